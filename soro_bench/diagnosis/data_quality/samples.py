"""Samples that a sensor or a logger has spoilt: one channel at a time, from its values alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.data_quality.noise import outliers
from soro_bench.diagnosis.settings import DEFAULT, DataQualitySettings, Settings

_TURNS = (2.0 * np.pi, np.pi)  # rad, after which angles wrap


@dataclass(frozen=True)
class Channel:
    """One number of a signal over time.

    values: (T,), NaN where missing. noise: standard deviation of white noise, as far as it is known; 0 if it is not.
    step: between levels; 0 where it is not quantised. changes: of each number of the commands, the samples at which it
    is another one than at the sample before. replay: (T,) values of a simulated robot; None where nobody has asked.
    """

    values: Floats
    noise: float
    step: float = 0.0
    changes: tuple[Ints, ...] = ()
    replay: Floats | None = None

    @property
    def reach(self) -> float:
        """Largest less smallest value."""
        present = self.values[np.isfinite(self.values)]
        return float(np.ptp(present)) if len(present) else 0.0


def placeholder(point: Floats, noise: float, settings: DataQualitySettings) -> tuple[Bools, float]:
    """(T,) where a value stands for a missing sample of a point (T, D), and that value; zero, or the least or the
    largest one. All coordinates have it.

    The samples around it are far from it, and go on where they were before it.
    """
    present = np.flatnonzero(np.isfinite(point).all(axis=1))
    none = np.zeros(len(point), bool)
    if len(present) < settings.least_samples:
        return none, 0.0
    for value in dict.fromkeys((0.0, float(np.nanmin(point)), float(np.nanmax(point)))):
        has = (point[present] == value).all(axis=1)
        here, others = present[has], present[~has]
        if len(here) < settings.least_repeats or len(others) < settings.least_samples:
            continue
        x = point[others]
        far = np.maximum(
            settings.spike_changes * _changes_beside(x, np.searchsorted(others, here)),
            settings.outlier_deviations * noise,
        )
        before, after = _around(others, here)
        off = np.minimum(*(np.linalg.norm(point[each] - value, axis=1) for each in (before, after))) > far
        runs = 1 + int((np.diff(here) > 1).sum())
        if value and runs < settings.least_repeats:  # a turning point that is held may be the least value too
            off &= np.linalg.norm(point[before] - value, axis=1) > 0.5 * np.ptp(x, axis=0).max()
        if off.sum() >= settings.least_repeats:
            found = none.copy()
            # noise never has it, nor have several coordinates at once; some lie where the motion is near that value
            never = point.shape[1] > 1 or _is_random(Channel(point[:, 0], noise), settings)
            every = off.mean() > 0.5 or never
            found[here if every else here[off]] = True
            return found, value
    return none, 0.0


def _around(others: Ints, here: Ints) -> tuple[Ints, Ints]:
    """The numbers of the other samples before and after each of some."""
    after = np.searchsorted(others, here)
    return others[np.maximum(after - 1, 0)], others[np.minimum(after, len(others) - 1)]


def _changes_beside(values: Floats, after: Ints) -> Floats:
    """(n,) the larger one of the next changes of values (T, D) before and after each gap; ``after`` are its ends."""
    changes = np.r_[0.0, np.linalg.norm(np.diff(values, axis=0), axis=1), 0.0]  # before each value, and after the last
    number, moves = np.arange(len(changes)), changes > 0
    last = np.maximum.accumulate(np.where(moves, number, 0))  # repeated values are no evidence of slow motion
    following = np.minimum.accumulate(np.where(moves, number, len(values))[::-1])[::-1]
    before = last[np.maximum(after - 1, 0)]
    return np.maximum(changes[before], changes[following[np.minimum(after + 1, len(values))]])


def spikes(points: Floats, noise: float, settings: DataQualitySettings) -> Bools:
    """(T, P) where one or two samples of a point are far off and the next ones go on where it was before.

    A cubic through the two samples on either side says where they should be. Motion in and out again, as of a bounce,
    changes the samples beside them as well. A body that vibrates faster than it is sampled takes the points beside
    along, the same way; markers that are taken for each other go opposite ways.

    Args:
        points: (T, P, D) samples of neighbouring points of a body, NaN where missing.
    """
    found = np.zeros(points.shape[:2], bool)
    for length in (1, 2):
        gaps = [_off_cubic(points[:, p], length, noise, settings) for p in range(points.shape[1])]
        deviations = np.stack([each for each, _ in gaps], axis=1)
        far = np.stack([each for _, each in gaps], axis=1) & ~_taken_along(deviations, noise, settings)
        for p, column in enumerate(far.T):
            rows = np.flatnonzero(np.isfinite(points[:, p]).all(axis=1))
            first = np.searchsorted(rows, np.flatnonzero(column))
            for i in range(length):
                found[rows[first + i], p] = True
    return found


def _off_cubic(point: Floats, length: int, noise: float, settings: DataQualitySettings) -> tuple[Floats, Bools]:
    """(T, length, D) how far so many samples of a point (T, D), from each on, are from the cubic through the two on
    either side, NaN where there are none; (T,) whether all are far."""
    deviations, far = np.full((len(point), length, point.shape[1]), np.nan), np.zeros(len(point), bool)
    rows = np.flatnonzero(np.isfinite(point).all(axis=1))
    x = point[rows]
    if len(x) < settings.least_samples or not np.ptp(x, axis=0).any():
        return deviations, far
    changes = np.linalg.norm(np.diff(x, axis=0), axis=1)
    count = len(x) - length - 3
    first, second = x[:count], x[1 : 1 + count]
    third, fourth = x[2 + length : 2 + length + count], x[3 + length : 3 + length + count]
    nearby = np.stack([changes[:count], np.linalg.norm(third - second, axis=1), changes[2 + length :][:count]])
    least = np.maximum(settings.spike_changes * nearby.max(axis=0), settings.outlier_deviations * noise)
    least = np.maximum(least, float(np.quantile(changes, settings.mostly)))
    at = rows[2 : 2 + count]
    for i in range(length):
        weights = _cubic(1 + i, length)
        expected = sum(w * each for w, each in zip(weights, (first, second, third, fourth), strict=True))
        deviations[at, i] = x[2 + i : 2 + i + count] - expected
    far[at] = (np.linalg.norm(deviations[at], axis=2) > least[:, None]).all(axis=1)
    return deviations, far


def _taken_along(deviations: Floats, noise: float, settings: DataQualitySettings) -> Bools:
    """(T, P) whether the points beside each deviate (T, P, length, D) as it does: their mean the same way by a share of
    it, or no farther from it than noise."""
    if 1 in (deviations.shape[1], deviations.shape[3]):  # no points beside; one coordinate has the same sign by chance
        return np.zeros(deviations.shape[:2], bool)
    beside = np.full((2, *deviations.shape), np.nan)
    beside[0, :, 1:], beside[1, :, :-1] = deviations[:, :-1], deviations[:, 1:]
    known = np.isfinite(beside).all(axis=(3, 4), keepdims=True)
    count = known.sum(axis=0)
    mean = np.where(known, beside, 0.0).sum(axis=0) / np.maximum(count, 1)
    same_way = (mean * deviations).sum(axis=3) >= settings.outlier_return * (deviations**2).sum(axis=3)
    near = np.linalg.norm(mean - deviations, axis=3) <= settings.outlier_deviations * noise
    return (count > 0)[..., 0, 0] & (same_way | near).all(axis=2)


def _cubic(position: int, length: int) -> Floats:
    """(4,) weights of samples at -1, 0, length + 1, length + 2 in the cubic through them, at a position."""
    nodes = np.array([-1.0, 0.0, length + 1.0, length + 2.0])
    return np.array([np.prod([(position - n) / (m - n) for n in nodes if n != m]) for m in nodes])


def wrapped(values: Floats, settings: DataQualitySettings) -> tuple[int, float]:
    """How often an angle (T,) [rad] wraps, and the turn after which it does; 0 where it does not.

    It jumps back by nearly a turn, which is nearly all of its range, while it moves on.
    """
    x = values[np.isfinite(values)]
    if len(x) < settings.least_samples:
        return 0, 0.0
    change = np.diff(x)
    for turn in _TURNS:
        if np.ptp(x) > turn * (1.0 + settings.wrap_tolerance):
            continue
        jumps = np.abs(change) > (1.0 - settings.wrap_tolerance) * turn
        back = (jumps[:-1] & jumps[1:]) | (jumps[:-1] & np.r_[jumps[2:], False])  # samples alone on the other side
        if 2 * back.sum() >= jumps.sum():
            continue
        rest = np.abs(np.diff(np.unwrap(x, period=turn)))
        if jumps.any() and rest.max() < 0.5 * (1.0 - settings.wrap_tolerance) * turn:
            return int(jumps.sum()), turn
    return 0, 0.0


def unwrapped(values: Floats, turn: float) -> Floats:
    """The angle (T,) [rad] without its wraps; NaN stays."""
    found, present = values.copy(), np.isfinite(values)
    found[present] = np.unwrap(values[present], period=turn)
    return found


@dataclass(frozen=True)
class Runs:
    """Successive equal values: (R,) where each run begins, how long it is, and its value."""

    first: Ints
    length: Ints
    value: Floats

    @classmethod
    def of(cls, values: Floats) -> "Runs":
        """Of values (T,) without gaps."""
        first = np.flatnonzero(np.r_[True, np.diff(values) != 0])
        return cls(first, np.diff(np.r_[first, len(values)]), values[first])

    @property
    def jumps(self) -> tuple[Floats, Floats]:
        """(R,) how far the value jumps before and after each run; NaN at the ends."""
        jump = np.diff(self.value)
        return np.r_[np.nan, jump], np.r_[jump, np.nan]

    def at_rest(self, present: Ints, changes: Sequence[Ints]) -> Bools:
        """(R,) whether a run is a rest between two commands: one of them changes in the second half of it, as motion
        begins late, and not in the first half.

        Args:
            present: (T,) the samples that the runs are of. changes: as of ``Channel``.
        """
        begin, end = present[self.first], present[self.first + self.length - 1] + 1
        middle, found = (begin + end) / 2, np.zeros(len(begin), bool)
        for each in changes:
            early, half, late = (np.searchsorted(each, at) for at in (begin, middle, end + 1))
            found |= (half == early) & (late > half)
        return found


def clipped(channel: Channel, settings: DataQualitySettings) -> Bools:
    """(T,) where the values stay at the least or at the largest one, longer than at others, and come and go fast.

    A servo of limited speed does so between two commands too, but elsewhere as well. Where a simulated robot stands
    still too, as a gripper that holds something, it is no sensor.
    """
    x = channel.values
    present = np.flatnonzero(np.isfinite(x))
    found = np.zeros(len(x), bool)
    if len(present) < settings.least_samples:
        return found
    runs, random = Runs.of(x[present]), _is_random(channel, settings)
    hidden, rests = _hidden(x[present], runs, channel, settings), runs.at_rest(present, channel.changes)
    still = _stands_still(runs, present, hidden, channel, settings)
    for sign in (-1.0, 1.0):
        at = runs.value == sign * (sign * runs.value).max()
        samples, longest = runs.length[at].sum(), runs.length[at].max()
        if samples < settings.least_repeats or longest < 2 or longest <= np.median(runs.length):
            continue
        elsewhere = rests & ~at
        as_usual = not elsewhere.any() or (hidden[elsewhere] > 0).mean() >= 0.5
        stops = still & ~_beyond(runs, present, sign, channel, settings)
        ends = (hidden > 0) & ~stops & ~(rests & as_usual)
        if stops[at & (runs.length > 1)].mean() < 0.5 if random else ends[at].sum() >= max(2, 0.5 * at.sum()):
            for first, length in zip(runs.first[at], runs.length[at], strict=True):
                found[present[first : first + length]] = True
    return found


def _stands_still(runs: Runs, present: Ints, hidden: Floats, channel: Channel, settings: DataQualitySettings) -> Bools:
    """(R,) whether the replay stands still in the inner half of a run: it comes there earlier or later, and moves much
    less than the parabola that is ``hidden``."""
    found = np.zeros(len(runs.value), bool)
    if channel.replay is None:
        return found
    least = np.maximum(hidden / 8.0, settings.stands_still * channel.reach)  # a parabola moves by a quarter of it
    for i in np.flatnonzero(runs.length > 1):
        first, length = runs.first[i], runs.length[i]
        inner = channel.replay[present[first + length // 4 : first + length - length // 4]]
        found[i] = np.ptp(inner) <= least[i]
    return found


def _beyond(runs: Runs, present: Ints, sign: float, channel: Channel, settings: DataQualitySettings) -> Bools:
    """(R,) whether the replay is further to one side than the value in the middle of a run."""
    if channel.replay is None:
        return np.zeros(len(runs.value), bool)
    middle = channel.replay[present[runs.first + runs.length // 2]]
    return np.asarray(sign * (middle - runs.value) > settings.stands_still * channel.reach)


def _far(channel: Channel, settings: DataQualitySettings) -> float:
    """What is no rounding, no noise, and no small motion of a robot that comes to rest."""
    sizes = settings.jump_steps * channel.step, settings.outlier_deviations * channel.noise
    return max(*sizes, settings.jump_reach * channel.reach)


def _hidden(x: Floats, runs: Runs, channel: Channel, settings: DataQualitySettings) -> Floats:
    """(R,) how far motion that goes on smoothly would leave the value of a run in x (T,); 0 unless it comes and goes
    fast, and that is far.

    A robot at its end stop comes fast and leaves slowly; one that turns, sticks or has play does both slowly. Motion
    that comes and goes with speed v is v n / 4 beyond the value that it has n samples apart, if it is a parabola.
    """
    moves = np.abs(np.diff(x))
    if not (moves > 0).any():
        return np.zeros(len(runs.value))
    steps = settings.jump_steps * channel.step
    width = max(1, min(math.ceil(steps / np.sqrt(np.mean(moves[moves > 0] ** 2))), len(x) // 2))
    apart = np.abs(x[width:] - x[:-width])
    first, last = runs.first - 1 - width, runs.first + runs.length  # the run cuts the steps into it and out of it short
    inside = (first >= 0) & (last < len(apart))
    slower = np.minimum(apart[np.maximum(first, 0)], apart[np.minimum(last, len(apart) - 1)])
    speed = np.maximum(slower - channel.step, 0.0) / width  # of which rounding may be a step
    hidden, usual = speed * runs.length / 4.0, np.median(apart[apart > 0]) / width
    fast = inside & (speed > settings.clip_speed * usual) & (hidden > _far(channel, settings))
    return np.where(fast, hidden, 0.0)


def _comes_to_rest(runs: Runs, settings: DataQualitySettings) -> Bools:
    """(R,) whether motion slows down before a run of equal values: its last whole step is shorter than the one before.

    The step into the run itself says nothing, since the end of a range cuts it short.
    """
    steps = np.abs(np.diff(runs.value, prepend=np.nan))
    last, before = np.r_[np.nan, steps[:-1]], np.r_[np.nan, np.nan, steps[:-2]][: len(steps)]
    same = np.r_[False, False, False, np.diff(runs.value)[:-2] * np.diff(runs.value)[1:-1] > 0][: len(steps)]
    return same & (last < settings.rest_slows * before)


def stale(channel: Channel, settings: DataQualitySettings) -> tuple[Bools, str]:
    """(T,) where a value is only the one before once more, and whether the sensor is "held" throughout or "frozen" for
    a while; "" if neither.

    Noise makes equal values unlikely. Without noise, or on coarse levels, a robot at rest repeats itself; then values
    count that stay between two jumps.
    """
    x = channel.values
    present = np.flatnonzero(np.isfinite(x))
    none = np.zeros(len(x), bool)
    if len(present) < settings.least_samples:
        return none, ""
    runs = Runs.of(x[present])
    before, after = runs.jumps
    rests = runs.at_rest(present, channel.changes)
    repeated = none.copy()
    repeated[present[(np.diff(x[present], prepend=np.nan) == 0) & ~np.repeat(rests, runs.length)]] = True
    far = _far(channel, settings)
    moving = (np.abs(before) > far) & (np.abs(after) > far) & (before * after > 0) & ~rests  # nor turning
    long = moving & (runs.length > 1)
    following = np.abs(np.r_[after[1:], np.nan])  # motion that begins is smaller than what follows
    chosen = (runs.length >= settings.least_repeats) & (np.abs(after) > far) & (np.abs(after) > following)
    chosen &= ~rests & ~_stands_still(runs, present, np.zeros(len(runs.value)), channel, settings)
    if _is_random(channel, settings):
        least = max(settings.least_repeats, settings.held_share * len(present), _by_chance(channel, settings))
        # a sensor that is held is so in motion too; what repeats at rest only is a robot that friction holds
        in_motion = moving.sum() < settings.least_samples or long.sum() >= settings.held_share * moving.sum()
        if repeated.sum() >= least and in_motion:
            return repeated, "held" if (runs.length > 1).mean() > settings.held_share else "frozen"
    else:
        lengths = runs.length[long]
        even = len(lengths) and (np.abs(lengths - np.median(lengths)) <= 1).mean() > settings.mostly
        # a sensor that is far slower than its log repeats nearly all values; few long runs are a robot at rest
        slow = len(lengths) and np.median(lengths) > settings.least_repeats
        share = settings.mostly if slow else settings.held_share
        if long.sum() >= settings.least_repeats and even and long.sum() >= share * moving.sum():
            return repeated, "held"
        chosen &= (np.abs(before) > far) & ~_comes_to_rest(runs, settings)
    found = none.copy()
    for first, length in zip(runs.first[chosen], runs.length[chosen], strict=True):
        found[present[first + 1 : first + length]] = True
    return found, "frozen" if found.any() else ""


def _by_chance(channel: Channel, settings: DataQualitySettings) -> float:
    """Repeats that a robot at rest hardly exceeds by chance, as its samples are rounded finer than their noise.

    Two of them are equal with the probability of a step times the density of their difference at 0.
    """
    levels = np.unique(channel.values[np.isfinite(channel.values)])
    apart = np.diff(levels)
    apart = apart[apart > settings.least_noise * channel.noise]  # less are errors of the last digit
    step = float(apart.min()) if len(apart) else 0.0
    expected = np.isfinite(channel.values).sum() * step / (2.0 * np.sqrt(np.pi) * channel.noise)
    return float(expected + np.sqrt(2.0 * settings.evidence * expected))


def _is_random(channel: Channel, settings: DataQualitySettings) -> bool:
    """Whether noise makes it unlikely that a value repeats.

    Fourth differences of white noise mostly change their sign from one to the next (correlation -0.8); those of smooth
    motion do not.
    """
    if channel.step > 0.0 or channel.noise <= settings.jump_reach * channel.reach:
        return False
    x = channel.values[np.isfinite(channel.values)]
    differences = np.diff(Runs.of(x).value, n=4)
    sizes = np.abs(differences)
    small = sizes <= np.median(sizes) if len(sizes) else np.zeros(0, bool)
    pairs = small[1:] & small[:-1]
    flips = (differences[1:] * differences[:-1] < 0)[pairs]
    return len(flips) >= settings.least_samples and bool(flips.mean() > settings.random_flips)


def repeats(values: Floats) -> Bools:
    """(T,) the inside of runs of three or more equal values, but for their middle.

    The rounding error of a level is the same in all samples on it. They tell no more than one of them does.
    """
    found = np.zeros(len(values), bool)
    present = np.flatnonzero(np.isfinite(values))
    if not len(present):
        return found
    runs = Runs.of(values[present])
    for first, length in zip(runs.first[runs.length > 2], runs.length[runs.length > 2], strict=True):
        found[present[first : first + length]] = True
        found[present[first + length // 2]] = False
    return found


def far_off(residual: Floats, spoilt: bool, settings: Settings = DEFAULT) -> Bools:
    """(T, P) whether a point is alone and far off; one of two, where the recording was ``spoilt``.

    Args:
        residual: (T, P, D) measured less simulated, in standard deviations of the noise; NaN where missing.
    """
    far = outliers(residual, settings.data_quality)
    return far | spikes(residual, 1.0, settings.data_quality) if spoilt else far
