"""What a result finds: errors, quantities, laws, hypotheses, locations, and what to record next."""

import math
import typing
from dataclasses import dataclass

from soro_bench.effects.effect import Location

NINETY = 1.645  # standard deviations on either side of the middle 90 %
NEAR = 0.9  # of the best location's gain, from which another one explains nearly as much


@dataclass(frozen=True)
class Errors:
    """How far a simulation is from recordings: root mean squares of a coordinate, in the unit of the signal.

    before: of plain replays, at the time step of the model, of fitted parameters only. after: the same of the
        hypothesis.
    noise: standard deviation of the sensor's noise.
    corrected_before, corrected_after: of replays at the time step of fits, without what the covariance of
        discretisation error explains; no replay shows them.
    motion: of what was measured, about its mean in each recording; None in older results.
    """

    before: float
    after: float
    noise: float
    corrected_before: float
    corrected_after: float
    motion: float | None = None

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
class ModelForm:
    """Error of the model's form, as another simulator of the robot may have it: rms of a coordinate, in the unit of the
    signal.

    left: by fitted parameters beside the sensor's noise and discretisation error, on all recordings. largest: how large
        such an error may be, from how far the simulators at hand are apart.
    """

    left: float
    largest: float

    @property
    def possible(self) -> bool:
        """Whether all that is left may be such an error."""
        return self.left <= self.largest


@dataclass(frozen=True)
class Estimate:
    """A quantity with its unit ("1" if it has none) and the bounds of its 90 % interval, None where it has none."""

    name: str
    value: float
    unit: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Agreement:
    """A quantity that was fitted to each recording alone.

    name: of the parameter, or of the quantity of a law; ``law`` and ``location`` say which, and are empty for a
        parameter.
    estimates: from each of the recordings that were fitted to, in their order.
    p_value: of a larger difference between any two of them by chance, corrected for the number of comparisons.
    overlap: whether the 90 % intervals of any two do. changes: whether they do not, beyond chance.
    """

    name: str
    law: str
    location: Location | None
    estimates: tuple[Estimate, ...]
    p_value: float
    overlap: bool
    changes: bool


@dataclass(frozen=True)
class ReachedLimit:
    """A limit that the fitted robot reaches in a plain replay.

    name: "force_limit", "control_limit", "slack", "stop" or "contact".
    element: its kind and name, or those of both sides of a contact.
    share: of the time. value: of the limit, None where it has none. unit: of that value.
    """

    name: str
    element: str
    share: float
    value: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter of the robot: the estimate, its nominal value, and how many standard deviations of its prior are
    between the two.

    known: "told" or "recorded" where its value was known, and nothing was fitted; else empty.
    """

    estimate: Estimate
    nominal: float
    prior_deviations: float
    known: str = ""


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
class SeedAnswer:
    """An answer, and how many diagnoses with different random numbers give it: the probability that the seeds show.

    share: ``count`` of all of them.
    """

    answer: str
    count: int
    share: float


@dataclass(frozen=True)
class UnknownInput:
    """The input at the best location that explains what no law does.

    components: names of its C numbers. units: of components. start_s: (K,) when each value begins, of recording
    ``recording`` (K,). values: (K, C). rmse_after: what the input leaves, without discretisation error [signal's unit].
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
class DiscoveredLaw:
    """A law outside the catalogue as the search for one left it.

    location: where the input acts. effects: the law, in the format of effects.json; none where neither a law nor a
        black box holds on held-out motion. black_box: whether it is a sum of bumps of the state instead of a law.
    equations: of each effect, one line. legend: what their names are, with the ranges that were seen; outside them a
        law is held.
    estimates: coefficients and shapes with 90 % intervals.
    explained: share of the held-out mean square that the law explains, 1 - sum(r_after^2) / sum(r_before^2).
    noise_share: of that mean square, which is the sensor's noise. nearest: what the catalogue's best answer explains.
    own_test: whether the ends of the recordings were held out, as no recording was.
    others: equations of laws that leave about as much.
    state, force, law: (n,) the main variable, the input and the law, in control steps. state_label, force_label: with
        units. peak: Hz, of the largest peak of the input's spectrum. peaks: of its largest ones.
    """

    location: Location
    effects: tuple[dict[str, typing.Any], ...]
    equations: tuple[str, ...]
    legend: dict[str, str]
    estimates: tuple[Estimate, ...]
    explained: float
    noise_share: float
    nearest: float
    own_test: bool
    others: tuple[str, ...]
    state: tuple[float, ...]
    force: tuple[float, ...]
    law: tuple[float, ...]
    state_label: str
    force_label: str
    peak: float
    peaks: tuple[float, ...] = ()
    black_box: bool = False


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
