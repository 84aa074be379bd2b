"""Laws at several elements at once, as one candidate: in place of one term more, or of the single terms found so far.

Their responses are those of their elements together, so that they are screened without a replay.
"""

from collections.abc import Sequence

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, effects_at, slices
from soro_bench.diagnosis.estimation.fit import Guess
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate
from soro_bench.diagnosis.spread_terms import SpreadTerm, alike, is_single, law_of, spread
from soro_bench.effects.catalogue import CATEGORIES


def at_each_element(problem: Problem, screened: Evidence, offered: Sequence[ScreenedCandidate]) -> list[Guess]:
    """Where to begin fits of laws at several elements that are predicted to gain clearly more than any single term.

    Args:
        offered: the single terms, the largest predicted gain first.
    """
    least = offered[0].gain + problem.settings.selection.least_gain
    found = [screened.at_each(spread(members)) for members in alike(screened.candidates)]
    better = [each for each in found if _beyond_chance(problem, each) > least and _accepted(problem, each)]
    better.sort(key=lambda each: -each.gain)
    return [screened.guess(each) for each in better[: problem.settings.selection.spread_laws]]


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
        found += [guess, *_simpler(problem, guess, candidates)] if guess else []
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
    if _beyond_chance(problem, rest) < worth:
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


def _simpler(problem: Problem, guess: Guess, candidates: Sequence[Term]) -> list[Guess]:
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


def _beyond_chance(problem: Problem, candidate: ScreenedCandidate) -> float:
    """The predicted gain, less what further unknowns than one gain by chance [nats]."""
    if problem.misfit_dominated:  # then the whole residual counts as noise, and all gains are small
        return candidate.gain
    return candidate.gain - problem.settings.probabilities.gain_of_unknown * (candidate.terms[-1].size - 1)


def _accepted(problem: Problem, candidate: ScreenedCandidate) -> bool:
    return problem.robot.accepts(candidate.effects)
