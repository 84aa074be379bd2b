"""Screening of candidates, their sizes, rivals, and what a fit knows where a joint sticks."""

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.candidates import term, terms, typical
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, descended, fitted, with_covariance
from soro_bench.diagnosis.estimation.problem import DIVERGED, Problem
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.moves import is_rival
from soro_bench.diagnosis.selection.rounds import is_discrepant
from soro_bench.diagnosis.selection.screening import evidence, pairs, responses, screen, singles
from soro_bench.diagnosis.selection.sizing import sized, smaller
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.recording import Recording, Signal
from tests import arm
from tests.arm import ARM, MAP, SIGMA, trunk_problem
from tests.test_model_probabilities import leaving

PENDULUM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="1e-4"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.1" contype="0" conaffinity="0"/></body></worldbody>
</mujoco>"""
SWING_MAP = """
[robot]
control_timestep = 0.02
[signal]
name = "angle"
joints = ["hinge"]
unit = "rad"
[initial]
joints = ["hinge"]
[parameters.damping]
fields = ["dof_damping:hinge"]
deviation = 0.3
"""
TRUTH = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 2e-4, "presliding": 1e-3})


STICKY = ARM.replace(' forcerange="-1 1"', "").replace(
    'damping="0.02"', 'damping="0.02" frictionloss="0.05" solreffriction="0.004 1"'
)
SERVO = """[parameters.stiffness]
fields = ["actuator_gainprm[0]:motor", "actuator_biasprm[1]:motor", "actuator_biasprm[2]:motor"]
deviation = 0.2
[parameters.friction]
fields = ["dof_frictionloss:hinge"]
deviation = 0.3
"""


def test_what_only_ratios_change_is_as_unknown_as_before_though_a_joint_sticks(tmp_path):
    """All forces and masses times the same number leave the motion as it is. Where the joint sticks, a slope at a point
    says otherwise."""
    model, mapping = tmp_path / "arm.xml", tmp_path / "map.toml"
    model.write_text(STICKY)
    mapping.write_text(MAP[: MAP.index("[parameters.zero]")] + SERVO)
    robot, rng = ModelRobot(model, mapping, threads=1), np.random.default_rng(0)
    goals = np.repeat(rng.uniform(-0.4, 0.4, 20), 15)[:, None]
    (angles,) = robot.simulate(goals, np.ones((1, 4)), [[]], np.zeros((1, 1)))
    angles = np.concatenate([np.zeros(1), angles.ravel()]) + 5e-4 * rng.standard_normal(len(goals) + 1)
    time = 0.02 * np.arange(len(angles))
    angles[0] = 0.0
    seen = robot.measured(Recording({"goal": Signal(time[:-1], goals)}, {"angle": Signal(time, angles, "rad")}))
    problem = unexplained(robot, (seen,), 5e-4)
    x = np.zeros(4)
    (residual,) = problem.residuals([(x, ())])
    nothing = np.zeros((0, len(residual)))
    start = Hypothesis((), x, residual, problem.cost(residual, x), np.zeros((4, len(residual))), nothing)
    (found,) = descended(problem, [start])
    scale = 1.0 / np.array([prior.deviation for prior in robot.priors])  # by which all grow alike

    def known(hypothesis):
        return 1.0 / np.sqrt(scale @ np.linalg.inv(hypothesis.covariance(problem)) @ scale)

    assert known(with_covariance(problem, found, 0)) == pytest.approx(1.0 / np.linalg.norm(scale), rel=0.3)


def screened(robot, actions, hidden, names):
    """A problem with a hidden effect, its nominal fit, candidates of some names, and the responses of all."""
    given = trunk_problem(robot, actions, [hidden.effect(np.array([0.3]))])
    base = fitted(given, [Guess(np.zeros(5))], (0.7, 0.3), seed=0)[0]
    candidates = [one for one in terms(robot) if one.name in names]
    return given, base, candidates, responses(given, base, candidates, robot)


def test_laws_that_look_alike_are_simulated_where_the_first_one_gains(robot, actions):
    hidden = term(robot, "actuator_gain", Location("actuator", "S1"))
    names = ("actuator_gain", "coulomb_friction", "load_friction")
    given, base, candidates, simulated = screened(robot, actions, hidden, names)
    found = screen(given, base, candidates, robot)
    best, first = (singles(each)[0] for each in (evidence(given, base, candidates, simulated), found))
    assert first.terms == best.terms
    assert first.gain == pytest.approx(best.gain)
    pairs_of = zip(candidates, simulated, found.responses, strict=True)
    assumed = [(one, rows) for one, own, rows in pairs_of if not np.array_equal(own, rows)]
    like = {one.location: one for one in candidates if one.name == "coulomb_friction"}
    assert assumed
    assert all(np.array_equal(rows, found.response(like[one.location])) for one, rows in assumed)


def test_laws_that_look_alike_are_simulated_where_another_law_gains_most(robot, actions):
    """A friction that grows with the load looks less like one that does not than like a motor of less force."""
    cable = Location("tendon", "L1")
    hidden = Effect("load_friction", cable, {"mu": 0.5, "presliding": 1e-4})
    given = trunk_problem(robot, actions, [hidden])
    base = fitted(given, [Guess(np.zeros(5))], (0.7, 0.3), seed=0)[0]
    names = ("actuator_saturation", "coulomb_friction", "load_friction")
    found = screen(given, base, [one for one in terms(robot) if one.name in names], robot)
    assert singles(found)[0].names == ("actuator_saturation",)
    assert term(robot, "load_friction", cable) in found.simulated


def test_of_responses_beside_another_hypothesis_those_are_simulated_again_that_gain_most(robot, actions):
    hidden = term(robot, "payload", Location("body", "vertebra7"))
    given, base, candidates, simulated = screened(robot, actions, hidden, ("payload", "actuator_gain", "rest_bend"))
    before = {one: 0.9 * rows for one, rows in zip(candidates, simulated, strict=True)}
    found = screen(given, base, candidates, robot, before)
    (first,) = singles(found)[0].terms
    assert (first.name, first.location) == (hidden.name, hidden.location)
    gains = {each.terms[0]: each.gain for each in singles(evidence(given, base, candidates, list(before.values())))}
    again = [np.array_equal(own, rows) for own, rows in zip(simulated, found.responses, strict=True) if rows.any()]
    moving = [one for one, rows in before.items() if rows.any()]
    there = max(gains, key=gains.get).location
    assert again == [gains[one] > 0.3 * max(gains.values()) or one.location == there for one in moving]
    assert 2 <= sum(again) < len(again)


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """(problem, fit, robot): a pendulum whose friction is a 16th of the typical one, and stops it no earlier."""
    folder = tmp_path_factory.mktemp("pendulum")
    paths = folder / "arm.xml", folder / "map.toml"
    for path, text in zip(paths, (PENDULUM, SWING_MAP), strict=True):
        path.write_text(text)
    robot = ModelRobot(*paths, threads=1)
    still, start = np.zeros((250, 0)), np.full((1, 1), 1.0)
    (values,) = robot.simulate(still, np.ones((1, 1)), [(TRUTH,)], start)
    values += SIGMA / 100 * np.random.default_rng(0).standard_normal(values.shape)
    measured = replace(_measured(robot, still, values), start=start)
    problem = Problem(robot, (measured,), SIGMA / 100, np.ones(values.size), LowRank(np.zeros((0, values.size))))
    return *nominal_fit(problem, [], 0), robot


def _measured(robot, actions, values):
    from soro_bench.diagnosis.robots.measured import Measured

    return Measured(actions, robot.control_timestep * np.arange(1, len(values) + 1), values, "angle", "rad")


def test_a_friction_far_below_the_typical_one_is_predicted_to_explain_most_once_it_is_sized(swing):
    problem, fit, robot = swing
    assert problem.misfit_dominated
    candidates = terms(robot)
    found = sized(problem, fit, candidates, robot)
    pairs = {a.name: (a, b) for a, b in zip(candidates, found, strict=True) if a.location == TRUTH.location}
    before, after = pairs["coulomb_friction"]
    assert after.typical[0] < 0.3 * before.typical[0] and after.typical[1] == before.typical[1]
    best = singles(evidence(problem, fit, found, responses(problem, fit, found, robot)))[0]
    (effect,) = best.effects
    assert effect.name in ("coulomb_friction", "stribeck_friction")  # which are alike but near standstill
    assert effect.parameters["friction"] == pytest.approx(2e-4, rel=0.5)


def test_a_robot_without_commands_has_no_clock_to_differ_from_its_sensor(swing):
    *_, robot = swing
    names = {term.name for term in terms(robot)}
    assert not names & {"sensor_delay", "clock_skew"} and "sensor_bias" in names


def test_nothing_is_sized_where_noise_is_all_that_is_left(swing):
    problem, fit, robot = swing
    candidates = terms(robot)
    assert sized(problem.allowing(0.0), fit, candidates, robot) == candidates


def test_samples_that_do_not_count_have_no_response_where_a_term_makes_the_robot_diverge(swing, monkeypatch):
    problem, fit, robot = swing
    counts = np.arange(problem.weight.size) % 2.0
    diverged = np.array([[0.0], [np.nan]]) + 0.0 * counts  # without the term, and with it
    monkeypatch.setattr(Problem, "simulated", lambda *_: diverged)
    one = term(robot, "viscous_friction", TRUTH.location)
    (rows,) = responses(replace(problem, weight=counts), fit, [one], robot)
    assert np.array_equal(rows[0], DIVERGED * counts)


@pytest.mark.parametrize(("misfits", "scaled"), [(7.0, False), (14.0, True)])
def test_what_would_move_the_robot_ten_times_as_far_as_it_is_off_is_scaled_down(swing, misfits, scaled):
    problem, fit, robot = swing
    one = term(robot, "viscous_friction", TRUTH.location)
    for _ in range(10):  # its response is not quite linear
        (rows,) = responses(problem, fit, [one], robot)
        response = np.linalg.norm(rows) * abs(one.simulated[0])
        one = smaller(one, misfits * np.linalg.norm(fit.residual) / response)
    assert (sized(problem, fit, [one], robot) != [one]) == scaled


@pytest.mark.parametrize(
    ("misfit", "samples", "discrepant"),
    [(8e3, 90, False), (1.3e4, 90, True), (2.1e4, 1e5, False), (3.3e4, 1e5, True)],
)
def test_parameters_hardly_cause_10000_nats_nor_a_quarter_of_a_nat_a_sample(paths, misfit, samples, discrepant):
    given = arm.problem(paths)
    size = given.weight.size
    given = replace(given, weight=np.full(size, samples / size))
    nominal = leaving(given, misfit + (samples - size) / 2)
    assert given.misfit(nominal.residual) == pytest.approx(misfit)
    assert is_discrepant(given, nominal) == discrepant


@pytest.mark.parametrize(
    ("misfit", "best", "rival"), [(1.6e3, 10.0, True), (2.6e3, 10.0, False), (6.4e3, 4e3, True), (1e4, 4e3, False)]
)
def test_a_rival_leaves_twice_as_much_as_the_best_or_as_a_healthy_robot(paths, misfit, best, rival):
    given = arm.problem(paths)
    assert is_rival(given, leaving(given, misfit), [leaving(given, best)]) == rival


def test_a_friction_that_is_far_too_large_is_scaled_down_five_times(swing):
    problem, fit, robot = swing
    stuck = smaller(term(robot, "coulomb_friction", TRUTH.location), 1e40)  # any friction beyond the weight is the same
    (rows,) = responses(problem, fit, [stuck], robot)
    response = np.linalg.norm(rows) * abs(stuck.simulated[0])
    (found,) = sized(problem, fit, [stuck], robot)
    share = np.linalg.norm(fit.residual) / response
    assert found.typical[0] == pytest.approx(share**5 * stuck.typical[0], rel=1e-6)


def test_a_free_arm_stays_as_far_off_as_the_noisy_sample_that_it_begins_at(paths):
    free = re.sub("<position .*?/>", '<velocity name="motor" joint="hinge" kv="0.05"/>', ARM)
    paths[0].write_text(free.replace('axis="0 1 0"', 'axis="0 0 1"'))  # gravity turns it nowhere
    paths[1].write_text(MAP.split("[parameters.zero]")[0])
    robot = ModelRobot(*paths, threads=1)
    goals, start = np.repeat(np.random.default_rng(0).uniform(-3, 3, 20), 15)[:, None], np.full((1, 1), 0.2)
    (values,) = robot.simulate(goals, np.ones((1, 2)), [()], start)
    measured = replace(_measured(robot, goals, values), start=start + 2.0 * SIGMA)
    given = unexplained(robot, (measured,), SIGMA)
    (residual,) = given.residuals([(np.zeros(2), ())])
    assert (residual**2).sum() > 0.9 * 4.0 * len(values)
    assert (given.discretisation.without(residual) ** 2).sum() < 0.01 * (residual**2).sum()


@pytest.mark.parametrize(
    ("name", "location", "coordinate"),
    [("payload", Location("body", "vertebra7"), 0.2), ("actuator_gain", Location("actuator", "L0"), 0.3)],
)
def test_screening_puts_a_hidden_effect_first(robot, actions, name, location, coordinate):
    hidden = term(robot, name, location)
    given = trunk_problem(robot, actions, [hidden.effect(np.array([coordinate]))])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [one for one in terms(robot) if one.location.kind in ("body", "actuator")]
    found = evidence(given, base, candidates, responses(given, base, candidates, robot))
    (first,) = singles(found)[0].terms
    assert (first.name, first.location) == (name, location)


def test_screening_finds_a_pair_of_hidden_effects(robot, actions):
    hidden = [
        term(robot, "payload", Location("body", "vertebra8")),
        term(robot, "backlash", Location("actuator", "L2")),
    ]
    given = trunk_problem(robot, actions, [one.effect(np.array([0.2])) for one in hidden])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [one for one in terms(robot) if one.name in ("payload", "backlash", "actuator_gain")]
    screened_candidate = pairs(evidence(given, base, candidates, responses(given, base, candidates, robot)))[0]
    assert {(s.name, s.location) for s in screened_candidate.terms} == {(s.name, s.location) for s in hidden}


def test_a_term_is_screened_with_what_is_typical_and_a_share_has_no_prior_beyond_one(robot):
    for one in terms(robot):
        assert [typical(one).parameters[q.name] for q in one.quantities] == pytest.approx(one.typical)
    weak = term(robot, "actuator_saturation", Location("actuator", "L0"))
    assert weak.deviations[0] == 1.0


def test_a_candidate_gains_no_more_than_its_bounds_allow(robot, actions):
    given = trunk_problem(robot, actions)
    jacobian, error = np.zeros((5, given.weight.size)), np.zeros((0, given.weight.size))
    row = np.random.default_rng(0).standard_normal(given.weight.size)
    weak = term(robot, "actuator_saturation", Location("actuator", "L0"))
    for size, expected in ((0.5, 0.5), (3.0, 1.0), (-1.0, 0.0)):
        base = Hypothesis((), np.zeros(5), -size * row, 0.0, jacobian, error)
        screened_candidate = evidence(given, base, [weak], [row[None]]).screened_candidate([0])
        assert screened_candidate.x[-1] == pytest.approx(expected, rel=0.01)
        attained = given.misfit(base.residual) - given.misfit(base.residual + screened_candidate.x[-1] * row)
        assert screened_candidate.gain < attained
