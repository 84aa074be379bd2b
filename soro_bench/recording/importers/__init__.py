"""Recordings from files of others; docs/reference/recordings.md describes the mapping file."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from soro_bench.recording.recording import Recording, RecordingError


def import_recording(path: str | Path, mapping: str | Path | Mapping | None = None, **selection: Any) -> Recording:
    """Read a foreign recording: .csv, .tsv or .txt, .npz, .mcap, or the folder of a LeRobot dataset.

    Args:
        mapping: TOML file that says what is what, or what it says; a LeRobot dataset needs none.
        selection: ``episode`` of a LeRobot dataset, ``max_bytes`` of any file.

    Raises:
        RecordingError: the file or the mapping is not as expected; says why.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise ImportError("recordings need pyarrow: pip install soro_bench[record]")
    path = Path(path)
    if path.is_dir():
        from soro_bench.recording.importers.lerobot import import_lerobot

        return import_lerobot(path, mapping, **selection)
    if "episode" in selection:
        raise RecordingError(f"{path} has no episodes; only the folder of a LeRobot dataset has")
    if path.suffix.lower() == ".mcap":
        from soro_bench.recording.importers.mcap_file import import_mcap

        return import_mcap(path, mapping, **selection)
    if path.suffix.lower() == ".npz":
        from soro_bench.recording.importers.npz import import_npz

        return import_npz(path, mapping, **selection)
    if path.suffix.lower() in (".csv", ".tsv", ".txt"):
        from soro_bench.recording.importers.csv_table import import_csv

        return import_csv(path, mapping, **selection)
    raise RecordingError(f"{path}: expected .csv, .tsv, .txt, .npz, .mcap or the folder of a LeRobot dataset")
