"""Signals that stand still, and commands that nothing follows: told from physics by replays of the nominal robot."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.recording.recording import NOTES, Recording, RecordingError, Signal
from tests.arm import ARM, MAP, recording

LINK = """<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0" damping="0.05"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/>{2}</body>"""
TWO = f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
{LINK.format("upper", 0, LINK.format("fore", 0.2, ""))}</worldbody><actuator>
<position name="first" joint="upper" kp="4"/><position name="second" joint="fore" kp="2"/></actuator></mujoco>"""
OF_TWO = """[robot]
control_timestep = 0.02
[commands.goals]
actuators = ["first", "second"]
[signal]
name = "angles"
joints = ["upper", "fore"]
unit = "rad"
[parameters.damping]
fields = ["dof_damping:*"]
deviation = 0.3
"""
NOISE = 5e-4  # rad


@pytest.fixture
def robot(tmp_path):
    for name, text in (("two.xml", TWO), ("two.toml", OF_TWO)):
        (tmp_path / name).write_text(text)
    return ModelRobot(tmp_path / "two.xml", tmp_path / "two.toml", threads=1)


def measured(robot, arrived=lambda goals: goals):
    """Noisy angles of a robot with more damping, whose motors get what arrives of the recorded goals."""
    rng = np.random.default_rng(1)
    goals = np.repeat(rng.uniform(-0.5, 0.5, (12, 2)), 12, axis=0)
    (values,) = robot.simulate(arrived(goals), np.array([[1.3]]), [()])
    values = np.concatenate([np.zeros((1, 2, 1)), values]) + NOISE * rng.standard_normal((len(goals) + 1, 2, 1))
    times = 0.02 * np.arange(len(values))
    signals = {"angles": Signal(times, values, "rad")}
    return robot.measured(Recording({"goals": Signal(times[:-1], goals)}, signals))


def test_a_healthy_robot_answers_to_every_command(robot):
    whole = measured(robot)
    found = answered(whole, 0, robot)
    assert found.findings == ()
    assert np.array_equal(found.measured.values, whole.values)


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_a_sensor_that_stands_still_is_left_out(robot, noise):
    """The other joint moves as if this one did too, so its command has arrived."""
    whole = measured(robot)
    still = 0.1 + noise * np.random.default_rng(2).standard_normal(len(whole.time))
    values = np.stack([whole.values[:, 0], still[:, None]], axis=1)
    found = answered(replace(whole, values=values), 3, robot)
    (finding,) = found.findings
    assert (finding.name, finding.recording, finding.samples) == ("unmoved", 3, len(still))
    assert finding.share == 0.5
    assert "angles, point 1" in finding.text
    assert np.isnan(found.measured.values[:, 1]).all()
    assert np.array_equal(found.measured.values[:, 0], whole.values[:, 0])


def test_a_command_that_never_arrives_is_held(robot):
    found = answered(measured(robot, lambda goals: goals * [0.0, 1.0]), 0, robot)
    (finding,) = found.findings
    assert (finding.name, finding.signal) == ("unanswered_command", "actuator first")
    assert not found.measured.actions[:, 0].any()
    assert np.ptp(found.measured.actions[:, 1]) > 0


@pytest.mark.parametrize("arrived", [lambda goals: goals * [0.6, 1.0], lambda goals: goals[:, ::-1]])
def test_a_weak_motor_or_swapped_commands_are_none_that_never_arrive(robot, arrived):
    assert answered(measured(robot, arrived), 0, robot).findings == ()


def test_a_command_that_never_changes_is_said(robot):
    whole = measured(robot, lambda goals: goals * [1.0, 0.0])
    constant = replace(whole, actions=whole.actions * [1.0, 0.0])
    (finding,) = answered(constant, 0, robot).findings
    assert (finding.name, finding.signal, finding.share) == ("constant_command", "actuator second", 0.5)


@pytest.fixture
def arm(tmp_path):
    paths = tmp_path / "arm.xml", tmp_path / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    return paths


def test_a_whole_signal_that_stands_still_is_refused_in_one_sentence(arm):
    whole = recording(arm, (), 0)
    angle = whole.signals["angle"]
    still = replace(whole, signals={"angle": replace(angle, values=np.full(len(angle.time), 0.2))})
    with pytest.raises(RecordingError, match="recording 1: angle: all of the samples stay within 0 rad although"):
        diagnose(ModelRobot(*arm, threads=1), [still])


def test_what_an_import_has_changed_is_told_with_the_data(arm):
    whole = recording(arm, (), 0)
    noted = replace(whole, metadata={NOTES: "signals.angle: 3 cells were empty\nlast line, 9, was cut"})
    plain, result = (diagnose(ModelRobot(*arm, threads=1), [each]) for each in (whole, noted))
    assert [(f.name, f.signal, f.recording) for f in result.data] == [("import", "angle", 0), ("import", "", 0)]
    assert result.verdict == plain.verdict
    assert result.train == plain.train
