"""Text that motion capture systems write: OpenSim's .trc, and the exports of Motive, Vicon Nexus and Qualisys.

Each is a table below a header that says names, units and rates. Sources: the pages on .trc in OpenSim's documentation,
on CSV export in OptiTrack's, on ASCII export in Vicon's, and on motion data (.tsv) in Qualisys'.
"""

import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.recording.importers.tracks import (
    GROUPS,
    Track,
    Tracks,
    continuous,
    import_tracks,
    known_unit,
    mentions,
    read_text,
    written,
)
from soro_bench.recording.recording import ReadingProgress, Recording, RecordingError
from soro_bench.recording.untrusted import MAX_BYTES, MAX_COLUMNS, MAX_ROWS, named_errors

_MAX_ROW = 1_000_000  # letters
_MAX_CELLS = 50_000_000
_SECTIONS = ("Trajectories", "Devices", "Objects", "Segments", "Joints", "Model Outputs", "Events")  # of Vicon
_HEADS = ("NO_OF_FRAMES", "FILE_VERSION")  # one of them begins a file of Qualisys
_BY_TAB = ("\tSub Frame", "Frame#\t", "NO_OF_FRAMES\t", "FILE_VERSION\t")
_BODY = 16  # numbers of a body of Qualisys: position, three angles, residual, rotation matrix
_UNSEEN = ("", "nan", "null", "none", "#n/a")
_MAX_HEADER = 200  # rows
_PLAIN = re.compile(r"[-+0-9.,\s]*")
_TOLD = 2000  # rows, after which the progress is told

Cells = list[str]


def is_export(path: str | Path, mapping: str | Path | Mapping | None) -> bool:
    """Whether a table is an export of motion capture, which its beginning tells, and not mapped by columns."""
    if not Path(path).is_file():
        return False
    with open(path, "rb") as file:
        beginning = file.read(200)
    if beginning[:2] in (b"\xff\xfe", b"\xfe\xff"):
        beginning = beginning[2:].replace(b"\0", b"")
    recognised = (*_SECTIONS, *_HEADS, "Format Version", "PathFileType")
    return _head(beginning.decode("utf-8-sig", errors="replace")) in recognised and (
        mapping is None or mentions(mapping, GROUPS)
    )


def import_motion_capture(
    path: str | Path,
    mapping: str | Path | Mapping | None,
    max_bytes: int = MAX_BYTES,
    progress: ReadingProgress | None = None,
) -> Recording:
    """Read an export with a mapping that names markers; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: needs a mapping; soro-bench import {Path(path).name} --guess writes one")
    return import_tracks(path, read_tracks(path, max_bytes, progress), mapping, max_bytes)


def guess(path: str | Path) -> str:
    """A mapping (TOML) for an export, to be corrected."""
    return written(read_tracks(path))


def read_tracks(path: str | Path, max_bytes: int = MAX_BYTES, progress: ReadingProgress | None = None) -> Tracks:
    """Everything in an export; RecordingError says what is wrong with it."""
    with named_errors(path):
        text = read_text(path, max_bytes)
        head = _head(text)
        # a table of Vicon or OpenSim has tabs or commas, but for its names
        by_comma = head == "Format Version" or (head != "" and not any(sign in text for sign in _BY_TAB))
        rows = _Rows(text, "," if by_comma else "\t", progress)
        readers = {"PathFileType": _trc, "Format Version": _motive, **dict.fromkeys(_HEADS, _qualisys)}
        readers.update(dict.fromkeys(_SECTIONS, _vicon))
        if head not in readers:
            raise RecordingError(f"begins with {ascii(head)[:40]}: no .trc, nor an export of Motive, Vicon or Qualisys")
        return replace(readers[head](rows), notes=rows.notes)


def _head(text: str) -> str:
    """The first cell."""
    return text[:200].lstrip("\ufeff\r\n").split("\n")[0].replace("\t", ",").split(",")[0].strip().strip('"')


class _Rows:
    """The rows of a table, which can be looked at before they are taken, and the line of the last one taken."""

    def __init__(self, text: str, delimiter: str, progress: ReadingProgress | None = None) -> None:
        self.line, self.notes = 0, list[str]()
        self._ahead: Cells | None = None
        self._complete = text.endswith("\n")
        self._lines = io.StringIO(text.lstrip("\r\n"), newline=None)
        self._delimiter, self._progress, self._size = delimiter, progress, len(text)
        self._plain = False  # whether the row that comes next has nothing but finite numbers

    def take(self, label: str) -> Cells:
        """The next row."""
        if (row := self.look()) is None:
            raise RecordingError(f"ends before {label}")
        self._ahead = None
        self.line += 1
        return row

    def look(self) -> Cells | None:
        """The row that comes next; None at the end."""
        if self._ahead is None and (line := self._lines.readline(_MAX_ROW + 1)):
            if len(line) > _MAX_ROW:
                raise RecordingError(f"line {self.line + 1} has more than {_MAX_ROW} letters")
            row = (
                line.split(self._delimiter) if '"' not in line else next(csv.reader([line], delimiter=self._delimiter))
            )
            if len(row) > MAX_COLUMNS:
                raise RecordingError(f"line {self.line + 1} has {len(row)} cells; at most {MAX_COLUMNS} are read")
            self._ahead, self._plain = [cell.strip() for cell in row], _PLAIN.fullmatch(line) is not None
        return self._ahead

    def header(self, until: Callable[[Cells], bool], label: str) -> list[Cells]:
        """The rows before one, of which there are few."""
        found: list[Cells] = []
        for _ in range(_MAX_HEADER):
            if (row := self.look()) is None:
                break
            if until(row):
                return found
            found.append(self.take(label))
        raise RecordingError(f"has no {label} in its first {_MAX_HEADER} lines; export it again with its header")

    def numbers(self, width: int, blocks: bool = False) -> np.ndarray:
        """(rows, width) numbers until the end, NaN where one is missing; cells at the end of a row may be left out.

        Args:
            blocks: whether an empty line ends them.
        """
        cells, count, longest = array("d"), 0, 0  # letters of the last number of a line
        while (row := self.look()) is not None:
            is_plain = self._plain  # of this row, before the next one is looked at
            if not any(row):
                self.take("")
                if blocks:
                    break
                continue
            self.take("")
            if self._is_cut() and (len(row) < width or (len(row) == width and len(row[-1]) < longest)):
                self.notes.append(f"its last line, {self.line}, was cut and is left out")
                break
            if any(row[width:]):
                raise RecordingError(f"line {self.line} has {len(row)} cells; the header has {width}")
            cells.extend(self._numbers(row[:width], is_plain))
            cells.extend([math.nan] * (width - len(row)))
            longest = max(longest, len(row[width - 1]) if len(row) >= width else 0)
            count += 1
            if self._progress and not count % _TOLD:
                self._progress("read", self._lines.tell(), self._size)
            if count > MAX_ROWS or len(cells) > _MAX_CELLS:
                raise RecordingError(f"more than {MAX_ROWS} rows or {_MAX_CELLS} cells")
        if not count:
            raise RecordingError("has a header and no rows of numbers")
        return np.array(cells).reshape(count, width)

    def _is_cut(self) -> bool:
        return not self._complete and self.look() is None

    def _numbers(self, cells: Cells, is_plain: bool) -> list[float]:
        if is_plain and "" not in cells:
            try:
                return list(map(float, cells))
            except ValueError:  # a decimal comma, or no number
                pass
        return [self._number(cell) for cell in cells]

    def _number(self, cell: str) -> float:
        if cell.lower() in _UNSEEN:
            return math.nan
        try:
            value = float(cell.replace(",", ".") if self._delimiter == "\t" else cell)
        except ValueError:
            value = math.inf
        if "_" in cell or not math.isfinite(value):
            raise RecordingError(f"line {self.line}: {ascii(cell)[:40]} is no finite number; leave missing ones empty")
        return value


def _trc(rows: _Rows) -> Tracks:
    """OpenSim's: keys and their values below one another, marker names, axes, numbers."""
    rows.take("its header")
    about = dict(zip(rows.take("its header"), rows.take("its header"), strict=False))
    head = rows.take("the names of the markers")
    if [cell.lower() for cell in head[:2]] != ["frame#", "time"]:
        raise RecordingError(f"line {rows.line} begins with {ascii(head[:2])[:60]}; expected Frame# and Time")
    names = [cell for cell in head[2:] if cell]
    rows.take("the axes")
    width, declared = 2 + 3 * len(names), about.get("NumMarkers", "")
    if declared != str(len(names)):
        raise RecordingError(f"says NumMarkers {ascii(declared)[:20]} and names {len(names)}; correct its header")
    if not (unit := known_unit(about.get("Units", ""))):
        raise RecordingError(f"Units {ascii(about.get('Units', ''))[:20]} are unknown; write m, cm or mm there")
    table = rows.numbers(width)
    time = table[:, 1]
    if np.isnan(time).any():
        time = _counted(table[:, 0], about.get("DataRate", ""), "DataRate")
    points = table[:, 2:].reshape(len(table), -1, 3)
    return Tracks("TRC file", markers=_tracks("markers", names, points, time, unit))


def _motive(rows: _Rows) -> Tracks:
    """OptiTrack's: keys and values in one row; then type, name and more of each column; Frame, Time and the axes."""
    first = rows.take("its header")
    about = dict(zip(first[::2], first[1::2], strict=False))
    above = rows.header(lambda row: row[:1] == ["Frame"], 'row that begins with "Frame"')
    axes = rows.take("the axes")
    width = len(axes)
    said = {row[1]: row for row in above if len(row) > 1 and row[1]}
    if not {"Type", "Name"} <= said.keys() or len(axes) < 3 or not axes[1].lower().startswith("time"):
        raise RecordingError("has no rows Type and Name, or no time; export it from Motive with its header")
    kinds = next((row for row in above if {"Position", "Rotation"} & set(row)), None)
    if kinds is None:
        raise RecordingError("no row says which columns are a Position or a Rotation; export it again with its header")
    if not (unit := known_unit(about.get("Length Units", ""))):
        raise RecordingError(f"Length Units {ascii(about.get('Length Units', ''))[:20]} are unknown; there are Meters, "
                             "Centimeters and Millimeters")  # fmt: skip
    table = rows.numbers(width)
    columns: dict[tuple[str, str, str], dict[str, int]] = {}
    for i, key in enumerate(zip(said["Type"], kinds, said["Name"], axes, strict=False)):
        if i >= 2 and key[1] in ("Position", "Rotation"):
            columns.setdefault(key[:3], {}).setdefault(key[3], i)
    tracks = Tracks("export of Motive")
    for (thing, kind, name), found in columns.items():
        order = ("X", "Y", "Z") if kind == "Position" or "W" not in found else ("W", "X", "Y", "Z")
        if not set(order) <= found.keys():
            raise RecordingError(f"{kind} of {ascii(name)[:60]} has the axes {sorted(found)}; expected {list(order)}")
        values = table[:, [found[axis] for axis in order]]
        if kind == "Rotation":
            turns = len(order) == 4
            values, units = (continuous(values), "1") if turns else (values, "deg")
            tracks.rotations[name] = Track(table[:, 1], values, units)
            continue
        group = tracks.markers if thing.endswith("Marker") else tracks.bodies
        # a marker of a rigid body comes twice: as it was measured, "Marker", and as the body has it
        if thing == "Marker" or name not in group:
            group[name] = Track(table[:, 1], values, unit)
    return tracks


def _vicon(rows: _Rows) -> Tracks:
    """Vicon's: sections of a title, a rate, names, Frame and Sub Frame and components, units, and numbers."""
    tracks = Tracks("export of Vicon")
    while rows.look() is not None:
        title = rows.take("a section")[0]
        if title == "Events":
            while any(rows.look() or []):
                rows.take("events")
        elif title in _SECTIONS:
            _section(rows, title, tracks)
        elif title:
            there = ", ".join(_SECTIONS)
            raise RecordingError(f"line {rows.line}: {ascii(title)[:40]} is no section; there are {there}")
    return tracks


def _section(rows: _Rows, title: str, tracks: Tracks) -> None:
    rate = _rate(rows.take("a rate")[0], f"the rate of {title}")
    names, parts, units = rows.take("names"), rows.take("components"), rows.take("units")
    if [cell.lower() for cell in parts[:2]] != ["frame", "sub frame"]:
        raise RecordingError(f"line {rows.line - 1} begins with {ascii(parts[:2])[:60]}; expected Frame and Sub Frame")
    width = len(parts)
    table = rows.numbers(width, blocks=True)
    subs = np.nan_to_num(table[:, 1]).max() + 1.0
    time = (subs * table[:, 0] + table[:, 1]) / rate
    columns: dict[str, dict[str, int]] = {}
    name = ""
    for i in range(2, width):
        name = names[i] if i < len(names) and names[i] else name
        columns.setdefault(name.removeprefix("Global Angle (Quaternion) "), {}).setdefault(parts[i], i)
    for name, found in columns.items():
        _vicon_tracks(title, name, found, units, table, time, tracks)


def _vicon_tracks(
    title: str, name: str, found: Mapping[str, int], units: Cells, table: np.ndarray, time: np.ndarray, tracks: Tracks
) -> None:
    def track(parts: Sequence[str], fixed: str = "") -> Track:
        columns = [found[part] for part in parts]
        unit = fixed or known_unit(units[columns[0]] if columns[0] < len(units) else "")
        return Track(time, table[:, columns], unit)

    if title == "Trajectories" and {"X", "Y", "Z"} <= found.keys():
        tracks.markers[name] = track(("X", "Y", "Z"))
    elif {"TX", "TY", "TZ"} <= found.keys():
        tracks.bodies[name] = track(("TX", "TY", "TZ"))
        if {"RX", "RY", "RZ", "RW"} <= found.keys():
            turns = track(("RW", "RX", "RY", "RZ"), "1")
            tracks.rotations[name] = Track(time, continuous(turns.values), "1")
        elif {"RX", "RY", "RZ"} <= found.keys():
            tracks.rotations[name] = track(("RX", "RY", "RZ"))
    else:
        for part in found:
            tracks.channels[f"{name}.{part}"] = track((part,))


def _qualisys(rows: _Rows) -> Tracks:
    """Qualisys': keys and values, names, perhaps a row of column names, and numbers in mm."""
    head = rows.header(lambda row: row[0].lower() == "frame" or _is_number(row[0]), "rows of numbers")
    about = {row[0]: row[1:] for row in head if row[0]}
    included = (about.get("DATA_INCLUDED") or ["3D"])[0]
    key = {"3D": "MARKER_NAMES", "6D": "BODY_NAMES"}.get(included)
    if key is None or key not in about:
        raise RecordingError(f"DATA_INCLUDED {ascii(included)[:20]} without names; export 3D or 6D with its header")
    names = [name for name in about[key] if name]
    row = rows.look() or []
    titled = row[:1] == ["Frame"] or row[:1] == ["frame"]
    if titled:
        row = rows.take("column names")
    size = (3 if key == "MARKER_NAMES" else _BODY) * len(names)
    counted = titled and row[1:2] == ["Time"]
    if not titled:  # the first row shows it; a tab may follow the last number
        counted = len(row) in (size + 2, size + 3)
    table = rows.numbers(size + 2 * counted)
    rate = (about.get("FREQUENCY") or [""])[0]
    time: np.ndarray | None = table[:, 1] if counted else None
    if not counted and rate != "EXT":
        time = _counted(np.arange(len(table)), rate, "FREQUENCY")
    blocks = table[:, 2 * counted :].reshape(len(table), len(names), -1)
    unseen = (blocks[:, :, :3] == 0).all(axis=2)  # Qualisys writes 0 0 0 for a marker that it does not see
    blocks[unseen] = np.nan
    found = _tracks(key, names, blocks[:, :, :3], time, "mm")
    if key == "MARKER_NAMES":
        return Tracks("export of Qualisys", markers=found)
    turns = {name: Track(time, continuous(_of_angles(blocks[:, i, 3:6])), "1") for i, name in enumerate(names)}
    return Tracks("export of Qualisys", bodies=found, rotations=turns)


def _of_angles(degrees: np.ndarray) -> np.ndarray:
    """(T, 4) quaternions of (T, 3) roll, pitch and yaw, in the standard of Qualisys: about the body's own axes, the x
    axis first."""
    half = np.radians(degrees) / 2.0
    (a, b, c), (x, y, z) = np.cos(half).T, np.sin(half).T
    w, i = a * b * c - x * y * z, x * b * c + a * y * z
    return np.stack([w, i, a * y * c - x * b * z, a * b * z + x * y * c], axis=1)


def _tracks(
    label: str, names: Sequence[str], points: np.ndarray, time: np.ndarray | None, unit: str
) -> dict[str, Track]:
    """Tracks of (T, n, 3) points."""
    if double := [name for name in names if names.count(name) > 1]:
        raise RecordingError(f"{label}: two are called {ascii(double[0])[:60]}; rename one and export again")
    return {name: Track(time, points[:, i], unit) for i, name in enumerate(names)}


def _counted(frames: np.ndarray, rate: str, label: str) -> np.ndarray:
    """(T,) times [s] of frames."""
    return frames / _rate(rate, label)


def _rate(text: str, label: str) -> float:
    if not _is_number(text) or not 0.0 < float(text) < math.inf:
        raise RecordingError(f"{label} is {ascii(text)[:20]}; expected samples per second")
    return float(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
