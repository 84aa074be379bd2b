"""Residual maps: when, and under which conditions, a hypothesis explains more than another one."""

from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.settings import DEFAULT, LocalisationSettings, Settings

WINDOWS = 1_000_000  # more than a recording has


@dataclass(frozen=True)
class Regime:
    """A condition, the share of time under it, and the share of the improvement then."""

    condition: str
    time: float
    explained: float


def explained_over_time(problem: Problem, before: Hypothesis, after: Hypothesis) -> np.ndarray:
    """(T,) log evidence [nats] that ``after`` gains over ``before`` in each sample of the first recording."""
    squares = [problem.rows(problem.discretisation.without(h.residual))[0] ** 2 for h in (before, after)]
    return 0.5 * (squares[0] - squares[1]).sum(axis=1)


def intervals(
    time: np.ndarray, gain: np.ndarray, settings: LocalisationSettings = DEFAULT.localisation
) -> list[tuple[float, float]]:
    """The fewest windows with most of the gain, as intervals [s]; none if nothing is gained.

    Args:
        time: (T,) s.
        gain: (T,) log evidence gained in each sample.
    """
    edges = np.arange(0.0, time[-1] + settings.map_window, settings.map_window)
    of_window = np.histogram(time - 1e-9, edges, weights=np.maximum(gain, 0.0))[0]
    if not of_window.any():
        return []
    order = np.argsort(of_window)[::-1]
    enough = int(np.searchsorted(np.cumsum(of_window[order]), settings.shown_share * of_window.sum())) + 1
    joined: list[tuple[float, float]] = []
    for i in sorted(order[:enough]):
        start, end = float(edges[i]), float(min(edges[i + 1], time[-1]))
        if joined and joined[-1][1] == start:
            start = joined.pop()[0]
        joined.append((start, end))
    return joined


def regimes(time: np.ndarray, rates: np.ndarray, gain: np.ndarray, settings: Settings = DEFAULT) -> list[Regime]:
    """Improvement while commands move fast or slowly, have just reversed, or rest; and early or late.

    Args:
        time: (T,) s.
        rates: (T, A) of the commands.
        gain: (T,) log evidence gained in each sample.
    """
    still, maps = settings.limits.tolerance, settings.localisation
    steps = max(1, round(maps.after_reversal / float(np.median(np.diff(time)))))
    rates = rates / max(float(np.abs(rates).max(initial=0.0)), 1e-300)
    speed = np.abs(rates).max(axis=1, initial=0.0)
    moving, fast = speed > still, speed > maps.fast_rate * speed.max()
    reversal = np.zeros(len(rates), bool)
    for column in np.sign(np.where(np.abs(rates) > still, rates, 0.0)).T:
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
    """(M,) the number of the window of a length [s] in which each sample is, rising; ``WINDOWS`` higher for the next
    recording."""
    return np.concatenate([
        # a sample at the end of a window belongs to it, as its control step does
        np.repeat(((each.time - 1e-9) // length).astype(int), problem.robot.columns) + WINDOWS * i
        for i, each in enumerate(problem.recordings)
    ])
