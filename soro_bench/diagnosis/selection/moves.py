"""Moves: screened candidates become hypotheses, fitted together with all parameters; weak ones are dropped.

A fit may end in a local minimum. The moves begin it again from elsewhere: from a neighbouring location, from a rival's
or a nested model's parameters, with a simpler law, without one of the terms, or with another delay.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from soro_bench.diagnosis.candidates import Term, effects_at, late, slices
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, descended, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate
from soro_bench.diagnosis.settings import SelectionSettings
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import EACH, Location

Laws = frozenset[tuple[str, Location]]  # of a hypothesis
WithTerms = TypeVar("WithTerms", Guess, Hypothesis)


def distinct(
    candidates: Sequence[ScreenedCandidate], robot: Robot, settings: SelectionSettings
) -> list[ScreenedCandidate]:
    """The first candidates that the robot can have, few of the same laws."""
    chosen: list[ScreenedCandidate] = []
    times: Counter[tuple[str, ...]] = Counter()
    for candidate in candidates:
        if len(chosen) == settings.candidates:
            break
        if times[candidate.names] < settings.candidates_per_law and robot.accepts(candidate.effects):
            times[candidate.names] += 1
            chosen.append(candidate)
    return chosen


def refitted(problem: Problem, guesses: Sequence[Guess], screened: Evidence, seed: int) -> list[Hypothesis]:
    """The hypotheses that are kept, the most probable first.

    Args:
        screened: the responses of all candidates, for terms that move to another location.
    """
    settings = problem.settings.selection
    hypotheses = fitted(problem, begun_best(problem, guesses), (settings.fit_radius,), seed)
    hypotheses = unique(sorted(hypotheses, key=lambda h: h.cost))
    hypotheses = _shift_location(problem, _warm_start_nested(problem, hypotheses, seed), screened, seed + 1)
    ranked = unique(sorted(hypotheses, key=lambda h: -h.log_evidence(problem)))
    return _diversify(problem.robot, ranked, range(len(ranked)), settings.kept)


def unique(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The first of those with the same laws at the same locations, whose fits began elsewhere."""
    first: dict[Laws, Hypothesis] = {}
    for hypothesis in hypotheses:
        first.setdefault(laws(hypothesis), hypothesis)
    return list(first.values())


def laws(hypothesis: Hypothesis | Guess) -> Laws:
    """Its laws with their locations."""
    return frozenset((term.name, term.location) for term in hypothesis.terms)


def move_radii(settings: SelectionSettings) -> tuple[float, float]:
    """Of the samples of the two fits after a move, in prior deviations."""
    return settings.move_radius, settings.move_radius_second


def refine(
    problem: Problem, hypotheses: Sequence[Hypothesis], radii: Sequence[float], seed: int, anew: bool = True
) -> list[Hypothesis]:
    """The hypotheses, each fitted further; never worse.

    Args:
        radii: of the samples, in prior deviations.
        anew: whether Jacobians are computed from nothing; else from those that the hypotheses have.
    """
    better = fitted(problem, [Guess(h.x, h.terms, None if anew else h.jacobian) for h in hypotheses], radii, seed)
    return [min(pair, key=lambda h: h.cost) for pair in zip(hypotheses, better, strict=True)]


def iterate_to_convergence(problem: Problem, hypotheses: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The hypotheses, each fitted further as long as that helps it; never worse.

    For fits that are far from the recordings, where a Jacobian from elsewhere points in a wrong direction.
    """
    settings = problem.settings.selection
    best, going = list(hypotheses), list(range(len(hypotheses)))
    for k in range(settings.turns):
        guesses = [Guess(best[i].x, best[i].terms, best[i].jacobian if k else None) for i in going]
        further = dict(zip(going, fitted(problem, guesses, move_radii(settings), seed + k), strict=True))
        helped = [i for i, h in further.items() if h.cost < (1.0 - settings.turn_gain) * best[i].cost]
        for i, hypothesis in further.items():
            best[i] = min(best[i], hypothesis, key=lambda h: h.cost)
        if not (going := helped):
            break
    return descended(problem, best)


def without_one(problem: Problem, hypothesis: Hypothesis, nominal: Hypothesis, seed: int) -> list[Hypothesis]:
    """The hypotheses that have one term less, fitted from where this one is.

    Args:
        nominal: has no term; its parameters are tried too where the misfit dominates.
    """
    guesses = []
    for i, part in enumerate(slices(hypothesis.terms, problem.parameters)):
        kept = np.ones(len(hypothesis.x), bool)
        kept[part] = False
        rest = hypothesis.terms[:i] + hypothesis.terms[i + 1 :]
        guesses.append(Guess(hypothesis.x[kept], rest, hypothesis.jacobian[kept]))
    radii = move_radii(problem.settings.selection)
    if not problem.misfit_dominated:
        return fitted(problem, guesses, radii, seed)
    nearer = [_nearer(problem, guess, nominal) for guess in guesses]
    return descended(problem, fitted(problem, nearer, radii, seed))


def revisit_rivals(problem: Problem, best: Hypothesis, tried: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The best hypothesis with a close rival of an earlier round in place of the law that won that round.

    Each is fitted from where either ended: two laws that leave the same misfit alone may not beside a third one.

    Args:
        tried: all hypotheses of earlier rounds.
    """
    guesses, d = [], problem.parameters
    for rival in tried:
        k = len(rival.terms) - 1
        won = best.terms[: k + 1]
        if 0 <= k < len(best.terms) - 1 and _differ_in_last_law(rival.terms, won) and is_rival(problem, rival, tried):
            later = best.x[slices(best.terms, d)[k].stop :]
            terms = (*rival.terms, *best.terms[k + 1 :])
            for parameters in (best.x[:d], rival.x[:d]):
                guesses.append(Guess(np.concatenate([parameters, rival.x[d:], later]), terms))
    guesses = [guess for guess in guesses if problem.robot.accepts(effects_at(guess.x[d:], guess.terms))]
    return fitted(problem, guesses, move_radii(problem.settings.selection), seed) if guesses else []


def simplify(
    problem: Problem, best: Hypothesis, others: Sequence[Hypothesis], candidates: Sequence[Term], seed: int
) -> list[Hypothesis]:
    """The best hypothesis with simpler laws in place of its last one: of the same class, at the same location.

    They are fitted from its parameters, as screening predicts little so far from where they were screened.

    Args:
        others: hypotheses whose laws are not tried again.
    """
    last, known = best.terms[-1], {laws(h) for h in others}
    rest, guesses = best.x[: -last.size], []
    settings = problem.settings.selection
    for simpler in candidates:
        terms = (*best.terms[:-1], simpler)
        if _trace(problem.robot, simpler) == _trace(problem.robot, last) and simpler.size < last.size:
            points = [np.concatenate([rest, size * simpler.simulated]) for size in settings.starts]
            guess = Guess(_point_of_least_cost(problem, points, terms), terms)
            if laws(guess) not in known:
                guesses.append(guess)
    if not guesses:
        return []
    return iterate_to_convergence(problem, fitted(problem, guesses, move_radii(settings), seed), seed + 1)


def _differ_in_last_law(first: Sequence[Term], second: Sequence[Term]) -> bool:
    """Whether terms differ in the law of the last only."""
    *before, one = first
    *before_other, other = second
    return before == before_other and one.location == other.location and one.name != other.name


def is_rival(problem: Problem, hypothesis: Hypothesis, tried: Sequence[Hypothesis]) -> bool:
    """Whether the misfit of a hypothesis is hardly larger than that of the best one with as many terms."""
    settings = problem.settings.selection
    least = min(problem.misfit(h.residual) for h in tried if len(h.terms) == len(hypothesis.terms))
    return problem.misfit(hypothesis.residual) < settings.rival_misfit * max(least, settings.healthy_misfit)


def swap_delays(
    problem: Problem,
    hypotheses: Sequence[Hypothesis],
    candidates: Sequence[Term],
    known: Collection[Laws],
    seed: int,
) -> list[Hypothesis]:
    """The hypotheses with a delay of all commands in place of one of all measurements, or the other way round.

    Args:
        known: laws of hypotheses that are not fitted again.
    """
    robot = problem.robot
    guesses: dict[Laws, Guess] = {}
    delays = [term for term in candidates if late(robot, term.name, term.location)]
    for h in hypotheses:
        for i, (term, part) in enumerate(zip(h.terms, slices(h.terms, problem.parameters), strict=True)):
            for other in [delay for delay in delays if delay != term] if term in delays else ():
                x, jacobian, factor = h.x.copy(), h.jacobian.copy(), float(term.deviations[0] / other.deviations[0])
                x[part], jacobian[part] = x[part] * factor, jacobian[part] / factor  # of their only number
                guess = Guess(x, (*h.terms[:i], other, *h.terms[i + 1 :]), jacobian)
                if (x[part] < other.bounds[0]).any():
                    continue  # what is early is no later delay, but one of the model that is taken away
                if laws(guess) not in known and robot.accepts(effects_at(x[problem.parameters :], guess.terms)):
                    guesses.setdefault(laws(guess), guess)
    if not guesses:
        return []
    swapped = fitted(problem, list(guesses.values()), move_radii(problem.settings.selection), seed)
    return descended(problem, swapped) if problem.misfit_dominated else swapped


def _nearer(problem: Problem, guess: Guess, nominal: Hypothesis) -> Guess:
    """The guess, or one from the nominal robot's parameters if that is nearer to the recordings.

    Parameters that were fitted beside a strong term may be worse without it than those of no term at all.
    """
    settings, d = problem.settings.selection, problem.parameters
    from_nominal = np.concatenate([nominal.x, guess.x[d:]])
    others = [_with_share_of_terms(from_nominal, d, share) for share in _smaller(settings)]
    best = _point_of_least_cost(problem, [guess.x, *others], guess.terms)
    return guess if best is guess.x else Guess(best, guess.terms)


def _point_of_least_cost(problem: Problem, points: Sequence[np.ndarray], terms: Sequence[Term]) -> np.ndarray:
    """The one of points (n,) whose cost is least."""
    residuals = problem.residuals([(x, terms) for x in points])
    return min(zip(points, residuals, strict=True), key=lambda pair: problem.cost(pair[1], pair[0]))[0]


def _warm_start_nested(problem: Problem, hypotheses: Sequence[Hypothesis], seed: int) -> list[Hypothesis]:
    """The hypotheses; of two nested models, the one with the larger cost is fitted again from where the other ended.

    A law with more unknowns begins farther off, and can explain all that a nested one does. Whether the nested one
    really explains less shows only near the other.
    """
    best = list(hypotheses)
    pairs = [(i, better) for i, h in enumerate(best) if (better := _best_nested(h, best))]
    if pairs:
        guesses = [_begun_at_nested(problem, best[i].terms, better) for i, better in pairs]
        again = fitted(problem, guesses, move_radii(problem.settings.selection), seed)
        for (i, _), hypothesis in zip(pairs, again, strict=True):
            best[i] = min(best[i], hypothesis, key=lambda h: h.cost)
    return best


def _best_nested(hypothesis: Hypothesis, others: Sequence[Hypothesis]) -> Hypothesis | None:
    """The best of the hypotheses with less cost that this one contains, or that contain this one."""
    nested = [other for other in others if other.cost < hypothesis.cost and _are_nested(hypothesis.terms, other.terms)]
    return min(nested, key=lambda h: h.cost, default=None)


def _are_nested(first: Sequence[Term], second: Sequence[Term]) -> bool:
    """Whether terms differ in the law of the last only, one of which has all quantities of the other."""
    quantities, others = ({q.name for q in terms[-1].quantities} for terms in (first, second))
    same = first[:-1] == second[:-1] and first[-1].location == second[-1].location
    same = same and first[-1].location.name != EACH  # whose coordinates are not those of one effect
    return same and (quantities < others or quantities > others)


def _begun_at_nested(problem: Problem, terms: tuple[Term, ...], nested: Hypothesis) -> Guess:
    """Terms with the values of a nested hypothesis; quantities that it lacks are typical, or as small as can be."""
    last, values = terms[-1], nested.effects(problem.parameters)[-1].parameters
    rest, x = nested.x[: -nested.terms[-1].size], last.coordinates(values)
    points = [np.concatenate([rest, x])]
    if any(lacks := [q.name not in values for q in last.quantities]):
        points.append(np.concatenate([rest, np.where(lacks, last.bounds[0], x)]))
    return Guess(_point_of_least_cost(problem, points, terms), terms)


def _shift_location(
    problem: Problem, hypotheses: Sequence[Hypothesis], screened: Evidence, seed: int
) -> list[Hypothesis]:
    """The hypotheses, with the last term of the best one and of its rivals moved to a neighbour as long as that helps.

    Screening simulates the robot without the term. So far from it, neighbouring locations have other responses: the
    predicted gain tells laws apart, and hardly locations.
    """
    settings = problem.settings.selection
    best, tried = list(hypotheses), {laws(h) for h in hypotheses}
    responses = dict(zip(screened.candidates, screened.responses, strict=True))
    misfits = [problem.misfit(h.residual) for h in best]
    limit = settings.rival_misfit * max(min(misfits), settings.healthy_misfit)
    going = {i for i, misfit in enumerate(misfits) if misfit < limit}
    while sides := [
        (i, guess)
        for i in sorted(going)
        for guess in _at_neighbours(problem, best[i], responses)
        if laws(guess) not in tried
    ]:
        tried |= {laws(guess) for _, guess in sides}
        going = set()
        moved = fitted(problem, [guess for _, guess in sides], move_radii(settings), seed)
        for (i, _), hypothesis in zip(sides, moved, strict=True):
            if hypothesis.cost < best[i].cost:
                best[i] = hypothesis
                going.add(i)
        seed += 1
    return best


def _at_neighbours(problem: Problem, hypothesis: Hypothesis, responses: Mapping[Term, np.ndarray]) -> list[Guess]:
    """The same with its last term at the neighbouring bodies or measured points, as large as gives the same response.

    Args:
        responses: (k, M) of the candidates.
    """
    *others, last = hypothesis.terms
    guesses, magnitudes = [], len(hypothesis.x) - last.size + np.flatnonzero(last.magnitudes)
    for location in problem.robot.beside(last.location):
        neighbour = replace(last, location=location)
        if last in responses and neighbour in responses:
            x, jacobian = hypothesis.x.copy(), hypothesis.jacobian.copy()
            response = x[magnitudes] @ responses[last]
            x[magnitudes] = np.linalg.lstsq(responses[neighbour].T, response)[0]
            jacobian[magnitudes] = responses[neighbour]
            guess = Guess(x, (*others, neighbour), jacobian)
            if problem.robot.accepts(effects_at(x[problem.parameters :], guess.terms)):
                guesses.append(guess)
    return guesses


def begun_best(problem: Problem, guesses: Sequence[Guess]) -> list[Guess]:
    """The laws that explain most when they are replayed, each begun where it explains most.

    That may be at a share of its estimated magnitudes. A law that sets in at a threshold may do nothing there, so it
    may also begin at the magnitudes with which it was screened.
    """
    if not guesses:
        return []
    settings, d = problem.settings.selection, problem.parameters
    starts = [
        [*(_with_share_of_terms(guess.x, d, share) for share in _smaller(settings)), _as_screened(guess)]
        for guess in guesses
    ]
    points = [(x, guess.terms) for guess, own in zip(guesses, starts, strict=True) for x in own]
    costs = [problem.cost(row, x) for row, (x, _) in zip(problem.residuals(points), points, strict=True)]
    costs_of = np.reshape(costs, (len(guesses), -1))
    begun = [
        replace(guess, x=own[int(k)]) for guess, own, k in zip(guesses, starts, costs_of.argmin(axis=1), strict=True)
    ]
    return _diversify(problem.robot, begun, costs_of.min(axis=1), settings.fitted)


def _diversify(
    robot: Robot, given: Sequence[WithTerms], costs: Sequence[float] | np.ndarray, count: int
) -> list[WithTerms]:
    """The best ``count`` of different laws, the best other location, and all that look like the very best.

    Each law is at the first of its locations; the least cost comes first.
    """
    first_of: dict[frozenset[str], int] = {}
    for i, hypothesis in enumerate(given):
        first_of.setdefault(frozenset(term.name for term in hypothesis.terms), i)
    order = np.argsort(np.asarray(costs), kind="stable").tolist()
    firsts = set(first_of.values())
    kept = [i for i in order if i in firsts][:count] + [i for i in order if i not in firsts][:1]
    return [given[i] for i in order if i in kept or indistinguishable(robot, given[i], given[order[0]])]


def indistinguishable(
    robot: Robot, first: Guess | Hypothesis | ScreenedCandidate, second: Guess | Hypothesis | ScreenedCandidate
) -> bool:
    """Whether their responses are nearly the same: laws of the same classes at the same locations, or delays of
    everything."""
    traces, others = (Counter(_trace(robot, term) for term in each.terms) for each in (first, second))
    return traces == others


def _trace(robot: Robot, term: Term) -> str | tuple[str, Location]:
    """What terms with nearly the same response have in common."""
    return "late" if late(robot, term.name, term.location) else (CATEGORIES[term.name], term.location)


def _as_screened(guess: Guess) -> np.ndarray:
    """(n,) unknowns with the last term as it was screened."""
    last = guess.terms[-1]
    return np.concatenate([guess.x[: -last.size], last.simulated])


def _smaller(settings: SelectionSettings) -> list[float]:
    """Shares of estimated magnitudes from which a fit may begin: Jacobians vanish without any."""
    return [share for share in settings.starts if share <= 1.0]


def _with_share_of_terms(x: np.ndarray, parameters: int, share: float) -> np.ndarray:
    """(n,) unknowns with only a share of the coordinates of terms."""
    return np.concatenate([x[:parameters], share * x[parameters:]])
