"""The table of a training: curve.csv."""

import csv
from pathlib import Path

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.sources import metric_key


def read_curve(path: str | Path, metric: str, parts: int) -> tuple[Floats, Floats]:
    """Steps and mean final metric [mm] of the episodes in each of so many equal parts of a training.

    A part mixes whole updates: the episodes that end early in an update are the successful ones.

    Raises:
        ValueError: the file is no such table.
    """
    names = ("steps", "episodes", metric_key(metric))
    try:
        with Path(path).open() as file:
            rows = [tuple(float(row[name]) for name in names) for row in csv.DictReader(file)]
        steps, episodes, value = np.array(rows).T
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is no table of {', '.join(names)} ({type(error).__name__}: {error})") from error
    if not ((steps > 0) & (episodes > 0)).all() or not np.isfinite(rows).all():
        raise ValueError(f"{path} has steps or episodes that are not positive, or other numbers that are not finite")
    part = np.minimum((parts * steps / steps[-1]).astype(int), parts - 1)
    present = np.unique(part)
    means = [np.average(value[part == k], weights=episodes[part == k]) for k in present]
    return (present + 0.5) / parts * steps[-1], np.array(means)
