"""What settings of the diagnosis are for: known answers on either side, which half or twice of each gets wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.limits import limits_of
from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.data_quality import samples
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.lattice import is_lattice, lattice_step
from soro_bench.diagnosis.data_quality.noise import data_quality, outliers
from soro_bench.diagnosis.data_quality.samples import Channel
from soro_bench.diagnosis.data_quality.stamps import stamps
from soro_bench.diagnosis.estimation.model_form import UnderModelForm, largest_model_form_error
from soro_bench.diagnosis.localisation.input_models import Free, Nodes
from soro_bench.diagnosis.localisation.residual_maps import intervals, regimes
from soro_bench.diagnosis.paired.alignment import aligned
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.preparation import check_unit_and_sign
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.diagnosis.selection.experiment_design import motions
from soro_bench.diagnosis.selection.model_probabilities import temperature
from soro_bench.diagnosis.selection.significance import alpha, p_slow
from soro_bench.diagnosis.selection.stopping import is_better
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.diagnosis.spread_terms import spread
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests import arm
from tests.test_model_probabilities import comparison, leaving
from tests.test_paired import recording as pair_side

DATA = DEFAULT.data_quality
TIME = 0.02 * np.arange(400)
DAMPED = Term("viscous_friction", Location("joint", "hinge"), (1.0,), (True,))


@pytest.fixture(scope="module")
def arm_paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Model and map of an arm of one joint."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.xml").write_text(arm.ARM)
    (folder / "map.toml").write_text(arm.MAP)
    return folder / "arm.xml", folder / "map.toml"


def quiet(seed: int = 0, count: int = 400) -> Floats:
    """(T,) white noise."""
    return np.random.default_rng(seed).standard_normal(count)


def moved(count: int = 400) -> Floats:
    """(T, 1) a smooth motion."""
    return np.sin(np.arange(count) / 9.0)[:, None] + 1e-3 * quiet(1, count)[:, None]


# --- data quality ---


@pytest.mark.parametrize(("size", "refused"), [(8e3, False), (1.5e4, True)])
def test_a_signal_that_no_robot_is_large_enough_for_is_refused(size: float, refused: bool) -> None:
    measured = Measured(np.zeros((400, 1)), TIME + 0.02, size * moved()[:, :, None], "x", "m")
    if refused:
        with pytest.raises(RecordingError, match="beyond"):
            data_quality(measured, DATA)
    else:
        assert data_quality(measured, DATA).sigma > 0


@pytest.mark.parametrize(
    ("jump", "usual", "step", "outlier"),
    [
        (4.5, 0.0, 0.0, False),  # noise goes so far
        (9.0, 0.0, 0.0, True),
        (9.0, 3.0, 0.0, False),  # fast motion does
        (18.0, 3.0, 0.0, True),
        (20.0, 0.0, 14.0, False),  # the robot has moved on
        (20.0, 0.0, 7.0, True),
    ],
)
def test_an_outlier_is_far_from_noise_and_motion_which_go_on(
    jump: float, usual: float, step: float, outlier: bool
) -> None:
    """jump, usual, step: of a sample, of the others, and of the motion, in noise deviations over the root of 1.5."""
    residual = 0.5 * usual * np.where(np.arange(200) % 2, 1.0, -1.0)
    residual[100] += jump - usual if residual[100] > 0 else usual - jump
    residual[101:] += step * np.sign(residual[100])
    residual[100] += 0.5 * step * np.sign(residual[100])
    found = outliers(np.sqrt(1.5) * residual[:, None, None], DATA)
    assert found[100, 0] == outlier


@pytest.mark.parametrize(("shift", "regular"), [(0.006, True), (0.015, False)])
def test_stamps_are_regular_to_a_hundredth_of_the_period(shift: float, regular: bool) -> None:
    given = TIME + 0.02 * shift * np.random.default_rng(0).choice([0.0, 1.0], len(TIME))
    assert (stamps(given, moved(), DATA) is None) == regular


@pytest.mark.parametrize(("jump", "step"), [(0.2, False), (0.5, True)])
def test_a_clock_is_set_by_a_good_part_of_a_period(jump: float, step: bool) -> None:
    given = TIME + np.where(TIME > 3.9, 0.02 * jump, 0.0)
    found = stamps(given, moved(), DATA)
    assert found is not None
    assert ("clock_step" in found.kinds) == step


@pytest.mark.parametrize(("rough", "levels"), [(0.018, True), (0.04, False)])
def test_a_few_samples_are_on_levels_whose_changes_are_whole_steps_to_a_twentieth(rough: float, levels: bool) -> None:
    """rough: how far samples are from their levels, in steps."""
    rng = np.random.default_rng(0)
    x = rng.integers(0, 9, 15) + rough * rng.choice([-1.0, 1.0], 15)
    assert is_lattice(x, 1.0, DATA) == levels


@pytest.mark.parametrize(("count", "held"), [(8, False), (19, True)])
def test_noise_repeats_itself_by_chance_and_a_held_sensor_oftener(count: int, held: bool) -> None:
    x = moved()[:, 0] + 0.01 * quiet(2)
    at = np.linspace(20, 380, count).astype(int)
    x[at] = x[at - 1]
    _, kind = samples.stale(Channel(x, 0.01), DATA)
    assert (kind == "held") == held


def test_smooth_motion_is_not_taken_for_noise_however_large_that_is_said_to_be() -> None:
    x = np.sin(np.cumsum(np.where(np.arange(400) % 40 < 20, 0.4, 0.0)))
    assert samples.stale(Channel(x, 0.01), DATA)[1] != "held"


@pytest.mark.parametrize(("steps", "held"), [(2, False), (5, True)])
def test_values_that_stay_between_small_steps_are_slow_motion(steps: int, held: bool) -> None:
    x = 0.1 * steps * (np.arange(400) // 2).astype(float)
    assert (samples.stale(Channel(x, 0.0, 0.1), DATA)[1] == "held") == held


@pytest.mark.parametrize(("share", "held"), [(0.7e-4, False), (1.5e-4, True)])
def test_values_that_stay_between_jumps_far_below_the_range_are_rest(share: float, held: bool) -> None:
    x = share * (np.arange(400) // 2).astype(float)
    x[200:] += 1.0 - x[-1]
    assert (samples.stale(Channel(x, 0.0), DATA)[1] == "held") == held


@pytest.mark.parametrize(("levels", "found"), [(3, False), (6, True)])
def test_a_signal_has_to_have_some_levels(levels: int, found: bool) -> None:
    x = np.random.default_rng(0).integers(0, levels + 1, 400).astype(float)
    assert (lattice_step(x, 0.9, DATA) > 0) == found


@pytest.mark.parametrize(("dither", "found"), [(0.15, True), (0.18, False)])
def test_levels_under_noise_have_to_stand_out_from_chance(dither: float, found: bool) -> None:
    x = np.round(300 * moved()[:, 0]) + dither * quiet(5)
    assert (lattice_step(x, 0.5, DATA) > 0) == found


@pytest.mark.parametrize(("step", "quantised"), [(0.2, False), (0.45, True)])
def test_levels_finer_than_the_noise_do_not_count(step: float, quantised: bool, arm_paths: tuple[Path, Path]) -> None:
    whole = arm.recording(arm_paths, [], 0)
    angle = whole.signals["angle"]
    x = angle.values + 0.005 * quiet(3, len(angle.values)).reshape(angle.values.shape)
    x = 0.005 * step * np.round(x / (0.005 * step))
    given = replace(whole, signals={"angle": replace(angle, values=x)})
    found = inspected(given, 0, ModelRobot(*arm_paths, threads=1), DEFAULT)
    assert ("quantisation" in [each.name for each in found.findings]) == quantised


@pytest.mark.parametrize(("factor", "refused"), [(110.0, True), (125.0, False)])
def test_a_signal_in_another_unit_moves_nearly_as_many_times_as_far(
    factor: float, refused: bool, arm_paths: tuple[Path, Path]
) -> None:
    problem = arm.problem(arm_paths, [])
    (recording,) = problem.recordings
    given = replace(problem, recordings=(replace(recording, values=factor * recording.values),))
    if refused:
        with pytest.raises(RecordingError, match="is it in rad"):
            check_unit_and_sign(given)
    else:
        check_unit_and_sign(given)


# --- model-form error ---


@pytest.mark.parametrize(
    ("gain", "of_all", "likely"),
    [(12.0, 24.0, 0.5), (24.0, 48.0, 0.8), (24.0, 72.0, 0.5), (6.0, 150.0, 0.0)],
)
def test_a_law_is_missing_that_explains_much_and_most_of_what_all_do(gain: float, of_all: float, likely: float) -> None:
    """Even odds where it gains 1.2 % of the largest error's 1000 nats and as much as all others; with the square."""
    form = UnderModelForm(np.ones(1), 2000.0, 1.0)
    assert form.missing(np.array([gain]), of_all, DEFAULT.discretisation)[0] == pytest.approx(likely, abs=1e-3)


def test_a_model_form_error_is_three_quarters_of_what_simulators_are_apart(arm_paths: tuple[Path, Path]) -> None:
    problem = arm.problem(arm_paths, [])
    rows = 2.0 * np.ones((1, problem.weight.size))
    given = replace(problem, discretisation=LowRank(rows))
    found = largest_model_form_error(given, np.zeros((0, problem.weight.size)))
    assert found == pytest.approx(0.75 * 2.0 * problem.sigma)


# --- probabilities ---


def test_a_healthy_robot_leaves_little_slow_variance() -> None:
    """A variance of 0.12 is a discrepancy as likely as not; twice that is 32 times less likely of a healthy robot; and
    from 100 pairs of samples 0.5 says no more."""
    assert p_slow(0.12, 1e6) == pytest.approx(alpha())
    assert p_slow(0.24, 1e6) == pytest.approx(alpha() / 32.0)
    assert p_slow(0.5, 100.0) == pytest.approx(alpha())


def test_evidence_is_tempered_by_a_tenth_of_the_misfit() -> None:
    assert temperature(1e4) == pytest.approx(1100.0)


# --- localisation and motions ---


def test_an_input_is_free_ten_times_a_second_and_pulses_are_a_memory_apart(arm_paths: tuple[Path, Path]) -> None:
    problem = arm.problem(arm_paths, [])
    nodes = Nodes(problem)
    assert np.diff(nodes.time)[0] == pytest.approx(0.1)
    assert len(nodes.pulses()) == 9
    long = replace(problem, recordings=(problem.recordings[0],) * 100)
    assert 1000 <= len(Free(long, 3).nodes.time) * 3 <= 2000


def test_intervals_are_seconds_and_fast_motion_is_over_half_of_the_fastest() -> None:
    time = 0.05 * np.arange(1, 201)
    assert intervals(time, np.where((time > 2.2) & (time <= 2.4), 1.0, 0.0)) == [(2.0, 3.0)]
    rates = np.repeat([0.3, 0.7, 1.0], 100)[:, None]
    found = {each.condition: each.time for each in regimes(0.05 * np.arange(1, 301), rates, np.ones(300))}
    assert found["while it moves on, fast"] == pytest.approx(2.0 / 3.0)
    rates = np.repeat([0.0007, 0.0015, 1.0], 100)[:, None]
    found = {each.condition: each.time for each in regimes(0.05 * np.arange(1, 301), rates, np.ones(300))}
    assert found["while it rests"] == pytest.approx(1.0 / 3.0)


def test_like_elements_have_most_of_a_magnitude_in_common() -> None:
    """Of unit prior variance 0.8; the rest is their own."""
    parts = [Term("viscous_friction", Location("joint", name), (1.0,), (True,)) for name in "abc"]
    mixing = spread(parts).mixing
    assert mixing.T @ mixing == pytest.approx(0.8 + 0.2 * np.eye(3))


def test_a_staircase_holds_for_seconds_and_slow_motion_takes_ten_times_as_long() -> None:
    found = {each.words: each.actions[:, 0] for each in motions((0,), ["one"], 0.05)}
    pauses = np.diff(np.flatnonzero(found["steps of every channel with holds of 4 s"]))
    assert pauses.max() == pytest.approx(4.0 / 0.05, abs=2)
    for words, steps in (("fast", 3), ("slow", 30)):
        turns = np.flatnonzero(np.diff(np.sign(found[f"{words} triangles of every channel"])))
        assert np.diff(turns).max() == steps


# --- what laws gain by chance, and what they leave ---


@pytest.mark.parametrize(("gain", "better"), [(130.0, False), (170.0, True)])
def test_a_term_of_one_unknown_has_to_gain_150_nats(gain: float, better: bool, arm_paths: tuple[Path, Path]) -> None:
    problem = arm.problem(arm_paths, [])
    nominal = leaving(problem, 1000.0)
    assert is_better(problem, None, nominal, leaving(problem, 1000.0 - gain, DAMPED)) == better


def test_one_more_law_of_740_nats_is_as_likely_as_not_and_of_904_it_is_not(arm_paths: tuple[Path, Path]) -> None:
    """500, and 0.006 of the 40,000 that the first one explains; and 22 % more than that."""
    problem = arm.problem(arm_paths, [])
    laws = [leaving(problem, 4e4), leaving(problem, 0.0, DAMPED)]
    found = [comparison(problem, *laws, predicted=1e4, remaining=each).unknown for each in (740.0, 904.0)]
    assert found == pytest.approx([0.51, 0.73], abs=0.05)


def test_of_what_a_law_leaves_a_part_is_that_of_healthy_robots(arm_paths: tuple[Path, Path]) -> None:
    """0.066 nats of a sample. A quarter of what the nominal robot leaves beyond that is as likely as not unknown."""
    problem = arm.problem(arm_paths, [])
    healthy = 0.066 * problem.weight.sum()
    laws = [leaving(problem, 4.0 * healthy), leaving(problem, 1.75 * healthy, DAMPED)]
    assert comparison(problem, *laws, predicted=1e4).unknown == pytest.approx(0.5, abs=0.1)


def test_a_parameter_drifts_by_a_tenth_of_its_prior_from_one_diagnosis_to_the_next() -> None:
    prior = Prior("mass", "kg", 1.0, 0.2, True, (0.0, np.inf))
    assert prior.about(1.1, 0.0, DEFAULT.priors).deviation == pytest.approx(0.02)


# --- robots ---


@pytest.mark.parametrize(("every", "refused"), [(0.008, False), (0.005, True)])
def test_a_command_that_changes_often_in_a_control_step_is_refused(
    every: float, refused: bool, arm_paths: tuple[Path, Path]
) -> None:
    time = every * np.arange(200)
    whole = Signal(TIME[:40], moved(40)[:, 0], "rad")
    given = Recording({"goal": Signal(time, quiet(0, 200)[:, None])}, {"angle": whole})
    robot = ModelRobot(*arm_paths, threads=1)
    if refused:
        with pytest.raises(RecordingError, match="leaves most of it out"):
            robot.measured(given)
    else:
        assert len(robot.measured(given).time)


@pytest.mark.parametrize(("above", "share", "refused"), [(0.0014, 1.0, False), (0.003, 1.0, True), (1.0, 0.4, False)])
def test_a_command_that_a_model_mostly_clips_is_refused(
    above: float, share: float, refused: bool, tmp_path: Path
) -> None:
    """above: of a range of 2, which the command is beyond for a share of the time."""
    (tmp_path / "arm.xml").write_text(arm.ARM.replace('kv="0.05"', 'kv="0.05" ctrlrange="-1 1"'))
    (tmp_path / "map.toml").write_text(arm.MAP)
    goals = np.where(np.arange(40) < 40 * share, 1.0 + above, 0.0)[:, None]
    given = Recording({"goal": Signal(TIME[:40], goals)}, {"angle": Signal(TIME[:41], moved(41)[:, 0], "rad")})
    robot = ModelRobot(tmp_path / "arm.xml", tmp_path / "map.toml", threads=1)
    if refused:
        with pytest.raises(RecordingError, match="most of it would be lost"):
            robot.measured(given)
    else:
        assert len(robot.measured(given).time)


def test_a_proposed_motion_keeps_to_a_third_of_a_range(tmp_path: Path) -> None:
    """Of a setpoint from -1 to 1."""
    (tmp_path / "arm.xml").write_text(arm.ARM.replace('kv="0.05"', 'kv="0.05" ctrlrange="-1 1"'))
    (tmp_path / "map.toml").write_text(arm.MAP)
    robot = ModelRobot(tmp_path / "arm.xml", tmp_path / "map.toml", threads=1)
    rates = np.where(np.arange(40) < 20, 1.0, -1.0)[:, None]
    assert np.abs(robot.commanded(rates, np.zeros((40, 1)))).max() == pytest.approx(0.6)


@pytest.mark.parametrize(("steps", "told"), [(3, set()), (8, {"force_limit"})])
def test_a_limit_is_told_that_is_reached_for_a_twentieth_of_the_time(
    steps: int, told: set[str], arm_paths: tuple[Path, Path]
) -> None:
    problem = arm.problem(arm_paths, [])
    goals = np.where((np.arange(100) >= 10) & (np.arange(100) < 10 + steps), 30.0, 0.0)[:, None]
    drive = replace(problem.recordings[0].drive, actions=goals)
    found = limits_of(problem.robot, [drive], np.array([[1.0, 1.0, 0.0]]), [], DEFAULT.limits)
    assert {each.name for each in found} == told


# --- pairs ---


@pytest.mark.parametrize(("share", "refused"), [(0.025, False), (0.05, True)])
def test_commands_are_the_same_to_two_hundredths_of_their_range(share: float, refused: bool) -> None:
    """share: of its range that a command is off; half of it is what it changes in a sample."""
    one, other = pair_side(), pair_side()
    motors = other.commands["motors"]
    values = motors.values + share * np.ptp(motors.values, axis=0) * [0.0, 1.0]
    other = replace(other, commands={"motors": replace(motors, values=values)})
    if refused:
        with pytest.raises(RecordingError, match="are not the same"):
            aligned(one, other)
    else:
        aligned(one, other)


@pytest.mark.parametrize(("end", "start", "refused"), [(12.0, 8.0, True), (13.0, 5.0, False)])
def test_recordings_overlap_by_half_of_the_shorter_one(end: float, start: float, refused: bool) -> None:
    one, other = _cut(pair_side(), 0.0, end), _cut(pair_side(), start, 20.0)
    if refused:
        with pytest.raises(RecordingError):
            aligned(one, other)
    else:
        assert aligned(one, other).before.duration == pytest.approx(end - start, abs=0.1)


@pytest.mark.parametrize(
    ("runs", "grown", "verdict"),
    [
        ((1.0,), 1.004, "same"),  # p = 0.014
        ((1.0,), 1.0044, "changed"),  # p = 0.007
        ((1.0,), 1.003, "same"),  # which five blocks would call a change
        ((1.0, 1.05), 1.08, "differs"),  # as much as runs of one robot do, twice
        ((1.0, 1.05), 1.2, "changed"),
    ],
)
def test_a_difference_is_a_change_if_it_is_steady_and_beyond_that_of_runs(
    runs: tuple[float, ...], grown: float, verdict: str
) -> None:
    before = [pair_side(i, grown=each) for i, each in enumerate(runs)]
    after = pair_side(len(runs), grown=grown)
    assert compare(before, [after]).signals[0].verdict == verdict


def _cut(recording: Recording, start: float, end: float) -> Recording:
    """A part of a recording, with its time."""

    def part(signal: Signal) -> Signal:
        inside = (signal.time >= start) & (signal.time < end)
        return replace(signal, time=signal.time[inside], values=signal.values[inside])

    commands, signals = ({name: part(each) for name, each in group.items()} for group in
                         (recording.commands, recording.signals))  # fmt: skip
    return replace(recording, commands=commands, signals=signals)
