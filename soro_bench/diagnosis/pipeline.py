"""The stages of a diagnosis, from recordings to the discrepancies of a simulation."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.candidates import terms, within
from soro_bench.diagnosis.data_quality.noise import DataQuality
from soro_bench.diagnosis.data_quality.signals import imported, left_out
from soro_bench.diagnosis.discovery.discovery import Discovery, discovered
from soro_bench.diagnosis.estimation.fit import Hypothesis, with_covariance
from soro_bench.diagnosis.estimation.model_form import largest_model_form_error, unfitted_under_model_form
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.ranking import RankedLocation, ranked_locations
from soro_bench.diagnosis.outliers import far_points, fitted_again, masked, nominal_fit, of_samples
from soro_bench.diagnosis.preparation import Prepared, prepared, unexplained
from soro_bench.diagnosis.result_robot import DataFinding, Outliers
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.experiment_design import Proposal, proposed
from soro_bench.diagnosis.selection.forward_selection import Explanation, StageProgress, explained, silent
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, compared, shortlist
from soro_bench.diagnosis.selection.sizing import sized
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.recording import Recording


@dataclass(frozen=True)
class Run:
    """How a diagnosis runs.

    seed: of the random numbers. progress: is called with the name of every stage. settings: numbers of the method.
    """

    seed: int = 0
    progress: StageProgress = silent
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
    given = prepared(robot, recordings, heldout, settings)
    problem, nominal, outliers, left = _nominal(given, run)
    explanation = _explanation(given, problem, nominal, run)
    run.progress("comparison")
    trial = tried_on(explanation, given.heldout, given.refined, shortlist(explanation))
    explanation, comparison = _with_covariances(explanation, compared(explanation, trial), seed)
    found = Diagnosis(
        given.robot, given.qualities, outliers, explanation, comparison, (), None, 0.0,
        tested=trial[0] if trial else None,
        data=(*imported((*recordings, *heldout)), *given.findings, *left),
        digests=tuple(each.digest() for each in (*recordings, *heldout)), seed=seed,
    )  # fmt: skip
    if comparison.detected and comparison.unknown > settings.report.least_probability:
        found = _outside_catalogue(found, given.refined, run)
    run.progress("next recording")
    return replace(found, proposal=_proposal(found, seed), seconds=time.perf_counter() - start)


def _nominal(given: Prepared, run: Run) -> tuple[Problem, Hypothesis, Outliers, tuple[DataFinding, ...]]:
    """The problem without outliers and with its errors of discretisation and model form, the nominal robot fitted to
    it, the outliers, and what the fits left out of the recordings."""
    untouched = replace(given.unexplained(given.fitted, given.measured), variants=given.robot.variants())
    problem, nominal = nominal_fit(untouched, given.refined, run.seed, run.progress)
    for each in (given.robot, given.fitted):
        problem.check_finite(each, problem.simulated(each, [(nominal.x, ())]))
    known = of_samples(given.inspected[: len(given.measured)], untouched)
    problem, nominal, outliers = fitted_again(
        problem, nominal, untouched, given.refined, known, given.least, given.spoilt, run.seed, run.progress
    )
    problem = replace(problem, model_form=largest_model_form_error(problem, nominal.jacobian))
    return problem, nominal, outliers, tuple(left_out(untouched, problem))


def _explanation(given: Prepared, problem: Problem, nominal: Hypothesis, run: Run) -> Explanation:
    """The hypotheses that a search over all candidate terms finds."""
    unfitted = None
    if given.heldout:
        unfitted = replace(given.unexplained(given.fitted, given.heldout), variants=problem.variants)
    longest = max(float(each.time[-1]) for each in given.measured)
    every = within(terms(given.robot, run.settings.priors), longest)
    candidates = sized(problem, nominal, every, given.robot)
    return explained(problem, nominal, given.robot, given.refined, candidates, run.seed, run.progress, unfitted)


def _outside_catalogue(found: Diagnosis, refined: Sequence[Robot], run: Run) -> Diagnosis:
    """The diagnosis with the places where something unknown may act, and a law for it."""
    run.progress("localisation")
    explanation = found.explanation
    places = ranked_locations(explanation.problem, found.robot, explanation.nominal, refined)
    found = replace(found, ranked_locations=tuple(places))
    run.progress("laws outside the catalogue")
    return replace(found, discovery=_discovery(found, run.seed))


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


def _proposal(found: Diagnosis, seed: int) -> Proposal | None:
    if not found.detected:
        return None
    unknown = (
        found.ranked_locations[0].location if found.verdict == "outside_catalogue" and found.ranked_locations else None
    )
    return proposed(found.explanation.problem, found.comparison, unknown, seed)


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
