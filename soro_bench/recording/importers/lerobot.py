"""LeRobot datasets, read without the lerobot package: one episode becomes a recording."""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from soro_bench.recording.importers.lerobot_files import NUMBERS, TIME, Dataset, opened
from soro_bench.recording.importers.mapping import FileMapping, load_mapping, texts
from soro_bench.recording.importers.source import Source, numbers_of, order_of
from soro_bench.recording.importers.tracks import signal_name
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors

_CALIBRATION = ("range_min", "range_max", "normalised", "resolution")
_PLACE = ("column", "indices", "names", *_CALIBRATION)
_NORMALISED = (-100.0, 100.0)  # lerobot's RANGE_M100_100
_RESOLUTION = 4096  # of the motors of SO-100, SO-101 and Koch: a turn is from 0 to 4095
_OTHER_RATE = 0.2  # by which the time between rows may differ from 1 / fps
_GROUPS = {"action": "commands", "observation": "signals"}


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
        dataset = opened(folder)
        spec = _everything(dataset)
    if mapping:
        spec = load_mapping(mapping, _PLACE, ("interval", "rate"), unit_optional=True)
    with named_errors(folder):
        columns = {_column(source) for source in (*spec.commands.values(), *spec.signals.values())}
        table = dataset.rows(episode, [TIME, *sorted(columns - {TIME})], max_bytes)
        time = _times(table, dataset, spec)
        robot = {"robot": dataset.robot} if dataset.robot else {}
        spec = replace(spec, metadata={"episode": str(episode), **robot, **spec.metadata})
        read = partial(_samples, table, time, dataset)
        return spec.recording(read, folder.resolve().name, EXPANSION * max_bytes, _unit)


def guess(path: str | Path) -> str:
    """A mapping (TOML) of all numeric features, to be corrected."""
    with named_errors(path):
        dataset = opened(Path(path))
        lines = [f"# LeRobot dataset of version {dataset.major}; --episode NUMBER chooses the episode"]
        for column in _numeric(dataset):
            kind, _, name = column.partition(".")
            lines += ["", f"[{_GROUPS[kind]}.{signal_name(name or kind)}]", f"column = {json.dumps(column)}"]
            try:
                lines.append(f"names = {json.dumps(dataset.names(column))}  # in the order that the signal gets")
            except RecordingError:
                lines.append("# indices = [0]  # which of its numbers; there are no names")
            lines.append('unit = "1"  # what it is: "deg", "rad"; lerobot does not say it')
        lines += ["", "# Of numbers from -100 to 100 (normalised = [0, 100]: from 0), leave unit out and copy from the",
                  "# calibration file range_min = [...] and range_max = [...], a number for each name."]  # fmt: skip
        return "\n".join(lines) + "\n"


def _numeric(dataset: Dataset) -> list[str]:
    """The columns of numbers that are commands or signals."""
    features = dataset.features.items()
    return [column for column, about in features if about.get("dtype") in NUMBERS and column.split(".")[0] in _GROUPS]


def _everything(dataset: Dataset) -> FileMapping:
    """Commands and signals of all numeric features."""
    groups: dict[str, dict[str, Source]] = {group: {} for group in _GROUPS.values()}
    for column in _numeric(dataset):
        kind, _, name = column.partition(".")
        groups[_GROUPS[kind]][name or kind] = Source("1", 1.0, np.zeros(()), "", None, 0.0, None, {"column": column})
    return FileMapping(groups["commands"], groups["signals"])


def _column(source: Source) -> str:
    column = source.place.get("column")
    if not isinstance(column, str):
        raise RecordingError(f"column is {ascii(column)[:80]}; expected a text")
    return column


def _unit(source: Source) -> str:
    """The unit of what the calibration makes degrees."""
    if "range_min" in source.place:
        return "deg"
    raise RecordingError(f'{source.place.get("column")}: LeRobot says no units; write unit = "deg", "rad" or "1", or '
                         "range_min and range_max of numbers from -100 to 100")  # fmt: skip


def _times(table: pa.Table, dataset: Dataset, spec: FileMapping) -> np.ndarray:
    """(T,) times [s], NaN where a row has none."""
    if {"interval", "rate"} & spec.time.keys():
        return spec.counted(len(table))
    time = table.column(TIME).cast(pa.float64()).to_numpy(zero_copy_only=False)
    steps = np.diff(time)
    if dataset.fps is not None and len(steps) and abs(np.median(steps) * dataset.fps - 1.0) > _OTHER_RATE:
        raise RecordingError(f"meta/info.json says fps = {dataset.fps:g}, and rows are {np.median(steps):.4g} s apart; "
                             "correct fps, or write [time] rate")  # fmt: skip
    return time


def _samples(table: pa.Table, time: np.ndarray, dataset: Dataset, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """(T,) times [s] and (T, ...) numbers."""
    name = _column(source)
    column = table.column(name)
    present = column.is_valid().to_numpy() & ~np.isnan(time)
    if not present.any():
        raise RecordingError("has no samples")
    numbers = _numbers(column.filter(pa.array(present)), int(present.sum()))
    shape = dataset.features.get(name, {}).get("shape")
    if isinstance(shape, list) and len(shape) == 1 and shape[0] != np.size(numbers[0]):
        raise RecordingError(f"meta/info.json says that {name[:60]} has shape {ascii(shape)[:40]}; its rows have "
                             f"{np.size(numbers[0])} numbers: correct the shape and the names")  # fmt: skip
    chosen = _chosen(source.place, numbers, dataset, name)
    if chosen is not None:
        numbers = numbers.reshape(len(numbers), -1)[:, chosen]
    return time[present], _degrees(numbers, source)


def _numbers(column: pa.ChunkedArray, count: int) -> np.ndarray:
    """(T,) numbers or (T, ...) lists of them; NaN for a missing one."""
    shape: list[int] = []
    while pa.types.is_nested(column.type):
        lengths = set(pc.list_value_length(column).unique().to_pylist())
        if len(lengths) != 1:
            raise RecordingError(f"lists have lengths {sorted(lengths, key=str)[:10]}; expected one length")
        shape += lengths
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks])
    return column.cast(pa.float64(), safe=False).to_numpy().reshape(count, *shape)


def _chosen(place: Mapping[str, Any], numbers: np.ndarray, dataset: Dataset, column: str) -> list[int] | None:
    """Which of the numbers of a sample."""
    size = int(np.size(numbers[0]))
    if "names" in place:
        if "indices" in place:
            raise RecordingError("says both names and indices; keep one")
        return order_of(texts("names", place["names"]), dataset.names(column))
    if "indices" not in place:
        return None
    indices = place["indices"]
    if not isinstance(indices, list) or not indices or not all(type(i) is int and 0 <= i < size for i in indices):
        raise RecordingError(f"indices {ascii(indices)[:80]} have to be a list of integers from 0 to {size - 1}")
    return indices


def _degrees(numbers: np.ndarray, source: Source) -> np.ndarray:
    """Numbers that lerobot has normalised to each motor's range, as its degrees: from the middle of that range."""
    place = source.place
    given = [key for key in _CALIBRATION if key in place]
    if not given:
        return numbers
    if not {"range_min", "range_max"} <= place.keys():
        raise RecordingError(f"{given[0]} needs range_min and range_max, which the calibration file has of each motor")
    if source.unit not in (None, "deg"):
        raise RecordingError(f"unit = {source.unit!r}; range_min and range_max make degrees: leave unit out")
    try:
        least, most = (np.broadcast_to(numbers_of(key, place[key]), numbers.shape[1:]) for key in given[:2])
        normal = np.asarray(numbers_of("normalised", place.get("normalised", _NORMALISED)), float)
        low, high = np.moveaxis(np.broadcast_to(normal, (*numbers.shape[1:], 2)), -1, 0)
    except ValueError as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"range_min, range_max and normalised need a number, or [from, to], for each of the "
                             f"{np.size(numbers[0])} numbers of a sample") from error  # fmt: skip
    resolution = place.get("resolution", _RESOLUTION)
    if type(resolution) is not int or resolution < 2 or (most <= least).any() or (high <= low).any():
        raise RecordingError("range_max has to exceed range_min, and resolution is how many steps a turn has")
    return ((numbers - low) / (high - low) - 0.5) * (most - least) * 360.0 / (resolution - 1)
