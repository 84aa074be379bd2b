"""The guess of a robot map: what it takes from a model and a recording, and that it can be used as it is."""

import tomllib

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.robots.guessed_map import guess_map
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import Recording, Signal
from tests.hand import HAND

STEPS = 40
TIME = 0.025 * np.arange(STEPS + 1)
# two joints, a motor and a servo, nothing but the servo has a name
NAMELESS = """<mujoco><worldbody><body><joint axis="0 1 0" damping="1"/><geom size="0.1"/>
<body pos="0.3 0 0"><joint axis="0 1 0"/><geom size="0.1"/><site/></body></body></worldbody>
<actuator><motor joint="a"/><position name="a b.c&quot;" joint="b" kp="3"/></actuator></mujoco>"""


@pytest.fixture
def guessed(tmp_path):
    """A function that guesses the map of a model, and gives its text, its table and its robot."""

    def guessed(recording: Recording | None = None, model: str = HAND) -> tuple[str, dict, ModelRobot]:
        path, mapping = tmp_path / "hand.xml", tmp_path / "map.toml"
        path.write_text(model)
        mapping.write_text(guess_map(path, recording))
        text = mapping.read_text()
        return text, tomllib.loads(text), ModelRobot(path, mapping, threads=1)

    return guessed


def recorded(values: float | np.ndarray = 0.0, name: str = "angles", **commands: np.ndarray) -> Recording:
    """Of a hinge that starts somewhere and turns by 1 rad; commands have a row per step."""
    turned = values + np.linspace(0.0, 1.0, STEPS + 1)
    given = {each: Signal(TIME[:-1], rows) for each, rows in commands.items()}
    return Recording(given, {name: Signal(TIME, turned, "rad")})


def test_a_guess_without_a_recording_can_be_used(guessed):
    text, table, robot = guessed()
    assert table["commands"]["action"]["actuators"] == ["motor", "gripper"]
    assert table["signal"]["joints"] == ["hinge"] and table["signal"]["unit"] == "rad"
    assert table["initial"]["keyframe"] == "home"
    assert {"mass", "damping", "position_gain"} == table["parameters"].keys()
    assert table["parameters"]["position_gain"]["fields"] == ["actuator_gainprm[0]:*", "actuator_biasprm[1]:*"]
    assert "sites of the model: tip, corner" in text and "sensors of the model: turn, felt, torque, #3" in text
    assert robot.notes == ("mocap bodies stay where the model has them: target",)


def test_a_guess_takes_names_and_the_control_step_from_a_recording(guessed):
    """A command may be called as the joint that its actuator moves, or by more words."""
    _, table, robot = guessed(recorded(gripper_goal=np.zeros(STEPS), Hinge=np.zeros(STEPS)))
    found = {name: entry["actuators"] for name, entry in table["commands"].items()}
    assert found == {"gripper_goal": ["gripper"], "Hinge": ["motor"]}
    assert table["robot"]["control_timestep"] == pytest.approx(0.025)
    assert robot.simulation.model.opt.timestep == pytest.approx(0.025 / 13)


@pytest.mark.parametrize(
    ("start", "initial"),
    [(0.5, {"keyframe": "home"}), (0.0, {"keyframe": ""}), (-2.0, {"keyframe": "home", "joints": ["hinge"]})],
)
def test_a_guess_begins_where_the_recording_does(guessed, start, initial):
    """At the nearest keyframe or the default position, if it is near; else at the first sample, others as there."""
    recording = recorded(start, action=np.zeros((STEPS, 2)))
    _, table, robot = guessed(recording)
    assert table["initial"] == initial
    assert robot.measured(recording).start.size == 1


def test_markers_begin_at_the_joints_that_were_recorded_too(guessed):
    recording = recorded(-2.0, action=np.zeros((STEPS, 2)))
    markers = Signal(TIME, np.zeros((STEPS + 1, 2, 3)) + TIME[:, None, None], "m", "world")
    both = Recording(recording.commands, {"markers": markers, **recording.signals})
    _, table, _ = guessed(both)
    assert table["signal"]["name"] == "angles"
    tip = Signal(TIME, markers.values[:, 0], "m", "world")
    only = Recording(recording.commands, {"tip": tip, **recording.signals})
    _, table, robot = guessed(only)
    assert table["signal"] == {"name": "tip", "sites": ["tip"], "unit": "m", "frame": "world"}
    assert table["initial"]["signals"] == {"angles": {"joints": ["hinge"]}}
    assert robot.measured(only).start.tolist() == [-2.0]


def test_velocities_are_a_comment_where_the_recording_begins_elsewhere(guessed):
    recording = recorded(-2.0, action=np.zeros((STEPS, 2)))
    speed = Signal(TIME, np.ones(STEPS + 1), "rad/s")
    text, _, _ = guessed(Recording(recording.commands, {**recording.signals, "speed": speed}))
    assert '# [initial.signals.speed]   # if the robot moves then\n# velocities = ["hinge"]' in text


def test_what_could_not_be_matched_is_a_comment(guessed):
    """And actuators without a command, to be given constant controls."""
    recording = recorded(motor=np.zeros(STEPS), other=np.zeros((STEPS, 3)))
    text, table, robot = guessed(recording)
    assert table["commands"].keys() == {"motor"}
    assert "# command 'other' has 3 columns; say which actuators they move:" in text
    assert "# [fixed]\n# gripper = 0.0" in text
    assert any(note.startswith("no command drives gripper") for note in robot.notes)


def test_commands_that_come_only_where_they_change_do_not_set_the_control_step(guessed):
    rare = Recording({"motor": Signal(TIME[::20], np.arange(3.0))}, recorded().signals)
    assert guessed(rare)[1]["robot"]["control_timestep"] == pytest.approx(0.025)


def test_unnamed_elements_are_called_by_number_and_names_are_quoted(guessed):
    joints = NAMELESS.replace('<joint axis="0 1 0" damping="1"/>', '<joint name="a" axis="0 1 0" damping="1"/>')
    joints = joints.replace('<joint axis="0 1 0"/>', '<joint name="b" axis="0 1 0"/>')
    _, table, robot = guessed(None, joints)
    assert table["commands"]["action"]["actuators"] == ["#0", 'a b.c"']
    assert table["parameters"]["motor_gain"]["fields"] == ["actuator_gainprm[0]:#0"]
    assert robot.actuator_names == ["0 of hand", 'a b.c"']


def test_the_command_writes_a_map_says_what_it_leaves_open_and_keeps_what_is_there(tmp_path, call):
    model, out, run = tmp_path / "hand.xml", tmp_path / "map.toml", tmp_path / "run.parquet"
    model.write_text(HAND)
    save(recorded(motor=np.zeros(STEPS)), run)
    said = call("map", model, run, "--out", out)
    assert "check every line" in said and "note: no command drives gripper" in said
    assert tomllib.loads(out.read_text())["commands"]["motor"]["actuators"] == ["motor"]
    with pytest.raises(SystemExit, match=r"map.toml exists, and may be corrected already"):
        call("map", model, run, "--out", out)
    save(recorded(other=np.zeros((STEPS, 3))), run)
    said = call("map", model, run, "--out", tmp_path / "second.toml")
    assert "to correct before it can be used: the mapping has no [commands.<name>]" in said
