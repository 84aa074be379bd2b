"""How probable hypotheses are, what is said where none of them is right, and what to record next to tell them apart."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from soro_bench.diagnosis.candidates import Term, term, within
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_robot import Outliers
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.experiment_design import (
    competing,
    labels,
    motions,
    predictions,
    proposed,
    separations,
)
from soro_bench.diagnosis.selection.forward_selection import Explanation
from soro_bench.diagnosis.selection.model_probabilities import (
    Answer,
    Comparison,
    Fit,
    compared,
    shortlist,
    temperature,
)
from soro_bench.diagnosis.selection.rounds import worth
from soro_bench.diagnosis.selection.significance import alpha, p_slow, p_value, slow_variance
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import SIGMA, trunk_problem

CABLE, FIT = Location("tendon", "L0"), Fit(1.0, 1.0, 1.0)
GAIN = Term("actuator_gain", Location("actuator", "L0"), (0.85,), (True,))
COULOMB = Term("coulomb_friction", CABLE, (1.0, 1e-3), (True, False))
STRIBECK = Term("stribeck_friction", CABLE, (1.0, 1.5, 0.01, 1e-3), (True, False, False, False))


@pytest.fixture(scope="module")
def given(robot, actions):
    """A recording of the trunk."""
    return trunk_problem(robot, actions)


def noise(given):
    """(M,) white, of the size of the sensor's."""
    return np.random.default_rng(0).standard_normal(given.weight.size)


def hypothesis(given, residual, *terms):
    """A hypothesis with a residual (M,), whose parameters nothing is known of."""
    size = given.parameters + sum(one.size for one in terms)
    none = np.zeros((size, residual.size))
    return Hypothesis(terms, np.zeros(size), residual, given.cost(residual, np.zeros(size)), none, none[:0])


def leaving(given, misfit, *terms):
    """A hypothesis with a misfit [nats]."""
    white = noise(given)
    return hypothesis(given, white * np.sqrt((white.size + 2.0 * misfit) / (white @ white)), *terms)


def comparison(given, nominal, *others, predicted=0.0, remaining=0.0, heldout=None):
    """Of hypotheses, by the gains in log evidence that screening predicts at first and at last."""
    return compared(Explanation(given, nominal, others, 0.0, predicted, remaining, ()), heldout)


def answer(probability, *names):
    """An answer with effects of these names."""
    kinds = {"sensor_delay": Location("sensor", "keypoints")}
    terms = tuple(Term(name, kinds.get(name, Location("body", "vertebra4")), (0.1,), (True,)) for name in names)
    size = len(terms)
    none = np.zeros((size, 1))
    return Answer(Hypothesis(terms, np.zeros(size), np.zeros(1), 0.0, none, none), probability, 0.0, FIT, None, 0.0)


def test_a_gain_like_those_of_healthy_robots_is_no_detection():
    assert p_value(100.0) > 0.1
    assert p_value(1000.0) < 1e-3
    gumbel = DEFAULT.probabilities
    assert p_value(gumbel.healthy_gain) == pytest.approx(1.0 - math.exp(-1.0))  # of a Gumbel distribution


def test_the_temperature_grows_with_the_misfit_and_evidence_below_the_noise_does_not_cool_it():
    settings = DEFAULT.probabilities
    assert temperature(-50.0) == temperature(0.0) == settings.temperature
    assert temperature(1000.0) == settings.temperature + 1000.0 * settings.temperature_of_misfit


@pytest.mark.parametrize(
    ("answers", "unknown", "verdict"),
    [
        ([(0.8,), (0.1, "payload")], 0.1, "adequate"),
        ([(0.3, "payload"), (0.2,)], 0.5, "outside_catalogue"),
        ([(0.35, "payload"), (0.2,)], 0.45, "outside_catalogue"),
        ([(0.3, "payload"), (0.3, "payload"), (0.0,)], 0.4, "discrepancy"),
        ([(0.6, "sensor_delay"), (0.1,)], 0.3, "measurement_fault"),
    ],
)
def test_the_verdict_is_what_is_likeliest(answers, unknown, verdict):
    compared = Comparison(tuple(answer(*each) for each in answers), unknown, 0.0)
    found = Diagnosis(None, (), Outliers(0.0, 0.0), None, compared, (), None, 0.0)
    assert found.verdict == verdict


def test_the_report_is_of_the_likeliest_effect_even_if_nothing_is_the_first_answer():
    """It is likelier than nothing in two answers together, and in neither of them."""
    answers = answer(0.35), answer(0.32, "payload"), answer(0.3, "payload", "actuator_gain")
    found = Comparison(answers, 0.03, 0.5)
    assert found.detected
    assert found.best is answers[1]
    assert Comparison(answers[:2], 0.33, 0.5).best is answers[0]


def test_the_answer_that_the_report_is_of_comes_first():
    answers = (
        answer(0.34, "payload", "backlash"),
        answer(0.33, "actuator_lag", "compliance"),
        answer(0.3, "actuator_lag", "actuator_gain"),
    )
    assert Comparison(answers, 0.03, 0.0).ranked == (answers[1], answers[0], answers[2])


def test_a_misfit_that_no_law_explains_is_unknown_and_one_that_a_law_explains_is_not(given):
    nominal, poor, good = (leaving(given, misfit, *terms) for misfit, terms in ((4e4, ()), (4e4, [GAIN]), (0, [GAIN])))
    assert comparison(given, nominal, poor, predicted=1e4).unknown > 0.95
    assert comparison(given, nominal, good, predicted=1e4).unknown < 0.05
    # a law explains most, and one more is predicted to gain much: a discrepancy that no law describes
    assert comparison(given, nominal, good, predicted=1e4, remaining=3000.0).unknown > 0.95


def test_where_no_law_was_worth_a_fit_a_discrepancy_is_unknown(given):
    assert comparison(given, leaving(given, 4e4), predicted=1e5).unknown > 0.95


def test_a_misfit_far_above_the_sensors_noise_that_no_law_explains_is_unknown_and_not_nothing(given):
    """Even if no law is predicted to gain anything."""
    dominated = given.allowing(20 * SIGMA)
    white = noise(given)
    found = comparison(dominated, hypothesis(dominated, white), hypothesis(dominated, 0.99 * white, GAIN))
    assert found.p_value is None
    assert found.unknown > 0.9


RESIDUALS = {
    "white noise of twice its size": False,
    "noise that remembers a sample": False,
    "three outliers": False,
    "motion as slow as the commands": True,
}


def residual_of(given, kind):
    """(M,) of a kind."""
    (recording,) = given.recordings
    white = noise(given).reshape(recording.values.shape)
    slow = 2.0 * np.sin(2.0 * np.pi * 0.4 * recording.time)[:, None, None]
    return {
        "white noise of twice its size": 2.0 * white,
        "noise that remembers a sample": (white + np.roll(white, 1, axis=0)) / np.sqrt(2.0),
        "three outliers": white + 40.0 * (np.arange(white.size).reshape(white.shape) < 3),
        "motion as slow as the commands": white + slow,
    }[kind].ravel()


@pytest.mark.parametrize(("kind", "unknown"), RESIDUALS.items())
def test_a_residual_is_unknown_if_it_is_slower_than_noise_even_if_no_law_is_predicted_to_gain(given, kind, unknown):
    found = comparison(given, hypothesis(given, residual_of(given, kind)), predicted=50.0, remaining=50.0)
    assert found.detected == unknown
    assert (found.unknown > 0.9) == unknown


def test_the_slow_variance_is_that_of_the_motion_in_units_of_the_noise(given):
    """A sine of amplitude 2 has a variance of 2, and a lag of 0.15 s turns it by 22 degrees."""
    slow, pairs = slow_variance([(given, residual_of(given, "motion as slow as the commands"))])
    assert slow == pytest.approx(2.0 * math.cos(2.0 * math.pi * 0.4 * 0.15), rel=0.3)
    assert 0.9 * given.weight.size < pairs < given.weight.size
    white, _ = slow_variance([(given, noise(given))])
    assert abs(white) < 0.1


def test_a_small_misfit_that_is_slower_than_noise_makes_a_law_worth_a_fit_that_explains_much_of_it(given):
    few = replace(given, weight=given.weight * (np.arange(given.weight.size) < 600))
    slow = hypothesis(few, few.weight * residual_of(few, "motion as slow as the commands"))
    misfit = few.misfit(slow.residual)
    assert misfit < DEFAULT.selection.least_gain / 0.2
    assert worth(few, slow, slow) == pytest.approx(max(DEFAULT.probabilities.healthy_gain, 0.2 * misfit))
    white = hypothesis(few, few.weight * noise(few))
    assert worth(few, white, white) == DEFAULT.selection.least_gain


def test_slow_variance_is_as_likely_as_not_at_its_setting():
    limit = DEFAULT.probabilities.slow_variance
    assert p_slow(limit, 1e6) == pytest.approx(alpha())
    assert p_slow(2 * limit, 1e6) < p_slow(limit, 1e6) < p_slow(limit, 100.0)  # few samples say little


@pytest.mark.parametrize(("share", "first"), [(0.009, "coulomb_friction"), (0.04, "stribeck_friction")])
def test_a_law_with_more_unknowns_has_to_explain_more_than_what_no_law_has_quite_right(given, share, first):
    """Stribeck friction contains Coulomb friction, so it never explains less."""
    nominal, whole = leaving(given, 1e5), leaving(given, 0.0, STRIBECK)
    found = comparison(given, nominal, whole, leaving(given, share * 1e5, COULOMB), predicted=1e5)
    assert found.answers[0].names == (first,)


def test_recordings_that_were_held_out_decide_between_hypotheses_that_fit_as_well(given):
    nominal, first, second = leaving(given, 1e5), leaving(given, 100.0, GAIN), leaving(given, 100.0, COULOMB)
    heldout = [leaving(given, misfit).residual for misfit in (1e5, 5e4, 100.0)]
    found = comparison(given, nominal, first, second, predicted=1e5, heldout=(given, np.array(heldout)))
    assert found.best.names == ("coulomb_friction",)
    assert found.best.heldout.explained == pytest.approx(1.0, abs=0.01)


def test_what_is_compared_has_most_evidence_whatever_round_it_is_of(given):
    """The right law is of the first round. Later rounds have more hypotheses than are compared, with one term more:
    they gain no more than a law with more unknowns always gains."""
    nominal, right = leaving(given, 2e5), leaving(given, 2000.0, COULOMB)
    count = DEFAULT.selection.candidates
    later = [leaving(given, 900.0 + k, COULOMB, GAIN) for k in range(count)]
    explanation = Explanation(given, nominal, (*later, right), 0.0, 0.0, 0.0, ())
    assert shortlist(explanation) == [nominal, right, *later[:-1]]
    settings = replace(DEFAULT, selection=replace(DEFAULT.selection, candidates=1))
    assert shortlist(replace(explanation, problem=replace(given, settings=settings))) == [nominal, right]


@pytest.mark.parametrize("misfit", [0.0, 1e6])
def test_answers_are_never_certain_and_probabilities_add_up(given, misfit):
    """However clear it is: of those that seemed so, a few were wrong."""
    found = comparison(given, leaving(given, misfit), predicted=misfit)
    mistaken = DEFAULT.probabilities.wrong_when_certain
    assert mistaken <= found.unknown <= 1.0 - mistaken
    assert found.unknown + sum(a.probability for a in found.answers) == pytest.approx(1.0)


def test_what_is_known_of_a_robot_of_the_suite_before_any_recording(robot):
    """Stiffness and mass to a quarter, Poisson's ratio to 0.03, and a wall to a centimetre."""
    lifting = SuiteRobot("TrunkLift-v0", threads=1)
    found = {prior.name: prior.deviation for prior in (*robot.priors, *lifting.priors)}
    names = "young_modulus", "trunk_mass", "poisson_ratio", "wall_offset"
    assert [found[name] for name in names] == [0.25, 0.25, 0.03, 0.01]


STEPS, L2 = 40, Location("tendon", "L2")
NAMES = [f"cable {i}" for i in range(8)]


@pytest.fixture(scope="module")
def frictions(robot):
    """A recording of a trunk whose cable L2 has dry friction, and two answers: that, and viscous friction there."""
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (STEPS // 5, 8)), 5, axis=0)
    terms = [term(robot, name, L2) for name in ("coulomb_friction", "viscous_friction")]
    guesses = [Guess(np.array([0.0] * 5 + [0.2] + [0.0] * (one.size - 1)), (one,)) for one in terms]
    parameters = np.array([[prior.nominal for prior in robot.priors]])
    (values,) = robot.simulate(actions, parameters, [[terms[0].effect(guesses[0].x[5:])]])
    values = values + SIGMA * np.random.default_rng(1).standard_normal(values.shape)
    measured = Measured(actions, 0.05 * np.arange(1, STEPS + 1), values, "keypoints", "m")
    problem = Problem(robot, (measured,), SIGMA, np.ones(values.size), LowRank(np.zeros((0, values.size))))
    hypotheses = fitted(problem, guesses, (0.1,), seed=0)
    answers = tuple(Answer(h, p, 0.0, FIT, None, 0.0) for h, p in zip(hypotheses, (0.6, 0.4), strict=True))
    return problem, Comparison(answers, 0.0, 1e-6)


def lasting(problem, duration):
    """The problem, for which recordings of a duration [s] are proposed."""
    design = replace(DEFAULT.experiment_design, duration=duration)
    return replace(problem, settings=replace(DEFAULT, experiment_design=design))


def several(*probabilities, residual=(0.0, 0.0)):
    """Answers of one effect each, at cables L0, L1, ..., the residuals of which differ by ``residual``."""
    found = []
    for i, p in enumerate(probabilities):
        one = Term("coulomb_friction", Location("tendon", f"L{i}"), (1.0, 5e-4), (True, False))
        residuals, none = i * np.array(residual), np.zeros((0, 2))
        found.append(Answer(Hypothesis((one,), np.zeros(2), residuals, 0.0, none, none), p, 0.0, FIT, None, 0.0))
    return found


@pytest.fixture
def two_samples(frictions):
    """A problem of two samples without discretisation error."""
    return replace(frictions[0], weight=np.ones(2), discretisation=LowRank(np.zeros((0, 2))))


def test_answers_of_the_same_laws_are_named_with_their_locations():
    """Also where one has a law twice."""
    one, two = several(0.6, 0.4)
    both = replace(one, hypothesis=replace(one.hypothesis, terms=one.hypothesis.terms + two.hypothesis.terms))
    first, second = (f"coulomb_friction at {each.hypothesis.terms[0].location}" for each in (one, two))
    assert labels([one]) == ["coulomb_friction"]
    assert labels([one, both]) == [first, f"{first} with {second}"]


def test_viscous_and_dry_friction_of_a_cable_are_told_apart_by_moving_it(frictions):
    problem, comparison = frictions
    found = proposed(lasting(problem, 4.0), comparison)
    assert found.motion.duration == pytest.approx(4.0)
    assert found.motion.actions.shape == (80, 8)
    assert found.motion.actions[:, 2].any()
    assert "cable L2" in found.motion.words
    assert found.separates == (("coulomb_friction", "viscous_friction"),)
    points = [(a.hypothesis.x, a.hypothesis.terms) for a in comparison.answers]
    (resting,) = separations(problem, comparison.answers, predictions(problem, np.zeros((80, 8)), points))
    assert found.evidence > 10 * resting


def test_the_same_seed_proposes_the_same_bytes(frictions):
    problem, comparison = frictions
    first, second = (proposed(lasting(problem, 1.5), comparison, seed=3) for _ in range(2))
    assert first.motion.actions.tobytes() == second.motion.actions.tobytes()
    assert replace(first, motion=second.motion) == second


def test_where_a_discrepancy_is_outside_the_catalogue_the_channel_at_its_location_moves(frictions):
    problem, comparison = lasting(frictions[0], 1.5), frictions[1]
    found = proposed(problem, comparison, unknown=Location("tendon", "S1"))
    assert "cable S1" in found.motion.words
    alone = replace(comparison, answers=comparison.answers[:1])
    assert proposed(problem, alone, unknown=Location("tendon", "S1")).separates == ()


def test_nothing_is_proposed_where_one_answer_stands_alone(frictions):
    problem, _ = frictions
    assert proposed(problem, Comparison(tuple(several(0.95, 0.03, 0.02)), 0.0, 1e-6)) is None
    assert proposed(problem, Comparison(tuple(several(1.0)), 0.0, 0.5)) is None


@pytest.mark.parametrize("channels", [(2,), (1, 6), tuple(range(8))])
@pytest.mark.parametrize("timestep", [0.05, 0.6])
def test_motions_stay_in_the_action_space_and_end_where_they_began(channels, timestep):
    found = motions(channels, NAMES, timestep)
    assert len({m.words for m in found}) == len(found) >= 1
    for motion in found:
        assert motion.actions.shape == (round(10.0 / timestep), 8)
        assert all(row in spaces.Box(-1, 1, (8,)) for row in motion.actions.astype(np.float32))
        assert motion.actions.sum(axis=0) == pytest.approx(np.zeros(8), abs=1e-9)
        assert all(motion.actions[:, list(channels)].any(axis=0))
        others = np.setdiff1d(range(8), channels)
        assert motion.actions[:, others].any() == ("others" in motion.words)


def test_motions_have_holds_slow_parts_and_fast_parts():
    words = " ".join(m.words for m in motions((2,), NAMES, 0.05))
    for part in ("fast triangles", "slow triangles", "nested loops", "holds of 4 s", "others pulled", "sums of sines"):
        assert part in words
    slow = next(m for m in motions((2,), NAMES, 0.05) if m.words.startswith("slow triangles"))
    assert np.abs(slow.actions).max() == pytest.approx(0.1)


def test_motions_that_do_not_fit_are_left_out():
    """Ten seconds are 17 control steps of the walker; triangles of eight channels take 48."""
    assert [m.words for m in motions(range(8), NAMES, 0.6)] == ["sums of sines of every channel"]


@pytest.mark.parametrize("timestep", [3.0, 5.0, 8.0, 30.0])
def test_motions_of_robots_with_few_control_steps_end_where_they_began_or_are_left_out(timestep):
    found = motions((0,), NAMES, timestep)
    assert bool(found) == (timestep < 8.0)
    assert all(np.abs(motion.actions.sum(axis=0)).max() < 1e-9 for motion in found)


def test_nothing_is_proposed_where_no_motion_fits():
    robot = SimpleNamespace(driven=np.ones(8, bool), channels=NAMES, control_timestep=30.0, channel=lambda _: 0)
    slow = SimpleNamespace(robot=robot, settings=DEFAULT, misfit=lambda _: 0.0)
    assert proposed(slow, Comparison(tuple(several(0.5, 0.5)), 0.0, 1e-6)) is None


def test_motions_leave_channels_without_a_command_alone():
    found = motions((1,), NAMES, 0.05, driven=np.arange(8) < 3)
    moved = {motion.words: np.flatnonzero(motion.actions.any(axis=0)).tolist() for motion in found}
    assert {tuple(each) for each in moved.values()} == {(1,), (0, 1, 2)}
    every = motions((0, 1, 2), NAMES, 0.05, driven=np.arange(8) < 3)
    assert all("every channel" in motion.words and not motion.actions[:, 3:].any() for motion in every)
    fixed = SimpleNamespace(robot=SimpleNamespace(driven=np.zeros(8, bool)), settings=DEFAULT)
    assert proposed(fixed, Comparison(tuple(several(0.5, 0.5)), 0.0, 1e-6)) is None


@pytest.mark.parametrize(("longest", "time"), [(8.0, 4.0), (20.0, 10.0), (300.0, 10.0)])
def test_a_slip_is_looked_for_within_the_longest_recording(longest, time):
    slip = Term("marker_slip", Location("sensor", "keypoints", 3), (2e-3, 2e-3, 2e-3, 10.0), (True, True, True, False))
    found, gain = within([slip, GAIN], longest)
    assert (found.typical, gain) == ((2e-3, 2e-3, 2e-3, time), GAIN)


def test_motions_have_another_phase_for_another_seed():
    first, second = (motions((2,), NAMES, 0.05, seed)[-1].actions for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_the_evidence_is_half_the_squared_distance_in_units_of_the_noise(two_samples):
    predicted = np.array([[0.0, 0.0], [3.0, 4.0]])
    assert separations(two_samples, several(0.5, 0.5), predicted) == pytest.approx([12.5])


def test_what_other_parameters_could_do_is_no_evidence(two_samples):
    predicted, other = np.array([[0.0, 0.0], [3.0, 4.0]]), [np.array([[30.0, 0.0]]), np.zeros((0, 2))]
    (found,) = separations(two_samples, several(0.5, 0.5), predicted, other)
    assert found == pytest.approx(0.5 * (9 / 901 + 16))


def test_discretisation_error_takes_the_share_that_it_takes_in_the_recordings_at_hand(two_samples):
    problem = replace(two_samples, discretisation=LowRank(np.array([[3.0, 0.0]])))
    rivals = several(0.5, 0.5, residual=(1.0, 0.0))
    assert separations(problem, rivals, np.array([[0.0, 0.0], [3.0, 4.0]])) == pytest.approx([1.25])


def test_a_prediction_that_diverges_is_no_evidence(two_samples):
    predicted = np.array([[0.0, 0.0], [3.0, np.nan]])
    assert separations(two_samples, several(0.5, 0.5), predicted) == pytest.approx([4.5])


@pytest.mark.parametrize(
    ("probabilities", "count"),
    [((0.6, 0.3, 0.01), 2), ((0.93, 0.06), 2), ((0.6, 0.01, 0.01, 0.01), 1), ((0.01, 0.01), 1), ((0.2,) * 5, 3)],
)
def test_answers_compete_that_are_not_improbable(probabilities, count):
    assert len(competing(Comparison(tuple(several(*probabilities)), 0.0, 1e-6))) == count


def test_fits_that_began_elsewhere_are_one_answer():
    one, two = several(0.5, 0.45)
    again = replace(two, hypothesis=one.hypothesis)
    (found,) = competing(Comparison((one, again), 0.0, 1e-6))
    assert found.probability == pytest.approx(0.95)
