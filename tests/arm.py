"""An arm of one joint and the cheap trunk, and recordings of them with other parameters and hidden effects."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.effect import Effect
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.recording import Recording, Signal

ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.02"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/>
<site name="tip" pos="0.2 0 0"/></body></worldbody>
<actuator><position name="motor" joint="hinge" kp="2" kv="0.05" forcerange="-1 1"/></actuator></mujoco>"""
MAP = """
[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["motor"]
[signal]
name = "angle"
joints = ["hinge"]
unit = "rad"
[initial]
joints = ["hinge"]
[parameters.inertia]
fields = ["body_mass:arm", "body_inertia:arm"]
deviation = 0.2
[parameters.damping]
fields = ["dof_damping:hinge"]
deviation = 0.3
[parameters.zero]
fields = ["actuator_biasprm[0]:motor"]
add = true
unit = "N m"
deviation = 0.02
"""
TRUTH = np.array([[1.2, 0.8, 0.01]])
SIGMA = 5e-4  # rad, and m, of the noise
TRUNK_TRUTH = np.array([0.5, -0.4, -0.6, 0.3, 0.2])


def recording(paths: tuple[Path, Path], hidden: Sequence[Effect], seed: int, noise: float = SIGMA) -> Recording:
    """Of an arm with other parameters, half the time step and hidden effects."""
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-0.6, 0.6, 15), 15)[:, None]
    start = np.full((1, 1), 0.2)
    (values,) = ModelRobot(*paths, threads=1, shorter=2).simulate(goals, TRUTH, [hidden], start)
    values = np.concatenate([start[None], values]) + noise * rng.standard_normal((len(goals) + 1, 1, 1))
    times = 0.02 * np.arange(len(values))
    return Recording({"goal": Signal(times[:-1], goals)}, {"angle": Signal(times, values[:, 0, 0], "rad")})


def problem(
    paths: tuple[Path, Path],
    hidden: Sequence[Effect] = (),
    seed: int = 0,
    settings: Settings = DEFAULT,
    steps: int = 90,
    real: tuple[Path, Path] | None = None,
) -> Problem:
    """The beginning of a recording of the arm, or of another one, to be explained with the time step that it was
    simulated with."""
    robot = ModelRobot(*paths, threads=1, shorter=2)
    whole = robot.measured(recording(real or paths, hidden, seed))
    measured = replace(whole, actions=whole.actions[:steps], time=whole.time[:steps], values=whole.values[:steps])
    size = measured.values.size
    return Problem(robot, (measured,), SIGMA, np.ones(size), LowRank(np.zeros((0, size))), settings=settings)


def trunk_problem(
    robot: Robot, actions: np.ndarray, hidden: Sequence[Effect] = (), before_step: Callable | None = None
) -> Problem:
    """A recording of the robot with other parameters, hidden effects and noise."""
    parameters = np.array([[prior.value(x) for prior, x in zip(robot.priors, TRUNK_TRUTH, strict=True)]])
    values = robot.simulate(actions, parameters, [hidden], before_step=before_step)[0]
    values = values + SIGMA * np.random.default_rng(1).standard_normal(values.shape)
    measured = Measured(actions, 0.05 * np.arange(1, len(actions) + 1), values, "keypoints", "m")
    return Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))
