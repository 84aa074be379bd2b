"""Parts of the diagnosis, on short recordings of the cheap trunk."""

from types import SimpleNamespace

import numpy as np
import pytest

from soro_bench.diagnosis import compare, explain, refit
from soro_bench.diagnosis.explain import Explanation
from soro_bench.diagnosis.fit import Guess, Hypothesis, bounds, fitted
from soro_bench.diagnosis.floor import numerical_floor
from soro_bench.diagnosis.localise import windows
from soro_bench.diagnosis.probe import _pushes, _responses, places
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import Measured
from soro_bench.diagnosis.screen import Lead, evidence, pairs, responses, singles
from soro_bench.diagnosis.suite_robot import SuiteRobot
from soro_bench.diagnosis.suspects import Suspect, suspect, suspects, typical
from soro_bench.effects.effect import EVERY, Effect, Port
from soro_bench.inference.clouds import LowRank
from soro_bench.models.trunk_geometry import CABLE_NAMES
from soro_bench.recording.recording import Recording, RecordingError, Signal

STEPS, SIGMA = 50, 5e-4
TRUTH = np.array([0.5, -0.4, -0.6, 0.3, 0.2])


@pytest.fixture(scope="module")
def robot():
    return SuiteRobot("TrunkReach-v0", threads=1)


@pytest.fixture(scope="module")
def actions():
    return np.repeat(np.random.default_rng(0).uniform(-1, 1, (STEPS // 5, 8)), 5, axis=0).astype(np.float32)


def problem(robot, actions, hidden=(), before_step=None):
    """A recording of the robot with other parameters, hidden effects and noise."""
    parameters = np.array([[prior.value(x) for prior, x in zip(robot.priors, TRUTH, strict=True)]])
    values = robot.simulate(actions, parameters, [hidden], before_step=before_step)[0]
    values = values + SIGMA * np.random.default_rng(1).standard_normal(values.shape)
    measured = Measured(actions, 0.05 * np.arange(1, len(actions) + 1), values, "keypoints", "m")
    return Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))


def test_a_fit_recovers_parameters_and_leaves_the_noise(robot, actions):
    """Not within the linearised errors: along the weakest combination those are too small (docs/inference.md)."""
    given = problem(robot, actions)
    (found,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert np.abs(found.x - TRUTH).max() < 0.15  # of a prior standard deviation
    assert 2 * found.cost / found.residual.size == pytest.approx(1, abs=0.1)


def test_a_fit_comes_back_from_a_bound(robot, actions):
    """Beyond it a parameter changes nothing, so a fit that could go there would stay."""
    given = problem(robot, actions)
    beyond = TRUTH.copy()
    beyond[1] = 5.0  # Poisson's ratio
    (found,) = fitted(given, [Guess(beyond)], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert robot.priors[1].value(bounds(given, ())[1, 1]) == pytest.approx(robot.priors[1].bounds[1])
    assert np.abs(found.x - TRUTH).max() < 0.15


def test_half_the_time_step_leaves_half_the_error(robot, actions):
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    motions = [robot.shortened(k).simulate(actions, nominal, [()]) for k in (1, 2, 4, 8)]
    errors = [np.abs(motion - motions[-1]).mean() for motion in motions[:-1]]
    # first order, the error of the last one included: 7 : 3 : 1
    assert errors[0] / errors[1] == pytest.approx(7 / 3, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(3, rel=0.2)


@pytest.mark.parametrize(
    ("name", "port", "coordinate"),
    [("payload", Port("body", "vertebra7"), 0.2), ("actuator_gain", Port("actuator", "L0"), 0.3)],
)
def test_screening_puts_a_hidden_effect_first(robot, actions, name, port, coordinate):
    hidden = suspect(robot, name, port)
    given = problem(robot, actions, [hidden.effect(np.array([coordinate]))])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [one for one in suspects(robot) if one.where.kind in ("body", "actuator")]
    found = evidence(given, base, candidates, responses(given, base, candidates, robot))
    (first,) = singles(found)[0].suspects
    assert (first.name, first.where) == (name, port)


def test_screening_finds_a_pair_of_hidden_effects(robot, actions):
    hidden = [suspect(robot, "payload", Port("body", "vertebra8")), suspect(robot, "backlash", Port("actuator", "L2"))]
    given = problem(robot, actions, [one.effect(np.array([0.2])) for one in hidden])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [one for one in suspects(robot) if one.name in ("payload", "backlash", "actuator_gain")]
    lead = pairs(evidence(given, base, candidates, responses(given, base, candidates, robot)))[0]
    assert {(s.name, s.where) for s in lead.suspects} == {(s.name, s.where) for s in hidden}


def test_there_is_a_suspect_for_every_place(robot):
    found = suspects(robot)
    assert len(found) > 150
    assert {s.where.name for s in found if s.name == "coulomb_friction"} == set(CABLE_NAMES)
    assert {s.where.name for s in found if s.name == "viscoelastic_creep"} == {EVERY}


def test_the_numerical_floor_is_the_difference_from_a_quarter_of_the_time_step(robot, actions):
    given = problem(robot, actions[:10])
    floor = numerical_floor(given, robot.refined()[:1], [(np.zeros(5), ())])
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    finer, plain = (each.simulate(actions[:10], nominal, [()]) for each in (robot.shortened(4), robot))
    np.testing.assert_array_equal(floor, (finer - plain).reshape(1, -1))
    assert np.abs(floor).max() > 1e-6


def test_the_numerical_floor_has_the_effects_of_a_hypothesis(robot, actions):
    given, refined = problem(robot, actions[:10]), robot.refined()[1:]
    plain = numerical_floor(given, refined, [(np.zeros(5), ())])
    gain = suspect(robot, "actuator_gain", Port("actuator", "L0"))
    assert np.abs(numerical_floor(given, refined, [(np.append(np.zeros(5), 0.5), [gain])]) - plain).max() > 1e-6


@pytest.mark.parametrize(
    ("hook", "other"), [("accepts", lambda effects: False), ("ports", lambda kind: [Port(kind, "link")] * 20)]
)
def test_the_numerical_floor_leaves_out_on_both_sides_what_a_finer_model_cannot_have(
    robot, actions, monkeypatch, hook, other
):
    """Or the difference would contain the effect itself. With more joints, a law at all of them is another one."""
    given, finer = problem(robot, actions[:10]), robot.refined()[0]
    plain = numerical_floor(given, [finer], [(np.zeros(5), ())])
    monkeypatch.setattr(finer, hook, other)
    stiffer = suspect(robot, "stiffening", Port("body", EVERY))
    assert np.array_equal(numerical_floor(given, [finer], [(np.append(np.zeros(5), 0.5), [stiffer])]), plain)


def test_a_recording_of_something_else_is_refused(robot):
    metadata = {"env_id": "TrunkReach-v0", "action": "continuous"}
    commands = {"action": Signal(0.05 * np.arange(5), np.zeros((5, 8)), "1")}
    times = 0.05 * np.arange(6)
    millimetres = Signal(times, np.zeros((6, 21, 3)), "mm", "world")
    with pytest.raises(RecordingError, match="'mm'"):
        robot.measured(Recording(commands, {"keypoints": millimetres}, {}, metadata))
    with pytest.raises(RecordingError, match="no keypoints"):
        robot.measured(Recording(commands, {"tip": Signal(times, np.zeros((6, 3)), "m")}, {}, metadata))
    with pytest.raises(RecordingError, match="shape"):
        robot.measured(
            Recording(commands, {"keypoints": Signal(times, np.zeros((6, 5, 3)), "m", "world")}, {}, metadata)
        )


def test_a_suspect_without_magnitude_is_no_effect():
    one = Suspect("actuator_gain", Port("actuator", "L0"), (0.85,), (True,))
    assert one.effect(np.zeros(1)).parameters == {"gain": 1.0}
    assert one.effect(np.array([0.2])).parameters["gain"] == pytest.approx(0.85)


def test_what_is_far_larger_than_the_sensors_noise_becomes_the_noise_and_goes_again(robot, actions):
    """And small numerical errors no longer explain anything; residuals scale with it."""
    given = problem(robot, actions)
    size = given.weight.size
    columns = SIGMA * np.array([0.2 * np.ones(size), 50 * np.ones(size)])
    given = given.with_floor(columns)
    assert not given.allowing(9 * SIGMA).rough
    rough = given.allowing(20 * SIGMA)
    assert rough.rough
    assert (rough.sigma, rough.sensor) == (20 * SIGMA, SIGMA)
    assert np.allclose(rough.floor.basis, [2.5 * np.ones(size)])
    again = rough.allowing(2 * SIGMA)
    assert not again.rough
    assert again.sigma == SIGMA


@pytest.mark.parametrize("where", [Port("tendon", "L2"), Port("body", "vertebra5")])
def test_a_force_without_a_name_is_found_at_its_place(robot, actions, where):
    """A force that comes and goes, which no law of the catalogue exerts."""
    batch, model, i = robot.simulation.batch, robot.simulation.model, robot.elements.id(where)
    for name in ("ten_J", "xfrc_applied", "qfrc_applied"):
        batch.bind(name)

    def pull(step):
        force = 1.0 + np.sin(step / 5)
        if where.kind == "body":
            batch.xfrc_applied[0, i, 0] = 0.05 * force
        else:
            entries = model.ten_J_rowadr[i] + np.arange(model.ten_J_rownnz[i])
            batch.qfrc_applied[0, model.ten_J_colind[entries]] = -force * batch.ten_J[0, entries]

    given = problem(robot, actions, before_step=pull)
    batch.xfrc_applied[:] = batch.qfrc_applied[:] = 0.0
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    best = places(given, robot, base)[0]
    assert best.where == where
    component = best.force.components.index("x" if where.kind == "body" else "pull")
    middle = (best.force.start + 0.5 * np.diff(best.force.start).mean()) / 0.05  # control steps
    truth = (0.05 if where.kind == "body" else 1.0) * (1.0 + np.sin(middle / 5))
    truth, force = truth[:-1], best.force.values[:-1, component]  # the end of the recording cuts the last window
    assert force.mean() == pytest.approx(truth.mean(), rel=0.2)
    assert np.corrcoef(force, truth)[0, 1] > 0.5
    assert best.force.units[component] == "N"
    assert best.force.left < 0.75 * given.left(base.residual)


def test_a_setpoint_that_wanders_is_found_at_its_actuator(robot, actions):
    """A servo gives way to no force, so that a pull along its cable could not stand for it."""
    batch, i = robot.simulation.batch, robot.elements.id(Port("actuator", "L2"))
    slot = robot.simulation.model.actuator_actadr[i]

    def move(step):
        batch.act[0, slot] += 0.004 * (np.sin(step / 5) - np.sin((step - 1) / 5))

    given = problem(robot, actions, before_step=move)
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    best = places(given, robot, base)[0]
    assert best.where == Port("actuator", "L2")
    assert best.force.components == ("offset",)


def test_what_pushes_a_body_and_a_law_that_does_so_too_add_up(robot, actions):
    """Drag that is known, or in a hypothesis, takes nothing from the pushes of the probes."""
    given = problem(robot, actions)
    drag, x = suspect(robot, "fluid_drag", Port("body", EVERY)), np.append(np.zeros(5), 1e-6)
    pushes = [each for each in _pushes(robot) if each.where == Port("body", "vertebra5") and each.kind == "world"]
    plain, dragged = (
        _responses(given, robot, Hypothesis(tuple(laws), x[: 5 + len(laws)], None, 0.0, None, None), pushes)
        for laws in ([], [drag])
    )
    assert np.abs(plain).max() > 1.0  # standard deviations of the noise
    assert np.abs(dragged - plain).max() < 1e-3 * np.abs(plain).max()


@pytest.mark.parametrize("length", [0.15, 0.45])
def test_windows_hold_as_many_samples_each(robot, actions, length):
    numbers = windows(problem(robot, actions), length)[:: 21 * 3]
    counts = np.bincount(numbers)[:-1]
    assert (counts == round(length / 0.05)).all()


def test_what_nothing_explains_is_unknown_and_what_something_explains_is_not(robot, actions):
    given = problem(robot, actions)
    residual = np.random.default_rng(0).standard_normal(given.weight.size)
    slope, error = np.zeros((5, residual.size)), np.zeros((0, residual.size))
    poor, good = (Hypothesis((), np.zeros(5), scale * residual, 0.0, slope, error) for scale in (5.0, 1.0))
    assert compare._unknown(given, [poor], 0.0) > 0.95
    assert compare._unknown(given, [poor, poor], 0.0) > 0.95
    assert compare._unknown(given, [poor, good], 0.0) < 0.05
    assert compare._unknown(given, [poor, good], 3000.0) > 0.95  # something else is there, which no law explains
    assert compare._unknown(given, [good], 400.0) < 0.05  # a lead that was not worth a try


def test_a_search_leaves_the_minimum_in_which_a_fit_has_ended(monkeypatch):
    """Of a cost with one every 0.5 standard deviations; the deepest is at 1."""

    class Rugged:
        robot = SimpleNamespace(priors=[SimpleNamespace(reach=np.array([-3.0, 3.0]))] * 2)

        def residuals(self, points):
            return np.array([10.0 * (x - 1.0) ** 2 + 3.0 * (1.0 - np.cos(4 * np.pi * (x - 1.0))) for x, _ in points])

        def cost(self, residual, x):
            return float(residual.sum())

    def at(x, *_):
        (residual,) = problem.residuals([(x, ())])
        return Hypothesis((), x, residual, problem.cost(residual, x), np.zeros((2, 2)), np.zeros((0, 2)))

    problem = Rugged()
    monkeypatch.setattr(refit, "fitted", lambda problem, guesses, *_: [at(g.x) for g in guesses])
    ended = at(np.array([-0.5, 2.5]))
    (found,) = refit.searched(problem, [ended], 0)
    assert found.x == pytest.approx([1.0, 1.0], abs=0.02)
    monkeypatch.setattr(refit, "fitted", lambda *_: [ended])
    assert refit.searched(problem, [found], 0) == [found]


def test_laws_of_the_class_and_place_of_the_best_lead_are_tried_whatever_they_promise(robot):
    promised = [("stribeck_friction", "L0", 1000.0), ("viscous_friction", "L1", 500.0),
                ("viscous_friction", "L0", 200.0), ("coulomb_friction", "L0", 20.0),
                ("coulomb_friction", "L1", 10.0)]  # fmt: skip
    offered = []
    for name, cable, gain in promised:
        one = suspect(robot, name, Port("tendon", cable))
        offered.append(Lead((one,), gain, np.full(one.size, 0.2), (len(offered),)))
    screened = SimpleNamespace(guess=lambda lead: lead)
    tried = explain._leads(SimpleNamespace(robot=robot), screened, offered)
    assert [lead.chosen for lead in tried] == [(0,), (1,), (3,)]


@pytest.mark.parametrize("began", ["vertebra4", "vertebra8"])
def test_a_law_begun_at_a_neighbour_ends_at_its_place(robot, actions, began):
    hidden = Effect("payload", Port("body", "vertebra6"), {"mass": 0.04})
    given = problem(robot, actions, [hidden])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [suspect(robot, "payload", Port("body", f"vertebra{k}")) for k in range(3, 10)]
    found = evidence(given, base, candidates, responses(given, base, candidates, robot))
    lead = found.lead([[one.where.name for one in candidates].index(began)])
    (payload,) = refit.refitted(given, [found.guess(lead)], found, 1)[0].effects(given.parameters)
    assert payload.where == hidden.where
    assert payload.parameters["mass"] == pytest.approx(0.04, rel=0.1)


@pytest.mark.parametrize(("name", "sides"), [("vertebra0", ["vertebra1"]), ("vertebra4", ["vertebra3", "vertebra5"])])
def test_beside_a_segment_are_the_ones_before_and_after(robot, name, sides):
    assert [port.name for port in robot.beside(Port("body", name))] == sides


def test_cables_have_no_order(robot):
    assert robot.beside(Port("tendon", "L2")) == []


def test_other_laws_are_kept_before_other_places_of_one(robot):
    given = [("viscous_friction", "L0"), ("viscous_friction", "L1"), ("viscous_friction", "L2"), ("compliance", "L1"),
             ("stribeck_friction", "L1"), ("stribeck_friction", "L0")]  # fmt: skip
    ranked = [SimpleNamespace(suspects=[suspect(robot, name, Port("tendon", cable))]) for name, cable in given]
    assert refit._varied(ranked, range(6), 2) == [ranked[0], ranked[1], ranked[3]]


def test_of_fits_of_the_same_laws_the_best_one_stays_in_the_place_of_the_first(robot):
    one, other = (suspect(robot, "coulomb_friction", Port("tendon", cable)) for cable in ("L0", "L1"))
    given = [SimpleNamespace(suspects=s, cost=c) for s, c in (((one,), 5.0), ((other,), 4.0), ((one,), 3.0))]
    assert explain._cheapest(given) == [given[2], given[1]]


def test_the_best_hypothesis_and_its_rivals_are_searched_on_and_keep_their_places(monkeypatch):
    asked = []
    monkeypatch.setattr(explain, "searched", lambda problem, some, seed: asked.extend(some) or [h.name for h in some])
    given = [SimpleNamespace(name=name, cost=cost) for name, cost in (("far", 50.0), ("best", 10.0), ("rival", 19.0))]
    found = explain._searched(None, given, 0)
    assert [h.name for h in asked] == ["best", "rival"]
    assert found == [given[0], "best", "rival"]


def test_what_is_far_beyond_the_sensors_noise_and_not_explained_is_unknown_and_not_nothing(robot, actions):
    """Even if no law promises anything."""
    given = problem(robot, actions).allowing(20 * SIGMA)
    residual = np.random.default_rng(0).standard_normal(given.weight.size)
    slope, error = np.zeros((5, residual.size)), np.zeros((0, residual.size))
    nominal = Hypothesis((), np.zeros(5), residual, 0.0, slope, error)
    lead = Hypothesis((Suspect("actuator_gain", Port("actuator", "L0"), (0.85,), (True,)),), np.zeros(6),
                      0.99 * residual, 0.0, np.zeros((6, residual.size)), error)  # fmt: skip
    found = compare.compared(Explanation(given, nominal, (lead,), 0.0, 0.0, 0.0, ()), None)
    assert found.p_value == 0.0
    assert found.unknown > 0.9


def test_a_late_sensor_shows_where_the_robot_was_before_it_moved(robot, actions):
    late = Effect("sensor_delay", Port("sensor", robot.signal), {"delay": robot.control_timestep})
    nominal = np.array([[prior.nominal for prior in robot.priors]] * 2)
    plain, delayed = robot.simulate(actions, nominal, [(), (late,)])
    robot._begin(nominal[:1], None)
    np.testing.assert_allclose(delayed, np.concatenate([robot._read(1), plain[:-1]]), atol=1e-12)


@pytest.mark.parametrize("share, first", [(0.004, "coulomb_friction"), (0.04, "stribeck_friction")])
def test_a_law_with_more_unknowns_has_to_explain_more_than_what_no_law_has_quite_right(robot, actions, share, first):
    """Stribeck friction contains Coulomb friction, so it never explains less."""
    given = problem(robot, actions)
    noise = np.random.default_rng(0).standard_normal(given.weight.size)
    all_of_it = 100_000.0

    def leaving(excess, *suspects):
        residual = noise * np.sqrt((noise.size + 2.0 * excess) / (noise @ noise))
        size = given.parameters + sum(s.size for s in suspects)
        none = np.zeros((size, noise.size))
        return Hypothesis(suspects, np.zeros(size), residual, excess, none, none[:0])

    where = Port("tendon", "L0")
    coulomb = Suspect("coulomb_friction", where, (1.0, 1e-3), (True, False))
    stribeck = Suspect("stribeck_friction", where, (1.0, 1.5, 0.01, 1e-3), (True, False, False, False))
    found = (leaving(0.0, stribeck), leaving(share * all_of_it, coulomb))
    compared = compare.compared(Explanation(given, leaving(all_of_it), found, 0.0, all_of_it, 0.0, ()), None)
    assert compared.answers[0].names == (first,)


def test_answers_are_never_certain(robot, actions):
    """However clear it is: of those that seemed so, a few were wrong."""
    given = problem(robot, actions)
    noise = np.random.default_rng(0).standard_normal(given.weight.size)
    none = np.zeros((5, noise.size))
    for scale in (1.0, 30.0):
        nominal = Hypothesis((), np.zeros(5), scale * noise, 0.0, none, none[:0])
        found = compare.compared(Explanation(given, nominal, (), 0.0, 1e5 * (scale - 1.0), 0.0, ()), None)
        assert compare.BLUNDER <= found.unknown <= 1.0 - compare.BLUNDER
        assert found.unknown + sum(a.probability for a in found.answers) == pytest.approx(1.0)


def test_a_suspect_is_screened_with_what_is_typical_and_a_share_has_no_prior_beyond_one(robot):
    for one in suspects(robot):
        assert [typical(one).parameters[q.name] for q in one.quantities] == pytest.approx(one.typical)
    weak = suspect(robot, "actuator_saturation", Port("actuator", "L0"))
    assert weak.deviations[0] == 1.0


def test_a_lead_promises_no_more_than_its_bounds_allow(robot, actions):
    given = problem(robot, actions)
    slope, error = np.zeros((5, given.weight.size)), np.zeros((0, given.weight.size))
    row = np.random.default_rng(0).standard_normal(given.weight.size)
    weak = suspect(robot, "actuator_saturation", Port("actuator", "L0"))
    for size, expected in ((0.5, 0.5), (3.0, 1.0), (-1.0, 0.0)):
        base = Hypothesis((), np.zeros(5), -size * row, 0.0, slope, error)
        lead = evidence(given, base, [weak], [row[None]]).lead([0])
        assert lead.x[-1] == pytest.approx(expected, rel=0.01)
        attained = given.excess(base.residual) - given.excess(base.residual + lead.x[-1] * row)
        assert lead.gain < attained


def test_quantities_that_can_do_nothing_are_no_unknowns(robot):
    (tilt,) = [one for one in suspects(robot) if one.name == "base_tilt"]
    assert {q.name for q in tilt.quantities} == {"about_x", "about_z"}  # the trunk hangs along -y
    assert typical(tilt).parameters["about_y"] == 0.0
    (bias,) = [one for one in suspects(robot) if one.name == "sensor_bias" and one.where.index == 3]
    assert {q.name for q in bias.quantities} == {"x", "y", "z"}


def test_an_effect_that_only_leads_to_better_parameters_is_dropped(robot, actions):
    """A fit of the parameters has ended far from where they are, and its slopes lead nowhere."""
    given = problem(robot, actions)
    x = np.where(np.arange(5) == 0, TRUTH - 1.0, TRUTH)  # too light, as if something were carried
    (residual,) = given.residuals([(x, ())])
    none = np.zeros((5, residual.size))
    stuck = Hypothesis((), x, residual, given.cost(residual, x), none, none[:0])
    candidates = [suspect(robot, "payload", Port("body", f"vertebra{k}")) for k in (6, 8)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(explain, "LACKING", 0.0)
        found = explain.explained(given, stuck, robot, [], candidates, 0)
    assert found.found == ()
    assert given.excess(found.nominal.residual) < explain.CLEAN < given.excess(residual)
