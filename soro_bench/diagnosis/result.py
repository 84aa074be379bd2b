"""The result of a diagnosis: plain numbers and names, in JSON and back.

Everything that a person or a program gets is rendered from a :class:`Result`: the summary on the console, report.html,
comparison.rrd, the patched model, effects.json and the actions to record next. Nothing here simulates.
"""

import math
import types
import typing
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path

from soro_bench.effects.effect import Location
from soro_bench.files import brief, read_json, write_json

SCHEMA = "soro-bench/diagnosis/2"
VERDICTS = ("adequate", "discrepancy", "outside_catalogue", "measurement_fault")
LONGEST = 1e5  # s, of a replay
FARTHEST = 1e4  # m, of what is drawn
DIGITS = 7  # significant ones of numbers in a file; a float32 has as many


@dataclass(frozen=True)
class Errors:
    """How far a simulation is from recordings: root mean squares of a coordinate, in the unit of the signal.

    before, after: of a plain replay with fitted parameters only, and with the patch.
    noise: standard deviation of the sensor's noise.
    corrected_before, corrected_after: the same without what the covariance of discretisation error explains.
    """

    before: float
    after: float
    noise: float
    corrected_before: float
    corrected_after: float

    @property
    def explained(self) -> float:
        """Share of the corrected variance above the noise that the patch explains; NaN where there is none."""
        above = self.corrected_before**2 - self.noise**2
        return 1.0 - max(self.corrected_after**2 - self.noise**2, 0.0) / above if above > 0 else math.nan

    @property
    def is_worse(self) -> bool:
        """Whether the patch increases the corrected error."""
        return self.corrected_after > self.corrected_before


@dataclass(frozen=True)
class Estimate:
    """A quantity with its unit ("1" if it has none) and the bounds of its 90 % interval, None where it has none."""

    name: str
    value: float
    unit: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter of the robot: the estimate, its nominal value, and how many standard deviations of its prior are
    between the two."""

    estimate: Estimate
    nominal: float
    prior_deviations: float


@dataclass(frozen=True)
class Finding:
    """An effect of some hypothesis: a law at a location.

    name: of the law; "none", "unknown" and "outliers" stand for what no law describes.
    category: the kind of law.
    probability: of all hypotheses that have it.
    intervals: [s] when it acts, in the first recording. condition: in words, when it mainly acts.
    train, heldout: errors of the most probable hypothesis that has it.
    drawbacks: what speaks against it, in words.
    together_with: names of the other effects of that hypothesis.
    indistinguishable_from: what hardly any recording can tell from it, in words; empty if there is no such thing.
    is_best: whether it belongs to the hypothesis that the report is about.
    """

    name: str
    category: str
    probability: float
    location: Location | None = None
    estimates: tuple[Estimate, ...] = ()
    intervals: tuple[tuple[float, float], ...] = ()
    condition: str = ""
    train: Errors | None = None
    heldout: Errors | None = None
    drawbacks: tuple[str, ...] = ()
    together_with: tuple[str, ...] = ()
    indistinguishable_from: str = ""
    is_best: bool = False


@dataclass(frozen=True)
class NamedLocation:
    """A law and where it acts."""

    name: str
    location: Location

    def __str__(self) -> str:
        return f"{self.name} at {self.location}"


@dataclass(frozen=True)
class HypothesisSummary:
    """A hypothesis and how probable it is.

    unknowns: number of fitted coordinates, parameters included. samples: numbers that it was fitted to.
    misfit: chi-squared / 2 above that of white noise, of the recordings that it was fitted to; misfit_total: with
        the held-out ones.
    log_evidence: of the fit. evidence: natural logarithm, of all recordings, less what its effects gain by chance.
    """

    effects: tuple[NamedLocation, ...]
    probability: float
    unknowns: int
    samples: int
    misfit: float
    misfit_total: float
    log_evidence: float
    evidence: float
    train: Errors
    heldout: Errors | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of its laws."""
        return tuple(each.name for each in self.effects)


@dataclass(frozen=True)
class ScreenedTerm:
    """A candidate term with the gain in log evidence that its linear response predicts."""

    term: NamedLocation
    predicted_gain: float


@dataclass(frozen=True)
class FittedTerms:
    """Terms that were fitted together, and the misfit that they leave."""

    terms: tuple[NamedLocation, ...]
    misfit: float


@dataclass(frozen=True)
class SelectionRound:
    """One round of forward selection: on top of what it searched, what screening predicted, what the fits left."""

    on_top_of: tuple[NamedLocation, ...]
    screened: tuple[ScreenedTerm, ...]
    fitted: tuple[FittedTerms, ...]


@dataclass(frozen=True)
class RankedLocation:
    """A location, and the gain in log evidence of an unconstrained input there."""

    location: Location
    gain: float


@dataclass(frozen=True)
class UnknownInput:
    """The input at the best location that explains what no law does.

    components, units: names of its C numbers. start_s: (K,) when each value begins, of recording ``recording`` (K,).
    values: (K, C). rmse_after: what the input leaves, without discretisation error [signal's unit].
    linear_in: shares of what it depends on, where it is a linear function of commands and shape; else empty.
    """

    location: Location
    components: tuple[str, ...]
    units: tuple[str, ...]
    recording: tuple[int, ...]
    start_s: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]
    rmse_after: float
    linear_in: dict[str, float]


@dataclass(frozen=True)
class Detectable:
    """The smallest magnitude of a law that the recordings would have shown, where it shows most.

    quantity: which one. minimum: how far it is from ``null``, where the law does nothing.
    """

    name: str
    quantity: str
    minimum: float
    unit: str
    null: float
    location: Location


@dataclass(frozen=True)
class NextRecording:
    """What to record next.

    motion: in words. rivals: hypotheses that are left. separates: pairs of them that the motion would tell apart.
    evidence: what it would give on average [nats] for the closest pair.
    actions: (T, A) to replay, one every ``control_timestep`` [s].
    """

    motion: str
    duration_s: float
    rivals: tuple[str, ...]
    separates: tuple[tuple[str, str], ...]
    evidence: float
    control_timestep: float
    actions: tuple[tuple[float, ...], ...]


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


@dataclass(frozen=True)
class SignalQuality:
    """Of a recording: standard deviation of the noise [signal's unit], and share of missing samples."""

    noise: float
    missing: float


@dataclass(frozen=True)
class DataFinding:
    """What a sensor, a logger or a broken line did to a recording: no physics of the robot.

    name: such as "quantisation", "spikes" or "held". signal: of a signal or command. recording: index of it in
        ``recordings``. samples: numbers concerned, and share: of those that there are.
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
class RobotSummary:
    """The robot and the signal that was explained; channels: what each number of an action moves."""

    name: str
    model: str
    signal: str
    unit: str
    channels: tuple[str, ...]
    has_baseline: bool = False


@dataclass(frozen=True)
class Result:
    """What a diagnosis found.

    verdict: "adequate" (no discrepancy detected), "discrepancy" (a law of the catalogue), "outside_catalogue" or
        "measurement_fault".
    p_value: probability of as much misfit where nothing is missing; None where the model error is far above the sensor
        noise. alpha: the level at which a discrepancy is as likely as none.
    unknown: probability that the discrepancy is outside the catalogue. healthy: that there is none.
    predicted_gain: in log evidence, of the best single term. remaining_gain: likewise of one more term, on top of the
        best hypothesis.
    trained_on: number of recordings that were fitted to, the first ones; the others were held out.
    findings: every effect of any hypothesis, the most probable first. categories: kinds of laws with probabilities.
    credible_set: names that together have 90 % of the probability.
    train, heldout: errors of the best hypothesis. parameters_only: rms of fitted parameters alone, without
        discretisation error [signal's unit].
    covariance: (d, d) of the parameters' posterior, in their units.
    undetectable, not_searched: names of laws that these recordings would not have shown, or that have no location in
        this robot.
    trainable: whether the robot is of the suite, so that policies can be trained on the posterior.
    seed: of random numbers. seconds: that the diagnosis took.
    settings: that differ from their defaults. notes: on the model, its mapping and the recordings, in words.
    data: what sensors and loggers did to the recordings.
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

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict is {brief(self.verdict)}; allowed are {', '.join(VERDICTS)}")
        if not self.hypotheses:
            raise ValueError("a result needs a hypothesis")

    @property
    def detected(self) -> bool:
        """Whether something is missing or wrong, outliers apart."""
        return self.verdict == "discrepancy" or self.verdict == "outside_catalogue" or bool(self.best.effects)

    @property
    def best(self) -> HypothesisSummary:
        """The hypothesis that the report is about."""
        return self.hypotheses[0]

    def to_json(self) -> dict[str, typing.Any]:
        """A JSON object; NaN is null."""
        return {"schema": SCHEMA, **_plain(self)}

    @classmethod
    def from_json(cls, data: object) -> "Result":
        """The result that a JSON object describes; ValueError names what is wrong."""
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise ValueError(f"not a result of a diagnosis: its schema has to be {SCHEMA}")
        return _read(cls, {key: value for key, value in data.items() if key != "schema"}, "result")

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


def _plain(value: typing.Any) -> typing.Any:
    if is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, (tuple, list)):
        return [_plain(each) for each in value]
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def _read(kind: typing.Any, value: typing.Any, name: str) -> typing.Any:
    """A value of an annotated type, from plain JSON; ``name`` says which in errors."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _read(next(each for each in inner if each is not type(None)), value, name)
    if kind is typing.Any:
        return value
    if is_dataclass(kind):
        return _read_dataclass(kind, value, name)
    if origin is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{name} is {brief(value)}; a list is expected")
        if len(inner) == 2 and inner[1] is Ellipsis:
            return tuple(_read(inner[0], each, f"{name}[{i}]") for i, each in enumerate(value))
        if len(value) != len(inner):
            raise ValueError(f"{name} has {len(value)} entries; expected are {len(inner)}")
        return tuple(_read(each, item, f"{name}[{i}]") for i, (each, item) in enumerate(zip(inner, value, strict=True)))
    if origin is dict:
        if not isinstance(value, dict):
            raise ValueError(f"{name} is {brief(value)}; an object is expected")
        return {key: _read(inner[1], each, f"{name}.{key}") for key, each in value.items()}
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
    known = typing.get_type_hints(kind)
    required = {f.name for f in fields(kind)}
    if not isinstance(value, dict) or not value.keys() <= required:
        raise ValueError(f"{name} is {brief(value)}; an object with {', '.join(sorted(required))} is expected")
    try:
        return kind(**{key: _read(known[key], each, f"{name}.{key}") for key, each in value.items()})
    except TypeError as error:
        raise ValueError(f"{name} lacks entries: {error}") from error
