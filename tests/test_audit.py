"""What a diagnosis sees of a recording before anything is fitted, and when and where what it finds shows."""

import numpy as np
import pytest

from soro_bench.diagnosis.estimation.data_quality import data_quality, noise, outliers
from soro_bench.diagnosis.localisation.residual_maps import intervals, regimes
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.recording.recording import RecordingError

SIGMA = 5e-4


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
