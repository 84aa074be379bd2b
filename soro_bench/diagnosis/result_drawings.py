"""What the report of a diagnosis draws: a law against its state, replays over time, and the robot."""

import math
from dataclasses import dataclass

from soro_bench.diagnosis.result_parts import NamedLocation
from soro_bench.effects.effect import Location

LONGEST = 1e5  # s, of a replay
FARTHEST = 1e4  # m, of what is drawn


@dataclass(frozen=True)
class LawCurve:
    """What a law does against the state of its location, at nodes of falling and of rising states: rows are (2, n).

    law: of the fitted law. measured, deviation: what the recordings ask for, and its standard deviation. NaN where the
    recordings say too little. share: of the law's squared force that the curve describes.
    state_label, force_label: with units.
    """

    effect: NamedLocation
    state: tuple[tuple[float, ...], ...]
    law: tuple[tuple[float, ...], ...]
    measured: tuple[tuple[float, ...], ...]
    deviation: tuple[tuple[float, ...], ...]
    share: float
    state_label: str
    force_label: str


@dataclass(frozen=True)
class Replay:
    """The first recording and plain replays of it: (T, P * D) in the unit of the signal; NaN where unmeasured.

    time: (T,) s since the first command. shape: (P, D), points and coordinates.
    gain: (T,) evidence that the best hypothesis gains in each sample over fitted parameters alone.
    """

    time: tuple[float, ...]
    shape: tuple[int, int]
    measured: tuple[tuple[float, ...], ...]
    before: tuple[tuple[float, ...], ...]
    after: tuple[tuple[float, ...], ...]
    gain: tuple[float, ...]

    def __post_init__(self) -> None:
        steps, width = len(self.time), self.shape[0] * self.shape[1]
        if not steps or not all(math.isfinite(each) and 0 <= each <= LONGEST for each in self.time):
            raise ValueError(f"time of a replay has {steps} stamps; allowed are 0 to {LONGEST:g} s, one at least")
        if list(self.time) != sorted(self.time):
            raise ValueError("time of a replay runs backwards")
        for name in ("measured", "before", "after"):
            rows = getattr(self, name)
            if len(rows) != steps or any(len(row) != width for row in rows):
                raise ValueError(f"{name} of a replay needs {steps} rows of {width} numbers")
        if len(self.gain) != steps:
            raise ValueError(f"gain of a replay has {len(self.gain)} numbers; {steps} are needed")


@dataclass(frozen=True)
class Shape:
    """A part of the robot to draw: a line through points (K, 3) [m] with a radius [m], and the locations it stands
    for. A single point is a ball."""

    points: tuple[tuple[float, float, float], ...]
    radius: float
    locations: tuple[Location, ...]

    def __post_init__(self) -> None:
        numbers = [self.radius, *(each for point in self.points for each in point)]
        if not self.points or not all(abs(each) <= FARTHEST for each in numbers) or self.radius < 0:
            raise ValueError(f"a shape needs points and a radius, all finite and at most {FARTHEST:g} m")
