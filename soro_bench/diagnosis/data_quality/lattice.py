"""The step of a quantised signal, also where noise of less than a step lies on top.

Samples x on levels that are a step s apart have the same phase 2 pi x / s. The mean of exp(i 2 pi x / s), their
empirical characteristic function, is then near 1 in absolute value; of other samples it is of the order 1 / sqrt(n)
(Widrow, Kollar, "Quantization Noise", 2008, chapter 4).
"""

import math

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.settings import DataQualitySettings

_BINS = 8  # of a histogram in a step; its Fourier transform is exact to 3 % then
_FINE = 41  # frequencies around a peak


def lattice_step(samples: Floats, least: float, settings: DataQualitySettings) -> float:
    """Step between the levels of samples (T,), NaN where missing; 0 if none of at least ``least`` is found.

    A robot at rest repeats itself, and even motion takes equal steps. Neither is evidence of levels. So samples count
    where the increment changes, and of successive ones those that are more than a step apart. Changes of the increment
    have to be multiples of the step too, which they are not by chance.
    """
    samples = samples[np.isfinite(samples)]
    reach = float(np.ptp(samples)) if len(samples) else 0.0
    low, high = least, reach / settings.fewest_levels
    while high > low > 0.0:
        step = _within(samples, max(low, 0.5 * high), high, settings)
        if step and _in_changes(samples, step, settings) and _in_distinct(samples, step, settings):
            return _widened(samples, step, settings)
        high *= 0.5
    return _between_few(samples, least, settings)


def _between_few(samples: Floats, least: float, settings: DataQualitySettings) -> float:
    """Step between a few levels on which samples mostly rest and to which they come back, as those of an encoder; 0 if
    these are no whole steps apart."""
    if not (np.diff(samples) == 0).sum() > 0.5 * len(samples):
        return 0.0
    levels = np.unique(samples)
    runs = 1 + int(np.count_nonzero(np.diff(samples)))
    if not 2 <= len(levels) <= settings.least_samples or runs == len(levels):
        return 0.0
    apart = np.diff(levels)
    # many levels may all be several steps apart; of few, parts of the least distance would fit by chance
    parts = range(1, settings.fewest_levels + 1) if len(levels) > settings.fewest_levels + 1 else (1,)
    for step in (float(apart.min()) / part for part in parts):
        if step >= least and (np.abs(apart / step - np.round(apart / step)) < settings.whole).all():
            return step
    return 0.0


def is_lattice(samples: Floats, step: float, settings: DataQualitySettings) -> bool:
    """Whether samples (T,) lie on levels that are ``step`` apart."""
    samples = samples[np.isfinite(samples)]
    changes = np.diff(samples) / step
    if (np.abs(changes - np.round(changes)) < settings.whole).all():
        return True
    picked = _picked(samples, 0.5 * step, step)
    sharp = abs(_characteristic(picked, np.array([1.0 / step]))[0]) if len(picked) else 0.0
    return sharp > _limit(len(picked), 1, settings) and _in_changes(samples, step, settings)


def _within(samples: Floats, low: float, high: float, settings: DataQualitySettings) -> float:
    """A step from low to high on which the samples lie; 0 if there is none."""
    picked = _picked(samples, 0.5 * low, high)
    if len(picked) < settings.least_samples:
        return 0.0
    width = low / _BINS
    bins = np.floor((picked - picked.min()) / width).astype(int)
    size = 2 ** math.ceil(math.log2(2 * (bins.max() + 1)))
    found = np.abs(np.fft.rfft(np.bincount(bins, minlength=size), n=size)) / len(picked)
    frequencies = np.arange(len(found)) / (size * width)
    tried = np.flatnonzero((frequencies >= 1.0 / high) & (frequencies <= 1.0 / low))
    if not len(tried):
        return 0.0
    centre, space = frequencies[tried[found[tried].argmax()]], 1.0 / (size * width)
    near = centre + space * np.linspace(-1.0, 1.0, _FINE)
    sharp = np.abs(_characteristic(picked, near))
    return float(1.0 / near[sharp.argmax()]) if sharp.max() > _limit(len(picked), len(tried), settings) else 0.0


def _in_distinct(samples: Floats, step: float, settings: DataQualitySettings) -> bool:
    """Whether the same holds of samples without repetitions; True where too few changes are left to tell."""
    distinct = samples[np.r_[True, np.diff(samples) != 0]]
    changes = np.abs(np.diff(distinct, n=2)) > 0.5 * step
    return bool(changes.sum() < settings.least_samples) or _in_changes(distinct, step, settings)


def _in_changes(samples: Floats, step: float, settings: DataQualitySettings) -> bool:
    """Whether changes of the increment of samples (T,) are multiples of a step."""
    changes = np.diff(samples, n=2)
    changes = changes[np.abs(changes) > 0.5 * step]
    if len(changes) < settings.least_samples:
        return False
    return bool(np.cos(2 * np.pi * changes / step).mean() > chance(len(changes), settings))


def _widened(samples: Floats, step: float, settings: DataQualitySettings) -> float:
    """The step, or a multiple of it on which the samples lie too: too few of them may be further apart."""
    for many in range(settings.fewest_levels, 1, -1):
        if abs(_characteristic(np.unique(samples), np.array([1.0 / (many * step)]))[0]) > settings.mostly:
            return many * step
    return step


def _limit(count: int, tried: int, settings: DataQualitySettings) -> float:
    """Absolute value that the characteristic function of samples without levels hardly exceeds at any frequency."""
    return max(settings.level_sharpness, chance(count, settings, tried))


def chance(count: int, settings: DataQualitySettings, tried: int = 1) -> float:
    """Absolute value that the largest of means of ``count`` random phases, or a correlation, hardly exceeds."""
    return math.sqrt((math.log(tried) + settings.evidence) / max(count, 1))


def _characteristic(samples: Floats, frequencies: Floats) -> np.ndarray:
    """(F,) of samples (T,) at frequencies (F,)."""
    return np.exp(2j * np.pi * np.outer(frequencies, samples)).mean(axis=1)


def _picked(samples: Floats, least: float, step: float) -> Floats:
    """Samples after which the increment changes by more than ``least``, each further than a step from the one before:
    by a random part of another step, as equal distances would look like levels."""
    changed = samples[1:-1][np.abs(np.diff(samples, n=2)) > least]
    further = step * (1.0 + np.random.default_rng(0).random(len(changed)))
    kept, last = [], math.inf
    for value, distance in zip(changed.tolist(), further.tolist(), strict=True):
        if abs(value - last) > distance:
            kept.append(value)
            last = value
    return np.array(kept)
