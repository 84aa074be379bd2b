"""Refits: leads become hypotheses, fitted together with all parameters; those that fall behind are dropped."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, effects_at, late, slices
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.gauss_newton import descended
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate
from soro_bench.effects.catalogue import CATEGORIES

SCALE, KEPT = 0.15, 3  # of the cloud, and how many hypotheses remain
_SIZES = (0.1, 0.3, 1.0, 3.0, 10.0)  # shares of typical magnitudes at which plainer laws are tried
_TRIED, _LENGTHS = 4, (0.5, 1.0)  # how many leads are fitted, and shares of their magnitudes at which all are tried
_LITTLE = 0.1  # of magnitudes: nearly none, but not so little that slopes vanish
_REFINE = (0.3, 0.1)  # radii
_ROUNDS, _HELPS = 5, 0.1  # of fits that go on, at most, and the share of the cost by which one has to help
_PER_NAME = 2  # leads that differ in their places only
RIVAL = 2.0  # a hypothesis that leaves less than so many times what the best one leaves
CLEAN = 1000.0  # nats, the excess below which nothing has to be better: nulls leave as much


def distinct(screened_candidates: Sequence[ScreenedCandidate], count: int, robot: Robot) -> list[ScreenedCandidate]:
    """The first ``count`` leads that the robot can have, of which at most two have the same names."""
    chosen, seen = [], Counter()
    for screened_candidate in screened_candidates:
        if len(chosen) == count:
            break
        if seen[screened_candidate.names] < _PER_NAME and robot.accepts(screened_candidate.effects):
            seen[screened_candidate.names] += 1
            chosen.append(screened_candidate)
    return chosen


def refitted(problem: Problem, guesses: Sequence[Guess], screened: Evidence, seed: int) -> list[Hypothesis]:
    """The hypotheses that remain, the best first.

    Args:
        screened: what the responses of all suspects say, for those that a hypothesis may change its place with.
    """
    found = unique(sorted(fitted(problem, _tried(problem, guesses), (SCALE,), seed), key=lambda h: h.cost))
    found = _shift_location(problem, _warm_start_nested(problem, found, seed), screened, seed + 1)
    ranked = unique(sorted(found, key=lambda h: -h.log_evidence(problem)))
    return _diversify(problem.robot, ranked, range(len(ranked)), KEPT)


def unique(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The first of those that name the same laws at the same places, which began elsewhere."""
    first = {}
    for h in hypotheses:
        first.setdefault(laws(h), h)
    return list(first.values())


def laws(hypothesis: Hypothesis | Guess) -> frozenset:
    """Its laws with their places."""
    return frozenset((s.name, s.location) for s in hypothesis.terms)


def refine(problem: Problem, hypotheses: Sequence[Hypothesis], radii: Sequence[float], seed: int) -> list[Hypothesis]:
    """The hypotheses, each fitted on with slopes of its own, since those from elsewhere mislead; never worse."""
    better = fitted(problem, [Guess(h.x, h.terms) for h in hypotheses], radii, seed)
    return [min(pair, key=lambda h: h.cost) for pair in zip(hypotheses, better, strict=True)]


def iterate_to_convergence(problem: Problem, hypotheses: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The hypotheses, each fitted on as long as that helps it; never worse.

    For fits that are far from the recordings, where slopes from elsewhere mislead.
    """
    found, going = list(hypotheses), list(range(len(hypotheses)))
    for k in range(_ROUNDS):
        own = [found[i].jacobian if k else None for i in going]
        guesses = [Guess(found[i].x, found[i].terms, jacobian) for i, jacobian in zip(going, own, strict=True)]
        better = fitted(problem, guesses, _REFINE, seed + k)
        helped = [i for i, h in zip(going, better, strict=True) if h.cost < (1.0 - _HELPS) * found[i].cost]
        for i, h in zip(going, better, strict=True):
            found[i] = min(found[i], h, key=lambda h: h.cost)
        if not (going := helped):
            break
    return descended(problem, found)


def without_one(problem: Problem, hypothesis: Hypothesis, nominal: Hypothesis, seed: int) -> list[Hypothesis]:
    """The hypotheses that have one effect less, fitted from where this one is."""
    guesses = []
    for i, part in enumerate(slices(hypothesis.terms, problem.parameters)):
        kept = np.ones(len(hypothesis.x), bool)
        kept[part] = False
        rest = hypothesis.terms[:i] + hypothesis.terms[i + 1 :]
        guesses.append(Guess(hypothesis.x[kept], rest, hypothesis.jacobian[kept]))
    if not problem.misfit_dominated:
        return fitted(problem, guesses, _REFINE, seed)
    nearer = [_nearer(problem, guess, nominal) for guess in guesses]
    return descended(problem, fitted(problem, nearer, _REFINE, seed))


def revisit_rivals(problem: Problem, best: Hypothesis, baseline: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The best hypothesis with each close rival of earlier rounds instead of the law at its place that they went on
    with, fitted from where either ended: two laws that leave as much alone may not beside a third one."""
    guesses, d = [], problem.parameters
    for h in baseline:
        k = len(h.terms) - 1
        taken = best.terms[: k + 1]
        if 0 <= k < len(best.terms) - 1 and _there(h.terms, taken) and _close(problem, h, baseline):
            remaining = best.x[slices(best.terms, d)[k].stop :]
            for robot in (best.x[:d], h.x[:d]):
                guesses.append(Guess(np.concatenate([robot, h.x[d:], remaining]), (*h.terms, *best.terms[k + 1 :])))
    guesses = [g for g in guesses if problem.robot.accepts(effects_at(g.x[d:], g.terms))]
    return fitted(problem, guesses, _REFINE, seed) if guesses else []


def simplify(
    problem: Problem, best: Hypothesis, others: Sequence[Hypothesis], candidates: Sequence[Term], seed: int
) -> list[Hypothesis]:
    """The best hypothesis with laws of fewer quantities, of the class of its last one and at its place, that none of
    the others has there, fitted from its parameters: what they promise far from there is not what they explain."""
    last, known = best.terms[-1], {laws(h) for h in others}
    rest, guesses = best.x[: -last.size], []
    for one in candidates:
        terms = (*best.terms[:-1], one)
        if _trace(problem.robot, one) == _trace(problem.robot, last) and one.size < last.size:
            points = [np.concatenate([rest, share * one.simulated]) for share in _SIZES]
            guess = Guess(_cheapest(problem, points, terms), terms)
            if laws(guess) not in known:
                guesses.append(guess)
    return iterate_to_convergence(problem, fitted(problem, guesses, _REFINE, seed), seed + 1) if guesses else []


def _there(one, other):
    """Whether suspects differ in the law of the last only."""
    return one[:-1] == other[:-1] and one[-1].location == other[-1].location and one[-1].name != other[-1].name


def _close(problem, hypothesis, others):
    """Whether it leaves hardly more than the best one with as many effects."""
    least = min(problem.misfit(h.residual) for h in others if len(h.terms) == len(hypothesis.terms))
    return problem.misfit(hypothesis.residual) < RIVAL * max(least, CLEAN)


def swap_delays(
    problem: Problem, hypotheses: Sequence[Hypothesis], candidates: Sequence[Term], known: set, seed: int
) -> list[Hypothesis]:
    """The hypotheses with a delay of all commands instead of one of all measurements, and the other way round, fitted
    from where they are; but for those whose laws are known."""
    robot, guesses = problem.robot, {}
    late_ones = [s for s in candidates if late(robot, s.name, s.location)]
    for h in hypotheses:
        for i, (one, part) in enumerate(zip(h.terms, slices(h.terms, problem.parameters), strict=True)):
            for other in [each for each in late_ones if each != one] if one in late_ones else ():
                x, jacobian, factor = h.x.copy(), h.jacobian.copy(), float(one.deviations[0] / other.deviations[0])
                x[part], jacobian[part] = x[part] * factor, jacobian[part] / factor  # of their only number
                guess = Guess(x, (*h.terms[:i], other, *h.terms[i + 1 :]), jacobian)
                if laws(guess) not in known and robot.accepts(effects_at(x[problem.parameters :], guess.terms)):
                    guesses.setdefault(laws(guess), guess)
    if not guesses:
        return []
    found = fitted(problem, list(guesses.values()), _REFINE, seed)
    return descended(problem, found) if problem.misfit_dominated else found


def _nearer(problem, guess, nominal):
    """The guess, or one from the nominal robot's parameters if that is nearer to the recordings: without an effect that
    did most, parameters that went with it may be worse than those of no effect at all."""
    others = [_scaled(np.concatenate([nominal.x, guess.x[problem.parameters :]]), problem.parameters, length)
              for length in (_LITTLE, *_LENGTHS)]  # fmt: skip
    best = _cheapest(problem, [guess.x, *others], guess.terms)
    return guess if best is guess.x else Guess(best, guess.terms)


def _cheapest(problem, points, terms):
    """The one of points (n,) that costs least."""
    residuals = problem.residuals([(x, terms) for x in points])
    return min(zip(points, residuals, strict=True), key=lambda pair: problem.cost(pair[1], pair[0]))[0]


def _warm_start_nested(problem, hypotheses, seed):
    """The hypotheses; where the last law of one contains that of another, the one that leaves more is fitted anew from
    where the other ended.

    A law with more unknowns begins farther off, and can explain all that the contained one does; whether the contained
    one explains as little as it seems is to be seen near the other.
    """
    found = list(hypotheses)
    pairs = [(i, better) for i, h in enumerate(found) if (better := _best_nested(h, found))]
    if pairs:
        guesses = [_begun(problem, found[i].terms, better) for i, better in pairs]
        for (i, _), h in zip(pairs, fitted(problem, guesses, _REFINE, seed), strict=True):
            found[i] = min(found[i], h, key=lambda h: h.cost)
    return found


def _best_nested(hypothesis, others) -> Hypothesis | None:
    """Of the hypotheses that leave less and contain this one, or are contained in it, the best."""
    nested_in = [o for o in others if o.cost < hypothesis.cost and _are_nested(hypothesis.terms, o.terms)]
    return min(nested_in, key=lambda h: h.cost, default=None)


def _are_nested(one, other):
    """Whether suspects differ in the law of the last only, and one of these has all quantities of the other."""
    first, second = ({q.name for q in terms[-1].quantities} for terms in (one, other))
    return one[:-1] == other[:-1] and one[-1].location == other[-1].location and (first < second or first > second)


def _begun(problem, terms, nested_in) -> Guess:
    """Suspects with the values of a hypothesis that is akin; what that lacks is typical, or least."""
    last, known = terms[-1], nested_in.effects(problem.parameters)[-1].parameters
    rest, at = nested_in.x[: -nested_in.terms[-1].size], last.coordinates(known)
    points = [np.concatenate([rest, at])]
    if any(lacks := [q.name not in known for q in last.quantities]):
        points.append(np.concatenate([rest, np.where(lacks, last.bounds[0], at)]))
    return Guess(_cheapest(problem, points, terms), terms)


def _shift_location(problem, hypotheses, screened, seed):
    """The hypotheses, the best one and its rivals with their last effect one segment or measured point further as long
    as that helps.

    Screening sees the robot without the effect, and so far from it neighbours leave other traces: what it promises
    decides between laws, and hardly between segments.
    """
    found, tried = list(hypotheses), {laws(h) for h in hypotheses}
    responses = dict(zip(screened.candidates, screened.responses, strict=True))
    left = [problem.misfit(h.residual) for h in found]
    going = [i for i, each in enumerate(left) if each < RIVAL * max(min(left), CLEAN)]
    while sides := [(i, g) for i in going for g in _beside(problem, found[i], responses) if laws(g) not in tried]:
        tried |= {laws(guess) for _, guess in sides}
        going = set()
        for (i, _), h in zip(sides, fitted(problem, [g for _, g in sides], _REFINE, seed), strict=True):
            if h.cost < found[i].cost:
                found[i] = h
                going.add(i)
        seed += 1
    return found


def _beside(problem, hypothesis, responses) -> list[Guess]:
    """The same with its last effect one body or measured point up and down, as large as leaves the same trace."""
    *others, last = hypothesis.terms
    found, magnitudes = [], len(hypothesis.x) - last.size + np.flatnonzero(last.magnitudes)
    for location in problem.robot.beside(last.location):
        other = replace(last, location=location)
        if last in responses and other in responses:
            x, jacobian = hypothesis.x.copy(), hypothesis.jacobian.copy()
            trace = x[magnitudes] @ responses[last]
            x[magnitudes] = np.linalg.lstsq(responses[other].T, trace)[0]
            jacobian[magnitudes] = responses[other]
            guess = Guess(x, (*others, other), jacobian)
            if problem.robot.accepts(effects_at(x[problem.parameters :], guess.terms)):
                found.append(guess)
    return found


def _tried(problem, guesses):
    """The laws that really explain most, where each promises most, begun where it does: at shares of its estimated
    magnitudes, or, as laws that set in at a threshold may do nothing there, at those with which its last suspect was
    screened."""
    starts = [[*(_scaled(g.x, problem.parameters, length) for length in _LENGTHS), _screened(g)] for g in guesses]
    points = [(x, g.terms) for g, some in zip(guesses, starts, strict=True) for x in some]
    costs = [problem.cost(row, x) for row, (x, _) in zip(problem.residuals(points), points, strict=True)]
    best = np.reshape(costs, (len(guesses), -1))
    started = [replace(g, x=some[int(k)]) for g, some, k in zip(guesses, starts, best.argmin(axis=1), strict=True)]
    return _diversify(problem.robot, started, best.min(axis=1), _TRIED)


def _diversify(robot, given, costs, count):
    """The best so many of different laws, each at the first of its places, the best of other places, and the twins of
    the very best. The best first."""
    firsts = {}
    for i, each in enumerate(given):
        firsts.setdefault(frozenset(s.name for s in each.terms), i)
    order = np.argsort(costs, kind="stable")
    kept = [i for i in order if i in firsts.values()][:count] + [i for i in order if i not in firsts.values()][:1]
    return [given[i] for i in order if i in kept or indistinguishable(robot, given[i], given[order[0]])]


def indistinguishable(
    robot: Robot, one: Guess | Hypothesis | ScreenedCandidate, other: Guess | Hypothesis | ScreenedCandidate
) -> bool:
    """Whether they are laws of the same classes at the same places, or delays of everything, which leave nearly the
    same traces."""
    first, second = (Counter(_trace(robot, s) for s in each.terms) for each in (one, other))
    return first == second


def _trace(robot, term):
    return "late" if late(robot, term.name, term.location) else (CATEGORIES[term.name], term.location)


def _screened(guess):
    last = guess.terms[-1]
    return np.concatenate([guess.x[: -last.size], last.simulated])


def _scaled(x, parameters, length):
    return np.concatenate([x[:parameters], length * x[parameters:]])
