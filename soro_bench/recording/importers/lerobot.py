"""LeRobot datasets of version 3, read without the lerobot package: one episode becomes a recording."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from soro_bench.recording.bounded_parquet import BoundedParquet
from soro_bench.recording.importers.mapping import FileMapping, Source, load_mapping
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors, read_bytes

_PLACE = ("column", "indices")
_VERSION = re.compile(r"v3\.\d{1,3}")
_MAX_FILES, _MAX_INFO_BYTES = 10_000, 10_000_000
_NUMBERS = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool")
_MAX_FOOTER = 4_000_000  # bytes: a row group per episode takes some 800
_EPISODE, _TIME = "episode_index", "timestamp"


def import_lerobot(
    path: str | Path, mapping: str | Path | Mapping | None = None, episode: int = 0, max_bytes: int = MAX_BYTES
) -> Recording:
    """Read one episode of a dataset folder; RecordingError says what is wrong with it.

    Without a mapping, ``action`` and every numeric ``observation.<name>`` are taken as they are, with unit "1".

    Args:
        episode: its ``episode_index``.
        max_bytes: largest size of one data file.
    """
    folder = Path(path)
    with named_errors(folder):
        info = json.loads(read_bytes(_inside(folder, folder / "meta" / "info.json"), _MAX_INFO_BYTES))
        features = info.get("features") if isinstance(info, dict) else None
        if not isinstance(features, dict) or not _VERSION.fullmatch(str(info.get("codebase_version"))[:20]):
            raise RecordingError("meta/info.json describes no LeRobot dataset of version 3")
        spec = load_mapping(mapping, _PLACE) if mapping else _everything(features)
    for file in _data_files(folder):
        with named_errors(file):
            table = _episode(BoundedParquet(read_bytes(file, max_bytes), max_bytes, _MAX_FOOTER), spec, episode)
            if table is not None:
                read = partial(_samples, table)
                robot = {"robot": str(info["robot_type"])[:100]} if info.get("robot_type") else {}
                spec = replace(spec, metadata={"episode": str(episode), **robot, **spec.metadata})
                return spec.recording(read, folder.resolve().name, EXPANSION * max_bytes)
    raise RecordingError(f"{folder}: there is no episode {episode}")


def _inside(folder: Path, file: Path) -> Path:
    """The file, if it lies in the folder and no link leads out of it, but to where Hugging Face's cache, with folders
    snapshots/<version>, keeps all files: blobs."""
    dataset, target = folder.resolve(), file.resolve()
    allowed = [dataset, *([dataset.parents[1] / "blobs"] if dataset.parent.name == "snapshots" else [])]
    if not any(target.is_relative_to(place) for place in allowed):
        raise RecordingError(f"{file} leads out of the dataset")
    return file


def _data_files(folder: Path) -> list[Path]:
    # as the format has them: the pattern in info.json could lead anywhere
    files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))[: _MAX_FILES + 1]
    if not 1 <= len(files) <= _MAX_FILES:
        raise RecordingError(f"{folder} has {len(files)} files data/chunk-*/file-*.parquet; expected 1 to {_MAX_FILES}")
    return [_inside(folder, file) for file in files]


def _everything(features: dict) -> FileMapping:
    """Commands and signals of all numeric features."""
    groups: dict[str, dict[str, Source]] = {"action": {}, "observation": {}}
    for column, feature in features.items():
        kind, _, name = column.partition(".")
        if kind in groups and isinstance(feature, dict) and feature.get("dtype") in _NUMBERS:
            groups[kind][name or kind] = Source("1", 1.0, np.zeros(()), "", None, 0.0, None, {"column": column})
    return FileMapping(groups["action"], groups["observation"])


def _episode(file: BoundedParquet, spec: FileMapping, episode: int) -> pa.Table | None:
    """The rows of an episode, or None if the file has none of them."""
    columns = {_column(source) for source in (*spec.commands.values(), *spec.signals.values())}
    parts = []
    for group in range(file.num_row_groups):
        rows = pc.equal(file.read([_EPISODE], [group]).column(_EPISODE), episode)
        if pc.any(rows).as_py():
            parts.append(file.read([_TIME, *sorted(columns - {_TIME})], [group]).filter(rows))
    return pa.concat_tables(parts) if parts else None


def _column(source: Source) -> str:
    column = source.place.get("column")
    if not isinstance(column, str):
        raise RecordingError(f"column is {ascii(column)[:80]}; expected a text")
    return column


def _samples(table: pa.Table, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """(T,) times [s] and (T, ...) numbers."""
    column = table.column(_column(source))
    present = pc.and_(column.is_valid(), table.column(_TIME).is_valid())
    if not pc.any(present).as_py():
        raise RecordingError("has no samples")
    time = table.column(_TIME).filter(present).to_numpy().astype(float)
    numbers = _numbers(column.filter(present), len(time))
    if "indices" in source.place:
        numbers = numbers[:, _indices(source.place["indices"], numbers)]
    return time, numbers


def _numbers(column: pa.ChunkedArray, count: int) -> np.ndarray:
    """(T,) numbers or (T, k) lists of them; NaN for a missing one."""
    is_list = pa.types.is_nested(column.type)
    if is_list:
        lengths = set(pc.list_value_length(column).unique().to_pylist())
        if len(lengths) != 1:
            raise RecordingError(f"lists have lengths {sorted(lengths)[:10]}; expected one length")
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks])
    numbers = column.cast(pa.float64(), safe=False).to_numpy()
    return numbers.reshape(count, -1) if is_list else numbers


def _indices(indices: Any, numbers: np.ndarray) -> list[int]:
    size = numbers.shape[1] if numbers.ndim == 2 else 0
    if not isinstance(indices, list) or not indices or not all(type(i) is int and 0 <= i < size for i in indices):
        raise RecordingError(f"indices {ascii(indices)[:80]} have to be a list of integers from 0 to {size - 1}")
    return indices
