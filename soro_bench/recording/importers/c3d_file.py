"""C3D files: markers and analogue channels, as motion capture systems of every maker write them.

Read by the library c3d, which is written in Python and NumPy: a damaged file ends in an exception. (ezc3d reads more
variants, in C++, where one could end the process.)
"""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

try:
    import c3d
except ImportError as error:
    raise ImportError("C3D files need c3d: pip install soro_bench[logs]") from error

from soro_bench.recording.importers.tracks import Track, Tracks, import_tracks, known_unit, written
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_ROWS, named_errors, read_bytes

_COORDINATES = 5  # of a point: position, residual, cameras
_MOST_LABELS = 10_000


def import_c3d(path: str | Path, mapping: str | Path | Mapping | None, max_bytes: int = MAX_BYTES) -> Recording:
    """Read a C3D file with a mapping that names markers; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: needs a mapping; soro-bench import {Path(path).name} --guess writes one")
    return import_tracks(path, read_c3d(path, max_bytes), mapping, max_bytes)


def guess(path: str | Path) -> str:
    """A mapping (TOML) for a C3D file, to be corrected."""
    return written(read_c3d(path))


def read_c3d(path: str | Path, max_bytes: int = MAX_BYTES) -> Tracks:
    """Everything in a C3D file; a marker that no camera saw (residual -1) is NaN."""
    data = read_bytes(path, max_bytes)
    with named_errors(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of groups that are missing, which is seen below
        try:
            reader = _Reader(io.BytesIO(data))
            return _tracks(reader, len(data), EXPANSION * max_bytes)
        except RecordingError:
            raise
        except Exception as error:  # whatever a stranger's bytes make of the library
            raise RecordingError(f"is no C3D file that can be read ({str(error)[:120]}); export it again") from error


class _Reader(c3d.Reader):
    """The library's, also for files that have the frames of the trial in an array of another shape (c3d 0.6)."""

    @property
    def first_frame(self) -> int:
        """Of the trial."""
        found = self._frame("TRIAL:ACTUAL_START_FIELD")
        return self.header.first_frame if found is None else found

    @property
    def last_frame(self) -> int:
        """Of the trial."""
        found = self._frame("TRIAL:ACTUAL_END_FIELD")
        return super().last_frame if found is None or found < self.header.last_frame else found

    def _frame(self, key: str) -> int | None:
        """The number in two words of 16 bits."""
        words = [] if (found := self.get(key)) is None else np.ravel(found.uint16_array).tolist()
        return words[0] + 65536 * words[1] if len(words) > 1 else None


def _tracks(reader: _Reader, size: int, most: int) -> Tracks:
    points, channels = reader.point_used, reader.analog_used
    frames, rate = reader.last_frame - reader.first_frame + 1, float(reader.point_rate)
    if not points and not channels:
        raise RecordingError("has neither markers nor channels")
    if not 0.0 < rate < np.inf:
        raise RecordingError(f"says {rate} frames per second; correct its POINT:RATE")
    per_frame = reader.analog_per_frame if channels else 0
    if not 0 < frames <= min(MAX_ROWS, size) or not 0 <= per_frame * frames <= MAX_ROWS:
        raise RecordingError(f"says that it has {frames} frames, which its {size} bytes cannot hold")
    if 8 * frames * (_COORDINATES * points + channels * per_frame) > most:
        raise RecordingError(f"{frames} frames of {points} markers take more memory than its largest size allows")
    seen, analog = [], []
    for _, point, sample in reader.read_frames(copy=True):
        seen.append(np.where(point[:, 3:4] < 0, np.nan, point[:, :3]))
        analog.append(np.asarray(sample).reshape(channels, per_frame))
    if not seen:
        raise RecordingError("holds no whole frame")
    notes = [f"{frames - len(seen)} of the {frames} frames that it declares are missing"] if len(seen) < frames else []
    time = (reader.first_frame + np.arange(len(seen))) / rate
    positions = np.array(seen, float)
    unit = known_unit(_text(reader, "POINT:UNITS"))
    markers = {
        name: Track(time, positions[:, i], unit) for i, name in enumerate(_labels(reader, "POINT", points)) if name
    }
    channels_found = _channels(reader, analog, time[0], rate * per_frame)
    return Tracks("C3D file", markers=markers, channels=channels_found, notes=notes)


def _channels(reader: _Reader, analog: list[np.ndarray], start: float, rate: float) -> dict[str, Track]:
    if not reader.analog_used:
        return {}
    values = np.concatenate(analog, axis=1)
    time = start + np.arange(values.shape[1]) / rate
    units = _texts(reader, "ANALOG:UNITS")
    found = {}
    for i, name in enumerate(_labels(reader, "ANALOG", reader.analog_used)):
        if name:
            found[name] = Track(time, values[i, :, None], known_unit(units[i]) if i < len(units) else "")
    return found


def _labels(reader: _Reader, group: str, count: int) -> list[str]:
    """Names, of which every 255 are in a parameter of their own; later ones that come again are left out."""
    names: list[str] = []
    for suffix in ("", *map(str, range(2, 2 + count // 255))):
        names += _texts(reader, f"{group}:LABELS{suffix}")
    names = (names + [""] * count)[: min(count, _MOST_LABELS)]
    return [name if name not in names[:i] else "" for i, name in enumerate(names)]


def _texts(reader: _Reader, key: str) -> list[str]:
    found: Any = reader.get(key)
    if found is None:
        return []
    if found.total_bytes != len(found.bytes):  # its array would be as large as it says
        raise RecordingError(f"{key} is damaged; export it again")
    return [str(text).strip(" \0") for text in np.ravel(found.string_array)]


def _text(reader: _Reader, key: str) -> str:
    return next(iter(_texts(reader, key)), "")
