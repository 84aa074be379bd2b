"""Public MuJoCo models that pip installs, found as files; their packages are neither imported nor run.

    python benchmarks/model_zoo.py [--models FOLDER]

Prints the models and what cannot be one. FOLDER is a site-packages folder or any folder with MJCF files; without it the
packages of this Python are searched. These have models:

    pip install --no-deps --target FOLDER gymnasium gymnasium-robotics dm_control robosuite metaworld gym-aloha \
        gym-xarm gym-hil
"""

import argparse
import hashlib
import importlib.util
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco

from soro_bench.models.simulation import quiet

PACKAGES = (
    "gymnasium", "gymnasium_robotics", "dm_control", "robosuite", "metaworld", "gym_aloha", "gym_xarm", "gym_hil",
)  # fmt: skip
_HEAD = 20_000  # characters, in which a file says that it is a model


@dataclass(frozen=True)
class ZooModel:
    """A model that loads, moves and has actuators. name: package and path within it, without its suffix."""

    name: str
    path: Path

    @property
    def package(self) -> str:
        return self.name.split("/")[0]


def zoo(folder: Path | None = None) -> list[ZooModel]:
    """The models of a folder or of the installed packages, sorted by name; of files with the same bytes one."""
    return [model for model, reason in surveyed(folder) if not reason]


def surveyed(folder: Path | None = None) -> Iterator[tuple[ZooModel, str]]:
    """Every MJCF file with the reason why it is no model of the zoo, empty if it is one."""
    seen: set[str] = set()
    for root, path in _files(folder):
        text = path.read_bytes()
        if b"<mujoco" not in text[:_HEAD] or b"<mujocoinclude" in text[:_HEAD]:
            continue
        model = ZooModel(str(path.relative_to(root).with_suffix("")), path)
        digest = hashlib.sha256(text).hexdigest()
        yield model, "the same bytes as another file" if digest in seen else unfit(path)
        seen.add(digest)


def _files(folder: Path | None) -> Iterator[tuple[Path, Path]]:
    """Folders to which names are relative, and MJCF files."""
    if folder is not None:
        yield from ((folder, path) for path in sorted(folder.rglob("*.xml")))
        return
    for package in sorted(PACKAGES):
        spec = importlib.util.find_spec(package)  # of a package without a dot it imports nothing
        for place in (spec.submodule_search_locations or []) if spec else []:
            yield from ((Path(place).parent, path) for path in sorted(Path(place).rglob("*.xml")))


def unfit(path: Path) -> str:
    """Why a file is no model that can be driven, in one line; empty if it is one."""
    try:
        with quiet():
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return str(error).splitlines()[0]
    return "" if model.nv and model.nu else "it has no degree of freedom" if not model.nv else "it has no actuator"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path)
    found = list(surveyed(parser.parse_args().models))
    for model, reason in found:
        print(f"{model.name}: {reason}" if reason else model.name)
    counts = Counter(model.package for model, reason in found if not reason)
    print(f"{counts.total()} models: {', '.join(f'{name} {count}' for name, count in counts.items())}")


if __name__ == "__main__":
    main()
