"""Models as files have them, and mappings of recordings to models: what is refused, in words, and what is guessed."""

import re
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
from tests import arm
from tests.arm import HAND, HAND_MAP, NOMINAL, SIGNAL, plain


def test_quaternions_have_no_unit(paths):
    model, mapping = paths
    quaternion = '<sensor><framequat name="s" objtype="body" objname="arm"/></sensor></mujoco>'
    model.write_text(arm.ARM.replace("</mujoco>", quaternion))
    mapping.write_text(arm.MAP.replace('joints = ["hinge"]\nunit', 'sensors = ["s"]\nunit', 1))
    with pytest.raises(ModelError, match=r"unit is 'rad'; quaternions have \"1\""):
        ModelRobot(model, mapping)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('actuators = ["motor"]', 'actuators = ["engine"]', "no actuator 'engine'"),
        ('joints = ["hinge"]\nunit', 'joints = ["elbow"]\nunit', "no joint 'elbow'"),
        ('unit = "rad"', "", "needs a name, a unit"),
        ("control_timestep = 0.02", "control_timestep = 0", "control_timestep is 0; expected a number"),
        ("[robot]", '[robot]\nctrlrange = "wide"', "[robot] ctrlrange is 'wide'; expected \"widen\""),
        ('["motor"]', '["motor"]\nctrlrange = 3', "[commands.goal] ctrlrange is 3; expected"),
        ("[signal]", "[fixed]\nmotor = 0.1\n[signal]", "[fixed] motor: actuator motor has a command"),
        ("[signal]", "[fixed]\nengine = 0.1\n[signal]", "no actuator 'engine'; it has motor"),
        ("[signal]", '[fixed]\nmotor = "open"\n[signal]', "[fixed] motor is 'open'; expected a number"),
        ("[initial]", '[initial]\nkeyframe = "home"', "keyframe is 'home'; the model has no keyframes"),
        ("[initial]", "[initial.signals.speed]\n[initial]", "needs joints or velocities"),
        ("[initial]", '[initial.signals.a]\njoints = ["hinge"]\n[initial]', "two positions or two velocities"),
        ("[initial]", '[initial.signals.a]\nvelocities = ["elbow"]\n[initial]', "no joint 'elbow'; it has hinge"),
        ('joints = ["hinge"]\nunit', 'joints = ["#3"]\nunit', "no joint '#3'; it has hinge"),
        ("control_timestep = 0.02", "timestep = 0.02", "unknown entry 'timestep'"),
        ("dof_damping:hinge", "dof_frictionloss:hinge", "dof_frictionloss:hinge is 0 in the model"),
        ("body_mass:arm", "body_weight:arm", "expected field:element"),
        ("actuator_biasprm[0]:motor", "actuator_biasprm[99]:motor", "no column 99"),
        ("body_mass:arm", "body_mass:leg*", "no body of the model is called 'leg*'"),
        ("deviation = 0.2", 'deviation = "large"', "expected a number"),
        ("[robot]", "[robot", "no TOML file"),
        ("[robot]", "[robot]\naccurate = 3", "accurate is 3; expected a model"),
        ("[robot]", '[robot]\naccurate = "finer.xml"', "accurate is 'finer.xml'; expected a model"),
        (
            "[initial]",
            '[settings.gain]\nfields = ["actuator_gainprm[0]:motor"]\n[initial]',
            "either metadata or command",
        ),
        ('[initial]\njoints = ["hinge"]', "[initial]\njoints = 5", "[initial] joints is 5; expected a list"),
        ('"body_mass:arm"', '"body:arm"', "'body:arm'; expected field:element"),
        ('"body_mass:arm"', '"body_parentid:arm"', "body_parentid is no number that a model is made of"),
        ('"body_mass:arm"', '"body_subtreemass:arm"', "body_subtreemass is no number"),
        ('actuators = ["motor"]', 'actuators = ["motor"]\nscale = 0.001', "unknown entry 'scale' in [commands.goal]"),
        ('actuators = ["motor"]', 'actuators = ["motor", "motor"]', "expected each name once"),
        ("[signal]", '[commands.other]\nactuators = ["#0"]\n[signal]', "'#0', which has a command already"),
        ('[commands.goal]\nactuators = ["motor"]', "", "say what moves them"),
        ("add = true", 'add = "false"', "add is 'false'; expected true or false"),
        ("[initial]", '[settings.zero]\ncommand = "a"\nfields = ["dof_damping:*"]\n[initial]', "name of a setting"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused_in_words(paths, old, new, message):
    model, mapping = paths
    mapping.write_text(arm.MAP.replace(old, new, 1))
    with pytest.raises(ModelError, match=re.escape(message)):
        ModelRobot(model, mapping)


def test_an_actuator_that_is_not_there_is_refused_with_those_that_are(paths):
    paths[1].write_text(arm.MAP.replace('["motor"]', '["moter"]', 1))
    with pytest.raises(ModelError, match=r"\[commands.goal\]: the model has no actuator 'moter'; it has motor"):
        ModelRobot(*paths, threads=1)


def test_setpoints_are_in_the_unit_of_the_mapping_or_else_of_the_model(paths):
    assert ModelRobot(*paths, threads=1).setpoint_unit == "rad"
    paths[1].write_text(arm.MAP.replace('["motor"]', '["motor"]\nunit = "deg"', 1))
    assert ModelRobot(*paths, threads=1).setpoint_unit == "deg"


def test_a_finer_model_outside_the_folder_of_the_mapping_is_refused(paths):
    model, mapping = paths
    inner = mapping.parent / "inner"
    inner.mkdir()
    moved = inner / mapping.name
    moved.write_text(arm.MAP.replace("[robot]", f'[robot]\naccurate = "../{model.name}"', 1))
    with pytest.raises(ModelError, match="in the folder of the mapping, or below it"):
        ModelRobot(model, moved)


def test_a_file_that_is_no_model_is_refused(paths):
    model, mapping = paths
    model.write_text("<mujoco><worldbody><bdy/></worldbody></mujoco>")
    with pytest.raises(ModelError, match="no MuJoCo model"):
        ModelRobot(model, mapping)
    with pytest.raises(ModelError, match="no model"):
        ModelRobot(model.with_name("other.xml"), mapping)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<option timestep="1e-300"/><worldbody>', "timestep is 1e-300 s; allowed is 1e-06 to 1 s"),
        ("<worldbody>", '<option timestep="0"/><worldbody>', r"timestep is 0\.0 s"),
        ("<worldbody>", '<option gravity="nan 0 0"/><worldbody>', "opt.gravity is not a number"),
    ],
)
def test_a_model_that_cannot_be_simulated_is_refused(paths, old, new, message):
    model, mapping = paths
    model.write_text(model.read_text().replace(old, new, 1))
    with pytest.raises(ModelError, match=message):
        ModelRobot(model, mapping)


def test_a_mapping_of_lists_in_lists_is_refused(paths):
    model, mapping = paths
    mapping.write_text("robot = " + "[" * 100_000)
    with pytest.raises(ModelError, match="no TOML file"):
        ModelRobot(model, mapping)


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
    robot = robot_of(HAND_MAP.replace(":arm", ":a").replace(SIGNAL, 'name = "tip"\nsites = ["tip"]\nunit = "m"'), model)
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
        robot_of(HAND_MAP, HAND.replace(old, new, 1))
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
    assert np.isnan(robot_of(HAND_MAP, stiff).simulate(np.tile([1.0, 0.0], (50, 1)), NOMINAL, [()])).any()
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_model_in_which_nothing_moves_is_refused(robot_of):
    with pytest.raises(ModelError, match="nothing moves in it"):
        robot_of(HAND_MAP, "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")


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
    robot = robot_of(HAND_MAP, model.replace(hand + site, f'type="mesh" mesh="w" mass="0.1"/>{site}'))
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


def test_a_guess_matches_commands_by_their_units(guessed):
    """Where names say nothing, the first command went to the first actuator, an opening [m] to a hinge."""
    given = {"first": Signal(TIME[:-1], np.zeros(STEPS), "m"), "second": Signal(TIME[:-1], np.zeros(STEPS), "rad")}
    text, table, _ = guessed(Recording(given, recorded().signals))
    assert {name: entry["actuators"] for name, entry in table["commands"].items()} == {
        "first": ["gripper"],
        "second": ["motor"],
    }
    assert "[commands.first]   # matched by unit: check the order" in text


def test_a_guess_scales_the_rest_of_a_servo_with_its_gain(guessed):
    """Else a winch of 1200 (u + 0.12 - x) N at another gain would be at rest elsewhere."""
    winch = '<general joint="hinge" biastype="affine" gainprm="1200" biasprm="144 -1200"/>'
    _, table, _ = guessed(model=re.sub('<position name="motor"[^>]*>', winch, HAND))
    assert "actuator_biasprm[0]:*" in table["parameters"]["position_gain"]["fields"]


@pytest.mark.parametrize(
    ("start", "initial"),
    [(0.5, {"keyframe": "home"}), (0.0, {"keyframe": ""}), (-2.0, {"keyframe": "home", "joints": ["hinge"]})],
)
def test_a_guess_begins_where_the_recording_does(guessed, start, initial):
    """At the nearest keyframe or the default position, if it is near; else at the first sample, others as there."""
    recording = recorded(start, action=np.zeros((STEPS, 2)))
    _, table, robot = guessed(recording)
    assert table["initial"] == initial
    assert (robot.measured(recording).start is not None) == ("joints" in initial)


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


def test_joints_of_several_signals_begin_at_their_own_first_samples(guessed):
    angle = recorded(-2.0, action=np.zeros((STEPS, 2)))
    way = Signal(TIME, 0.09 - 0.05 * np.linspace(0.0, 1.0, STEPS + 1), "m")
    both = Recording(angle.commands, {"hinge": angle.signals["angles"], "slide": way})
    _, table, robot = guessed(both)
    assert table["signal"]["name"] == "hinge" and table["initial"]["joints"] == ["hinge"]
    assert table["initial"]["signals"] == {"slide": {"joints": ["slide"]}}
    assert robot.measured(both).start.ravel().tolist() == [-2.0, 0.09]


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


def test_another_signal_that_matches_may_be_explained_too(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    tip = Signal(TIME, np.zeros((STEPS + 1, 3)), "m", "world")
    text = guess_map(tmp_path / "hand.xml", Recording({}, {**recorded(name="hinge").signals, "tip": tip}))
    assert """# instead, or also in [[signals]], 'tip': sites = ["tip"]""" in text


def test_signals_that_nothing_is_called_like_are_listed(tmp_path):
    """And where no command was recorded, the control step does not say that commands are rare."""
    strange = {name: Signal(TIME, np.zeros((STEPS + 1, 5))) for name in ("one", "two")}
    (tmp_path / "hand.xml").write_text(HAND)
    text = guess_map(tmp_path / "hand.xml", Recording({}, {**recorded().signals, **strange}))
    assert "# signals that nothing in the model is called like: one, two" in text
    assert "the spacing of the signal, as no command was recorded" in text


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
