"""Hidden physics that no catalogue has; the labels say "unknown"."""

import numpy as np

from soro_bench.blind_benchmark import body_laws as body
from soro_bench.blind_benchmark import cable_laws as cable
from soro_bench.blind_benchmark.locations import (
    Hidden,
    any_neck,
    log_uniform,
    offset_values,
    random_direction,
    vertebra,
)
from soro_bench.blind_benchmark.robot import Trace
from soro_bench.models import trunk_geometry as geo


def cross_talk(rng: np.random.Generator, base: Trace) -> Hidden:
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


def rubber_band(rng: np.random.Generator, base: Trace) -> Hidden:
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


def vibrating_base(rng: np.random.Generator, base: Trace) -> Hidden:
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


def gusts(rng: np.random.Generator, base: Trace) -> Hidden:
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


def hidden_obstacle(rng: np.random.Generator, base: Trace) -> Hidden:
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


def coupled_bend(rng: np.random.Generator, base: Trace) -> Hidden:
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
