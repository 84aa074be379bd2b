"""What a result says of the robot, of its recordings and of replays of them, and the patch of its model."""

import math
import typing
from dataclasses import dataclass

from soro_bench.effects.effect import Location

LONGEST = 1e5  # s, of a replay
FARTHEST = 1e4  # m, of what is drawn
ACCURATE = "accurate"  # name of a ReplayedRobot


@dataclass(frozen=True)
class SourceFile:
    """A file that the robot was made from.

    path: as it was given. sha256: of its content.
    """

    path: str
    sha256: str


@dataclass(frozen=True)
class RobotSummary:
    """The robot and the signal that was explained.

    channels: what each number of an action moves.
    files: its model and its mapping, where it was made from files. others: names of the other explained signals.
    """

    name: str
    model: str
    signal: str
    unit: str
    channels: tuple[str, ...]
    has_baseline: bool = False
    files: tuple[SourceFile, ...] = ()
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class SignalQuality:
    """Of a recording: standard deviation of the noise [signal's unit], and share of missing samples.

    digest: of its samples, to know it again. left_out: sample and column, through all signals, of numbers that fits
        left out as outliers, beside what ``Result.data`` says.
    """

    noise: float
    missing: float
    digest: str = ""
    left_out: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class DataFinding:
    """What a sensor, a logger or a broken line did to a recording: no physics of the robot.

    name: such as "quantisation", "spikes" or "held". signal: of a signal or command. recording: index of it in
        ``recordings``. samples: numbers concerned. share: of those that there are.
    text: what was found and done, and what to do, in one sentence.
    """

    name: str
    signal: str
    recording: int
    samples: int
    share: float
    text: str


@dataclass(frozen=True)
class Outliers:
    """Samples left out because they are alone and far off: share of all points, and their rms distance [signal's
    unit]."""

    share: float
    size: float


@dataclass(frozen=True)
class SignalErrors:
    """Of one of several signals: root mean squares of a coordinate in plain replays, in its unit.

    noise: standard deviation of its sensor's noise. before, after: on the recordings fitted to, with fitted parameters
    only and by the best hypothesis. heldout_before, heldout_after: on held-out recordings; None without them.
    """

    name: str
    unit: str
    noise: float
    before: float
    after: float
    heldout_before: float | None = None
    heldout_after: float | None = None


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


@dataclass(frozen=True)
class ReplayedRobot:
    """A robot with all that a plain replay of it needs, and the errors of its replays [signal's unit].

    name: "nominal" (the model as built), "fitted" (fitted parameters only), "patched" (the parameters and effects of
        the patch), "best" (the best hypothesis, where it is no patch), "accurate" (the last one of these, simulated by
        the robot's accurate model, if it has one) or "alternative" (another hypothesis).
    parameters: values by name. effects: all that act, in the format of effects.json, known ones included.
    train, heldout: root mean squares of a coordinate, of the recordings that were fitted to and of held-out ones; NaN
        where a replay diverges; None where nothing was held out.
    """

    name: str
    parameters: dict[str, float]
    effects: tuple[dict[str, typing.Any], ...]
    train: float
    heldout: float | None = None


@dataclass(frozen=True)
class WorseReplay:
    """Recordings of which a robot of the result replays worse than the model as built does.

    robot: name of a ReplayedRobot. recordings: "fitted" or "held-out". built, found: root mean squares of a coordinate
        in plain replays [signal's unit], by the model as built and by that robot; NaN where a replay diverges.
    """

    robot: str
    recordings: str
    built: float
    found: float


@dataclass(frozen=True)
class ReplayError:
    """Root mean squares of plain replays [signal's unit]: by the model as built, and by patched_model.xml alone."""

    built: float
    patched: float


@dataclass(frozen=True)
class Patch:
    """The physics that the simulation should have.

    state: "none", "rejected" (it makes held-out recordings worse), "untested" (none is held out) or "accepted".
    effects: in the format of effects.json, those of a baseline diagnosis included.
    model: MJCF with the fitted parameters and the effects ``in_model``; None where it is not written.
    remaining: effects that the MJCF lacks.
    model_state: "as_found", "refitted" (with other parameters, since alone it would be worse than the model as built)
        or "not_written"; empty in results of older versions.
    obstacle: why the model is not as found.
    replays: errors of the model alone, on the recordings fitted to and on held-out ones.
    """

    state: str
    effects: tuple[dict[str, typing.Any], ...]
    model: str | None
    in_model: tuple[str, ...]
    remaining: tuple[dict[str, typing.Any], ...]
    obstacle: str | None = None
    model_state: str = ""
    replays: tuple[ReplayError, ...] = ()
