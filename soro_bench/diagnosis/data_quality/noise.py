"""Data-quality check: noise, gaps and outliers of a recording, before any model explains it."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.settings import DataQualitySettings
from soro_bench.recording.recording import RecordingError

_DEFAULT = DataQualitySettings()


@dataclass(frozen=True)
class DataQuality:
    """Noise and gaps of a recording.

    sigma: standard deviation of the noise [signal's unit]. least: lower bound of it, from rounding. missing: share of
    missing samples.
    """

    sigma: float
    least: float
    missing: float


def data_quality(measured: Measured, settings: DataQualitySettings = _DEFAULT) -> DataQuality:
    """Noise and gaps of a recording.

    Raises:
        RecordingError: there are too few samples, or they are not those of a moving robot.
    """
    values = _rows(measured.values.reshape(len(measured.values), -1))
    enough = np.isfinite(values).sum(axis=0) >= settings.least_samples
    if not enough.any():
        share = np.isfinite(measured.values).mean()
        raise RecordingError(
            f"too few samples: {len(values)}, {share:.0%} of all present; {settings.least_samples} of some point's "
            "coordinate are needed"
        )
    present = values[:, enough]
    low, high = np.nanmin(present, axis=0), np.nanmax(present, axis=0)
    if max(-low.min(), high.max()) > settings.largest_signal or not (high > low).any():
        raise RecordingError(
            f"{measured.signal} is constant, or beyond {settings.largest_signal:g} {measured.unit}: no moving robot"
        )
    least = max(settings.least_noise * float((high - low).max()), _quantisation(present, settings) / np.sqrt(12))
    return DataQuality(max(noise(present, settings), least), least, float(np.isnan(values).mean()))


def noise(values: Floats, settings: DataQualitySettings = _DEFAULT) -> float:
    """Standard deviation of white noise in samples (T, k) of a smooth signal.

    A polynomial is fitted to short windows. The windows with the smallest residuals count: there the robot rests or
    moves evenly.

    Raises:
        RecordingError: no window is complete.
    """
    values = _rows(values)
    windows = np.lib.stride_tricks.sliding_window_view(values, settings.window, axis=0)
    powers = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, settings.window), settings.window - 2)
    squares = ((windows @ (np.eye(settings.window) - powers @ np.linalg.pinv(powers))) ** 2).sum(axis=2)
    complete = np.isfinite(squares)
    count = complete.sum(axis=1)
    if not count.any():
        raise RecordingError(f"no point is present in {settings.window} successive samples")
    used = count > 0
    sums = np.where(complete, squares, 0.0).sum(axis=1)[used]
    quiet = chi2.ppf(settings.quiet_windows, count[used])  # a degree of freedom of each complete point
    return float(np.sqrt(np.quantile(sums / quiet, settings.quiet_windows)))


def _rows(values: Floats) -> Floats:
    """The rows of (T, ...) with any sample: a robot may take several steps between two of them."""
    return values[np.isfinite(values).reshape(len(values), -1).any(axis=1)]


def _quantisation(values: Floats, settings: DataQualitySettings) -> float:
    """Step between the levels of a quantised signal (T, k); 0 for a signal that is not quantised.

    It is the commonest change, not the least one: resampling a log puts samples between the levels.
    """
    steps = np.abs(np.diff(values, axis=0))
    steps = steps[np.isfinite(steps)]
    if not len(steps) or (steps == 0).mean() <= settings.repeated:
        return 0.0
    rounding = settings.least_noise * float(steps.max())
    changes, counts = np.unique(np.round(steps[steps > 0] / rounding), return_counts=True)
    return float(rounding * changes[counts.argmax()])


def outliers(residual: Floats, settings: DataQualitySettings = _DEFAULT) -> Bools:
    """(T, P) whether a sample is an outlier: far from the samples before and after it, which agree with each other,
    while the neighbouring points of the robot stay.

    Args:
        residual: (T, P, D) measured less simulated, in standard deviations of the noise; NaN where missing.
    """
    if not (sampled := np.isfinite(residual).any(axis=(1, 2))).all():
        found = np.zeros(residual.shape[:2], bool)
        if sampled.any():
            found[sampled] = outliers(residual[sampled], settings)
        return found
    jump = np.zeros(residual.shape[:2])
    jump[1:-1] = np.linalg.norm(residual[1:-1] - 0.5 * (residual[:-2] + residual[2:]), axis=2)
    jump = np.nan_to_num(jump) / np.sqrt(1.5 * residual.shape[2])
    moved = np.full(jump.shape, np.inf)
    moved[1:-1] = np.linalg.norm(residual[2:] - residual[:-2], axis=2) / np.sqrt(1.5 * residual.shape[2])
    around = settings.least_samples // 2
    padded = np.pad(jump, ((around, around), (0, 0)), mode="reflect" if len(jump) > around else "edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * around + 1, axis=0), axis=2)
    beside = np.pad(jump, ((0, 0), (1, 1)))
    beside = np.maximum(beside[:, :-2], beside[:, 2:])
    peak = np.maximum(np.roll(jump, 1, axis=0), np.roll(jump, -1, axis=0))
    least = np.maximum(settings.outlier_deviations, settings.outlier_times_usual * np.maximum(usual, beside))
    return (jump > least) & (jump > peak) & (moved < settings.outlier_return * jump)


def compressed(values: Floats) -> Floats:
    """(T, ...) with the present samples of each number first, in their order: it may miss others than its neighbours
    do."""
    columns = values.reshape(len(values), -1)
    order = np.argsort(np.isnan(columns), axis=0, kind="stable")
    return np.take_along_axis(columns, order, axis=0).reshape(values.shape)


def noise_or_zero(values: Floats, settings: DataQualitySettings) -> float:
    """Standard deviation of the noise of the present samples (T, C); 0 where there are too few."""
    try:
        return noise(compressed(values), settings)
    except (RecordingError, ValueError):
        return 0.0
