"""Which effects explain recordings: from the nominal robot one effect further as long as much is left.

Each round screens every suspect on top of the best hypothesis so far (and, once there are two, every pair on top of the
nominal robot), refits the leads, and computes the numerical floor of the best anew with their effects.
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
    CLEAN,
    RIVAL,
    distinct,
    indistinguishable,
    iterate_to_convergence,
    laws,
    refine,
    refitted,
    revisit_rivals,
    simplify,
    swap_delays,
    unique,
    without_one,
)
from soro_bench.diagnosis.selection.screening import evidence, pairs, responses, singles
from soro_bench.effects.catalogue import CATEGORIES

SEEDS = 10_000  # of clouds, for each seed of a diagnosis
# radii of the clouds of the nominal fit after each numerical floor, and of the last fit of a hypothesis, in standard
# deviations of the priors
RADII, LAST = ((0.7, 0.3), (0.15,), (0.05, 0.05)), 0.07
FAR_DRAWS, FAR = 3, 0.7  # replays of each refined robot at first, and their standard deviation
NEAR = (0.15, 0.05)  # of the one near each fit but the last
# polishes at most, and the share that one more has to take off; and their radii: a cloud as wide as the nominal fit's
# at first, as parameters that have absorbed an effect may be far from where they belong
REFINEMENTS, ENOUGH = 4, 0.1
# nats, and per sample of long recordings: an excess of the nominal robot far beyond that of nulls, so that polishing
# supplies no physics
LACKING = (10_000.0, 0.26)
WIDE, NARROW = (0.7, 0.15), (0.3, 0.1)
MOST = 3  # effects
# leads that are tried, the share of the best one's promise that they have to make, and hypotheses of a round with
# floors of their own
LEADS, LEAST_SHARE_OF_GAIN, DISCRETISATIONS = 6, 0.3, 2
# natural logarithm of the evidence that a lead has to promise (40 nulls promise 85 at most, but for one); the share of
# what is left: where physics has no name in the catalogue, one effect after the other would explain a little of it; and
# the share of what is explained: no law is quite right (what still promises 0.2 per cent is called unknown, compare.py)
WORTH, WORTH_SHARE, LAW_SHARE = 400.0, 0.05, 0.005


@dataclass(frozen=True)
class Round:
    """What one more effect promised, and what became of it.

    on: the suspects on top of which it was looked for. promised: the best suspects, with the evidence that each
    promised. fitted: the suspects of every hypothesis that was kept, with the excess that it leaves.
    """

    on: tuple[Term, ...]
    predicted_gain: tuple[tuple[Term, float], ...]
    fitted: tuple[tuple[tuple[Term, ...], float], ...]


@dataclass(frozen=True)
class Explanation:
    """Hypotheses about recordings.

    problem: with the numerical floor under which all hypotheses are compared.
    nominal: no effect.
    found: those that were refitted, the last round first and of each round the most probable first; empty where nothing
        is missing.
    unpatched: rms [signal's unit] that the nominal robot leaves under its own numerical floor, before any effect has
        had a say in that.
    promised: the evidence that the best lead promised on top of the nominal robot.
    left: the same on top of the best of all.
    minimum: of each suspect, the coordinate of its first magnitude that would just have been worth a look beside the
        best hypothesis.
    rounds: how it came about.
    looked_for: names of the effects that were tried anywhere.
    """

    problem: Problem
    nominal: Hypothesis
    found: tuple[Hypothesis, ...]
    unpatched: float
    predicted_gain: float
    left: float
    minimum: tuple[tuple[Term, float], ...]
    rounds: tuple[Round, ...] = ()
    looked_for: frozenset[str] = frozenset()


def nominal_fit(problem: Problem, refined: Sequence[Robot], seed: int, progress=lambda *_: None):
    """The problem with its numerical floor, and the nominal robot fitted: floor and fit in turns, ever closer."""
    rng, d = np.random.default_rng(seed), problem.parameters
    draws = FAR * rng.standard_normal((FAR_DRAWS, d))
    draws[0] = 0.0
    guess = Guess(np.zeros(d))
    for k, radii in enumerate(RADII):
        progress("numerical floor and joint fit of the parameters")
        if k > 0:
            draws = np.clip(guess.x + NEAR[k - 1] * rng.standard_normal((1, d)), -2, 2)
        points = [(x, ()) for x in draws]
        problem, (fit,) = fitted_under_discretisation(problem, refined, points, [guess], radii, SEEDS * seed + k)
        problem, (fit,) = allowing(problem, fit, [fit])
        guess = Guess(fit.x, jacobian=fit.jacobian)
    if problem.misfit_dominated:
        (fit,) = iterate_to_convergence(problem, [fit], SEEDS * seed + len(RADII))
        problem, (fit,) = allowing(problem, fit, [fit])
    return problem, fit


def explained(
    problem: Problem, nominal: Hypothesis, robot: Robot, refined: Sequence[Robot], candidates: Sequence[Term],
    seed: int, progress=lambda *_: None,
) -> Explanation:  # fmt: skip
    """One effect further as long as a lead promises enough.

    Args:
        robot: with the time steps of its model, for the responses.
    """
    seeds = itertools.count(SEEDS * seed + 10, 10)
    search = _Search(problem, nominal, robot, refined, candidates, seeds, progress)
    search.begin()
    while len(search.rounds) < MOST and search.is_worth_a_round():
        search.add_one_effect()
        if search.local_minimum:
            return explained(search.problem, search.nominal, robot, refined, candidates, seed + 1, progress)
    return search.explanation()


@dataclass
class _Search:
    """Hypotheses on their way to an explanation.

    best: the most probable one. tried: all that were refitted, the last round first. possible: the suspects that the
    robot can have besides those of the best; found: their responses; screened: what they promise on top of it, the
    best of them ``left``. misled: the first effect has only led to parameters that explain as much without it, and
    those are now the nominal ones.
    """

    problem: Problem
    nominal: Hypothesis
    robot: Robot
    refined: Sequence[Robot]
    candidates: Sequence[Term]
    seeds: Iterator[int]
    progress: Callable
    tried: list[Hypothesis] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    local_minimum: bool = False

    @property
    def worth(self) -> float:
        return _worth(self.problem, self.nominal, self.best)

    def begin(self) -> None:
        """The nominal robot, fitted and screened."""
        lacking = max(LACKING[0], LACKING[1] * self.problem.weight.sum())
        far = self.problem.misfit(self.nominal.residual) >= lacking
        self._start(refine=not self.problem.misfit_dominated and not far)
        if (
            not self.problem.misfit_dominated and far and self.left < self.worth
        ):  # no physics promises what seems to be lacking
            self._start(refine=True)
        self.first, self.predicted_gain = self.screened, self.left

    def _start(self, refine: bool) -> None:
        if refine:
            self.progress("joint fit of the parameters")
            self.problem, (self.nominal,) = _refined_in_turns(self.problem, self.refined, [self.nominal], self.seeds)
        self.unpatched = self.problem.left(self.nominal.residual)
        self.best, self.possible = self.nominal, self.candidates
        self._screen()

    def is_worth_a_round(self) -> bool:
        if self.rounds and not self.problem.misfit_dominated and self.left >= self.worth:
            self.possible = _compatible(self.robot, self.best, self.candidates)
            self._screen()  # anew, where the best hypothesis is
        return self.left >= self.worth

    def add_one_effect(self) -> None:
        """One round: fit the leads, compare them with what there was, and see what is left."""
        base, offered, number = self.best, singles(self.screened), len(self.rounds) + 1
        self.progress(f"refits with {number} effect{'s' * (number > 1)}")
        new = self._fitted(offered)
        if self.problem.misfit_dominated:
            self._keep_misfit_dominated(new)
        else:
            self._keep(new)
        self.best = self.tried[0]
        self._judge()
        self.rounds.append(_round(self.problem, base, offered, self.tried[: len(new)]))
        self.nominal = _again(self.problem, self.nominal)
        without = without_one(self.problem, self.best, self.nominal, next(self.seeds))
        others = without if number > 1 else []
        known = {laws(h) for h in self.tried}
        others += swap_delays(self.problem, [self.best, *others], self.candidates, known, next(self.seeds))
        self.tried[1:1] = others
        if number == 1:
            before, self.nominal = self.nominal, min(self.nominal, *without, key=lambda h: h.cost)
            gained = before.cost - self.nominal.cost
            self.local_minimum = (
                not self.problem.misfit_dominated and gained > WORTH > self.nominal.cost - self.best.cost
            )

    def explanation(self) -> Explanation:
        minimum, found = self.screened.detectable(self.worth), tuple(_cheapest(self.tried))
        return Explanation(self.problem, self.nominal, found, self.unpatched, self.predicted_gain, self.left, minimum,
                           tuple(self.rounds), frozenset(one.name for one in self.candidates))  # fmt: skip

    def _screen(self):
        self.progress("screening")
        self.found = responses(self.problem, self.best, self.possible, self.robot)
        self._judge()

    def _judge(self):
        self.screened = evidence(self.problem, self.best, self.possible, self.found)
        self.left = singles(self.screened)[0].gain

    def _fitted(self, offered) -> list[Hypothesis]:
        """Hypotheses of the best leads, the most probable first."""
        screened_candidates = _screened_candidates(self.problem, self.screened, offered)
        if len(self.rounds) == 1 and not self.problem.misfit_dominated:
            screened_candidates += _screened_candidates(self.problem, self.first, pairs(self.first))
        new = refitted(self.problem, screened_candidates, self.screened, next(self.seeds))
        if self.rounds:
            new += revisit_rivals(self.problem, new[0], self.tried, next(self.seeds))
        if self.problem.misfit_dominated:
            new = iterate_to_convergence(self.problem, new, next(self.seeds))
            best = min(new, key=lambda h: h.cost)
            new += simplify(self.problem, best, new, self.possible, next(self.seeds))
        self.problem, new = _with_own_discretisation(self.problem, self.refined, new, next(self.seeds))
        return sorted(new, key=lambda h: -h.log_evidence(self.problem))

    def _keep(self, new) -> None:
        self.problem, new = _refined_in_turns(self.problem, self.refined, new, self.seeds)
        self.tried = [_again(self.problem, h) for h in new + self.tried]
        allowed = _compatible(self.robot, self.tried[0], self.possible)
        self.found = [rows for c, rows in zip(self.possible, self.found, strict=True) if c in allowed]
        self.possible = allowed

    def _keep_misfit_dominated(self, new) -> None:
        """The same where the best hypothesis says how large the noise is; the nominal robot is compared under it."""
        others = [self.nominal, *new, *self.tried]
        self.problem, (self.nominal, *self.tried) = allowing(self.problem, new[0], others)
        self.possible = _compatible(self.robot, self.tried[0], self.candidates)
        self.found = responses(self.problem, self.tried[0], self.possible, self.robot)


def _cheapest(hypotheses):
    """Those with the same suspects once, in the place of the first and as the one that fits best."""
    best = {}
    for h in sorted(hypotheses, key=lambda h: h.cost):
        best.setdefault(laws(h), h)
    return [best[laws(h)] for h in unique(hypotheses)]


def _round(problem, base, offered, fitted) -> Round:
    predicted_gain = tuple(
        (screened_candidate.terms[-1], screened_candidate.gain) for screened_candidate in offered[:LEADS]
    )
    return Round(base.terms, predicted_gain, tuple((h.terms, problem.misfit(h.residual)) for h in fitted))


def _refined_in_turns(problem, refined, hypotheses, seeds):
    """Fit and numerical floor in turns, as long as the best hypothesis, which comes first, leaves more than nulls and
    that helps: at first of its rivals too, which may only have farther to go, and then of the best."""
    for k in range(REFINEMENTS):
        before = problem.misfit(hypotheses[0].residual)
        if before < CLEAN:
            break
        wide = k == 0 and len(hypotheses[0].terms) > 0
        some = sum(problem.misfit(h.residual) < RIVAL * before for h in hypotheses[:DISCRETISATIONS]) if wide else 1
        better = refine(problem, hypotheses[:some], WIDE if wide else NARROW, next(seeds))
        problem, better = _with_own_discretisation(problem, refined, better, next(seeds))
        rest = [_again(problem, h) for h in hypotheses[some:]]
        hypotheses = sorted([*better, *rest], key=lambda h: -h.log_evidence(problem))
        if not wide and problem.misfit(hypotheses[0].residual) > (1.0 - ENOUGH) * before:
            break
    return problem, hypotheses


def _compatible(robot, hypothesis, candidates):
    """The candidates that the robot can have besides the effects of a hypothesis."""
    effects = hypothesis.effects(len(robot.priors))
    return [c for c in candidates if robot.accepts([*effects, typical(c)])]


def _screened_candidates(problem, screened, screened_candidates):
    """Where to begin the fits of the best leads, and of the twins of the first: what is promised comes of slopes, of
    which one law may have steeper ones than another that fits better."""
    best = [
        screened_candidate
        for screened_candidate in distinct(screened_candidates, LEADS, problem.robot)
        if screened_candidate.gain > LEAST_SHARE_OF_GAIN * screened_candidates[0].gain
    ]
    taken = {screened_candidate.chosen for screened_candidate in best}
    others = [
        screened_candidate
        for screened_candidate in screened_candidates
        if best
        and indistinguishable(problem.robot, screened_candidate, best[0])
        and screened_candidate.chosen not in taken
    ]
    best += [screened_candidate for screened_candidate in others if problem.robot.accepts(screened_candidate.effects)]
    return [screened.guess(screened_candidate) for screened_candidate in best]


def _worth(problem, nominal, best):
    """What one more effect has to promise."""
    left, all_of_it = (problem.misfit(h.residual) for h in (best, nominal))
    if problem.misfit_dominated:  # then all that is left is taken for noise
        return max(WORTH_SHARE * 0.5 * float(problem.weight.sum()), LAW_SHARE * (all_of_it - left))
    return max(WORTH, WORTH_SHARE * left, LAW_SHARE * (all_of_it - left))


def _with_own_discretisation(problem, refined, hypotheses, seed):
    """Numerical error with the effects of the hypotheses, under which they are fitted once more. It is the same for
    laws of one class at one place."""
    points: dict[tuple, tuple] = {}
    for h in hypotheses:
        points.setdefault(tuple((CATEGORIES[s.name], s.location) for s in h.terms), (h.x, h.terms))
    chosen, guesses = list(points.values())[:DISCRETISATIONS], [Guess(h.x, h.terms, h.jacobian) for h in hypotheses]
    problem, again = fitted_under_discretisation(problem, refined, chosen, guesses, (LAST,), seed)
    before = [_again(problem, h) for h in hypotheses]
    return problem, [min(pair, key=lambda h: h.cost) for pair in zip(before, again, strict=True)]


def _again(problem, hypothesis):
    return replace(hypothesis, cost=problem.cost(hypothesis.residual, hypothesis.x))
