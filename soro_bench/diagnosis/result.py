"""The result of a diagnosis: plain numbers and names, in JSON and back.

Everything that a person or a program gets is rendered from a :class:`Result`: the summary on the console, report.html,
comparison.rrd, the patched model, effects.json and the actions to record next. Nothing here simulates.
"""

import math
import types
import typing
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path

from soro_bench.diagnosis.result_parts import (
    Agreement,
    Detectable,
    DiscoveredLaw,
    Errors,
    Finding,
    HypothesisSummary,
    ModelForm,
    NamedLocation,
    NextRecording,
    ParameterEstimate,
    RankedLocation,
    ReachedLimit,
    SeedAnswer,
    SelectionRound,
    UnknownInput,
)
from soro_bench.diagnosis.result_robot import (
    DataFinding,
    Outliers,
    Patch,
    Replay,
    ReplayedRobot,
    RobotSummary,
    Shape,
    SignalErrors,
    SignalQuality,
    WorseReplay,
)
from soro_bench.files import brief, read_json, write_json

SCHEMA = "soro-bench/diagnosis/2"
VERDICTS = (
    "adequate", "discrepancy", "outside_catalogue", "measurement_fault", "recordings_disagree", "undecided",
)  # fmt: skip
_NOTHING_FOUND = ("adequate", "undecided")  # verdicts of robots without a discrepancy
DIGITS = 7  # significant ones of numbers in a file; a float32 has as many


@dataclass(frozen=True)
class LawCurve:
    """What a law does against the state of its location, at nodes of falling and of rising states: rows are (2, n).

    law: of the fitted law. measured: what the recordings ask for, NaN where they say too little. deviation:
    standard deviation of measured. share: of the law's squared force that the curve describes.
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
class Result:
    """What a diagnosis found.

    verdict: "adequate" (no discrepancy detected), "discrepancy" (a law of the catalogue), "outside_catalogue",
        "measurement_fault", "recordings_disagree" (no law was detected, but parameters change), or "undecided" (none
        was detected, but plain replays leave most of the motion, and test little).
    p_value: probability of as much misfit where nothing is missing; None where the model error is far above the sensor
        noise. alpha: the level at which a discrepancy is as likely as none.
    unknown: probability that the discrepancy is outside the catalogue, or hidden by model-form error. healthy: that
        there is none.
    predicted_gain: in log evidence, of the best single term. remaining_gain: likewise of one more term, on top of the
        best hypothesis.
    trained_on: number of recordings that were fitted to, the first ones; the others were held out.
    findings: every effect of any hypothesis, the most probable first. categories: kinds of laws with probabilities.
    credible_set: names that together have 90 % of the probability.
    train, heldout: errors of the best hypothesis. parameters_only: rms of fitted parameters alone, without
        discretisation error [signal's unit].
    covariance: (d, d) of the parameters' posterior, in their units; 0 where they are known.
    undetectable: names of laws that these recordings would not have shown. not_searched: names of laws without
        a location in this robot.
    trainable: whether the robot is of the suite, so that policies can be trained on the posterior.
    seed: of random numbers. seconds: that the diagnosis took.
    settings: that differ from their defaults. notes: on the model, its mapping and the recordings, in words.
    data: what sensors and loggers did to the recordings.
    robots: whose plain replays are shown; empty in results of older versions.
    agreement: what each recording alone says of parameters and magnitudes; empty where one recording was fitted.
    limits: what the fitted robot reaches in replays of these recordings: limits of force and control, slack cables,
        stops, contacts.
    signals: errors of every signal, where several are explained; all other errors are those of the first one.
    model_form: what another simulator of the robot could differ by; None in results before it was estimated.
    discovery: a law outside the catalogue, or that none was found; None where none was looked for.
    region: bodies that an unknown input cannot be told apart at, from the base on; empty where there is one.
    seeds: answers of diagnoses with different random numbers; empty where there is one.
    worse_replays: where fitted parameters or the best hypothesis have a larger plain error than the model as built.
    """

    robot: RobotSummary
    verdict: str
    p_value: float | None
    alpha: float
    unknown: float
    healthy: float
    predicted_gain: float
    remaining_gain: float
    recordings: tuple[SignalQuality, ...]
    trained_on: int
    outliers: Outliers
    findings: tuple[Finding, ...]
    categories: dict[str, float]
    hypotheses: tuple[HypothesisSummary, ...]
    rounds: tuple[SelectionRound, ...]
    credible_set: tuple[str, ...]
    train: Errors
    heldout: Errors | None
    parameters_only: float
    parameters: tuple[ParameterEstimate, ...]
    covariance: tuple[tuple[float, ...], ...]
    trainable: bool
    patch: Patch
    locations: tuple[RankedLocation, ...]
    unknown_input: UnknownInput | None
    detectable: tuple[Detectable, ...]
    undetectable: tuple[str, ...]
    not_searched: tuple[str, ...]
    next_recording: NextRecording | None
    curve: LawCurve | None
    replay: Replay
    shapes: tuple[Shape, ...]
    seed: int
    seconds: float
    settings: dict[str, typing.Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    data: tuple[DataFinding, ...] = ()
    robots: tuple[ReplayedRobot, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    limits: tuple[ReachedLimit, ...] = ()
    signals: tuple[SignalErrors, ...] = ()
    model_form: ModelForm | None = None
    worse_replays: tuple[WorseReplay, ...] = ()
    discovery: DiscoveredLaw | None = None
    region: tuple[str, ...] = ()
    seeds: tuple[SeedAnswer, ...] = ()

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict is {brief(self.verdict)}; allowed are {', '.join(VERDICTS)}")
        if not self.hypotheses:
            raise ValueError("a result needs a hypothesis")

    @property
    def detected(self) -> bool:
        """Whether something is missing or wrong, outliers apart."""
        return self.verdict not in (*_NOTHING_FOUND, "measurement_fault") or bool(self.best.effects)

    @property
    def answer(self) -> str:
        """What it says in short: the laws with their locations, or that there is none."""
        if self.verdict == "outside_catalogue":
            law, place = self.discovery, self.locations[0].location if self.locations else None
            return f"outside the catalogue at {law.location if law else place or 'no single location'}"
        if not self.best.effects:
            return self.verdict.replace("_", " ")
        return " and ".join(sorted(map(str, self.best.effects)))

    @property
    def best(self) -> HypothesisSummary:
        """The hypothesis that the report is about."""
        return self.hypotheses[0]

    def to_json(self) -> dict[str, typing.Any]:
        """A JSON object; NaN is null."""
        return {"schema": SCHEMA, **plain_json(self)}

    @classmethod
    def from_json(cls, data: object) -> "Result":
        """The result that a JSON object describes; ValueError names what is wrong."""
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise ValueError(f"not a result of a diagnosis: its schema has to be {SCHEMA}")
        return read(cls, {key: value for key, value in data.items() if key != "schema"}, "result")

    def save(self, path: str | Path) -> None:
        """Write it as JSON."""
        write_json(path, self.to_json())

    @classmethod
    def load(cls, path: str | Path) -> "Result":
        """Read a file; ValueError if it is another one."""
        data = read_json(path)
        try:
            return cls.from_json(data)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error


def plain_json(value: typing.Any) -> typing.Any:
    """Dataclasses as JSON objects, tuples as lists, numbers with seven digits, NaN as null."""
    if is_dataclass(value):
        return {each.name: plain_json(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, (tuple, list)):
        return [plain_json(each) for each in value]
    if isinstance(value, dict):
        return {str(key): plain_json(each) for key, each in value.items()}
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def read(kind: typing.Any, value: typing.Any, name: str) -> typing.Any:
    """A value of an annotated type, from plain JSON; ``name`` says which in errors."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else read(next(each for each in inner if each is not type(None)), value, name)
    if kind is typing.Any:
        return value
    if is_dataclass(kind):
        return _read_dataclass(kind, value, name)
    if origin is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{name} is {brief(value)}; a list is expected")
        if len(inner) == 2 and inner[1] is Ellipsis:
            return tuple(read(inner[0], each, f"{name}[{i}]") for i, each in enumerate(value))
        if len(value) != len(inner):
            raise ValueError(f"{name} has {len(value)} entries; expected are {len(inner)}")
        return tuple(read(each, item, f"{name}[{i}]") for i, (each, item) in enumerate(zip(inner, value, strict=True)))
    if origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{name} is {brief(value)}; an object is expected")
        return {key: read(inner[1], each, f"{name}.{key}") for key, each in value.items()}
    if kind is float:
        if value is None:
            return math.nan
        if type(value) not in (int, float):
            raise ValueError(f"{name} is {brief(value)}; a number is expected")
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{name} is {brief(value)}; {kind.__name__} is expected")
    return value


def _read_dataclass(kind: typing.Any, value: typing.Any, name: str) -> typing.Any:
    hints = typing.get_type_hints(kind)
    allowed = {f.name for f in fields(kind)}
    if not isinstance(value, dict) or not value.keys() <= allowed:
        raise ValueError(f"{name} is {brief(value)}; an object with {', '.join(sorted(allowed))} is expected")
    entries = {key: read(hints[key], each, f"{name}.{key}") for key, each in value.items()}
    try:
        return kind(**entries)
    except TypeError as error:  # of entries without a default that are not there
        raise ValueError(f"{name} lacks entries: {error}") from error
