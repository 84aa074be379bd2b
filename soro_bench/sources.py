"""Which sources and versions a result comes from, and what it calls its metric."""

import hashlib
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from soro_bench.files import is_temporary, mjcf_path, replacing

# of an episode; and scenes
SIMULATION = ("parameters.py", "arrays.py", "randomization.py", "models/*.py", "envs/*.py", "effects/*.py")
METHOD = (*SIMULATION, "diagnosis/**/*.py", "recording/*.py", "inference/statistical_linearisation.py")
_PACKAGES = ("soro_bench", "mujoco", "gymnasium", "numpy", "stable_baselines3", "torch")


def version_of(parts: Iterable[str]) -> str:
    """A hash of files of this package, given as patterns, and of all scenes: with another one, the same work may give
    other results."""
    package, digest = Path(__file__).parent, hashlib.sha256()
    scenes = sorted(mjcf_path(".").rglob("*.xml"))
    files = {part: list(package.glob(part)) for part in parts}
    if missing := [part for part, found in files.items() if not found]:
        raise FileNotFoundError(f"{package} has no file like {', '.join(missing)}")
    for file in (*sorted(file for found in files.values() for file in found), *scenes):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def claim(path: Path, sources: str) -> None:
    """Write into the file ``path`` of which version the files of its folder are; ValueError if they are of another."""
    if path.exists():
        if path.read_text().strip() != sources:
            raise ValueError(f"{path.parent} has results of another version of the sources; choose another folder")
        return
    if path.parent.is_dir() and any(not is_temporary(each) for each in path.parent.iterdir()):
        raise ValueError(f"{path.parent} has results, and no {path.name} that says of which version of the sources; "
                         "choose another folder")  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(sources + "\n")


def method_version() -> str:
    """A hash of the source files that the method consists of."""
    return version_of(METHOD)


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
