"""The numerical floor: how far the simulation is from itself, made more accurate.

Differences between refined and plain replays at a few parameter vectors span the errors that a finer model or time step
makes (Kennedy, O'Hagan, "Bayesian calibration of computer models", 2001, with a discrepancy of low rank that is
simulated rather than assumed). What looks like them is no evidence of missing physics.
"""

from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.robot import Robot


def numerical_floor(robot: Robot, refined: Sequence[Robot], actions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(F, M) differences [signal's unit] of refined replays from plain ones, at unknowns (N, d) of the parameters."""
    parameters = np.stack([prior.value(points[:, i]) for i, prior in enumerate(robot.priors)], axis=1)
    nothing = [()] * len(points)
    plain = robot.simulate(actions, parameters, nothing)
    found = [finer.simulate(actions, parameters, nothing) - plain for finer in refined]
    return np.nan_to_num(np.concatenate(found)).reshape(len(refined) * len(points), -1)
