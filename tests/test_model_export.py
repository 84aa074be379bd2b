"""Exported models: what MuJoCo derives is explicit, and laws that MJCF has act as in the catalogue."""

import mujoco
import numpy as np
import pytest

from soro_bench.diagnosis.assembly.model_export import PatchError, exported
from soro_bench.diagnosis.assembly.motion import LONG, SHORT, motion_difference
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from tests.arm import ARM, MAP

MOTOR, HINGE = Location("actuator", "motor"), Location("joint", "hinge")
LINK = """<mujoco>{compiler}<option timestep="0.005"/>{default}<worldbody>
<body name="link" euler="0 20 0">{inertial}<joint name="hinge" axis="0 1 0" {joint}/>
<geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0" contype="0" conaffinity="0"/>
<body name="end" pos="0.2 0 0"><joint name="last" axis="0 0 1" damping="0.01"/>
<geom size="0.03" pos="0.05 0 0" contype="0" conaffinity="0"/></body></body>{bodies}</worldbody>
{more}<actuator>{actuator}</actuator></mujoco>"""
MOTORS = '<motor name="motor" joint="hinge" ctrlrange="-1 1"/>'
LINK_MAP = """
[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["motor"]
[signal]
name = "angle"
joints = ["hinge", "last"]
unit = "rad"
[parameters.mass]
fields = ["body_mass:link", "body_inertia:link"]
deviation = 0.3
"""
DERIVED = {
    "inertiafromgeom": {"compiler": '<compiler inertiafromgeom="true"/>'},
    "settotalmass": {"compiler": '<compiler settotalmass="3"/>'},
    "bounds": {"compiler": '<compiler boundmass="2" boundinertia="0.01"/>'},
    "balanceinertia": {
        "compiler": '<compiler balanceinertia="true"/>',
        "inertial": '<inertial pos="0.1 0 0" mass="0.5" diaginertia="0.001 0.001 0.01"/>',
    },
    "fullinertia": {"inertial": '<inertial pos="0.1 0 0" mass="0.5" fullinertia="0.01 0.02 0.02 0.001 0 0"/>'},
    "dampratio": {"actuator": '<position name="motor" joint="hinge" kp="5" dampratio="1"/>'},
    "inheritrange": {
        "joint": 'range="-40 60"',
        "actuator": '<position name="motor" joint="hinge" kp="5" inheritrange="0.9"/>',
    },
    "springdamper": {"joint": 'springdamper="0.1 0.5"'},
    "muscle": {"joint": 'range="-40 60"', "actuator": '<muscle name="motor" joint="hinge"/>'},
    "angle and default": {
        "compiler": '<compiler angle="degree" autolimits="true"/>',
        "default": '<default><joint range="-30 30" stiffness="1" springref="10"/></default>',
    },
    "tendon": {
        "joint": 'ref="10"',
        "more": '<tendon><fixed stiffness="3"><joint joint="hinge" coef="1"/></fixed></tendon>',
    },
    "free": {"compiler": '<compiler alignfree="true"/>', "bodies": """<body name="ball" pos="1 1 0" euler="10 20 30">
        <freejoint/><geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0"/></body>"""},
    "replicate": {"bodies": """<replicate count="3" offset="0 0.3 0"><body pos="1 0 0"><joint axis="1 0 0"/>
        <geom size="0.05" pos="0 0.1 0"/></body></replicate>"""},
    "weld": {
        "bodies": '<body name="ball" pos="1 1 0"><freejoint/><geom size="0.1"/></body>',
        "more": '<equality><weld body1="ball"/></equality>',
    },
    "keyframe": {"more": '<keyframe><key name="home" qpos="0.3 0.2"/></keyframe>'},
}  # fmt: skip


def robot_of(folder, xml, mapping):
    """The robot of a model and a mapping, written to a folder."""
    paths = folder / "robot.xml", folder / "robot.toml"
    paths[0].write_text(xml)
    paths[1].write_text(mapping)
    return ModelRobot(*paths, threads=1)


@pytest.mark.parametrize("case", DERIVED)
def test_what_mujoco_derives_stays_as_it_was_when_masses_change(case, tmp_path):
    parts = dict.fromkeys(("compiler", "default", "inertial", "joint", "bodies", "more"), "")
    robot = robot_of(tmp_path, LINK.format(**{"actuator": MOTORS, **parts, **DERIVED[case]}), LINK_MAP)
    for factor in (1.0, 1.4):
        xml = exported(robot, {"mass": factor}, []).xml
        found = motion_difference(robot.model({"mass": factor}, []), mujoco.MjModel.from_xml_string(xml))
        assert found.largest < 1e-9
        assert found.seconds == LONG


def test_models_that_differ_by_a_hundredth_do_not_move_alike():
    model, other = (mujoco.MjModel.from_xml_string(ARM.replace('"0.02"', value)) for value in ('"0.02"', '"0.0202"'))
    assert not motion_difference(model, other).alike
    assert motion_difference(model, model).alike


def test_a_chaotic_motion_is_compared_for_a_short_time():
    link = '<body pos="0.01 0 0"><joint {} axis="0 1 0"/><geom size="0.002" pos="0.01 0 0"/>{}</body>'
    links = link.format('name="a"', link.format("", ""))
    pendulum = f"""<mujoco><option timestep="0.001"/><worldbody>{links}</worldbody>
        <actuator><motor joint="a" gear="1e-6"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(pendulum)
    found = motion_difference(model, model)
    assert found.chaotic
    assert found.seconds == SHORT


LAWS = [
    Effect("actuator_gain", MOTOR, {"gain": 0.8}),
    Effect("pretension", MOTOR, {"offset": 0.1}),
    Effect("actuator_delay", MOTOR, {"delay": 0.0235}),
    Effect("actuator_lag", MOTOR, {"time_constant": 0.05}),
]


def replays(robot, effect):
    """(T,) angles under an effect, by the exported model alone, and without it."""
    goals = np.repeat(np.r_[0.0, np.random.default_rng(0).uniform(-0.6, 0.6, 9)], 15)[:, None]
    nominal, start = np.array([[prior.nominal for prior in robot.priors]]), np.zeros((1, 1))
    with_it, without = robot.simulate(goals, np.repeat(nominal, 2, axis=0), [[effect], []], start)
    found = exported(robot, robot.parameters(np.zeros(len(robot.priors))), [effect])
    assert (found.effects, found.remaining) == ((effect,), ())
    (alone,) = robot.as_built(found.xml).simulate(goals, nominal, [()], start)
    return with_it.ravel(), alone.ravel(), without.ravel()


@pytest.mark.parametrize("effect", LAWS, ids=lambda effect: effect.name)
def test_a_law_that_mjcf_has_acts_in_the_model_as_in_the_simulation(effect, tmp_path):
    expected, alone, without = replays(robot_of(tmp_path, ARM, MAP), effect)
    assert np.abs(alone - expected).max() < 1e-9
    assert np.abs(without - expected).max() > 1e-2


def test_dry_friction_is_that_of_mujoco(tmp_path):
    effect = Effect("coulomb_friction", HINGE, {"friction": 0.05, "presliding": 1e-4})
    expected, alone, without = replays(robot_of(tmp_path, ARM, MAP), effect)
    assert np.std(alone - expected) < 0.25 * np.std(without - expected)


def test_a_range_that_the_mapping_widens_is_wide_in_the_model(tmp_path):
    wide = MAP.replace("[robot]", '[robot]\nctrlrange = "widen"')
    robot = robot_of(tmp_path, ARM.replace('kp="2"', 'kp="2" ctrlrange="-0.1 0.1"'), wide)
    model = mujoco.MjModel.from_xml_string(exported(robot, robot.parameters(np.zeros(3)), []).xml)
    assert not model.actuator_ctrllimited.any()


def test_a_walker_of_a_mesh_has_no_model_for_its_stiffness():
    robot = SuiteRobot("MultiGait-v0", threads=1)
    with pytest.raises(PatchError, match="MJCF cannot hold the fitted flex_stiffness"):
        exported(robot, {prior.name: prior.nominal for prior in robot.priors}, [])
