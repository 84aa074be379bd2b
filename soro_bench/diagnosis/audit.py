"""Audit: what a recording's samples are worth, before any of them is explained: noise, missing ones, outliers."""

from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.robot import Measured

_WINDOW = 10  # samples
_QUIETEST = 0.25  # of the windows: the noise is what is there even when nothing moves
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
    """From what a straight line leaves of short windows, where the commands rest if they ever do."""
    values = measured.values.reshape(len(measured.values), -1)
    count = len(values) // _WINDOW
    windows = values[: count * _WINDOW].reshape(count, _WINDOW, -1)
    still = ~np.any(measured.actions[: count * _WINDOW].reshape(count, _WINDOW, -1), axis=(1, 2))
    time = np.arange(_WINDOW) - 0.5 * (_WINDOW - 1)
    level = windows.mean(axis=1, keepdims=True)
    slope = (time[:, None] * windows).sum(axis=1, keepdims=True) / (time**2).sum()
    left = windows - level - slope * time[:, None]
    deviation = np.sqrt(np.nanmean((left**2).sum(axis=1) / (_WINDOW - 2), axis=1))
    chosen = deviation[still & np.isfinite(deviation)]
    chosen = chosen if len(chosen) else deviation[np.isfinite(deviation)]
    return max(float(np.quantile(chosen, _QUIETEST)), _LEAST_NOISE * float(np.nanmax(values) - np.nanmin(values)))


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
