"""One command or signal of a mapping: what the numbers of a file mean, and the signal that they become."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soro_bench.files import brief
from soro_bench.recording.importers.units import si
from soro_bench.recording.importers.wraps import (
    counter_period,
    lost_number,
    part_of_turn,
    saw_period,
    seen_wraps,
    told,
    unwrapped,
)
from soro_bench.recording.recording import RecordingError, Signal, check_shape

VALUE_KEYS = (
    "unit", "scale", "sign", "offset", "rotation", "frame", "shape", "shift", "leaves", "unwrap", "period", "relative",
    "interpolate", "missing",
)  # fmt: skip
_TURN = 2 * math.pi
_ROTATION_ERROR = 1e-3  # of what has three digits in the mapping
_MOST_INTERPOLATED = 1_000_000  # samples
_FIRST, _IN_A_ROW = 5, 3  # samples that say where something is held, and that say that it has left
_AT_ONCE = 0.05  # s after the first sample


@dataclass(frozen=True)
class Source:
    """Where one command or signal comes from and what its numbers mean.

    The value in SI units is offset + rotation * (sign * scale * factor of the unit * number in the file), where the
    number is unwrapped first, less what it is relative to.
    """

    unit: str | None  # as in the file; None: the file says it
    scale: np.ndarray | float  # one number, or one per number of a sample; with its sign
    offset: np.ndarray  # SI; one number, or one per number of a sample
    frame: str
    shape: tuple[int, ...] | None  # of a sample; None: as the file has it, and () for one number
    shift: float  # s, added to its times
    leaves: float | None  # SI; instead of the value: 1 until it is that far from where it was first, then 0
    place: Mapping[str, Any] = field(default_factory=dict)  # what else the importer knows: columns, topic, ...
    rotation: np.ndarray | None = None  # (3, 3), of every three numbers into the frame
    unwrap: bool = False
    period: float | None = None  # of what wraps, in the numbers of the file; None: a turn, after unit and scale
    # True: each number counts from the one before it, as joint angles of a chain do; "first": the points of a sample
    # from its first one, which is left out
    relative: bool | str = False
    interpolate: float | None = None  # s, between samples on the lines between its own: of a command that was measured
    missing: np.ndarray = field(default_factory=lambda: np.zeros(0))  # numbers in the file that stand for a missing one

    def known(self, numbers: np.ndarray) -> np.ndarray:
        """(T, ...) numbers of the file, NaN for those that stand for a missing one."""
        return np.where(np.isin(numbers, self.missing), np.nan, numbers) if self.missing.size else numbers

    def signal(self, time: np.ndarray, numbers: np.ndarray, unit: str | None = None) -> Signal:
        """The signal for (T,) times [s] and (T, ...) numbers of the file, whose unit the file says if nothing does."""
        unit, factor = si(self.unit or unit or "")
        shape = self._shape_of(numbers)
        scale, offset = _fitting("scale or sign", self.scale, shape), _fitting("offset", self.offset, shape)
        if self.unwrap:
            numbers = unwrapped(numbers, self._period(factor, unit, shape))
        values = scale * factor * numbers.reshape(len(numbers), *shape)
        if self.rotation is not None:
            if shape[-1:] != (3,):
                raise RecordingError(f"rotation is of samples of three numbers; shape is {list(shape)}, write [n, 3]")
            values = values @ self.rotation.T
        values += offset
        if self.relative == "first":
            values = values[:, 1:] - values[:, :1]
        elif self.relative:
            values = np.diff(values, axis=-1, prepend=0.0)
            if self.unwrap and self.period is None:  # each number was unwrapped from a turn of its own
                values[..., 1:] -= _TURN * np.round(_first(values[..., 1:]) / _TURN)
        if self.leaves is not None:
            return _staying(time, values, self.leaves, self.shift)
        if self.interpolate is not None:
            time, values = _interpolated(time, values, self.interpolate)
        return Signal(time, values, unit, self.frame)

    def note(self, numbers: np.ndarray, unit: str | None = None, is_command: bool = False) -> str:
        """What the wraps of (T, ...) numbers of the file give reason to say, or "".

        Commands may jump by themselves, so that of theirs only angles are said that go the other way beside a jump.
        """
        unit, factor = si(self.unit or unit or "")
        shape = self._shape_of(numbers)
        if self.unwrap:
            return told(numbers, self._period(factor, unit, shape))
        if lost := lost_number(numbers):
            numbers = np.where(numbers == lost.number, np.nan, numbers)
        if unit == "rad" and (count := seen_wraps(numbers, self._turns(factor, shape))):
            if is_command and saw_period(numbers) is None:
                return ""
            if part := part_of_turn(numbers, float(np.max(self._turns(factor, shape)))):
                return (f"jumps of nearly {part.counts:.10g}: {count}; if the angle wraps, write unwrap = true and "
                        f"period = {part.counts:.10g}{part.doubt}")  # fmt: skip
            return f"jumps of nearly a turn: {count}; if the angle wraps, write unwrap = true"
        if is_command or unit not in ("rad", "1"):
            return ""
        turn = float(np.max(self._turns(factor, shape))) if unit == "rad" else 0.0
        period = (counter_period(numbers) if unit == "1" else None) or saw_period(numbers, turn)
        if period:
            said = f"jumps of nearly {period.counts:.10g}: {seen_wraps(numbers, period.counts)}"
            what = "counter" if unit == "1" else "angle"
            return f"{said}; if the {what} wraps, write unwrap = true and period = {period.counts:.10g}{period.doubt}"
        return ""

    def lost(self, numbers: np.ndarray) -> str:
        """What numbers that seem to stand for missing ones give reason to say, or ""."""
        if not (lost := lost_number(numbers)):
            return ""
        return (f"{lost.count} numbers are exactly {lost.number:.10g}, far from those beside; if they are lost, write "
                f"missing = [{lost.number:.10g}]")  # fmt: skip

    def _shape_of(self, numbers: np.ndarray) -> tuple[int, ...]:
        """The shape of a sample of (T, ...) numbers of the file; RecordingError if it does not fit them."""
        found = math.prod(numbers.shape[1:])
        shape = self.shape
        if shape is None:  # one number is no list of one
            shape = numbers.shape[1:] if found > 1 else ()
        if math.prod(shape) != found:
            raise RecordingError(f"shape {list(shape)} does not fit the {found} numbers found")
        return shape

    def _period(self, factor: float, unit: str, shape: tuple[int, ...]) -> np.ndarray:
        """(k,) what each number of a sample wraps at, in the numbers of the file."""
        if self.period is not None:
            return np.full(math.prod(shape), self.period)
        if unit != "rad":
            raise RecordingError(f"unwrap = true needs period = ..., the range of a number of unit {self.unit!r}")
        return self._turns(factor, shape)

    def _turns(self, factor: float, shape: tuple[int, ...]) -> np.ndarray:
        """(k,) a turn of each number of a sample, in the numbers of the file."""
        scale = np.abs(_fitting("scale or sign", self.scale, shape)).ravel()
        if not scale.all():
            raise RecordingError("scale = 0 for an angle; expected another number")
        return _TURN / (factor * scale)


def order_of(names: Sequence[str], found: Sequence[str]) -> list[int]:
    """Where each of the wanted names stands among those that a file has; RecordingError names one that it has not."""
    for name in names:
        if (count := list(found).count(name)) != 1:
            there = ", ".join(ascii(each)[1:-1] for each in found)[:200]
            raise RecordingError(f"names: {ascii(name)[:80]} stands there {count} times; there are {there}")
    return [list(found).index(name) for name in names]


def read_source(entry: object, place_keys: tuple[str, ...], unit_optional: bool) -> Source:
    """A section [commands.NAME] or [signals.NAME]; RecordingError says what is wrong with it."""
    if not isinstance(entry, dict):
        raise RecordingError(f"is {ascii(entry)[:80]}; expected a section")
    check_keys("it", entry, (*place_keys, *VALUE_KEYS))
    unit = entry.get("unit")
    if unit is not None or not unit_optional:
        if unit is None:
            raise RecordingError('has no unit; a quantity without one has unit = "1"')
        si(unit)
    _check_effects(entry)
    sign = numbers_of("sign", entry.get("sign", 1.0))
    if not (np.abs(sign) == 1).all():
        raise RecordingError(f"sign = {sign.tolist()}; expected 1 or -1, or a list of them")
    scale, offset = numbers_of("scale", entry.get("scale", 1.0)), numbers_of("offset", entry.get("offset", 0.0))
    if (shift := numbers_of("shift", entry.get("shift", 0.0))).ndim:
        raise RecordingError(f"shift = {shift.tolist()}; expected one number")
    try:
        scale = scale * sign
    except ValueError as error:
        raise RecordingError(f"scale and sign have {scale.size} and {sign.size} numbers; expected as many") from error
    return Source(
        unit,
        scale,
        offset,
        entry.get("frame", ""),
        check_shape(entry["shape"]) if "shape" in entry else None,
        float(shift),
        positive("leaves", entry["leaves"]) if "leaves" in entry else None,
        {key: entry[key] for key in place_keys if key in entry},
        _rotation(entry["rotation"]) if "rotation" in entry else None,
        bool(entry.get("unwrap", False)),
        positive("period", entry["period"]) if "period" in entry else None,
        entry.get("relative", False),
        positive("interpolate", entry["interpolate"]) if "interpolate" in entry else None,
        _missing(entry) if "missing" not in place_keys else np.zeros(0),  # of a table, whose importer knows texts too
    )


def _missing(entry: Mapping) -> np.ndarray:
    """(k,) numbers that stand for a missing one."""
    found = numbers_of("missing", entry.get("missing", np.zeros(0)))
    if found.ndim != 1:
        raise RecordingError(f"missing = {brief(entry['missing'])}; expected a list of numbers")
    return found


def check_keys(label: str, table: Mapping, allowed: tuple[str, ...]) -> None:
    """Raise RecordingError for a key that is not allowed."""
    for key in table:
        if key not in allowed:
            there = f"there are {', '.join(dict.fromkeys(allowed))}" if allowed else "a file of this kind needs none"
            raise RecordingError(f"unknown entry {ascii(key)[:80]} in {label}; {there}")


def positive(label: str, value: Any) -> float:
    """A finite positive number; RecordingError for anything else."""
    if type(value) not in (int, float) or not 0 < value < math.inf:
        raise RecordingError(f"{label} = {ascii(value)[:80]}; expected a positive number")
    return float(value)


def numbers_of(label: str, value: object) -> np.ndarray:
    """An array of finite numbers; RecordingError for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of several lengths
        array = np.asarray("")
    if array.dtype.kind not in "fi" or not np.isfinite(array).all():
        raise RecordingError(f"{label} = {ascii(value)[:80]}; expected finite numbers")
    return array.astype(float)


def _check_effects(entry: Mapping) -> None:
    """Refuse entries that would do nothing."""
    if type(entry.get("unwrap", False)) is not bool:
        raise RecordingError(f"unwrap = {brief(entry['unwrap'])}; expected true or false")
    if "period" in entry and not entry.get("unwrap"):
        raise RecordingError("period has no effect without unwrap = true")
    if (relative := entry.get("relative", False)) not in (True, False, "first"):
        raise RecordingError(f'relative = {brief(relative)}; expected true, false or "first"')
    if relative == "first" and len(entry.get("shape", ())) < 2:
        raise RecordingError('relative = "first" is of points; write shape = [n, 3]')
    if (frame := entry.get("frame", "")) not in ("", "world"):
        raise RecordingError(f'frame = {brief(frame)}; expected "world", of positions in the robot\'s frame')
    for key in ("offset", "frame", "rotation", "relative", "interpolate"):
        if key in entry and "leaves" in entry:
            raise RecordingError(f"{key} has no effect beside leaves, which looks at distances only")


def _rotation(value: object) -> np.ndarray:
    """(3, 3) from a matrix, {quaternion = [w, x, y, z]}, or {rpy = [roll, pitch, yaw], unit = "deg"}."""
    wanted = 'a 3 x 3 matrix, {quaternion = [w, x, y, z]} or {rpy = [roll, pitch, yaw], unit = "deg"}'
    if isinstance(value, dict) and value.keys() == {"quaternion"}:
        q = numbers_of("rotation quaternion", value["quaternion"])
        if q.shape == (4,) and abs(np.linalg.norm(q) - 1.0) < _ROTATION_ERROR:
            return _of_quaternion(q / np.linalg.norm(q))
        raise RecordingError(f"rotation quaternion = {brief(q.tolist())}; expected [w, x, y, z] of length 1")
    if isinstance(value, dict) and value.keys() == {"rpy", "unit"}:
        angles = numbers_of("rotation rpy", value["rpy"])
        unit, factor = si(value["unit"])
        if angles.shape == (3,) and unit == "rad":
            return _of_angles(*(factor * angles))
        raise RecordingError(f"rotation = {brief(value)}; expected {wanted}")
    if isinstance(value, dict):
        raise RecordingError(f"rotation = {brief(value)}; expected {wanted}")
    matrix = numbers_of("rotation", value)
    if matrix.shape != (3, 3):
        raise RecordingError(f"rotation has shape {matrix.shape}; expected {wanted}")
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ROTATION_ERROR or np.linalg.det(matrix) < 0:
        raise RecordingError("rotation is no rotation: its rows have to be orthonormal and right-handed; mirrored "
                             "axes are for sign")  # fmt: skip
    return matrix


def _of_quaternion(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def _of_angles(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """About the fixed x, then y, then z axis, as in URDF and ROS."""
    matrix = np.eye(3)
    for axis, angle in enumerate((roll, pitch, yaw)):
        turn, (i, j) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
        matrix = turn @ matrix
    return matrix


def _fitting(label: str, numbers: np.ndarray | float, shape: tuple[int, ...]) -> np.ndarray:
    """One number, or numbers of a sample: as its shape has them, or one after the other."""
    numbers = np.asarray(numbers)
    if numbers.ndim == 1 and len(shape) > 1 and numbers.size == math.prod(shape):
        numbers = numbers.reshape(shape)
    try:
        return np.broadcast_to(numbers, shape)
    except ValueError as error:
        raise RecordingError(f"{label} of shape {numbers.shape} does not fit the shape {shape}") from error


def _first(values: np.ndarray) -> np.ndarray:
    """(...) the first known one of (T, ...) values, NaN where there is none."""
    known = np.isfinite(values)
    return np.where(known.any(axis=0), np.take_along_axis(values, known.argmax(axis=0)[None], axis=0)[0], np.nan)


def _interpolated(time: np.ndarray, values: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """(K,) times [s] from the first to the last at an interval [s], and (K, ...) values on the lines between (T, ...).

    Raises:
        RecordingError: they would be too many, or no number is known.
    """
    if (count := (time[-1] - time[0]) / interval) > _MOST_INTERPOLATED:
        raise RecordingError(f"interpolate = {interval:g} makes {count:.0f} samples; {_MOST_INTERPOLATED} are allowed")
    times = time[0] + interval * np.arange(int(count) + 1)
    columns = values.reshape(len(time), -1).T
    known = [np.isfinite(column) for column in columns]
    if not all(each.any() for each in known):
        raise RecordingError("interpolate needs numbers; one of the columns has none")
    found = [np.interp(times, time[some], column[some]) for some, column in zip(known, columns, strict=True)]
    return times, np.stack(found, axis=1).reshape(len(times), *values.shape[1:])


def _staying(time: np.ndarray, values: np.ndarray, distance: float, shift: float) -> Signal:
    """1 until the values (T, ...) stay further than a distance from the first ones, a time [s] after that 0.

    One sample decides nothing, as a marker may be lost or swapped in it: the first one counts unless it is far from the
    median of a few, and a release is several samples in a row.
    """
    rows = values.reshape(len(values), -1)
    seen = np.flatnonzero(~np.isnan(rows).any(axis=1))
    if not seen.size or seen[0] >= _FIRST:
        raise RecordingError("its first samples have gaps; leaves counts from them")
    time, rows = time[seen], rows[seen]
    usual = np.median(rows[:_FIRST], axis=0)
    first = rows[0] if np.linalg.norm(rows[0] - usual) <= distance else usual
    away = np.linalg.norm(rows - first, axis=1)
    beyond = np.concatenate([away > distance, np.ones(_IN_A_ROW - 1, bool)])  # it may leave with the last sample
    staying = np.lib.stride_tricks.sliding_window_view(beyond, _IN_A_ROW).all(axis=1)
    if not (left := np.flatnonzero(staying & (away > distance))).size:
        return Signal(time[:1], np.ones(1), "1")
    i = left[0]
    at = time[0]
    if i:
        at = time[i - 1] + (distance - away[i - 1]) / (away[i] - away[i - 1]) * (time[i] - time[i - 1])
    return Signal(np.array([time[0], max(at + shift, np.nextafter(time[0], np.inf))]), np.array([1.0, 0.0]), "1")


def when_left(held: Signal) -> str:
    """What the time of a release gives reason to say, or ""."""
    if len(held.time) == 1:
        return "it never leaves where it was first; is leaves too large, or the recording cut?"
    if held.time[1] - held.time[0] < _AT_ONCE:
        return (
            f"it leaves {held.time[1] - held.time[0]:.2g} s after the first sample; does the recording begin too late?"
        )
    return ""
