"""Time stamps: whether they are regular, and what regular ones there were before a logger received the samples late.

A sensor that samples regularly has stamps a period apart. Receipt adds delays that come and go (bursts, jitter), a
coarse clock rounds, and a clock that is set makes a step. What is left of a stamp less its number times the period
tells them apart; the motion tells a clock step from a gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.settings import DataQualitySettings

_LEAST_GAP = 0.1  # of the spacing, below which a cubic through two samples says nothing
_BLOCK = 5  # samples, of which errors of cubics depend on each other
_SHORT, _FEW = 0.5, 0.01  # of the period, and of the intervals
_SURE = 3.0  # deviations of noise, beyond which a difference is motion
_MEDIAN = 0.6745  # of the absolute value of a normal number


@dataclass(frozen=True)
class Stamps:
    """What became of T time stamps.

    kinds: "bursts", "jitter", "coarse_clock", "clock_step", "irregular" (right, but not regular) or "gaps"; several
        may apply. affected: samples of each.
    time: (T,) s, as it should be used. period: s, of the sensor. missing: rows that were lost.
    error: s, standard deviation of a constant error that the stamps may have; size: s, largest correction.
    """

    kinds: tuple[str, ...]
    affected: tuple[int, ...]
    time: Floats
    period: float
    missing: int
    error: float = 0.0
    size: float = 0.0


def stamps(
    time: Floats, values: Floats, settings: DataQualitySettings, late: bool = False, beside: Sequence[Floats] = ()
) -> Stamps | None:
    """What became of the time stamps (T,) [s] of samples (T, C); None where they are regular.

    Args:
        late: whether each sample is at least as old as its stamp, as one that a logger holds.
        beside: (T, C) samples of other signals that have the same stamps, and tell too whether these are right.
    """
    if len(time) < settings.least_samples:
        return None
    interval = np.diff(time)
    period = float(np.median(interval))
    if np.abs(interval - period).max() <= settings.regular * period:
        return None
    number = np.round(interval / period)
    regular = time[1:] if late else time  # what a logger holds at first may be from before the recording
    even = number.sum() >= len(number) + settings.least_samples and _is_even(regular, period, settings)
    if (
        not even
        and (number >= 1).all()
        and (np.abs(interval - number * period) <= settings.regular * period * number).all()
    ):
        return Stamps(("gaps",), (len(time),), time, period, int((number - 1).sum()))
    return _irregular(time, values, settings, late, beside)


def _is_even(time: Floats, tick: float, settings: DataQualitySettings) -> bool:
    """Whether stamps are evenly spaced but for the rounding to a tick, which leaves half of one."""
    number = np.arange(len(time), dtype=float)
    period, offset = _line(number, time)
    return bool(np.abs(time - offset - period * number).max() <= (0.5 + settings.whole) * tick)


def _irregular(
    time: Floats, values: Floats, settings: DataQualitySettings, lagging: bool, beside: Sequence[Floats]
) -> Stamps:
    """Regular stamps if the motion is smoother with them, else the given ones."""
    count = len(time)
    window = min(settings.least_samples, count // 4)
    period = float(np.median(time[window:] - time[:-window])) / window
    late = time - time[0] - period * np.arange(count)
    steps, jumps = _level_steps(np.diff(time) - period, late, period, settings)
    number, level, missing, clock = np.arange(count, dtype=float), np.zeros(count), 0, 0
    noise = np.array([_deviation(*_off_cubics(time, column[:, None])) for column in values.T])
    for at, jump in zip(steps, jumps, strict=True):
        lost = max(round(jump / period), 0)
        whole = lost >= 1 and abs(jump - lost * period) < settings.whole * period
        moved = _moved_on(values, at, period, jump, noise)
        if moved or (whole and not _stood(values, at, settings)):
            number[at:] += lost
            level[at:] += jump - lost * period
            missing += lost
        elif moved is None:  # a logger that waited is commoner than a clock that was set
            number[at:] += jump / period
        else:
            level[at:] += jump
            clock += 1
    rest = np.asarray(time - level, float)
    period, offset = _line(number, rest)
    early, at_first = _lower_line(number, rest, window)
    off = rest - offset - period * number
    coarse = float(np.abs(off).max()) <= _tick(time, period, settings)  # rounding does not change more
    one_sided = _one_sided(off, settings)
    one_sided |= not coarse and _many_at_once(rest - at_first - early * number, settings)
    if one_sided or lagging:
        period, offset = early, at_first
    fitted = np.asarray(offset + period * number, float)
    left = rest - fitted
    kinds, affected = [], []
    far = np.abs(left) > settings.regular * period
    if far.any():
        kinds.append("bursts" if one_sided else "coarse_clock" if coarse else "jitter")
        affected.append(int(far.sum()))
    if clock:
        kinds.append("clock_step")
        affected.append(clock)
    if missing:
        kinds.append("gaps")
        affected.append(missing)
    if far.any() and (
        (not coarse and _wanders(left, window) and not _catches_up(time, period))
        or _roughness(rest, values) < settings.mostly * _roughness(fitted, values)
        or sum(_evidence(rest, fitted, each, settings) for each in (values, *beside)) > settings.evidence
    ):
        return Stamps(("irregular",), (int(far.sum()),), time, period, 0)
    # all samples may be as late as they seem beside the earliest one
    error = float(np.sqrt(np.mean((left - left.min()) ** 2))) if far.any() else 0.0
    return Stamps(tuple(kinds), tuple(affected), fitted, period, missing, error, float(np.abs(time - fitted).max()))


def _wanders(left: Floats, window: int) -> bool:
    """Whether stamps (T,) [s] are off for long, one way and the other, more than from one to the next: then a logger's
    loop takes different times, and tells them."""
    blocks = left[: len(left) // window * window].reshape(-1, window)
    within = blocks - blocks.mean(axis=1, keepdims=True)
    return bool(blocks.mean(axis=1).std() > within.std())


def _catches_up(time: Floats, period: float) -> bool:
    """Whether some intervals are short, as after a stamp that is late; a loop that waited goes on as before."""
    return bool((np.diff(time) < _SHORT * period).mean() > _FEW)


def _line(number: Floats, time: Floats) -> tuple[float, float]:
    """Period and offset of the line through times."""
    period, offset = np.polyfit(number, time, 1)
    return float(period), float(offset)


def _lower_line(number: Floats, time: Floats, window: int) -> tuple[float, float]:
    """Period and offset of a line along the earliest of the times: those of samples that were received at once."""
    blocks = np.array_split(np.arange(len(time)), max(len(time) // window, 2))
    slope, _ = _line(number, time)
    first = np.array([block[np.argmin(time[block] - slope * number[block])] for block in blocks])
    period, _ = _line(number[first], time[first])
    return period, float(np.median(time[first] - period * number[first]))


def _one_sided(late: Floats, settings: DataQualitySettings) -> bool:
    """Whether most samples are early and a few late."""
    low, middle, high = np.quantile(late, [0.02, 0.5, 0.98])
    return bool(high - middle > settings.one_sided * (middle - low))


def _many_at_once(late: Floats, settings: DataQualitySettings) -> bool:
    """Whether many samples are received at once, and the others any time later.

    Args:
        late: (T,) s, less the line along the earliest stamps.
    """
    at_once = np.abs(late) < settings.whole * np.quantile(late, 0.98)
    return bool(at_once.mean() > settings.at_once)


def _tick(time: Floats, period: float, settings: DataQualitySettings) -> float:
    """The tick [s], at least a share of the period, of which intervals are multiples; 0 if there is none."""
    intervals = np.unique(np.round(np.diff(time), 9))
    tick = float(np.median(np.diff(intervals))) if len(intervals) > 1 else 0.0  # a gap is many ticks
    if not tick > settings.regular * period:
        return 0.0
    whole = np.diff(time) / tick
    return tick if (np.abs(whole - np.round(whole)) < settings.whole).mean() > settings.mostly else 0.0


def _level_steps(extra: Floats, late: Floats, period: float, settings: DataQualitySettings) -> tuple[list[int], Floats]:
    """Where stamps become later or earlier for good, and by how much [s]."""
    window = min(settings.least_samples, len(late) // 4)
    before = np.array([np.min(late[max(i - window, 0) : i]) for i in range(1, len(late))])
    after = np.array([np.min(late[i : i + window]) for i in range(1, len(late))])
    ends = window // 2  # too few stamps beside them
    before[:ends], before[-ends:] = after[:ends], after[-ends:]
    usual = float(np.median(np.abs(after - before)))
    least = max(settings.level_step * period, settings.outlier_times_usual * usual)
    candidates = np.flatnonzero((np.abs(after - before) > least) & (np.abs(extra) > 0.5 * least))
    steps: list[int] = []
    sizes: list[float] = []
    for i in candidates:
        agrees = abs(extra[i] - (after[i] - before[i])) < 0.5 * abs(extra[i])
        if agrees and (not steps or i + 1 - steps[-1] > 1):
            steps.append(int(i) + 1)
            sizes.append(float(after[i] - before[i]))
    if (np.abs(extra) <= settings.regular * period).mean() > 0.5:  # so few are late that each step is one
        return steps, np.array(sizes)
    return _lasting(steps, late, window, least)


def _lasting(steps: list[int], late: Floats, window: int, least: float) -> tuple[list[int], Floats]:
    """The steps after which stamps stay later or earlier than before; a burst of late ones begins and ends."""
    while True:
        edges = [0, *steps, len(late)]
        beside = [
            (late[first:at], late[at:last])
            for first, at, last in zip(edges, edges[1:], edges[2:], strict=False)
        ]  # fmt: skip
        sizes = np.array([after.min() - before.min() for before, after in beside])
        short = [min(len(before), len(after)) < window for before, after in beside]
        weak = np.where(short, 0.0, np.abs(sizes))
        if not steps or weak.min() > least:
            return steps, sizes
        steps = [step for i, step in enumerate(steps) if i != int(weak.argmin())]


def _moved_on(values: Floats, at: int, period: float, jump: float, noise: Floats) -> bool | None:
    """Whether the motion between two samples fits a gap of ``period + jump`` rather than one of ``period``; None where
    noise (C,) hides which."""
    near = values[max(at - 3, 0) : at + 3]
    if len(near) < 6 or not np.isfinite(near).all():
        return True
    speed = 0.5 * (near[2] - near[0] + near[5] - near[3]) / (2.0 * period)
    change, unsure = near[3] - near[2], noise * (1.5 + abs(jump) / period)  # that of the speed, times the jump
    if (np.abs(speed * jump) <= _SURE * unsure).all():
        return None
    return bool(np.linalg.norm(change - speed * (period + jump)) < np.linalg.norm(change - speed * period))


def _stood(values: Floats, at: int, settings: DataQualitySettings) -> bool:
    """Whether nothing moves beside a gap, so that the motion says nothing of it."""
    near = values[max(at - 3, 0) : at + 3]
    return not np.ptp(near) > settings.jump_reach * np.nanmax(np.ptp(values, axis=0))


def _roughness(time: Floats, values: Floats) -> float:
    """Median distance [unit] of samples (T, C) from the cubics through the two on either side, while they move."""
    deviation, _ = _off_cubics(time, values)
    off = np.linalg.norm(deviation, axis=1)
    moved = np.linalg.norm(values[3:-1] - values[1:-3], axis=1)
    fast = moved > np.nanmedian(moved) if np.isfinite(moved).any() else np.zeros(len(moved), bool)
    off = np.where(np.isnan(off) & np.isfinite(moved), moved, off)  # stamps together that values are not
    return float(np.nanmedian(off[fast])) if fast.any() else 0.0


def _evidence(given: Floats, regular: Floats, values: Floats, settings: DataQualitySettings) -> float:
    """Log odds [nats] of samples (T, C) that they were taken at their given stamps rather than at regular ones.

    Samples at given stamps that are taken for regular ones are off the cubics through those beside them by what the
    stamps differ. Of that, each channel shows a share, with an error that allows for samples that depend on each other:
    1 where the given stamps are right, and 0 where the regular ones are.
    """
    odds = 0.0
    for column in values.T:
        off, weights = _off_cubics(regular, column[:, None])
        other, others = _off_cubics(given, column[:, None])
        seen, shift = off[:, 0], (off - other)[:, 0]
        sigma = min(_deviation(off, weights), _deviation(other, others))
        noisy = sigma * np.sqrt(((weights - others) ** 2).sum(axis=0))
        moves = np.abs(shift) > _SURE * noisy  # else noise alone would be the shift
        moves &= np.minimum(np.abs(seen), np.abs(other[:, 0])) < settings.outlier_deviations * sigma  # else a spike
        seen, shift = np.where(moves, seen, 0.0), np.where(moves, shift, 0.0)
        if total := float(shift @ shift):
            share = float(seen @ shift) / total
            left = (seen - share * shift) * shift
            blocks = np.pad(left, (0, -len(left) % _BLOCK)).reshape(-1, _BLOCK).sum(axis=1)
            odds += (share - 0.5) * total**2 / max(float(blocks @ blocks), sigma**2 * total, np.finfo(float).tiny)
    return odds


def _deviation(off: Floats, weights: Floats) -> float:
    """Standard deviation of the noise of samples (n, 1) that are so far off their cubics, of weights (4, n)."""
    each = np.abs(off[:, 0]) / np.sqrt(1.0 + (weights**2).sum(axis=0))
    return float(np.nanmedian(each)) / _MEDIAN if np.isfinite(each).any() else 0.0


def _off_cubics(time: Floats, values: Floats) -> tuple[Floats, Floats]:
    """(T - 4, C) how far samples (T, C) are from the cubics through the two on either side, and (4, T - 4) the weights
    of these; NaN where they are too close."""
    spacing = np.median(np.diff(time))
    weights = []
    at = time[2:-2]
    nodes = np.stack([time[:-4], time[1:-3], time[3:-1], time[4:]])
    for i in range(4):
        others = np.delete(np.arange(4), i)
        gap = nodes[i] - nodes[others]
        gap = np.where(np.abs(gap) < _LEAST_GAP * spacing, np.nan, gap)
        weights.append(np.prod((at - nodes[others]) / gap, axis=0))
    near = (values[:-4], values[1:-3], values[3:-1], values[4:])
    return values[2:-2] - sum(w[:, None] * each for w, each in zip(weights, near, strict=True)), np.array(weights)


def interpolated(
    time: Floats, values: Floats, wanted: Floats, step: float, noise: float, settings: DataQualitySettings
) -> Floats:
    """(n,) values at wanted times, a control step apart, by cubics through the four samples around each.

    A time at which there is a sample gets it as it is. NaN where no sample is within half a step, and where cubic and
    line disagree by so much that the cubic's own error may be larger than the noise. A sample half-way between two
    times counts for the first one: noise that counts twice is taken for motion.

    Args:
        time, values: (T,) s, and what was sampled, NaN where missing. noise: standard deviation of it.
    """
    seen = np.isfinite(values)
    time, values = time[seen], values[seen]
    found = np.full(len(wanted), np.nan)
    if len(time) < 4:
        return found
    nearest = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    same = settings.same_time * step
    nearest -= (wanted - time[nearest - 1]) < (time[nearest] - wanted) - same
    later = time[nearest] - wanted
    exact = np.abs(later) <= same
    found[exact] = values[nearest[exact]]
    within = (later > same - 0.5 * step) & (later <= 0.5 * step + same)
    between = ~exact & within & (wanted > time[1]) & (wanted < time[-2])
    left = np.clip(np.searchsorted(time, wanted, side="right") - 1, 1, len(time) - 3)
    around = left[:, None] + np.arange(-1, 3)
    cubic, line = np.zeros(len(wanted)), np.zeros(len(wanted))
    for i in range(4):
        weight = np.ones(len(wanted))
        for j in range(4):
            if j != i:
                weight *= (wanted - time[around[:, j]]) / (time[around[:, i]] - time[around[:, j]])
        cubic += weight * values[around[:, i]]
    share = (wanted - time[left]) / (time[left + 1] - time[left])
    line = (1 - share) * values[left] + share * values[left + 1]
    between &= np.abs(cubic - line) * settings.cubic_error <= noise
    found[between] = cubic[between]
    return found
