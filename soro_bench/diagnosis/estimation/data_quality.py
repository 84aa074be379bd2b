"""Audit: what a recording's samples are worth, before any of them is explained: noise, missing ones, outliers."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.recording.recording import RecordingError

_WINDOW, _DEGREE = 6, 4  # samples of a window, and of the polynomial that takes the motion out of it
_SAMPLES = 20  # of a recording at least
_PRESENT = 0.5  # of a coordinate's samples, to estimate noise from it
_FARTHEST = 1e4  # in the signal's unit: no robot is that large
_QUIET = 0.05  # of the windows: in so many at least there is nothing but noise
_LEAST_NOISE = 1e-6  # of the signal's range: simulations have none
_REPEATED = 0.2  # of successive samples are equal: a quantised signal
_FAR = 6.0  # deviations of a point from what its neighbours in time say, to be called an outlier
_TIMES_USUAL = 4.0  # and as many times what is usual around it and beside it: motion that the simulation gets wrong
_AROUND = 10  # samples on either side
_BACK = 0.5  # of its distance, within which its place just before and just after are


@dataclass(frozen=True)
class DataQuality:
    """What was found in a recording.

    sigma: standard deviation of the noise [signal's unit]. least: what it is at any rate, from rounding. missing: share
    of samples that are missing.
    """

    sigma: float
    least: float
    missing: float


def data_quality(measured: Measured) -> DataQuality:
    """Noise and gaps of a recording."""
    values = _rows(measured.values.reshape(len(measured.values), -1))
    enough = np.isfinite(values).sum(axis=0) >= _PRESENT * len(values)
    if len(values) < _SAMPLES or not enough.any():
        share = np.isfinite(measured.values).mean()
        raise RecordingError(f"too few samples: {len(values)}, {share:.0%} of all present; {_SAMPLES} are needed, and "
                             f"{_PRESENT:.0%} of some point's")  # fmt: skip
    present = values[:, enough]
    low, high = np.nanmin(present, axis=0), np.nanmax(present, axis=0)
    if max(-low.min(), high.max()) > _FARTHEST or not (high > low).any():
        raise RecordingError(f"{measured.signal} is constant, or beyond {_FARTHEST:g} {measured.unit}: no moving robot")
    least = max(_LEAST_NOISE * float((high - low).max()), _step(present) / np.sqrt(12))
    return DataQuality(max(noise(present), least), least, float(np.isnan(values).mean()))


def noise(values: np.ndarray) -> float:
    """Standard deviation of white noise in samples (T, k) of something smooth.

    From what a polynomial leaves of short windows, of those where it leaves least: the robot rests or moves evenly.
    """
    values = _rows(values)
    windows = np.lib.stride_tricks.sliding_window_view(values, _WINDOW, axis=0)
    powers = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, _WINDOW), _DEGREE)
    squares = ((windows @ (np.eye(_WINDOW) - powers @ np.linalg.pinv(powers))) ** 2).sum(axis=2)
    complete = np.isfinite(squares)
    count = complete.sum(axis=1)
    if not count.any():
        raise RecordingError(f"no point is present in {_WINDOW} successive samples")
    used = count > 0
    sums = np.where(complete, squares, 0.0).sum(axis=1)[used]
    quiet = chi2.ppf(_QUIET, count[used] * (_WINDOW - _DEGREE - 1))  # of what is present in each window
    return float(np.sqrt(np.quantile(sums / quiet, _QUIET)))


def _rows(values: np.ndarray) -> np.ndarray:
    """Those of the rows (T, ...) that have samples: a robot may take several steps between two of them."""
    return values[np.isfinite(values).reshape(len(values), -1).any(axis=1)]


def _step(values) -> float:
    """Between the levels of a quantised signal; 0 for another one.

    It is the commonest change, not the least one: where a log was resampled, samples lie between the levels.
    """
    steps = np.abs(np.diff(values, axis=0))
    steps = steps[np.isfinite(steps)]
    if not len(steps) or (steps == 0).mean() <= _REPEATED:
        return 0.0
    rounding = _LEAST_NOISE * float(steps.max())
    changes, counts = np.unique(np.round(steps[steps > 0] / rounding), return_counts=True)
    return float(rounding * changes[counts.argmax()])


def outliers(residual: np.ndarray) -> np.ndarray:
    """(T, P) whether a point is alone far from where it was just before and is again just after, and its neighbours on
    the robot are not.

    Args:
        residual: (T, P, D) measured less simulated, in standard deviations of the noise; NaN where missing.
    """
    if not (sampled := np.isfinite(residual).any(axis=(1, 2))).all():
        found = np.zeros(residual.shape[:2], bool)
        found[sampled] = outliers(residual[sampled])
        return found
    jump = np.zeros(residual.shape[:2])
    jump[1:-1] = np.linalg.norm(residual[1:-1] - 0.5 * (residual[:-2] + residual[2:]), axis=2)
    jump = np.nan_to_num(jump) / np.sqrt(1.5 * residual.shape[2])
    moved = np.full(jump.shape, np.inf)
    moved[1:-1] = np.linalg.norm(residual[2:] - residual[:-2], axis=2) / np.sqrt(1.5 * residual.shape[2])
    padded = np.pad(jump, ((_AROUND, _AROUND), (0, 0)), mode="reflect" if len(jump) > _AROUND else "edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1, axis=0), axis=2)
    beside = np.pad(jump, ((0, 0), (1, 1)))
    beside = np.maximum(beside[:, :-2], beside[:, 2:])
    peak = np.maximum(np.roll(jump, 1, axis=0), np.roll(jump, -1, axis=0))
    return (jump > np.maximum(_FAR, _TIMES_USUAL * np.maximum(usual, beside))) & (jump > peak) & (moved < _BACK * jump)
