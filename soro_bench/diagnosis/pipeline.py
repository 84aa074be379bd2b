"""The stages of a diagnosis, from recordings to the discrepancies of a simulation."""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.data_quality.inspection import Inspected, inspected
from soro_bench.diagnosis.data_quality.noise import DataQuality, compressed, noise
from soro_bench.diagnosis.data_quality.samples import far_off
from soro_bench.diagnosis.data_quality.signals import (
    answers_of,
    explaining,
    imported,
    labels,
    left_out,
    named,
    qualities_of,
)
from soro_bench.diagnosis.estimation.discretisation import differences, discretisation_and_residuals
from soro_bench.diagnosis.estimation.fit import Hypothesis, with_covariance
from soro_bench.diagnosis.estimation.model_form import largest_model_form_error
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.estimation.unit_check import check_unit_and_sign
from soro_bench.diagnosis.localisation.ranking import RankedLocation, ranked_locations
from soro_bench.diagnosis.result_robot import DataFinding
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


@dataclass(frozen=True)
class Outliers:
    """Samples left out because they are alone and far off: share of all points that there are, and the rms distance of
    a coordinate [unit]."""

    share: float
    size: float

    def with_more(self, problem: Problem, nominal: Hypothesis, far: np.ndarray, weight: np.ndarray) -> "Outliers":
        """These, and those that a fit found in the first signal: (M,) ``far``, of samples with a weight (M,)."""
        far, weight = (np.concatenate([part.ravel() for part in problem.split(each)]) for each in (far, weight))
        if not far.any():
            return self
        parts = problem.split(problem.discretisation.without(nominal.residual))
        left = problem.sigma * np.concatenate([part.ravel() for part in parts])[far]
        share = float(far.sum() / weight.sum())
        square = (self.share * self.size**2 + share * float((left**2).mean())) / (self.share + share)
        return Outliers(self.share + share, float(np.sqrt(square)))


@dataclass(frozen=True)
class Diagnosis:
    """What was found; times are in seconds, everything else in the units of the robot and its signal.

    places: outside the catalogue, the best first; none where a law explains it, or no force at one place anything.
    proposal: what to record next; None where nothing is left to be told apart.
    data: what sensors and loggers did to the recordings.
    tested: the problem of the held-out recordings.
    digests: of all recordings, those to explain first.
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
    data: tuple[DataFinding, ...] = ()
    digests: tuple[str, ...] = ()

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
    inspections = _inspected(robot, recordings, heldout, settings)
    robot, inspections = explaining(robot, inspections, settings)
    fitted = robot.shortened(settings.discretisation.fitted_refinement)
    refined = robot.refined(settings.discretisation.reference_refinement)
    measured, tested = _measured(robot, settings.report.most_numbers, *inspections)
    measured, tested, answers = answers_of(robot, measured, tested, settings)
    looked_at = tuple(each for group in inspections for each in group)
    qualities = qualities_of(robot, (*measured, *tested), looked_at, settings)
    data_qualities = tuple(each for each in qualities[0] if each is not None)
    measured, tested = (
        tuple(found.applied(each) for each, found in zip(some, group, strict=True))
        for some, group in zip((measured, tested), inspections, strict=True)
    )
    found_of = [[each for each in group if each is not None] for group in qualities]
    least = tuple(max(a.least for a in group) for group in found_of)
    # of one sensor: motion only adds to it
    sigma, *others = (max(min(a.sigma for a in group), low) for group, low in zip(found_of, least, strict=True))
    spoilt = any(found.all_findings for found in looked_at)
    check_unit_and_sign(unexplained(robot, measured, sigma, settings, others))
    untouched = unexplained(fitted, measured, sigma, settings, others)
    untouched = replace(untouched, variants=robot.variants())
    problem, nominal = nominal_fit(untouched, refined, seed, progress)
    for each in (robot, fitted):
        problem.check_finite(each, problem.simulated(each, [(nominal.x, ())]))
    found_outliers = _of_samples(looked_at[: len(measured)], untouched)
    problem, nominal, found_outliers = _fitted_again(
        problem,
        nominal,
        untouched,
        refined,
        found_outliers,
        least,
        spoilt,
        seed,
        progress,
    )
    problem = replace(problem, model_form=largest_model_form_error(problem, nominal))
    unfitted = unexplained(fitted, tested, sigma, settings, others) if tested else None
    candidates = terms(robot, settings.priors)
    explanation = explained(problem, nominal, robot, refined, candidates, seed, progress, unfitted)
    progress("comparison")
    hypotheses = shortlist(explanation)
    trial = tried_on(explanation, tested, refined, hypotheses)
    comparison = compared(explanation, trial)
    explanation, comparison = _with_covariances(explanation, comparison, seed)
    found = Diagnosis(
        robot, data_qualities, found_outliers, explanation, comparison, (), None, 0.0,
        tested=trial[0] if trial else None,
        data=(*imported((*recordings, *heldout)), *_findings(looked_at), *answers, *left_out(untouched, problem)),
        digests=tuple(each.digest() for each in (*recordings, *heldout)),
    )  # fmt: skip
    if comparison.detected and comparison.unknown > settings.report.least_unknown:
        progress("localisation")
        found = replace(
            found, ranked_locations=tuple(ranked_locations(explanation.problem, robot, explanation.nominal, refined))
        )
    progress("next recording")
    proposal = _proposal(found, seed)
    return replace(found, proposal=proposal, seconds=time.perf_counter() - start)


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


def _inspected(
    robot: Robot, recordings: Sequence[Recording], heldout: Sequence[Recording], settings: Settings
) -> tuple[tuple[Inspected, ...], tuple[Inspected, ...]]:
    """The recordings to explain and the held-out ones, freed of what sensors and loggers did to them."""
    if not recordings:
        raise RecordingError("there is no recording to explain")
    found = []
    for number, (label, recording) in enumerate(zip(labels(recordings, heldout), (*recordings, *heldout), strict=True)):
        check = partial(inspected, number=number, robot=robot, settings=settings)
        found.append(named(label, check, recording))
    return tuple(found[: len(recordings)]), tuple(found[len(recordings) :])


def _measured(robot: Robot, most_numbers: int, *groups: Sequence[Inspected]) -> list[tuple[Measured, ...]]:
    """What the diagnosis sees of the recordings to explain, and of held-out ones."""
    names = iter(labels(*groups))
    found = [tuple(named(next(names), robot.measured, each.recording) for each in group) for group in groups]
    for i, j in itertools.combinations([each.recording for group in groups for each in group], 2):
        if _same(robot, i, j):
            raise RecordingError("two of the recordings are the same; what is explained twice is no more certain, and "
                                 "held-out recordings have to be others than those that are explained")  # fmt: skip
    if (size := sum(each.columns.size for group in found for each in group)) > most_numbers:
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


def unexplained(
    robot: Robot,
    measured: tuple[Measured, ...],
    sigma: float,
    settings: Settings = DEFAULT,
    others: Sequence[float] = (),
) -> Problem:
    """Recordings of which nothing is explained yet, without discretisation error.

    Args:
        sigma: noise of the first signal [its unit]. others: that of the robot's other signals; 1 by default.
    """
    weight = np.concatenate([np.isfinite(each.columns).ravel().astype(float) for each in measured])
    sigmas = tuple((each, 0.0) for each in (others or [1.0] * len(robot.others)))
    nothing = LowRank(np.zeros((0, weight.size)))
    problem = Problem(robot, measured, sigma, weight, nothing, settings=settings, others=sigmas)
    late = _late(measured)
    return problem.with_discretisation(late * problem.of_samples(problem.scales) if sigmas else late)


def _late(measured: tuple[Measured, ...]) -> np.ndarray:
    """(F, M) how the signals [their units] change with each possible error of their time stamps."""
    size = sum(each.columns.size for each in measured)
    rows, start = [np.zeros((0, size))], 0
    for each in measured:
        if each.late is not None:
            found = np.zeros((len(each.late), size))
            found[:, start : start + each.columns.size] = (each.late * _rate(each)).reshape(len(each.late), -1)
            rows.append(found)
        start += each.columns.size
    return np.concatenate(rows)


def _rate(measured: Measured) -> np.ndarray:
    """(T, C) rates of change of the signals, across missing samples too."""
    columns = measured.columns
    for column in columns.T:
        seen = np.isfinite(column)
        if seen.any():
            column[:] = np.gradient(np.interp(measured.time, measured.time[seen], column[seen]), measured.time)
    return np.nan_to_num(columns)


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
    tested = unexplained(problem.robot, measured, problem.sigma, problem.settings, problem.sigmas[1:])
    tested = replace(tested, noise=problem.noise, others=problem.others,
                     model_form=problem.model_form, variants=problem.variants)  # fmt: skip
    tested = _masked(tested, _outliers(tested, tested.residuals([(found.nominal.x, ())])[0]))
    points = [(h.x, h.terms) for h in hypotheses]
    discretisation, residuals = discretisation_and_residuals(tested, refined, points, points)
    others = differences(tested, [found.nominal.x])
    return tested.with_discretisation(np.concatenate([discretisation, others])), residuals


def _outliers(problem: Problem, residual: np.ndarray, spoilt: bool = False) -> np.ndarray:
    """(M,) whether a sample belongs to a point that is alone and far off; one of two, where others were ``spoilt``."""
    left = np.where(problem.weight > 0, problem.discretisation.without(residual), np.nan)
    found: list[list[np.ndarray]] = []
    for which in range(len(problem.robot.signals)):
        far = ((far_off(part, spoilt, problem.settings), part) for part in problem.split(left, which))
        found.append([np.repeat(each[:, :, None], part.shape[2], axis=2) for each, part in far])
    return problem.joined(found)


def _fitted_again(
    problem: Problem,
    nominal: Hypothesis,
    untouched: Problem,
    refined: Sequence[Robot],
    found: Outliers,
    least: Sequence[float],
    spoilt: bool,
    seed: int,
    progress: Callable[[str], None],
) -> tuple[Problem, Hypothesis, Outliers]:
    """The problem without outliers and with the noise that the nominal fit leaves, and that fit.

    It is made anew without the outliers of the fit before, and where sparse samples first seemed far noisier.

    Args:
        untouched: the problem before any fit.
        found: outliers so far.
        least: noise of each signal [its unit].
        spoilt: whether samples were left out before any fit.
    """
    settings = problem.settings.data_quality
    for again in range(settings.refits + 1):
        far = _outliers(problem, nominal.residual, spoilt) & (problem.weight > 0)
        quiet = problem, nominal
        if not problem.misfit_dominated:
            quiet = _with_noise(problem, nominal, least, spoilt)
        sigmas = zip(quiet[0].sigmas, untouched.sigmas, strict=True)
        noisier = spoilt and any(now < settings.refit_noise * before for now, before in sigmas)
        if again == settings.refits or not (far.any() or noisier):
            break
        if far.any():
            found = found.with_more(problem, nominal, far, untouched.weight)
            untouched = _masked(untouched, far)
        if noisier:
            basis = LowRank(untouched.discretisation.basis * untouched.factor_to(quiet[0]))
            untouched = replace(untouched, sigma=quiet[0].sigma, others=quiet[0].others, discretisation=basis)
        problem, nominal = nominal_fit(untouched, refined, seed, progress)
    if far.any():  # of the last fit
        found, problem = found.with_more(problem, nominal, far, untouched.weight), _masked(problem, far)
        nominal = nominal.scaled(problem, np.where(far, 0.0, 1.0))
        quiet = (problem, nominal) if problem.misfit_dominated else _with_noise(problem, nominal, least, spoilt)
    return *quiet, found


def _of_samples(found: Sequence[Inspected], problem: Problem) -> Outliers:
    """The spikes that were found before anything was fitted, beside the points that are left."""
    count = sum(each.spikes for each in found)
    if not count:
        return Outliers(0.0, 0.0)
    square = sum(each.spikes * each.size**2 for each in found) / count
    points = sum(float(part.sum()) for part in problem.split(problem.weight)) / problem.robot.shape[1]
    return Outliers(count / (points + count), float(np.sqrt(square)))


def _findings(found: Sequence[Inspected]) -> tuple[DataFinding, ...]:
    return tuple(finding for each in found for finding in each.all_findings)


def _masked(problem: Problem, far: np.ndarray) -> Problem:
    return replace(problem, weight=problem.weight * ~far, discretisation=LowRank(problem.discretisation.basis * ~far))


def _with_noise(
    problem: Problem, nominal: Hypothesis, least: Sequence[float], spoilt: bool
) -> tuple[Problem, Hypothesis]:
    """The same with the noise of what the nominal fit leaves: little of the motion is in it, so it shows better.

    Args:
        least: noise of each signal [its unit]. spoilt: whether samples were left out, so that few windows are complete.
    """
    rest = np.where(problem.weight > 0, problem.discretisation.without(nominal.residual), np.nan)
    factors = []
    for which, (sigma, low) in enumerate(zip(problem.sigmas, least, strict=True)):
        left = problem.split(rest, which)
        left = [part for part in left if not which or np.isfinite(part).any()]  # recordings may lack other signals
        left = [compressed(part) for part in left] if spoilt else left
        found = max(noise(part.reshape(len(part), -1), problem.settings.data_quality) for part in left)
        factors.append(1.0 / min(1.0, max(low / sigma, found)))
    sigma, *others = (sigma / factor for sigma, factor in zip(problem.sigmas, factors, strict=True))
    factor = problem.of_samples(problem.of_columns(factors)) if others else factors[0]
    problem = replace(
        problem,
        sigma=sigma,
        others=tuple((each, 0.0) for each in others),
        discretisation=LowRank(problem.discretisation.basis * factor),
    )
    return problem, nominal.scaled(problem, factor)
