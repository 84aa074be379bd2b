"""An arm of one joint, a hand with a ball and a box, and the cheap trunk: recordings of them with other parameters and
hidden effects, and what MuJoCo alone simulates."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
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
HAND = """<mujoco><compiler angle="degree"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" range="-170 170" damping="0.05"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.3 0 0" mass="0.2"/>
<body name="hand" pos="0.3 0 0"><geom size="0.02" mass="0.1"/><site name="tip"/>
<body name="finger" pos="0.05 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 0.1" damping="5"/>
<geom size="0.01" mass="0.02"/></body></body></body>
<body name="ball" pos="0 1 1"><joint name="ball" type="ball" damping="0.01"/>
<geom pos="0.1 0 0" size="0.02" mass="0.1"/></body>
<body name="box" pos="0 2 1"><freejoint name="free"/><geom type="box" size="0.1 0.1 0.1" mass="1"/><site name="corner"/>
</body>
<body name="target" mocap="true" pos="1 0 1"/>
</worldbody>
<actuator><position name="motor" joint="hinge" kp="8" kv="0.5" ctrlrange="-1 1" ctrllimited="true"/>
<position name="gripper" joint="slide" kp="100" ctrlrange="0 0.1" ctrllimited="true"/></actuator>
<sensor><framequat name="turn" objtype="body" objname="ball"/><accelerometer name="felt" site="tip"/>
<jointactuatorfrc name="torque" joint="hinge"/><jointpos joint="hinge"/></sensor>
<keyframe><key name="home" qpos="0.5 0.04  0.7071068 0 0.7071068 0  0 2 1 1 0 0 0" ctrl="0.5 0.04"/></keyframe>
</mujoco>"""
HAND_MAP = (
    MAP.split("[initial]")[0]
    + """[parameters.inertia]
fields = ["body_mass:arm", "body_inertia:arm"]
deviation = 0.2
"""
)
SIGNAL = 'name = "angle"\njoints = ["hinge"]\nunit = "rad"'
NOMINAL = np.array([[1.0]])
TRUTH = np.array([[1.2, 0.8, 0.01]])
SIGMA = 5e-4  # rad, and m, of the noise
TRUNK_TRUTH = np.array([0.5, -0.4, -0.6, 0.3, 0.2])


def recording(
    paths: tuple[Path, Path], hidden: Sequence[Effect], seed: int, noise: float = SIGMA, truth: np.ndarray = TRUTH
) -> Recording:
    """Of an arm with other parameters, half the time step and hidden effects."""
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-0.6, 0.6, 15), 15)[:, None]
    start = np.full((1, 1), 0.2)
    (values,) = ModelRobot(*paths, threads=1, shorter=2).simulate(goals, truth, [hidden], start)
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


def with_initial(text: str) -> str:
    return f"{HAND_MAP}\n[initial]\n{text}"


def goals(values, step=0.02) -> Signal:
    return Signal(step * np.arange(len(values)), np.asarray(values, float)[:, None], "rad")


def plain(model_text: str, controls, steps: int, timestep: float | None = None, keyframe: int = -1) -> list[tuple]:
    """What MuJoCo alone simulates: positions, sensors and the site "tip" after each control step."""
    model = mujoco.MjModel.from_xml_string(model_text)
    model.opt.timestep = timestep or model.opt.timestep
    data = mujoco.MjData(model)
    if keyframe >= 0:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    states = []
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, steps)
        mujoco.mj_forward(model, data)
        states.append((data.qpos.copy(), data.sensordata.copy(), data.site("tip").xpos.copy()))
    return states


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """A file with up to three bytes changed, some lost, some repeated, or its end cut off."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        i, size, change = rng.integers(len(data) + 1), rng.integers(1, 20), rng.integers(4)
        if change == 0:
            data[i : i + 1] = bytes([rng.integers(256)])
        elif change == 1:
            del data[i : i + size]
        elif change == 2:
            data[i:i] = data[i : i + size]
        else:
            del data[i:]
    return bytes(data)


def says(*parts: str) -> str:
    """A pattern for a message in which ``parts`` follow one another."""
    return "(?s)" + ".*".join(re.escape(part) for part in parts)


def example() -> Recording:
    """Irregular times, several rates, missing samples, arrays, and numbers that only their bits tell apart."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.001, 0.1, 50))
    points = rng.normal(size=(50, 4, 3))
    points[3, 1, 2], points[7] = np.nan, np.nan
    signals = {
        "points": Signal(times, points, "m", "world"),
        "force": Signal(np.array([0.0, 0.25, times[20]]), np.array([1.0, -0.0, 5e-324]), "N"),
        "once": Signal(np.array([1 / 3]), np.array([[[1, 2], [3, 4]]]), "rad"),
    }
    commands = {
        "action": Signal(times[:-1], rng.normal(size=(49, 2))),
        "pump": Signal(np.array([0.5, 0.6]), np.array([1, 0]), "Pa"),
    }
    return Recording(commands, signals, {"trunk_mass": 0.1 + 0.2}, {"robot": "trunk no. 3, größer"})


def assert_same(a: Recording, b: Recording) -> None:
    """Equal to the last bit."""
    for group in ("commands", "signals"):
        first, second = getattr(a, group), getattr(b, group)
        assert first.keys() == second.keys()
        for name in first:
            x, y = first[name], second[name]
            assert (x.unit, x.frame, x.values.shape) == (y.unit, y.frame, y.values.shape)
            assert x.time.tobytes() == y.time.tobytes()
            assert x.values.tobytes() == y.values.tobytes()
    assert (a.parameters, a.metadata) == (b.parameters, b.metadata)
