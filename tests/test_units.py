"""Every quantity that a diagnosis can print has a unit; and the robots of the suite, as a diagnosis simulates them."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.recording.simulated import record
from soro_bench.registration import ENV_IDS, task_type
from tests.arm import ARM, MAP

UNITS = {
    "1", "m", "rad", "s", "kg", "N", "N m", "1/s", "1/min", "m/s", "rad/s", "1/m", "1/rad", "1/m^2", "1/rad^2", "m/N",
    "rad/(N m)", "N s/m", "N m s/rad", "N s^2/m^2",
}  # fmt: skip
SUITE = [(env_id, model) for env_id in ENV_IDS for model in (task_type(env_id).cheap, task_type(env_id).accurate)]


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


@pytest.fixture(scope="module", params=ENV_IDS)
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
    assert ("adhesion" in found) == (robot.env_id != "TrunkReach-v0")  # which touches nothing
    assert ("stiction" in found) == (robot.env_id in ("TrunkPush-v0", "TrunkLift-v0"))  # where an object slides
    assert ("viscoelastic_creep" in found) != robot.pneumatic  # also beside an object that has no springs


def test_it_has_a_more_accurate_model_where_that_has_the_same_signal(robot):
    finer = robot.accurate()
    assert (finer is None) if robot.pneumatic else finer.model_name == "flex"


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
