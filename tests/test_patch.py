"""The patched model: a robot's MJCF with fitted parameters and with the effects that a model can hold, exported so that
what MuJoCo derives is explicit."""

from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from soro_bench.diagnosis.assembly.errors import rms_as_it_is
from soro_bench.diagnosis.assembly.model_export import (
    LONG,
    SHORT,
    PatchError,
    exported,
    motion_difference,
    patched_spec,
)
from soro_bench.diagnosis.assembly.patch import _expressible, _worse, kept, lacking, model_patch, patch
from soro_bench.diagnosis.candidates import term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.result_robot import ReplayError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.model_probabilities import Fit
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.catalogue import QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.effects.elements import AUXILIARY, FOUND, instrument, without_unused_springs
from soro_bench.envs.trunk import NUM_KEYPOINTS
from soro_bench.files import mjcf_path
from soro_bench.models.trunk_geometry import CABLE_RATE
from tests.arm import ARM, MAP
from tests.arm import problem as arm_problem

X = np.array([0.3, -0.4, 0.2, 0.3, 0.1])  # fitted parameters, in standard deviations of their priors
PAYLOAD = Effect("payload", Location("body", "vertebra7"), {"mass": 0.04})
CREEP = Effect("viscoelastic_creep", Location("body", EVERY), {"ratio": 0.3, "time_constant": 2.0})
NATIVE = [
    PAYLOAD,
    Effect("local_stiffness", Location("body", "vertebra3"), {"factor": 0.6}),
    Effect("hysteresis", Location("body", "vertebra5"), {"ratio": 0.5, "yield_strain": 0.03}),
    Effect("plastic_set", Location("body", "vertebra6"), {"softness": 5.0, "share": 0.5}),
    Effect("viscous_friction", Location("tendon", "L1"), {"damping": 2.6}),
    Effect("compliance", Location("actuator", "L2"), {"compliance": 1e-4}),
    Effect("actuator_saturation", Location("actuator", "S2"), {"loss": 0.5}),
    Effect("base_tilt", Location("model", "gravity"), {"about_x": 0.02, "about_y": 0.01, "about_z": -0.03}),
]


@pytest.fixture(scope="module")
def robot():
    return SuiteRobot("TrunkReach-v0", threads=1)


def diagnosis(robot, effects, heldout=(2.0, 1.0), verdict="discrepancy"):
    """A diagnosis with a known answer; the nominal fit is at the origin."""
    best = SimpleNamespace(x=X, effects=lambda parameters: list(effects))
    answer = SimpleNamespace(hypothesis=best, train=Fit(2.0, 1.0, 0.0), heldout=heldout and Fit(*heldout, 0.0))
    nominal = SimpleNamespace(x=np.zeros(len(X)))
    explanation = SimpleNamespace(nominal=nominal, problem=SimpleNamespace(parameters=len(X)))
    return SimpleNamespace(robot=robot, verdict=verdict, best=answer, explanation=explanation, discovery=None)


def test_a_model_with_a_mesh_is_patched_and_loads_from_anywhere(paths, tmp_path):
    model, mapping = paths
    corners = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
    (tmp_path / "meshes").mkdir()
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "meshes" / "box.obj").write_text(vertices + "f 1 2 3\nf 5 6 7\n")
    mesh = '<compiler meshdir="meshes"/><asset><mesh name="box" file="box.obj" inertia="convex"/></asset><worldbody>'
    geom = '<geom type="mesh" mesh="box" contype="0" conaffinity="0"/><site name="tip"'
    model.write_text(ARM.replace("<worldbody>", mesh).replace('<site name="tip"', geom))
    robot = ModelRobot(model, mapping, threads=1)
    nominal = {prior.name: prior.nominal for prior in robot.priors}
    assert mujoco.MjModel.from_xml_string(exported(robot, nominal, []).xml).nmesh == 1


def moved(model, actions):
    """(T, 21, 3) keypoints [m] of a trunk that MuJoCo alone simulates."""
    data, points = mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    sites = [model.site(f"keypoint{i}").id for i in range(NUM_KEYPOINTS)]
    for action in actions:
        data.ctrl[:] = CABLE_RATE * action.astype(float)
        mujoco.mj_step(model, data, round(0.05 / model.opt.timestep))
        mujoco.mj_forward(model, data)
        points.append(data.site_xpos[sites].copy())
    return np.array(points)


@pytest.mark.parametrize("effects", [[], [PAYLOAD], NATIVE])
def test_a_patched_model_moves_as_the_simulation_with_these_parameters_and_effects(robot, effects):
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (8, 8)), 5, axis=0).astype(np.float32)
    parameters = robot.parameters(X)
    (expected,) = robot.simulate(actions, np.array([list(parameters.values())]), [effects])
    loaded = mujoco.MjModel.from_xml_string(exported(robot, parameters, effects).xml)
    np.testing.assert_array_equal(moved(loaded, actions), expected)


@pytest.mark.parametrize("name", ["bam_servo", "opencr_tdcr", "asl_trunk", "silicone_beam"])
def test_the_patched_model_of_a_real_robot_moves_as_its_simulation(name):
    robot = ModelRobot(mjcf_path(f"real/{name}.xml"), mjcf_path(f"real/{name}.toml"), threads=1)
    parameters = robot.parameters(0.5 * np.random.default_rng(0).standard_normal(len(robot.priors)))
    loaded = mujoco.MjModel.from_xml_string(exported(robot, parameters, []).xml)
    np.testing.assert_allclose(driven(loaded), driven(robot.model(parameters, [])), rtol=0, atol=1e-12)


def driven(model):
    """Positions of all bodies and sites [m] after 20 time steps under a tenth of the largest commands."""
    data = mujoco.MjData(model)
    for _ in range(20):
        data.ctrl[:] = 0.1 * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return np.concatenate([data.xpos, data.site_xpos])


def test_the_file_says_what_it_has_and_what_it_lacks(robot):
    parameters = robot.parameters(X)
    found = exported(robot, parameters, [PAYLOAD, CREEP])
    assert (found.effects, found.remaining) == ((PAYLOAD,), (CREEP,))
    model, bare = mujoco.MjModel.from_xml_string(found.xml), robot.model(parameters, [])
    added = model.body("vertebra7").mass[0] - bare.body("vertebra7").mass[0]
    assert added == pytest.approx(0.04, rel=1e-9)
    assert model.body("vertebra6").mass[0] == pytest.approx(bare.body("vertebra6").mass[0], rel=1e-9)
    assert f"trunk_mass {parameters['trunk_mass']:.6g} kg" in found.xml[:1000]
    assert "Effects in this model: payload at body vertebra7" in found.xml[:1000]
    assert "Not in this model: viscoelastic_creep at every body" in found.xml[:1000]


@pytest.mark.parametrize(
    "case",
    [
        {"heldout": (1.0, 2.0)},
        {"verdict": "adequate"},
        {"verdict": "outside_catalogue", "heldout": None},
        {"verdict": "outside_catalogue", "heldout": (2.0, 1.7)},
    ],
)
def test_without_a_patch_the_model_has_the_parameters_that_were_fitted_without_one(robot, case):
    found = diagnosis(robot, [PAYLOAD, CREEP], **case)
    assert patch(found) == []
    assert kept(found) is found.explanation.nominal


def test_what_has_no_name_is_patched_by_the_nearest_that_explains_held_out_recordings_too(robot):
    assert patch(diagnosis(robot, [PAYLOAD], verdict="outside_catalogue")) == [PAYLOAD]


def test_springs_are_in_the_model_only_where_an_effect_uses_them(robot):
    for effects, count in ([PAYLOAD], 0), ([NATIVE[2]], 2):
        names = [tendon.name for tendon in patched_spec(robot, robot.parameters(X), effects).tendons]
        assert sum(name.startswith(FOUND) for name in names) == count
        assert not any(name.startswith(AUXILIARY) for name in names)  # so that it can be diagnosed again


def test_a_patched_model_can_be_prepared_for_effects_again(robot):
    xml = exported(robot, robot.parameters(X), [NATIVE[2]], "of a file---with hyphens").xml
    assert instrument(mujoco.MjSpec.from_string(xml)).compile().ntendon > 0
    assert ElementTree.fromstring(xml).tag == "mujoco"


def test_what_is_found_at_a_place_again_gets_another_name(robot):
    spec = patched_spec(robot, robot.parameters(X), [NATIVE[2]])
    once = {tendon.name for tendon in spec.tendons if tendon.name.startswith(FOUND)}
    for tendon in instrument(spec).tendons:
        if tendon.name.replace(AUXILIARY, FOUND) in once and tendon.name not in once:
            tendon.stiffness = [1.0, 0.0, 0.0]
    names = [tendon.name for tendon in without_unused_springs(spec).tendons]
    assert {name for name in names if name.startswith(FOUND)} == once | {f"{name}_2" for name in once}
    assert spec.compile().ntendon == len(names)


def test_inertia_that_no_body_can_have_is_in_no_patched_model(tmp_path):
    paths = tmp_path / "arm.xml", tmp_path / "arm.toml"
    paths[0].write_text(ARM)
    paths[1].write_text(MAP.replace('"body_inertia:arm"', '"body_inertia[0]:arm"').replace("= 0.2", "= 2.0"))
    robot = ModelRobot(*paths, threads=1)
    with pytest.raises(PatchError, match=r"MJCF cannot hold the fitted model: .*inertia"):
        patched_spec(robot, robot.parameters(np.array([2.0, 0.0, 0.0])), [])


def test_a_flex_has_no_patched_model_and_the_reason_is_given():
    robot = SuiteRobot("TrunkReach-v0", "flex", threads=1)
    found = model_patch(diagnosis(robot, [PAYLOAD]), [])
    assert (found.state, found.xml, found.remaining) == ("not_written", None, (PAYLOAD,))
    assert "flex_stiffness" in found.obstacle


GEAR = Effect(
    "gear_friction",
    Location("joint", "hinge"),
    {"mu": 0.3, "backdrive": 1.0, "preload": 0.1, "static_ratio": 1.5, "stribeck_velocity": 0.2, "presliding": 1e-3},
)


def found_on_the_arm(paths, hidden, x):
    """A diagnosis of the arm that has found an effect with parameters at coordinates x."""
    problem = replace(arm_problem(paths, [hidden]), robot=ModelRobot(*paths, threads=1))
    one = term(problem.robot, hidden.name, hidden.location)
    x = np.concatenate([x, one.coordinates(hidden.parameters)])
    row = problem.residuals([(x, (one,))])[0]
    nothing = np.zeros((0, row.size))
    best = Hypothesis((one,), x, row, problem.cost(row, x), nothing, nothing)
    origin = problem.residuals([(np.zeros(3), ())])[0]
    nominal = Hypothesis((), np.zeros(3), origin, problem.cost(origin, np.zeros(3)), nothing, nothing)
    return SimpleNamespace(
        robot=problem.robot,
        verdict="discrepancy",
        best=SimpleNamespace(hypothesis=best, train=Fit(2.0, 1.0, 0.0), heldout=None),
        explanation=SimpleNamespace(nominal=nominal, problem=problem),
        tested=None,
    )


def patched(diagnosis):
    return model_patch(diagnosis, rms_as_it_is(diagnosis.robot.as_built(), [diagnosis.explanation.problem]))


def test_a_model_that_would_be_worse_alone_is_fitted_again_with_what_mjcf_has(paths):
    # with the damping that belongs to the friction, the arm alone is far too weakly damped
    diagnosis = found_on_the_arm(paths, GEAR, np.array([0.0, -6.0, 0.0]))
    found = patched(diagnosis)
    assert found.state == "refitted"
    assert found.errors[0].patched < 0.6 * found.errors[0].built
    assert {effect.name for effect in found.effects} == {"coulomb_friction", "viscous_friction"}
    assert [effect.name for effect in found.remaining] == [GEAR.name]
    assert "do not add that" in found.xml
    (again,) = diagnosis.explanation.problem.recordings
    alone = diagnosis.robot.as_built(found.xml).simulate(again.actions, np.ones((1, 3)) * [1, 1, 0], [()], again.start)
    assert np.sqrt(np.mean((alone[0] - again.values) ** 2)) == pytest.approx(found.errors[0].patched, rel=1e-6)


def test_a_refit_that_ends_in_a_local_minimum_is_followed_by_one_from_other_parameters(paths):
    # a fifth of the inertia, and the arm rings out of phase; what was found without the delay is near the truth
    soft = ARM.replace('kp="2" kv="0.05"', 'kp="0.5" kv="0.002"').replace('damping="0.02"', 'damping="0.001"')
    paths[0].write_text(soft)
    late = Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.02})
    found = patched(found_on_the_arm(paths, late, np.array([-8.0, 0.0, 0.0])))
    assert (found.state, [each.name for each in found.effects], found.remaining) == ("refitted", [late.name], ())
    assert found.errors[0].patched < 0.1 * found.errors[0].built
    masses = [mujoco.MjModel.from_xml_string(text).body("arm").mass[0] for text in (found.xml, soft)]
    assert masses[0] / masses[1] == pytest.approx(1.2, rel=0.05)


def test_a_model_that_is_better_alone_is_as_found(paths):
    gain = Effect("actuator_gain", Location("actuator", "motor"), {"gain": 0.8})
    found = patched(found_on_the_arm(paths, gain, np.zeros(3)))
    assert (found.state, found.effects, found.remaining, found.obstacle) == ("as_found", (gain,), (), None)
    assert found.errors[0].patched < 0.3 * found.errors[0].built


@pytest.mark.parametrize(
    ("name", "location", "native"),
    [
        ("hysteresis", Location("body", "vertebra4"), True),
        ("actuator_gain", Location("actuator", "L1"), False),
        ("coulomb_friction", Location("tendon", "L1"), False),
        ("sensor_bias", Location("sensor", "keypoints", 3), False),
    ],
)
def test_an_effect_is_native_if_the_fields_of_a_model_can_hold_it(robot, name, location, native):
    parameters = {q.name: q.bounds[1] if np.isfinite(q.bounds[1]) else q.typical for q in QUANTITIES[name]}
    assert robot.native(Effect(name, location, parameters)) is native


def test_a_law_at_one_place_is_none_at_another():
    first, other = (Effect("actuator_gain", Location("actuator", name), {"gain": 0.8}) for name in ("L1", "L2"))
    assert lacking([first, other], [replace(first, parameters={"gain": 0.7})]) == (other,)


@pytest.mark.parametrize(("squares", "worse"), [(1.089, False), (1.091, True)])
def test_a_model_is_worse_by_the_samples_of_the_signal_that_errors_are_of(squares, worse):
    """By nine variances in all; samples of another signal are not in the error."""
    problem = SimpleNamespace(weight=np.ones(300), sensor=1.0, split=lambda samples: [samples[:100]])
    assert _worse([ReplayError(1.0, float(np.sqrt(squares)))], [problem]) == worse


def test_friction_of_an_actuator_is_that_of_its_joint_in_a_model(tmp_path):
    parts = dict.fromkeys(("compiler", "default", "inertial", "joint", "bodies", "more"), "")
    robot = robot_of(tmp_path, LINK.format(actuator=MOTORS + MOTORS.replace('motor"', 'other"'), **parts), LINK_MAP)
    found = _expressible(robot, [term(robot, "input_friction", MOTOR)], SimpleNamespace(settings=DEFAULT))
    assert [(each.name, each.location) for each in found] == [("coulomb_friction", HINGE), ("viscous_friction", HINGE)]


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
    "tendon": {"joint": 'ref="10"',
               "more": '<tendon><fixed stiffness="3"><joint joint="hinge" coef="1"/></fixed></tendon>'},
    "free": {"compiler": '<compiler alignfree="true"/>', "bodies": """<body name="ball" pos="1 1 0" euler="10 20 30">
        <freejoint/><geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0"/></body>"""},
    "replicate": {"bodies": """<replicate count="3" offset="0 0.3 0"><body pos="1 0 0"><joint axis="1 0 0"/>
        <geom size="0.05" pos="0 0.1 0"/></body></replicate>"""},
    "weld": {"bodies": '<body name="ball" pos="1 1 0"><freejoint/><geom size="0.1"/></body>',
             "more": '<equality><weld body1="ball"/></equality>'},
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
