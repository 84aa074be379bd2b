"""What results name: versions and metrics."""

import platform
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("soro_bench", "mujoco", "gymnasium", "numpy", "stable_baselines3", "torch")


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
