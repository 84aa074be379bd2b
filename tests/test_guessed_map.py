"""Models as files have them, and the robot map that is guessed from one."""

import tomllib

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.robots.guessed_map import guess_map
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.models.simulation import quiet
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import Recording, Signal
from tests.hand import HAND, MAP, NOMINAL, SIGNAL, plain

_PENDULUM = """<mujoco><option timestep="0.005"/><default><geom contype="0" conaffinity="0"/></default><worldbody>{0}
<body name="a" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping="0.1"/><geom type="capsule" size="0.02"
fromto="0 0 0 0.3 0 0" mass="1"/><site name="tip" pos="0.3 0 0"/>{1}</body></worldbody>{2}
<actuator><motor name="motor" joint="hinge" gear="2"/></actuator></mujoco>"""
_SECOND = '<body name="b" pos="0.3 0 0"><joint name="second" axis="0 1 0"/><geom size="0.05" mass="0.5"/></body>'
_SHEET = """<flexcomp name="sheet" type="grid" count="3 3 1" spacing="0.05 0.05 0.1" pos="0 1 1" dim="2" mass="0.1"
radius="0.001"><edge equality="true"/><pin id="0"/></flexcomp>"""
_COPIES = """<replicate count="3" offset="0 0.3 0"><body pos="0 1 1"><joint axis="0 1 0"/>
<geom size="0.05" pos="0.1 0 0"/></body></replicate>"""
_BOX = """<body pos="0.2 0 0.5"><freejoint/><geom type="box" size="0.1 0.1 0.1" contype="1" conaffinity="1"/></body>
<geom type="plane" size="1 1 1" contype="1" conaffinity="1"/>"""
_TENDON = """<tendon><fixed limited="true" range="-0.2 0.2" stiffness="3" damping="0.1"><joint joint="hinge" coef="1"/>
<joint joint="second" coef="1"/></fixed></tendon>"""
_GEARED = '<equality><joint joint1="second" joint2="hinge" polycoef="0 -1 0 0 0"/></equality>'
_LINKED = '<equality><connect body1="b" body2="world" anchor="0 0 0"/></equality>'
_MOCAP, _HELD = '<body name="m" mocap="true" pos="0.3 0 1"/>', '<equality><weld body1="m" body2="a"/></equality>'
_KINDS = {  # what is added to the world, to the arm, and beside the world
    "joint equality": ("", _SECOND, _GEARED),
    "connected": ("", _SECOND, _LINKED),
    "mocap weld": (_MOCAP, "", _HELD),
    "tendon": ("", _SECOND, _TENDON),
    "falling box": (_BOX, "", ""),
    "replicated": (_COPIES, "", ""),
    "flex": (_SHEET, "", ""),
}


@pytest.mark.parametrize("kind", _KINDS)
def test_models_of_all_kinds_move_as_mujoco_alone_moves_them(robot_of, kind):
    model = _PENDULUM.format(*_KINDS[kind])
    robot = robot_of(MAP.replace(":arm", ":a").replace(SIGNAL, 'name = "tip"\nsites = ["tip"]\nunit = "m"'), model)
    controls = np.sin(np.arange(50) / 5)[:, None]
    (values,) = robot.simulate(controls, NOMINAL, [()])
    np.testing.assert_allclose(values[:, 0], [state[2] for state in plain(model, controls, 4)], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<extension><plugin plugin="no.such"/></extension><worldbody>', "install that plugin"),
        ("<worldbody>", '<asset><mesh name="m" file="there_is_none.stl"/></asset><worldbody>', "needs the files"),
        ("<worldbody>", '<include file="nowhere.xml"/><worldbody>', "needs the files"),
        ("<worldbody>", "<worldbody><bdy/>", "no MuJoCo model"),
    ],
)
def test_what_mujoco_says_of_a_model_is_one_line(robot_of, tmp_path, monkeypatch, old, new, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=message) as caught:
        robot_of(MAP, HAND.replace(old, new, 1))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_mujoco_stays_quiet_until_the_last_caller_has_ended():
    """A handler that ends under the simulations of another thread would log their warnings to a file."""
    before = mujoco.get_mju_user_warning()
    with quiet():
        during = mujoco.get_mju_user_warning()
        with quiet():
            assert mujoco.get_mju_user_warning() is during
        assert mujoco.get_mju_user_warning() is during is not before
    assert mujoco.get_mju_user_warning() is before


def test_a_replay_that_diverges_logs_nothing(robot_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stiff = HAND.replace('kp="8" kv="0.5"', 'kp="1e7" kv="0"').replace("implicitfast", "Euler")
    assert np.isnan(robot_of(MAP, stiff).simulate(np.tile([1.0, 0.0], (50, 1)), NOMINAL, [()])).any()
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_model_in_which_nothing_moves_is_refused(robot_of):
    with pytest.raises(ModelError, match="nothing moves in it"):
        robot_of(MAP, "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")


def test_included_files_and_meshes_in_folders_are_found(robot_of, tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(
        f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces
    )
    (tmp_path / "meshes" / "wedge.obj").write_text(text)
    (tmp_path / "parts" / "assets.xml").write_text('<mujoco><asset><mesh name="w" file="wedge.obj"/></asset></mujoco>')
    model = HAND.replace("<worldbody>", '<include file="parts/assets.xml"/><worldbody>', 1)
    model = model.replace('angle="degree"', 'angle="degree" meshdir="meshes"')
    hand, site = 'size="0.02" mass="0.1"/>', '<site name="tip"/>'
    robot = robot_of(MAP, model.replace(hand + site, f'type="mesh" mesh="w" mass="0.1"/>{site}'))
    assert np.isfinite(robot.simulate(np.zeros((5, 2)), NOMINAL, [()])).all()


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
