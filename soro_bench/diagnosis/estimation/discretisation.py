"""Discretisation error: how far the simulation is from a more accurate one of the same robot.

Differences of refined replays from plain ones, at a few points, span the errors of the time step and the model. They
are a model discrepancy of low rank (Kennedy, O'Hagan, "Bayesian calibration of computer models", 2001) that is
simulated, not assumed. A residual in their span is no evidence of unmodelled dynamics. They depend on the physics, so
near a hypothesis they are computed with its effects.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, slices
from soro_bench.diagnosis.estimation.problem import Points, Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.variants import Variant
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import EVERY, Location
from soro_bench.parallel import side_by_side


def discretisation_and_residuals(
    problem: Problem, refined: Sequence[Robot], points: Points, others: Points, compared: Sequence[Floats] = ()
) -> tuple[Floats, Floats]:
    """Discretisation errors at some points, and residuals at other points, replayed side by side.

    A refined robot has too few replays to keep all processors busy; the other replays fill them. The accurate model has
    other parts: an effect without a location in it is left out on both sides.

    Args:
        refined: more accurate robots.
        points: where errors are computed.
        others: where residuals are computed.
        compared: (n,) unknowns, of which the parameters come first, at which other simulations are compared too.

    Returns:
        (F, M) differences [signal's unit] of refined replays from plain ones, then those of other simulations; (N, M)
        residuals at ``others``.

    Raises:
        SimulationError: a refined robot diverges at every point, without any effect.
    """
    common = [[_common(problem, finer, *point) for point in points] for finer in refined if len(points)]
    without = [(x[: problem.parameters], ()) for x in compared] if problem.variants else []
    plain = [*itertools.chain(*common), *without, *others]
    if not plain:
        return np.zeros((0, problem.weight.size)), np.zeros((0, problem.weight.size))
    # what runs alone comes first; the many replays of the robot itself fill what is left of the processors
    jobs = [partial(problem.simulated, *each) for each in zip(refined, common, strict=bool(common))]
    jobs += [partial(_by_other, problem, each, compared) for each in problem.variants if without]
    jobs.append(partial(problem.simulated, problem.robot, plain))
    *rows, found = side_by_side(problem.robot.simulation.batch.nthread, _called, jobs)
    if not any(terms for _, terms in points):
        for each, own in zip(refined, rows[: len(common)], strict=bool(common)):
            problem.check_finite(each, own)
    count = len(plain) - len(others)
    own, compared_to = np.split(found[:count], [count - len(without)])
    beside = [own, *[compared_to] * (len(rows) - len(common))]
    error = np.concatenate(rows) - np.concatenate(beside) if rows else found[:0]
    return np.nan_to_num(error), problem.residuals_of(found[count:])


def differences(problem: Problem, points: Sequence[Floats]) -> Floats:
    """Differences of other simulations of the robot from its own, without effects.

    Args:
        points: (n,) unknowns, of which the parameters come first.

    Returns:
        (F, M) differences [signal's unit]; 0 from where a simulation diverges.
    """
    return discretisation_and_residuals(problem, (), (), (), points)[0]


def unlike(points: Points) -> list[tuple[Floats, Sequence[Term]]]:
    """The points of different classes of laws, or at different locations; the others have nearly the same error."""
    found: dict[tuple[tuple[str, Location], ...], tuple[Floats, Sequence[Term]]] = {}
    for x, terms in points:
        found.setdefault(tuple((CATEGORIES.get(term.name, term.name), term.location) for term in terms), (x, terms))
    return list(found.values())


def _called(job: Callable[[], Floats]) -> Floats:
    return job()


def _by_other(problem: Problem, other: Variant, points: Sequence[Floats]) -> Floats:
    """(N, M) samples [first signal's unit] of another simulation without effects."""
    return problem.scaled(other([each.drive for each in problem.recordings], problem.parameter_values(points)))


def _common(problem: Problem, finer: Robot, x: Floats, terms: Sequence[Term]) -> tuple[Floats, list[Term]]:
    """A point without the terms that the finer robot cannot have."""
    kept, parts = [], [x[: problem.parameters]]
    for term, where in zip(terms, slices(terms, problem.parameters), strict=True):
        part = x[where]
        kind, everywhere = term.location.kind, term.location.name == EVERY
        # a law at all joints is another law where there are more of them
        other = everywhere and len(finer.locations(kind)) != len(problem.robot.locations(kind))
        if not other and finer.accepts(term.effects(part)):
            kept.append(term)
            parts.append(part)
    return np.concatenate(parts), kept
