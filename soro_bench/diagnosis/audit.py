"""Audit: what a recording's samples are worth, before any of them is explained: noise, missing ones, outliers."""

from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.robot import Measured
from soro_bench.recording.recording import RecordingError

_WINDOW, _SAMPLES = 10, 20  # samples of a window, and of a recording at least
_PRESENT = 0.5  # of a coordinate's samples, to estimate noise from it
_FARTHEST = 1e4  # in the signal's unit: no robot is that large
_QUIETEST = 1.1  # times the least: windows in which there is nothing but noise
_LEAST_NOISE = 1e-6  # of the signal's range: simulations and quantised signals have none
_FAR = 6.0  # deviations of a point from what its neighbours in time say, to be called an outlier
_TIMES_USUAL = 4.0  # and as many times what is usual around it and beside it: motion that the simulation gets wrong
_AROUND = 10  # samples on either side


@dataclass(frozen=True)
class Audit:
    """What was found in a recording.

    sigma: standard deviation of the noise [signal's unit]. missing: share of samples that are missing.
    """

    sigma: float
    missing: float


def audit(measured: Measured) -> Audit:
    """Noise and gaps of a recording."""
    return Audit(_noise(measured), float(np.isnan(measured.values).mean()))


def _noise(measured) -> float:
    """From what a parabola leaves of short windows, of those where it leaves least: the robot rests or moves evenly."""
    values = measured.values.reshape(len(measured.values), -1)
    present = values[:, np.isfinite(values).mean(axis=0) >= _PRESENT]
    if len(values) < _SAMPLES or not present.shape[1]:
        raise RecordingError(f"too few samples: {len(values)}, {np.isfinite(values).mean():.0%} of them present; "
                             f"{_SAMPLES} are needed, and {_PRESENT:.0%} of some point's")  # fmt: skip
    low, high = np.nanmin(present, axis=0), np.nanmax(present, axis=0)
    if max(-low.min(), high.max()) > _FARTHEST or not (high > low).any():
        raise RecordingError(f"{measured.signal} is constant, or beyond {_FARTHEST:g} {measured.unit}: no moving robot")
    windows = np.lib.stride_tricks.sliding_window_view(present, _WINDOW, axis=0)
    powers = np.vander(np.linspace(-1, 1, _WINDOW), 3)
    squares = ((windows @ (np.eye(_WINDOW) - powers @ np.linalg.pinv(powers))) ** 2).sum(axis=2)
    complete = np.isfinite(squares)
    count = complete.sum(axis=1)
    variance = np.where(complete, squares, 0.0).sum(axis=1)[count > 0] / (count[count > 0] * (_WINDOW - 3))
    if not len(variance):
        raise RecordingError(f"no point is present in {_WINDOW} successive samples")
    quiet = variance[variance <= _QUIETEST**2 * variance.min()]
    return max(float(np.sqrt(quiet.mean())), _LEAST_NOISE * float(np.nanmax(present) - np.nanmin(present)))


def outliers(residual: np.ndarray) -> np.ndarray:
    """(T, P) whether a point is alone far from where it was just before and after, and its neighbours are not.

    Args:
        residual: (T, P, D) measured less simulated, in standard deviations of the noise; NaN where missing.
    """
    jump = np.zeros(residual.shape[:2])
    jump[1:-1] = np.linalg.norm(residual[1:-1] - 0.5 * (residual[:-2] + residual[2:]), axis=2)
    jump = np.nan_to_num(jump) / np.sqrt(1.5 * residual.shape[2])
    padded = np.pad(jump, ((_AROUND, _AROUND), (0, 0)), mode="reflect" if len(jump) > _AROUND else "edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1, axis=0), axis=2)
    beside = np.pad(jump, ((0, 0), (1, 1)))
    beside = np.maximum(beside[:, :-2], beside[:, 2:])
    peak = np.maximum(np.roll(jump, 1, axis=0), np.roll(jump, -1, axis=0))
    return (jump > np.maximum(_FAR, _TIMES_USUAL * np.maximum(usual, beside))) & (jump > peak)
