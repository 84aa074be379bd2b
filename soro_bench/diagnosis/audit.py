"""Audit: what a recording's samples are worth, before any of them is explained: noise, missing ones, outliers."""

from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.robot import Measured
from soro_bench.recording.recording import RecordingError

_WINDOW = 10  # samples
_QUIETEST = 1.1  # times the least: windows in which there is nothing but noise
_LEAST_NOISE = 1e-6  # of the signal's range: simulations and quantised signals have none
_FAR = 6.0  # deviations of a point from what its neighbours in time say, to be called an outlier
_TIMES_USUAL = 4.0  # and as many times what is usual around it, for motion that the simulation gets wrong
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
    if len(values) < _WINDOW:
        raise RecordingError(f"{len(values)} samples are too few for a diagnosis; at least {_WINDOW} are needed")
    windows = np.lib.stride_tricks.sliding_window_view(values, _WINDOW, axis=0)
    powers = np.vander(np.linspace(-1, 1, _WINDOW), 3)
    left = windows @ (np.eye(_WINDOW) - powers @ np.linalg.pinv(powers))
    variance = np.nanmean((left**2).sum(axis=2) / (_WINDOW - 3), axis=1)
    least = np.nanmin(variance)
    quiet = variance[variance <= _QUIETEST**2 * least]
    return max(float(np.sqrt(quiet.mean())), _LEAST_NOISE * float(np.nanmax(values) - np.nanmin(values)))


def outliers(residual: np.ndarray) -> np.ndarray:
    """(T, P) whether a point is alone far from where it was just before and after.

    Args:
        residual: (T, P, D) measured less simulated, in standard deviations of the noise; NaN where missing.
    """
    jump = np.full(residual.shape[:2], np.nan)
    jump[1:-1] = np.linalg.norm(residual[1:-1] - 0.5 * (residual[:-2] + residual[2:]), axis=2)
    jump /= np.sqrt(1.5 * residual.shape[2])
    padded = np.pad(jump, ((_AROUND, _AROUND), (0, 0)), constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1, axis=0)
    usual = np.nanmedian(around, axis=2, keepdims=False) if len(jump) else jump
    peak = np.nan_to_num(np.fmax(np.roll(jump, 1, axis=0), np.roll(jump, -1, axis=0)))
    return (jump > np.maximum(_FAR, _TIMES_USUAL * usual)) & (jump > peak)
