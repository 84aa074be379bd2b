"""Short recordings of the cheap trunk, to diagnose."""

from collections.abc import Callable, Sequence

import numpy as np

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect
from soro_bench.inference.statistical_linearisation import LowRank

SIGMA = 5e-4
TRUTH = np.array([0.5, -0.4, -0.6, 0.3, 0.2])


def problem(
    robot: Robot, actions: np.ndarray, hidden: Sequence[Effect] = (), before_step: Callable | None = None
) -> Problem:
    """A recording of the robot with other parameters, hidden effects and noise."""
    parameters = np.array([[prior.value(x) for prior, x in zip(robot.priors, TRUTH, strict=True)]])
    values = robot.simulate(actions, parameters, [hidden], before_step=before_step)[0]
    values = values + SIGMA * np.random.default_rng(1).standard_normal(values.shape)
    measured = Measured(actions, 0.05 * np.arange(1, len(actions) + 1), values, "keypoints", "m")
    return Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))
