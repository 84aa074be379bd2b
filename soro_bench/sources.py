"""Which sources a result comes from."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from soro_bench.assets import mjcf_path
from soro_bench.files import is_temporary, replacing

SIMULATION = ("parameters.py", "rotation.py", "models/*.py", "envs/*.py", "effects/*.py")  # of an episode; and scenes
METHOD = (*SIMULATION, "diagnosis/**/*.py", "recording/*.py", "inference/statistical_linearisation.py")


def version_of(parts: Iterable[str]) -> str:
    """A hash of files of this package, given as patterns, and of all scenes: with another one, the same work may give
    other results."""
    package, digest = Path(__file__).parent, hashlib.sha256()
    scenes = sorted(mjcf_path(".").rglob("*.xml"))
    for file in (*sorted(file for part in parts for file in package.glob(part)), *scenes):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def claim(path: Path, version: str) -> None:
    """Write into the file ``path`` of which version the files of its folder are; ValueError if they are of another."""
    if path.exists():
        if path.read_text().strip() != version:
            raise ValueError(f"{path.parent} has results of another version of the sources; choose another folder")
        return
    if path.parent.is_dir() and any(not is_temporary(each) for each in path.parent.iterdir()):
        raise ValueError(f"{path.parent} has results, and no {path.name} that says of which version of the sources; "
                         "choose another folder")  # fmt: skip
    with replacing(path) as temporary:
        temporary.write_text(version + "\n")


def method_version() -> str:
    """A hash of the source files that the method consists of."""
    return version_of(METHOD)
