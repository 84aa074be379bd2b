"""What sensors and loggers do to signals: found in the samples, and not taken for physics of the robot."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.data_quality import samples
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.lattice import lattice_step
from soro_bench.diagnosis.data_quality.noise import data_quality, noise, outliers
from soro_bench.diagnosis.data_quality.samples import Channel
from soro_bench.diagnosis.data_quality.stamps import interpolated, stamps
from soro_bench.diagnosis.localisation.residual_maps import intervals, regimes
from soro_bench.diagnosis.outliers import _noises
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import ARM, MAP, recording, says

SETTINGS = DEFAULT.data_quality
NOISE = 1e-3


def motion(count: int = 400, seed: int = 0) -> np.ndarray:
    """A position that follows random steps, as that of a servo does."""
    goals = np.repeat(np.random.default_rng(seed).uniform(-1, 1, count // 20 + 1), 20)[:count]
    response = np.arange(30) * np.exp(-np.arange(30) / 3.0)
    return np.convolve(goals, response / response.sum())[:count]


def noisy(count: int = 400, seed: int = 0) -> np.ndarray:
    return motion(count, seed) + NOISE * np.random.default_rng(seed + 100).standard_normal(count)


@pytest.mark.parametrize("dither", [0.0, 0.2])
@pytest.mark.parametrize("levels", [20, 300, 3000])
def test_step_of_a_quantised_signal(levels, dither):
    step = np.ptp(motion()) / levels
    x = step * np.round((motion() + dither * step * np.random.default_rng(1).standard_normal(400)) / step)
    assert lattice_step(x, 0.1 * step, SETTINGS) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("counts", [[5, 4, 5], [2, 0, 2, 1], [0, 6, 9, 4, -5, -3, 6, 4]])
def test_step_of_an_encoder_that_rests_on_a_few_levels(counts):
    x = 0.0015 * np.repeat(counts, 8)
    assert lattice_step(x, 1e-6, SETTINGS) == pytest.approx(0.0015)


def test_a_robot_that_rests_at_a_few_places_has_no_levels():
    rests = np.repeat([0.11, 0.37, 0.11, 0.22, 0.53, 0.37], 8)
    assert lattice_step(rests, 1e-6, SETTINGS) == 0.0


@pytest.mark.parametrize("x", [motion(), noisy(), np.linspace(0, 1, 400), np.sin(np.arange(400) / 9)])
def test_no_step_where_there_is_none(x):
    assert lattice_step(x, 1e-6, SETTINGS) == 0.0


def test_spikes_are_found_and_a_bounce_is_not():
    x, at = noisy(), [60, 150, 151, 333]
    x[at] += 0.8
    assert np.flatnonzero(samples.spikes(x[:, None, None], NOISE, SETTINGS)).tolist() == at
    bounce = np.abs(np.linspace(-1, 1, 201))[:, None, None]
    assert not samples.spikes(bounce, 1e-6, SETTINGS).any()


@pytest.mark.parametrize(
    ("along", "at"),
    [((1.0, 1.0), []), ((0.1, 1.4), []), ((0.2, 0.2), [150, 151]), ((0.0, -1.0), [150, 151])],
)
def test_a_vibration_that_takes_the_points_beside_along_is_no_spike(along, at):
    """Trunks that vibrate at 5 Hz, sampled at 20 Hz, were "adequate but for outliers"; swapped markers are spoilt."""
    points = np.stack([noisy(seed=seed) for seed in range(9)], axis=1).reshape(400, 3, 3)
    points[150:152] += 0.8 * np.array([along[0], 1.0, along[1]])[:, None]
    assert np.flatnonzero(samples.spikes(points, NOISE, SETTINGS)[:, 1]).tolist() == at


@pytest.mark.parametrize(("along", "at"), [(0.4, []), (0.0, [150])])
def test_what_noise_alone_tells_from_the_points_beside_is_no_spike(along, at):
    """It is farther off than noise gets, but not so far from the points beside, which go along a little."""
    points = 0.3 * NOISE * np.random.default_rng(0).standard_normal((400, 3, 3))
    size = 1.4 * SETTINGS.outlier_deviations * NOISE / np.sqrt(3)
    points[150] += size * np.array([along, 1.0, along])[:, None]
    assert np.flatnonzero(samples.spikes(points, NOISE, SETTINGS)[:, 1]).tolist() == at


@pytest.mark.parametrize("rows", [1.27, 1.5, 3])
def test_a_sensor_slower_than_its_logger_gets_the_times_at_which_it_sampled(rows, tmp_path):
    """Within what the rows leave open: a motion of 0.5 Hz shows a delay of a millisecond."""
    paths = tmp_path / "arm.xml", tmp_path / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    robot, row = ModelRobot(*paths, threads=1), np.arange(500)
    fresh = np.maximum(np.floor((row - 0.3) / rows) * rows + 0.3, 0.0)
    angle = (
        np.sin(np.pi * 0.02 * fresh) + 1e-5 * np.random.default_rng(0).standard_normal(500)[np.floor(fresh).astype(int)]
    )
    logged = Recording(
        {"goal": Signal(0.02 * row, np.zeros((500, 1)), "rad")}, {"angle": Signal(0.02 * row, angle, "rad")}
    )
    found = inspected(logged, 0, robot)
    signal = found.recording.signals["angle"]
    seen = np.isfinite(signal.values) & (signal.time > 0.1)
    time, value = signal.time[seen], signal.values[seen]
    slope = np.pi * np.cos(np.pi * time)
    late = float(slope @ (np.sin(np.pi * time) - value) / (slope @ slope))
    assert [each.name for each in found.findings] == ["held"]
    assert abs(late) < 2.0 * found.error + 2e-4 and found.error < 0.007
    assert np.std(value - np.sin(np.pi * (time - late))) < 2e-3


def test_samples_half_way_between_two_control_steps_keep_their_noise():
    """Of a sensor three times as slow as the control: one that counted for both steps would hardly seem noisy."""
    time, wanted = 0.06 * np.arange(200) + 0.01, 0.02 * np.arange(1, 600)
    sampled = np.sin(0.5 * time) + NOISE * np.random.default_rng(0).standard_normal((10, 200))
    found = np.stack([interpolated(time, each, wanted, 0.02, NOISE, SETTINGS) for each in sampled], axis=1)
    assert 1900 < np.isfinite(found).sum() <= sampled.size
    assert noise(found[np.isfinite(found).all(axis=1)]) == pytest.approx(NOISE, rel=0.3)


def arm_at_rest(folder) -> ModelRobot:
    """The arm, whose map does not say how it begins."""
    paths = folder / "arm.xml", folder / "arm.toml"
    for path, text in zip(paths, (ARM, MAP.split("[initial]")[0] + MAP[MAP.index("[parameters") :]), strict=True):
        path.write_text(text)
    return ModelRobot(*paths, threads=1)


def test_a_log_that_begins_behind_a_wrap_is_moved_to_the_turn_in_which_the_robot_begins(tmp_path):
    time = 0.02 * np.arange(400)
    true = 0.5 * np.sin(1.3 * time - 0.6) + NOISE * np.random.default_rng(0).standard_normal(400)
    logged = Recording(
        {"goal": Signal(time, np.zeros((400, 1)), "rad")}, {"angle": Signal(time, np.mod(true, 2 * np.pi), "rad")}
    )
    found = inspected(logged, 0, arm_at_rest(tmp_path))
    assert [each.name for each in found.findings] == ["wrap"]
    assert found.recording.signals["angle"].values.ravel() == pytest.approx(true)


def test_wraps_at_a_part_of_a_turn_are_asked_about(tmp_path):
    time = 0.02 * np.arange(400)
    part = Signal(time, np.mod(3.0 * time, np.radians(300)), "rad")
    logged = Recording({"goal": Signal(time, np.zeros((400, 1)), "rad")}, {"angle": part})
    with pytest.raises(RecordingError, match=says("jumps back by about 300 deg", "period = ")):
        inspected(logged, 0, arm_at_rest(tmp_path))


@pytest.mark.parametrize("value", [0.0, -99.0])
def test_values_for_missing_samples(value):
    x = noisy() + 2.0
    at = [10, 11, 12, 90, 200, 201, 310]
    x[at] = value
    found, said = samples.placeholder(x[:, None], NOISE, SETTINGS)
    assert (np.flatnonzero(found).tolist(), said) == (at, value)
    assert not samples.placeholder(noisy()[:, None], NOISE, SETTINGS)[0].any()


@pytest.mark.parametrize("half", [np.pi, np.pi / 2])
def test_an_angle_that_wraps_becomes_one_that_goes_on(half):
    angle = np.cumsum(0.3 * half * np.abs(noisy()))
    folded = (angle + half) % (2 * half) - half
    count, turn = samples.wrapped(folded, SETTINGS)
    assert count == np.sum(np.diff(np.floor((angle + half) / (2 * half))) != 0)
    assert np.ptp(samples.unwrapped(folded, turn) - angle) == pytest.approx(0.0, abs=1e-9)
    assert samples.wrapped(noisy(), SETTINGS)[0] == 0


@pytest.mark.parametrize("rounded", [False, True])
def test_clipping_is_found_and_rest_is_not(rounded):
    step = 0.002 if rounded else 0.0
    x = step * np.round(noisy() / step) if rounded else noisy()
    limit = step * np.round(0.4 / step) if rounded else 0.4
    found = samples.clipped(Channel(np.minimum(x, limit), NOISE, step), SETTINGS)
    assert np.array_equal(found, x >= limit)
    assert not samples.clipped(Channel(x, NOISE, step), SETTINGS).any()


def test_clipping_of_a_slow_coarse_signal_is_found_and_its_rest_is_not():
    """Forty levels, one after the other."""
    step, limit = 0.05, 0.6
    levels = step * np.round(np.sin(2 * np.pi * np.arange(800) / 200) / step)
    found = samples.clipped(Channel(np.minimum(levels, limit), 0.0, step), SETTINGS)
    assert np.array_equal(found, levels > limit - 0.5 * step)
    assert not samples.clipped(Channel(levels, 0.0, step), SETTINGS).any()


def test_held_values_are_clipped_only_where_they_stay_longer_than_others():
    held = np.repeat(noisy()[::5], 5)
    assert not samples.clipped(Channel(held, NOISE), SETTINGS).any()
    assert np.array_equal(samples.clipped(Channel(np.minimum(held, 0.4), NOISE), SETTINGS), held >= 0.4)


def servo(rate: int, speed: float = np.inf, gain: float = np.inf) -> Channel:
    """A servo that reads 12 bits and is told one of five angles every 1.5 s: at a limited speed [rad/s], or with a
    gain [1/s]."""
    goals = np.random.default_rng(3).choice([-0.8, -0.4, 0.0, 0.4, 0.8], 27).repeat(3 * rate // 2)
    angle = np.zeros(len(goals))
    for i in range(1, len(goals)):
        way = goals[i] - angle[i - 1]
        angle[i] = angle[i - 1] + np.clip(way * -np.expm1(-gain / rate), -speed / rate, speed / rate)
    step = 2 * np.pi / 4096
    return Channel(step * np.round(angle / step), 0.0, step, (np.flatnonzero(np.diff(goals)) + 1,))


@pytest.mark.parametrize("rate", [10, 50, 100])
def test_a_servo_that_stops_at_once_between_two_commands_has_no_faulty_sensor(rate):
    """A third of its samples were those at "the end of the sensor's range", half of a sensor that "stood still"."""
    channel = servo(rate, speed=2.0)
    assert not samples.clipped(channel, SETTINGS).any()
    assert not samples.stale(channel, SETTINGS)[0].any()
    assert samples.clipped(replace(channel, changes=()), SETTINGS).any()  # without commands it could be either


@pytest.mark.parametrize("rate", [10, 50, 100])
def test_the_end_of_a_range_is_found_where_a_servo_comes_to_rest_slowly_elsewhere(rate):
    channel = servo(rate, gain=12.0)
    limit = channel.step * np.round(0.6 / channel.step)
    found = samples.clipped(replace(channel, values=np.minimum(channel.values, limit)), SETTINGS)
    assert np.array_equal(found, channel.values >= limit)
    assert not samples.clipped(channel, SETTINGS).any()


@pytest.mark.parametrize("step", [0.0, 2 * np.pi / 4096, 2 * np.pi / 256])
@pytest.mark.parametrize("rate", [50, 250])
def test_motion_with_play_turns_within_its_range(rate, step):
    """A quarter of its samples, those of the play, were left out."""
    drive, angle = 0.5 * np.sin(2 * np.pi * 0.3 * np.arange(30 * rate) / rate), np.zeros(30 * rate)
    for i in range(1, len(angle)):
        angle[i] = np.clip(angle[i - 1], drive[i] - 0.05, drive[i] + 0.05)
    read = step * np.round(angle / step) if step else angle
    assert not samples.clipped(Channel(read, 0.0, step), SETTINGS).any()


def test_no_sensor_is_to_blame_where_the_simulated_robot_is_stopped_too(paths):
    whole = recording(paths, (), 0, noise=0.0)
    time, angle = whole.signals["angle"].time, whole.signals["angle"].values
    stopped = replace(whole, signals={"angle": Signal(time, np.minimum(angle, 0.1), "rad")})
    assert inspected(stopped, 0, ModelRobot(*paths, threads=1)).findings
    paths[0].write_text(
        ARM.replace('damping="0.02"', f'damping="0.02" range="-180 {np.degrees(0.1)}" solreflimit="0.01 1"')
    )
    assert not inspected(stopped, 0, ModelRobot(*paths, threads=1)).findings


def test_a_robot_that_friction_holds_has_no_sensor_that_stands_still():
    """A log was resampled, so its encoder's levels are not seen: a servo that rests repeats itself, one that moves does
    not. Two thirds of its samples were left out."""
    phase = np.cumsum(np.tile(np.repeat([0.01, 0.0], [157, 150]), 12)) * np.pi / 1.57  # rests where it turns
    levels = np.round(-200 * np.cos(phase))
    resampled = np.interp(np.arange(0, len(levels) - 1, 0.97), np.arange(len(levels)), levels)
    channel = Channel(resampled, 0.5)
    assert samples._is_random(channel, SETTINGS) and not samples.stale(channel, SETTINGS)[0].any()


@pytest.mark.parametrize("rows", [1.06, 1.1, 1.27])
def test_a_sensor_a_little_slower_than_its_logger_is_held_on_levels_too(rows):
    sampled = np.floor(np.arange(400) / rows) * rows
    levels = 0.002 * np.round(np.interp(sampled, np.arange(400), motion()) / 0.002)
    found, kind = samples.stale(Channel(levels, 0.0, 0.002), SETTINGS)
    assert kind == "held" and found[1:][np.diff(sampled) == 0].mean() > 0.9


@pytest.mark.parametrize("rows", [2, 5])
def test_a_held_sensor_leaves_the_first_of_equal_samples(rows):
    found, kind = samples.stale(Channel(noisy()[np.arange(400) // rows * rows], NOISE), SETTINGS)
    assert (kind, np.flatnonzero(~found).tolist()) == ("held", list(range(0, 400, rows)))
    assert samples.stale(Channel(noisy(), NOISE), SETTINGS)[1] == ""
    levels = 0.002 * np.round(motion() / 0.002)
    assert samples.stale(Channel(levels, NOISE, 0.002), SETTINGS)[1] == ""


@pytest.mark.parametrize("digit", [0.1, 0.25])
def test_noise_that_is_rounded_to_finer_digits_repeats_itself_by_chance(digit):
    """Up to 7 % of the samples at rest; such a sensor was said to be held, and everything was fitted without them."""
    x = 0.02 * np.sin(np.arange(400) / 40) + NOISE * np.random.default_rng(5).standard_normal(400)
    rounded = digit * NOISE * np.round(x / (digit * NOISE))
    assert np.mean(np.diff(rounded) == 0) > 0.02
    assert not samples.stale(Channel(rounded, NOISE), SETTINGS)[0].any()
    assert samples.stale(Channel(rounded[np.arange(400) // 2 * 2], NOISE), SETTINGS)[1] == "held"


def test_a_sensor_that_stands_still_for_a_while_is_frozen():
    x = noisy()
    x[203:215] = x[203]
    found, kind = samples.stale(Channel(x, NOISE), SETTINGS)
    assert (kind, np.flatnonzero(found).tolist()) == ("frozen", list(range(204, 215)))


def _bursts(rng, time, share=0.2):
    late = np.where(rng.random(len(time)) < share, rng.uniform(0.02, 0.07, len(time)), 0.0)
    return np.maximum.accumulate(time + late) + 1e-7 * np.arange(len(time))


STAMPS = {
    "bursts": _bursts,
    "coarse_clock": lambda rng, time: np.round(time / 0.007) * 0.007,
    "jitter": lambda rng, time: time + rng.uniform(0, 0.008, len(time)),
    "clock_step": lambda rng, time: time + np.where(time > 3.9, 0.33, 0.0),
}


def test_a_logger_whose_loop_waits_stamps_what_it_samples():
    """A public bench had a clock that was set by 0.3 s, and a force sensor with a delay."""
    rng = np.random.default_rng(2)
    waits = np.where(rng.random(600) < 0.01, rng.uniform(0.004, 0.3, 600), rng.exponential(4e-4, 600))
    time = np.round(np.cumsum(0.01 + waits), 3)
    slow = np.sin(0.5 * time) + 0.01 * rng.standard_normal(600)
    found = stamps(time, slow[:, None], SETTINGS)
    assert found.kinds == ("irregular",) and np.array_equal(found.time, time)


@pytest.mark.parametrize("kind", STAMPS)
def test_regular_stamps_come_back(kind):
    """To within a constant, which nothing tells from a delay."""
    time = 0.02 * np.arange(400)
    given = STAMPS[kind](np.random.default_rng(3), time)
    found = stamps(given, noisy()[:, None], SETTINGS)
    assert found is not None and kind in found.kinds
    assert np.ptp(found.time - time) < 0.002
    assert stamps(time, noisy()[:, None], SETTINGS) is None


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_stamps_of_receipt_are_late_in_bursts_however_many_are(share):
    time = 0.02 * np.arange(400)
    found = stamps(_bursts(np.random.default_rng(5), time, share), noisy()[:, None], SETTINGS)
    assert found is not None and found.kinds == ("bursts",)
    assert np.abs(found.time - time).max() < 0.002


@pytest.mark.parametrize("right", [True, False])
def test_motion_in_noise_tells_whether_jittered_stamps_are_right(right):
    """Also of another signal with the same stamps, which hardly moves."""
    rng, time = np.random.default_rng(2), 0.02 * np.arange(400)
    given = time + rng.uniform(0, 0.004, 400)
    taken = given if right else time
    moves = np.sin(3 * taken) + 0.3 * np.sin(9 * taken) + 3e-3 * rng.standard_normal(400)
    rests = 1e-3 * rng.standard_normal(400)
    found = stamps(given, moves[:, None], SETTINGS)
    assert found is not None and found.kinds == (("irregular",) if right else ("jitter",))
    beside = stamps(given, rests[:, None], SETTINGS, beside=[moves[:, None]])
    assert beside is not None and beside.kinds == found.kinds and np.array_equal(beside.time, found.time)


def test_a_fine_clock_does_not_round_jitter():
    """Ticks of 0.5 ms were said to have rounded stamps by up to 4 ms."""
    given = 5e-4 * np.round((0.02 * np.arange(400) + np.random.default_rng(2).uniform(0, 0.008, 400)) / 5e-4)
    found = stamps(given, noisy()[:, None], SETTINGS)
    assert found is not None and found.kinds == ("jitter",)


def test_lost_rows_are_counted_and_leave_the_stamps_alone():
    kept = np.r_[True, np.random.default_rng(4).random(399) > 0.1]
    time = 0.02 * np.arange(400)[kept]
    found = stamps(time, noisy()[kept][:, None], SETTINGS)
    assert found is not None and found.kinds == ("gaps",)
    assert np.array_equal(found.time, time)
    assert found.missing == np.flatnonzero(kept)[-1] + 1 - kept.sum()


@pytest.fixture
def paths(tmp_path):
    found = tmp_path / "arm.xml", tmp_path / "arm.toml"
    for path, text in zip(found, (ARM, MAP), strict=True):
        path.write_text(text)
    return found


def test_a_first_sample_that_is_late_stays_so_at_rebuilt_stamps(paths):
    """A robot that begins there would begin elsewhere."""
    whole, robot = recording(paths, (), 0), ModelRobot(*paths, threads=1)
    angle = whole.signals["angle"]
    time = STAMPS["jitter"](np.random.default_rng(3), angle.time[5:])
    found = inspected(replace(whole, signals={"angle": Signal(time, angle.values[5:], "rad")}), 0, robot)
    assert [each.name for each in found.findings] == ["jitter"]
    with pytest.raises(RecordingError, match=r"first sample of angle is 0\.1"):
        robot.measured(found.recording)


def _encoder(values):
    step = 2 * np.pi / 4096
    return step * np.round(values / step)


def _spiky(values):
    found = values.copy()
    found[[40, 97, 160]] += 0.7
    return found


@pytest.mark.parametrize(("name", "spoil"), [("quantisation", _encoder), ("spikes", _spiky)])
def test_a_healthy_arm_read_by_a_degraded_sensor_lacks_no_physics(paths, name, spoil):
    """12 bits, and three spikes, were "physics outside the catalogue" with probability 0.97."""
    whole = recording(paths, (), 5)
    angle = whole.signals["angle"]
    read = Recording(whole.commands, {"angle": Signal(angle.time, spoil(angle.values), "rad")})
    result = diagnose(ModelRobot(*paths, threads=1), [read])
    assert not result.detected
    (finding,) = result.data
    assert (finding.name, finding.signal, finding.recording) == (name, "angle", 0)
    assert finding.samples == (3 if name == "spikes" else len(angle.values))
    if name == "quantisation":
        assert result.train.noise >= 2 * np.pi / 4096 / np.sqrt(12)


def test_what_an_encoder_errs_by_within_a_step_is_no_physics(paths):
    """A magnet beside the axis of its sensor was a gain or a tilt."""
    whole = recording(paths, (), 5, noise=0.0)
    angle, step = whole.signals["angle"], 2 * np.pi / 4096
    read = replace(angle, values=_encoder(angle.values + step * np.sin(2 * angle.values)))
    result = diagnose(ModelRobot(*paths, threads=1), [replace(whole, signals={"angle": read})])
    assert result.verdict == "adequate" and any("within steps of the sensors" in note for note in result.notes)


SIGMA = 5e-4


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("value", "message"), [(np.nan, "has 0 usable samples; 20 are needed"), (1e300, "a number of the size 1e[+]300")]
)
def test_a_signal_that_no_sensor_gives_is_refused_in_words(paths, value, message):
    of = recording(paths, (), 0)
    spoilt = replace(of.signals["angle"], values=np.full(of.signals["angle"].values.shape, value))
    with pytest.raises(RecordingError, match=message):
        diagnose(ModelRobot(*paths, threads=1), [replace(of, signals={"angle": spoilt})])


def test_an_audit_finds_the_noise_beside_motion():
    time = 0.05 * np.arange(1, 301)
    motion = 0.05 * np.sin(2 * np.pi * np.maximum(time - 2.0, 0.0))[:, None, None] * np.ones((1, 21, 3))
    noise = 5e-4 * np.random.default_rng(0).standard_normal(motion.shape)
    found = data_quality(Measured(np.zeros((300, 8)), time, motion + noise, "keypoints", "m"))
    assert found.sigma == pytest.approx(5e-4, rel=0.03)
    assert found.missing == 0


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_gaps_do_not_look_like_noise(share):
    rng = np.random.default_rng(1)
    values = rng.standard_normal((600, 63))
    values[rng.random(values.shape) < share] = np.nan
    assert noise(values) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("resampled", [False, True])
def test_an_audit_takes_the_rounding_of_a_quantised_signal_for_noise(resampled):
    """An encoder of 1,024 steps: rounding errors are uniform, so their deviation is the step over the root of 12."""
    step = 2 * np.pi / 1024
    time = 0.01 * np.arange(400)
    angle = step * np.round(0.3 * np.sin(2 * np.pi * 0.2 * time) / step)
    if resampled:  # a few samples lie between the levels
        angle[7::40] += 0.3 * step
    found = data_quality(Measured(np.zeros((400, 1)), time, angle[:, None, None], "angle", "rad"))
    assert found.least == pytest.approx(step / np.sqrt(12), rel=1e-3)
    assert found.sigma >= found.least


@pytest.mark.parametrize("spoilt", [False, True])
def test_recordings_with_hardly_any_samples_have_no_say_in_the_noise(spoilt):
    whole, few = np.random.default_rng(0).standard_normal((600, 3, 1)), np.full((600, 3, 1), np.nan)
    few[:3] = 0.0
    assert _noises([few, whole, np.full((600, 3, 1), np.nan)], spoilt, SETTINGS) == [pytest.approx(1.0, rel=0.05)]


def test_an_audit_finds_what_is_alone_and_far_off():
    rng = np.random.default_rng(0)
    residual = rng.standard_normal((300, 21, 3)) + 5 * np.sin(np.arange(300) / 20)[:, None, None]
    truth = np.zeros((300, 21), bool)
    truth[rng.integers(1, 299, 20), rng.integers(21, size=20)] = True
    residual[truth] += 40
    assert np.array_equal(outliers(residual), truth)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((1, 21, 3)), "too few"),
        (np.full((100, 21, 3), np.nan), "too few"),
        (np.ones((100, 21, 3)), "constant"),
        (1e300 * np.random.default_rng(0).standard_normal((100, 21, 3)), "beyond"),
        (
            np.where(np.add.outer(np.arange(100), np.arange(21)) % 2, np.nan, np.arange(100.0)[:, None])[..., None],
            "successive",
        ),
    ],
)
def test_what_is_no_recording_of_a_robot_is_refused_in_words(values, message):
    measured = Measured(np.zeros((len(values), 8)), 0.05 * np.arange(1, len(values) + 1), values, "keypoints", "m")
    with pytest.raises(RecordingError, match=message):
        data_quality(measured)


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_signal_that_a_recording_lacks_has_no_outliers(spoilt):
    assert not samples.far_off(np.full((100, 21, 3), np.nan), spoilt).any()


def test_a_jump_of_all_points_together_is_motion_and_no_outlier():
    residual = np.random.default_rng(0).standard_normal((300, 21, 3))
    residual[150] += 40
    assert not outliers(residual).any()


def test_intervals_are_the_windows_in_which_most_is_gained():
    time = 0.05 * np.arange(1, 201)
    gain = np.where((time > 2) & (time <= 4), 10.0, 0.1) + np.where((time > 7) & (time <= 8), 10.0, 0.0)
    assert intervals(time, gain) == [(2.0, 4.0), (7.0, 8.0)]
    assert intervals(time, -np.abs(gain)) == []


def test_regimes_do_not_depend_on_the_unit_of_commands_nor_need_any():
    time, rates = 0.05 * np.arange(1, 101), np.sin(np.arange(100) / 9)[:, None]
    assert regimes(time, 1e-6 * rates, np.ones(100)) == regimes(time, rates, np.ones(100))
    rest = next(r for r in regimes(time, np.zeros((100, 0)), np.ones(100)) if r.condition == "while it rests")
    assert (rest.time, rest.explained) == (1.0, 1.0)


def test_regimes_tell_reversals_from_motion_and_rest():
    rates = np.zeros((100, 1))
    rates[20:40], rates[40:60] = 1.0, -1.0
    gain = np.zeros(100)
    gain[40:45] = 1.0
    found = {r.condition: r for r in regimes(0.05 * np.arange(1, 101), rates, gain)}
    assert found["just after reversals"].explained == 1.0
    assert found["just after reversals"].time == 0.05
    assert found["while it rests"].time == 0.6
