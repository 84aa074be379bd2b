"""Which effects explain recordings: from the nominal robot one effect further as long as much is left.

Each round screens every suspect on top of the best hypothesis so far (and, once there are two, every pair on top of the
nominal robot), refits the leads, and computes the numerical floor of the best anew with their effects.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.fit import Guess, Hypothesis, allowing, fitted
from soro_bench.diagnosis.floor import numerical_floor
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.refit import (
    distinct,
    laws,
    persevered,
    polished,
    refitted,
    searched,
    twins,
    unique,
    without_one,
)
from soro_bench.diagnosis.robot import Robot
from soro_bench.diagnosis.screen import evidence, pairs, responses, singles
from soro_bench.diagnosis.suspects import Suspect, typical
from soro_bench.effects.catalogue import CATEGORIES

SEEDS = 10_000  # of clouds, for each seed of a diagnosis
# radii of the clouds of the nominal fit after each numerical floor, and of the last fit of a hypothesis, in standard
# deviations of the priors
RADII, LAST = ((0.7, 0.3), (0.15,), (0.05, 0.05)), 0.07
FAR_DRAWS, FAR = 3, 0.7  # replays of each refined robot at first, and their standard deviation
NEAR = (0.15, 0.05, 0.0)  # of the one near each fit
# polishes at most, the excess below which none is needed (nulls leave as much), and the share that one more has to take
# off; and their radii: a cloud as wide as the nominal fit's at first, as parameters that have absorbed an effect may be
# far from where they belong
POLISHES, CLEAN, ENOUGH = 4, 1000.0, 0.1
LACKING = 10_000.0  # nats, an excess of the nominal robot far beyond that of nulls: polishing supplies no physics
WIDE, NARROW = (0.7, 0.15), (0.3, 0.1)
RIVAL = 2.0  # a hypothesis that leaves less than so many times what the best one leaves
MOST = 3  # effects
# leads that are tried, the share of the best one's promise that they have to make, and hypotheses of a round with
# floors of their own
LEADS, PROMISING, FLOORS = 6, 0.3, 2
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

    on: tuple[Suspect, ...]
    promised: tuple[tuple[Suspect, float], ...]
    fitted: tuple[tuple[tuple[Suspect, ...], float], ...]


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
    """

    problem: Problem
    nominal: Hypothesis
    found: tuple[Hypothesis, ...]
    unpatched: float
    promised: float
    left: float
    minimum: tuple[tuple[Suspect, float], ...]
    rounds: tuple[Round, ...] = ()


def nominal_fit(problem: Problem, refined: Sequence[Robot], seed: int, progress=lambda *_: None):
    """The problem with its numerical floor, and the nominal robot fitted: floor and fit in turns, ever closer."""
    rng, d = np.random.default_rng(seed), problem.parameters
    draws = FAR * rng.standard_normal((FAR_DRAWS, d))
    draws[0] = 0.0
    guess = Guess(np.zeros(d))
    for k, radii in enumerate(RADII):
        progress("numerical floor")
        problem = problem.with_floor(numerical_floor(problem, refined, [(x, ()) for x in draws]))
        progress("joint fit of the parameters")
        (fit,) = fitted(problem, [guess], radii, SEEDS * seed + k)
        problem, (fit,) = allowing(problem, fit, [fit])
        guess = Guess(fit.x, slope=fit.slope)
        draws = np.clip(fit.x + NEAR[k] * rng.standard_normal((1, d)), -2, 2)
    if problem.rough:
        (fit,) = persevered(problem, [fit], SEEDS * seed + len(RADII))
        problem, (fit,) = allowing(problem, fit, [fit])
    return problem, fit


def explained(
    problem: Problem, nominal: Hypothesis, robot: Robot, refined: Sequence[Robot], candidates: Sequence[Suspect],
    seed: int, progress=lambda *_: None,
) -> Explanation:  # fmt: skip
    """One effect further as long as a lead promises enough.

    Args:
        robot: with the time steps of its model, for the responses.
    """
    seeds = itertools.count(SEEDS * seed + 10, 10)
    if not problem.rough and problem.excess(nominal.residual) < LACKING:
        progress("joint fit of the parameters")
        problem, (nominal,) = _polished(problem, refined, [nominal], seeds)
    unpatched = problem.left(nominal.residual)
    progress("screening")
    possible, best, tried, rounds = candidates, nominal, [], []
    found = responses(problem, nominal, possible, robot)
    first = screened = evidence(problem, nominal, possible, found)
    promised = left = singles(first)[0].gain
    for number in range(1, MOST + 1):
        if number > 1 and not problem.rough and left >= _worth(problem, nominal, best):
            progress("screening")  # anew, where the best hypothesis is
            possible = _compatible(robot, best, candidates)
            found = responses(problem, best, possible, robot)
            screened = evidence(problem, best, possible, found)
            left = singles(screened)[0].gain
        if left < _worth(problem, nominal, best):
            break
        progress(f"refits with {number} effect{'s' * (number > 1)}")
        offered = singles(screened)
        leads = _leads(problem, screened, offered)
        if number == 2 and not problem.rough:
            leads += _leads(problem, first, pairs(first))
        new = refitted(problem, leads, next(seeds))
        if problem.rough:
            new = _searched(problem, persevered(problem, new, next(seeds)), next(seeds))
        problem, new = _with_own_floor(problem, refined, new, next(seeds))
        new.sort(key=lambda h: -h.log_evidence(problem))
        if problem.rough:
            problem, (nominal, *tried) = allowing(problem, new[0], [nominal, *new, *tried])
            possible = _compatible(robot, tried[0], candidates)
            found = responses(problem, tried[0], possible, robot)
        else:
            problem, new = _polished(problem, refined, new, seeds)
            tried = [_again(problem, h) for h in new + tried]
            allowed = _compatible(robot, tried[0], possible)
            found = [rows for c, rows in zip(possible, found, strict=True) if c in allowed]
            possible = allowed
        screened = evidence(problem, tried[0], possible, found)
        left = singles(screened)[0].gain
        rounds.append(_round(problem, best, offered, tried[: len(new)]))
        nominal, without = _again(problem, nominal), without_one(problem, tried[0], next(seeds))
        if number > 1:
            tried[1:1] = without
        else:
            before, nominal = nominal, min(nominal, *without, key=lambda h: h.cost)
            if not problem.rough and before.cost - nominal.cost > WORTH > nominal.cost - tried[0].cost:
                # the effect has only led to parameters that explain as much without it
                return explained(problem, nominal, robot, refined, candidates, seed + 1, progress)
        best = tried[0]
    minimum, found = screened.detectable(_worth(problem, nominal, best)), tuple(_cheapest(tried))
    return Explanation(problem, nominal, found, unpatched, promised, left, minimum, tuple(rounds))


def _cheapest(hypotheses):
    """Those with the same suspects once, in the place of the first and as the one that fits best."""
    best = {}
    for h in sorted(hypotheses, key=lambda h: h.cost):
        best.setdefault(laws(h), h)
    return [best[laws(h)] for h in unique(hypotheses)]


def _searched(problem, hypotheses, seed):
    """The best hypothesis and its rivals, searched on."""
    least = min(h.cost for h in hypotheses)
    close = [h.cost < RIVAL * least for h in hypotheses]
    better = iter(searched(problem, list(itertools.compress(hypotheses, close)), seed))
    return [next(better) if near else h for h, near in zip(hypotheses, close, strict=True)]


def _round(problem, base, offered, fitted) -> Round:
    promised = tuple((lead.suspects[-1], lead.gain) for lead in offered[:LEADS])
    return Round(base.suspects, promised, tuple((h.suspects, problem.excess(h.residual)) for h in fitted))


def _polished(problem, refined, hypotheses, seeds):
    """Fit and numerical floor in turns, as long as the best hypothesis, which comes first, leaves more than nulls and
    that helps: at first of its rivals too, which may only have farther to go, and then of the best."""
    for k in range(POLISHES):
        before = problem.excess(hypotheses[0].residual)
        if before < CLEAN:
            break
        wide = k == 0 and len(hypotheses[0].suspects) > 0
        some = sum(problem.excess(h.residual) < RIVAL * before for h in hypotheses[:FLOORS]) if wide else 1
        better = polished(problem, hypotheses[:some], WIDE if wide else NARROW, next(seeds))
        problem, better = _with_own_floor(problem, refined, better, next(seeds))
        rest = [_again(problem, h) for h in hypotheses[some:]]
        hypotheses = sorted([*better, *rest], key=lambda h: -h.log_evidence(problem))
        if not wide and problem.excess(hypotheses[0].residual) > (1.0 - ENOUGH) * before:
            break
    return problem, hypotheses


def _compatible(robot, hypothesis, candidates):
    """The candidates that the robot can have besides the effects of a hypothesis."""
    effects = hypothesis.effects(len(robot.priors))
    return [c for c in candidates if robot.accepts([*effects, typical(c)])]


def _leads(problem, screened, leads):
    """Where to begin the fits of the best leads, and of the twins of the first: what is promised comes of slopes, of
    which one law may have steeper ones than another that fits better."""
    best = [lead for lead in distinct(leads, LEADS, problem.robot) if lead.gain > PROMISING * leads[0].gain]
    taken = {lead.chosen for lead in best}
    others = [lead for lead in leads if best and twins(lead, best[0]) and lead.chosen not in taken]
    best += [lead for lead in others if problem.robot.accepts(lead.effects)]
    return [screened.guess(lead) for lead in best]


def _worth(problem, nominal, best):
    """What one more effect has to promise."""
    left, all_of_it = (problem.excess(h.residual) for h in (best, nominal))
    if problem.rough:  # then all that is left is taken for noise
        return max(WORTH_SHARE * 0.5 * float(problem.weight.sum()), LAW_SHARE * (all_of_it - left))
    return max(WORTH, WORTH_SHARE * left, LAW_SHARE * (all_of_it - left))


def _with_own_floor(problem, refined, hypotheses, seed):
    """Numerical error with the effects of the hypotheses, under which they are fitted once more. It is the same for
    laws of one class at one place."""
    points: dict[tuple, tuple] = {}
    for h in hypotheses:
        points.setdefault(tuple((CATEGORIES[s.name], s.where) for s in h.suspects), (h.x, h.suspects))
    problem = problem.with_floor(numerical_floor(problem, refined, list(points.values())[:FLOORS]))
    again = fitted(problem, [Guess(h.x, h.suspects, h.slope) for h in hypotheses], (LAST,), seed)
    before = [_again(problem, h) for h in hypotheses]
    return problem, [min(pair, key=lambda h: h.cost) for pair in zip(before, again, strict=True)]


def _again(problem, hypothesis):
    return replace(hypothesis, cost=problem.cost(hypothesis.residual, hypothesis.x))
