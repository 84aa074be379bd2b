"""What a round of forward selection is made of: which candidates are fitted, and fits in turns with their errors."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, typical
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted_under_discretisation
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.moves import Laws, distinct, indistinguishable, laws, move_radii, refine, unique
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Location


def cheapest(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those with the same terms once: at the position of the first, as the one with the least cost."""
    best: dict[Laws, Hypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: h.cost):
        best.setdefault(laws(h), h)
    return [best[laws(h)] for h in unique(hypotheses)]


def refined_in_turns(
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
        problem, better = with_own_discretisation(problem, refined, better, next(seeds))
        rest = [under_present_error(problem, h) for h in hypotheses[count:]]
        hypotheses = sorted([*better, *rest], key=lambda h: -h.log_evidence(problem))
        if not wide and problem.misfit(hypotheses[0].residual) > (1.0 - settings.refinement_gain) * before:
            break
    return problem, hypotheses


def compatible(robot: Robot, hypothesis: Hypothesis, candidates: Sequence[Term]) -> list[Term]:
    """The candidates that the robot can have beside the effects of a hypothesis."""
    effects = hypothesis.effects(len(robot.priors))
    return [term for term in candidates if robot.accepts([*effects, typical(term)])]


def guesses_of(problem: Problem, screened: Evidence, offered: Sequence[ScreenedCandidate]) -> list[Guess]:
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


def worth(problem: Problem, nominal: Hypothesis, best: Hypothesis) -> float:
    """The least predicted gain of one more term beside the best hypothesis that is worth a fit [nats]."""
    settings = problem.settings.selection
    remaining, of_nominal = (problem.misfit(h.residual) for h in (best, nominal))
    of_explained = settings.least_gain_of_explained * (of_nominal - remaining)
    if problem.misfit_dominated:  # then the whole residual counts as noise
        return max(settings.least_gain_of_misfit * 0.5 * float(problem.weight.sum()), of_explained)
    return max(settings.least_gain, settings.least_gain_of_misfit * remaining, of_explained)


def with_own_discretisation(
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
    before = [under_present_error(problem, h) for h in hypotheses]
    return problem, [min(pair, key=lambda h: h.cost) for pair in zip(before, again, strict=True)]


def under_present_error(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with its cost under the discretisation error that the problem has now."""
    return replace(hypothesis, cost=problem.cost(hypothesis.residual, hypothesis.x))
