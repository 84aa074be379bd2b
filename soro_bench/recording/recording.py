"""What was measured or simulated over time: commands, signals and what is known about the robot.

Nothing here knows a file format: :mod:`soro_bench.recording.parquet` reads and writes the native one, and
:mod:`soro_bench.recording.importers` those of others.
"""

import hashlib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soro_bench.files import brief

SCHEMA = "soro-bench/recording/1"
MAX_DIMENSIONS = 4  # of one sample
MAX_SIZE = 100_000  # numbers in one sample
MAX_SIGNALS = 1000  # of commands and signals together
MAX_ENTRIES = 1000  # of parameters, and of metadata
MAX_TEXT = 10_000  # characters of a metadata value
NOTES = "import_notes"  # the metadata that say what an import has left out, changed or seen, a line each
_DENSE = 1.2  # of the spacing of times, above which samples are apart
_ROUNDING = 1e-3  # of the spacing of times, by which a time stamp may be late
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
_SHORT = re.compile(r"[ -~°µ²³]{0,32}")  # units and frames: printable

# is told what is done, with how much of a file, and of how much: bytes, or letters of a text
ReadingProgress = Callable[[str, int, int], None]


class RecordingError(ValueError):
    """A file, or what is to become one, is no valid recording."""


@dataclass(frozen=True, eq=False)
class Signal:
    """One quantity at its own times, which need not be regular.

    Args:
        time: (T,) s, from 0 on and strictly increasing; at least one.
        values: (T, ...) real numbers; NaN is a missing sample, infinity is refused.
        unit: SI unit such as "m", "N", "rad"; "1" if it has none.
        frame: the frame of coordinates, such as "world"; "" where there is none.

    Raises:
        RecordingError: says what is wrong.
    """

    time: np.ndarray
    values: np.ndarray
    unit: str = "1"
    frame: str = ""

    def __post_init__(self) -> None:
        # adding 0 turns -0 into 0, so that equal times have equal bits
        time, values = _floats("time", self.time) + 0.0, _floats("values", self.values)
        if time.ndim != 1 or len(time) == 0:
            raise RecordingError(f"time has shape {time.shape}; expected (T,) with T at least 1")
        if values.shape[:1] != time.shape:
            raise RecordingError(f"values have shape {values.shape}; expected {len(time)} rows, one per time")
        check_shape(values.shape[1:])
        _check_times(time)
        if np.isinf(values).any():
            raise RecordingError("values are infinite; allowed are finite numbers, and NaN for a missing sample")
        for label, text in (("unit", self.unit), ("frame", self.frame)):
            if not isinstance(text, str) or not _SHORT.fullmatch(text):
                raise RecordingError(f"{label} {brief(text)} has to be at most 32 printable characters")
        if not self.unit:
            raise RecordingError('unit is ""; a quantity without a unit has "1"')
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)


@dataclass(frozen=True, eq=False)
class Recording:
    """Commands and signals of one robot, each with times of its own, on one clock.

    Args:
        commands: what the robot was told, by name.
        signals: what was measured, by name.
        parameters: physical parameters that are known, in SI units; may be empty.
        metadata: texts such as env_id, model, action ("discrete" or "continuous"), noise, goal, robot, source.
        file: what it was read from, for messages; no part of what is recorded.

    Raises:
        RecordingError: says what is wrong.
    """

    commands: dict[str, Signal] = field(default_factory=dict)
    signals: dict[str, Signal] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    file: str = ""

    def __post_init__(self) -> None:
        count = len(self.commands) + len(self.signals)
        if not 1 <= count <= MAX_SIGNALS:
            raise RecordingError(f"{count} commands and signals; expected 1 to {MAX_SIGNALS}")
        for name in (*self.commands, *self.signals):
            check_name(name)
        check_parameters(self.parameters)
        check_metadata(self.metadata)

    @property
    def names(self) -> list[str]:
        """Sorted names of the signals."""
        return sorted(self.signals)

    @property
    def start(self) -> float:
        """The first time stamp [s]."""
        return float(min(signal.time[0] for signal in self._all()))

    @property
    def duration(self) -> float:
        """From the first time stamp to the last [s]."""
        return float(max(signal.time[-1] for signal in self._all())) - self.start

    def digest(self) -> str:
        """SHA-256 of all names, time stamps and samples: equal for equal recordings, whatever file they come from."""
        found = hashlib.sha256()
        for kind in (self.commands, self.signals):
            for name, signal in sorted(kind.items()):
                found.update(f"{name} {signal.values.shape} {signal.unit} ".encode())
                found.update(signal.time.tobytes() + signal.values.tobytes())
        return found.hexdigest()

    def control_steps(self, commands: Iterable[str], step: float) -> tuple[float, int]:
        """When control steps [s] begin, and how many there are until the last time stamp.

        They begin with the first command if that comes within a step of the first sample, as in logs whose signals
        have time stamps of their own; else each command would count from up to a step later.

        Args:
            commands: those that count; RecordingError if there is no such command.
            step: s, of the control.
        """
        for name in commands:
            if name not in self.commands:
                raise RecordingError(f"the recording has no command {name!r}; it has {sorted(self.commands)}")
        first = min((float(self.commands[name].time[0]) for name in commands), default=self.start)
        begin = first if first - self.start < step else self.start
        steps = (self.start + self.duration - begin) / step
        if not math.isfinite(steps):
            raise RecordingError(f"{self.duration:g} s are more control steps of {step:g} s than can be counted")
        return begin, math.ceil(steps - 1e-6)

    def _all(self) -> list[Signal]:
        return [*self.commands.values(), *self.signals.values()]


def resampled(signal: Signal, times: np.ndarray, max_gap: float | None = None) -> Signal:
    """The signal at other times, by linear interpolation between the two samples around each.

    A value is NaN where there is nothing to interpolate: before the first sample and after the last, where one of the
    two samples is missing, and where they lie more than ``max_gap`` apart. A time at which there is a sample gets that
    sample as it is. Discrete actions are not for interpolation. Quaternions are if their sign does not jump; between
    samples that are turned by an angle a [rad] they come out shorter than 1 by up to a² / 32.

    Args:
        times: (n,) s, strictly increasing.
        max_gap: s; by default three times the median interval of the signal.
    """
    times = np.asarray(times, float)
    time, values = signal.time, signal.values
    if max_gap is None:
        max_gap = 3.0 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    left = np.clip(np.searchsorted(time, times, side="right") - 1, 0, len(time) - 1)
    right = np.minimum(left + 1, len(time) - 1)
    gap = time[right] - time[left]
    weight = (times - time[left]) / np.where(gap > 0, gap, 1.0)
    usable = (times >= time[0]) & (times <= time[-1]) & (gap <= max_gap)
    across = (slice(None), *[None] * (values.ndim - 1))  # from (n,) to the shape of the values
    between = (1.0 - weight[across]) * values[left] + weight[across] * values[right]
    between = np.where(usable[across], between, np.nan)
    return Signal(times, np.where((times == time[left])[across], values[left], between), signal.unit, signal.frame)


def sampled(sampling: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(T,) whether a sample belongs to each of the evenly spaced times (T,).

    Where samples, at times ``sampling`` [s], are further apart than these are, only the times next to one count: what
    is interpolated between them has not been measured.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    if len(sampling) < 2 or np.median(np.diff(sampling)) < _DENSE * step:
        return np.ones(len(times), bool)
    nearest = np.round((sampling - times[0]) / step).astype(int)
    found = np.zeros(len(times), bool)
    found[nearest[(nearest >= 0) & (nearest < len(times))]] = True
    return found


def latest(signal: Signal, times: np.ndarray) -> np.ndarray:
    """(n,) the number of the last sample until each of the evenly spaced times, -1 before the first.

    A sample may be late by a thousandth of their spacing, as time stamps are that went through milliseconds or single
    precision.
    """
    late = _ROUNDING * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return np.searchsorted(signal.time, times + late, side="right") - 1


def with_file(name: str, file: str) -> str:
    """What a recording is called in an error, such as "recording 2", with its file if it was read from one."""
    return f"{name} ({file})" if file else name


def check_name(name: str) -> str:
    """Return a valid name of a signal or parameter; raise RecordingError otherwise."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise RecordingError(f"name {brief(name)} has to be a letter and then at most 63 of A-Z a-z 0-9 _ . -")
    return name


def check_shape(shape: Any) -> tuple[int, ...]:
    """Return the shape of a sample as a tuple; raise RecordingError if it is none or too large."""
    valid = isinstance(shape, (tuple, list)) and len(shape) <= MAX_DIMENSIONS
    valid = valid and all(type(n) is int and n >= 1 for n in shape)
    if not valid or math.prod(shape) > MAX_SIZE:
        allowed = f"at most {MAX_DIMENSIONS} positive integers with a product of at most {MAX_SIZE}"
        raise RecordingError(f"shape {brief(shape)} of a sample has to be {allowed}")
    return tuple(shape)


def check_parameters(parameters: Mapping[str, float]) -> None:
    """Raise RecordingError if these are not finite numbers by name."""
    _check_mapping("parameters", parameters)
    for name, value in parameters.items():
        check_name(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
            raise RecordingError(f"parameter {name} is {brief(value)}; it has to be a finite int or float")


def check_metadata(metadata: Mapping[str, str]) -> None:
    """Raise RecordingError if these are not texts of a sensible length by name."""
    _check_mapping("metadata", metadata)
    for name, value in metadata.items():
        check_name(name)
        if not isinstance(value, str) or len(value) > MAX_TEXT or not _is_unicode(value):
            raise RecordingError(f"metadata {name} is {brief(value)}; it has to be a text of up to {MAX_TEXT} letters")


def _check_mapping(label: str, mapping: object) -> None:
    if not isinstance(mapping, Mapping) or len(mapping) > MAX_ENTRIES:
        raise RecordingError(f"{label} {brief(mapping)} have to be a dict of at most {MAX_ENTRIES} entries")


def _check_times(time: np.ndarray) -> None:
    if not np.isfinite(time).all():
        raise RecordingError("time is not finite")
    if time[0] < 0:
        raise RecordingError(f"time begins at {time[0]} s; it has to begin at 0 or later")
    steps = np.diff(time)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0))
        raise RecordingError(f"time has to increase strictly; {time[i + 1]} s follows {time[i]} s in row {i + 1}")


def _floats(label: str, values: object) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "fiub":
        raise RecordingError(f"{label} has type {values.dtype}; expected real numbers")
    return np.ascontiguousarray(values, float).reshape(values.shape)


def _is_unicode(text: str) -> bool:
    """Whether a text can be written, which one with half of a surrogate pair cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
