"""The difference of paired recordings, measured without a model and tested.

The test asks whether the difference has a constant part, a part in proportion to the motion or one in proportion to its
speed in every block of time. Blocks are longer than noise remembers, so a t test over their coefficients holds whatever
the autocorrelation is (Ibragimov, Müller, "t-statistic based correlation and heterogeneity robust inference", 2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.signal import savgol_filter
from scipy.stats import t as student

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.data_quality import samples
from soro_bench.diagnosis.data_quality.lattice import lattice_step
from soro_bench.diagnosis.data_quality.noise import noise_or_zero, outliers
from soro_bench.diagnosis.data_quality.samples import Channel
from soro_bench.diagnosis.paired.alignment import Pair
from soro_bench.diagnosis.paired.result import (
    Description,
    PointDifference,
    Profile,
    SignalDifference,
    Start,
)
from soro_bench.diagnosis.result_parts import Estimate
from soro_bench.diagnosis.settings import DataQualitySettings, Settings
from soro_bench.recording.recording import RecordingError, Signal, resampled

_SMOOTHED = 7  # samples, and the degree of the polynomial through them, for the speed of a noisy signal
_DEGREE = 2
_LEAST_SHARE = 1e-3  # of the motion's variance: a block with less says nothing of gain and delay
_LEVELS = 3  # columns, those that move most, in which levels are looked for
_WINDOWS = 200  # of the picture of a difference over time


@dataclass(frozen=True)
class Difference:
    """One signal of a pair at common times.

    time: (T,) s. before, after: (T, P, D), NaN where missing. noise: standard deviation of each of them [unit].
    settings: of outliers.
    """

    name: str
    unit: str
    time: Floats
    before: Floats
    after: Floats
    noise: tuple[float, float]
    settings: DataQualitySettings

    @property
    def values(self) -> Floats:
        """(T, P, D) after less before; NaN where either is missing or far off."""
        found = self.after - self.before
        found[outliers(found / max(self.expected, 1e-300), self.settings)] = np.nan
        return found

    @property
    def expected(self) -> float:
        """Standard deviation of a coordinate's difference that the sensors' noise alone makes [unit]."""
        return float(np.hypot(*self.noise))


def difference(name: str, pair: Pair, settings: DataQualitySettings) -> Difference:
    """A signal of both recordings, at the stamps of the one with fewer of them.

    Raises:
        RecordingError: there is too little that both have.
    """
    first, second = (_cleaned(each.signals[name], settings) for each in (pair.before, pair.after))
    fewer, other = (first, second) if len(first.time) <= len(second.time) else (second, first)
    inside = (fewer.time >= other.time[0] - 1e-9) & (fewer.time <= other.time[-1] + 1e-9)
    times = np.clip(fewer.time[inside], other.time[0], other.time[-1])
    if len(times) < (least := settings.least_samples):
        raise RecordingError(f"both recordings have {len(times)} samples of {name!r} in common; {least} are needed")
    shape = points_of(first)
    own, theirs = fewer.values[inside], resampled(other, times).values
    one, two = (own, theirs) if fewer is first else (theirs, own)
    before, after = (each.reshape(len(times), *shape) for each in (one, two))
    if np.isfinite(after - before).any(axis=(1, 2)).sum() < least:
        raise RecordingError(f"no point of {name!r} is there in both recordings at once")
    return Difference(name, first.unit, times, before, after, (_noise(first, settings), _noise(second, settings)),
                      settings)  # fmt: skip


def points_of(signal: Signal) -> tuple[int, int]:
    """(P, D) points and coordinates of a sample: a sample of three lengths is one point."""
    shape = signal.values.shape[1:]
    if len(shape) >= 2:
        return int(np.prod(shape[:-1])), int(shape[-1])
    count = int(np.prod(shape))
    return (1, 3) if count == 3 and signal.unit == "m" else (count, 1)


def _cleaned(signal: Signal, settings: DataQualitySettings) -> Signal:
    """The signal without placeholders and without values that were only held."""
    values = signal.values.reshape(len(signal.time), -1).copy()
    shape, noises = points_of(signal), [noise_or_zero(column[:, None], settings) for column in values.T]
    for p in range(shape[0]):
        columns = slice(p * shape[1], (p + 1) * shape[1])
        values[samples.placeholder(values[:, columns], max(noises[columns]), settings)[0], columns] = np.nan
        stale = [_frozen(Channel(c, n), settings) for c, n in zip(values[:, columns].T, noises[columns], strict=True)]
        values[np.all(stale, axis=0), columns] = np.nan
    return Signal(signal.time, values.reshape(signal.values.shape), signal.unit, signal.frame)


def _frozen(channel: Channel, settings: DataQualitySettings) -> Bools:
    """(T,) where a value stands still though its noise should move it; a slow sensor that holds is left alone."""
    found, kind = samples.stale(channel, settings)
    return found if kind == "frozen" else np.zeros_like(found)


def _noise(signal: Signal, settings: DataQualitySettings) -> float:
    """Standard deviation of the white noise of a coordinate [unit]; at least that of the levels of a coarse sensor, and
    the rounding of a simulation."""
    values = signal.values.reshape(len(signal.time), -1)
    present = np.isfinite(values).sum(axis=0) > settings.least_samples
    reach = np.nanmax(values[:, present], axis=0) - np.nanmin(values[:, present], axis=0)
    least = settings.least_noise * float(reach.max()) if present.any() else 0.0
    found = [noise_or_zero(column[:, None], settings) for column in values[:, present].T]
    widest = values[:, present].T[np.argsort(-reach)[:_LEVELS]]
    levels = [lattice_step(column, max(least, settings.least_step * n), settings)
              for column, n in zip(widest, np.array(found)[np.argsort(-reach)], strict=False)]  # fmt: skip
    least = max([least, *(step / np.sqrt(12.0) for step in levels)])
    return max(float(np.sqrt(np.mean(np.square(found)))) if found else 0.0, least)


def repeatability(pairs: Sequence[Difference]) -> float | None:
    """Rms difference of a coordinate between runs of the same robot [unit]; None without any."""
    squares = [float(np.nanmean(each.values**2)) for each in pairs]
    return float(np.sqrt(np.mean(squares))) if squares else None


def measured(pairs: Sequence[Difference], repeats: Sequence[Difference], settings: Settings) -> SignalDifference:
    """What differs in one signal, of all pairs together.

    Args:
        repeats: runs of the same robot under the same commands.
    """
    name, unit = pairs[0].name, pairs[0].unit
    found = [each.values for each in pairs]
    every = np.concatenate(found)
    run_to_run = repeatability(repeats)
    noises = [float(np.sqrt(np.mean([each.noise[i] ** 2 for each in pairs]))) for i in (0, 1)]
    expected = max(float(np.hypot(noises[0], noises[1])), run_to_run or 0.0)
    points = tuple(_point(i, every[:, i], expected) for i in range(every.shape[1]))
    rms = float(np.sqrt(np.nanmean(every**2)))
    p_value = _p_value(pairs, found, settings)
    steady = p_value < settings.paired.alpha and rms > settings.paired.beyond * (run_to_run or 0.0)
    verdict = (
        "changed" if steady else "differs" if rms > settings.paired.beyond * np.hypot(noises[0], noises[1]) else "same"
    )
    if verdict == "same" and p_value < settings.paired.alpha:
        verdict = "differs"  # as runs of the same robot do
    return SignalDifference(
        name,
        unit,
        verdict,
        rms,
        float(np.sqrt(np.nanmean((every**2).sum(axis=2)))),
        noises[0],
        noises[1],
        run_to_run,
        p_value,
        points,
        _profile(pairs[0], found[0]),
        _descriptions(pairs, found, settings),
        tuple(_starts(each, expected, settings) for each in pairs),
    )


def _point(index: int, values: Floats, expected: float) -> PointDifference:
    """Of one point's differences (T, D)."""
    there = np.isfinite(values).all(axis=1)
    if not there.any():
        nothing = (float("nan"),) * values.shape[1]
        return PointDifference(index, nothing, float("nan"), float("nan"), float("nan"), 0.0)
    distance = np.linalg.norm(values[there], axis=1)
    rms = float(np.sqrt((distance**2).mean()))
    mean = tuple(float(each) for each in values[there].mean(axis=0))
    return PointDifference(
        index, mean, rms, float(distance.max()), float(rms / max(expected * np.sqrt(values.shape[1]), 1e-300)),
        float(there.mean()),
    )  # fmt: skip


def _profile(pair: Difference, values: Floats) -> Profile:
    """Rms distance of every point in windows of time."""
    windows = np.array_split(np.arange(len(pair.time)), min(_WINDOWS, len(pair.time)))
    square = (values**2).sum(axis=2)
    rows = []
    for window in windows:
        count = np.isfinite(square[window]).sum(axis=0)
        with np.errstate(invalid="ignore"):
            rows.append(np.sqrt(np.nansum(square[window], axis=0) / np.where(count > 0, count, np.nan)))
    return Profile(
        tuple(float(pair.time[window].mean()) for window in windows),
        tuple(tuple(float(each) for each in row) for row in rows),
    )


def _starts(pair: Difference, expected: float, settings: Settings) -> Start:
    """How far the two robots are apart at the beginning; over a few samples, as one alone is noise."""
    first = pair.values[: settings.data_quality.window]
    with np.errstate(invalid="ignore"):
        count = np.isfinite(first).sum(axis=0)
        mean = np.nansum(first, axis=0) / np.where(count > 0, count, np.nan)
    distance = np.linalg.norm(mean, axis=1)
    if not np.isfinite(distance).any():
        return Start(0, float("nan"), 0.0, False)
    worst = int(np.nanargmax(distance))
    noise = expected * np.sqrt(first.shape[2] / max(len(first), 1))
    deviations = float(distance[worst] / max(noise, 1e-300))
    return Start(worst, float(distance[worst]), deviations, deviations > settings.data_quality.outlier_deviations)


def _motion(pair: Difference) -> tuple[Floats, Floats]:
    """(T, C) mean of both runs about its mean, and its rate of change; smoothed, as noise is in the difference too."""
    both = (0.5 * (pair.before + pair.after)).reshape(len(pair.time), -1)
    way, speed = np.full_like(both, np.nan), np.full_like(both, np.nan)
    for i, column in enumerate(both.T):
        seen = np.isfinite(column)
        if seen.sum() <= _SMOOTHED:
            continue
        filled = np.interp(pair.time, pair.time[seen], column[seen])
        smooth = savgol_filter(filled, _SMOOTHED, _DEGREE)
        way[:, i] = np.where(seen, smooth - smooth.mean(), np.nan)
        speed[:, i] = np.where(seen, np.gradient(smooth, pair.time), np.nan)
    return way, speed


def _blocks(length: int, settings: Settings) -> list[slice]:
    """Parts of time, as many as are long enough."""
    count = max(min(settings.paired.blocks, length // settings.paired.blocks), 1)
    ends = np.linspace(0, length, count + 1).astype(int)
    return [slice(a, b) for a, b in pairwise(ends.tolist())]


def _p_value(pairs: Sequence[Difference], found: Sequence[Floats], settings: Settings) -> float:
    """Probability of so steady a difference by chance, Bonferroni-corrected for all numbers that are tested."""
    rows: list[Floats] = []
    for pair, values in zip(pairs, found, strict=True):
        flat = values.reshape(len(values), -1)
        way, speed = _motion(pair)
        rows += [_coefficients(flat[b], way[b], speed[b], way, speed) for b in _blocks(len(flat), settings)]
    coefficients = np.stack(rows)  # (blocks, C, 3)
    tested = np.isfinite(coefficients).sum(axis=0) >= 3
    if not tested.any():
        return 1.0
    p = np.array([_t_test(column) for column in coefficients.reshape(len(coefficients), -1)[:, tested.ravel()].T])
    return float(min(1.0, len(p) * p.min()))


def _coefficients(values: Floats, way: Floats, speed: Floats, all_way: Floats, all_speed: Floats) -> Floats:
    """(C, 3) of one block: mean, and the slopes over motion and speed beside it; NaN where a block does not move."""
    result = np.full((values.shape[1], 3), np.nan)
    for i in range(values.shape[1]):
        seen = np.isfinite(values[:, i]) & np.isfinite(way[:, i])
        if seen.sum() < 8:
            continue
        result[i, 0] = values[seen, i].mean()
        design = np.column_stack([way[seen, i], speed[seen, i]])
        design = design - design.mean(axis=0)
        whole = np.array([np.nanvar(all_way[:, i]), np.nanvar(all_speed[:, i])])
        gram = design.T @ design / seen.sum()
        moves = np.diag(gram) > _LEAST_SHARE * np.maximum(whole, 1e-300)
        if moves.all() and np.linalg.cond(gram / np.sqrt(np.outer(np.diag(gram), np.diag(gram)))) < 1e3:
            result[i, 1:] = np.linalg.solve(gram, design.T @ (values[seen, i] - values[seen, i].mean()) / seen.sum())
    return result


def _t_test(values: Floats) -> float:
    """p-value of the mean of independent numbers being zero."""
    values = values[np.isfinite(values)]
    deviation = float(values.std(ddof=1)) / np.sqrt(len(values))
    if deviation <= 1e-12 * float(np.abs(values).max()):
        return 0.0 if np.abs(values).max() > 0 else 1.0
    return float(2.0 * student.sf(abs(values.mean()) / deviation, len(values) - 1))


def _descriptions(pairs: Sequence[Difference], found: Sequence[Floats], settings: Settings) -> tuple[Description, ...]:
    """What the difference looks like: a constant offset of each number, a change of amplitude and a delay common to
    all of them, with the shares of its variance that they take off one after another."""
    slopes, total, offset_left, left = [], 0.0, 0.0, 0.0
    for pair, values in zip(pairs, found, strict=True):
        flat = values.reshape(len(values), -1)
        way, speed = _motion(pair)
        seen = np.isfinite(flat) & np.isfinite(way)
        if not seen.any():
            continue
        count = np.maximum(seen.sum(axis=0), 1)
        center = np.where(seen, flat, 0.0).sum(axis=0) / count
        rest = np.where(seen, flat - center, 0.0)
        moved = [np.where(seen, each, 0.0) for each in (way, speed)]
        moved = [np.where(seen, each - each.sum(axis=0) / count, 0.0) for each in moved]
        design = np.stack([each.ravel() for each in moved], axis=1)
        whole = _solved(design, rest.ravel())
        total += float(np.where(seen, flat**2, 0.0).sum())
        offset_left += float((rest**2).sum())
        left += float(((rest.ravel() - design @ np.nan_to_num(whole)) ** 2).sum())
        for b in _blocks(len(flat), settings):
            inner = np.stack([each[b].ravel() for each in moved], axis=1)
            slopes.append(_solved(inner, rest[b].ravel()))
    if not slopes or total <= 0:
        return ()
    share = 1.0 - offset_left / total
    rms = float(np.sqrt(max(total - offset_left, 0.0) / sum(np.isfinite(each).sum() for each in found)))
    rows = np.array(slopes)
    both = max(offset_left - left, 0.0) / total
    gain, delay = _interval(rows[:, 0]), _interval(-rows[:, 1])
    return (
        Description("offset", Estimate("offset", rms, pairs[0].unit), share),
        Description("amplitude", Estimate("amplitude", *_with_unit(gain, "1")), both),
        Description("delay", Estimate("delay", *_with_unit(delay, "s")), both),
    )


def _with_unit(found: tuple[float, float, float], unit: str) -> tuple[float, str, float, float]:
    return found[0], unit, found[1], found[2]


def _solved(design: Floats, values: Floats) -> Floats:
    """Least squares; NaN where the design says nothing."""
    gram = design.T @ design
    scale = np.sqrt(np.diag(gram))
    if (scale <= 0).any() or np.linalg.cond(gram / np.outer(scale, scale)) > 1e4:
        return np.full(design.shape[1], np.nan)
    return np.asarray(np.linalg.solve(gram, design.T @ values), float)


def _interval(values: Floats) -> tuple[float, float, float]:
    """Mean of blocks, and its 90 % interval."""
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return float("nan"), float("nan"), float("nan")
    by = float(student.ppf(0.95, len(values) - 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return float(values.mean()), float(values.mean()) - by, float(values.mean()) + by
