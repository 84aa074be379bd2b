"""Time stamps of a file: counters that overflow, stamps that repeat or go back, and what to do about them."""

import numpy as np

from soro_bench.recording.importers.source import unwrapped
from soro_bench.recording.recording import RecordingError

ORDERS = ("refuse", "keep_first", "keep_last", "sort", "continue")
_COUNTERS = (16, 24, 32)  # bits
_SOON = 100  # median steps, within which a counter goes on after it has overflowed


def overflowed(numbers: np.ndarray) -> tuple[np.ndarray, str]:
    """(T,) whole numbers of a clock of 16, 24 or 32 bits as if it never overflowed, and what there is to say.

    Every step back has to be an overflow; otherwise the numbers stay as they are.
    """
    steps = np.diff(numbers)
    back, on = steps[steps < 0], steps[steps > 0]
    if not back.size or not on.size or not (numbers == np.rint(numbers)).all():
        return numbers, ""
    for bits in _COUNTERS:
        period = 2.0**bits
        within = np.ptp(numbers) < period and (numbers.min() >= 0 or np.abs(numbers + 0.5).max() < period / 2)
        if within and (back + period < _SOON * np.median(on)).all() and (back < -period / 2).all():
            return unwrapped(numbers, period), f"a clock of {bits} bits overflows {len(back)} times; unwrapped"
    return numbers, ""


def continued(time: np.ndarray) -> tuple[np.ndarray, str]:
    """(T,) times that go on by a median step where the clock was set back, and what there is to say."""
    steps = np.diff(time)
    back = steps < 0
    if not back.any():
        return time, ""
    step = np.median(steps[steps > 0]) if (steps > 0).any() else time[0] * 0
    mended = np.where(back, step, steps).astype(time.dtype)
    most = "s" if time.dtype.kind == "f" else "ns"
    note = f"its clock is set back {int(back.sum())} times, by up to {-steps.min():g} {most}; later stamps go on"
    return np.concatenate([time[:1], time[0] + np.cumsum(mended)]), note


def chosen(time: np.ndarray, order: str, rows: np.ndarray | None = None) -> tuple[np.ndarray, str]:
    """Which of (T,) times to keep, and in which order, for stamps that increase strictly; and what there is to say.

    Args:
        order: one of ORDERS. "keep_first" leaves out what is not later than everything before it, "keep_last" what is
            not earlier than everything after it; "sort" sorts, and of equal stamps keeps the last.
        rows: (T,) where the samples are in the file, for the message.

    Raises:
        RecordingError: stamps do not increase, and nothing says what to do.
    """
    if not np.isfinite(time).all():
        raise RecordingError("time is not finite")
    steps = np.diff(time)
    if not (steps <= 0).any():
        return np.arange(len(time)), ""
    if order == "refuse":
        raise RecordingError(_complaint(time, steps, rows))
    if order == "sort":
        _, last = np.unique(time[::-1], return_index=True)
        kept = len(time) - 1 - last
    elif order == "keep_last":
        after = np.minimum.accumulate(time[::-1])[::-1]
        kept = np.flatnonzero(np.append(time[:-1] < after[1:], True))
    else:
        before = np.maximum.accumulate(time)
        kept = np.flatnonzero(np.append(True, time[1:] > before[:-1]))
    return kept, f"{int((steps <= 0).sum())} stamps repeat or go back; {len(time) - len(kept)} samples left out"


def _complaint(time: np.ndarray, steps: np.ndarray, rows: np.ndarray | None) -> str:
    i = int(np.flatnonzero(steps <= 0)[0])
    place = f"row {i + 1}" if rows is None else f"line {rows[i + 1]}"
    same, back = int((steps == 0).sum()), int((steps < 0).sum())
    others = 'or "continue" (a clock that was set back goes on)' if back else "or leave the times out and write rate"
    return (
        f"time does not increase in {place}: {time[i + 1]} follows {time[i]}; {same} stamps repeat and {back} go back; "
        f'write [time] order = "keep_first", "keep_last" or "sort", {others}, or cut with begin and until'
    )
