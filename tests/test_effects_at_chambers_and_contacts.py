"""Known answers of the effects at chambers, filled through a supply or those of the walker, and at contacts.

Every quantity that a diagnosis can print has a unit; and the robots of the suite, as a diagnosis simulates them.
"""

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")


from soro_bench.diagnosis.assembly.shapes import of_model
from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.catalogue import PHYSICS, QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, EffectError, Location
from soro_bench.effects.elements import instrument
from soro_bench.effects.setpoints import SetpointLaw
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from soro_bench.recording.simulated import record
from soro_bench.registration import FIRST_IDS, make_task, task_type
from tests.arm import ARM, MAP

# three chambers: actuators that integrate the rate of their pressure
CHAMBERS = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="hinge" armature="1"/>
<geom size="0.01" contype="0" conaffinity="0"/></body></worldbody><actuator>
<general name="a" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
<general name="b" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
<general name="c" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
</actuator></mujoco>"""


def pressures(effects, rates, chambers=CHAMBERS):
    """(T, 3) activations of chambers that are filled at rates (T, 3) [1/s]."""
    model = instrument(mujoco.MjSpec.from_string(chambers)).compile()
    sim = Simulation(model, ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    rows = []
    for rate in rates:
        sim.batch.ctrl[0] = rate
        sim.step(np.arange(1), 1)
        rows.append(sim.batch.act[0].copy())
    return np.array(rows)


def test_chambers_on_one_supply_fill_more_slowly_together_and_vent_as_alone():
    rates = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [-1.0, -1.0, 0.0]], 100, axis=0)
    found = pressures([Effect("supply_coupling", Location("actuator", "*"), {"coupling": 0.25})], rates)
    assert found[99] == pytest.approx([0.1, 0, 0], abs=0.002)
    assert found[199] == pytest.approx([0.1, 0.075, 0.075], abs=0.002)
    assert found[299] == pytest.approx([0.0, -0.025, 0.075], abs=0.002)


def test_a_leak_loses_pressure_with_its_rate():
    rates = np.repeat([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]], [100, 900], axis=0)
    found = pressures([Effect("pressure_leak", Location("actuator", "a"), {"rate": 2.0})], rates)
    assert found[-1] == pytest.approx([0.1 * np.exp(-2.0 * 0.95), 0.1, 0.0], rel=0.01, abs=1e-12)


CLOSED = CHAMBERS.replace('ctrllimited="true"/>', 'ctrllimited="true" actlimited="true" actrange="0 1"/>')


@pytest.mark.parametrize(
    ("effect", "held"),
    [
        (Effect("pressure_leak", Location("actuator", "a"), {"rate": 0.5}), np.exp(-0.5)),
        (Effect("supply_coupling", Location("actuator", "*"), {"coupling": 0.25}), 1.0),
    ],
)
def test_a_chamber_is_filled_again_and_never_below_nothing(effect, held):
    """For 2 s to the full, held for 1 s, filled again, vented for 3 s."""
    rates = np.repeat([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]], [2000, 1000, 2000, 3000],
                      axis=0)  # fmt: skip
    found = pressures([effect], rates, CLOSED)[:, 0]
    full = found[1999]
    assert 0.75 < full <= 1.0
    assert found[2999] == pytest.approx(held * full, rel=0.01)
    assert found[4999] == pytest.approx(full, rel=0.02)
    assert found.min() == found[-1] == 0.0


def test_filling_lags_and_venting_does_not():
    rates = np.repeat([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-5.0, 0.0, 0.0]], [20, 480, 40], axis=0)
    asymmetry = [Effect("pressure_asymmetry", Location("actuator", "a"), {"difference": 0.1, "venting": 0.001})]
    found = pressures(asymmetry, rates)[:, 0]
    assert found[120] == pytest.approx(0.1 * (1 - np.exp(-1.1)), rel=0.05)
    assert found[499] == pytest.approx(0.1, rel=0.02)
    assert found[539] == pytest.approx(-0.1, rel=0.1)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("pressure_leak", {"rate": 1e-9}),
        ("supply_coupling", {"coupling": 1e-9}),
    ],
)
def test_a_weak_supply_leaves_what_laws_before_it_have_done(name, parameters):
    """A chamber that is filled half as far as it is told, or that leaks, long after it was told to be full."""
    rates, location = np.repeat([[2.0, 0.0, 0.0]], 2000, axis=0), Location("actuator", "a")
    before = [Effect("actuator_gain", location, {"gain": 0.5})]
    if name == "supply_coupling":
        before = [Effect("pressure_leak", location, {"rate": 5.0})]
    found = pressures([*before, Effect(name, location, parameters)], rates, CLOSED)
    assert found[:, 0] == pytest.approx(pressures(before, rates, CLOSED)[:, 0], abs=1e-5)


ON_CHAMBERS = [name for name, law in PHYSICS.items() if issubclass(law, SetpointLaw) and name != "lost_motion"]


@pytest.mark.parametrize("name", ON_CHAMBERS)  # lost motion is of servos of positions
def test_a_law_of_the_chambers_without_magnitude_moves_the_walker_bit_for_bit_as_before(name):
    null = {q.name: q.null if i == 0 else q.typical for i, q in enumerate(QUANTITIES[name])}
    assert np.array_equal(walk([Effect(name, Location("actuator", "*"), null)]), walk(None))


def walk(effects):
    """(3, n) observations of a walker under random rates of inflation."""
    task, rng = (
        make_task("MultiGait-v0", 1, 1, "coarse", action="continuous", effects=effects),
        np.random.default_rng(0),
    )
    task.reset(np.arange(1), [rng], [{}])
    return np.concatenate([task.step(np.arange(1), rng.uniform(-0.3, 1, (1, 3))).observation for _ in range(3)])


WEAK = {
    "pressure_leak": {"rate": 2.0},
    "supply_coupling": {"coupling": 0.5},
    "pressure_asymmetry": {"difference": 1.0, "venting": 0.1},
}


@pytest.mark.parametrize("name", WEAK)
def test_a_walker_whose_supply_is_weak_is_inflated_less(name):
    inflation = []
    for effects in ((), [Effect(name, Location("actuator", "*"), WEAK[name])]):
        task = make_task("MultiGait-v0", 1, 1, "coarse", action="continuous", effects=effects)
        task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
        task.step(np.arange(1), np.ones((1, 3), np.float32))
        inflation.append(task.sim.batch.act[0].mean())
    assert inflation[1] < 0.9 * inflation[0]


TIMESTEP, FRICTION, GRAVITY = 0.001, 0.3, 9.81


BLOCK = f"""<mujoco><option timestep="{TIMESTEP}"/>
<default><geom friction="{FRICTION} 0 0" solref="0.004 1"/></default>
<worldbody><geom name="ground" type="plane" size="5 5 0.1"/><body name="block" pos="0 0 0.009996"><freejoint/>
<geom name="block" type="box" size="0.05 0.05 0.01" mass="0.2"/></body></worldbody></mujoco>"""


def slide(effects, velocity=0.0, tilt=0.0, gravity=GRAVITY, duration=1.0, height=0.0, xml=BLOCK):
    """(T, 3) m, the way of a block on a plane, or above it, that is tilted about y (a slope down along +x) [rad]."""
    model = instrument(mujoco.MjSpec.from_string(xml)).compile()
    sim = Simulation(model, ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.batch.expand("opt.gravity")[:] = gravity * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    sim.batch.qvel[0, 0] = velocity
    sim.batch.qpos[0, 2] += height
    sim.begin(np.arange(1))
    way = []
    for _ in range(round(duration / TIMESTEP)):
        sim.step(np.arange(1), 1)
        way.append(sim.batch.qpos[0, :3].copy())
    return np.array(way) - [0, 0, 0.01]


def on_block(name, **values):
    return [Effect(name, Location("geom", "block"), values)]


@pytest.mark.parametrize(("slope", "factor"), [(0.8, 1.0), (-0.8, 2.0)])
def test_anisotropic_friction_brakes_more_one_way(slope, factor):
    """A block that slides down a slope in 1 s, along x or against it."""
    way = slide(on_block("anisotropic_friction", excess=1.0), tilt=np.arctan(slope))[-1, 0]
    expected = 0.5 * GRAVITY * (abs(slope) - factor * FRICTION) / np.hypot(1, slope)
    assert way * np.sign(slope) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("excess", "velocity", "rests"), [(0.0, 0.0, False), (1.0, 0.0, True), (1.0, 0.3, False)])
def test_stiction_holds_what_rests_and_not_what_slides(excess, velocity, rests):
    """On a slope of tan 0.45, between the friction of sliding, 0.3, and that of rest, 0.6."""
    way = slide(on_block("stiction", excess=excess, velocity=0.02), velocity, tilt=np.arctan(0.45))
    acceleration = GRAVITY * (0.45 - FRICTION) / np.hypot(1, 0.45)
    expected = 0.0 if rests else velocity + 0.5 * acceleration
    assert way[-1, 0] == pytest.approx(expected, rel=0.05, abs=0.01)


@pytest.mark.parametrize("name", ["anisotropic_friction", "stiction"])
def test_friction_that_depends_on_a_velocity_needs_a_geom_that_moves(name):
    with pytest.raises(EffectError, match="geom ground never moves"):
        slide([Effect(name, Location("geom", "ground"), {})])


@pytest.mark.parametrize(("pull", "holds"), [(0.8, True), (1.2, False)])
@pytest.mark.parametrize("solref", ["0.004 1", "0.02 1", "0.1 1", "-2500 -100"])
def test_adhesion_holds_up_to_its_force(pull, holds, solref):
    """A block that hangs from the plane by its four corners, pulled at with ``pull`` times what they hold; stiff and
    soft ones."""
    law, xml = on_block("adhesion", force=0.2 * GRAVITY / pull / 4), BLOCK.replace("0.004 1", solref)
    assert (slide(law, gravity=-GRAVITY, duration=1.0, xml=xml)[-1, 2] < 0.02) == holds


def test_adhesion_does_not_cushion_a_fall():
    """A block that falls 2 cm meets the plane as it would without."""
    before = slide([], gravity=GRAVITY, height=0.02, duration=0.2)
    after = slide(on_block("adhesion", force=1e-6), gravity=GRAVITY, height=0.02, duration=0.2)
    assert np.abs(after - before).max() < 1e-4


UNITS = {
    "1", "m", "rad", "s", "kg", "N", "N m", "1/s", "1/min", "m/s", "rad/s", "1/m", "1/rad", "1/m^2", "1/rad^2", "m/N",
    "rad/(N m)", "N s/m", "N m s/rad", "N s^2/m^2",
}  # fmt: skip


ROBOTS = [*FIRST_IDS, "TrunkReach-v1"]  # the other later versions differ from it in their tasks only
SUITE = [(env_id, model) for env_id in ROBOTS for model in (task_type(env_id).cheap, task_type(env_id).accurate)]


def units(robot: Robot) -> dict[tuple[str, str, str], str]:
    """Unit of every quantity of every candidate term of a robot, by law, kind of location and quantity."""
    return {
        (one.name, one.location.kind, q.name): robot.unit_at(q.unit, one.location)
        for one in terms(robot)
        for q in one.quantities
    }


@pytest.mark.parametrize(("env_id", "model"), SUITE)
def test_every_quantity_of_every_term_of_the_suite_has_a_unit(env_id, model):
    robot = SuiteRobot(env_id, model, threads=1)
    found = units(robot)
    assert set(found.values()) <= UNITS
    # cables are pulled by lengths; chambers are inflated from 0 to 1
    length = "1" if robot.pneumatic else "m"
    assert {found[name, "actuator", "width"] for name in ("backlash", "actuator_deadband")} == {length}
    assert found["pretension", "actuator", "offset"] == length
    assert robot.setpoint_unit == length
    assert found["sensor_bias", "sensor", "x"] == "m"


@pytest.mark.parametrize(("env_id", "model"), [("TrunkReach-v0", "cable"), ("TrunkReach-v0", "flex"), SUITE[-2]])
def test_questions_about_effects_do_not_change_what_is_simulated(env_id, model):
    """Asked in every control step, with every law, beside the law that acts."""
    robot = SuiteRobot(env_id, model, threads=1)
    lag = Effect("actuator_lag", Location("actuator", EVERY), {"time_constant": 0.05})
    laws = {one.name: typical(one) for one in terms(robot) if one.location.kind != "sensor"}
    actions = np.full((3, len(robot.moves)), 0.4)
    nominal = np.array([[prior.nominal for prior in robot.priors]])

    def ask(step: int) -> None:
        for law in laws.values():
            assert robot.accepts([law])
            robot.native(law)
        assert not robot.accepts([lag, lag])

    plain, asked = (robot.simulate(actions, nominal, [[lag]], before_step=each) for each in (lambda step: None, ask))
    np.testing.assert_array_equal(plain, asked)


@pytest.mark.parametrize(
    ("actuator", "setpoint", "friction"),
    [
        ('<position name="motor" joint="hinge" kp="2" kv="0.05" forcerange="-1 1"/>', "rad", "N m"),
        ('<intvelocity name="motor" joint="hinge" kp="2" actrange="-1 1"/>', "rad", "N m"),
        ('<velocity name="motor" joint="hinge" kv="2"/>', "rad/s", "N m"),
        ('<motor name="motor" joint="hinge"/>', "N m", "N m"),
        ('<motor name="motor" joint="hinge" gear="3"/>', "1", "N m"),
    ],
)
def test_every_quantity_of_an_arm_has_the_unit_of_its_hinge_and_actuator(paths, actuator, setpoint, friction):
    own = '<position name="motor" joint="hinge" kp="2" kv="0.05" forcerange="-1 1"/>'
    assert own in ARM
    paths[0].write_text(ARM.replace(own, actuator))
    paths[1].write_text(MAP)
    robot = ModelRobot(*paths, threads=1)
    found = units(robot)
    assert set(found.values()) <= UNITS
    assert found["backlash", "actuator", "width"] == robot.setpoint_unit == setpoint
    assert found["coulomb_friction", "joint", "friction"] == friction
    assert found["sensor_bias", "sensor", "x"] == "rad"


def test_each_actuator_has_its_own_unit(paths):
    text = ARM.replace("<actuator>", '<actuator><motor name="push" joint="hinge"/>')
    paths[0].write_text(text)
    paths[1].write_text(MAP.replace('["motor"]', '["push", "motor"]', 1))
    robot = ModelRobot(*paths, threads=1)
    assert [robot.setpoint_unit_at(Location("actuator", name)) for name in ("push", "motor")] == ["N m", "rad"]
    assert robot.setpoint_unit_at(Location("actuator", EVERY)) == robot.setpoint_unit == "1"


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request):
    return SuiteRobot(request.param, threads=1)


def test_it_moves_as_its_environment_does(robot):
    """But for what its solver leaves, which is less accurate."""
    recording = record(robot.env_id, "random", robot.model_name, steps=4)
    measured = robot.measured(recording)
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    (simulated,) = robot.simulate(measured.actions, nominal, [()])
    np.testing.assert_allclose(simulated, measured.values, atol=1e-6)  # m


def test_every_kind_of_effect_that_it_can_have_is_suspected(robot):
    found = {one.name for one in terms(robot)}
    assert {"actuator_delay", "actuator_gain", "local_stiffness", "base_tilt", "sensor_bias"} <= found
    assert ("pressure_leak" in found) == robot.pneumatic == (robot.env_id == "MultiGait-v0")
    assert ("coulomb_friction" in found) != robot.pneumatic
    assert ("adhesion" in found) == (not robot.env_id.startswith("TrunkReach"))  # which touches nothing
    assert ("stiction" in found) == robot.env_id.startswith((
        "TrunkPush",
        "TrunkLift",
        "TrunkGrasp",
    ))  # an object slides
    assert ("viscoelastic_creep" in found) != robot.pneumatic  # also beside an object that has no springs


def test_it_has_a_more_accurate_model_where_that_has_the_same_signal(robot):
    finer = robot.accurate()
    assert (finer is None) if robot.pneumatic else finer.model_name == "flex"


def test_other_simulations_of_it_move_like_it(robot):
    drive = Drive(np.zeros((2, *robot.actions(record(robot.env_id, "random", robot.model_name, steps=1)).shape[1:])))
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    own = robot.simulate(drive.actions, nominal, [()])
    variants = robot.variants()
    assert variants or robot.pneumatic  # whose flex has one integrator, and whose other mesh has other vertices
    for variant in variants:
        (values,) = variant([drive], nominal)
        first = values[:, :, : robot.signals[0].size].reshape(own.shape)
        np.testing.assert_allclose(first, own, atol=5e-3)  # m, of a trunk of 0.2 m


def test_every_element_of_it_is_drawn(robot):
    parameters = {prior.name: prior.nominal for prior in robot.priors}
    drawn = {location for shape in of_model(robot.model(parameters, [])) for location in shape.locations}
    kinds = ("flex",) if robot.pneumatic else ("body", "tendon", "actuator")
    assert {each for kind in kinds for each in robot.locations(kind)} <= drawn


def test_a_number_of_an_action_may_move_several_actuators():
    robot = SuiteRobot("MultiGait-v0", threads=1)
    assert robot.channels == [
        "actuator centre",
        "actuator rear_left and rear_right",
        "actuator front_left and front_right",
    ]
    assert robot.channel(Location("actuator", "front_right")) == 2
    assert robot.channel(Location("actuator", EVERY)) is None


def test_an_effect_of_the_material_at_every_body_leaves_out_a_free_object():
    robot = SuiteRobot("TrunkPush-v0", threads=1)
    assert robot.accepts([Effect("stiffening", Location("body", EVERY), {"beta": 1.0})])
    assert not robot.accepts([Effect("stiffening", Location("body", "object"), {"beta": 1.0})])


def test_what_has_no_robot_is_refused():
    with pytest.raises(ValueError, match="'Ant-v5' cannot be diagnosed; allowed are TrunkReach-v0"):
        SuiteRobot("Ant-v5")


def test_laws_that_work_between_time_steps_are_replayed_beside_others_with_the_same_bytes():
    """On two threads, each kind by simulations of its own."""
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 8)).astype(np.float32)
    payload = Effect("payload", Location("body", "vertebra7"), {"mass": 0.04})
    friction = Effect("coulomb_friction", Location("tendon", "L1"), {"friction": 1.0})
    effects = [(), (payload,), (friction,), (payload, friction)]
    found = []
    for threads in (1, 2):
        robot = SuiteRobot("TrunkReach-v0", threads=threads).shortened(2)
        parameters = np.repeat([[prior.nominal for prior in robot.priors]], len(effects), axis=0)
        found.append(robot.simulate(actions, parameters, effects))
        assert ("_second" in vars(robot)) == (threads == 2)
    assert found[0].tobytes() == found[1].tobytes()
