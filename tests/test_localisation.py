"""Where an unknown input acts, what it is, models of test inputs, and forces over the state."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soro_bench.diagnosis.assembly.force_against_state import force_against_state
from soro_bench.diagnosis.candidates import term
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.input_models import Free, Linear
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.diagnosis.localisation.test_inputs import Source, replayed, setpoints, sources
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import ARM, MAP, SIGMA, trunk_problem


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

    given = trunk_problem(robot, actions, before_step=pull)
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

    given = trunk_problem(robot, actions[:30], before_step=move)
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    best = ranked_locations(given, robot, base)[0]
    assert best.location == Location("actuator", "L2")
    assert best.force.components == ("offset",)


def test_where_nothing_acts_no_location_is_ranked(robot, actions):
    """Any force explains a little noise."""
    given = trunk_problem(robot, actions[:30])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert ranked_locations(given, robot, base) == []


def test_a_test_input_on_a_body_and_a_law_that_acts_there_add_up(robot, actions):
    """Drag in a hypothesis takes nothing from the test inputs."""
    given = trunk_problem(robot, actions)
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


STEPS = (120, 90)
MEMORY = 45  # control steps of 0.02 s, after which the arm has forgotten a pulse


@pytest.fixture
def problem(paths):
    """Two recordings of an arm."""
    robot, rng = ModelRobot(*paths, threads=1), np.random.default_rng(0)
    recordings = tuple(
        Measured(np.zeros((n, 1)), 0.02 * np.arange(1, n + 1), rng.standard_normal((n, 1, 1)), "angle", "rad")
        for n in STEPS
    )
    size = sum(STEPS)
    return Problem(robot, recordings, SIGMA, np.ones(size), LowRank(np.zeros((0, size))))


def test_a_free_input_is_straight_between_its_nodes(problem):
    model = Free(problem, 1)
    factors = model.factors(2.0 * model.nodes.time[:, None])
    for part, steps in zip(factors, STEPS, strict=True):
        np.testing.assert_allclose(part[:, 0], 2.0 * 0.02 * np.arange(steps))


def test_values_at_the_nodes_are_those_that_made_the_factors(problem):
    model = Free(problem, 2)
    values = np.random.default_rng(1).standard_normal((model.size, 2))
    back = model.nodes.values(model.factors(values))
    inside = np.concatenate([
        model.nodes.every * np.arange(n) < steps for n, steps in zip(model.nodes.counts, STEPS, strict=True)
    ])
    np.testing.assert_allclose(back[inside], values[inside])


def test_pulses_at_all_nodes_are_a_constant_input_and_so_are_their_responses(problem):
    """Every sample belongs to one node in each replay, so that the parts of all nodes add up to all replays."""
    model = Free(problem, 2)
    pulses = model.pulses()
    np.testing.assert_allclose(sum(np.concatenate(pulse) for pulse in pulses), 1.0)
    rows = np.random.default_rng(1).standard_normal((2, len(pulses), sum(STEPS)))
    parts = model.parts(rows).toarray().reshape(model.size, 2, -1).sum(axis=0)
    assert (np.abs(parts).sum(axis=0) > 0).all()
    late = np.concatenate([np.arange(steps) >= MEMORY for steps in STEPS])
    np.testing.assert_allclose(parts[:, late], rows.sum(axis=1)[:, late])


def test_nodes_of_long_recordings_are_farther_apart(problem):
    """However many components an input has, its values are few."""
    few, many = Free(problem, 3), Free(problem, 60)
    assert few.nodes.every < many.nodes.every
    most = problem.settings.localisation.most_values + 2 * 60 * len(STEPS)  # and two nodes at the ends
    assert many.size * 60 <= most


def test_shares_say_in_what_an_input_is_linear(problem):
    rng = np.random.default_rng(2)
    setpoints = [rng.standard_normal((steps, 2)) for steps in STEPS]
    model = Linear(problem, setpoints, ["A", "B"])
    values = np.zeros((model.size, 3))
    values[model.names.index("setpoint of B"), 0] = 3.0
    values[0, 1] = 1.0
    expected = {"setpoint of B": 0.9, "constant": 0.1, "setpoint of A": 0, "shape": 0}
    assert model.shares(values) == pytest.approx(expected)
    b = np.concatenate(setpoints)[:, 1]
    b = b - b.mean()
    np.testing.assert_allclose(np.concatenate(model.factors(values))[:, 0], 3.0 * b / np.sqrt((b**2).mean()))


@pytest.mark.filterwarnings("error")
def test_a_point_that_is_never_seen_has_no_share(problem):
    """The others have the features that they have without it."""
    setpoints = [np.arange(2.0 * steps).reshape(-1, 2) for steps in STEPS]
    never = [
        replace(each, values=np.concatenate([each.values, 0.0 * each.values[:, :1] + np.nan], axis=1))
        for each in problem.recordings
    ]
    found, other = (
        Linear(replace(problem, recordings=some), setpoints, ["A", "B"]).features
        for some in (never, problem.recordings)
    )
    np.testing.assert_allclose(np.abs(found[:, : other.shape[1]]), np.abs(other), atol=1e-9)


NOISE = 2e-4
CABLE, CHANNEL = Location("tendon", "L1"), 1


@pytest.fixture(scope="module")
def trunk():
    return SuiteRobot("TrunkReach-v0", threads=1)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.xml").write_text(ARM)
    (folder / "map.toml").write_text(MAP.replace("deviation = 0.3", "deviation = 0.001"))  # its damping is known
    return ModelRobot(folder / "arm.xml", folder / "map.toml", threads=1)


def strokes(slowness=(1, 2, 3)):
    """(T, 8) actions: one cable is pulled in by 15 mm and let out again, twice at each of several speeds."""
    rates = [sign / k for k in slowness for sign in (1, -1) for _ in range(3 * k)]
    actions = np.zeros((2 * len(rates), 8), np.float32)
    actions[:, CHANNEL] = 2 * rates
    return actions


def swings(robot):
    """(T, 1) setpoints that sweep to and fro at changing speeds."""
    time = robot.control_timestep * np.arange(200)
    return 0.5 * np.sin(2 * np.pi * (0.5 * time + 0.15 * time**2))[:, None]


def diagnosis(robot, actions, hidden, fitted, coordinates):
    """Of a robot with a hidden effect: one hypothesis with another effect, and the true parameters."""
    rng, nominal = np.random.default_rng(0), np.array([[prior.nominal for prior in robot.priors]])
    values = robot.simulate(actions, nominal, [[hidden]])[0]
    values = values + NOISE * rng.standard_normal(values.shape)
    time = robot.control_timestep * np.arange(1, len(actions) + 1)
    measured, nothing = Measured(actions, time, values, robot.signal, robot.unit), np.zeros((0, values.size))
    problem = Problem(robot, (measured,), NOISE, np.ones(values.size), LowRank(nothing))
    x = np.concatenate([np.zeros(len(robot.priors)), coordinates])
    points = np.concatenate([x[None], x + 0.05 * np.eye(len(x))])
    residuals = problem.residuals([(point, (fitted,)) for point in points])
    best = Hypothesis((fitted,), x, residuals[0], 0.0, (residuals[1:] - residuals[0]) / 0.05, nothing)
    return SimpleNamespace(explanation=SimpleNamespace(problem=problem), best=SimpleNamespace(hypothesis=best))


def curve(robot, actions, fitted, coordinates, hidden=None):
    """For a hypothesis with the hidden effect itself, if no other one is given."""
    hidden = hidden or fitted.effect(np.array(coordinates))
    return force_against_state(diagnosis(robot, actions, hidden, fitted, coordinates))


def jacobians(found, force):
    """Of straight lines through the origin, for falling and for rising states."""
    known = np.isfinite(force)
    return [(s[k] @ f[k]) / (s[k] @ s[k]) for s, f, k in zip(found.state, force, known, strict=True)]


def assert_agrees(found):
    """The recordings say what the fitted law does, at four nodes and more, within their errors or a few percent."""
    known = np.isfinite(found.measured)
    assert known.sum() >= 4
    off, least = np.abs(found.measured - found.law)[known], 0.03 * np.nanmax(np.abs(found.law))
    assert (off < np.maximum(3 * found.deviation[known], least)).all(), found


def test_viscous_friction_shows_as_a_force_against_the_speed(trunk):
    found = curve(trunk, strokes(), term(trunk, "viscous_friction", CABLE), [0.4])
    assert found.labels == ("rate of the length pulled in [mm/s]", "force in the tendon [N]")
    assert jacobians(found, found.law) == pytest.approx([-1e-3 * found.effect.parameters["damping"]] * 2, rel=0.15)
    assert_agrees(found)


def test_the_recording_shows_how_strong_the_friction_of_a_cable_is_beside_a_fit_that_is_too_weak(trunk):
    fitted, hidden = term(trunk, "viscous_friction", CABLE), Effect("viscous_friction", CABLE, {"damping": 30.0})
    found = curve(trunk, strokes((1, 2, 3, 4)), fitted, [0.25], hidden)
    assert jacobians(found, found.law) == pytest.approx([-0.0225, -0.0225], rel=0.15)
    assert jacobians(found, found.measured) == pytest.approx([-0.03, -0.03], rel=0.15)


def test_the_recording_shows_the_hidden_law_beside_a_wrong_one(arm):
    hinge = Location("joint", "hinge")
    hidden = Effect("viscous_friction", hinge, {"damping": 0.01})
    found = curve(arm, swings(arm), term(arm, "coulomb_friction", hinge), [0.15, 0.0], hidden)
    assert jacobians(found, found.measured) == pytest.approx([-0.01, -0.01], rel=0.1)
    assert found.law == pytest.approx(-0.0225 * np.sign(found.state), rel=0.05)


def test_a_delay_shows_as_a_cable_that_lags_behind_its_command(trunk):
    found = curve(trunk, strokes(), term(trunk, "actuator_delay", Location("actuator", EVERY)), [0.2])
    assert found.labels == ("rate of the command [mm/s]", "beside the command by [mm]")
    assert jacobians(found, found.law) == pytest.approx([-0.015, -0.015], rel=0.05)
    assert_agrees(found)


def test_stiffening_shows_as_a_moment_that_grows_with_the_cube_of_the_bend(trunk):
    found = curve(trunk, strokes(), term(trunk, "stiffening", Location("body", "vertebra3")), [0.6])
    assert found.labels == ("bend [rad]", "moment [N m]")
    model = trunk.model({prior.name: prior.nominal for prior in trunk.priors}, [])
    hinge = trunk.elements.joints_of(model.body("vertebra3").id, bending_only=True)[0]
    cube = -model.jnt_stiffness[hinge] * found.effect.parameters["beta"] * found.state**3
    assert found.law[:, -2:] == pytest.approx(cube[:, -2:], rel=0.1)
    assert_agrees(found)


def test_friction_in_a_joint_of_any_model_is_a_constant_moment_against_its_motion(arm):
    fitted = term(arm, "coulomb_friction", Location("joint", "hinge"))
    found = curve(arm, swings(arm), fitted, [0.3, 0.0])
    assert found.law == pytest.approx(-found.effect.parameters["friction"] * np.sign(found.state), rel=0.05)
    assert_agrees(found)


def test_a_delay_of_a_servo_of_any_model_shows_against_the_speed_of_its_command(arm):
    found = curve(arm, swings(arm), term(arm, "actuator_delay", Location("actuator", "motor")), [0.4])
    assert jacobians(found, found.law) == pytest.approx([-found.effect.parameters["delay"]] * 2, rel=0.15)
    assert_agrees(found)


@pytest.mark.parametrize(
    ("name", "location"),
    [
        ("payload", Location("body", "vertebra7")),
        ("base_tilt", Location("model", "gravity")),
    ],
)
def test_what_has_no_force_at_a_place_has_no_curve(trunk, name, location):
    fitted = term(trunk, name, location)
    assert curve(trunk, strokes((2,)), fitted, [0.2, *[0.0] * (fitted.size - 1)]) is None


def test_what_depends_on_the_past_has_no_curve(trunk):
    fitted, actions = term(trunk, "viscoelastic_creep", Location("body", EVERY)), np.zeros((70, 8), np.float32)
    actions[:5, CHANNEL], actions[35:40, CHANNEL] = 1.0, -1.0  # held between
    assert curve(trunk, actions, fitted, [0.2, -2.0]) is None


def test_a_neck_of_flex_has_no_curve_and_its_cables_have_one():
    robot = SuiteRobot("TrunkReach-v0", "flex", threads=1)
    assert curve(robot, strokes((1,)), term(robot, "stiffening", Location("body", EVERY)), [0.2]) is None
    found = curve(robot, strokes((1,)), term(robot, "viscous_friction", CABLE), [0.4])
    assert jacobians(found, found.law) == pytest.approx([-1e-3 * found.effect.parameters["damping"]] * 2, rel=0.15)


def test_a_curve_is_the_same_again_and_later_replays_are_as_before(trunk):
    for name, location in ("viscous_friction", CABLE), ("actuator_delay", Location("actuator", "L1")):
        fitted = term(trunk, name, location)
        given = diagnosis(trunk, strokes((1,)), fitted.effect(np.array([0.3])), fitted, [0.3])
        problem = given.explanation.problem
        first, before = force_against_state(given), problem.residuals([(np.zeros(6), ())])
        again, after = force_against_state(given), problem.residuals([(np.zeros(6), ())])
        assert np.array_equal(first.measured, again.measured, equal_nan=True)
        assert np.array_equal(before, after)
