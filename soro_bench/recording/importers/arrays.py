"""Files of named arrays (.npz, .npy, .mat): which entries of them are the samples of a command or signal."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from soro_bench.recording.importers.clock import NO_STAMP
from soro_bench.recording.importers.mapping import NO_COMMAND, FileMapping, Source, load_mapping, texts, unit_doubt
from soro_bench.recording.importers.table_cells import occurs
from soro_bench.recording.importers.tracks import signal_name
from soro_bench.recording.importers.units import origin, split_unit, time_unit
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_ROWS

_PLACE = ("arrays", "indices", "time")
_TIME = ("array", "indices", "unit", "interval", "rate", "period")
_FORMAT = ("episode", "ends", "lengths", "label", "only")
_ROWS, _ALL = "rows", ":"  # in indices
_MAX_DIMENSIONS = 5
_CLOCKS = ("time", "t", "timestamp", "timestamps", "times", "stamp", "time_s", "sec", "seconds", "tout")
_TIMELIKE = re.compile(r"(^|[^a-z])(t|ts|elapsed|clock)([^a-z]|$)|^time|time$|stamps?$")  # of what increases
_COMMANDS = ("action", "actions", "u", "cmd", "command", "commands", "ctrl", "control", "tau_cmd", "q_des", "setpoint")
_NANOSECONDS = {"ns": 1, "us": 1_000, "ms": 1_000_000}  # of whole numbers, which stay whole


class ArrayFile(Protocol):
    """Arrays by name: real numbers, dates or texts, and nothing else."""

    kind: str  # of file, for messages

    @property
    def names(self) -> list[str]:
        """Of all arrays."""

    def array(self, name: str) -> np.ndarray:
        """One of them as it is in the file; RecordingError for anything but numbers, dates and texts."""


def array_mapping(path: str | Path, mapping: str | Path | Mapping | None, episode: int | None) -> FileMapping:
    """The mapping of a file of arrays; RecordingError says what is wrong with it, or how to get one."""
    if mapping is None:
        raise RecordingError(f"{path}: needs a mapping; soro-bench import {Path(path).name} --guess writes one")
    spec = load_mapping(mapping, _PLACE, _TIME, _FORMAT)
    return spec if episode is None else replace(spec, format={**spec.format, "episode": episode})


def import_arrays(path: str | Path, file: ArrayFile, spec: FileMapping, max_bytes: int = MAX_BYTES) -> Recording:
    """The recording of what a mapping chooses; RecordingError says what is wrong with it."""
    spec.to_seconds()
    most = EXPANSION * max_bytes
    arrays = _Arrays(file, most)
    cut = _Cut(arrays, spec.format)
    for group, sources in (("commands", spec.commands), ("signals", spec.signals)):
        for label, source in sources.items():
            names = [name for name in source.place.get("arrays", []) if isinstance(name, str)]
            spec.notes.add(f"{group}.{label}", unit_doubt(source, names))

    def read(source: Source) -> tuple[np.ndarray, np.ndarray]:
        """(T,) times [s] or [ns] and (T, k) numbers: rows of the arrays, one after the other."""
        names = texts("arrays", source.place.get("arrays"))
        clock = source.place.get("time", spec.time.get("array"))
        rows, size = [], 0
        for name in names:
            array = cut.of(arrays.numbers(name))
            if array.ndim == 2 and len(array) == 1 and not (clock and arrays.of(clock).size == 1):
                array = array.ravel()  # a row of MATLAB, and no sample of one time
            rows.append(_rows(array, source.place.get("indices"), name))
            size += rows[-1].nbytes
            if size > most:
                raise RecordingError(f"arrays {ascii(names)[1:80]} have more than {most} bytes")
        if len(counts := {len(array) for array in rows}) > 1:
            raise RecordingError(f"its arrays have {sorted(counts)} rows; all need as many")
        numbers = np.concatenate([array.reshape(len(array), -1) for array in rows], axis=1)
        indices = None if "time" in source.place else spec.time.get("indices")
        time = spec.counted(len(numbers)) if clock is None else _times(arrays, cut, spec, clock, indices, len(numbers))
        present = ~np.isnan(numbers).all(axis=1)  # episodes of several lengths are filled up with NaN
        present &= ~np.isnan(time) if time.dtype.kind == "f" else time != NO_STAMP
        if not present.any():
            raise RecordingError("no row has a time and a number")
        return time[present], numbers[present]

    return spec.recording(read, Path(path).name, most)


@dataclass
class _Arrays:
    """Arrays in bounded memory."""

    file: ArrayFile
    most: int

    def of(self, name: Any) -> np.ndarray:
        """An array by name, or a field of one: ``array.field``."""
        names = self.file.names
        if isinstance(name, str) and names.count(name) == 1:
            return self.file.array(name)
        whole, _, part = name.rpartition(".") if isinstance(name, str) else ("", "", "")
        if names.count(whole) == 1 and part in (self.file.array(whole).dtype.names or ()):
            return self.file.array(whole)[part]
        found = ", ".join(ascii(each)[1:-1] for each in names)[:200] or "none"
        count = names.count(name)
        label = f"{count} arrays are" if count else "no array is"
        raise RecordingError(f"{label} called {ascii(name)[:80]}; there are {found}")

    def numbers(self, name: Any) -> np.ndarray:
        """An array of at least one dimension, as floating-point numbers."""
        array = self.of(name)
        if array.dtype.kind not in "fiub" or not array.ndim or array.ndim > _MAX_DIMENSIONS or not array.size:
            more = f"; its fields are {', '.join(array.dtype.names)[:100]}" if array.dtype.names else ""
            kind = str(array.dtype)[:60]
            raise RecordingError(f"{name} has type {kind} and shape {array.shape}; expected rows of real numbers{more}")
        if 8 * array.size > self.most:
            raise RecordingError(f"{name} has {array.size} numbers; at most {self.most // 8} are read")
        return array.astype(float)


class _Cut:
    """Which rows of the first axis belong to the episode, or to the rows with a label, that [format] asks for."""

    def __init__(self, arrays: _Arrays, options: Mapping[str, Any]) -> None:
        self._episode = options.get("episode")
        if "episode" in options and (type(self._episode) is not int or self._episode < 0):
            raise RecordingError(f"[format] episode = {ascii(self._episode)[:40]}; expected 0 or a larger integer")
        bounds = [key for key in ("ends", "lengths") if key in options]
        if bounds and (len(bounds) > 1 or self._episode is None):
            raise RecordingError(f"[format] {bounds[0]} needs episode = NUMBER, and one of ends and lengths")
        if ("label" in options) != ("only" in options):
            raise RecordingError("[format] label and only belong together: an array, and what to look for in it")
        self._kept = _labelled(arrays, options["label"], options["only"]) if "label" in options else None
        self._lengths: np.ndarray | None = None
        if bounds:
            numbers = arrays.numbers(options[bounds[0]]).ravel()
            self._lengths = np.diff(numbers, prepend=0.0) if bounds == ["ends"] else numbers
            if (self._lengths < 0).any() or (self._lengths % 1).any():
                raise RecordingError(f"[format] {bounds[0]}: {options[bounds[0]]} does not count rows")

    def of(self, array: np.ndarray) -> np.ndarray:
        """The part of an array."""
        if self._kept is not None:
            array = array[self._fitting(self._kept, array)]
        if self._episode is None:
            return array
        lengths = self._lengths
        count = len(array) if lengths is None else len(lengths)
        if self._episode >= count:
            raise RecordingError(f"[format] episode = {self._episode}; there are {count}, counted from 0")
        if lengths is None:
            if array.ndim < 2:
                raise RecordingError(f"one axis of shape {array.shape} cannot hold episodes; [format] ends, lengths or "
                                     "label says where they are")  # fmt: skip
            return array[self._episode]
        length = int(lengths[self._episode])
        if len(array) == count and array.ndim > 1 and array.shape[1] >= lengths.max():
            return array[self._episode, :length]
        if len(array) != lengths.sum():
            raise RecordingError(f"shape {array.shape} fits neither {count} episodes nor {int(lengths.sum())} rows")
        start = int(lengths[: self._episode].sum())
        return array[start : start + length]

    def of_clock(self, array: np.ndarray, rows: int) -> np.ndarray:
        """The part of an array of times, which all episodes may share."""
        shared = array.ndim == 1 or (array.ndim == 2 and 1 in array.shape)
        return array if shared and array.size == rows else self.of(array)

    @staticmethod
    def _fitting(kept: np.ndarray, array: np.ndarray) -> np.ndarray:
        if len(kept) != len(array):
            raise RecordingError(f"shape {array.shape} has not the {len(kept)} rows of [format] label")
        return kept


def _labelled(arrays: _Arrays, label: Any, only: Any) -> np.ndarray:
    """(rows,) whether a label is one of those wanted: equal numbers, or texts that occur in it."""
    found = arrays.of(label).ravel()
    if not isinstance(only, list) or not only:
        raise RecordingError(f"[format] only = {ascii(only)[:60]}; expected a list of numbers or texts")
    if found.dtype.kind in "US":
        words = texts("[format] only", only)
        decoded = np.char.decode(found, "utf-8", "replace") if found.dtype.kind == "S" else found
        kept = np.array([any(occurs(word, text) for word in words) for text in decoded.tolist()], bool)
    elif found.dtype.kind in "fiub" and all(type(number) in (int, float) for number in only):
        kept = np.isin(found, only)
    else:
        raise RecordingError(f"[format] only = {ascii(only)[:60]}; {label} has type {found.dtype}")
    if not kept.any():
        raise RecordingError(f"[format] only = {ascii(only)[:60]}: {label} is never that")
    return kept


def _rows(array: np.ndarray, indices: Any, name: str) -> np.ndarray:
    """(T, ...) the samples of an array, of which ``indices`` chooses entries.

    A list of integers chooses from each sample; a list with "rows" or ":" has an entry for each axis: an integer, a
    list of integers, ":" for all, and "rows" for the axis of the samples, without which the first ":" is it.
    """
    if indices is None:
        rows = array
    elif isinstance(indices, list) and indices and all(type(i) is int for i in indices):
        flat = array.reshape(len(array), -1)
        rows = flat[:, [_checked(i, flat.shape[1], name) for i in indices]]
    else:
        rows = _along_axes(array, indices, name)
    if not 0 < len(rows) <= MAX_ROWS:
        raise RecordingError(f"{name} has {len(rows)} rows; expected 1 to {MAX_ROWS}")
    return rows


def _along_axes(array: np.ndarray, indices: Any, name: str) -> np.ndarray:
    wanted = f'expected integers, or for each axis of {array.shape} an integer, a list of them, ":" or "rows"'
    if not isinstance(indices, list) or len(indices) > array.ndim or not {_ROWS, _ALL} & set(map(str, indices)):
        raise RecordingError(f"indices = {ascii(indices)[:60]} of {name}; {wanted}")
    marked = [i for i, entry in enumerate(indices) if entry == _ROWS] or [
        i for i, entry in enumerate(indices) if entry == _ALL
    ][:1]
    if len(marked) > 1:
        raise RecordingError(f'indices = {ascii(indices)[:60]} of {name}: "rows" stands there twice')
    array = np.moveaxis(array, marked[0], 0)
    others = [entry for i, entry in enumerate(indices) if i != marked[0]]
    axis = 1
    for entry in others:
        if entry == _ALL:
            axis += 1
        elif type(entry) is int:
            array = array.take(_checked(entry, array.shape[axis], name), axis=axis)
        elif isinstance(entry, list) and entry and all(type(i) is int for i in entry):
            array = array.take([_checked(i, array.shape[axis], name) for i in entry], axis=axis)
            axis += 1
        else:
            raise RecordingError(f"indices = {ascii(indices)[:60]} of {name}; {wanted}")
    return array


def _checked(index: int, size: int, name: str) -> int:
    if not 0 <= index < size:
        raise RecordingError(f"index {index} of {name}: expected 0 to {size - 1}")
    return index


def _times(arrays: _Arrays, cut: _Cut, spec: FileMapping, name: Any, indices: Any, rows: int) -> np.ndarray:
    """(T,) times [s]; or whole ones [ns], NO_STAMP where a date or duration is missing."""
    array = arrays.of(name)
    if has_dates := array.dtype.kind in "mM":
        if told := [key for key in ("unit", "period") if key in spec.time]:
            raise RecordingError(f"[time] {told[0]} has no effect: {ascii(name)[:80]} holds dates or durations")
        array = array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64)  # which makes NO_STAMP of NaT
    else:
        spec.check_unit_of_time(name.rpartition(".")[2], spec.time.get("unit"))
    if array.dtype.kind not in "fiu" or not array.ndim:
        raise RecordingError(f"its times {ascii(name)[:80]} have type {array.dtype}; expected numbers or dates")
    found = cut.of_clock(array, rows) if indices is None else _rows(cut.of(array), indices, name)
    if found.size != rows or max(found.shape) != rows:
        hint = 'indices = [":", "rows"] where samples lie along the second axis'
        if rows == found.shape[0]:
            hint = "[time] indices = [0] for its first column"
        elif rows in found.shape:
            hint = '[time] indices = [0, "rows"] for its first row'
        raise RecordingError(f"its times {ascii(name)[:80]} have shape {found.shape}; expected ({rows},), or {hint}")
    return found.ravel() if has_dates else _of_clock(found.ravel(), spec, name)


def _of_clock(found: np.ndarray, spec: FileMapping, name: str) -> np.ndarray:
    """(T,) times [s] from the numbers of a clock, or whole ones [ns] where they are whole and increase."""
    if found.dtype == np.float32 and (np.diff(found) == 0).any() and len(np.unique(found)) < len(found):
        step = float(np.spacing(np.abs(found).max()))
        raise RecordingError(f"its times {ascii(name)[:80]} are of single precision, steps of {step:.3g}: write [time] "
                             "interval = ... instead, or save them as float64")  # fmt: skip
    to_nanoseconds = _NANOSECONDS.get(spec.time.get("unit", "s")) if found.dtype.kind in "iu" else None
    if to_nanoseconds is not None and "period" not in spec.time and np.abs(found).max() < 2**62 // to_nanoseconds:
        stamps = found.astype(np.int64) * to_nanoseconds
        if (np.diff(stamps) > 0).all():  # else the clock may have overflowed
            return stamps
    return spec.clock(found.astype(float))


def written(file: ArrayFile) -> str:
    """A mapping (TOML) that takes every array with as many rows as the times, to be corrected."""
    shapes: dict[str, np.ndarray] = {}
    lines = [f"# {file.kind}: arrays, of which each row is a sample"]
    for name in file.names:
        try:
            array = file.array(name)
        except RecordingError as error:
            lines.append(f"# {ascii(name)[1:-1]} is left out: {error}")
            continue
        parts = {f"{name}.{part}": array[part] for part in array.dtype.names or ()} or {name: array}
        shapes.update({key: each for key, each in parts.items() if each.dtype.kind in "fiubmM" and each.size > 1})
        lines += [f"# {ascii(name)[1:-1]} is left out: complex numbers"] if array.dtype.kind == "c" else []
    if not shapes:
        found = "; ".join(line.removeprefix("# ") for line in lines[1:4]) or f"there are {len(file.names)} arrays"
        raise RecordingError(f"no array of numbers is found: {found}")
    clock = _clock(file.names, shapes)
    lines += [] if any(map(_is_command, shapes)) else [NO_COMMAND]
    lines += ["", "[time]", *clock.lines]
    lines.append("# [format] episode = 0 takes the first entry of the first axis; ends, lengths or label cut rows")
    for name, array in shapes.items():
        if name != clock.name:
            lines += _section(name, array, clock.rows)
        elif clock.others:
            lines += _section(name, array, clock.rows, clock.others)
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class _Clock:
    """What a guess says about times: lines of [time], how many rows there are, and the array of the times.

    Args:
        others: indices of what else a matrix has, whose first column or row are the times.
    """

    lines: list[str]
    rows: int
    name: str = ""
    others: str = ""


def _clock(names: Sequence[str], shapes: Mapping[str, np.ndarray]) -> _Clock:
    """The times in arrays: those that are called so, else the first column or row of a matrix that increases."""
    named = [name for name in shapes if _is_called_time(name)]
    named = named or [name for name, array in shapes.items() if _is_like_time(name, array)]
    increasing = [name for name in named if (np.diff(shapes[name].ravel().astype(float)) > 0).all()]
    if named:
        name = (increasing or named)[0]
        doubt = "" if increasing else f"  # {ascii(name)[1:-1]} does not increase everywhere"
        numbers = shapes[name].ravel().astype(float)
        step = float(np.median(np.diff(numbers))) if numbers.size > 1 else 0.0
        unit = time_unit(name.rpartition(".")[2]) or (origin(float(numbers[0]), step) or ("s",))[0]
        units = [f'unit = "{unit}"  # or "s", "ms", "us", "ns"'] if shapes[name].dtype.kind not in "mM" else []
        return _Clock([f"array = {json.dumps(name)}{doubt}", *units], shapes[name].size, name)
    if matrix := next(filter(None, (_matrix(*item) for item in shapes.items())), None):
        return matrix
    rows = max((len(_line(array)) for array in shapes.values()), default=0)
    if unread := next(filter(_is_called_time, names), None):
        return _Clock([f"# interval = ...  # s between rows: {ascii(unread)[1:-1]} holds no numbers or dates"], rows)
    return _Clock(["# interval = ...  # s between rows: no array is called time"], rows)


def _is_called_time(name: str) -> bool:
    return split_unit(name.rpartition(".")[2])[0].lower() in _CLOCKS


def _is_like_time(name: str, array: np.ndarray) -> bool:
    """Whether an array of another name holds dates, or increases and its name or its numbers are those of times."""
    if array.dtype.kind in "mM" or max(array.shape) < array.size:
        return array.dtype.kind in "mM"
    numbers = array.ravel().astype(float)
    steps = np.diff(numbers)
    return bool((steps > 0).all()) and (
        _TIMELIKE.search(name.rpartition(".")[2].lower()) is not None
        or origin(float(numbers[0]), float(np.median(steps))) is not None
    )


def _is_command(name: str) -> bool:
    return name.rpartition(".")[2].lower() in _COMMANDS


def _matrix(name: str, array: np.ndarray) -> _Clock | None:
    """The clock in a matrix whose first column or row increases; None for others."""
    if array.ndim != 2 or min(array.shape) < 2 or array.shape[0] == array.shape[1]:
        return None
    rows, others = max(array.shape), list(range(1, min(array.shape)))
    is_row = array.shape[1] == rows
    if not (np.diff((array[0] if is_row else array[:, 0]).astype(float)) > 0).all():
        return None
    first, rest = (f'[0, "{_ROWS}"]', f'[{others}, "{_ROWS}"]') if is_row else ("[0]", str(others))
    return _Clock([f"array = {json.dumps(name)}", f"indices = {first}  # increases; is it the time?"], rows, name, rest)


def _line(array: np.ndarray) -> np.ndarray:
    return array.ravel() if array.ndim == 2 and 1 in array.shape else array


def _section(name: str, array: np.ndarray, rows: int, indices: str = "") -> list[str]:
    """The lines of one array, as a comment where it has another number of rows."""
    group = "commands" if _is_command(name) else "signals"
    line = _line(array)
    head = f"[{group}.{signal_name(name)}]  # shape {array.shape}"
    unit = split_unit(name.rpartition(".")[2])[1]
    said = f'unit = "{unit}"  # from its name' if unit else 'unit = "1"'
    found = ["", head, f"arrays = [{json.dumps(name)}]", said]
    if indices:
        found.insert(3, f"indices = {indices}")
    elif len(line) != rows and rows in line.shape:
        axes = [_ROWS if size == rows and i == line.shape.index(rows) else _ALL for i, size in enumerate(line.shape)]
        found.insert(3, f"indices = {json.dumps(axes)}  # samples lie along this axis")
    found[1] += f", not {rows} rows" * (rows not in line.shape)
    if rows not in line.shape or math.prod(line.shape) // rows > 1000:
        found = [f"# {each}" if each else "" for each in found]
    return found
