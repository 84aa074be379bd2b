"""The numerical floor: how far the simulation is from itself, made more accurate.

Differences between refined and plain replays at a few points span the errors that a finer model or time step makes
(Kennedy, O'Hagan, "Bayesian calibration of computer models", 2001, with a discrepancy of low rank that is simulated
rather than assumed). What looks like them is no evidence of missing physics. They depend on the physics: near a
hypothesis they have to be computed with its effects.
"""

import itertools
from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import Robot
from soro_bench.diagnosis.suspects import Suspect
from soro_bench.effects.effect import EVERY
from soro_bench.parallel import side_by_side


def numerical_floor(problem: Problem, refined: Sequence[Robot], points: Sequence[tuple[np.ndarray, Sequence[Suspect]]]):
    """(F, M) differences [signal's unit] of refined replays from plain ones, at points: unknowns and suspects.

    The accurate model has other parts: an effect that has no place in it is left out on both sides.
    """
    if not refined:
        return np.zeros((0, problem.weight.size))
    common = [[_common(problem, finer, *point) for point in points] for finer in refined]
    # there are too few replays of each robot to keep its threads busy
    robots, asked = [*refined, problem.robot], [*common, list(itertools.chain(*common))]
    *finer, plain = side_by_side(problem.robot.simulation.batch.nthread, problem.simulated, robots, asked)
    return np.nan_to_num(np.concatenate(finer) - plain)


def _common(problem, finer, x, suspects):
    """A point without the suspects that the finer robot cannot have."""
    kept, parts, first = [], [x[: problem.parameters]], problem.parameters
    for suspect in suspects:
        part, first = x[first : first + suspect.size], first + suspect.size
        kind, everywhere = suspect.where.kind, suspect.where.name == EVERY
        # a law at all joints is another law where there are more of them
        other = everywhere and len(finer.ports(kind)) != len(problem.robot.ports(kind))
        if not other and finer.accepts([suspect.effect(part)]):
            kept.append(suspect)
            parts.append(part)
    return np.concatenate(parts), kept
