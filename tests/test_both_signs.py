"""What a model has too much of is taken away, as what it lacks is added: known answers, and the search for them."""

import mujoco
import numpy as np
import pytest

from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.forward_selection import explained, nominal_fit
from soro_bench.effects.catalogue import QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, EffectError, Location
from soro_bench.effects.elements import instrument
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from tests.arm import ARM, MAP, problem

MOTOR, HINGE = Location("actuator", "motor"), Location("joint", "hinge")
SERVO = ARM.replace("<position", "<general").replace(
    'kp="2" kv="0.05"', 'gainprm="2" biastype="affine" biasprm="0 -2 -0.05"'
)
STIFF = ARM.replace('kp="2" kv="0.05"', 'kp="4" kv="0.1"')
LIMITED = ARM.replace('"-1 1"', '"-0.25 0.25"')
LATE = ARM.replace("forcerange", 'nsample="10" interp="linear" delay="0.04" forcerange')
SLOW = SERVO.replace("forcerange", 'dyntype="filterexact" actearly="true" dynprm="0.04" forcerange')
STICKY = ARM.replace('damping="0.02"', 'damping="0.02" frictionloss="0.06"')
TAKEN = {  # an effect on a model, and the same model with other numbers
    "limit": (LIMITED, Effect("actuator_saturation", MOTOR, {"loss": -1.0}), LIMITED.replace("0.25", "0.5")),
    "part of a delay": (LATE, Effect("actuator_delay", MOTOR, {"delay": -0.03}), LATE.replace("0.04", "0.01")),
    "delay": (LATE, Effect("actuator_delay", MOTOR, {"delay": -0.04}), ARM),
    "part of a filter": (SLOW, Effect("actuator_lag", MOTOR, {"time_constant": -0.03}), SLOW.replace("0.04", "0.01")),
    "filter": (SLOW, Effect("actuator_lag", MOTOR, {"time_constant": -0.04}), SERVO),
    "dry friction": (STICKY, Effect("coulomb_friction", HINGE, {"friction": -0.02}), STICKY.replace("0.06", "0.04")),
    "damping": (ARM, Effect("viscous_friction", HINGE, {"damping": -0.015}), ARM.replace("0.02", "0.005")),
    "all damping": (ARM, Effect("viscous_friction", HINGE, {"damping": -1.0}), ARM.replace("0.02", "0")),
    "softness": (ARM, Effect("compliance", MOTOR, {"compliance": -0.25}), STIFF),
}  # fmt: skip


def moved(xml, effects):
    """(300,) rad, the hinge under a changing goal."""
    sim = Simulation(instrument(mujoco.MjSpec.from_string(xml)).compile(), ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    angles = []
    for step in range(300):
        sim.batch.ctrl[:] = 0.6 * np.sin(0.05 * step) + 0.3 * (step > 150)
        sim.step(np.arange(1), 1)
        angles.append(sim.batch.qpos[0, 0])
    return np.array(angles)


@pytest.mark.parametrize("case", TAKEN)
def test_what_is_taken_away_leaves_a_model_with_less(case):
    model, effect, other = TAKEN[case]
    found, expected = moved(model, [effect]), moved(other, [])
    assert found == pytest.approx(expected, abs=1e-12)
    assert np.abs(found - moved(model, [])).max() > 1e-3


def test_nothing_is_taken_from_a_model_that_has_nothing():
    with pytest.raises(EffectError, match=r"delay of actuator_delay is -0.01.*nothing to take it from.*0 or more"):
        moved(ARM, [Effect("actuator_delay", MOTOR, {"delay": -0.01})])


TWO = LATE.replace(
    "</worldbody>", '<body pos="0 1 0"><joint name="other"/><geom size="0.1"/></body></worldbody>'
).replace("</actuator>", '<motor name="free" joint="other"/></actuator>')
BOTH = ("actuator_gain", "pretension", "local_stiffness")


@pytest.fixture
def paths(tmp_path):
    def written(xml):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        model, mapping = folder / "arm.xml", folder / "map.toml"
        model.write_text(xml)
        mapping.write_text(MAP)
        return model, mapping

    return written


def test_there_are_candidates_of_both_signs(paths):
    """Gains, offsets and stiffness have them in one term; what the model has of a law is taken away by another one."""
    found = terms(ModelRobot(*paths(TWO), threads=1))
    taken = {(each.name, str(each.location)) for each in found if each.removable}
    expected = [("actuator_delay", MOTOR), ("actuator_saturation", MOTOR), ("compliance", MOTOR)]
    assert taken == {(name, str(location)) for name, location in [*expected, ("viscous_friction", HINGE)]}
    for each in found:
        low, high = each.bounds
        assert (low[0] < 0 < high[0]) == (each.name in BOTH or (not QUANTITIES[each.name][0].takes and low[0] < 0))
        assert (low <= each.simulated).all() and (each.simulated <= high).all()
    assert set(BOTH) <= {each.name for each in found}


def test_what_all_locations_have_is_taken_away_at_all_of_them_too(paths):
    several = LIMITED.replace("</actuator>", '<motor name="second" joint="hinge" forcerange="-2 2"/></actuator>')
    found = terms(ModelRobot(*paths(several), threads=1))
    taken = [each.location for each in found if each.name == "actuator_saturation" and each.removable]
    assert taken == [Location("actuator", EVERY), MOTOR, Location("actuator", "second")]


def test_the_delay_of_a_model_is_as_long_with_shorter_time_steps(paths):
    """MuJoCo remembers a number of samples, and each is shorter then."""
    late, plain = paths(LATE), paths(ARM)
    goals = np.repeat([[0.0], [0.5]], 20, axis=0)

    def angles(robot):
        return robot.simulate(goals, np.array([[1.0, 1.0, 0.0]]), [()], np.zeros((1, 1)))[0].ravel()

    for shorter in (1, 4):
        found, undelayed = (angles(ModelRobot(*each, threads=1, shorter=shorter)) for each in (late, plain))
        assert found[22:] == pytest.approx(undelayed[20:-2], abs=1e-3)  # 0.04 s are two control steps


@pytest.mark.parametrize(
    ("model", "real", "name", "location", "value"),
    [
        (LIMITED, ARM, "actuator_saturation", MOTOR, -3.0),
        (LATE, ARM, "actuator_delay", MOTOR, -0.04),
        (STICKY, ARM, "coulomb_friction", HINGE, -0.06),
    ],
    ids=["limit", "delay", "friction"],
)
def test_what_a_model_has_too_much_of_is_found_with_its_size(paths, model, real, name, location, value):
    given = problem(paths(model), real=paths(real), steps=75)
    given, nominal = nominal_fit(given, (), 0)
    candidates = [each for each in terms(given.robot) if QUANTITIES[each.name][0].takes or each.name in BOTH]
    found = explained(given, nominal, given.robot, (), candidates, 0)
    (term,) = found.found[0].terms
    (effect,) = found.found[0].effects(given.parameters)
    assert (term.name, term.location) == (name, location)
    assert effect.parameters[QUANTITIES[name][0].name] == pytest.approx(value, rel=0.1)
