"""The robots of the suite, as a diagnosis simulates them."""

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.recording.simulated import record
from soro_bench.registration import ENV_IDS


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
