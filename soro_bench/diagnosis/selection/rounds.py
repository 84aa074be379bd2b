"""What a round of forward selection is made of: which candidates are fitted, and fits in turns with their errors.

A law at several elements at once is one candidate: in place of one term more, or of the single terms found so far. Its
responses are those of its elements together, so that it is screened without a replay.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, effects_at, slices, typical
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals, unlike
from soro_bench.diagnosis.estimation.fit import (
    Guess,
    Hypothesis,
    descended,
    fitted,
    fitted_under_discretisation,
    linearised_at,
)
from soro_bench.diagnosis.estimation.problem import Problem, SimulationError
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.moves import (
    Laws,
    begun_best,
    distinct,
    indistinguishable,
    laws,
    move_radii,
    refine,
    unique,
)
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate, beyond_chance, screen, singles
from soro_bench.diagnosis.selection.significance import alpha, p_slow, slow_variance
from soro_bench.diagnosis.spread_terms import SpreadTerm, alike, is_single, law_of, spread
from soro_bench.effects.catalogue import CATEGORIES

_MUCH = 0.2  # of the misfit, a gain by which a law is the likely cause of a small one


@dataclass(frozen=True)
class Round:
    """What one more term was predicted to gain, and what became of it.

    on: the terms beside which it was looked for. predicted_gain: the best candidates, with the log evidence that each
    was predicted to gain. fitted: the terms of every hypothesis that was kept, with its misfit.
    """

    on: tuple[Term, ...]
    predicted_gain: tuple[tuple[Term, float], ...]
    fitted: tuple[tuple[tuple[Term, ...], float], ...]


def round_of(
    problem: Problem, base: Hypothesis, offered: Sequence[ScreenedCandidate], fitted: Sequence[Hypothesis]
) -> Round:
    """What is told of a round that began at ``base``."""
    best = offered[: problem.settings.selection.candidates]
    return Round(
        base.terms,
        tuple((candidate.terms[-1], candidate.gain) for candidate in best),
        tuple((h.terms, problem.misfit(h.residual)) for h in fitted),
    )


def at_each_element(problem: Problem, screened: Evidence, offered: Sequence[ScreenedCandidate]) -> list[Guess]:
    """Where to begin fits of laws at several elements that are predicted to gain clearly more than any single term.

    Args:
        offered: the single terms, the largest predicted gain first.
    """
    least = offered[0].gain + problem.settings.selection.least_gain
    found = [screened.at_each(spread(members)) for members in alike(screened.candidates)]
    better = [each for each in found if beyond_chance(problem, each) > least and _accepted(problem, each)]
    better.sort(key=lambda each: -each.gain)
    return [screened.guess(each) for each in better[: problem.settings.selection.candidates_per_law]]


def generalised(problem: Problem, screened: Evidence, candidates: Sequence[Term], worth: float) -> list[Guess]:
    """Where to begin fits of laws at all their elements, in place of the single terms that the hypothesis has of them.

    They are tried where the other elements together are predicted to gain as much as is worth a fit. With each come
    simpler laws of its class, as one element may not tell them apart.

    Args:
        candidates: all of them, those too that the robot cannot have beside the hypothesis.
    """
    found, single = [], [each for each in screened.base.terms if is_single(each)]
    for law in sorted({law_of(each) for each in single}):
        own = [each for each in single if law_of(each) == law]
        taken = {each.location for each in own}
        same = [each for each in screened.candidates if is_single(each) and law_of(each) == law]
        others = {each.location: each for each in reversed(same) if each.location not in taken}  # without variants
        if not others:
            continue
        guess = _generalised(problem, screened, own, list(others.values())[::-1], worth)
        found += [guess, *_simpler(guess, candidates)] if guess else []
    return [each for each in found if problem.robot.accepts(effects_at(each.x[problem.parameters :], each.terms))]


def _generalised(
    problem: Problem, screened: Evidence, own: Sequence[Term], others: Sequence[Term], worth: float
) -> Guess | None:
    """The hypothesis with a law at each element in place of its own terms of that law; None if it is not worth a fit.

    Args:
        own: terms of the hypothesis. others: candidates of the same law.
    """
    base, d = screened.base, problem.parameters
    rest = screened.at_each(spread(others))
    if beyond_chance(problem, rest) < worth:
        return None
    parts = dict(zip(base.terms, slices(base.terms, d), strict=True))
    added = rest.terms[-1].parts(rest.x[len(base.x) :])
    magnitudes = [base.x[parts[each]][0] for each in own] + [x[0] for _, x in added]
    kept = np.ones(len(base.x), bool)
    for each in own:
        kept[parts[each]] = False
    whole = spread([*own, *others])
    x = whole.coordinates_of(magnitudes, base.x[parts[own[0]]][1:])
    responses = [base.jacobian[parts[each]][:1] for each in own] + [screened.response(each) for each in others]
    return Guess(
        np.concatenate([rest.x[: len(base.x)][kept], x]),
        (*(each for each in base.terms if each not in own), whole),
        np.concatenate([base.jacobian[kept], _rows(whole, whole.mixing @ np.concatenate(responses))]),
    )


def _simpler(guess: Guess, candidates: Sequence[Term]) -> list[Guess]:
    """The guess with laws of fewer quantities, of the same class at the same elements, in place of its last one."""
    *others, last = guess.terms
    if not isinstance(last, SpreadTerm) or guess.jacobian is None:
        return []
    first, found = len(guess.x) - last.size, []
    for group in alike(candidates):
        members = {each.location: each for each in group}
        same = CATEGORIES[group[0].name] == CATEGORIES[last.name] and group[0].size < last.members[0].size
        if same and not group[0].removable and all(each.location in members for each in last.members):
            whole = spread([members[each.location] for each in last.members])
            ratio = np.array([
                a.deviations[0] / b.deviations[0] for a, b in zip(last.members, whole.members, strict=True)
            ])
            magnitudes = guess.x[first : first + len(last.mixing)] @ last.mixing
            x = whole.coordinates_of(magnitudes * ratio, np.zeros(whole.size))
            rows = guess.jacobian[first : first + len(whole.mixing)]  # but for the ratio, where a search begins only
            jacobian = np.concatenate([guess.jacobian[:first], _rows(whole, rows)])
            found.append(Guess(np.concatenate([guess.x[:first], x]), (*others, whole), jacobian))
    return found


def _rows(term: Term, responses: Floats) -> Floats:
    """(size, M) of a Jacobian: responses (k, M) of the magnitudes, and nothing known of the rest."""
    found = np.zeros((term.size, responses.shape[1]))
    found[: len(responses)] = responses
    return found


def _accepted(problem: Problem, candidate: ScreenedCandidate) -> bool:
    return problem.robot.accepts(candidate.effects)


# --- fits ---


def cheapest(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those with the same terms once: at the position of the first, as the one with the least cost."""
    best: dict[Laws, Hypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: h.cost):
        best.setdefault(laws(h), h)
    return [best[laws(h)] for h in unique(hypotheses)]


def refined_in_turns(
    problem: Problem, robot: Robot, refined: Sequence[Robot], hypotheses: list[Hypothesis], seeds: Iterator[int]
) -> tuple[Problem, list[Hypothesis]]:
    """Fit and discretisation error in turns, as long as the misfit is larger than that of healthy cases and falls, and
    fits move anything.

    The best hypothesis comes first. The first turn is of its rivals too, which may only have farther to go. It samples
    as widely as the nominal fit, as parameters that have absorbed an effect may be far from where they belong.

    Args:
        robot: with the time steps of its model, for the wider samples.
    """
    settings = problem.settings.selection
    for turn in range(settings.turns):
        before = problem.misfit(hypotheses[0].residual)
        if before < settings.healthy_misfit:
            break
        count, radii = 1, move_radii(settings)
        wide = turn == 0 and len(hypotheses[0].terms) > 0
        if wide:
            limit = settings.rival_misfit * before
            count = sum(problem.misfit(h.residual) < limit for h in hypotheses[: settings.discretisations])
            radii = settings.nominal_radius, settings.fit_radius
        better = _refined(problem, robot, hypotheses[:count], radii, next(seeds), anew=turn == 0)
        moved = any(one.x is not other.x for one, other in zip(hypotheses, better, strict=False))
        problem, better = with_own_discretisation(problem, refined, better, next(seeds))
        rest = [under_present_error(problem, h) for h in hypotheses[count:]]
        hypotheses = sorted([*better, *rest], key=lambda h: -h.log_evidence(problem))
        if not moved or (not wide and problem.misfit(hypotheses[0].residual) > (1.0 - settings.turn_gain) * before):
            break
    return problem, hypotheses


def _refined(
    problem: Problem, robot: Robot, hypotheses: Sequence[Hypothesis], radii: Sequence[float], seed: int, anew: bool
) -> list[Hypothesis]:
    """Hypotheses fitted further with longer time steps, and replayed; never worse."""
    best = hypotheses[0]
    rough = problem.with_longer_steps(robot, best.x, best.terms, best.residual)
    better = replayed_anew(problem, refine(rough, hypotheses, radii, seed, anew))
    return [min(pair, key=lambda h: h.cost) for pair in zip(hypotheses, better, strict=True)]


def fitted_in_growing_parts(problem: Problem, refined: Sequence[Robot], seed: int) -> tuple[Problem, Hypothesis] | None:
    """The nominal robot fitted to the beginning of recordings, then from there to longer and longer parts.

    The misfit of a whole recording may have many local minima where motion is chaotic, as of links that swing through.
    That of a short part has few, and each part ends near the minimum of the next one.

    Args:
        problem: without any discretisation error of the robot.
        seed: of the samples around the first fit.

    Returns:
        The problem with its discretisation error and the fit; None where parameters do not explain some part.
    """
    settings, d = problem.settings.selection, problem.parameters
    radii = settings.nominal_radius, settings.move_radius, settings.fit_radius
    part, fit, x = problem, None, np.zeros(d)
    for steps in _growing(problem) if d else ():
        part = problem.first(steps)
        if fit is None and part.left(part.residuals([(x, ())])[0]) <= settings.part_left * part.sensor:
            continue  # other simulations of it would only leave less
        try:
            errors, rows = discretisation_and_residuals(part, refined, [(x, ())], [(x, ())], [x])
        except SimulationError:
            return None
        part = part.with_discretisation(errors)
        most = settings.part_left * part.sensor
        if fit is None and part.left(rows[0]) <= most:
            continue
        guess = Hypothesis((), x, rows[0], part.cost(rows[0], x), np.zeros((d, rows[0].size)), rows[:0])
        (fit,) = [guess] if fit else fitted(part, [Guess(x)], radii, seed)
        (fit,) = descended(part, [fit])
        x = fit.x
        if part.left(fit.residual) > most:
            return None
    return None if fit is None else (part, fit)


def _growing(problem: Problem) -> Iterator[list[int]]:
    """Control steps of each recording that belong to parts, up to all."""
    least, growth = problem.settings.data_quality.least_samples, problem.settings.selection.part_growth
    whole = [len(each.time) for each in problem.recordings]
    share, before = least / max(whole), [0]
    while before != whole:
        steps = [min(max(math.ceil(share * count), least), count) for count in whole]
        if steps != before:
            yield steps
        share, before = share * growth, steps


def is_discrepant(problem: Problem, nominal: Hypothesis) -> bool:
    """Whether the nominal robot leaves so much that parameters hardly cause it."""
    settings, samples = problem.settings.selection, problem.weight.sum()
    limit = max(settings.discrepant_misfit, settings.discrepant_misfit_per_sample * samples)
    return bool(problem.misfit(nominal.residual) >= limit)


def screened_again(
    problem: Problem,
    best: Hypothesis,
    candidates: Sequence[Term],
    robot: Robot,
    known: Mapping[Term, Floats],
    last: Evidence | None,
) -> tuple[Evidence, Evidence]:
    """What candidates say beside the best hypothesis, and which of them were simulated there or near.

    Args:
        known: (k, M) their responses so far. last: those of them that were simulated last.
    """
    radius = problem.settings.selection.fit_radius_last
    if last is None or last.base.terms != best.terms or (np.abs(last.base.x - best.x) >= radius).any():
        screened = screen(problem, best, candidates, robot, known)
        return screened, screened
    screened = screen(problem, best, candidates, robot, known, last.simulated)
    return screened, replace(last, simulated=screened.simulated)


def compatible(robot: Robot, hypothesis: Hypothesis, candidates: Sequence[Term]) -> list[Term]:
    """The candidates that the robot can have beside the effects of a hypothesis."""
    effects = hypothesis.effects(len(robot.priors))
    return [term for term in candidates if robot.accepts([*effects, typical(term)])]


def guesses_of(problem: Problem, screened: Evidence, offered: Sequence[ScreenedCandidate]) -> list[Guess]:
    """Where to begin the fits of the best candidates, and of those that look like the very best.

    Predicted gains are linear: one law may be predicted to gain more than another one that fits better.
    """
    settings = problem.settings.selection
    limit = problem.settings.screening.least_share * offered[0].gain if offered else 0.0
    best = [candidate for candidate in distinct(offered, problem.robot, settings) if candidate.gain >= limit]
    taken = {candidate.chosen for candidate in best}
    others = [
        candidate
        for candidate in offered
        if best and indistinguishable(problem.robot, candidate, best[0]) and candidate.chosen not in taken
    ]
    best += [candidate for candidate in others if problem.robot.accepts(candidate.effects)]
    return [screened.guess(candidate) for candidate in best]


def may_imitate(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether the parameters of a hypothesis may imitate what is missing: it leaves much, and one of them is farther
    from its prior than it would be by chance."""
    if problem.misfit_dominated or not is_discrepant(problem, hypothesis):
        return False
    moved = np.abs(hypothesis.x[: problem.parameters])
    return bool((moved > problem.settings.selection.beyond_chance).any())


def fitted_from_priors(
    problem: Problem,
    robot: Robot,
    best: Hypothesis,
    beside: Evidence,
    candidates: Sequence[Term],
    seed: int,
) -> tuple[Evidence, list[Hypothesis]]:
    """A hypothesis with one more term, screened and fitted from where all parameters are at their priors.

    Parameters may imitate what is missing, as a body's mass does a payload. Where they have moved far to do so, a line
    beside the hypothesis predicts nothing of the missing law, and a fit of it does not lead back.

    Args:
        robot: with the time steps of its model.
        beside: what candidates say beside the hypothesis itself. candidates: that may be the term.

    Returns:
        What the candidates say there, and fits of the best of them.
    """
    settings, d = problem.settings.selection, problem.parameters
    x = np.where(np.arange(len(best.x)) < d, 0.0, best.x)
    rough = problem.with_longer_steps(robot, best.x, best.terms, best.residual)
    there = linearised_at(rough, Guess(x, best.terms), settings.nominal_radius_last, seed)
    known = dict(zip(beside.candidates, beside.responses, strict=True))
    screened = screen(problem, there, compatible(robot, there, candidates), robot, known)
    guesses = guesses_of(problem, screened, singles(screened))
    # the parameters of the estimate are as far off as the line is wrong
    guesses = [replace(each, x=np.concatenate([x, each.x[len(x) :]])) for each in guesses]
    fits = fitted(rough, begun_best(rough, guesses), (settings.fit_radius,), seed)
    return screened, replayed_anew(problem, fits)


def worth(problem: Problem, nominal: Hypothesis, best: Hypothesis) -> float:
    """The least predicted gain of one more term beside the best hypothesis that is worth a fit [nats]."""
    settings = problem.settings.selection
    remaining, of_nominal = (problem.misfit(h.residual) for h in (best, nominal))
    of_explained = problem.settings.probabilities.law_error * (of_nominal - remaining)
    if problem.misfit_dominated:  # then the whole residual counts as noise
        return max(settings.least_gain_of_misfit * 0.5 * float(problem.weight.sum()), of_explained)
    least = max(settings.least_gain, settings.least_gain_of_misfit * remaining, of_explained)
    if not best.terms and p_slow(*slow_variance([(problem, best.residual)]), problem.settings) < alpha(
        problem.settings
    ):
        # a short recording shows a discrepancy that no law can gain so much by
        least = min(least, max(problem.settings.probabilities.healthy_gain, _MUCH * remaining))
    return least


def with_own_discretisation(
    problem: Problem, refined: Sequence[Robot], hypotheses: Sequence[Hypothesis], seed: int
) -> tuple[Problem, list[Hypothesis]]:
    """The problem with the discretisation error of the hypotheses too, and these fitted once more under it."""
    settings = problem.settings.selection
    chosen = unlike([(h.x, h.terms) for h in hypotheses])[: settings.discretisations]
    guesses = [Guess(h.x, h.terms, h.jacobian) for h in hypotheses]
    problem, again = fitted_under_discretisation(problem, refined, chosen, guesses, (settings.fit_radius_last,), seed)
    before = [under_present_error(problem, h) for h in hypotheses]
    return problem, [min(pair, key=lambda h: h.cost) for pair in zip(before, again, strict=True)]


def replayed_anew(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses that were fitted with longer time steps, with their residuals and costs in the problem."""
    rows = problem.residuals([(h.x, h.terms) for h in hypotheses])
    pairs = zip(hypotheses, rows, strict=True)
    return [replace(h, residual=row, cost=problem.cost(row, h.x)) for h, row in pairs]


def from_base_if_worse(problem: Problem, base: Hypothesis, fits: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Fits of a base with more terms; where all ended above the base, fits that begin at it, without the new terms.

    Then samples were too wide, as where the phase of an oscillation runs away.
    """
    if any(h.cost <= base.cost or h.terms[: len(base.terms)] != base.terms for h in fits):
        return list(fits)
    starts = [
        replace(h, x=np.concatenate([base.x, np.zeros(len(h.x) - len(base.x))]), residual=base.residual,
                cost=base.cost, error=h.error[:0])
        for h in fits
    ]  # fmt: skip
    return sorted(descended(problem, starts), key=lambda h: -h.log_evidence(problem))


def under_present_error(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with its cost under the discretisation error that the problem has now."""
    return replace(hypothesis, cost=problem.cost(hypothesis.residual, hypothesis.x))
