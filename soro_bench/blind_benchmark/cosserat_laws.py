"""Hidden physics of the trunk that PyElastica simulates; none of it is shared with other robots or with a diagnosis."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.cases import change, recording
from soro_bench.blind_benchmark.cosserat import TIMESTEP, Arm, ArmLaw, Row
from soro_bench.blind_benchmark.draw import draw_parameters
from soro_bench.blind_benchmark.healthy import DURATIONS, drawn_actions
from soro_bench.blind_benchmark.locations import (
    Quantities,
    Where,
    any_cable,
    any_keypoint,
    any_neck,
    log_uniform,
    offset_values,
    random_direction,
)
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.trunk_chain import displacements
from soro_bench.recording.recording import Recording

_SLOW = 1e-3  # m/s, below which Coulomb friction is viscous
_ALL_ACTUATORS, _ALL_NECKS = {"kind": "actuator", "name": "*"}, {"kind": "body", "name": "*"}


class Payload(ArmLaw):
    """A mass [kg] in the middle of a vertebra."""

    def __init__(self, neck: int, mass: float) -> None:
        self._neck, self._mass = neck, mass

    def install(self, arm: Arm) -> None:
        arm.payloads[self._neck] += self._mass


class Softening(ArmLaw):
    """A neck whose stiffness and damping are those of the parameters times a factor."""

    def __init__(self, neck: int, factor: float) -> None:
        self._neck, self._factor = neck, factor

    def install(self, arm: Arm) -> None:
        for values in arm.stiffness.values():
            values[self._neck] *= self._factor


class Tilt(ArmLaw):
    """A base that is turned by an angle [rad] about a horizontal axis through the clamp, seen by who is turned too."""

    def __init__(self, angle: float, azimuth: float) -> None:
        self._angle, self._azimuth = angle, azimuth

    def install(self, arm: Arm) -> None:
        axis = np.array([math.sin(self._azimuth), 0.0, math.cos(self._azimuth)])
        gravity = arm.gravity
        across = np.cross(axis, gravity)
        arm.gravity = math.cos(self._angle) * gravity + math.sin(self._angle) * across


class LateralDrag(ArmLaw):
    """Quadratic drag [N s^2/m^2] of each vertebra, across the axis only."""

    def __init__(self, drag: float) -> None:
        self._drag = drag

    def push(self, arm: Arm) -> None:
        rod = arm.rod
        speed = (rod.velocity_collection[:, 1:] + rod.velocity_collection[:, :-1]) / 2
        across = speed - (speed * rod.tangents).sum(axis=0) * rod.tangents
        per_length = self._drag * geo.NUM_NECKS / (geo.LENGTH - geo.NECK_START[0])
        force = -per_length * rod.rest_lengths * np.sqrt((across * across).sum(axis=0)) * across
        rod.external_forces[:, 1:] += force / 2
        rod.external_forces[:, :-1] += force / 2


class Friction(ArmLaw):
    """Coulomb friction [N] of a cable in its guides."""

    def __init__(self, cable: int, friction: float) -> None:
        self._row = (cable, 0.0, friction / _SLOW, -friction, friction)

    def cables(self, arm: Arm) -> Sequence[Row]:
        return (self._row,)


class Dahl(ArmLaw):
    """Dahl's friction [N] of a cable, an elastic slip over a distance [m] before it slides (P. Dahl, 1968)."""

    def __init__(self, cable: int, friction: float, distance: float) -> None:
        self._cable, self._friction, self._distance = cable, friction, distance
        self._force = 0.0

    def cables(self, arm: Arm) -> Sequence[Row]:
        rate = arm.rates[self._cable]
        against = self._force * math.copysign(1.0, rate) / self._friction  # 1 where it slides
        stiffness = self._friction / self._distance * max(1.0 - against, 0.0)
        self._force = float(np.clip(self._force + stiffness * rate * arm.timestep, -self._friction, self._friction))
        slope = stiffness * arm.timestep
        return ((self._cable, self._force, slope, -self._friction, self._friction),)


class Gain(ArmLaw):
    """A cable whose servo does a part of what is commanded."""

    def __init__(self, cable: int, gain: float) -> None:
        self._cable, self._gain = cable, gain

    def command(self, arm: Arm, pull: np.ndarray) -> np.ndarray:
        return np.where(np.arange(len(pull)) == self._cable, self._gain * pull, pull)


class Offset(ArmLaw):
    """A cable that is pulled by so much [m] from the start."""

    def __init__(self, cable: int, offset: float) -> None:
        self._cable, self._offset = cable, offset

    def command(self, arm: Arm, pull: np.ndarray) -> np.ndarray:
        return pull + self._offset * (np.arange(len(pull)) == self._cable)


class Delay(ArmLaw):
    """Commands that reach all servos later [s]."""

    def __init__(self, delay: float) -> None:
        self._delay = delay
        self._waiting: list[np.ndarray] = []

    def command(self, arm: Arm, pull: np.ndarray) -> np.ndarray:
        self._waiting.append(pull)
        return self._waiting.pop(0) if len(self._waiting) > round(self._delay / arm.timestep) else np.zeros_like(pull)


class Lag(ArmLaw):
    """Servos that follow their commands with a time constant [s]."""

    def __init__(self, constant: float) -> None:
        self._constant = constant
        self._state = np.zeros(len(geo.CABLE_NAMES))

    def command(self, arm: Arm, pull: np.ndarray) -> np.ndarray:
        self._state = self._state + (pull - self._state) * -math.expm1(-arm.timestep / self._constant)
        return self._state


class Play(ArmLaw):
    """A drum that turns by a width [m] before it takes its cable along."""

    def __init__(self, cable: int, width: float) -> None:
        self._cable, self._half, self._out = cable, width / 2, 0.0

    def command(self, arm: Arm, pull: np.ndarray) -> np.ndarray:
        self._out = float(np.clip(self._out, pull[self._cable] - self._half, pull[self._cable] + self._half))
        return np.where(np.arange(len(pull)) == self._cable, self._out, pull)


class NeckHysteresis(ArmLaw):
    """A moment [N m] at a neck that follows its bend like Dahl's friction, over an angle [rad]."""

    def __init__(self, neck: int, moment: float, angle: float) -> None:
        self._neck, self._moment, self._angle = neck, moment, angle
        self._state, self._last = np.zeros(2), np.zeros(2)

    def push(self, arm: Arm) -> None:
        last = int(np.argmin(np.abs(arm.nodes - geo.NECK_END[self._neck])))  # of the vertebra behind the neck
        first = int(np.argmin(np.abs(arm.nodes - geo.NECK_START[self._neck]))) - 1
        near, far = arm.rod.director_collection[:, :, first], arm.rod.director_collection[:, :, last]
        turn = near @ far.T  # from the frame of the far element to that of the near one
        bend = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0]]) / 2
        step = bend - self._last
        self._state = self._state + step / self._angle - self._state * np.linalg.norm(step) / self._angle
        self._last = bend
        moment = self._moment * np.array([*self._state, 0.0])
        arm.rod.external_torques[:, last] -= turn.T @ moment
        arm.rod.external_torques[:, first] += moment


@dataclass(frozen=True)
class Hidden:
    """An effect of an arm.

    Args:
        names: of the catalogue, that are right.
        laws: new ones, for a run.
        offset: (21, 3) m, added to the keypoints as measured.
    """

    names: tuple[str, ...]
    location: Where
    parameters: Quantities
    laws: Callable[[], list[ArmLaw]] = list
    offset: np.ndarray | float = 0.0


_DRY = ("coulomb_friction", "stribeck_friction", "load_friction")


def _payload(rng: np.random.Generator) -> Hidden:
    (k, where), mass = any_neck(rng, 2), log_uniform(rng, 0.012, 0.035)
    return Hidden(("payload",), where, {"mass": (mass, "kg")}, lambda: [Payload(k, mass)])


def _softening(rng: np.random.Generator) -> Hidden:
    (k, where), factor = any_neck(rng), math.exp(-rng.uniform(0.35, 0.8))
    return Hidden(("local_stiffness",), where, {"factor": (factor, "1")}, lambda: [Softening(k, factor)])


def _tilt(rng: np.random.Generator) -> Hidden:
    angle, azimuth = rng.uniform(0.04, 0.1), rng.uniform(0, 2 * np.pi)
    where = {"kind": "model", "name": "gravity"}
    return Hidden(("base_tilt",), where, {"angle": (angle, "rad")}, lambda: [Tilt(angle, azimuth)])


def _drag(rng: np.random.Generator) -> Hidden:
    drag = log_uniform(rng, 0.2, 0.6)
    return Hidden(("fluid_drag",), _ALL_NECKS, {"drag": (drag, "N s^2/m^2")}, lambda: [LateralDrag(drag)])


def _friction(rng: np.random.Generator) -> Hidden:
    (c, where), force = any_cable(rng, "tendon"), log_uniform(rng, 1.5, 3.5)
    return Hidden(_DRY, where, {"friction": (force, "N")}, lambda: [Friction(c, force)])


def _dahl(rng: np.random.Generator) -> Hidden:
    (c, where), force, distance = any_cable(rng, "tendon"), log_uniform(rng, 1.5, 3.5), log_uniform(rng, 3e-4, 1e-3)
    values = {"friction": (force, "N"), "distance": (distance, "m")}
    return Hidden(_DRY, where, values, lambda: [Dahl(c, force, distance)])


def _gain(rng: np.random.Generator) -> Hidden:
    (c, where), gain = any_cable(rng, "actuator"), rng.uniform(0.6, 0.85)
    return Hidden(("actuator_gain",), where, {"gain": (gain, "1")}, lambda: [Gain(c, gain)])


def _offset(rng: np.random.Generator) -> Hidden:
    (c, where), offset = any_cable(rng, "actuator"), float(rng.choice([-1, 1])) * rng.uniform(0.0008, 0.0018)
    return Hidden(("pretension",), where, {"offset": (offset, "m")}, lambda: [Offset(c, offset)])


def _delay(rng: np.random.Generator) -> Hidden:
    delay = log_uniform(rng, 0.015, 0.04)
    return Hidden(("actuator_delay",), _ALL_ACTUATORS, {"delay": (delay, "s")}, lambda: [Delay(delay)])


def _lag(rng: np.random.Generator) -> Hidden:
    constant = log_uniform(rng, 0.02, 0.05)
    return Hidden(("actuator_lag",), _ALL_ACTUATORS, {"time_constant": (constant, "s")}, lambda: [Lag(constant)])


def _play(rng: np.random.Generator) -> Hidden:
    (c, where), width = any_cable(rng, "actuator"), rng.uniform(0.002, 0.004)
    return Hidden(("backlash",), where, {"width": (width, "m")}, lambda: [Play(c, width)])


def _hysteresis(rng: np.random.Generator) -> Hidden:
    (k, where), moment, angle = any_neck(rng), log_uniform(rng, 0.015, 0.035), log_uniform(rng, 0.06, 0.15)
    values = {"moment": (moment, "N m"), "yield_angle": (angle, "rad")}
    return Hidden(("hysteresis",), where, values, lambda: [NeckHysteresis(k, moment, angle)])


def _sensor_shift(rng: np.random.Generator) -> Hidden:
    i, shift = any_keypoint(rng), rng.uniform(0.008, 0.02) * random_direction(rng)
    where: Where = {"kind": "sensor", "name": "keypoints", "index": i}
    offset = np.zeros((len(geo.KEYPOINT_Z), 3))
    offset[i] = shift
    return Hidden(("sensor_bias",), where, offset_values(shift), offset=offset)


# by what is hidden: what draws it
HIDDEN: dict[str, Callable[[np.random.Generator], Hidden]] = {
    "payload": _payload,
    "friction": _friction,
    "weak cable": _gain,
    "delay": _delay,
    "soft neck": _softening,
    "tilt": _tilt,
    "sensor shift": _sensor_shift,
    "play": _play,
    "Dahl friction": _dahl,
    "lateral drag": _drag,
    "lag": _lag,
    "neck hysteresis": _hysteresis,
    "pretension": _offset,
}


def build(seed: int, durations: Mapping[str, float] = DURATIONS) -> tuple[dict[str, Recording], dict]:
    """The recordings by role of an arm with one hidden effect, the next of HIDDEN for the next seed, and its label.

    Raises:
        ValueError: the simulation diverged.
    """
    rng = np.random.default_rng([seed, 3])
    name, parameters = list(HIDDEN)[seed % len(HIDDEN)], draw_parameters(rng)
    hidden = HIDDEN[name](rng)
    recordings, changes = {}, {}
    for role, (actions, noise) in drawn_actions(seed, durations).items():
        every = round(CONTROL_TIMESTEP / TIMESTEP)
        pulls = displacements(actions, TIMESTEP, every)
        points = Arm(parameters, hidden.laws()).run(pulls, every) + hidden.offset
        recordings[role] = recording(actions, points, noise)
        if role != "heldout":
            changes[role] = change(points, Arm(parameters).run(pulls, every))
    effect = {
        "name": hidden.names[0],
        "names": list(hidden.names),
        "where": hidden.location,
        "parameters": {key: {"value": value, "unit": unit} for key, (value, unit) in hidden.parameters.items()},
    }
    label = {"kind": name, "robot": "pyelastica", "seed": seed, "parameters": parameters, "effects": [effect]}
    return recordings, label | {"change_mm": changes}
