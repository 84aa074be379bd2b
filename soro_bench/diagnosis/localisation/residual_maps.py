"""Localise: when, and under which conditions, a hypothesis explains more than another one."""

from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem

WINDOW = 1.0  # s, of maps over time
WINDOWS = 1_000_000  # more than a recording has
_WHEN = 0.8  # of what is explained lies in the intervals that are named
_AFTER_REVERSAL, _STILL = 0.25, 1e-3  # s; share of the fastest rate


@dataclass(frozen=True)
class Regime:
    """Share of time, and of what is explained, under a condition."""

    condition: str
    time: float
    explained: float


def residual_map(problem: Problem, residual: np.ndarray) -> np.ndarray:
    """(windows, points) rms [signal's unit] of what the numerical floor does not explain, of the first recording; NaN
    where nothing was measured."""
    left = left_over(problem, residual)
    size = _samples(problem)
    count = len(left) // size
    windows = left[: count * size].reshape(count, size, *left.shape[1:])
    seen = np.isfinite(windows).sum(axis=(1, 3))
    return np.sqrt(np.nansum(windows**2, axis=(1, 3)) / np.where(seen, seen, np.nan))


def map_window(problem: Problem) -> float:
    """s, how long the windows of the map are."""
    return _samples(problem) * _spacing(problem)


def _samples(problem) -> int:
    return max(1, round(WINDOW / _spacing(problem)))


def _spacing(problem) -> float:
    return float(np.median(np.diff(problem.recordings[0].time)))


def left_over(problem: Problem, residual: np.ndarray) -> np.ndarray:
    """(T, P, D) [signal's unit] what the numerical floor does not explain, of the first recording; NaN where nothing
    was measured."""
    return problem.split(
        np.where(problem.weight > 0, problem.sigma * problem.discretisation.without(residual), np.nan)
    )[0]


def explained_over_time(problem: Problem, before: Hypothesis, after: Hypothesis) -> np.ndarray:
    """(T,) evidence gained in each sample of the first recording."""
    squares = [problem.split(problem.discretisation.without(h.residual))[0] ** 2 for h in (before, after)]
    return 0.5 * (squares[0] - squares[1]).reshape(len(squares[0]), -1).sum(axis=1)


def intervals(time: np.ndarray, gain: np.ndarray) -> list[tuple[float, float]]:
    """The fewest windows with most of the gain, as intervals [s]; none if nothing is gained."""
    edges = np.arange(0.0, time[-1] + WINDOW, WINDOW)
    of_window = np.histogram(time - 1e-9, edges, weights=np.maximum(gain, 0.0))[0]
    if not of_window.any():
        return []
    order = np.argsort(of_window)[::-1]
    enough = int(np.searchsorted(np.cumsum(of_window[order]), _WHEN * of_window.sum())) + 1
    found: list[tuple[float, float]] = []
    for i in sorted(order[:enough]):
        start, end = float(edges[i]), float(min(edges[i + 1], time[-1]))
        if found and found[-1][1] == start:
            start = found.pop()[0]
        found.append((start, end))
    return found


def regimes(time: np.ndarray, rates: np.ndarray, gain: np.ndarray) -> list[Regime]:
    """What is explained while commands move fast or slowly, have just reversed, or rest; and early or late.

    Args:
        time: (T,) s.
        rates: (T, A) of the commands.
        gain: (T,) what is explained in each sample.
    """
    steps = max(1, round(_AFTER_REVERSAL / float(np.median(np.diff(time)))))
    rates = rates / max(float(np.abs(rates).max(initial=0.0)), 1e-300)
    speed = np.abs(rates).max(axis=1, initial=0.0)
    moving, fast = speed > _STILL, speed > 0.5 * speed.max()
    reversal = np.zeros(len(rates), bool)
    for column in np.sign(np.where(np.abs(rates) > _STILL, rates, 0.0)).T:
        last = 0.0
        for t, sign in enumerate(column):
            if sign and last and sign != last:
                reversal[t : t + steps] = True
            last = sign or last
    gained = np.maximum(gain, 0.0)
    total = max(float(gained.sum()), 1e-300)
    masks = {
        "just after reversals": reversal,
        "while it moves on, fast": fast & moving & ~reversal,
        "while it moves on, slowly": ~fast & moving & ~reversal,
        "while it rests": ~moving & ~reversal,
        "early": time <= 0.5 * time[-1],
        "late": time > 0.5 * time[-1],
    }
    return [Regime(name, float(m.mean()), float(gained[m].sum()) / total) for name, m in masks.items()]


def windows(problem: Problem, length: float) -> np.ndarray:
    """(M,) the number of the window of that length [s] that a sample is in, rising; ``WINDOWS`` higher for the next
    recording."""
    return np.concatenate([
        # a sample at the end of a window belongs to it, as its control step does
        np.repeat(((each.time - 1e-9) // length).astype(int), each.values[0].size) + WINDOWS * i
        for i, each in enumerate(problem.recordings)
    ])
