"""Where an unknown input acts, and what it is."""

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import term
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.diagnosis.localisation.test_inputs import Source, replayed, setpoints, sources
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import ARM, MAP
from tests.trunk import SIGMA, problem


@pytest.mark.parametrize("location", [Location("tendon", "L2"), Location("body", "vertebra5")])
def test_a_force_without_a_law_is_found_at_its_location(robot, actions, location):
    """A force that comes and goes, which no law of the catalogue exerts."""
    batch, model, i = robot.simulation.batch, robot.simulation.model, robot.elements.id(location)
    for name in ("ten_J", "xfrc_applied", "qfrc_applied"):
        batch.bind(name)

    def pull(step):
        force = 1.0 + np.sin(step / 5)
        if location.kind == "body":
            batch.xfrc_applied[0, i, 0] = 0.1 * force
        else:
            entries = model.ten_J_rowadr[i] + np.arange(model.ten_J_rownnz[i])
            batch.qfrc_applied[0, model.ten_J_colind[entries]] = -force * batch.ten_J[0, entries]

    given = problem(robot, actions, before_step=pull)
    batch.xfrc_applied[:] = batch.qfrc_applied[:] = 0.0
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    best = ranked_locations(given, robot, base)[0]
    assert best.location == location
    component = best.force.components.index("x" if location.kind == "body" else "pull")
    steps = best.force.start / 0.05
    truth = (0.1 if location.kind == "body" else 1.0) * (1.0 + np.sin(steps / 5))
    truth, force = truth[:-2], best.force.values[:-2, component]  # little is seen of the force at the very end
    assert force.mean() == pytest.approx(truth.mean(), rel=0.2)
    assert np.corrcoef(force, truth)[0, 1] > 0.5
    assert best.force.units[component] == "N"
    assert best.force.remaining_rms < 0.75 * given.left(base.residual)


def test_a_setpoint_that_wanders_is_found_at_its_actuator(robot, actions):
    """A servo gives way to no force, so that a pull along its cable could not stand for it."""
    batch, i = robot.simulation.batch, robot.elements.id(Location("actuator", "L2"))
    slot = robot.simulation.model.actuator_actadr[i]

    def move(step):
        batch.act[0, slot] += 0.004 * (np.sin(step / 5) - np.sin((step - 1) / 5))

    given = problem(robot, actions, before_step=move)
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    best = ranked_locations(given, robot, base)[0]
    assert best.location == Location("actuator", "L2")
    assert best.force.components == ("offset",)


def test_where_nothing_acts_no_location_is_ranked(robot, actions):
    """Any force explains a little noise."""
    given = problem(robot, actions)
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert ranked_locations(given, robot, base) == []


def test_a_test_input_on_a_body_and_a_law_that_acts_there_add_up(robot, actions):
    """Drag in a hypothesis takes nothing from the test inputs."""
    given = problem(robot, actions)
    drag, x = term(robot, "fluid_drag", Location("body", EVERY)), np.append(np.zeros(5), 1e-6)
    location, ones = Location("body", "vertebra5"), [np.ones((len(actions), 3))]
    bases = [Hypothesis(tuple(laws), x[: 5 + len(laws)], None, 0.0, None, None) for laws in ([], [drag])]
    (source,) = [
        each
        for each in sources(given, robot, bases[0])
        if each.location == location and each.unit_inputs[0].kind == "world"
    ]
    at = np.zeros(5)
    acting = [(at, source, ones), (at, Source(()), [np.zeros((len(actions), 0))])]
    plain, dragged = (np.subtract(*replayed(given, robot, base, acting)) / given.sigma for base in bases)
    assert np.abs(plain).max() > 1.0  # standard deviations of the noise
    assert np.abs(dragged - plain).max() < 1e-3 * np.abs(plain).max()


def test_a_walkers_chamber_that_is_filled_too_much_is_found():
    """It has neither tendons nor bodies with names: actuators, gravity and measured points remain."""
    robot, location = SuiteRobot("MultiGait-v0", threads=1), Location("actuator", "front_left")
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    actions = np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]], np.float32)
    more = Effect("pretension", location, {"offset": 0.1})
    values = robot.simulate(actions, nominal, [[more]])[0]
    values = values + SIGMA * np.random.default_rng(0).standard_normal(values.shape)
    measured = Measured(
        actions, robot.control_timestep * np.arange(1, len(actions) + 1), values, robot.signal, robot.unit
    )
    given = Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))
    x, n = np.zeros(len(robot.priors)), len(robot.priors)
    (residual,) = given.residuals([(x, ())])
    base = Hypothesis(
        (), x, residual, given.cost(residual, x), np.zeros((n, residual.size)), np.zeros((0, residual.size))
    )
    best = ranked_locations(given, robot, base)[0]
    assert best.location == location


def test_forces_are_found_on_a_robot_whose_actuators_have_no_state(tmp_path):
    """Its setpoints are its controls."""
    paths = tmp_path / "arm.xml", tmp_path / "arm.toml"
    link = '<body name="link" pos="0.2 0 0"><joint axis="0 1 0" stiffness="0.5" damping="0.01"/><geom size="0.02"/>'
    paths[0].write_text(ARM.replace("</body></worldbody>", f"{link}</body></body></worldbody>"))
    paths[1].write_text(MAP)
    robot = ModelRobot(*paths, threads=1)
    batch, i = robot.simulation.batch, robot.elements.id(Location("body", "link"))
    batch.bind("xfrc_applied")

    def act(step):
        batch.xfrc_applied[0, i, 2] = 0.2 * (1.0 + np.sin(step / 7))

    goals = np.repeat([0.3, -0.2, 0.4, 0.0], 40)[:, None]
    start = np.zeros((1, 1))
    (values,) = robot.simulate(goals, np.array([[1.0, 1.0, 0.0]]), [()], start, act)
    batch.xfrc_applied[:] = 0.0
    values = values + SIGMA * np.random.default_rng(0).standard_normal(values.shape)
    time = 0.02 * np.arange(1, len(goals) + 1)
    given = Problem(
        robot, (Measured(goals, time, values, robot.signal, robot.unit, start),), SIGMA, np.ones(values.size),
        LowRank(np.zeros((0, values.size))),
    )  # fmt: skip
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    turned = {source.location.name for source in sources(given, robot, base) if source.unit_inputs[0].kind == "joint"}
    assert turned == {"arm", "link"}
    np.testing.assert_array_equal(setpoints(given, robot, base)[0], goals)
    found = {site.location: site for site in ranked_locations(given, robot, base)}
    assert found[Location("body", "link")].force.remaining_rms < 0.2 * given.left(base.residual)
