"""Numbers that wrap, as counters and angles do, and numbers that stand for missing ones: how they look, and undone."""

import math
from dataclasses import dataclass

import numpy as np

_WRAPS = 0.75  # of a turn: larger steps within one turn look like wraps
_SMALLEST, _LARGEST = 256, 2**32  # counts of a turn of encoders that wrap
_BESIDE, _LOOKED_AT = 5, 100  # steps on each side of a jump that tell how fast a counter moves; jumps
_ON = 0.5  # of the way beside the jump of a counter leads on at least, and not back
_ALIKE = 0.02  # of a period, by which the shown one differs at most from a power of two
_PART = 0.1  # of a turn, by which the period of what wraps at a part of one differs from it at least
_NICE = 1.0, 3.6, 4.0, math.pi, 2 * math.pi  # times powers of ten: periods of what is no angle by its unit
_FEW, _OFTEN = 20, 3  # numbers, of fewer none is lost; times that one comes which stands for a missing one
_VERY_FAR, _SHORTLY = 10.0, 2  # ranges or median steps; samples in a row
_DIGITS = 4  # of a number that somebody writes for a missing one, such as -1 or 9999
_DECIMAL = 1e-6  # of a thousandth, by which a number of three decimals differs from one at most
_FAST = 0.35  # of a period, over which steps may as well be wraps the other way
_LEFT, _TIMES = 0.05, 3.0  # of a period, and of the usual steps: what is left of a jump with the wrong period
_LARGE = np.errstate(over="ignore", invalid="ignore")  # numbers near the largest there are


def unwrapped(numbers: np.ndarray, period: float | np.ndarray) -> np.ndarray:
    """(T, ...) numbers without the jumps of a counter or angle; missing ones stay missing.

    Args:
        period: of all, or (k,) of each number of a sample.
    """
    columns = np.array(numbers, float).reshape(len(numbers), -1)
    for column, own in zip(columns.T, np.broadcast_to(period, columns.shape[1:]), strict=True):
        known = np.flatnonzero(np.isfinite(column))
        turns = -np.cumsum(np.round(np.diff(column[known]) / own))
        column[known[1:]] += own * turns
    return columns.reshape(numbers.shape)


@dataclass(frozen=True)
class Lost:
    """A number that seems to stand for a missing one, and how often it comes."""

    number: float
    count: int


@_LARGE
def lost_number(numbers: np.ndarray) -> Lost | None:
    """The least or largest of (T, ...) numbers, if it seems to stand for a missing one; None if neither does.

    It comes exactly again and again: very far from all others; or for a sample or two from which they are far, with as
    few digits as somebody writes there, unlike a tracker that slips for a moment.
    """
    columns = np.asarray(numbers, float).reshape(len(numbers), -1)
    found: dict[float, int] = {}
    for column in columns.T:
        known = column[np.isfinite(column)]
        for number in {known.min(), known.max()} if known.size > _FEW else ():
            at = known == number
            if _OFTEN <= at.sum() <= known.size / 2 and _is_lost(known, at, float(number)):
                found[float(number)] = found.get(float(number), 0) + int(at.sum())
    return Lost(*max(found.items(), key=lambda item: item[1])) if found else None


def _is_lost(known: np.ndarray, at: np.ndarray, number: float) -> bool:
    """Whether (T,) known numbers say nothing about where they are ``at`` a number."""
    others = known[~at]
    steps = np.abs(np.diff(others))
    if not (moved := steps[steps > 0]).size:
        return False
    if number and np.abs(others - number).min() > _VERY_FAR * np.ptp(others):
        return True
    if float(f"{number:.{_DIGITS}g}") != number:
        return False
    ends = np.flatnonzero(np.diff(at, prepend=False, append=False)).reshape(-1, 2)  # of its runs
    inner = ends[(ends[:, 0] > 0) & (ends[:, 1] < len(known))]
    if len(inner) < _OFTEN or np.median(inner[:, 1] - inner[:, 0]) > _SHORTLY:
        return False
    jumps = np.minimum(np.abs(known[inner[:, 0] - 1] - number), np.abs(known[inner[:, 1]] - number))
    return bool(np.median(jumps) > _VERY_FAR * np.median(moved))


@_LARGE
def thousands(numbers: np.ndarray) -> str:
    """A question about (T, ...) numbers that look as if separators of thousands were read as decimal points, or "".

    As in 998, 999, 1.001: without the point the step is a small one.
    """
    for column in np.asarray(numbers, float).reshape(len(numbers), -1).T:
        known = column[np.isfinite(column)]
        parted = known != np.rint(known)
        mended = np.where(parted, np.rint(1000.0 * known), known)
        below = np.where(parted, 0.0, np.abs(known)) >= 100.0  # but for whole thousands, such as 5.000
        i = np.flatnonzero((parted[1:] & below[:-1]) | (parted[:-1] & below[1:]))
        if not i.size or np.abs(known).max() >= 1000.0 or np.abs(known[parted]).min() < 1.0:
            continue
        exact = np.abs(mended - 1000.0 * known)[parted].max() < _DECIMAL
        if exact and np.median(np.abs(np.diff(mended))[i]) < 0.5 * np.median(np.abs(np.diff(known))[i]):
            return (
                f"{known[i[0] + 1]:.10g} follows {known[i[0]]:.10g}; if these are thousands, export without separators"
            )
    return ""


@_LARGE
def seen_wraps(numbers: np.ndarray, period: float | np.ndarray) -> int:
    """How often (T, ...) numbers look as if they wrapped: within one period, but for spikes, from end to end.

    Args:
        period: of all, or (k,) of each number of a sample.
    """
    columns = np.asarray(numbers, float).reshape(len(numbers), -1)
    wraps = 0
    for column, own in zip(columns.T, np.broadcast_to(period, columns.shape[1:]), strict=True):
        finite = column[np.isfinite(column)]
        jumps = int((np.abs(np.diff(finite)) > _WRAPS * own).sum())
        if jumps and np.ptp(_without_spikes(finite)) <= own * (1 + 1e-6):
            wraps += jumps
    return wraps


def _without_spikes(numbers: np.ndarray) -> np.ndarray:
    """Without those of (T,) numbers that are far from both beside them, on the same side."""
    steps = np.diff(numbers)
    far = np.abs(steps) > _VERY_FAR * np.median(np.abs(steps))
    spikes = np.flatnonzero(far[:-1] & far[1:] & (np.sign(steps[:-1]) != np.sign(steps[1:]))) + 1
    return np.delete(numbers, spikes)


@dataclass(frozen=True)
class CounterPeriod:
    """At how many counts a counter seems to wrap, and what to add to that number where it is not exact."""

    counts: float
    doubt: str = ""


@_LARGE
def counter_period(numbers: np.ndarray) -> CounterPeriod | None:
    """At which period whole (T, ...) numbers seem to wrap; None if they do not.

    A counter jumps by its period, less the step that it makes meanwhile. The steps beside the jump tell that step.
    """
    low, high = np.fmin.reduce(numbers, axis=None), np.fmax.reduce(numbers, axis=None)  # which copy nothing
    if not _SMALLEST <= high - low + 1 <= _LARGEST or ((numbers % 1) > 0).any():
        return None
    columns = np.asarray(numbers, float).reshape(len(numbers), -1)
    found = np.concatenate([_jumps(column[np.isfinite(column)]) for column in columns.T])
    known = found[~np.isnan(found).any(axis=1)]
    if 2 * len(known) <= len(found):
        return None
    counts, spread = np.median(known, axis=0)
    if counts < (1.0 - _ALIKE) * (high - low):
        return None
    counts = max(round(counts), int(high - low) + 1)
    power = 2 ** round(math.log2(counts))
    if abs(power - counts) <= max(min(spread, _ALIKE * counts), 1) and power > high - low:
        return CounterPeriod(power)
    return CounterPeriod(counts, "" if spread <= 1 else " (about; its data sheet says it)")


@_LARGE
def saw_period(numbers: np.ndarray, turn: float = 0.0) -> CounterPeriod | None:
    """At which period (T, ...) numbers with decimals seem to wrap, once at a usual one; None if they do not.

    Args:
        turn: of an angle, of which the period may be a part.
    """
    columns = np.asarray(numbers, float).reshape(len(numbers), -1)
    found = np.concatenate([_jumps(column[np.isfinite(column)], 0.0) for column in columns.T])
    known = found[~np.isnan(found).any(axis=1)]
    if 2 * len(known) <= len(found):
        return None
    counts, spread = np.median(known, axis=0)
    least = np.fmax.reduce(np.fmax.reduce(columns) - np.fmin.reduce(columns))  # some may have no number
    if spread > _ON * counts or not seen_wraps(columns, counts * (1.0 + _ALIKE)):
        return None
    nice = turn / np.arange(1, 21) if turn else np.concatenate([np.outer(_NICE, 10.0 ** np.arange(-3, 6)).ravel(),
                                                                2.0 ** np.arange(8, 33)])  # fmt: skip
    near = nice[(np.abs(nice - counts) <= max(spread, _ALIKE * counts)) & (nice >= least * (1 - 1e-6))]
    if near.size:
        return CounterPeriod(float(near[np.abs(near - counts).argmin()]))
    return CounterPeriod(float(f"{counts:.4g}"), " (about; its data sheet says it)") if len(known) > 1 else None


def part_of_turn(numbers: np.ndarray, turn: float) -> CounterPeriod | None:
    """At which period (T, ...) numbers of an angle wrap that is no whole turn, as encoders of 300 degrees do."""
    found = saw_period(numbers, turn)
    return found if found and abs(found.counts - turn) > _PART * turn else None


def _jumps(column: np.ndarray, least: float = 1.0) -> np.ndarray:
    """(jumps, 2) the period that each jump of (T,) numbers over their range shows, and how exactly.

    Both are NaN where the numbers do not go the other way before and after it, as those of a counter do.

    Args:
        least: range of numbers that are looked at.
    """
    steps = np.diff(column)
    large = np.abs(steps) > _WRAPS * max(np.ptp(column) if column.size else 0.0, least)
    found = np.full((min(int(large.sum()), _LOOKED_AT), 2), np.nan)
    for row, i in zip(found, np.flatnonzero(large), strict=False):
        around = slice(max(i - _BESIDE, 0), i + _BESIDE + 1)
        beside = steps[around][~large[around] & (steps[around] != 0)]
        if -np.sign(steps[i]) * beside.sum() > _ON * np.abs(beside).sum():
            row[:] = np.abs(steps[i]) + np.abs(np.median(beside)), np.ptp(beside)
    return found


def told(numbers: np.ndarray, period: np.ndarray) -> str:
    """What there is to say of (T, ...) numbers that are unwrapped at periods (k,) of each number of a sample."""
    label = ", ".join(f"{each:.6g}" for each in np.unique(period))[:80]
    numbers = np.asarray(numbers, float).reshape(len(numbers), -1) / period
    jumps = np.abs(_steps(numbers)) > 0.5
    wraps = int(jumps.sum())
    if not wraps:
        return f"unwrap = true, but nothing wraps at {label}; period = ... says where it does"
    steps = np.abs(_steps(unwrapped(numbers, 1.0)))
    left, usual = float(np.median(steps[jumps])), float(np.quantile(steps[~jumps], 0.95)) if wraps < len(jumps) else 1.0
    doubt = ""
    if steps.max() > _FAST:
        doubt = f"; steps of {steps.max():.2f} of a period may as well be wraps the other way"
    elif left > max(_LEFT, _TIMES * usual):
        doubt = f"; steps of {left:.2f} of a period are left there: is it another period?"
    return f"wraps at {label} that are unwrapped: {wraps}{doubt}"


def _steps(numbers: np.ndarray) -> np.ndarray:
    """The changes from each sample of a number to its next one that is not missing."""
    columns = np.asarray(numbers, float).reshape(len(numbers), -1)
    changes = [np.diff(column[np.isfinite(column)]) for column in columns.T]
    return np.concatenate(changes) if changes else np.zeros(0)
