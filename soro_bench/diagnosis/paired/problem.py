"""What the fit of a change explains: the recordings before it, and the measured differences.

Before the change, measured less simulated is noise plus the model's error. That error is in both recordings, so the
difference is compared with the difference of two simulations, which is free of it to first order. Both parts count as
much as they have independent samples: errors of a model are as slow as the motion, and neighbouring points share them.
Numbers of other signals than the first are scaled so that their noise is that of the first one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.estimation.problem import DIVERGED, finite
from soro_bench.diagnosis.paired.changes import LawChange, ParameterChange, Side
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.effect import Effect

Changes = Sequence[ParameterChange | LawChange]


@dataclass(frozen=True)
class Point:
    """Unknowns: x (n,) parameters and shared laws; z (k,) coordinates of changes."""

    x: Floats
    z: Floats
    changes: tuple[ParameterChange | LawChange, ...]


@dataclass(frozen=True)
class PairedProblem:
    """Pairs of recordings, M numbers in all on each side.

    shared: laws that act in both recordings, whose coordinates follow the parameters. settings: of the method.
    sigma: of the model's error before the change, and of what is left of the difference [signal's unit]. share:
    independent samples as shares of all, of both. scales: (C,) units of the first signal for one of each number's own.
    """

    robot: Robot
    before: tuple[Measured, ...]
    after: tuple[Measured, ...]
    shared: tuple[Term, ...]
    settings: Settings = DEFAULT
    sigma: tuple[float, float] = (1.0, 1.0)
    share: tuple[float, float] = (1.0, 1.0)
    scales: Floats | float = 1.0

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return len(self.robot.priors)

    @property
    def measured(self) -> tuple[Floats, Floats]:
        """(M,) before, and the differences (M,); NaN where missing."""
        sides = (self.before, self.after)
        one, two = (np.concatenate([(each.columns * self.scales).ravel() for each in some]) for some in sides)
        return one, two - one

    @property
    def seen(self) -> tuple[Bools, Bools]:
        """(M,) which numbers there are, of both."""
        one, two = self.measured
        return np.isfinite(one), np.isfinite(two)

    @property
    def bounds(self) -> Floats:
        """(2, n) of the shared unknowns."""
        parts = *(p.reach()[:, None] for p in self.robot.priors), *(s.bounds for s in self.shared)
        return np.hstack([np.zeros((2, 0)), *parts])  # all may be known

    def effects(self, x: Floats) -> list[Effect]:
        """The shared laws."""
        return effects_at(x[self.parameters :], self.shared)

    def sides(self, point: Point) -> tuple[Side, Side]:
        """The robot before and after all changes of a point; a change of a law also has the other changes."""
        shared = self.effects(point.x)
        before = after = Side(point.x[: self.parameters], tuple(shared))
        start = 0
        for change in point.changes:
            z = point.z[start : start + change.size]
            start += change.size
            one, _ = change.sides(z, before.x, before.effects)
            _, two = change.sides(z, after.x, after.effects)
            before, after = one, two
        return before, after

    def simulated(self, points: Sequence[Point]) -> tuple[Floats, Floats]:
        """(N, M) before, and differences (N, M) [signal's unit]."""
        sides = [self.sides(point) for point in points]
        first = self._replayed(self.before, [one for one, _ in sides])
        second = self._replayed(self.after, [two for _, two in sides])
        return first, second - first

    def _replayed(self, recordings: Sequence[Measured], sides: Sequence[Side]) -> Floats:
        """(N, M) signals."""
        rows = np.array([side.x for side in sides])
        columns = [prior.value(rows[:, i]) for i, prior in enumerate(self.robot.priors)]
        parameters = np.stack(columns, axis=1) if columns else rows  # all may be known
        parts = self.robot.simulate_all(
            [each.drive for each in recordings], parameters, [side.effects for side in sides]
        )
        return np.concatenate([(part * self.scales).reshape(len(sides), -1) for part in parts], axis=1)

    def residuals(self, points: Sequence[Point]) -> Floats:
        """(N, 2 M) residuals before and of the difference, each number counting as its independent share."""
        found = []
        for values, given, seen, sigma, share in zip(
            self.simulated(points), self.measured, self.seen, self.sigma, self.share, strict=True
        ):
            off = np.where(seen, (np.nan_to_num(given) - values) / sigma, 0.0)
            found.append(np.clip(finite(off), -DIVERGED, DIVERGED) * np.sqrt(share))
        return np.hstack(found)

    def squares(self, points: Sequence[Point]) -> Floats:
        """(N, 2) sums of squares of what is left [signal's unit, squared], before and of the difference."""
        rows = replace(self, sigma=(1.0, 1.0), share=(1.0, 1.0)).residuals(points)
        half = rows.shape[1] // 2
        return np.stack([(rows[:, :half] ** 2).sum(axis=1), (rows[:, half:] ** 2).sum(axis=1)], axis=1)

    def scale(self, which: int) -> float:
        """Units of the first signal for one of a signal's own."""
        first = sum(each.size for each in self.robot.signals[:which])
        return float(np.broadcast_to(self.scales, self.robot.columns)[first])

    def rms(self, point: Point, which: int) -> tuple[float, float]:
        """Rms of a number of one signal [its unit] that a point leaves, before and of the difference."""
        signals = np.repeat(np.arange(len(self.robot.signals)), [each.size for each in self.robot.signals])
        own = np.concatenate([np.tile(signals == which, len(each.time)) for each in self.before])
        rows = replace(self, sigma=(1.0, 1.0), share=(1.0, 1.0)).residuals([point])[0].reshape(2, -1)
        counts = [max(float(seen[own].sum()), 1.0) for seen in self.seen]
        one, two = (float(np.sqrt((row[own] ** 2).sum() / n)) for row, n in zip(rows, counts, strict=True))
        return one / self.scale(which), two / self.scale(which)

    def split(self, samples: Floats) -> list[Floats]:
        """(M,) numbers as (T, C) of every recording."""
        ends = np.cumsum([each.columns.size for each in self.before])[:-1]
        return [part.reshape(len(m.time), -1) for part, m in zip(np.split(samples, ends), self.before, strict=True)]

    def independent(self, left: Floats, seen: Bools) -> float:
        """How many independent samples (M,) numbers ``left`` are."""
        total = 0.0
        for part, there in zip(self.split(np.where(seen, left, 0.0)), self.split(seen.astype(float)), strict=True):
            total += _independent(part[there.any(axis=1)][:, there.any(axis=0)], float(there.sum()))
        return max(total, 1.0)


def _independent(values: Floats, count: float) -> float:
    """Of (T, C) numbers: samples over the time that they are correlated, times the number of independent columns (that
    of equal eigenvalues with the same sum of squares).

    An inference counts them by the same idea, but not to the same number (``independent`` in ``inference/guard.py``):
    here lags are summed in pairs, as one alone may be below zero by chance, missing numbers count as zeros, and there
    are never more than ``count``.
    """
    if not values.size or not values.any():
        return count
    covariance = values.T @ values
    columns = float(np.trace(covariance) ** 2 / (covariance**2).sum())
    length = len(values)
    size = 1 << int(np.ceil(np.log2(2 * length)))
    spectrum = (np.abs(np.fft.rfft(values, size, axis=0)) ** 2).sum(axis=1)
    correlation = np.fft.irfft(spectrum, size)[:length]
    correlation = correlation / correlation[0]
    pairs = correlation[:-1:2] + correlation[1::2][: len(correlation[:-1:2])]  # Geyer's initial positive sequence
    last = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    time = max(2.0 * float(pairs[:last].sum()) - 1.0, 1.0)
    return min(columns * length / time, count)
