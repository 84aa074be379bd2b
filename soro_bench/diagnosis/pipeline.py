"""The stages of a diagnosis, from recordings to the discrepancies of a simulation."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from soro_bench.diagnosis.candidates import terms, within
from soro_bench.diagnosis.data_quality.inspection import Inspected, inspected
from soro_bench.diagnosis.data_quality.noise import DataQuality
from soro_bench.diagnosis.data_quality.signals import (
    answers_of,
    explaining,
    imported,
    labels,
    left_out,
    named,
    qualities_of,
)
from soro_bench.diagnosis.discovery.discovery import Discovery, discovered
from soro_bench.diagnosis.estimation.fit import Hypothesis, with_covariance
from soro_bench.diagnosis.estimation.model_form import largest_model_form_error, unfitted_under_model_form
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.estimation.unit_check import check_unit_and_sign
from soro_bench.diagnosis.localisation.ranking import RankedLocation, ranked_locations
from soro_bench.diagnosis.outliers import far_points, fitted_again, masked, nominal_fit, of_samples
from soro_bench.diagnosis.result_robot import DataFinding, Outliers
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.experiment_design import Proposal, proposed
from soro_bench.diagnosis.selection.forward_selection import Explanation, Progress, explained, silent
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, compared, shortlist
from soro_bench.diagnosis.selection.sizing import sized
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.recording import Recording, RecordingError

_MOST_NUMBERS = 300_000  # of all recordings: four minutes of a trunk; every candidate term adds as many


@dataclass(frozen=True)
class Run:
    """How a diagnosis runs.

    seed: of the random numbers. progress: is called with the name of every stage. settings: numbers of the method.
    """

    seed: int = 0
    progress: Progress = silent
    settings: Settings = DEFAULT


@dataclass(frozen=True)
class Diagnosis:
    """What was found; times are in seconds, everything else in the units of the robot and its signal.

    places: outside the catalogue, the best first; none where a law explains it, or no force at one place anything.
    proposal: what to record next; None where nothing is left to be told apart.
    data: what sensors and loggers did to the recordings.
    tested: the problem of the held-out recordings.
    digests: of all recordings, those to explain first. seed: of the random numbers.
    discovery: of a law outside the catalogue; None where none was looked for.
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
    seed: int = 0
    discovery: Discovery | None = None

    @property
    def detected(self) -> bool:
        """Whether something is missing or wrong beside outliers."""
        return self.comparison.detected

    @property
    def best(self) -> Answer:
        """The answer that the report is of."""
        return self.comparison.best

    @property
    def replaces_best(self) -> bool:
        """Whether a law outside the catalogue leaves much less of held-out motion than the catalogue's best answer. A
        black box is no answer."""
        found = self.discovery
        if found is None or found.best is None or found.best.boxed:
            return False
        return found.beats < 1.0 - self.explanation.problem.settings.discovery.least_removed

    @property
    def verdict(self) -> str:
        """One of the verdicts of a result: what is likeliest, as its first effect."""
        if not self.detected:
            return "measurement_fault" if self.outliers.share else "adequate"
        if self.comparison.unknown > self.comparison.likeliest or self.replaces_best:
            return "outside_catalogue"
        faults = all(s.location.kind == "sensor" for s in self.best.hypothesis.terms)
        return "measurement_fault" if faults else "discrepancy"


@one_blas_thread
@quiet()
def run_diagnosis(
    robot: Robot, recordings: Sequence[Recording], heldout: Sequence[Recording] = (), run: Run = Run()
) -> Diagnosis:
    """The stages of :func:`soro_bench.diagnosis.api.diagnose`.

    Raises:
        RecordingError: a recording lacks something; says what.
        SimulationError: the simulation diverges.
    """
    start, seed, settings = time.perf_counter(), run.seed, run.settings
    run.progress("data quality")
    inspections = _inspected(robot, recordings, heldout, settings)
    robot, inspections = explaining(robot, inspections, settings)
    fitted = robot.shortened(settings.discretisation.fitted_refinement)
    refined = robot.refined(settings.discretisation.reference_refinement)
    measured, tested = _measured(robot, *inspections)
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
    problem, nominal = nominal_fit(untouched, refined, seed, run.progress)
    for each in (robot, fitted):
        problem.check_finite(each, problem.simulated(each, [(nominal.x, ())]))
    known_outliers = of_samples(looked_at[: len(measured)], untouched)
    problem, nominal, found_outliers = fitted_again(
        problem, nominal, untouched, refined, known_outliers, least, spoilt, seed, run.progress
    )
    problem = replace(problem, model_form=largest_model_form_error(problem, nominal.jacobian))
    unfitted = unexplained(fitted, tested, sigma, settings, others) if tested else None
    if unfitted:
        unfitted = replace(unfitted, variants=problem.variants)
    longest = max(float(each.time[-1]) for each in measured)
    candidates = sized(problem, nominal, within(terms(robot, settings.priors), longest), robot)
    explanation = explained(problem, nominal, robot, refined, candidates, seed, run.progress, unfitted)
    run.progress("comparison")
    hypotheses = shortlist(explanation)
    trial = tried_on(explanation, tested, refined, hypotheses)
    comparison = compared(explanation, trial)
    explanation, comparison = _with_covariances(explanation, comparison, seed)
    found = Diagnosis(
        robot, data_qualities, found_outliers, explanation, comparison, (), None, 0.0,
        tested=trial[0] if trial else None,
        data=(*imported((*recordings, *heldout)), *_findings(looked_at), *answers, *left_out(untouched, problem)),
        digests=tuple(each.digest() for each in (*recordings, *heldout)), seed=seed,
    )  # fmt: skip
    if comparison.detected and comparison.unknown > settings.report.least_probability:
        run.progress("localisation")
        found = replace(
            found, ranked_locations=tuple(ranked_locations(explanation.problem, robot, explanation.nominal, refined))
        )
        run.progress("laws outside the catalogue")
        found = replace(found, discovery=_discovery(found, seed))
    run.progress("next recording")
    proposal = _proposal(found, seed)
    return replace(found, proposal=proposal, seconds=time.perf_counter() - start)


def _discovery(found: Diagnosis, seed: int) -> Discovery | None:
    """The law at the places that were found, if there are any."""
    explanation, ranked = found.explanation, found.ranked_locations
    if not ranked:
        return None
    nominal, nearest = explanation.nominal, found.best.hypothesis
    return discovered(explanation.problem, found.tested, found.robot, nominal, nearest, ranked, seed)


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


def _measured(robot: Robot, *groups: Sequence[Inspected]) -> list[tuple[Measured, ...]]:
    """What the diagnosis sees of the recordings to explain, and of held-out ones."""
    names = iter(labels(*groups))
    found = [tuple(named(next(names), robot.measured, each.recording) for each in group) for group in groups]
    recorded = zip(labels(*groups), (each.recording for group in groups for each in group), strict=True)
    for (first, one), (second, other) in itertools.combinations(recorded, 2):
        if _same(robot, one, other):
            raise RecordingError(f"{first} and {second} are the same; what is explained twice is no more certain, and "
                                 "held-out recordings have to be others than those that are explained")  # fmt: skip
    if (size := sum(each.columns.size for group in found for each in group)) > _MOST_NUMBERS:
        raise RecordingError(f"{size} numbers to explain; at most {_MOST_NUMBERS}, so cut the recordings")
    return found


def _same(robot: Robot, one: Recording, other: Recording) -> bool:
    """Whether two recordings have the same samples of the robot's signal."""
    first, second = (each.signals.get(robot.signal) for each in (one, other))
    return first is not None and second is not None and np.array_equal(first.values, second.values, equal_nan=True)


def _proposal(found: Diagnosis, seed: int) -> Proposal | None:
    if not found.detected:
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
    errors = np.concatenate([_late(measured), _begun_apart(robot, measured, sigma)])
    problem = problem.with_discretisation(errors * problem.of_samples(problem.scales) if sigmas else errors)
    return replace(problem, of_recordings=len(errors))


def _begun_apart(robot: Robot, measured: tuple[Measured, ...], sigma: float) -> np.ndarray:
    """(F, M) how the signals [their units] change where a replay that begins at a noisy sample begins a standard
    deviation of its noise apart, in each of its numbers. Where nothing drives a robot back, it stays apart."""
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    size = sum(each.columns.size for each in measured)
    rows, begin = [np.zeros((0, size))], 0
    for each in measured:
        if each.start is not None and each.start.shape == robot.shape:
            apart = sigma * np.eye(each.start.size).reshape(-1, *robot.shape)
            drives = [replace(each.drive, start=start) for start in (each.start, *(each.start + apart))]
            before, *after = (values[0].ravel() for values in robot.simulate_all(drives, nominal, [()]))
            found = np.zeros((len(after), size))
            found[:, begin : begin + each.columns.size] = np.nan_to_num(np.array(after) - before)
            rows.append(found)
        begin += each.columns.size
    return np.concatenate(rows)


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
    # errors of stamps and first samples are those of the sensor, however large what counts as noise is
    tested = unexplained(problem.robot, measured, problem.sensor, problem.settings, problem.sensors[1:])
    tested = tested.with_noise_of(problem)
    tested = replace(tested, variants=problem.variants)
    tested = masked(tested, far_points(tested, tested.residuals([(found.nominal.x, ())])[0]))
    return unfitted_under_model_form(tested, refined, [(h.x, h.terms) for h in hypotheses])


def _findings(found: Sequence[Inspected]) -> tuple[DataFinding, ...]:
    return tuple(finding for each in found for finding in each.all_findings)
