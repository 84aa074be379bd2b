"""What results name and state: versions, metrics, intervals."""

import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

import numpy as np

_PACKAGES = ("soro_bench", "mujoco", "gymnasium", "numpy", "stable_baselines3", "torch")
_RESAMPLES = 10_000


def versions() -> dict[str, str]:
    """Versions of what a result depends on; packages that are not installed are left out."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def metric_key(metric: str) -> str:
    """How results and training curves call the final value of a task's metric."""
    return f"final_{metric}_mm"


def interval(groups: Sequence[Sequence[float]], seed: int = 0) -> tuple[float, float, float]:
    """Mean over all values and its 95 % stratified-bootstrap interval.

    Args:
        groups: one sequence of values per training seed (or box); seeds and values within them are both resampled.
        seed: of the resampling.
    """
    groups = [np.asarray(group, float) for group in groups]
    rng = np.random.default_rng(seed)
    means = np.empty(_RESAMPLES)
    for r in range(_RESAMPLES):
        picked = rng.integers(len(groups), size=len(groups))
        means[r] = np.mean([rng.choice(groups[g], len(groups[g])).mean() for g in picked])
    low, high = np.quantile(means, [0.025, 0.975])
    return float(np.mean([g.mean() for g in groups])), float(low), float(high)
