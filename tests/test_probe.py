"""Places of forces that have no name; those on the trunk are in test_diagnosis.py."""

import numpy as np

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.probe import places
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import Measured
from soro_bench.diagnosis.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Port
from soro_bench.inference.clouds import LowRank

SIGMA, STEPS = 5e-4, 2


def test_a_walkers_chamber_that_is_filled_too_much_is_found():
    """It has neither tendons nor bodies with names: actuators, gravity and measured points are left."""
    robot, where = SuiteRobot("MultiGait-v0", threads=1), Port("actuator", "front_left")
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    actions = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]], np.float32)[:STEPS]
    more = Effect("pretension", where, {"offset": 0.1})
    values = robot.simulate(actions, nominal, [[more]])[0]
    values = values + SIGMA * np.random.default_rng(0).standard_normal(values.shape)
    measured = Measured(actions, robot.control_timestep * np.arange(1, STEPS + 1), values, robot.signal, robot.unit)
    given = Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))
    x, n = np.zeros(len(robot.priors)), len(robot.priors)
    (residual,) = given.residuals([(x, ())])
    base = Hypothesis(
        (), x, residual, given.cost(residual, x), np.zeros((n, residual.size)), np.zeros((0, residual.size))
    )
    best = places(given, robot, base)[0]
    assert best.where == where
