"""What a diagnosis works with, on short recordings of the cheap trunk: fits, errors and candidate terms.

Model-form error: what a residual may be where simulators of a robot are apart.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import Term, term, terms, typical
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, bounds, fitted, fitted_under_discretisation
from soro_bench.diagnosis.estimation.model_form import (
    _modes,
    largest_model_form_error,
    spectrum,
    unfitted_under_model_form,
)
from soro_bench.diagnosis.estimation.problem import SimulationError
from soro_bench.diagnosis.localisation.residual_maps import windows
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.variants import trunk_chains
from soro_bench.diagnosis.selection.forward_selection import Explanation, _Search, silent
from soro_bench.diagnosis.selection.model_probabilities import compared
from soro_bench.diagnosis.selection.screening import evidence
from soro_bench.diagnosis.selection.stopping import FormJudge
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.models.trunk_geometry import CABLE_NAMES
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import SIGMA, TRUNK_TRUTH, problem, trunk_problem


def numerical_floor(given, refined, points):
    return discretisation_and_residuals(given, refined, points, ())[0]


def test_a_fit_recovers_parameters_and_leaves_the_noise(robot, actions):
    """Not within the linearised errors: there those are too small (docs/explanation/inference.md)."""
    given = trunk_problem(robot, actions)
    (found,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert np.abs(found.x - TRUNK_TRUTH).max() < 0.15  # of a prior standard deviation
    assert 2 * found.cost / found.residual.size == pytest.approx(1, abs=0.1)


def test_a_fit_comes_back_from_a_bound(robot, actions):
    """Beyond it a parameter changes nothing, so a fit that could go there would stay."""
    given = trunk_problem(robot, actions)
    beyond = TRUNK_TRUTH.copy()
    beyond[1] = 5.0  # Poisson's ratio
    (found,) = fitted(given, [Guess(beyond)], (0.7, 0.4, 0.2, 0.1, 0.05), seed=0)
    assert robot.priors[1].value(bounds(given, ())[1, 1]) == pytest.approx(robot.priors[1].bounds[1])
    assert np.abs(found.x - TRUNK_TRUTH).max() < 0.15


def test_half_the_time_step_leaves_half_the_error(robot, actions):
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    motions = [robot.shortened(k).simulate(actions, nominal, [()]) for k in (1, 2, 4, 8)]
    errors = [np.abs(motion - motions[-1]).mean() for motion in motions[:-1]]
    # first order, the error of the last one included: 7 : 3 : 1
    assert errors[0] / errors[1] == pytest.approx(7 / 3, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(3, rel=0.2)


def test_there_is_a_suspect_for_every_place(robot):
    found = terms(robot)
    assert len(found) > 150
    assert {s.location.name for s in found if s.name == "coulomb_friction"} == set(CABLE_NAMES)
    assert {s.location.name for s in found if s.name == "viscoelastic_creep"} == {EVERY}


def test_the_numerical_floor_is_the_difference_from_a_quarter_of_the_time_step(robot, actions):
    given = trunk_problem(robot, actions[:10])
    discretisation = numerical_floor(given, robot.refined()[:1], [(np.zeros(5), ())])
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    finer, plain = (each.simulate(actions[:10], nominal, [()]) for each in (robot.shortened(4), robot))
    np.testing.assert_array_equal(discretisation, (finer - plain).reshape(1, -1))
    assert np.abs(discretisation).max() > 1e-6


def test_the_numerical_floor_has_the_effects_of_a_hypothesis(robot, actions):
    given, refined = trunk_problem(robot, actions[:10]), robot.refined()[1:]
    plain = numerical_floor(given, refined, [(np.zeros(5), ())])
    gain = term(robot, "actuator_gain", Location("actuator", "L0"))
    assert np.abs(numerical_floor(given, refined, [(np.append(np.zeros(5), 0.5), [gain])]) - plain).max() > 1e-6


@pytest.mark.parametrize(
    ("hook", "other"), [("accepts", lambda effects: False), ("locations", lambda kind: [Location(kind, "link")] * 20)]
)
def test_the_numerical_floor_leaves_out_on_both_sides_what_a_finer_model_cannot_have(
    robot, actions, monkeypatch, hook, other
):
    """Or the difference would contain the effect itself. With more joints, a law at all of them is another one."""
    given, finer = trunk_problem(robot, actions[:10]), robot.refined()[0]
    plain = numerical_floor(given, [finer], [(np.zeros(5), ())])
    monkeypatch.setattr(finer, hook, other)
    stiffer = term(robot, "stiffening", Location("body", EVERY))
    assert np.array_equal(numerical_floor(given, [finer], [(np.append(np.zeros(5), 0.5), [stiffer])]), plain)


@pytest.mark.parametrize("effects", [False, True])
@pytest.mark.parametrize("lost", [1, 2])
def test_a_refined_robot_that_diverges_without_any_effect_at_every_point_is_refused(
    robot, actions, monkeypatch, effects, lost
):
    """One that does so at some, or with the effect of a hypothesis, only knows no numerical error there."""
    given, finer = trunk_problem(robot, actions[:10]), robot.refined()[0]
    simulated = finer.simulate_all

    def diverging(*args):
        (values,) = simulated(*args)
        values[:lost, 3:] = np.nan
        return [values]

    monkeypatch.setattr(finer, "simulate_all", diverging)
    gain = (term(robot, "actuator_gain", Location("actuator", "L0")),) if effects else ()
    points = [(np.full(5 + effects, at), gain) for at in (0.0, 0.1)]
    if lost == 2 and not effects:
        with pytest.raises(SimulationError, match=r"by cable diverges 0.2 s into recording 1"):
            numerical_floor(given, [finer], points)
    else:
        discretisation = numerical_floor(given, [finer], points)
        assert [not row.reshape(10, -1)[3:].any() for row in discretisation] == [True, lost == 2]


@pytest.mark.parametrize("refined", [0, 1])
def test_a_fit_beside_its_numerical_floor_is_that_after_it(robot, actions, refined):
    given, finer, guesses = trunk_problem(robot, actions[:10]), robot.refined()[:refined], [Guess(np.full(5, 0.1))]
    points = [(np.zeros(5), ())]
    beside, (one,) = fitted_under_discretisation(given, finer, points, guesses, (0.3, 0.1), seed=3)
    after = given.with_discretisation(numerical_floor(given, finer, points))
    (other,) = fitted(after, guesses, (0.3, 0.1), seed=3)
    assert np.array_equal(beside.discretisation.basis, after.discretisation.basis)
    assert np.array_equal(one.x, other.x) and one.cost == other.cost


def test_a_recording_of_something_else_is_refused(robot):
    metadata = {"env_id": "TrunkReach-v0", "action": "continuous"}
    commands = {"action": Signal(0.05 * np.arange(5), np.zeros((5, 8)), "1")}
    times = 0.05 * np.arange(6)
    millimetres = Signal(times, np.zeros((6, 21, 3)), "mm", "world")
    with pytest.raises(RecordingError, match="'mm'"):
        robot.measured(Recording(commands, {"keypoints": millimetres}, {}, metadata))
    with pytest.raises(RecordingError, match="no signal 'keypoints'"):
        robot.measured(Recording(commands, {"tip": Signal(times, np.zeros((6, 3)), "m")}, {}, metadata))
    with pytest.raises(RecordingError, match="shape"):
        robot.measured(
            Recording(commands, {"keypoints": Signal(times, np.zeros((6, 5, 3)), "m", "world")}, {}, metadata)
        )


def test_a_suspect_without_magnitude_is_no_effect():
    one = Term("actuator_gain", Location("actuator", "L0"), (0.85,), (True,))
    assert one.effect(np.zeros(1)).parameters == {"gain": 1.0}
    assert one.effect(np.array([0.2])).parameters["gain"] == pytest.approx(0.85)


def test_what_is_far_larger_than_the_sensors_noise_becomes_the_noise_and_goes_again(robot, actions):
    """And small numerical errors no longer explain anything; residuals scale with it."""
    given = trunk_problem(robot, actions)
    size = given.weight.size
    columns = SIGMA * np.array([0.2 * np.ones(size), 50 * np.ones(size)])
    given = given.with_discretisation(columns)
    assert not given.allowing(9 * SIGMA).misfit_dominated
    misfit_dominated = given.allowing(20 * SIGMA)
    assert misfit_dominated.misfit_dominated
    assert (misfit_dominated.sigma, misfit_dominated.sensor) == (20 * SIGMA, SIGMA)
    assert np.allclose(misfit_dominated.discretisation.basis, [2.5 * np.ones(size)])
    again = misfit_dominated.allowing(2 * SIGMA)
    assert not again.misfit_dominated
    assert again.sigma == SIGMA


def test_with_the_noise_of_another_problem_errors_stay_what_they_are(robot, actions):
    """What a start or a stamp is off by is a matter of the sensor, whatever counts as noise beside it."""
    given = trunk_problem(robot, actions)
    given = given.with_discretisation(3 * SIGMA * np.ones((1, given.weight.size)))
    misfit_dominated = given.allowing(20 * SIGMA)
    louder = given.with_noise_of(misfit_dominated)
    assert (louder.sigma, louder.sensor) == (20 * SIGMA, SIGMA)
    assert np.allclose(louder.sigma * louder.discretisation.basis, given.sigma * given.discretisation.basis)
    assert given.with_noise_of(given).sigma == SIGMA


@pytest.mark.parametrize("length", [0.15, 0.45])
def test_windows_hold_as_many_samples_each(robot, actions, length):
    numbers = windows(trunk_problem(robot, actions), length)[:: 21 * 3]
    counts = np.bincount(numbers)[:-1]
    assert (counts == round(length / 0.05)).all()


def test_a_late_sensor_shows_where_the_robot_was_before_it_moved(robot, actions):
    late = Effect("sensor_delay", Location("sensor", robot.signal), {"delay": robot.control_timestep})
    nominal = np.array([[prior.nominal for prior in robot.priors]] * 2)
    plain, delayed = robot.simulate(actions, nominal, [(), (late,)])
    robot._begin(nominal[:1], None)
    np.testing.assert_allclose(delayed, np.concatenate([robot._read(1), plain[:-1]]), atol=1e-12)


def test_quantities_that_can_do_nothing_are_no_unknowns(robot):
    (tilt,) = [one for one in terms(robot) if one.name == "base_tilt"]
    assert {q.name for q in tilt.quantities} == {"about_x", "about_z"}  # the trunk hangs along -y
    assert typical(tilt).parameters["about_y"] == 0.0
    (bias,) = [one for one in terms(robot) if one.name == "sensor_bias" and one.location.index == 3]
    assert {q.name for q in bias.quantities} == {"x", "y", "z"}


ERROR = 3.0  # standard deviations of the noise, rms of a slow error


LAW = Term("payload", Location("body", "vertebra4"), (0.1,), (True,))


@pytest.fixture(scope="module")
def given(robot, actions):
    """A recording of the trunk."""
    return trunk_problem(robot, actions)


@pytest.fixture(scope="module")
def white(given):
    """(M,) of the sensor's noise."""
    return np.random.default_rng(0).standard_normal(given.weight.size)


@pytest.fixture(scope="module")
def slow(given):
    """(M,) an error in the directions in which the trunk moves most, of rms ``ERROR``."""
    moved = given.measured.reshape(len(given.recordings[0].values), -1)
    modes = np.linalg.svd(moved - moved.mean(axis=0), full_matrices=False)[2][:8]
    error = (np.random.default_rng(1).standard_normal((len(moved), len(modes))) @ modes).ravel()
    return ERROR * error / np.sqrt((error**2).mean())


def hypothesis(given, residual, *terms):
    size = given.parameters + sum(term.size for term in terms)
    none = np.zeros((size, residual.size))
    return Hypothesis(terms, np.zeros(size), residual, given.cost(residual, np.zeros(size)), none, none[:0])


def healthy(*args, **kwargs):
    """The probability that nothing is missing, of ``comparison``."""
    return comparison(*args, **kwargs).nothing


def comparison(given, bound, *residuals, heldout=None, of_all=0.8):
    """Of the nominal robot with a law, by their residuals, where all laws together explain a share of the misfit."""
    given = replace(given, model_form=bound * SIGMA)
    nominal, law = (hypothesis(given, row, *terms) for row, terms in zip(residuals, ((), (LAW,)), strict=True))
    predicted, share = float(nominal.cost - law.cost), of_all * given.misfit(nominal.residual)
    trial = None if heldout is None else (given, np.array(heldout))
    return compared(Explanation(given, nominal, (law,), 0.0, predicted, 0.0, (), of_all=share), trial)


def test_noise_has_no_excess_and_an_error_has_its_own(given, white, slow):
    assert spectrum(given, white).excess < 0.25
    assert spectrum(given, white + slow).excess == pytest.approx(ERROR, rel=0.05)


def test_the_modes_of_a_long_recording_need_little_memory():
    assert np.abs(_modes(np.linspace(0.0, 1.0, 200_000)[:, None])).tolist() == [[1.0]]


def test_a_law_that_explains_a_part_of_a_possible_error_is_no_discrepancy(given, white, slow):
    left, less = white + slow, white + 0.97 * slow
    assert healthy(given, 2.0 * ERROR, left, less) > 0.5
    assert healthy(given, 0.0, left, less) < 0.1


@pytest.mark.parametrize(("bound", "is_healthy"), [(1.5, False), (20.0, True)])
def test_a_law_stands_out_by_its_share_of_the_largest_error(given, white, slow, bound, is_healthy):
    assert (healthy(given, bound * ERROR, white + slow, white + 0.8 * slow) > 0.5) == is_healthy


@pytest.mark.parametrize(("of_all", "is_healthy"), [(0.8, False), (8.0, True)])
def test_a_law_stands_out_by_its_share_of_what_all_laws_explain(given, white, slow, of_all, is_healthy):
    found = healthy(given, 3.0 * ERROR, white + slow, white + 0.8 * slow, of_all=of_all)
    assert (found > 0.5) == is_healthy


@pytest.mark.parametrize(("left", "stated"), [(0.0, 0.96), (0.5, 0.86), (1.0, 0.73), (3.0, 0.55)])
def test_the_more_is_left_the_more_may_hide_there(given, white, slow, left, stated):
    row = white + left / ERROR * slow
    assert healthy(given, 2.0 * ERROR, row, row) == pytest.approx(stated, abs=0.03)


def test_a_law_that_explains_all_of_a_possible_error_is_a_discrepancy(given, white, slow):
    assert healthy(given, 2.0 * ERROR, white + slow, white) < 0.1


@pytest.mark.parametrize(("fitted_to", "is_healthy"), [(0.97, True), (0.5, False)])
def test_a_law_has_to_explain_the_recordings_that_it_is_fitted_to(given, white, slow, fitted_to, is_healthy):
    """What moves parameters may suit held-out motion by chance, though all of the error there is gone."""
    rows = white + slow, white + fitted_to * slow
    assert (healthy(given, 2.0 * ERROR, *rows, heldout=(white + slow, white)) > 0.5) == is_healthy


@pytest.mark.parametrize(("lost", "is_known"), [(0.05, True), (0.2, False)])
def test_a_law_need_not_show_on_held_out_motion_but_does_no_harm(given, white, slow, lost, is_known):
    """It may lose a tenth there of what it gains where it was fitted, which is all of the error; else something is
    missing that the law is not."""
    worse = white + np.sqrt(1.0 + lost) * slow
    found = comparison(given, 2.0 * ERROR, white + slow, white, heldout=(white + slow, worse))
    assert found.nothing < 0.5 and (found.likeliest > 0.5) == is_known and (found.unknown > 0.5) != is_known


def test_an_error_that_is_larger_than_possible_is_a_discrepancy(given, white, slow):
    assert healthy(given, 0.5 * ERROR, white + slow, white + 0.9 * slow) < 0.1


def judged(paths, hidden, bound):
    """A fit of a healthy arm, its problem, and a judge beside a held-out recording of one with hidden effects."""
    fitted_to = replace(problem(paths), model_form=bound * SIGMA)
    (nominal,) = fitted(fitted_to, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    unfitted = None if hidden is None else replace(problem(paths, hidden, seed=1), model_form=bound * SIGMA)
    return fitted_to, nominal, FormJudge(unfitted, ())


@pytest.mark.parametrize(("gain", "bound", "possible"), [(1.0, 1.0, True), (0.9, 1.0, False), (0.9, 1e3, True)])
def test_an_error_is_possible_if_held_out_recordings_have_no_larger_one(paths, gain, bound, possible):
    hidden = [Effect("actuator_gain", Location("actuator", "motor"), {"gain": gain})]
    fitted_to, nominal, judge = judged(paths, hidden, bound)
    assert spectrum(fitted_to, nominal.residual).excess < bound  # of the recording that was fitted to
    assert judge.possible(fitted_to, nominal) is possible


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_an_error_is_possible_where_nothing_is_held_out(paths, bound):
    fitted_to, nominal, judge = judged(paths, None, bound)
    assert judge.possible(fitted_to, nominal) is (bound > 0.0)


@pytest.mark.parametrize(
    ("bound", "gain", "is_tried"), [(1.1, 1700.0, True), (1.1, 1100.0, False), (0.9, 1100.0, True), (0.9, 900.0, False)]
)
def test_a_law_that_may_stand_out_of_a_possible_error_is_fitted(paths, bound, gain, is_tried):
    """20,000 nats are left, and all laws explain them. A law has to gain a tenth of a possible error, and a fit may
    gain twice what is predicted; 1,000 are worth a fit where what is left is larger than any such error."""
    given, nominal, _ = judged(paths, None, 1.0)
    size = np.sqrt(2 * 20_000 / nominal.residual.size)
    given = replace(given, model_form=bound * size * SIGMA)
    search = _Search(given, nominal, given.robot, (), (), itertools.count(), silent)
    search.nominal = search.best = replace(nominal, residual=size * np.ones(nominal.residual.size))
    payload = term(given.robot, "payload", given.robot.locations("body")[0])
    screened = evidence(given, search.best, [payload], [np.ones((1, nominal.residual.size))])
    search.screened = replace(screened, matrix=np.eye(1), pull=np.sqrt([2 * 20_000.0]))
    search.remaining_gain = gain
    assert search.is_worth_a_round() is is_tried


def test_the_bound_of_held_out_recordings_is_that_of_their_own_motion(paths):
    moving, finer = problem(paths, seed=1), ModelRobot(*paths, threads=1, shorter=8)
    (each,) = moving.recordings
    resting = replace(moving, recordings=(each.under(np.full_like(each.actions, each.start)),))
    bounds = [unfitted_under_model_form(one, [finer], [(np.zeros(3), ())])[0].model_form for one in (resting, moving)]
    assert 0.0 < bounds[0] < 0.5 * bounds[1]


def test_a_robot_with_longer_steps_agrees_at_its_point(robot, given):
    x = np.zeros(given.parameters)
    finer = replace(given, robot=robot.shortened(2))
    (there,) = finer.residuals([(x, ())])
    (rough,) = finer.with_longer_steps(robot, x, (), there).residuals([(x, ())])
    (uncorrected,) = replace(finer, robot=robot).residuals([(x, ())])
    np.testing.assert_allclose(rough, there, atol=1e-9)
    assert np.abs(uncorrected - there).max() > 0.01  # noise deviations


def test_the_bound_is_what_parameters_cannot_change(given, slow):
    share = given.settings.discretisation.model_form_share
    apart = replace(given, discretisation=LowRank(slow[None]))
    slopes = np.zeros((given.parameters, slow.size))
    assert largest_model_form_error(apart, slopes) == pytest.approx(share * ERROR * SIGMA)
    late = replace(apart, discretisation=LowRank(np.stack([0.0 * slow, slow])), of_recordings=1)
    assert largest_model_form_error(late, slopes) == pytest.approx(share * ERROR * SIGMA)  # stamps are no simulator
    slopes[0] = slow
    bound = largest_model_form_error(apart, slopes)
    assert bound == pytest.approx(0.0, abs=1e-3 * ERROR * SIGMA)


def test_chains_of_links_move_as_the_trunk_does(robot, given):
    drives = [each.drive for each in given.recordings]
    values = given.parameter_values([np.zeros(given.parameters)])
    (plain,) = robot.simulate_all(drives, values, [()])
    for chain in trunk_chains([prior.name for prior in robot.priors], robot.control_timestep):
        (found,) = chain(drives, values)
        assert found.shape == plain.shape
        apart = np.sqrt(((found - plain) ** 2).mean())
        assert 1e-5 < apart < 0.3 * np.sqrt(((plain - plain[:, :1]) ** 2).mean())
