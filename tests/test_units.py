"""Every quantity that a diagnosis can print has a unit; questions to a robot do not change it."""

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.registration import task_type
from tests.arm import ARM, MAP

UNITS = {
    "1", "m", "rad", "s", "kg", "N", "N m", "1/s", "1/min", "m/s", "rad/s", "1/m", "1/rad", "1/m^2", "1/rad^2", "m/N",
    "rad/(N m)", "N s/m", "N m s/rad", "N s^2/m^2",
}  # fmt: skip
ENV_IDS = ("TrunkReach-v0", "TrunkPush-v0", "TrunkLift-v0", "MultiGait-v0")
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
