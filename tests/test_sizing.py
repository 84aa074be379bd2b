"""Typical magnitudes of candidate terms that suit the misfit."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.forward_selection import nominal_fit
from soro_bench.diagnosis.selection.screening import evidence, responses, singles
from soro_bench.diagnosis.selection.sizing import sized
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import SIGMA

PENDULUM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="1e-4"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.1" contype="0" conaffinity="0"/></body></worldbody>
</mujoco>"""
MAP = """
[robot]
control_timestep = 0.02
[signal]
name = "angle"
joints = ["hinge"]
unit = "rad"
[initial]
joints = ["hinge"]
[parameters.damping]
fields = ["dof_damping:hinge"]
deviation = 0.3
"""
TRUTH = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 2e-4, "presliding": 1e-3})


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """(problem, fit, robot): a pendulum whose friction is a 16th of the typical one, and stops it no earlier."""
    folder = tmp_path_factory.mktemp("pendulum")
    paths = folder / "arm.xml", folder / "map.toml"
    for path, text in zip(paths, (PENDULUM, MAP), strict=True):
        path.write_text(text)
    robot = ModelRobot(*paths, threads=1)
    still, start = np.zeros((250, 0)), np.full((1, 1), 1.0)
    (values,) = robot.simulate(still, np.ones((1, 1)), [(TRUTH,)], start)
    values += SIGMA / 100 * np.random.default_rng(0).standard_normal(values.shape)
    measured = replace(_measured(robot, still, values), start=start)
    problem = Problem(robot, (measured,), SIGMA / 100, np.ones(values.size), LowRank(np.zeros((0, values.size))))
    return *nominal_fit(problem, [], 0), robot


def _measured(robot, actions, values):
    from soro_bench.diagnosis.robots.measured import Measured

    return Measured(actions, robot.control_timestep * np.arange(1, len(values) + 1), values, "angle", "rad")


def test_a_friction_far_below_the_typical_one_is_predicted_to_explain_most_once_it_is_sized(swing):
    problem, fit, robot = swing
    assert problem.misfit_dominated
    candidates = terms(robot)
    found = sized(problem, fit, candidates, robot)
    pairs = {a.name: (a, b) for a, b in zip(candidates, found, strict=True) if a.location == TRUTH.location}
    before, after = pairs["coulomb_friction"]
    assert after.typical[0] < 0.3 * before.typical[0] and after.typical[1] == before.typical[1]
    best = singles(evidence(problem, fit, found, responses(problem, fit, found, robot)))[0]
    (effect,) = best.effects
    assert effect.name in ("coulomb_friction", "stribeck_friction")  # which are alike but near standstill
    assert effect.parameters["friction"] == pytest.approx(2e-4, rel=0.5)


def test_a_robot_without_commands_has_no_clock_to_differ_from_its_sensor(swing):
    *_, robot = swing
    names = {term.name for term in terms(robot)}
    assert not names & {"sensor_delay", "clock_skew"} and "sensor_bias" in names


def test_nothing_is_sized_where_noise_is_all_that_is_left(swing):
    problem, fit, robot = swing
    candidates = terms(robot)
    assert sized(problem.allowing(0.0), fit, candidates, robot) == candidates
