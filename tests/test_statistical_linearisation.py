"""Linear models over samples, and how well fitted unknowns are known: answers of linear algebra and simulations."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.gauss_newton import descended
from soro_bench.diagnosis.estimation.posterior_covariance import with_covariance
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.inference.continuation import refine
from soro_bench.inference.search import EvaluationLog
from soro_bench.inference.statistical_linearisation import LowRank, linearised, sample_around
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize("rank", [0, 3])
def test_products_are_those_of_the_dense_inverse(rng, rank):
    basis, a, b = rng.normal(size=(rank, 20)), rng.normal(size=(2, 20)), rng.normal(size=(4, 20))
    dense = np.linalg.inv(np.eye(20) + basis.T @ basis)
    assert LowRank(basis).product(a, b) == pytest.approx(a @ dense @ b.T)
    assert LowRank(basis).without(a[0]) == pytest.approx(dense @ a[0])


def test_a_linear_function_is_found_exactly_and_leaves_no_error(rng):
    jacobian, at, x = rng.normal(size=(3, 50)), rng.normal(size=50), rng.normal(size=3)
    points = sample_around(x, 0.1, 12, [0, 1])
    line = linearised(x, points, at + (points - x) @ jacobian)
    assert line.residual == pytest.approx(at)
    assert line.jacobian == pytest.approx(jacobian)
    assert np.abs(line.error).max() < 1e-12


def test_a_rugged_function_has_an_error_of_its_ruggedness(rng):
    points = sample_around(np.zeros(2), 0.1, 64, [0])
    rough = 0.3 * rng.standard_normal((64, 200))
    line = linearised(np.zeros(2), points, points @ rng.normal(size=(2, 200)) + rough)
    assert np.sqrt((line.error**2).sum(axis=0).mean()) == pytest.approx(0.3, rel=0.05)


def test_polishing_leaves_a_local_optimum_of_a_rugged_replay():
    truth, deviation = np.array([0.4, 0.6]), np.full((30, 4), 1e-3)
    basis = np.random.default_rng(1).normal(size=(2, 30, 4))

    def residuals(points, steps):
        offset = points - truth
        ripples = 0.003 * np.sin(400 * offset).sum(axis=1)[:, None, None]
        return (np.tensordot(offset, basis, axes=1) + ripples)[:, :steps]

    start = truth + 0.03
    cost = np.log1p((residuals(start[None], 30)[0] / deviation) ** 2).sum()
    found, lower = refine(residuals, deviation, [slice(0, 4)], start, cost, EvaluationLog(None, ""), [0])
    assert np.abs(found - truth).max() < 0.002
    assert lower < cost


def test_a_basis_explains_no_more_than_it_is_likely_to(rng):
    """Of what it would have to be ten times as large for, three times its size."""
    basis = rng.standard_normal((1, 1000))
    assert LowRank(basis).without(10.0 * basis[0]) == pytest.approx(7.0 * basis[0], rel=1e-3)


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
