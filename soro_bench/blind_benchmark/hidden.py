"""Hidden effects: where each acts and how it looks are drawn here; only its magnitude is left open.

An effect's magnitude is zero where it changes nothing, and the larger it is, the more it changes.
"""

import math
from collections.abc import Callable

import numpy as np

from soro_bench.blind_benchmark import body_laws as body
from soro_bench.blind_benchmark import cable_laws as cable
from soro_bench.blind_benchmark import sensor_laws as sensor
from soro_bench.blind_benchmark.locations import (
    Hidden,
    Quantities,
    any_cable,
    any_keypoint,
    any_neck,
    log_uniform,
    offset_values,
    random_direction,
    vertebra,
)
from soro_bench.blind_benchmark.robot import Trace
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

_ALL_ACTUATORS = {"kind": "actuator", "name": "*"}
_ALL_NECKS = {"kind": "body", "name": "*"}
_ALL_KEYPOINTS = {"kind": "sensor", "name": "keypoints"}
_STIFFEST = 15.0  # of what is explicit at a neck, in parts of its own nominal stiffness; twice as much would chatter
_EXCITATION = 30.0  # s, over which a drift's magnitude is its change


def _coulomb_friction(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "tendon")
    return Hidden(location, lambda m: cable.Friction(c, m), lambda m: {"friction": (m, "N")}, 0.4, 10.0)


def _load_friction(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "tendon")
    return Hidden(location, lambda m: cable.Capstan(c, m), lambda m: {"coefficient": (m, "1")}, 0.4, 1.0)


def _stribeck_friction(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "tendon")
    ratio, speed = rng.uniform(1.6, 3.0), log_uniform(rng, 0.002, 0.010)

    def parameters(m: float) -> Quantities:
        return {"friction": (m, "N"), "breakaway_friction": (ratio * m, "N"), "stribeck_speed": (speed, "m/s")}

    return Hidden(location, lambda m: cable.Friction(c, m, ratio, speed), parameters, 0.3, 10.0)


def _viscous_friction(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "tendon")
    return Hidden(location, lambda m: cable.Viscous(c, m), lambda m: {"drag": (m, "N s/m")}, 15.0, 1000.0)


def _backlash(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    return Hidden(location, lambda m: cable.Backlash(c, m), lambda m: {"width": (m, "m")}, 0.0023, 0.02)


def _compliance(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    return Hidden(location, lambda m: cable.Compliance(c, m), lambda m: {"compliance": (m, "m/N")}, 2e-4, 1e-2)


def _actuator_gain(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    sign = rng.choice([-1.0, 1.0], p=[0.7, 0.3])
    return Hidden(location, lambda m: cable.Gain(c, 1 + sign * m), lambda m: {"gain": (1 + sign * m, "1")}, 0.15, 0.9)


def _pretension(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    sign = rng.choice([-1.0, 1.0])
    return Hidden(location, lambda m: cable.Offset(c, sign * m), lambda m: {"offset": (sign * m, "m")}, 0.0012, 0.02)


def _actuator_saturation(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    highest = min(1.05 * base.tension[:, c].max(), trunk.MAX_TENSION)  # between samples there may be a little more

    def limit(m: float) -> float:
        return highest * (1 - m) if m > 0 else trunk.MAX_TENSION

    return Hidden(location, lambda m: cable.TensionLimit(c, limit(m)), lambda m: {"limit": (limit(m), "N")}, 0.4, 0.95)


def _actuator_deadband(rng: np.random.Generator, base: Trace) -> Hidden:
    c, location = any_cable(rng, "actuator")
    return Hidden(location, lambda m: cable.Deadband(c, m), lambda m: {"width": (m, "m")}, 0.0016, 0.02)


def _actuator_delay(rng: np.random.Generator, base: Trace) -> Hidden:
    return Hidden(_ALL_ACTUATORS, cable.Delay, lambda m: {"delay": (m, "s")}, 0.01, 0.3)


def _actuator_lag(rng: np.random.Generator, base: Trace) -> Hidden:
    return Hidden(_ALL_ACTUATORS, cable.Lag, lambda m: {"time_constant": (m, "s")}, 0.011, 0.3)


def _hysteresis(rng: np.random.Generator, base: Trace) -> Hidden:
    k, location = any_neck(rng)
    angle = log_uniform(rng, 0.06, 0.2)
    highest = _STIFFEST * float(geo.BEND[1, k]) / body.Hysteresis(k, 1.0, angle).stiffness

    def parameters(m: float) -> Quantities:
        return {"moment": (m, "N m"), "yield_angle": (angle, "rad")}

    return Hidden(location, lambda m: body.Hysteresis(k, m, angle), parameters, 0.04, highest)


def _plastic_set(rng: np.random.Generator, base: Trace) -> Hidden:
    k, location = any_neck(rng)
    angle = rng.uniform(0.25, 0.55) * base.bend[:, k].max()

    def parameters(m: float) -> Quantities:
        return {"yield_angle": (angle, "rad"), "share": (m, "1")}

    return Hidden(location, lambda m: body.PlasticSet(k, angle, m), parameters, 0.5, 0.95)


def _local_stiffness(rng: np.random.Generator, base: Trace) -> Hidden:
    k, location = any_neck(rng)
    sign = rng.choice([-1.0, 1.0], p=[0.6, 0.4])

    def factor(m: float) -> float:
        return math.exp(sign * m)

    return Hidden(
        location, lambda m: body.LocalStiffness(k, factor(m)), lambda m: {"factor": (factor(m), "1")}, 0.4, 1.6
    )


def _viscoelastic_creep(rng: np.random.Generator, base: Trace) -> Hidden:
    time_constant = log_uniform(rng, 0.7, 6.0)

    def parameters(m: float) -> Quantities:
        return {"stiffness_ratio": (m, "1"), "time_constant": (time_constant, "s")}

    return Hidden(_ALL_NECKS, lambda m: body.Creep(m, time_constant), parameters, 0.25, 3.0)


def _stiffening(rng: np.random.Generator, base: Trace) -> Hidden:
    return Hidden(_ALL_NECKS, body.Stiffening, lambda m: {"cubic": (m, "1/rad^2")}, 1.5, 20.0)


def _mullins_softening(rng: np.random.Generator, base: Trace) -> Hidden:
    angle = log_uniform(rng, 0.1, 0.3)

    def parameters(m: float) -> Quantities:
        return {"softening": (m, "1"), "angle": (angle, "rad")}

    return Hidden(_ALL_NECKS, lambda m: body.Mullins(m, angle), parameters, 0.3, 0.9)


def _stiffness_drift(rng: np.random.Generator, base: Trace) -> Hidden:
    sign = rng.choice([-1.0, 1.0], p=[0.7, 0.3])

    def rate(m: float) -> float:
        return sign * m / _EXCITATION

    return Hidden(_ALL_NECKS, lambda m: body.StiffnessDrift(rate(m)), lambda m: {"rate": (rate(m), "1/s")}, 0.15, 0.8)


def _payload(rng: np.random.Generator, base: Trace) -> Hidden:
    k, location = any_neck(rng)
    return Hidden(location, lambda m: body.Payload(k, m), lambda m: {"mass": (m, "kg")}, 0.015, 0.3)


def _base_tilt(rng: np.random.Generator, base: Trace) -> Hidden:
    azimuth = rng.uniform(0, 2 * np.pi)

    def parameters(m: float) -> Quantities:
        return {"angle": (m, "rad"), "axis_azimuth": (azimuth, "rad")}

    location = {"kind": "model", "name": "gravity"}
    return Hidden(location, lambda m: body.Tilt(m, azimuth), parameters, 0.05, 0.8)


def _fluid_drag(rng: np.random.Generator, base: Trace) -> Hidden:
    return Hidden(_ALL_NECKS, body.Drag, lambda m: {"drag": (m, "N s^2/m^2")}, 0.1, 20.0)


def _sensor_bias(rng: np.random.Generator, base: Trace) -> Hidden:
    i, direction = any_keypoint(rng), random_direction(rng)
    return Hidden(
        {**_ALL_KEYPOINTS, "index": i},
        lambda m: sensor.SensorBias(i, m * direction),
        lambda m: offset_values(m * direction),
        0.009,
        0.1,
    )


def _sensor_delay(rng: np.random.Generator, base: Trace) -> Hidden:
    return Hidden(_ALL_KEYPOINTS, sensor.SensorDelay, lambda m: {"delay": (m, "s")}, 0.01, 0.3)


def _clock_skew(rng: np.random.Generator, base: Trace) -> Hidden:
    sign = rng.choice([-1.0, 1.0])
    return Hidden(
        _ALL_KEYPOINTS, lambda m: sensor.ClockSkew(sign * m), lambda m: {"skew": (sign * m, "1")}, 0.0006, 0.02
    )


def _marker_slip(rng: np.random.Generator, base: Trace) -> Hidden:
    i, direction, start = any_keypoint(rng), random_direction(rng), rng.uniform(3.0, 9.0)
    return Hidden(
        {**_ALL_KEYPOINTS, "index": i},
        lambda m: sensor.SensorBias(i, m * direction, start),
        lambda m: {**offset_values(m * direction), "start": (start, "s")},
        0.01,
        0.1,
    )


def _frame_misalignment(rng: np.random.Generator, base: Trace) -> Hidden:
    axis = random_direction(rng)

    def parameters(m: float) -> Quantities:
        return {"angle": (m, "rad"), **{f"axis_{n}": (float(a), "1") for n, a in zip("xyz", axis, strict=True)}}

    return Hidden(_ALL_KEYPOINTS, lambda m: sensor.Misalignment(m, axis), parameters, 0.02, 0.5)


def _outliers(rng: np.random.Generator, base: Trace) -> Hidden:
    share = log_uniform(rng, 0.001, 0.01)

    def parameters(m: float) -> Quantities:
        return {"size": (m, "m"), "share": (share, "1")}

    return Hidden(_ALL_KEYPOINTS, lambda m: sensor.Outliers(m, share), parameters, 0.02, 0.3)


# --- physics that no catalogue has; its label is "unknown" ---


def _cross_talk(rng: np.random.Generator, base: Trace) -> Hidden:
    """The motor of one cable moves another too; the magnitude is the share of the displacement."""
    source, c = map(int, rng.choice(len(geo.CABLE_NAMES), 2, replace=False))
    return Hidden(
        {"kind": "actuator", "name": geo.CABLE_NAMES[c]},
        lambda m: cable.CrossTalk(source, c, m),
        lambda m: {"share": (m, "1")},
        0.2,
        2.0,
        f"cross-talk: the motor of cable {geo.CABLE_NAMES[source]} also moves cable {geo.CABLE_NAMES[c]}",
    )


def _rubber_band(rng: np.random.Generator, base: Trace) -> Hidden:
    """A band from a vertebra to a point of the world; the magnitude is its stiffness [N/m]."""
    k, location = any_neck(rng, 3)
    offset = rng.uniform(0.08, 0.15) * random_direction(rng)
    length = rng.uniform(0.5, 0.9) * float(np.linalg.norm(offset))
    return Hidden(
        location,
        lambda m: body.RubberBand(k, m, offset, length),
        lambda m: {"stiffness": (m, "N/m"), "length": (length, "m"), **offset_values(offset)},
        1.0,
        100.0,
        f"a rubber band from vertebra {k} to a place in the world",
    )


def _vibrating_base(rng: np.random.Generator, base: Trace) -> Hidden:
    """The direction of gravity oscillates about a horizontal axis; the magnitude is the angle [rad]."""
    azimuth, frequency = rng.uniform(0, 2 * np.pi), log_uniform(rng, 0.5, 2.5)
    return Hidden(
        {"kind": "model", "name": "gravity"},
        lambda m: body.Tilt(m, azimuth, frequency),
        lambda m: {"angle": (m, "rad"), "axis_azimuth": (azimuth, "rad"), "frequency": (frequency, "Hz")},
        0.06,
        0.8,
        "the base rocks: the direction of gravity oscillates",
    )


def _gusts(rng: np.random.Generator, base: Trace) -> Hidden:
    """Pulses of force on a vertebra at random times; the magnitude is the largest force [N]."""
    k, location = any_neck(rng, 3)
    direction, length = random_direction(rng), rng.uniform(0.3, 0.7)
    return Hidden(
        location,
        lambda m: body.Gusts(k, m, direction, length),
        lambda m: {"force": (m, "N"), "pulse": (length, "s")},
        0.15,
        10.0,
        f"gusts push vertebra {k} at a few random times",
    )


def _hidden_obstacle(rng: np.random.Generator, base: Trace) -> Hidden:
    """A soft wall that a vertebra hits; the magnitude is its stiffness [N/m]."""
    k, location = any_neck(rng, 4)
    angle = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    position = float(np.quantile(base.vertebrae[:, k] @ normal, rng.uniform(0.75, 0.92)))
    return Hidden(
        location,
        lambda m: body.Wall(k, m, normal, position),
        lambda m: {"stiffness": (m, "N/m"), "position": (position, "m"), "normal_azimuth": (angle, "rad")},
        30.0,
        600.0,
        f"a soft wall that vertebra {k} hits",
    )


def _coupled_bend(rng: np.random.Generator, base: Trace) -> Hidden:
    """One neck is bent in proportion to another's bend; the magnitude is the share of its stiffness."""
    source, k = map(int, rng.choice(8, 2, replace=False))
    return Hidden(
        vertebra(k),
        lambda m: body.CoupledBend(source, k, m),
        lambda m: {"share": (m, "1")},
        0.6,
        1.5,
        f"the neck before vertebra {k} is bent sideways in proportion to the bend before vertebra {source}",
    )


Draw = Callable[[np.random.Generator, Trace], Hidden]
# by name: class, and what draws location and shape given the robot without the effect
PHYSICS: dict[str, tuple[str, Draw]] = {
    "coulomb_friction": ("friction", _coulomb_friction),
    "load_friction": ("friction", _load_friction),
    "stribeck_friction": ("friction", _stribeck_friction),
    "viscous_friction": ("timing", _viscous_friction),
    "backlash": ("hysteresis_or_play", _backlash),
    "compliance": ("static_error", _compliance),
    "actuator_gain": ("static_error", _actuator_gain),
    "pretension": ("static_error", _pretension),
    "actuator_lag": ("timing", _actuator_lag),
    "actuator_delay": ("timing", _actuator_delay),
    "actuator_saturation": ("amplitude", _actuator_saturation),
    "actuator_deadband": ("hysteresis_or_play", _actuator_deadband),
    "viscoelastic_creep": ("slow_drift", _viscoelastic_creep),
    "hysteresis": ("hysteresis_or_play", _hysteresis),
    "stiffening": ("amplitude", _stiffening),
    "mullins_softening": ("amplitude", _mullins_softening),
    "plastic_set": ("slow_drift", _plastic_set),
    "local_stiffness": ("local", _local_stiffness),
    "stiffness_drift": ("local", _stiffness_drift),
    "payload": ("inertia", _payload),
    "base_tilt": ("static_error", _base_tilt),
    "fluid_drag": ("inertia", _fluid_drag),
}
MEASUREMENT: dict[str, tuple[str, Draw]] = {
    "sensor_bias": ("measurement", _sensor_bias),
    "sensor_delay": ("measurement", _sensor_delay),
    "clock_skew": ("measurement", _clock_skew),
    "marker_slip": ("measurement", _marker_slip),
    "frame_misalignment": ("measurement", _frame_misalignment),
    "outliers": ("measurement", _outliers),
}
# what no catalogue has; their labels say "unknown"
UNKNOWN: dict[str, tuple[str, Draw]] = {
    "cross_talk": ("unknown", _cross_talk),
    "rubber_band": ("unknown", _rubber_band),
    "vibrating_base": ("unknown", _vibrating_base),
    "gusts": ("unknown", _gusts),
    "hidden_obstacle": ("unknown", _hidden_obstacle),
    "coupled_bend": ("unknown", _coupled_bend),
}
ALL = {**PHYSICS, **MEASUREMENT, **UNKNOWN}
