"""Refits: leads become hypotheses, fitted together with all parameters; those that fall behind are dropped."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.fit import Guess, Hypothesis, bounds, fitted
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import Robot
from soro_bench.diagnosis.screen import Lead
from soro_bench.effects.catalogue import CATEGORIES

SCALE, KEPT = 0.15, 3  # of the cloud, and how many hypotheses remain
_TRIED, _LENGTHS = 4, (0.5, 1.0)  # how many leads are fitted, and shares of their magnitudes at which all are tried
_POLISH = (0.3, 0.1)  # radii
_ROUNDS, _HELPS = 5, 0.1  # of fits that go on, at most, and the share of the cost by which one has to help
_STEP, _GENERATIONS = (
    0.3,
    40,
)  # of CMA-ES: its first step, in standard deviations of the priors, and how long it goes on
_PER_NAME = 2  # leads that differ in their places only


def distinct(leads: Sequence[Lead], count: int, robot: Robot) -> list[Lead]:
    """The first ``count`` leads that the robot can have, of which at most two have the same names."""
    chosen, seen = [], Counter()
    for lead in leads:
        if len(chosen) == count:
            break
        if seen[lead.names] < _PER_NAME and robot.accepts(lead.effects):
            seen[lead.names] += 1
            chosen.append(lead)
    return chosen


def refitted(problem: Problem, guesses: Sequence[Guess], seed: int) -> list[Hypothesis]:
    """The hypotheses that remain, the best first."""
    found = fitted(problem, _tried(problem, guesses), (SCALE,), seed)
    return _with_twins(unique(sorted(found, key=lambda h: -h.log_evidence(problem))), KEPT)


def unique(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The first of those that name the same laws at the same places, which began elsewhere."""
    first = {}
    for h in hypotheses:
        first.setdefault(laws(h), h)
    return list(first.values())


def laws(hypothesis: Hypothesis) -> frozenset:
    """Its laws with their places."""
    return frozenset((s.name, s.where) for s in hypothesis.suspects)


def polished(problem: Problem, hypotheses: Sequence[Hypothesis], radii: Sequence[float], seed: int) -> list[Hypothesis]:
    """The hypotheses, each fitted on with slopes of its own, since those from elsewhere mislead; never worse."""
    better = fitted(problem, [Guess(h.x, h.suspects) for h in hypotheses], radii, seed)
    return [min(pair, key=lambda h: h.cost) for pair in zip(hypotheses, better, strict=True)]


def persevered(problem: Problem, hypotheses: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The hypotheses, each fitted on as long as that helps it; never worse.

    For fits that are far from the recordings, where slopes from elsewhere mislead.
    """
    found, going = list(hypotheses), list(range(len(hypotheses)))
    for k in range(_ROUNDS):
        own = [found[i].slope if k else None for i in going]
        guesses = [Guess(found[i].x, found[i].suspects, slope) for i, slope in zip(going, own, strict=True)]
        better = fitted(problem, guesses, _POLISH, seed + k)
        helped = [i for i, h in zip(going, better, strict=True) if h.cost < (1.0 - _HELPS) * found[i].cost]
        for i, h in zip(going, better, strict=True):
            found[i] = min(found[i], h, key=lambda h: h.cost)
        if not (going := helped):
            break
    return found


def searched(problem: Problem, hypotheses: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The hypotheses, each after a search by CMA-ES from where it is; never worse.

    For fits that are far from the recordings, whose costs have many minima: which one slopes lead to is chance.
    """
    import cma

    rng, searches = np.random.default_rng(seed), []
    for each in hypotheses:
        low, high = bounds(problem, each.suspects)
        options = {"bounds": [low.tolist(), high.tolist()], "verbose": -9, "seed": np.nan,
                   "randn": lambda *shape: rng.standard_normal(shape)}  # fmt: skip
        searches.append(cma.CMAEvolutionStrategy(np.clip(each.x, low, high), _STEP, options))
    for _ in range(_GENERATIONS):
        asked = [search.ask() for search in searches]
        points = [(x, h.suspects) for h, some in zip(hypotheses, asked, strict=True) for x in some]
        costs = [problem.cost(row, x) for row, (x, _) in zip(problem.residuals(points), points, strict=True)]
        ends = np.cumsum([len(some) for some in asked])[:-1]
        for search, some, values in zip(searches, asked, np.split(costs, ends), strict=True):
            search.tell(some, values.tolist())
    guesses = [Guess(search.result.xbest, h.suspects) for search, h in zip(searches, hypotheses, strict=True)]
    better = fitted(problem, guesses, _POLISH, seed)
    return [min(pair, key=lambda h: h.cost) for pair in zip(hypotheses, better, strict=True)]


def without_one(problem: Problem, hypothesis: Hypothesis, seed: int) -> list[Hypothesis]:
    """The hypotheses that have one effect less, fitted from where this one is."""
    guesses, first = [], problem.parameters
    for i, suspect in enumerate(hypothesis.suspects):
        kept = np.ones(len(hypothesis.x), bool)
        kept[first : first + suspect.size] = False
        first += suspect.size
        rest = hypothesis.suspects[:i] + hypothesis.suspects[i + 1 :]
        guesses.append(Guess(hypothesis.x[kept], rest, hypothesis.slope[kept]))
    return fitted(problem, guesses, _POLISH, seed)


def _tried(problem, guesses):
    """The guesses that really explain most, each begun where it does: at shares of its estimated magnitudes, or, as
    laws that set in at a threshold may do nothing there, at those with which its last suspect was screened."""
    starts = [[*(_scaled(g.x, problem.parameters, length) for length in _LENGTHS), _screened(g)] for g in guesses]
    points = [(x, g.suspects) for g, some in zip(guesses, starts, strict=True) for x in some]
    costs = [problem.cost(row, x) for row, (x, _) in zip(problem.residuals(points), points, strict=True)]
    best = np.reshape(costs, (len(guesses), -1))
    order = np.argsort(best.min(axis=1))
    return _with_twins([replace(guesses[i], x=starts[i][int(best[i].argmin())]) for i in order], _TRIED)


def _with_twins(ranked, count):
    """The first so many, and the twins of the first."""
    return ranked[:count] + [each for each in ranked[count:] if twins(each, ranked[0])]


def twins(one: Guess | Hypothesis | Lead, other: Guess | Hypothesis | Lead) -> bool:
    """Whether they are laws of the same classes at the same places, which leave nearly the same traces."""
    first, second = (Counter((CATEGORIES[s.name], s.where) for s in each.suspects) for each in (one, other))
    return first == second


def _screened(guess):
    last = guess.suspects[-1]
    return np.concatenate([guess.x[: -last.size], last.simulated])


def _scaled(x, parameters, length):
    return np.concatenate([x[:parameters], length * x[parameters:]])
