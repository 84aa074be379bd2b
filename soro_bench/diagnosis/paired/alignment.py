"""Recordings of the same commands on one clock.

Commands that are sampled evenly are compared as lines between their samples, others as steps: a log that has only the
changes says so by its stamps. The shift of the clocks is where the commands differ least.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from soro_bench.arrays import Floats
from soro_bench.diagnosis.paired.result import CommandDifference
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.recording.recording import Recording, RecordingError, Signal

_EVEN = 0.5  # standard deviation of intervals over their mean, above which a command was logged at its changes only
_IDENTICAL = 1e-6  # share of the range; commands that went through single precision differ so
_SAME_CLOCK = 1e-4  # s; less is the rounding of stamps
_RATES = 2e-5  # of clocks, that are worth a correction; crystals differ by 1e-4


@dataclass(frozen=True)
class Pair:
    """A recording before and one after a change, on the clock of the first: both begin at 0 and last as long.

    commands: how they differ. notes: on clocks and on what is left out, in words.
    """

    before: Recording
    after: Recording
    commands: CommandDifference
    notes: tuple[str, ...] = ()


def aligned(before: Recording, after: Recording, settings: Settings = DEFAULT) -> Pair:
    """Two recordings of the same commands, on one clock and cut to what both have.

    Raises:
        RecordingError: the commands are not the same; says which, by how much and from when on.
    """
    _check_names(before, after)
    shift, rate, notes = _clocks(before.commands, after.commands, settings)
    moved = _moved(after, shift, rate)
    start = max(_first(before), _first(moved))
    end = min(_last(before), _last(moved))
    shorter = min(_last(before) - _first(before), _last(moved) - _first(moved))
    if end - start < settings.paired.least_overlap * shorter or end <= start:
        raise RecordingError(
            f"the recordings have {max(end - start, 0):.3g} s of the same commands; at least "
            f"{settings.paired.least_overlap:.0%} of the shorter one ({shorter:.3g} s) are needed"
        )
    rms, largest = _compare(before.commands, moved.commands, start, end, settings)
    left = max(abs(before.duration), abs(after.duration)) - (end - start)
    if left > 0.1 * (end - start):
        notes = (*notes, f"{end - start:.4g} s are compared; the recordings last {before.duration:.4g} and "
                         f"{after.duration:.4g} s")  # fmt: skip
    commands = CommandDifference(shift, rate, rms, largest, end - start)
    if shift == rate == 0.0 and left <= 1e-9:
        return Pair(before, after, commands, notes)
    first, second = _cut(before, start, end), _cut(moved, start, end)
    return Pair(first, replace(second, commands=first.commands), commands, notes)


def _check_names(before: Recording, after: Recording) -> None:
    """Refuse recordings that have not the same commands, in the same units and shapes."""
    if before.commands.keys() != after.commands.keys():
        only = sorted(before.commands.keys() ^ after.commands.keys())
        raise RecordingError(f"only one of the two recordings has the command {only[0]!r}; both need the same commands")
    for name, first in before.commands.items():
        second = after.commands[name]
        if first.unit != second.unit or first.values.shape[1:] != second.values.shape[1:]:
            raise RecordingError(
                f"the command {name!r} has samples of shape {first.values.shape[1:]} in {first.unit!r} before and "
                f"{second.values.shape[1:]} in {second.unit!r} after; both need the same"
            )


def _first(recording: Recording) -> float:
    """When there is a sample of every signal and of some command [s]."""
    signals = [each.time[0] for each in recording.signals.values()] or [recording.start]
    commands = [each.time[0] for each in recording.commands.values()]
    return float(max([min(signals), *([min(commands)] if commands else [])]))


def _last(recording: Recording) -> float:
    signals = [each.time[-1] for each in recording.signals.values()]
    return float(max(signals)) if signals else recording.start + recording.duration


def _columns(signal: Signal) -> Floats:
    """(T, C)."""
    return signal.values.reshape(len(signal.time), -1)


def _evenly(signal: Signal) -> bool:
    gaps = np.diff(signal.time)
    return len(gaps) > 1 and bool(gaps.std() < _EVEN * gaps.mean())


def _at(signal: Signal, times: Floats) -> Floats:
    """(n, C) a command at some times; its first or last values outside."""
    columns = _columns(signal)
    if _evenly(signal):
        return np.stack([np.interp(times, signal.time, column) for column in columns.T], axis=1)
    return columns[np.clip(np.searchsorted(signal.time, times + 1e-9, side="right") - 1, 0, None)]


def _ranges(first: Signal, second: Signal) -> Floats:
    """(C,) largest less smallest value of both; 0 of numbers that neither has."""
    both = np.concatenate([_columns(first), _columns(second)])
    seen = np.isfinite(both)
    highest = np.max(both, axis=0, where=seen, initial=-np.inf)
    lowest = np.min(both, axis=0, where=seen, initial=np.inf)
    return np.maximum(highest - lowest, 0.0)


def _clocks(
    before: Mapping[str, Signal], after: Mapping[str, Signal], settings: Settings
) -> tuple[float, float, tuple[str, ...]]:
    """Shift [s] and rate of the second clock against the first, and what there is to say of them."""
    moving = {name for name in before if (_ranges(before[name], after[name]) > 0).any()}
    offset = _begin(after) - _begin(before) if before else 0.0
    if not moving:
        what = "the commands are constant" if before else "there are no commands"
        return 0.0, 0.0, (f"{what}, so the clocks are compared by nothing; stamps are taken as they are",)
    if _same(before, after, 0.0):
        return 0.0, 0.0, ()
    if _same(before, after, offset):
        return offset, 0.0, ()
    times, first = _sampled(before, moving)
    scales = np.concatenate([np.maximum(_ranges(before[n], after[n]), 1e-300) for n in sorted(moving)])

    def misfit(shift: float, part: slice = slice(None)) -> float:
        """Mean square of the differences, as shares of the ranges, where both have commands."""
        other = np.hstack([_at(after[name], times[part] + shift) for name in sorted(moving)])
        inside = (times[part] + shift >= _begin(after)) & (times[part] + shift <= _end(after))
        if inside.sum() < settings.paired.least_overlap * min(len(inside), (_end(after) - _begin(after)) / step):
            return 1.0
        apart = np.nan_to_num((other - first[part]) / scales)  # what is missing does not count
        return float((apart[inside] ** 2).mean())

    step = float(np.median(np.diff(times)))
    coarse = _coarse(times, first / scales, after, sorted(moving), scales)
    tried = [0.0, offset, coarse]
    reach = 2 * max(step, *(float(np.median(np.diff(after[n].time))) for n in moving if len(after[n].time) > 1))
    best = min(tried, key=misfit)
    shift = _refined(misfit, best, reach)
    third = len(times) // 3
    parts = slice(0, third), slice(2 * third, None)
    ends = [_refined(partial(misfit, part=part), shift, reach) for part in parts]
    middles = [float(times[part].mean()) for part in parts]
    rate = (ends[1] - ends[0]) / (middles[1] - middles[0])
    if abs(rate) < _RATES or abs(ends[1] - ends[0]) < 0.1 * step:
        return (shift if abs(shift) > _SAME_CLOCK else 0.0), 0.0, ()
    return ends[0] - rate * middles[0], rate, (f"the clock of the second recording is {1e6 * rate:.0f} ppm fast",)


def _begin(commands: Mapping[str, Signal]) -> float:
    return float(min(each.time[0] for each in commands.values()))


def _end(commands: Mapping[str, Signal]) -> float:
    return float(max(each.time[-1] for each in commands.values()))


def _same(before: Mapping[str, Signal], after: Mapping[str, Signal], shift: float) -> bool:
    """Whether commands have the same samples at the same times, as far as both go."""
    for name, first in before.items():
        second = after[name]
        count = min(len(first.time), len(second.time))
        if count < 0.5 * max(len(first.time), len(second.time)):
            return False
        if np.abs(first.time[:count] + shift - second.time[:count]).max() > _SAME_CLOCK:
            return False
        far = np.abs(_columns(first)[:count] - _columns(second)[:count]) > _IDENTICAL * _ranges(first, second) + 1e-12
        if far.any():
            return False
    return True


def _sampled(commands: Mapping[str, Signal], names: set[str]) -> tuple[Floats, Floats]:
    """Times (n,), even and as dense as the densest command, and the commands there (n, C)."""
    gaps = [float(np.median(np.diff(commands[name].time))) for name in names if len(commands[name].time) > 1]
    start, end = _begin(commands), _end(commands)
    most = 2 * max(len(commands[name].time) for name in names)  # where one is logged at its changes only
    count = int(np.clip((end - start) / max(min(gaps, default=end - start), 1e-6), 2, most)) + 1
    times = np.linspace(start, end, count)
    return times, np.hstack([_at(commands[name], times) for name in sorted(names)])


def _coarse(times: Floats, first: Floats, after: Mapping[str, Signal], names: list[str], scales: Floats) -> float:
    """The shift [s] with the largest covariance of the commands, to a sample; of their changes, which have no mean."""
    step = times[1] - times[0]
    count = max(int((_end(after) - _begin(after)) / step) + 1, 2)
    grid = _begin(after) + step * np.arange(min(count, 4 * len(times)))
    second = np.hstack([_at(after[name], grid) for name in names]) / scales
    one, other = (np.nan_to_num(np.diff(each, axis=0)) for each in (first, second))
    size = 1 << int(np.ceil(np.log2(len(one) + len(other))))
    product = np.fft.rfft(other, size, axis=0) * np.conj(np.fft.rfft(one, size, axis=0))
    lag = int(np.fft.irfft(product.sum(axis=1), size).argmax())
    lag = lag - size if lag > size // 2 else lag
    return float(grid[0] - times[0] + lag * step)


def _refined(misfit: Callable[[float], float], around: float, reach: float) -> float:
    """The shift of least misfit near one."""
    found = minimize_scalar(misfit, bounds=(around - reach, around + reach), method="bounded",
                            options={"xatol": 1e-3 * reach})  # fmt: skip
    return float(found.x) if found.fun < misfit(around) else around


def _moved(recording: Recording, shift: float, rate: float) -> Recording:
    """The recording on the other clock; what comes before its zero is cut off."""
    if shift == rate == 0.0:
        return recording

    def moved(signal: Signal) -> Signal:
        time = (signal.time - shift) / (1.0 + rate)
        kept = time >= -1e-9
        if not kept.any():
            raise RecordingError(f"the recordings have no time in common: their clocks are {shift:.4g} s apart")
        if not kept[0]:  # a command is held until then
            first = int(kept.argmax())
            if time[first] > 0 and first > 0 and not _evenly(signal):
                time[first - 1], kept[first - 1] = 0.0, True
        return replace(signal, time=np.maximum(time[kept], 0.0), values=signal.values[kept])

    return replace(
        recording,
        commands={name: moved(each) for name, each in recording.commands.items()},
        signals={name: moved(each) for name, each in recording.signals.items()},
    )


def _compare(
    before: Mapping[str, Signal], after: Mapping[str, Signal], start: float, end: float, settings: Settings
) -> tuple[float, float]:
    """Differences of the worst command, rms and largest, as shares of its range.

    Samples may be as late as the commands are apart, so a sample counts as far as it is from the nearest value there.
    One that is missing in either recording does not count.

    Raises:
        RecordingError: they are not the same.
    """
    worst, largest = 0.0, 0.0
    for name, first in before.items():
        second, scales = after[name], np.maximum(_ranges(first, after[name]), 1e-12)
        times = first.time[(first.time >= start) & (first.time <= end)]
        if not len(times):
            continue
        late = max((float(np.median(np.diff(each.time))) for each in (first, second) if len(each.time) > 1), default=0)
        around = np.stack([_at(second, times + by) for by in (-late, -late / 2, 0.0, late / 2, late)])
        own = _at(first, times)
        off = np.maximum(around.min(axis=0) - own, own - around.max(axis=0)).clip(0.0) / scales
        off = np.where(_ranges(first, second) > 0, off, 0.0)
        seen = np.isfinite(off)
        off = np.where(seen, off, 0.0)
        rms = np.sqrt((off**2).sum(axis=0) / np.maximum(seen.sum(axis=0), 1))
        column = int(rms.argmax())
        if rms[column] > settings.paired.same_commands:
            where = f" (number {column})" if off.shape[1] > 1 else ""
            when = times[(off[:, column] > settings.paired.same_commands).argmax()] - start
            raise RecordingError(
                f"the commands are not the same: {name!r}{where} differs by {rms[column]:.2g} of its range (rms), "
                f"first after {when:.3g} s; allowed is {settings.paired.same_commands:g}"
            )
        worst, largest = max(worst, float(rms[column])), max(largest, float(off.max()))
    return worst, largest


def _cut(recording: Recording, start: float, end: float) -> Recording:
    """The recording from ``start`` to ``end``, which begins at 0; commands have the sample that holds then."""

    def command(signal: Signal) -> Signal:
        first = max(int(np.searchsorted(signal.time, start + 1e-9, side="right")) - 1, 0)
        last = max(int(np.searchsorted(signal.time, end + 1e-9, side="right")), first + 1)
        time = np.maximum(signal.time[first:last] - start, 0.0)
        return replace(signal, time=time, values=signal.values[first:last])

    def measured(signal: Signal) -> Signal:
        kept = (signal.time >= start - 1e-9) & (signal.time <= end + 1e-9)
        if not kept.any():
            kept[np.abs(signal.time - start).argmin()] = True
        return replace(signal, time=np.maximum(signal.time[kept] - start, 0.0), values=signal.values[kept])

    return replace(
        recording,
        commands={name: command(each) for name, each in recording.commands.items()},
        signals={name: measured(each) for name, each in recording.signals.items()},
    )
