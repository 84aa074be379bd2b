"""Entries as a table for the console and for documents."""

from collections.abc import Iterable

import numpy as np

from soro_bench.leaderboard.gather import Group
from soro_bench.leaderboard.statistics import interval
from soro_bench.markdown import table

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


def markdown_table(groups: Iterable[Group]) -> str:
    """A row per method and condition: mean over seeds and starts, its bootstrap interval over seeds, every seed's."""
    rows = []
    for group in groups:
        for label in group.labels:
            values = group.scores(label)
            ends = interval(np.mean, (values,), np.random.default_rng(0))
            mean = f"{values.mean():.2f}" + (" [{:.2f}, {:.2f}]".format(*ends) if ends else "")
            seeds = ", ".join(f"{value:.2f}" for value in values.mean(axis=1))
            solved = f"{group.scores(label, 'success').mean():.0%}"
            rows.append((group.board, group.name, group.trained_on, label, len(values), mean, solved, seeds))
    return table(_HEAD, rows)
