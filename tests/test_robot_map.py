"""Mappings of recordings to models: what is refused, in words."""

import re

import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot_map import ModelError
from tests.arm import ARM, MAP


@pytest.fixture
def paths(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path / "arm.xml", tmp_path / "map.toml"


def test_quaternions_have_no_unit(paths):
    model, mapping = paths
    quaternion = '<sensor><framequat name="s" objtype="body" objname="arm"/></sensor></mujoco>'
    model.write_text(ARM.replace("</mujoco>", quaternion))
    mapping.write_text(MAP.replace('joints = ["hinge"]\nunit', 'sensors = ["s"]\nunit', 1))
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
    mapping.write_text(MAP.replace(old, new, 1))
    with pytest.raises(ModelError, match=re.escape(message)):
        ModelRobot(model, mapping)


def test_an_actuator_that_is_not_there_is_refused_with_those_that_are(paths):
    paths[1].write_text(MAP.replace('["motor"]', '["moter"]', 1))
    with pytest.raises(ModelError, match=r"\[commands.goal\]: the model has no actuator 'moter'; it has motor"):
        ModelRobot(*paths, threads=1)


def test_setpoints_are_in_the_unit_of_the_mapping_or_else_of_the_model(paths):
    assert ModelRobot(*paths, threads=1).setpoint_unit == "rad"
    paths[1].write_text(MAP.replace('["motor"]', '["motor"]\nunit = "deg"', 1))
    assert ModelRobot(*paths, threads=1).setpoint_unit == "deg"


def test_a_finer_model_outside_the_folder_of_the_mapping_is_refused(paths):
    model, mapping = paths
    inner = mapping.parent / "inner"
    inner.mkdir()
    moved = inner / mapping.name
    moved.write_text(MAP.replace("[robot]", f'[robot]\naccurate = "../{model.name}"', 1))
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
