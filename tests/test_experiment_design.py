"""What to record next, so that the remaining answers can be told apart."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from soro_bench.diagnosis.candidates import Term, term
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.experiment_design import (
    competing,
    motions,
    predictions,
    proposed,
    separations,
)
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, Fit
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank

SIGMA, STEPS, L2 = 5e-4, 40, Location("tendon", "L2")
NAMES = [f"cable {i}" for i in range(8)]
FIT = Fit(1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def robot():
    return SuiteRobot("TrunkReach-v0", threads=1)


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


def answers(*probabilities, residual=(0.0, 0.0)):
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
    assert proposed(problem, Comparison(tuple(answers(0.95, 0.03, 0.02)), 0.0, 1e-6)) is None
    assert proposed(problem, Comparison(tuple(answers(1.0)), 0.0, 0.5)) is None


@pytest.mark.parametrize("channels", [(2,), (1, 6), tuple(range(8))])
@pytest.mark.parametrize("timestep", [0.05, 0.6])
def test_motions_stay_in_the_action_space_and_end_where_they_began(channels, timestep):
    found = motions(channels, NAMES, timestep)
    assert len({m.words for m in found}) == len(found) >= 2
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


def test_motions_have_another_phase_for_another_seed():
    first, second = (motions((2,), NAMES, 0.05, seed)[-1].actions for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_the_evidence_is_half_the_squared_distance_in_units_of_the_noise(two_samples):
    predicted = np.array([[0.0, 0.0], [3.0, 4.0]])
    assert separations(two_samples, answers(0.5, 0.5), predicted) == pytest.approx([12.5])


def test_what_other_parameters_could_do_is_no_evidence(two_samples):
    predicted, other = np.array([[0.0, 0.0], [3.0, 4.0]]), [np.array([[30.0, 0.0]]), np.zeros((0, 2))]
    (found,) = separations(two_samples, answers(0.5, 0.5), predicted, other)
    assert found == pytest.approx(0.5 * (9 / 901 + 16))


def test_discretisation_error_takes_the_share_that_it_takes_in_the_recordings_at_hand(two_samples):
    problem = replace(two_samples, discretisation=LowRank(np.array([[3.0, 0.0]])))
    rivals = answers(0.5, 0.5, residual=(1.0, 0.0))
    assert separations(problem, rivals, np.array([[0.0, 0.0], [3.0, 4.0]])) == pytest.approx([1.25])


def test_a_prediction_that_diverges_is_no_evidence(two_samples):
    predicted = np.array([[0.0, 0.0], [3.0, np.nan]])
    assert separations(two_samples, answers(0.5, 0.5), predicted) == pytest.approx([4.5])


@pytest.mark.parametrize(
    ("probabilities", "count"),
    [((0.6, 0.3, 0.01), 2), ((0.93, 0.06), 2), ((0.6, 0.01, 0.01, 0.01), 1), ((0.01, 0.01), 1)],
)
def test_answers_compete_that_are_not_improbable(probabilities, count):
    assert len(competing(Comparison(tuple(answers(*probabilities)), 0.0, 1e-6))) == count


def test_fits_that_began_elsewhere_are_one_answer():
    one, two = answers(0.5, 0.45)
    again = replace(two, hypothesis=one.hypothesis)
    (found,) = competing(Comparison((one, again), 0.0, 1e-6))
    assert found.probability == pytest.approx(0.95)
