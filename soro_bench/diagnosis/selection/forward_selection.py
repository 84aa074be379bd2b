"""Forward selection: from the nominal robot one term further as long as the predicted gain is worth it.

Each round screens every candidate term beside the best hypothesis so far; from the second round on also every pair of
terms beside the nominal robot. It fits the best of them, and computes the discretisation error again with
their effects.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, typical
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, allowing, fitted_under_discretisation
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.moves import (
    Laws,
    distinct,
    indistinguishable,
    iterate_to_convergence,
    laws,
    move_radii,
    refine,
    refitted,
    revisit_rivals,
    simplify,
    swap_delays,
    unique,
    without_one,
)
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate, evidence, pairs, responses, singles
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Location

SEEDS = 10_000  # of samples, for each seed of a diagnosis
_FIRST_SEED, _SEED_STEP = 10, 10  # after those of the nominal fit, and between those of two calls

Progress = Callable[[str], None]  # is told the name of each stage


def _silent(stage: str) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True)
class Round:
    """What one more term was predicted to gain, and what became of it.

    on: the terms beside which it was looked for. predicted_gain: the best candidates, with the log evidence that each
    was predicted to gain. fitted: the terms of every hypothesis that was kept, with its misfit.
    """

    on: tuple[Term, ...]
    predicted_gain: tuple[tuple[Term, float], ...]
    fitted: tuple[tuple[tuple[Term, ...], float], ...]


@dataclass(frozen=True)
class Explanation:
    """Hypotheses about recordings.

    problem: with the discretisation error under which all hypotheses are compared.
    nominal: has no term.
    found: the fitted hypotheses, the last round first and of each round the most probable first; empty where no term
        is worth a fit.
    parameters_only_rms: rms residual [signal's unit] of the nominal robot with fitted parameters, less discretisation
        error, before any term is fitted.
    predicted_gain: in log evidence, of the best candidate beside the nominal robot [nats].
    remaining_gain: the same beside the best hypothesis.
    minimum: of each candidate, the coordinate of its first magnitude that would just have been worth a fit beside the
        best hypothesis.
    rounds: how the hypotheses came about.
    looked_for: names of the effects that were screened anywhere.
    """

    problem: Problem
    nominal: Hypothesis
    found: tuple[Hypothesis, ...]
    parameters_only_rms: float
    predicted_gain: float
    remaining_gain: float
    minimum: tuple[tuple[Term, float], ...]
    rounds: tuple[Round, ...] = ()
    looked_for: frozenset[str] = frozenset()


def nominal_fit(
    problem: Problem, refined: Sequence[Robot], seed: int, progress: Progress = _silent
) -> tuple[Problem, Hypothesis]:
    """The problem with its discretisation error, and the nominal robot fitted to it, in turns.

    Args:
        refined: the robot simulated more accurately.
        seed: of the samples around the fit.
        progress: is told the name of each stage.
    """
    settings, rng, d = problem.settings.selection, np.random.default_rng(seed), problem.parameters
    draws = settings.nominal_radius * rng.standard_normal((settings.nominal_replays, d))
    draws[0] = 0.0
    guess = Guess(np.zeros(d))
    near, last = settings.nominal_radius_near, settings.nominal_radius_last
    stages = ((settings.nominal_radius, settings.nominal_radius_second), (near,), (last, last))
    for k, radii in enumerate(stages):
        progress("discretisation error and joint fit of the parameters")
        if k > 0:
            reach = settings.nominal_reach
            draws = np.clip(guess.x + radii[0] * rng.standard_normal((1, d)), -reach, reach)
        points = [(x, ()) for x in draws]
        problem, (fit,) = fitted_under_discretisation(problem, refined, points, [guess], radii, SEEDS * seed + k)
        problem, (fit,) = allowing(problem, fit, [fit])
        guess = Guess(fit.x, jacobian=fit.jacobian)
    if problem.misfit_dominated:
        (fit,) = iterate_to_convergence(problem, [fit], SEEDS * seed + len(stages))
        problem, (fit,) = allowing(problem, fit, [fit])
    return problem, fit


def explained(
    problem: Problem,
    nominal: Hypothesis,
    robot: Robot,
    refined: Sequence[Robot],
    candidates: Sequence[Term],
    seed: int,
    progress: Progress = _silent,
) -> Explanation:
    """One term further as long as a candidate's predicted gain is worth a fit.

    A term may only lead the parameters out of a local minimum. Then the search starts again from those parameters, a
    few times at most (``SelectionSettings.restarts``).

    Args:
        nominal: the fit without a term.
        robot: with the time steps of its model, for screening.
        refined: the robot simulated more accurately.
        candidates: the terms that are screened.
        seed: of the samples around fits.
        progress: is told the name of each stage.
    """
    settings = problem.settings.selection
    for restart in itertools.count():
        seeds = itertools.count(SEEDS * (seed + restart) + _FIRST_SEED, _SEED_STEP)
        search = _Search(problem, nominal, robot, refined, candidates, seeds, progress)
        search.begin()
        while len(search.rounds) < settings.most_terms and search.is_worth_a_round():
            search.add_one_term()
            if search.local_minimum and restart < settings.restarts:
                break
        else:
            break
        problem, nominal = search.problem, search.nominal
    return search.explanation()


@dataclass
class _Search:
    """Hypotheses on their way to an explanation.

    best: the most probable one. tried: all that were fitted, the last round first. possible: the candidates that the
    robot can have beside the best hypothesis. responses: theirs. screened: their predicted gains, the largest of which
    is ``remaining_gain``. first: the same beside the nominal robot. local_minimum: the first term has only led to
    parameters that explain as much without it, and those are now the nominal ones.
    """

    problem: Problem
    nominal: Hypothesis
    robot: Robot
    refined: Sequence[Robot]
    candidates: Sequence[Term]
    seeds: Iterator[int]
    progress: Progress
    tried: list[Hypothesis] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    local_minimum: bool = False
    best: Hypothesis = field(init=False)
    possible: Sequence[Term] = field(init=False)
    responses: list[np.ndarray] = field(init=False)
    screened: Evidence = field(init=False)
    first: Evidence = field(init=False)
    parameters_only_rms: float = field(init=False)
    predicted_gain: float = field(init=False)
    remaining_gain: float = field(init=False)

    @property
    def worth(self) -> float:
        """The least predicted gain that is worth a fit [nats]."""
        return _worth(self.problem, self.nominal, self.best)

    def begin(self) -> None:
        """The nominal robot, fitted and screened."""
        settings, samples = self.problem.settings.selection, self.problem.weight.sum()
        limit = max(settings.discrepant_misfit, settings.discrepant_misfit_per_sample * samples)
        discrepant = self.problem.misfit(self.nominal.residual) >= limit
        self._start(refining=not self.problem.misfit_dominated and not discrepant)
        # parameters may cause so large a misfit after all, if no term is predicted to explain it
        if not self.problem.misfit_dominated and discrepant and self.remaining_gain < self.worth:
            self._start(refining=True)
        self.first, self.predicted_gain = self.screened, self.remaining_gain

    def _start(self, refining: bool) -> None:
        if refining:
            self.progress("joint fit of the parameters")
            self.problem, (self.nominal,) = _refined_in_turns(self.problem, self.refined, [self.nominal], self.seeds)
        self.parameters_only_rms = self.problem.left(self.nominal.residual)
        self.best, self.possible = self.nominal, self.candidates
        self._screen()

    def is_worth_a_round(self) -> bool:
        """Whether the predicted gain of one more term is worth a fit."""
        if self.rounds and not self.problem.misfit_dominated and self.remaining_gain >= self.worth:
            self.possible = _compatible(self.robot, self.best, self.candidates)
            self._screen()  # anew, where the best hypothesis is
        return self.remaining_gain >= self.worth

    def add_one_term(self) -> None:
        """One round: fit the best candidates, compare them with earlier hypotheses, and screen beside the best."""
        base, offered, number = self.best, singles(self.screened), len(self.rounds) + 1
        self.progress(f"refits with {number} effect{'s' * (number > 1)}")
        new = self._fitted(offered)
        if self.problem.misfit_dominated:
            self._keep_misfit_dominated(new)
        else:
            self._keep(new)
        self.best = self.tried[0]
        self._predict_gains()
        self.rounds.append(_round(self.problem, base, offered, self.tried[: len(new)]))
        self.nominal = _under_present_error(self.problem, self.nominal)
        without = without_one(self.problem, self.best, self.nominal, next(self.seeds))
        others = without if number > 1 else []
        known = {laws(h) for h in self.tried}
        others += swap_delays(self.problem, [self.best, *others], self.candidates, known, next(self.seeds))
        self.tried[1:1] = others
        if number == 1:
            before, self.nominal = self.nominal, min(self.nominal, *without, key=lambda h: h.cost)
            by_parameters, by_term = before.cost - self.nominal.cost, self.nominal.cost - self.best.cost
            least = self.problem.settings.selection.least_gain
            self.local_minimum = not self.problem.misfit_dominated and by_parameters > least > by_term

    def explanation(self) -> Explanation:
        """The hypotheses so far."""
        return Explanation(
            self.problem,
            self.nominal,
            tuple(_cheapest(self.tried)),
            self.parameters_only_rms,
            self.predicted_gain,
            self.remaining_gain,
            self.screened.detectable(self.worth),
            tuple(self.rounds),
            frozenset(term.name for term in self.candidates),
        )

    def _screen(self) -> None:
        self.progress("screening")
        self.responses = responses(self.problem, self.best, self.possible, self.robot)
        self._predict_gains()

    def _predict_gains(self) -> None:
        self.screened = evidence(self.problem, self.best, self.possible, self.responses)
        self.remaining_gain = singles(self.screened)[0].gain

    def _fitted(self, offered: Sequence[ScreenedCandidate]) -> list[Hypothesis]:
        """Hypotheses of the best candidates, the most probable first."""
        guesses = _guesses(self.problem, self.screened, offered)
        if len(self.rounds) == 1 and not self.problem.misfit_dominated:
            guesses += _guesses(self.problem, self.first, pairs(self.first))
        new = refitted(self.problem, guesses, self.screened, next(self.seeds))
        if self.rounds:
            new += revisit_rivals(self.problem, new[0], self.tried, next(self.seeds))
        if self.problem.misfit_dominated:
            new = iterate_to_convergence(self.problem, new, next(self.seeds))
            best = min(new, key=lambda h: h.cost)
            new += simplify(self.problem, best, new, self.possible, next(self.seeds))
        self.problem, new = _with_own_discretisation(self.problem, self.refined, new, next(self.seeds))
        return sorted(new, key=lambda h: -h.log_evidence(self.problem))

    def _keep(self, new: list[Hypothesis]) -> None:
        """The new hypotheses before the others, refined; and the candidates that are possible beside the best one."""
        self.problem, new = _refined_in_turns(self.problem, self.refined, new, self.seeds)
        self.tried = [_under_present_error(self.problem, h) for h in new + self.tried]
        allowed = _compatible(self.robot, self.tried[0], self.possible)
        kept = zip(self.possible, self.responses, strict=True)
        self.responses = [response for term, response in kept if term in allowed]
        self.possible = allowed

    def _keep_misfit_dominated(self, new: list[Hypothesis]) -> None:
        """The same where the best hypothesis says how large the noise is; the nominal robot is compared under it."""
        others = [self.nominal, *new, *self.tried]
        self.problem, (self.nominal, *self.tried) = allowing(self.problem, new[0], others)
        self.possible = _compatible(self.robot, self.tried[0], self.candidates)
        self.responses = responses(self.problem, self.tried[0], self.possible, self.robot)


def _cheapest(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those with the same terms once: at the position of the first, as the one with the least cost."""
    best: dict[Laws, Hypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: h.cost):
        best.setdefault(laws(h), h)
    return [best[laws(h)] for h in unique(hypotheses)]


def _round(
    problem: Problem, base: Hypothesis, offered: Sequence[ScreenedCandidate], fitted: Sequence[Hypothesis]
) -> Round:
    """What is told of a round that began at ``base``."""
    best = offered[: problem.settings.selection.candidates]
    return Round(
        base.terms,
        tuple((candidate.terms[-1], candidate.gain) for candidate in best),
        tuple((h.terms, problem.misfit(h.residual)) for h in fitted),
    )


def _refined_in_turns(
    problem: Problem, refined: Sequence[Robot], hypotheses: list[Hypothesis], seeds: Iterator[int]
) -> tuple[Problem, list[Hypothesis]]:
    """Fit and discretisation error in turns, as long as the misfit is larger than that of healthy cases and falls.

    The best hypothesis comes first. The first turn is of its rivals too, which may only have farther to go. It samples
    as widely as the nominal fit, as parameters that have absorbed an effect may be far from where they belong.
    """
    settings = problem.settings.selection
    for turn in range(settings.refinements):
        before = problem.misfit(hypotheses[0].residual)
        if before < settings.healthy_misfit:
            break
        count, radii = 1, move_radii(settings)
        wide = turn == 0 and len(hypotheses[0].terms) > 0
        if wide:
            limit = settings.rival_misfit * before
            count = sum(problem.misfit(h.residual) < limit for h in hypotheses[: settings.discretisations])
            radii = settings.nominal_radius, settings.nominal_radius_near
        better = refine(problem, hypotheses[:count], radii, next(seeds))
        problem, better = _with_own_discretisation(problem, refined, better, next(seeds))
        rest = [_under_present_error(problem, h) for h in hypotheses[count:]]
        hypotheses = sorted([*better, *rest], key=lambda h: -h.log_evidence(problem))
        if not wide and problem.misfit(hypotheses[0].residual) > (1.0 - settings.refinement_gain) * before:
            break
    return problem, hypotheses


def _compatible(robot: Robot, hypothesis: Hypothesis, candidates: Sequence[Term]) -> list[Term]:
    """The candidates that the robot can have beside the effects of a hypothesis."""
    effects = hypothesis.effects(len(robot.priors))
    return [term for term in candidates if robot.accepts([*effects, typical(term)])]


def _guesses(problem: Problem, screened: Evidence, offered: Sequence[ScreenedCandidate]) -> list[Guess]:
    """Where to begin the fits of the best candidates, and of those that look like the very best.

    Predicted gains are linear: one law may be predicted to gain more than another one that fits better.
    """
    settings = problem.settings.selection
    limit = settings.least_share_of_gain * offered[0].gain if offered else 0.0
    best = [candidate for candidate in distinct(offered, problem.robot, settings) if candidate.gain > limit]
    taken = {candidate.chosen for candidate in best}
    others = [
        candidate
        for candidate in offered
        if best and indistinguishable(problem.robot, candidate, best[0]) and candidate.chosen not in taken
    ]
    best += [candidate for candidate in others if problem.robot.accepts(candidate.effects)]
    return [screened.guess(candidate) for candidate in best]


def _worth(problem: Problem, nominal: Hypothesis, best: Hypothesis) -> float:
    """The least predicted gain of one more term beside the best hypothesis that is worth a fit [nats]."""
    settings = problem.settings.selection
    remaining, of_nominal = (problem.misfit(h.residual) for h in (best, nominal))
    of_explained = settings.least_gain_of_explained * (of_nominal - remaining)
    if problem.misfit_dominated:  # then the whole residual counts as noise
        return max(settings.least_gain_of_misfit * 0.5 * float(problem.weight.sum()), of_explained)
    return max(settings.least_gain, settings.least_gain_of_misfit * remaining, of_explained)


def _with_own_discretisation(
    problem: Problem, refined: Sequence[Robot], hypotheses: Sequence[Hypothesis], seed: int
) -> tuple[Problem, list[Hypothesis]]:
    """The problem with the discretisation error of the hypotheses too, and these fitted once more under it.

    Laws of one class at one location have the same error.
    """
    settings = problem.settings.selection
    points: dict[tuple[tuple[str, Location], ...], tuple[np.ndarray, tuple[Term, ...]]] = {}
    for h in hypotheses:
        points.setdefault(tuple((CATEGORIES[term.name], term.location) for term in h.terms), (h.x, h.terms))
    chosen = list(points.values())[: settings.discretisations]
    guesses = [Guess(h.x, h.terms, h.jacobian) for h in hypotheses]
    problem, again = fitted_under_discretisation(problem, refined, chosen, guesses, (settings.fit_radius_last,), seed)
    before = [_under_present_error(problem, h) for h in hypotheses]
    return problem, [min(pair, key=lambda h: h.cost) for pair in zip(before, again, strict=True)]


def _under_present_error(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with its cost under the discretisation error that the problem has now."""
    return replace(hypothesis, cost=problem.cost(hypothesis.residual, hypothesis.x))
