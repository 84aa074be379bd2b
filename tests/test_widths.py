"""How well fitted unknowns are known."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.gauss_newton import descended
from soro_bench.diagnosis.estimation.posterior_covariance import with_covariance
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP

STICKY = ARM.replace(' forcerange="-1 1"', "").replace(
    'damping="0.02"', 'damping="0.02" frictionloss="0.05" solreffriction="0.004 1"'
)
SERVO = """[parameters.stiffness]
fields = ["actuator_gainprm[0]:motor", "actuator_biasprm[1]:motor", "actuator_biasprm[2]:motor"]
deviation = 0.2
[parameters.friction]
fields = ["dof_frictionloss:hinge"]
deviation = 0.3
"""


def test_what_only_ratios_change_is_as_unknown_as_before_though_a_joint_sticks(tmp_path):
    """All forces and masses times the same number leave the motion as it is. Where the joint sticks, a slope at a point
    says otherwise."""
    model, mapping = tmp_path / "arm.xml", tmp_path / "map.toml"
    model.write_text(STICKY)
    mapping.write_text(MAP[: MAP.index("[parameters.zero]")] + SERVO)
    robot, rng = ModelRobot(model, mapping, threads=1), np.random.default_rng(0)
    goals = np.repeat(rng.uniform(-0.4, 0.4, 20), 15)[:, None]
    (angles,) = robot.simulate(goals, np.ones((1, 4)), [[]], np.zeros((1, 1)))
    angles = np.concatenate([np.zeros(1), angles.ravel()]) + 5e-4 * rng.standard_normal(len(goals) + 1)
    time = 0.02 * np.arange(len(angles))
    angles[0] = 0.0
    seen = robot.measured(Recording({"goal": Signal(time[:-1], goals)}, {"angle": Signal(time, angles, "rad")}))
    problem = unexplained(robot, (seen,), 5e-4)
    x = np.zeros(4)
    (residual,) = problem.residuals([(x, ())])
    nothing = np.zeros((0, len(residual)))
    start = Hypothesis((), x, residual, problem.cost(residual, x), np.zeros((4, len(residual))), nothing)
    (found,) = descended(problem, [start])
    scale = 1.0 / np.array([prior.deviation for prior in robot.priors])  # by which all grow alike

    def known(hypothesis):
        return 1.0 / np.sqrt(scale @ np.linalg.inv(hypothesis.covariance(problem)) @ scale)

    assert known(with_covariance(problem, found, 0)) == pytest.approx(1.0 / np.linalg.norm(scale), rel=0.3)
