"""Known answers of the effects at sensors, necks and cables, of drag, and what no friction may do."""

import mujoco
import numpy as np
import pytest

from soro_bench.blind_benchmark import body_laws, cable_laws
from soro_bench.blind_benchmark.robot import simulate
from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.catalogue import MEASUREMENT, QUANTITIES
from soro_bench.effects.effect import Effect, EffectError, Location
from soro_bench.effects.elements import Elements, instrument
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from soro_bench.registration import make_task


@pytest.mark.parametrize("stage", [mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL])
def test_drag_slows_a_fall_as_it_should_whatever_is_computed_after_a_step(stage):
    """m v' = m g - c v^2 from rest: v = vt tanh(g t / vt), with vt^2 = m g / c."""
    ball = """<mujoco><option timestep="0.001"/><worldbody><body name="ball"><joint type="slide" axis="0 0 1"/>
    <geom size="0.01" mass="0.1"/></body></worldbody></mujoco>"""
    drag = [Effect("fluid_drag", Location("body", "ball"), {"drag": 0.2})]
    sim = Simulation(instrument(mujoco.MjSpec.from_string(ball)).compile(), ParameterSet(), (), 1, 1, drag)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    for _ in range(50):
        sim.step(np.arange(1), 10, stage)
    terminal = np.sqrt(0.1 * 9.81 / 0.2)
    assert sim.batch.qvel[0, 0] == pytest.approx(-terminal * np.tanh(9.81 * 0.5 / terminal), rel=2e-3)


# --- faults of measurement, on points that move along x ---

TIME = 0.05 * np.arange(100)
POINTS = np.stack([np.sin(TIME), 0 * TIME, 0 * TIME], axis=1)[:, None] * np.ones((1, 4, 1))


def recorded(name, index=0, **parameters):
    return MEASUREMENT[name].apply(TIME, POINTS, parameters, index)


def test_a_fast_clock_shows_later_what_happened():
    assert recorded("clock_skew", rate=0.02)[:, 0, 0] == pytest.approx(np.sin(0.98 * TIME), abs=1e-3)


def test_a_slipped_marker_is_off_from_its_time_on():
    shift = recorded("marker_slip", index=2, x=0.0, y=1.0, z=0.0, time=2.0) - POINTS
    assert (shift[:, 2, 1] == (TIME >= 2.0)).all()
    assert not np.delete(shift, 2, axis=1).any()


def test_a_misaligned_frame_is_turned_and_shifted():
    turned = recorded("frame_misalignment", about_x=0.0, about_y=0.0, about_z=np.pi / 2, x=0.0, y=0.0, z=3.0)
    expected = np.stack([0 * TIME, np.sin(TIME), 0 * TIME + 3.0], axis=1)
    assert turned[:, 1] == pytest.approx(expected, abs=1e-12)


def test_outliers_are_few_and_far_off():
    far = np.linalg.norm(recorded("outliers", share=0.1, size=5.0) - POINTS, axis=2) > 0.1
    assert far.mean() == pytest.approx(0.1, abs=0.05)


# --- the accurate trunk, whose necks are flexes ---


def sag(effects, model):
    """m, how far the tip of a trunk hangs down that is held by no cable."""
    task = make_task("TrunkReach-v0", 1, 1, model, action="continuous", effects=effects)
    task.sim.batch.expand("opt.gravity")[:] = (0.0, -9.81, 0.0)
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    for _ in range(20):
        task.step(np.arange(1), np.zeros((1, 8), np.float32))
    return task.keypoints(np.arange(1))[0, -1, 1]


@pytest.mark.parametrize("model", ["cable", "flex"])
def test_a_softer_neck_sags_more_on_either_model(model):
    softer = [Effect("local_stiffness", Location("body", "vertebra2"), {"factor": 0.5})]
    assert sag(softer, model) < 1.05 * sag((), model) < 0


def test_the_bending_stiffness_of_a_neck_is_that_of_its_flex():
    """Of the finite-element table that the flexes are made from (docs/archive/tasks_and_models.md)."""
    task = make_task(
        "TrunkReach-v0", 1, 1, "flex", effects=[Effect("stiffening", Location("body", "*"), {"beta": 1.0})]
    )
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    (law,) = task.sim._effects._laws
    assert law._stiffness == pytest.approx(geo.BEND[1], rel=0.01)


def moved(model, effects, actions):
    """(T, 21, 3) m, keypoints under actions (T, 8)."""
    task = make_task("TrunkReach-v0", 1, 1, model, action="continuous", effects=effects)
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    rows = []
    for action in actions:
        task.step(np.arange(1), action[None])
        rows.append(task.keypoints(np.arange(1))[0].copy())
    return np.array(rows)


MATERIAL = {
    "stiffening": ({"beta": 3.0}, [body_laws.Stiffening(3.0)]),
    "mullins_softening": ({"softening": 0.5, "strain": 0.05}, [body_laws.Mullins(0.5, 0.05)]),
    "viscoelastic_creep": ({"ratio": 0.5, "time_constant": 0.5}, [body_laws.Creep(0.5, 0.5)]),
    "plastic_set": ({"softness": 20.0, "share": 0.5}, [body_laws.PlasticSet(k, 0.05, 0.5) for k in range(10)]),
    # a spring that does not slip here: on `cable` each joint slips by itself, which the other code's necks do not
    "hysteresis": (
        {"ratio": 0.5, "yield_strain": 3.0},
        [body_laws.Hysteresis(k, 3.0 * 0.5 * geo.BEND[1][k], 3.0) for k in range(10)],
    ),
}


@pytest.mark.parametrize("name", MATERIAL)
@pytest.mark.parametrize(("model", "kind"), [("cable", "fine"), ("flex", "flex")])
def test_a_law_of_the_material_does_what_it_does_in_another_code(name, model, kind, monkeypatch):
    """That of the hidden robots, which shares nothing with the effects. Bent to and fro by the cables; hysteresis of
    one slider."""
    monkeypatch.setattr(body_laws, "_YIELDS", np.ones(1))
    monkeypatch.setattr(body_laws, "_SHARES", np.ones(1))
    parameters, laws = MATERIAL[name]
    actions = np.zeros((60, 8), np.float32)
    actions[:15, [0, 4]], actions[15:30, [0, 4]], actions[35:45, [1, 5]] = 1.0, -1.0, 1.0
    hidden = Effect(name, Location("body", "*"), parameters)
    ours = np.subtract(*(moved(model, effects, actions) for effects in ([hidden], ())))
    nominal = {p.name: p.nominal for p in trunk.PARAMETERS}
    times = 0.05 * np.arange(1, 61)
    theirs = np.subtract(*(simulate(kind, nominal, each, actions, (1, 2)).at(times) for each in (laws, [])))
    assert np.abs(theirs).max() > 1e-3
    assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(theirs), rel=0.05)
    # at least 0.94 on one processor, 0.936 on another: a softening flex amplifies the last digit
    assert (ours * theirs).sum() > 0.92 * np.linalg.norm(ours) * np.linalg.norm(theirs)


@pytest.mark.parametrize("force", [0.3, 2.5])
def test_friction_of_a_cable_does_what_it_does_in_another_code(force):
    """Pulled, held and released; the other code's time step is an eighth of ours."""
    actions = np.zeros((45, 8), np.float32)
    actions[:6, 4], actions[20:26, 4] = 1.0, -1.0
    friction = Effect("coulomb_friction", Location("tendon", "S0"), {"friction": force, "presliding": force / 3000})
    ours = np.subtract(*(moved("cable", effects, actions) for effects in ([friction], ())))
    nominal, times = {p.name: p.nominal for p in trunk.PARAMETERS}, 0.05 * np.arange(1, 46)
    laws = ([cable_laws.Friction(4, force)], [])
    theirs = np.subtract(*(simulate("fine", nominal, each, actions, (1, 2)).at(times) for each in laws))
    assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(theirs), rel=0.15)
    assert (ours * theirs).sum() > 0.93 * np.linalg.norm(ours) * np.linalg.norm(theirs)


@pytest.mark.parametrize("name", MATERIAL)
def test_a_material_without_magnitude_moves_the_flex_model_bit_for_bit_as_before(name):
    parameters, _ = MATERIAL[name]
    none = {**parameters, next(iter(parameters)): 0.0}
    assert sag([Effect(name, Location("body", "*"), none)], "flex") == sag((), "flex")


SHEET = """<mujoco><worldbody><flexcomp name="sheet" type="grid" count="4 3 1" spacing="0.02 0.02 0.1" dim="2"
radius="0.001" mass="0.05">{elasticity}<contact selfcollide="none"/></flexcomp></worldbody></mujoco>"""


def test_a_softer_sheet_stretches_and_bends_more_easily():
    elasticity = '<elasticity young="3e6" poisson="0.2" thickness="0.003" elastic2d="both"/>'
    model = instrument(mujoco.MjSpec.from_string(SHEET.format(elasticity=elasticity))).compile()
    softer = [Effect("local_stiffness", Location("flex", "sheet"), {"factor": 0.5})]
    batch = Simulation(model, ParameterSet(), (), 1, 1, softer).batch
    for field in ("flex_stiffness", "flex_bending"):
        assert np.any(getattr(model, field))
        np.testing.assert_array_equal(batch.expand(field)[0], 0.5 * getattr(model, field))


def test_a_flex_without_elasticity_has_none_to_change():
    model = instrument(mujoco.MjSpec.from_string(SHEET.format(elasticity='<edge equality="true"/>'))).compile()
    with pytest.raises(EffectError, match="needs elasticity of the flex; that of flex sheet has none"):
        Simulation(
            model, ParameterSet(), (), 1, 1, [Effect("local_stiffness", Location("flex", "sheet"), {"factor": 0.5})]
        )


@pytest.mark.parametrize(
    ("name", "parameters"), [("local_stiffness", {"factor": 0.5}), ("stiffness_drift", {"rate": 1.0})]
)
def test_a_law_at_a_flex_changes_that_flex_and_no_other(name, parameters):
    """And not at all without magnitude."""
    model = make_task("TrunkReach-v0", 1, 1, "flex", effects=()).model
    location = Elements(model).locations("flex")[3]
    null = {"factor": 1.0} if "factor" in parameters else {"rate": 0.0}
    assert sag([Effect(name, location, null)], "flex") == sag((), "flex")
    stiffness = []
    for effects in ([Effect(name, location, null)], [Effect(name, location, parameters)]):
        task = make_task("TrunkReach-v0", 1, 1, "flex", action="continuous", effects=effects)
        task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
        task.step(np.arange(1), np.zeros((1, 8), np.float32))
        stiffness.append(task.sim.batch.expand("flex_stiffness")[0].copy())
    changed = np.flatnonzero(stiffness[0] != stiffness[1])
    first, last = model.flex_stiffnessadr[3:5]
    assert len(changed) and first <= changed.min() and changed.max() < last


def test_a_neck_at_rest_elsewhere_bends_by_that_angle_on_either_model():
    """Unloaded and with slack cables, the trunk turns beyond the neck by what it is bent there."""
    ends = []
    for model in ("cable", "flex"):
        task = make_task("TrunkReach-v0", 1, 1, model, action="continuous", effects=())
        turned = Effect("rest_bend", Location("body", "vertebra4"), {"angle_x": 0.0, "angle_y": 0.1})
        task.sim.assign_effects([[turned]])
        task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
        task.sim.batch.expand("opt.gravity")[:] = 0
        for _ in range(40):
            task.step(np.arange(1), np.full((1, 8), -0.2, np.float32))
        points = task.keypoints(np.arange(1))[0]
        way = points[-1] - points[-4]
        ends.append(np.arctan2(way[0], way[2]))
    assert ends[0] == pytest.approx(0.1, rel=0.1)  # between keypoints that lie on the neck's side too
    assert ends[1] == pytest.approx(ends[0], rel=0.01)


def test_a_neck_bends_by_that_angle_whatever_joints_its_far_end_moves_on():
    """A free joint, or three sliders and three hinges without springs."""
    turned = Effect("rest_bend", Location("body", "vertebra9"), {"angle_x": 0.0, "angle_y": 0.1})
    turns = []
    for replaced in (False, True):
        spec = make_task("TrunkReach-v0", 1, 1, "flex", effects=()).spec()
        body = spec.body("vertebra9")
        for joint in body.joints if replaced else ():
            spec.delete(joint)
        for kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE) if replaced else ():
            for axis in np.eye(3):
                body.add_joint(name=f"{kind.name}{axis.argmax()}", type=kind, axis=axis)
        sim = Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, [turned])
        sim.batch.bind("xquat")
        sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        sim.batch.expand("opt.gravity")[:] = 0
        sim.begin(np.arange(1))
        sim.step(np.arange(1), 200)
        turns.append(2.0 * np.arcsin(sim.batch.xquat[0, sim.model.body("vertebra9").id, 2]))
    assert turns[0] == pytest.approx(0.1, rel=0.1)
    assert turns[1] == pytest.approx(turns[0], rel=0.02)


@pytest.mark.parametrize("name", ["rest_bend", "stiffening", "mullins_softening", "local_stiffness", "hysteresis"])
def test_a_node_of_a_mesh_has_no_springs_of_its_own(name):
    sim = make_task("MultiGait-v0", 1, 1, "coarse", effects=()).sim
    values = {q.name: q.typical for q in QUANTITIES[name]}
    for location in (Location("body", "vertex0"), Location("body", "*")):
        with pytest.raises(EffectError, match=f"{name}.* has n"):
            sim.assign_effects([[Effect(name, location, values)]])
        assert not sim.accepts([Effect(name, location, values)])


# --- a loaded gear ---


@pytest.mark.parametrize(("torque", "holds"), [(0.068, False), (0.075, True), (0.127, True), (0.135, False)])
def test_a_gear_holds_a_load_longer_than_it_lifts_it(torque, holds):
    """An arm of weight moment L rests between L (1 - mu b) / (1 + mu) and L (1 + mu b) / (1 - mu) of torque."""
    free = PENDULUM.replace(' stiffness="0.2"', "")
    values = {"mu": 0.1, "backdrive": 2.0, "preload": 0.0, "static_ratio": 1.0, "presliding": 1e-4}
    effect = Effect("gear_friction", Location("joint", "hinge"), values)
    model = instrument(mujoco.MjSpec.from_string(free)).compile()
    load = 9.81 * model.body("arm").mass[0] * model.body("arm").ipos[0]
    assert 0.0713 < load * 0.8 / 1.1 < 0.0714
    sim = Simulation(model, ParameterSet(), (), 1, 1, [effect])
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.batch.ctrl[:] = -torque
    sim.begin(np.arange(1))
    sim.step(np.arange(1), 500)
    assert (abs(sim.batch.qpos[0, 0]) < 0.01) == holds


# --- a rope round a bend ---

BEND, MU, SPRING = 1.0, 0.3, 1000.0
ROPE = f"""<mujoco><option timestep="0.001" gravity="0 0 0" integrator="discrete"/><worldbody>
<site name="hand" pos="-0.1 0 0"/>
<body name="arm"><joint name="hinge" axis="0 1 0" stiffness="1e4" springref="{np.degrees(BEND)}" damping="10"/>
<geom size="0.01" pos="0.1 0 0"/><site name="eyelet"/>
<body name="slider" pos="0.2 0 0"><joint name="slide" type="slide" axis="1 0 0" stiffness="{SPRING}" damping="1"/>
<geom size="0.01"/><site name="end"/></body></body></worldbody>
<tendon><spatial name="rope"><site site="hand"/><site site="eyelet"/><site site="end"/></spatial></tendon>
<actuator><motor tendon="rope"/></actuator></mujoco>"""


@pytest.mark.parametrize(("integrator", "gear"), [("discrete", 1), ("implicitfast", 1), ("discrete", 4)])
@pytest.mark.parametrize(("bent", "pulled", "released"), [
    (0.0, 10.0, 3.0),
    (BEND, 10.0 * np.exp(-MU * BEND), 3.0 * np.exp(MU * BEND)),
])  # fmt: skip
def test_a_rope_round_a_bend_pulls_less_while_it_is_pulled_and_more_while_it_is_paid_out(
    bent, pulled, released, integrator, gear
):
    """A spring at its end has what the hand pulls with times exp(-mu angle), and then exp(mu angle)."""
    effect = Effect("load_friction", Location("tendon", "rope"), {"mu": MU, "presliding": 1e-4})
    xml = ROPE.replace("discrete", integrator).replace("<motor ", f'<motor gear="{gear}" ')
    model = instrument(mujoco.MjSpec.from_string(xml)).compile()
    model.qpos_spring[model.joint("hinge").qposadr] = bent
    sim = Simulation(model, ParameterSet(), (), 1, 1, [effect])
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.batch.qpos[0, 0] = bent
    sim.begin(np.arange(1))
    forces = []
    for force in np.concatenate([np.linspace(0, 10, 2000), np.linspace(10, 3, 2000)]):
        sim.batch.ctrl[:] = -force / gear
        sim.step(np.arange(1), 1)
        forces.append(-SPRING * sim.batch.qpos[0, 1])
    assert (forces[1999], forces[-1]) == pytest.approx((pulled, released), rel=0.02)


def test_a_rope_whose_sites_coincide_or_that_cannot_slip_stays_finite():
    """With its two last sites at one place there is no direction between them; exp(mu angle) would be infinite."""
    effect = Effect("load_friction", Location("tendon", "rope"), {"mu": 10.0})
    xml = ROPE.replace('<site name="eyelet"/>', '<site name="eyelet" pos="0.2 0 0"/>')
    sim = Simulation(instrument(mujoco.MjSpec.from_string(xml)).compile(), ParameterSet(), (), 1, 1, [effect])
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    sim.batch.ctrl[:] = -10.0
    sim.step(np.arange(1), 500)
    assert np.isfinite(sim.batch.qpos).all()
    assert sim.batch.qpos[0, 0] > 0.5  # it is bent, and has not pulled the slider through


# --- energy ---

PENDULUM = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" stiffness="0.2"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""
DISSIPATIVE = {
    "coulomb_friction": {"friction": 0.01},
    "load_friction": {"mu": 0.2},
    "gear_friction": {"mu": 0.1, "backdrive": 2.0, "preload": 0.05},
    "stribeck_friction": {"friction": 0.005, "static_ratio": 3.0, "stribeck_velocity": 0.2},
    "viscous_friction": {"damping": 0.001},
    "hysteresis": {"ratio": 0.5, "yield_strain": 0.1},
    "viscoelastic_creep": {"ratio": 0.2, "time_constant": 0.5},
}


@pytest.mark.parametrize("name", DISSIPATIVE)
def test_a_lossy_law_makes_every_swing_of_a_pendulum_smaller(name):
    """Under a constant torque, from a start away from where its springs are at rest."""
    effects = [Effect(name, Location("joint", "hinge"), DISSIPATIVE[name])]
    model = instrument(mujoco.MjSpec.from_string(PENDULUM)).compile()
    sim = Simulation(model, ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.batch.expand("opt.gravity")[:] = 0
    sim.batch.qpos[:], sim.batch.ctrl[:] = 1.0, 0.05
    sim.begin(np.arange(1))
    angles = [1.0]
    for _ in range(5000):
        sim.step(np.arange(1), 1)
        angles.append(sim.batch.qpos[0, 0])
    angles = np.array(angles)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(angles)))) + 1
    swings = np.abs(np.diff(angles[np.concatenate([[0], turns])]))
    assert len(swings) > 3
    assert swings[0] < 1.6  # twice the way to where torque and springs balance
    assert (np.diff(swings) <= 2e-4).all()
    assert swings[-1] < 0.9 * swings[0]


LOSSY = ("coulomb_friction", "stribeck_friction", "load_friction", "viscous_friction", "fluid_drag", "hysteresis",
         "viscoelastic_creep", "plastic_set", "mullins_softening")  # fmt: skip


@pytest.fixture(scope="module", params=["cable", "flex"])
def robot(request):
    return SuiteRobot("TrunkReach-v0", request.param, threads=1)


@pytest.mark.parametrize("name", LOSSY)
def test_a_trunk_with_a_lossy_law_only_calms_down_once_its_commands_rest(name, robot):
    """The fastest that its keypoints are in each half of a second, after two cables were pulled and let go."""
    actions = np.zeros((70, 8), np.float32)
    actions[:10, :2], actions[10:20, :2] = 1.0, -1.0
    law = next(one for one in terms(robot) if one.name == name and one.location.kind != "sensor")
    nominal = np.array([[prior.nominal for prior in robot.priors]] * 2)
    points, without = robot.simulate(actions, nominal, [[typical(law)], []])
    assert np.abs(points - without).max() > 1e-4
    squares = (np.diff(points, axis=0) ** 2).sum(axis=(1, 2))
    fastest = squares[19:69].reshape(5, 10).max(axis=1)
    assert fastest[0] > 1e-5  # it swings
    assert (np.diff(fastest) < 0).all()
