"""Recordings from files of others; docs/reference/recordings.md describes the mapping file."""

import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from soro_bench.recording.recording import ReadingProgress, Recording, RecordingError

# by suffix: the module that reads such a file, and there guess(path)
_MODULES = {
    ".csv": "csv_table", ".tsv": "csv_table", ".txt": "csv_table", ".npz": "npz",
    ".npy": "npz", ".mat": "mat",
    ".mcap": "bags", ".db3": "bags", ".bag": "bags", ".zstd": "bags", ".zst": "bags", ".active": "bags",
    ".c3d": "c3d_file", ".trc": "motion_capture",
}  # fmt: skip
_FUNCTIONS = {
    "bags": "import_bag", "npz": "import_npz", "mat": "import_mat", "c3d_file": "import_c3d",
    "motion_capture": "import_motion_capture", "csv_table": "import_csv", "lerobot": "import_lerobot",
}  # fmt: skip
_WITH_EPISODES = ("lerobot", "npz", "mat")
_WITH_PROGRESS = ("csv_table", "bags", "motion_capture")


def import_recording(
    path: str | Path,
    mapping: str | Path | Mapping | None = None,
    progress: ReadingProgress | None = None,
    **selection: Any,
) -> Recording:
    """Read a foreign recording: a table, arrays, a bag, motion capture, or the folder of a LeRobot dataset.

    Args:
        mapping: TOML file that says what is what, or what it says; a LeRobot dataset needs none.
        progress: is told the stage, how much of the file has been read, and of how much, where that takes long.
        selection: ``episode`` of a LeRobot dataset or of arrays, ``max_bytes`` of any file.

    Raises:
        RecordingError: the file or the mapping is not as expected; says why.
    """
    path = Path(path)
    name, module = _module(path, mapping)
    if "episode" in selection and name not in _WITH_EPISODES:
        raise RecordingError(f"{path} has no episodes; only a LeRobot dataset, .npz, .npy and .mat have")
    if progress and name in _WITH_PROGRESS:
        selection["progress"] = progress
    found: Recording = getattr(module, _FUNCTIONS[name])(path, mapping, **selection)
    return replace(found, file=str(path))


def guess_mapping(path: str | Path) -> str:
    """A commented mapping (TOML) of everything in a file, to be corrected."""
    return _module(Path(path), None)[1].guess(path)


def _module(path: Path, mapping: str | Path | Mapping | None) -> tuple[str, ModuleType]:
    """The module that reads a file, and its name."""
    if importlib.util.find_spec("pyarrow") is None:
        raise ImportError("recordings need pyarrow: pip install soro_bench[record]")
    name = _folder(path) if path.is_dir() else _MODULES.get(path.suffix.lower())
    if name is None:
        raise RecordingError(f"{path}: expected {', '.join(_MODULES)}, or the folder of a bag or a LeRobot dataset; "
                             "rename a table of text to .txt, and export other files as one")  # fmt: skip
    if name == "csv_table":
        from soro_bench.recording.importers.motion_capture import is_export

        name = "motion_capture" if is_export(path, mapping) else name
    return name, importlib.import_module(f"soro_bench.recording.importers.{name}")


def _folder(path: Path) -> str:
    """The module that reads a folder."""
    from soro_bench.recording.importers.bags.files import is_bag

    return "bags" if is_bag(path) else "lerobot"
