"""The result of paired recordings: plain numbers and names, in JSON and back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soro_bench.diagnosis.result import plain_json, read
from soro_bench.diagnosis.result_parts import Estimate
from soro_bench.effects.effect import Location
from soro_bench.files import read_json, write_json

SCHEMA = "soro-bench/paired/1"
VERDICTS = ("same", "differs", "changed")


@dataclass(frozen=True)
class PointDifference:
    """The difference of one point: its mean (D,), rms and largest distance [signal's unit], its rms in units of what
    noise makes, and the share of the samples that both recordings have."""

    index: int
    mean: tuple[float, ...]
    rms: float
    largest: float
    times_noise: float
    present: float


@dataclass(frozen=True)
class Profile:
    """Rms distance over time: (K,) s, and (K, P) [signal's unit]; of the first pair."""

    time: tuple[float, ...]
    rms: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Description:
    """What a difference looks like, without a model: "offset" (rms [signal's unit]), "amplitude" (share of the motion)
    or "delay" [s]; the last two are fitted together. explained: share of the difference's square."""

    name: str
    estimate: Estimate
    explained: float


@dataclass(frozen=True)
class Start:
    """How far the initial states are apart where they are farthest: point, distance [signal's unit], the same in noise
    deviations, and whether that is beyond noise."""

    point: int
    distance: float
    deviations: float
    differs: bool


@dataclass(frozen=True)
class SignalDifference:
    """What differs in a signal.

    verdict: "same" (no difference beyond noise), "differs" (beyond noise, without a steady pattern: two runs of one
        robot may) or "changed" (steadily).
    rms: of a coordinate; distance: of a point. noise_before, noise_after: standard deviations of white noise.
    run_to_run: rms of a coordinate between runs of the same robot, where there are some. All in the signal's unit.
    p_value: of a difference that is as steady in all blocks of time by chance.
    """

    name: str
    unit: str
    verdict: str
    rms: float
    distance: float
    noise_before: float
    noise_after: float
    run_to_run: float | None
    p_value: float
    points: tuple[PointDifference, ...]
    profile: Profile
    looks_like: tuple[Description, ...]
    starts: tuple[Start, ...]

    @property
    def noise(self) -> float:
        """What a coordinate's difference would be without a change [signal's unit]."""
        return max((self.noise_before**2 + self.noise_after**2) ** 0.5, self.run_to_run or 0.0)


@dataclass(frozen=True)
class CommandDifference:
    """How far the commands of a pair are apart.

    shift: s, by which the clock of the second recording is ahead. rate: of that clock against the first one, less 1.
    rms, largest: differences of the worst command, as shares of its range. overlap: s that both recordings have.
    """

    shift: float
    rate: float
    rms: float
    largest: float
    overlap: float


@dataclass(frozen=True)
class Change:
    """A change that may explain the difference.

    kind: such as "payload", "stiffness" or "friction"; name: of the law or parameter. location: of a law.
    estimates: its size. parameter: whether it is a parameter of the model that moves. removed: whether a law acts
    before and not after. explained: share of the difference's square. probability: of all changes that were compared.
    """

    kind: str
    name: str
    location: Location | None
    estimates: tuple[Estimate, ...]
    parameter: bool
    removed: bool
    explained: float
    probability: float


@dataclass(frozen=True)
class Explanation:
    """What explains the difference of the robot's signals.

    signal, unit: of the one that differs most by its noise. changes: the most probable set, fitted together.
    candidates: each alone, the most probable first. nothing, unknown: probabilities that nothing has changed, and that
    what has is not among them. explained: share of the difference's square by ``changes``, in all signals. before,
    after: rms of a coordinate [signal's unit] of the difference, and of what is left.
    replay: rms error of the fitted model on the recording before the change [signal's unit]; it is in both, and the
    difference is free of it to first order. informative: independent samples that the difference is worth.
    """

    robot: str
    signal: str
    unit: str
    changes: tuple[Change, ...]
    candidates: tuple[Change, ...]
    nothing: float
    unknown: float
    explained: float
    before: float
    after: float
    replay: float
    informative: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PairedResult:
    """What paired recordings say; ``explanation`` needs a model."""

    commands: tuple[CommandDifference, ...]
    signals: tuple[SignalDifference, ...]
    explanation: Explanation | None
    seed: int
    seconds: float
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.signals:
            raise ValueError("paired recordings need a signal")
        for each in self.signals:
            if each.verdict not in VERDICTS:
                raise ValueError(f"verdict is {each.verdict!r}; allowed are {', '.join(VERDICTS)}")

    def to_json(self) -> dict[str, Any]:
        """A JSON object; NaN is null."""
        return {"schema": SCHEMA, **plain_json(self)}

    @classmethod
    def from_json(cls, data: object) -> "PairedResult":
        """The result that a JSON object describes; ValueError names what is wrong."""
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise ValueError(f"not a result of paired recordings: its schema has to be {SCHEMA}")
        found = read(cls, {key: value for key, value in data.items() if key != "schema"}, "result")
        assert isinstance(found, cls)
        return found

    def save(self, path: str | Path) -> None:
        """Write it as JSON."""
        write_json(path, self.to_json())

    @classmethod
    def load(cls, path: str | Path) -> "PairedResult":
        """Read a file; ValueError if it is another one."""
        try:
            return cls.from_json(read_json(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
