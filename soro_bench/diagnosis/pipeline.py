"""The stages of a diagnosis, from recordings to the discrepancies of a simulation."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, terms
from soro_bench.diagnosis.estimation.data_quality import DataQuality, data_quality, noise, outliers
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.posterior_covariance import with_covariance
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.estimation.unit_check import check_unit_and_sign
from soro_bench.diagnosis.localisation.ranking import RankedLocation, ranked_locations
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.experiment_design import Proposal, proposed
from soro_bench.diagnosis.selection.forward_selection import Explanation, explained, nominal_fit
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, compared, shortlist
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.recording import Recording, RecordingError

HypothesisKey = tuple[bytes, tuple[Term, ...]]


@dataclass(frozen=True)
class Outliers:
    """Samples left out because they are alone and far off: share of all points that there are, and the rms distance of
    a coordinate [unit]."""

    share: float
    size: float


@dataclass(frozen=True)
class Diagnosis:
    """What was found; times are in seconds, everything else in the units of the robot and its signal.

    places: outside the catalogue, the best first; none where a law explains it, or no force at one place anything.
    proposal: what to record next; None where nothing is left to be told apart.
    tested, tested_residuals: the problem of the held-out recordings, and its residuals (M,) by :func:`key_of` of the
        hypotheses that were compared.
    """

    robot: Robot
    data_qualities: tuple[DataQuality, ...]
    outliers: Outliers
    explanation: Explanation
    comparison: Comparison
    ranked_locations: tuple[RankedLocation, ...]
    proposal: Proposal | None
    seconds: float
    tested: Problem | None = None
    tested_residuals: Mapping[HypothesisKey, np.ndarray] = field(default_factory=dict)

    @property
    def detected(self) -> bool:
        """Whether something is missing or wrong beside outliers."""
        return self.comparison.detected

    @property
    def best(self) -> Answer:
        """The answer that the report is of."""
        return self.comparison.best

    @property
    def verdict(self) -> str:
        """One of the verdicts of a result: what is likeliest, as its first effect."""
        if not self.detected:
            return "measurement_fault" if self.outliers.share else "adequate"
        if self.comparison.unknown > self.comparison.likeliest:
            return "outside_catalogue"
        faults = all(s.location.kind == "sensor" for s in self.best.hypothesis.terms)
        return "measurement_fault" if faults else "discrepancy"


@one_blas_thread
@quiet()
def run_diagnosis(
    robot: Robot,
    recordings: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
    settings: Settings = DEFAULT,
) -> Diagnosis:
    """Find out what a simulated robot gets wrong in recordings; the arguments are those of
    :func:`soro_bench.diagnosis.api.diagnose`.

    Raises:
        RecordingError: a recording lacks something; says what.
        SimulationError: the simulation diverges.
    """
    start = time.perf_counter()
    progress("data quality")
    fitted = robot.shortened(settings.discretisation.fitted_refinement)
    refined = robot.refined(settings.discretisation.reference_refinement)
    measured, tested = _measured(robot, settings.report.most_numbers, recordings, heldout)
    data_qualities = tuple(data_quality(each, settings.data_quality) for each in (*measured, *tested))
    # of one sensor: motion only adds to it
    sigma = max(min(a.sigma for a in data_qualities), max(a.least for a in data_qualities))
    check_unit_and_sign(unexplained(robot, measured, sigma, settings))
    problem, nominal = nominal_fit(unexplained(fitted, measured, sigma, settings), refined, seed, progress)
    for each in (robot, fitted):
        problem.check_finite(each, problem.simulated(each, [(nominal.x, ())]))
    problem, nominal, found_outliers = _without_outliers(problem, nominal)
    if not problem.misfit_dominated:
        problem, nominal = _with_noise(problem, nominal, max(a.least for a in data_qualities))
    explanation = explained(problem, nominal, robot, refined, terms(robot, settings.priors), seed, progress)
    progress("comparison")
    hypotheses = shortlist(explanation)
    trial = tried_on(explanation, tested, refined, hypotheses)
    comparison = compared(explanation, trial)
    explanation, comparison = _with_covariances(explanation, comparison, seed)
    found = Diagnosis(robot, data_qualities, found_outliers, explanation, comparison, (), None, 0.0)
    if comparison.detected and comparison.unknown > settings.report.least_unknown:
        progress("localisation")
        found = replace(
            found, ranked_locations=tuple(ranked_locations(explanation.problem, robot, explanation.nominal, refined))
        )
    progress("next recording")
    proposal = _proposal(found, seed)
    found = replace(found, proposal=proposal, seconds=time.perf_counter() - start)
    if trial is None:
        return found
    rows = {key_of(h): row for h, row in zip(hypotheses, trial[1], strict=True)}
    return replace(found, tested=trial[0], tested_residuals=rows)


def key_of(hypothesis: Hypothesis) -> HypothesisKey:
    """What tells a hypothesis from others of the same robot: its coordinates and terms."""
    return hypothesis.x.tobytes(), tuple(hypothesis.terms)


def _with_covariances(explanation: Explanation, comparison: Comparison, seed: int) -> tuple[Explanation, Comparison]:
    """The same with the covariances of what a report has intervals of."""
    problem, nominal = explanation.problem, with_covariance(explanation.problem, explanation.nominal, seed)
    answers = [
        replace(a, hypothesis=with_covariance(problem, a.hypothesis, seed))
        if a is comparison.best or a.probability > problem.settings.report.least_probability
        else a
        for a in comparison.answers
    ]
    return replace(explanation, nominal=nominal), replace(comparison, answers=tuple(answers))


def _named(label: str, function: Callable[[Recording], Measured], recording: Recording) -> Measured:
    try:
        return function(recording)
    except RecordingError as error:
        raise RecordingError(f"{label}: {error}") from error


def _measured(robot: Robot, most_numbers: int, *groups: Sequence[Recording]) -> list[tuple[Measured, ...]]:
    """What the diagnosis sees of the recordings to explain, and of held-out ones."""
    if not groups[0]:
        raise RecordingError("there is no recording to explain")
    found = [
        tuple(_named(f"{label}recording {number}", robot.measured, each) for number, each in enumerate(group, 1))
        for label, group in zip(("", "held-out "), groups, strict=True)
    ]
    for i, j in itertools.combinations([each for group in groups for each in group], 2):
        if _same(robot, i, j):
            raise RecordingError("two of the recordings are the same; what is explained twice is no more certain, and "
                                 "held-out recordings have to be others than those that are explained")  # fmt: skip
    if (size := sum(each.values.size for group in found for each in group)) > most_numbers:
        raise RecordingError(f"{size} numbers to explain; at most {most_numbers}, so cut the recordings")
    return found


def _same(robot: Robot, one: Recording, other: Recording) -> bool:
    """Whether two recordings have the same samples of the robot's signal."""
    first, second = (each.signals.get(robot.signal) for each in (one, other))
    return first is not None and second is not None and np.array_equal(first.values, second.values, equal_nan=True)


def _proposal(found: Diagnosis, seed: int) -> Proposal | None:
    if not found.detected or not found.robot.channels:
        return None
    unknown = (
        found.ranked_locations[0].location if found.verdict == "outside_catalogue" and found.ranked_locations else None
    )
    return proposed(found.explanation.problem, found.comparison, unknown, seed)


def unexplained(robot: Robot, measured: tuple[Measured, ...], sigma: float, settings: Settings = DEFAULT) -> Problem:
    """Recordings of which nothing is explained yet, with noise ``sigma`` and no discretisation error."""
    weight = np.concatenate([np.isfinite(each.values).ravel().astype(float) for each in measured])
    return Problem(robot, measured, sigma, weight, LowRank(np.zeros((0, weight.size))), settings=settings)


def tried_on(
    found: Explanation, measured: tuple[Measured, ...], refined: Sequence[Robot], hypotheses: Sequence[Hypothesis]
) -> tuple[Problem, np.ndarray] | None:
    """Hypotheses on recordings that none was fitted to.

    Returns:
        The problem, without outliers and with a discretisation error of its own, and the residuals (H, M); None where
        there are no recordings.
    """
    if not measured:
        return None
    problem = found.problem
    tested = replace(unexplained(problem.robot, measured, problem.sigma, problem.settings), noise=problem.noise)
    tested = _masked(tested, _outliers(tested, tested.residuals([(found.nominal.x, ())])[0]))
    points = [(h.x, h.terms) for h in hypotheses]
    discretisation, residuals = discretisation_and_residuals(tested, refined, points, points)
    return tested.with_discretisation(discretisation), residuals


def _outliers(problem: Problem, residual: np.ndarray) -> np.ndarray:
    """(M,) whether a sample belongs to a point that is alone and far off."""
    left = np.where(problem.weight > 0, problem.discretisation.without(residual), np.nan)
    return np.concatenate([
        np.repeat(outliers(part, problem.settings.data_quality).ravel(), part.shape[2]) for part in problem.split(left)
    ])


def _without_outliers(problem: Problem, nominal: Hypothesis) -> tuple[Problem, Hypothesis, Outliers]:
    """The problem and its nominal fit without the samples that are alone and far off."""
    far = _outliers(problem, nominal.residual)
    if not far.any():
        return problem, nominal, Outliers(0.0, 0.0)
    far &= problem.weight > 0
    size = problem.sigma * float(np.sqrt((problem.discretisation.without(nominal.residual)[far] ** 2).mean()))
    share = float(far.sum() / problem.weight.sum())
    problem = _masked(problem, far)
    return problem, nominal.scaled(problem, ~far), Outliers(share, size)


def _masked(problem: Problem, far: np.ndarray) -> Problem:
    return replace(problem, weight=problem.weight * ~far, discretisation=LowRank(problem.discretisation.basis * ~far))


def _with_noise(problem: Problem, nominal: Hypothesis, least: float) -> tuple[Problem, Hypothesis]:
    """The same with the noise of what the nominal fit leaves: little of the motion is in it, so it shows better."""
    left = problem.split(np.where(problem.weight > 0, problem.discretisation.without(nominal.residual), np.nan))
    found = max(noise(part.reshape(len(part), -1), problem.settings.data_quality) for part in left)
    factor = 1.0 / min(1.0, max(least / problem.sigma, found))
    problem = replace(
        problem, sigma=problem.sigma / factor, discretisation=LowRank(problem.discretisation.basis * factor)
    )
    return problem, nominal.scaled(problem, factor)
