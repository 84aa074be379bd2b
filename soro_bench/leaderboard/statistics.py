"""Statistics of the leaderboard's entries, and entries as a table for the console and for documents."""

from collections.abc import Callable, Iterable

import numpy as np
from scipy.stats import permutation_test

from soro_bench.leaderboard.gather import Group
from soro_bench.markdown import table

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


def chance_of_difference(values: np.ndarray, others: np.ndarray) -> float:
    """Two-sided p value of a permutation test over training seeds: how often policies that are dealt to two methods at
    random differ as much, by the interquartile means over seeds and starts that methods are ranked by.

    Args:
        values, others: (seeds, starts) of each method.

    Returns:
        1 where a method has one seed: then no deal says anything.
    """
    if min(len(values), len(others)) < 2:
        return 1.0
    policies = np.concatenate([values, others])

    def apart(first: np.ndarray, second: np.ndarray) -> float:
        return interquartile_mean(policies[first]) - interquartile_mean(policies[second])

    seeds = np.split(np.arange(len(policies)), [len(values)])
    found = permutation_test(seeds, apart, rng=np.random.default_rng(0))
    return float(found.pvalue)


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


_HEAD = (
    "board",
    "method",
    "trained on",
    "evaluated on",
    "seeds",
    "mean [mm], 95 % interval",
    "solved",
    "per seed [mm]",
)


def mean_and_interval(values: np.ndarray) -> str:
    """The mean of values (seeds, starts) and its bootstrap interval over seeds, if there are several."""
    ends = interval(np.mean, (values,), np.random.default_rng(0))
    return f"{values.mean():.2f}" + (" [{:.2f}, {:.2f}]".format(*ends) if ends else "")


def markdown_table(groups: Iterable[Group]) -> str:
    """A row per method and condition: mean over seeds and starts, its bootstrap interval over seeds, every seed's."""
    rows = []
    for group in groups:
        for label in group.labels:
            values = group.scores(label)
            mean = mean_and_interval(values)
            seeds = ", ".join(f"{value:.2f}" for value in values.mean(axis=1))
            solved = f"{group.scores(label, 'success').mean():.0%}"
            rows.append((group.board, group.name, group.trained_on, label, len(values), mean, solved, seeds))
    return table(_HEAD, rows)
