"""Where a hidden effect acts, and how it looks: what the draws have in common."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.robot import Law
from soro_bench.blind_benchmark.sensor_laws import SensorLaw
from soro_bench.models import trunk_geometry as geo

Where = Mapping[str, str | int]  # as in a report of a diagnosis
Quantities = dict[str, tuple[float, str]]  # value and unit by name


@dataclass(frozen=True)
class Hidden:
    """An effect but for its magnitude.

    Args:
        location: as in a report of a diagnosis: kind and name of an element, and perhaps an index.
        law: of a magnitude.
        parameters: value and unit by name, of a magnitude.
        guess: the magnitude that changes keypoints by about 2 mm.
        highest: the largest magnitude that makes sense.
        description: of what is outside the catalogue.
    """

    location: Where
    law: Callable[[float], Law | SensorLaw]
    parameters: Callable[[float], Quantities]
    guess: float
    highest: float
    description: str = ""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number from low to high whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_direction(rng: np.random.Generator) -> np.ndarray:
    """(3,) unit vector, uniform on the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def any_cable(rng: np.random.Generator, kind: str) -> tuple[int, Where]:
    """The number of a cable, and the location of that kind ("tendon", "actuator") at it."""
    c = int(rng.integers(len(geo.CABLE_NAMES)))
    return c, {"kind": kind, "name": geo.CABLE_NAMES[c]}


def any_neck(rng: np.random.Generator, first: int = 0) -> tuple[int, Where]:
    """The number of a neck, of the first or a later one, and the location of the vertebra behind it."""
    k = int(rng.integers(first, geo.NUM_NECKS))
    return k, vertebra(k)


def vertebra(k: int) -> Where:
    """The location of vertebra k, 0 to 9."""
    return {"kind": "body", "name": f"vertebra{k}"}


def any_keypoint(rng: np.random.Generator) -> int:
    """Any but the clamped end."""
    return int(rng.integers(1, len(geo.KEYPOINT_Z)))


def offset_values(vector: np.ndarray) -> Quantities:
    """An offset (3,) [m] as the parameters of a label."""
    return {f"offset_{n}": (float(v), "m") for n, v in zip("xyz", vector, strict=True)}
