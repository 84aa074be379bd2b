"""The numerical floor: how far the simulation is from itself, made more accurate.

Differences between refined and plain replays at a few points span the errors that a finer model or time step makes
(Kennedy, O'Hagan, "Bayesian calibration of computer models", 2001, with a discrepancy of low rank that is simulated
rather than assumed). What looks like them is no evidence of missing physics. They depend on the physics: near a
hypothesis they have to be computed with its effects.
"""

from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import Robot
from soro_bench.diagnosis.suspects import Suspect
from soro_bench.effects.effect import EffectError


def numerical_floor(problem: Problem, refined: Sequence[Robot], points: Sequence[tuple[np.ndarray, Sequence[Suspect]]]):
    """(F, M) differences [signal's unit] of refined replays from plain ones, at points: unknowns and suspects."""
    plain, columns = problem.simulated(problem.robot, points), []
    for finer in refined:
        try:
            columns.append(problem.simulated(finer, points) - plain)
        except EffectError:  # the accurate model has other parts, at which an effect has no place
            bare = [(x[: problem.parameters], ()) for x, _ in points]
            columns.append(problem.simulated(finer, bare) - problem.simulated(problem.robot, bare))
    return np.nan_to_num(np.concatenate(columns))
