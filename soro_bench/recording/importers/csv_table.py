"""Tables of text: CSV files from motion capture, load cells and loggers."""

import csv
import io
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.recording.importers.mapping import FileMapping, Source, load_mapping, texts, typed
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_COLUMNS, MAX_ROWS, named_errors, read_bytes

_PLACE = ("columns", "first", "last", "time")
_FORMAT = ("delimiter", "decimal", "skip_rows", "header", "missing", "label", "only")
_MAX_CELLS = 50_000_000  # that a mapping asks for
_MAX_ROW = 1_000_000  # letters, as every cell of a row is a text of its own before they are counted


def import_csv(path: str | Path, mapping: str | Path | Mapping | None, max_bytes: int = MAX_BYTES) -> Recording:
    """Read a CSV file with a mapping file; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: a CSV file needs a mapping file; docs/how_to/import_a_log.md has an example")
    spec = load_mapping(mapping, _PLACE, ("column", "unit", "interval", "rate", "period"), _FORMAT)
    data = read_bytes(path, max_bytes)
    with named_errors(path):
        spec.to_seconds()
        table = _Table(data.decode("utf-8-sig"), spec.format)
        time_column = typed("[time]", spec.time, "column", "")

        def read(source: Source) -> tuple[np.ndarray, ...]:
            """(T,) times [s], (T, k) numbers of a signal and (T,) the lines that they are from."""
            column = typed("it has", source.place, "time", time_column)
            cells, lines = table.numbers([*([column] if column else []), *table.names_of(source)])
            if not column:
                cells = np.column_stack([spec.counted(len(cells)), cells])
            time, numbers, lines = _samples(cells, lines)
            return spec.clock(time) if column else time, numbers, lines

        table.read(_columns(table, spec, time_column))
        return spec.recording(read, Path(path).name, EXPANSION * max_bytes)


def _columns(table: "_Table", spec: FileMapping, time_column: str) -> list[str]:
    """Every column that the mapping asks for."""
    names = [time_column] if time_column else []
    for source in (*spec.commands.values(), *spec.signals.values()):
        names += [*table.names_of(source), *([source.place["time"]] if "time" in source.place else [])]
    return names


def _samples(cells: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T,) times, (T, k) numbers and (T,) lines of the rows that have a time and at least one number.

    Args:
        cells: (rows, 1 + k), time first.
        lines: (rows,) their numbers in the file.
    """
    present = ~np.isnan(cells[:, 0]) & ~np.isnan(cells[:, 1:]).all(axis=1)
    if not present.any():
        raise RecordingError("no row has a time and a number")
    return cells[present, 0], cells[present, 1:], lines[present]


class _Table:
    """The columns of a CSV file that are asked for, as numbers."""

    def __init__(self, text: str, options: Mapping[str, Any]) -> None:
        label = "[format]"
        self._decimal = typed(label, options, "decimal", ".")
        self._missing = {"", "nan", *(word.strip().lower() for word in _words(options, "missing"))}
        delimiter, skip = typed(label, options, "delimiter", ","), typed(label, options, "skip_rows", 0)
        if len(delimiter) != 1 or len(self._decimal) != 1 or delimiter in (self._decimal, "\n", "\r", '"'):
            raise RecordingError(f"{label} delimiter {delimiter!r} and decimal {self._decimal!r}: one letter each")
        if not 0 <= skip <= MAX_ROWS:
            raise RecordingError(f"{label} skip_rows = {skip}; expected 0 to {MAX_ROWS}")
        lines = io.StringIO(text, newline="")
        for _ in range(skip):
            lines.readline()
        self._skipped, self._letters = skip, 0
        self._rows = csv.reader(self._bounded(lines), delimiter=delimiter, strict=True)
        self._first = [cell.strip() for cell in next(self._rows, [])]
        if not 1 <= len(self._first) <= MAX_COLUMNS:
            raise RecordingError(f"{len(self._first)} columns; expected 1 to {MAX_COLUMNS}")
        self._has_header = typed(label, options, "header", True)
        self.header = self._first if self._has_header else [str(i + 1) for i in range(len(self._first))]
        label, self._only = typed(label, options, "label", ""), _words(options, "only")
        if bool(label) != bool(self._only):
            raise RecordingError("[format] label and only belong together: a column, and the texts to look for in it")
        self._label = self._position(label) if label else None
        self._index: dict[str, int] = {}
        self._cells = np.empty((0, 0))
        self._lines = np.empty(0, int)

    def names_of(self, source: Source) -> list[str]:
        """The columns of a signal: a list, or all from the first to the last."""
        place = source.place
        if "columns" in place and not {"first", "last"} & place.keys():
            return texts("columns", place["columns"])
        if {"first", "last"} <= place.keys() and "columns" not in place:
            first, last = self._position(place["first"]), self._position(place["last"])
            if first <= last:
                return self.header[first : last + 1]
        raise RecordingError("expected columns = [...], or first and last in the order of the file")

    def read(self, names: Iterable[str]) -> None:
        """Read these columns into memory."""
        names = list(dict.fromkeys(names))
        positions = [self._position(name) for name in names]
        self._index = {name: i for i, name in enumerate(names)}
        cells, lines = array("d"), array("q")  # a list would take four times the memory
        start = [self._first] if not self._has_header else []
        for row in self._all_rows(start):
            if len(row) != len(self.header):
                raise RecordingError(f"line {self._line} has {len(row)} cells; expected {len(self.header)}")
            if self._label is not None and not any(text in row[self._label] for text in self._only):
                continue
            cells.extend([self._number(row[i]) for i in positions])
            lines.append(self._line)
            if len(lines) > MAX_ROWS or len(cells) > _MAX_CELLS:
                raise RecordingError(f"more than {MAX_ROWS} rows or {_MAX_CELLS} cells")
        self._cells, self._lines = np.array(cells).reshape(-1, len(names)), np.array(lines)

    def numbers(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """(rows, k) numbers of k columns, NaN where one is missing, and (rows,) the lines they are from."""
        return self._cells[:, [self._index[name] for name in names]], self._lines

    @property
    def _line(self) -> int:
        return self._skipped + self._rows.line_num

    def _all_rows(self, start: list[list[str]]) -> Iterator[list[str]]:
        yield from start
        self._letters = 0
        for row in self._rows:
            self._letters = 0
            if len(row) > 1 or any(cell.strip() for cell in row):  # a row of empty cells counts, an empty line does not
                yield row

    def _bounded(self, lines: io.StringIO) -> Iterator[str]:
        """The lines, of which a quoted cell may join several to a row."""
        while line := lines.readline(_MAX_ROW + 1):
            self._letters += len(line)
            if self._letters > _MAX_ROW:
                raise RecordingError(f"the row in line {self._line + 1} has more than {_MAX_ROW} letters")
            yield line

    def _position(self, name: Any) -> int:
        if not isinstance(name, str) or self.header.count(name) != 1:
            count = self.header.count(name)
            found = ", ".join(ascii(column)[1:-1] for column in self.header)[:200]
            hint = "; are [format] delimiter and skip_rows right?" if len(self.header) == 1 else ""
            label = f"{count} columns are" if count else "no column is"
            raise RecordingError(f"{label} called {ascii(name)[:80]}; there {_are(self.header)} {found}{hint}")
        return self.header.index(name)

    def _number(self, cell: str) -> float:
        cell = cell.strip()
        if cell.lower() in self._missing:
            return math.nan
        # Python takes 1_000 for a number; and a point is none where the decimal is another letter
        foreign = "_" in cell or (self._decimal != "." and "." in cell)
        try:
            value = math.inf if foreign else float(cell.replace(self._decimal, "."))
        except ValueError:
            value = math.inf
        if not math.isfinite(value):
            hint = "what stands for a missing one belongs into [format] missing"
            if "," in cell and self._decimal == ".":
                hint = 'of decimal commas [format] says decimal = ","'
            raise RecordingError(f"line {self._line}: {ascii(cell)[:40]} is no finite number; {hint}")
        return value


def _are(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _words(options: Mapping[str, Any], key: str) -> list[str]:
    """The texts of an entry of [format], none if it is missing."""
    return texts(f"[format] {key}", options[key]) if key in options else []
