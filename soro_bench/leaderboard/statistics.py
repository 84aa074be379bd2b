"""Figures of merit with bootstrap intervals.

After Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
Values are arrays (seeds, starts): a row is what one policy does. There, every task has trainings of its own, and runs
are resampled for every task by itself. Here one policy goes through all starts, so rows are resampled as a whole: what
a training was unlucky in, it is at all starts, and to resample these apart would make intervals too narrow.
"""

from collections.abc import Callable

import numpy as np

RESAMPLES = 2000
LEVEL = 95  # per cent of an interval


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half of all values: a quarter of them, rounded down, is cut from either end."""
    ordered = np.sort(values, axis=None)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def probability_of_improvement(values: np.ndarray, reference: np.ndarray, higher: bool) -> float:
    """Chance that a policy of ``values`` is better than one of ``reference`` at a start; ties count half.

    Args:
        values, reference: (seeds, starts), the same starts.
        higher: whether higher values are better.
    """
    difference = values[:, None] - reference[None]
    return float(np.mean(0.5 * (1.0 + np.sign(difference if higher else -difference))))


def interval(
    statistic: Callable[..., float], groups: tuple[np.ndarray, ...], rng: np.random.Generator
) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of ``statistic(*groups)``; None where a group has one seed only.

    Args:
        groups: arrays (seeds, starts), whose seeds are resampled independently.
    """
    if min(map(len, groups)) < 2:
        return None
    draws = [statistic(*(g[rng.integers(len(g), size=len(g))] for g in groups)) for _ in range(RESAMPLES)]
    low, high = np.percentile(draws, ((100 - LEVEL) / 2, (100 + LEVEL) / 2))
    return float(low), float(high)
