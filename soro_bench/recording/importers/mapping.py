"""Which part of a foreign file is which command or signal: a TOML file, described in docs/reference/recordings.md."""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from soro_bench.files import shown
from soro_bench.recording.importers.units import si
from soro_bench.recording.recording import MAX_SIGNALS, Recording, RecordingError, Signal, check_name, check_shape
from soro_bench.recording.untrusted import named_errors, read_bytes

MAX_BYTES = 1_000_000
_ROUNDING = 1e-9  # s
_REGULAR = 1.5  # times the median interval, up to which others are regular too
_SECTIONS = ("format", "time", "commands", "signals", "parameters", "metadata")
_VALUE_KEYS = ("unit", "scale", "offset", "frame", "shape", "shift", "leaves")

T = TypeVar("T")
Numbers = TypeVar("Numbers", np.ndarray, np.number)  # one or many


@dataclass(frozen=True)
class Source:
    """Where one command or signal comes from and what its numbers mean.

    The value in SI units is offset + scale * (factor of the unit) * (number in the file).
    """

    unit: str  # as in the file
    scale: float
    offset: np.ndarray  # SI; one number, or one per number of a sample
    frame: str
    shape: tuple[int, ...] | None  # of a sample; None: as the file has it, and () for one number
    shift: float  # s, added to its times
    leaves: float | None  # SI; instead of the value: 1 until it is that far from where it was first, then 0
    place: Mapping[str, Any]  # what else the importer knows: columns, topic, ...

    def signal(self, time: np.ndarray, numbers: np.ndarray) -> Signal:
        """The signal for (T,) times [s] and (T, ...) numbers of the file."""
        unit, factor = si(self.unit)
        found = math.prod(numbers.shape[1:])
        shape = self.shape
        if shape is None:  # one number is no list of one
            shape = numbers.shape[1:] if found > 1 else ()
        if math.prod(shape) != found:
            raise RecordingError(f"shape {list(shape)} does not fit the {found} numbers found")
        try:
            offset = np.broadcast_to(self.offset, shape)
        except ValueError as error:
            raise RecordingError(f"offset of shape {self.offset.shape} does not fit the shape {shape}") from error
        values = self.scale * factor * numbers.reshape(len(numbers), *shape) + offset
        if self.leaves is not None:
            return _staying(time, values, self.leaves, self.shift)
        return Signal(time, values, unit, self.frame)


@dataclass(frozen=True)
class FileMapping:
    """A whole mapping file."""

    commands: dict[str, Source] = field(default_factory=dict)
    signals: dict[str, Source] = field(default_factory=dict)
    time: dict[str, Any] = field(default_factory=dict)
    format: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)

    def to_seconds(self) -> float:
        """What a number of [time] unit is [s]."""
        unit, factor = si(self.time.get("unit", "s"))
        if unit != "s":
            raise RecordingError(f"[time] unit = {self.time['unit']!r} is no unit of time")
        return factor

    def recording(
        self, read: Callable[[Source], tuple[np.ndarray, np.ndarray]], file_name: str, most: int
    ) -> Recording:
        """The recording whose signals ``read(source)`` gives as (T,) times [s] and (T, ...) numbers.

        Time is counted from the first sample of all, or from [time] begin after it; the metadata keep where that was,
        as "start_time" [s]. Signals of more than ``most`` bytes altogether are refused.
        """
        begin = _positive("[time] begin", self.time["begin"]) if "begin" in self.time else 0.0
        until, found = _positive("[time] until", self.time.get("until", math.inf)), {}
        for group, sources in (("commands", self.commands), ("signals", self.signals)):
            for name, source in sources.items():
                time, numbers = _named(f"{group}.{name}", read, source)
                most -= numbers.nbytes
                if most < 0:  # a small file may be asked for the same numbers again and again
                    raise RecordingError("the mapping asks for more numbers than the largest size of the file allows")
                _named(f"{group}.{name}", _check_order, time)
                if not source.leaves:  # which shifts by itself
                    time = _shifted(time, source.shift)
                found[group, name] = time, numbers
        start = min((time[0] for time, _ in found.values() if len(time)), default=np.int64(0))
        groups: dict[str, dict[str, Signal]] = {"commands": {}, "signals": {}}
        for (group, name), (time, numbers) in found.items():
            build, since = getattr(self, group)[name].signal, seconds(time - start) - begin
            kept = (since > -_ROUNDING) & (since < until - _ROUNDING)
            if group == "commands" and not (_regular(since) and kept.any()):
                kept |= _in_force(since)
            if len(time) and not kept.any():
                raise RecordingError(f"{group}.{name} has nothing from [time] begin = {begin:g} to until = {until:g}")
            groups[group][name] = _named(f"{group}.{name}", build, np.maximum(since[kept], 0.0), numbers[kept])
        about = {"source": shown(file_name[:200]), "start_time": repr(float(seconds(start) + begin))}
        metadata = {**about, **self.metadata}
        return Recording(**groups, parameters=self.parameters, metadata=metadata)

    def counted(self, rows: int) -> np.ndarray:
        """(rows,) times [s] of a file without any, from [time] interval."""
        if "interval" not in self.time:
            raise RecordingError("no times: [time] says neither where they are nor an interval between rows")
        return _positive("[time] interval", self.time["interval"]) * np.arange(rows)


def _check_order(time: np.ndarray) -> None:
    """Refuse what cannot be cut at a time."""
    if not np.isfinite(time).all():
        raise RecordingError("time is not finite")
    if (back := np.flatnonzero(np.diff(time) <= 0)).size:
        i = back[0]
        raise RecordingError(f"time has to increase strictly; {time[i + 1]} follows {time[i]} in row {i + 1}")


def _regular(since: np.ndarray) -> bool:
    """Whether a command comes at intervals; others come where they change."""
    intervals = np.diff(since)
    return len(intervals) > 0 and intervals.max() < _REGULAR * np.median(intervals)


def _in_force(since: np.ndarray) -> np.ndarray:
    """(T,) whether a command is the last one until the beginning, at zero."""
    found = np.zeros(len(since), bool)
    found[np.flatnonzero(since < _ROUNDING)[-1:]] = True
    return found


def seconds(time: Numbers) -> Numbers:
    """Times [s] as they are, or from whole nanoseconds, whose differences have to be taken before."""
    return time * 1e-9 if np.asarray(time).dtype.kind == "i" else time


def load_mapping(
    mapping: str | Path | Mapping,
    place_keys: tuple[str, ...],
    time_keys: tuple[str, ...] = (),
    format_keys: tuple[str, ...] = (),
) -> FileMapping:
    """Read a mapping file.

    Args:
        mapping: the file, or what one says.
        place_keys, time_keys, format_keys: what the importer knows in a command or signal, in [time] and in [format].

    Raises:
        RecordingError: names what is wrong and what is allowed.
    """
    label = "the mapping" if isinstance(mapping, Mapping) else mapping
    with named_errors(label):
        table = (
            dict(mapping) if isinstance(mapping, Mapping) else tomllib.loads(read_bytes(mapping, MAX_BYTES).decode())
        )
        check_keys("the mapping", table, _SECTIONS)
        for section in table:
            if not isinstance(table[section], dict):
                raise RecordingError(f"{section} has to be a section, [{section}]")
        check_keys("[time]", table.get("time", {}), (*time_keys, "begin", "until"))
        check_keys("[format]", table.get("format", {}), format_keys)
        if (count := sum(len(table.get(group, {})) for group in ("commands", "signals"))) > MAX_SIGNALS:
            raise RecordingError(f"it has {count} commands and signals; expected at most {MAX_SIGNALS}")
        for group in ("commands", "signals"):
            table[group] = {
                check_name(name): _named(f"{group}.{name}", _source, entry, place_keys)
                for name, entry in table.get(group, {}).items()
            }
        if not table["commands"] and not table["signals"]:
            raise RecordingError("the mapping has neither [commands.<name>] nor [signals.<name>]")
        # numbers are as good as texts there
        table["metadata"] = {
            k: v if type(v) not in (int, float) else repr(v) for k, v in table.get("metadata", {}).items()
        }
        return FileMapping(**table)


def check_keys(label: str, table: Mapping, allowed: tuple[str, ...]) -> None:
    """Raise RecordingError for a key that is not allowed."""
    for key in table:
        if key not in allowed:
            raise RecordingError(f"unknown entry {ascii(key)[:80]} in {label}; there are {', '.join(allowed)}")


def texts(label: str, values: object) -> list[str]:
    """Return a non-empty list of texts, each once; raise RecordingError for anything else."""
    if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected a list of texts")
    if len(set(values)) < len(values):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected each once")
    return values


def typed(label: str, table: Mapping[str, Any], key: str, default: T) -> T:
    """``table[key]`` of the type of the default; RecordingError for another type."""
    value = table.get(key, default)
    if type(value) is not type(default):
        raise RecordingError(f"{label} {key} = {ascii(value)[:80]}; expected something like {default!r}")
    return value


def _source(entry: object, place_keys: tuple[str, ...]) -> Source:
    if not isinstance(entry, dict):
        raise RecordingError(f"is {ascii(entry)[:80]}; expected a section")
    check_keys("it", entry, (*place_keys, *_VALUE_KEYS))
    unit = entry.get("unit")
    if unit is None:
        raise RecordingError('has no unit; a quantity without one has unit = "1"')
    si(unit)
    shape = check_shape(entry["shape"]) if "shape" in entry else None
    place = {key: entry[key] for key in place_keys if key in entry}
    scale, offset = _numbers("scale", entry.get("scale", 1.0)), _numbers("offset", entry.get("offset", 0.0))
    shift = _numbers("shift", entry.get("shift", 0.0))
    for label, number in (("scale", scale), ("shift", shift)):
        if number.ndim:
            raise RecordingError(f"{label} = {number.tolist()}; expected one number")
    leaves = _positive("leaves", entry["leaves"]) if "leaves" in entry else None
    return Source(unit, float(scale), offset, entry.get("frame", ""), shape, float(shift), leaves, place)


def _staying(time: np.ndarray, values: np.ndarray, distance: float, shift: float) -> Signal:
    """1 until the values (T, ...) are further than a distance from the first ones, a time [s] after that 0."""
    rows = values.reshape(len(values), -1)
    if np.isnan(rows[0]).any():
        raise RecordingError("its first sample has gaps; leaves counts from it")
    away = np.linalg.norm(rows - rows[0], axis=1)
    if not (beyond := np.flatnonzero(away > distance)).size:
        return Signal(time[:1], np.ones(1), "1")
    i = beyond[0]
    share = np.nan_to_num((distance - away[i - 1]) / (away[i] - away[i - 1]))  # 0 where the sample before is missing
    left = time[i - 1] + share * (time[i] - time[i - 1]) + shift
    return Signal(np.array([time[0], max(left, np.nextafter(time[0], np.inf))]), np.array([1.0, 0.0]), "1")


def _shifted(time: np.ndarray, shift: float) -> np.ndarray:
    """Times [s], or whole nanoseconds, some seconds later."""
    return time + (round(1e9 * shift) if np.asarray(time).dtype.kind == "i" else shift)


def _positive(label: str, value: Any) -> float:
    if type(value) not in (int, float) or not value > 0:
        raise RecordingError(f"{label} = {ascii(value)[:80]}; expected a positive number")
    return float(value)


def _numbers(label: str, value: object) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "fi" or not np.isfinite(array).all():
        raise RecordingError(f"{label} = {ascii(value)[:80]}; expected finite numbers")
    return array.astype(float)


def _named(label: str, function: Callable[..., T], *arguments: Any) -> T:
    try:
        return function(*arguments)
    except RecordingError as error:
        raise RecordingError(f"{label}: {error}") from error
