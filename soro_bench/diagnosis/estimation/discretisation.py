"""The numerical floor: how far the simulation is from itself, made more accurate.

Differences between refined and plain replays at a few points span the errors that a finer model or time step makes
(Kennedy, O'Hagan, "Bayesian calibration of computer models", 2001, with a discrepancy of low rank that is simulated
rather than assumed). What looks like them is no evidence of missing physics. They depend on the physics: near a
hypothesis they have to be computed with its effects.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.candidates import Term, slices
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import EVERY
from soro_bench.parallel import side_by_side

Points = Sequence[tuple[np.ndarray, Sequence[Term]]]  # unknowns, and the suspects that they belong to


def discretisation_and_residuals(
    problem: Problem, refined: Sequence[Robot], points: Points, others: Points
) -> tuple[np.ndarray, np.ndarray]:
    """The numerical floor at points: (F, M) differences [signal's unit] of refined replays from plain ones; and the
    residuals (N, M) at others, which are replayed meanwhile: there are too few replays of each refined robot to keep
    all processors busy.

    The accurate model has other parts: an effect that has no place in it is left out on both sides.

    Raises:
        SimulationError: a refined robot diverges at every point, and that without any effect.
    """
    common = [[_common(problem, finer, *point) for point in points] for finer in refined]
    plain = [*itertools.chain(*common), *others]
    robots, asked = [*refined, problem.robot], [*common, plain]
    if not plain:
        return np.zeros((0, problem.weight.size)), np.zeros((0, problem.weight.size))
    *finer, found = side_by_side(problem.robot.simulation.batch.nthread, problem.simulated, robots, asked)
    count = len(plain) - len(others)
    if not any(terms for _, terms in points):
        for each, rows in zip(refined, finer, strict=True):
            problem.check_finite(each, rows)
    error = np.concatenate(finer) - found[:count] if finer else found[:0]
    return np.nan_to_num(error), problem.residuals_of(found[count:])


def _common(problem, finer, x, terms):
    """A point without the suspects that the finer robot cannot have."""
    kept, parts = [], [x[: problem.parameters]]
    for term, location in zip(terms, slices(terms, problem.parameters), strict=True):
        part = x[location]
        kind, everywhere = term.location.kind, term.location.name == EVERY
        # a law at all joints is another law where there are more of them
        other = everywhere and len(finer.locations(kind)) != len(problem.robot.locations(kind))
        if not other and finer.accepts([term.effect(part)]):
            kept.append(term)
            parts.append(part)
    return np.concatenate(parts), kept
