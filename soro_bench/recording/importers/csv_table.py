"""Tables of text: CSV files from motion capture, load cells and loggers."""

import csv
import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import brief, shown
from soro_bench.recording.importers.clock import (
    DATE_ORDERS,
    NO_STAMP,
    Stamps,
    holds_stamps,
    is_minutes,
    over_midnight,
    together,
)
from soro_bench.recording.importers.guess_table import guessed
from soro_bench.recording.importers.mapping import FileMapping, load_mapping, unit_doubt
from soro_bench.recording.importers.source import Source
from soro_bench.recording.importers.table_cells import Labels, Names, Numbers, Times, Want, read_columns
from soro_bench.recording.importers.table_text import FORMAT, MISSING, TableText, read_text, value, words
from soro_bench.recording.importers.units import TIME_UNITS, of_text, si
from soro_bench.recording.recording import ReadingProgress, Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors, read_bytes

_PLACE = ("columns", "first", "last", "time", "time_unit", "missing", "label", "only", "names", "names_from")
_TIME = ("column", "columns", "unit", "units", "interval", "rate", "period", "date")
_TOGETHER = 0.5  # of the times have all names that are gathered at least
_PEEKED, _SEARCHED = 20, 1000  # rows that tell whether a column holds dates, and in which its first one is looked for


def import_csv(
    path: str | Path,
    mapping: str | Path | Mapping | None,
    max_bytes: int = MAX_BYTES,
    progress: ReadingProgress | None = None,
) -> Recording:
    """Read a CSV file with a mapping file; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: a CSV file needs a mapping file; soro-bench import {path} --guess writes one")
    spec = load_mapping(mapping, _PLACE, _TIME, FORMAT, unit_optional=True)
    data = read_bytes(path, max_bytes)
    with named_errors(path):
        spec.to_seconds()
        if {"unit", "units"} <= spec.time.keys():
            raise RecordingError("[time] says both unit and units; units are of columns, one for each")
        if spec.time.get("date", DATE_ORDERS[0]) not in DATE_ORDERS:
            raise RecordingError(f"[time] date = {brief(spec.time['date'])}; expected one of {', '.join(DATE_ORDERS)}")
        table = read_text(data, spec.format)
        del data
        spec.notes.add("the file", table.note)
        reader = _Reader(table, spec, progress)
        del table  # and its text, which is as large as the file
        return spec.recording(reader.samples, Path(path).name, EXPANSION * max_bytes, reader.unit)


class _Reader:
    """The columns of a table that a mapping asks for, read once."""

    def __init__(self, table: TableText, spec: FileMapping, progress: ReadingProgress | None) -> None:
        self._table, self._spec = table, spec
        self._words = words("[format] missing", spec.format.get("missing", []))
        self._known_names: dict[Names, Names] = {}
        self._peeked = _first_rows(table)
        wants: list[Want] = []
        for group, sources in (("commands", spec.commands), ("signals", spec.signals)):
            for name, source in sources.items():
                try:
                    wants += self._wants(source)
                    spec.notes.add(f"{group}.{name}", unit_doubt(source, self._labels(source)))
                except RecordingError as error:
                    raise RecordingError(f"{group}.{name}: {error}") from error
        self._columns, self._lines = read_columns(table, wants, self._kept("[format]", spec.format), progress)
        self._table = replace(table, text="", start=0)
        self._clocks: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        self._check_commands()

    def samples(self, source: Source) -> tuple[np.ndarray, ...]:
        """(T,) times [s] or ns, (T, k) numbers of a signal and (T,) the lines that they are from."""
        label = self._kept("it", source.place)
        rows = self._columns[label] if label else slice(None)
        numbers = np.column_stack([self._numbers(source, want)[rows] for want in self._number_wants(source)])
        if clock := self._times(source):
            time, known = clock[0][rows], clock[1][rows]
        else:
            time, known = self._spec.counted(len(numbers)), np.ones(len(numbers), bool)
        lines = self._lines[rows]
        if "names" in source.place:
            wants = self._names(source)
            places = np.column_stack([self._columns[want][rows] for want in wants])[known]
            time, numbers, lines = chosen_by_name(wants, places, time[known], numbers[known], lines[known])
            known = np.ones(len(time), bool)
            whole = ~np.isnan(numbers).any(axis=1)
            if len(wants) == 1 and whole.mean() < _TOGETHER:
                said = f"of {len(time)} times {whole.sum()} have all of {brief(source.place['names'])}"
                self._spec.notes.add("names", f"{said}; those of one time need equal stamps")
        present = known & ~np.isnan(numbers).all(axis=1)
        if not present.any():
            raise RecordingError("no row has a time and a number")
        if present.all():  # without a copy
            return time, numbers, lines
        return time[present], numbers[present], lines[present]

    def unit(self, source: Source) -> str:
        """What the row of units says about the columns of a signal."""
        if not self._table.units:
            raise RecordingError('a signal has no unit; a quantity without one has unit = "1", and of a row of units '
                                 '[format] says unit_row = "take"')  # fmt: skip
        found = {self._table.units[i] for i in self._positions(source)}
        units = {of_text(text) for text in found}
        if len(units) > 1 or None in units:
            raise RecordingError(f"columns have the units {', '.join(sorted(map(ascii, found)))[:80]} in the file; "
                                 "write unit = ... at the signal")  # fmt: skip
        return str(units.pop())

    def _wants(self, source: Source) -> list[Want]:
        """Every column that a signal needs."""
        place = source.place
        self._check_unit(source)
        if ("names" in place) != ("names_from" in place):
            raise RecordingError("names and names_from belong together: names, and the columns that they stand in")
        label = self._kept("it", place)
        names = self._names(source) if "names" in place else []
        wants: list[Want] = [*self._time_wants(source), *self._number_wants(source), *names]
        return [*wants, label] if label else wants

    def _check_unit(self, source: Source) -> None:
        if source.unit is None:
            self.unit(source)
        elif self._table.units:
            said = {of_text(self._table.units[i]) for i in self._positions(source)} - {None, source.unit}
            if said and si(source.unit) not in map(si, map(str, said)):
                raise RecordingError(f"unit = {source.unit!r}, and the row of units says {sorted(map(str, said))}; "
                                     'leave unit out, or write unit_row = "skip"')  # fmt: skip

    def _number_wants(self, source: Source) -> list[Numbers]:
        missing = frozenset(word.strip().lower() for word in self._missing(source) if value(word) is None)
        return [Numbers(i, missing) for i in self._positions(source)]

    def _missing(self, source: Source) -> list[str]:
        """What stands for a missing number."""
        return words("missing", source.place["missing"]) if "missing" in source.place else self._words

    def _numbers(self, source: Source, want: Numbers) -> np.ndarray:
        """(rows,) numbers without those that stand for a missing one."""
        cells = self._columns[want]
        values = self._sentinels(source)
        return np.where(np.isin(cells, values), np.nan, cells) if values else cells

    def _sentinels(self, source: Source) -> list[float]:
        """Numbers that stand for a missing one."""
        return [number for word in self._missing(source) if (number := value(word)) is not None]

    def _check_commands(self) -> None:
        """Refuse numbers that stand for a missing one among markers, and are commands."""
        for name, source in self._spec.commands.items():
            if "missing" in source.place or not (values := self._sentinels(source)):
                continue
            hit = sum(int(np.isin(self._columns[want], values).sum()) for want in self._number_wants(source))
            if hit:
                raise RecordingError(
                    f"commands.{name}: [format] missing = {self._words} would empty {hit} of its numbers; write "
                    "missing at the signals that it is meant for, or missing = [] at this command"
                )

    def _positions(self, source: Source) -> list[int]:
        """The columns of a signal: a list, or all from the first to the last."""
        place = source.place
        if "columns" in place and not {"first", "last"} & place.keys():
            found = [self._table.position(name) for name in _texts("columns", place["columns"])]
        elif {"first", "last"} <= place.keys() and "columns" not in place:
            first, last = self._table.position(place["first"]), self._table.position(place["last"])
            found = list(range(first, last + 1))
        else:
            found = []
        if not found:
            raise RecordingError("expected columns = [...], or first and last in the order of the file")
        if len(set(found)) < len(found):
            raise RecordingError(f"columns is {ascii(place['columns'])[:80]}; expected each once")
        return found

    def _labels(self, source: Source) -> list[str]:
        """What the header calls the columns of a signal."""
        return [self._table.header[i] for i in self._positions(source)]

    def _kept(self, label: str, options: Mapping[str, Any]) -> Labels | None:
        """Which rows belong to a signal, or to all."""
        if ("label" in options) != ("only" in options):
            raise RecordingError(f"{label}: label and only belong together: a column, and the texts to look for in it")
        if "label" not in options:
            return None
        return Labels(self._table.position(options["label"]), tuple(words(f"{label} only", options["only"], least=1)))

    def _clock_columns(self, source: Source) -> list[Any]:
        """The columns of its times; none where rows are counted."""
        time = self._spec.time
        if "time_unit" in source.place and "time" not in source.place:
            raise RecordingError("time_unit has no effect without time, a column of times of its own")
        found = source.place.get("time", time.get("column", time.get("columns", [])))
        return found if isinstance(found, list) else [found]

    def _time_wants(self, source: Source) -> list[Numbers] | list[Times]:
        positions = [self._table.position(name) for name in self._clock_columns(source)]
        if len(set(positions)) < len(positions):
            raise RecordingError(f"time is in columns {brief(self._clock_columns(source))}; expected each once")
        if not positions:
            return []
        cells = [" ".join(row[i] for i in positions).strip() for row in self._peeked if max(positions) < len(row)]
        if holds_stamps([cell for cell in cells if cell.lower() not in MISSING]):
            own = "time" in source.place
            if {"time_unit"} & source.place.keys() if own else {"unit", "units"} & self._spec.time.keys():
                raise RecordingError("a unit of time has no effect: its column holds dates or times of day")
            if "period" in self._spec.time and not own:
                raise RecordingError("[time] period has no effect: its column holds dates or times of day")
            if len(positions) == 1 and any(is_minutes(cell) for cell in cells):
                self._spec.notes.add("[time]", "times of two parts are taken for minutes and seconds")
            return [Times(tuple(positions), Stamps(self._spec.time.get("date", "")))]
        if "date" in self._spec.time:
            raise RecordingError("[time] date has no effect: the column of times holds no dates")
        if "period" in self._spec.time and len(positions) > 1:
            raise RecordingError("[time] period has no effect: times in several columns begin nowhere again")
        missing = frozenset(word.strip().lower() for word in self._words if value(word) is None)
        return [Numbers(i, missing) for i in positions]

    def _times(self, source: Source) -> tuple[np.ndarray, np.ndarray] | None:
        """(rows,) times [s] or ns, and whether there is one; None where rows are counted."""
        if not (wants := self._time_wants(source)):
            return None
        units = [] if isinstance(wants[0], Times) else self._units(source, wants)
        key = (*wants, *units)
        if key not in self._clocks:
            columns = [self._columns[want] for want in wants]
            known = ~np.isnan(columns).any(axis=0) if units else np.not_equal(columns[0], NO_STAMP)
            known = np.asarray(known, bool)
            present = [column[known] for column in columns]
            if not units:
                found = over_midnight(present[0])
            elif len(units) > 1:
                found = together(present, [self._spec.to_seconds(unit) for unit in units])
                found = over_midnight(found) if units[0] == "h" else found
            else:
                found = self._spec.clock(present[0], units[0])
            time = np.zeros(len(known), found.dtype)
            time[known] = self._spec.continued(found)
            self._clocks[key] = time, known
        return self._clocks[key]

    def _units(self, source: Source, wants: list[Any]) -> list[str | None]:
        """A unit of each column of times."""
        time, count = self._spec.time, len(wants)
        own = "time" in source.place
        key = "time_unit" if own else "[time] units" if count > 1 else "[time] unit"
        said = source.place.get("time_unit") if own else time.get("units", None)
        if said is None and not (own and count > 1):
            said = time.get("unit")
        found = said if isinstance(said, list) else [said] * (count if said is None else 1)
        if len(found) == count:
            found = [self._unit_of_time(want.position, unit, key) for want, unit in zip(wants, found, strict=True)]
        if len(found) != count or (count > 1 and None in found):
            raise RecordingError(f'time in {count} columns needs {key} of each, such as {key} = ["s", "ns"]')
        for want, unit in zip(wants, found, strict=True):
            self._spec.check_unit_of_time(self._table.header[want.position], unit, key)
        return found

    def _unit_of_time(self, position: int, said: str | None, key: str) -> str | None:
        """The unit of a column of times that the mapping says, or the row of units; RecordingError if they differ."""
        text = self._table.units[position] if self._table.units else ""
        row = of_text(text) if text.strip() else None
        row = row if row and si(row)[0] == "s" else None
        if said is None and text.strip() and not row:
            raise RecordingError(f"the row of units says {ascii(text)[:40]} of times; write {key}, one of {TIME_UNITS}")
        if said and row and si(said) != si(row):
            raise RecordingError(f"{key} = {said!r}, and the row of units says {row!r}; leave the unit out, or write "
                                 'unit_row = "skip"')  # fmt: skip
        return said or row

    def _names(self, source: Source) -> list[Names]:
        """The columns in which names stand: one, or one beside each column of numbers."""
        wanted = tuple(_texts("names", source.place["names"]))
        given = source.place["names_from"]
        positions = [self._table.position(name) for name in (given if isinstance(given, list) else [given])]
        if len(positions) not in (1, len(self._positions(source))):
            raise RecordingError(f"names_from has {len(positions)} columns; expected one, or one for each of columns")
        if not self._clock_columns(source):
            raise RecordingError("names need times: rows of one time belong together")
        wants = [Names(i, tuple(map(str, wanted))) for i in positions]
        return [self._known_names.setdefault(want, want) for want in wants]  # which remember what they have found


def _first_rows(table: TableText) -> list[list[str]]:
    """The first rows, and for each column that says nothing there the first one in which it does.

    There are fewer where rows cannot be read.
    """
    rows: list[list[str]] = []
    silent = set(range(len(table.header)))
    try:
        for row in itertools.islice(table.rows(table.lines()), _SEARCHED):
            said = {i for i in silent if i < len(row) and row[i].strip().lower() not in MISSING}
            rows += [row] if row and (said or len(rows) < _PEEKED) else []
            silent -= said
            if len(rows) >= _PEEKED and not silent:
                break
    except (csv.Error, RecordingError):  # which reading all of them says better
        pass
    return rows


def _texts(label: str, values: Any) -> list[Any]:
    """A list of texts, or of numbers of columns, each once."""
    valid = isinstance(values, list) and values and all(type(value) in (str, int) for value in values)
    if not valid or len(set(values)) < len(values):
        expected = "expected a list of texts" if not valid else "expected each once"
        raise RecordingError(f"{label} is {ascii(values)[:80]}; {expected}")
    return values


def guess(path: str | Path) -> str:
    """A commented mapping (TOML) of everything in a table, to be corrected; with what an import refuses."""
    text = guessed(path)
    try:
        import_csv(path, tomllib.loads(text))
    except RecordingError as error:
        text += f"\n# An import with this mapping says: {shown(str(error))}\n"
    return text


# --- numbers that are chosen by the names that stand beside them, in whatever order they come ---


def chosen_by_name(
    wants: Sequence[Names], places: np.ndarray, time: np.ndarray, numbers: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T,) times, (T, k) numbers in the order of the names, and (T,) lines.

    Args:
        places: (rows, m) which of the names stands in each column of names, -1 for none of them.
        time: (rows,).
        numbers: (rows, m) beside the names, or (rows, k) of the one name of a row, where m is 1.
        lines: (rows,).

    Raises:
        RecordingError: a name never occurs, or occurs twice at one time.
    """
    names = wants[0].names
    for i, name in enumerate(names):
        if not (places == i).any():
            there = ", ".join(ascii(each)[1:-1] for want in wants for each in want.found)[:200]
            raise RecordingError(f"no row has the name {ascii(name)[:80]}; there are {there}")
    if len(wants) > 1:
        return time, _beside(names, places, numbers, lines), lines
    kept = places[:, 0] >= 0
    return _gathered(names, places[kept, 0], time[kept], numbers[kept], lines[kept])


def _beside(names: tuple[str, ...], places: np.ndarray, numbers: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """(rows, names) the number beside each name, NaN where it is not there."""
    found = np.full((len(places), len(names)), np.nan)
    for i, name in enumerate(names):
        hit = places == i
        if (twice := hit.sum(axis=1) > 1).any():
            raise RecordingError(f"the name {ascii(name)[:80]} stands twice in line {lines[twice][0]}")
        column = hit.argmax(axis=1)
        found[:, i] = np.where(hit.any(axis=1), numbers[np.arange(len(numbers)), column], np.nan)
    return found


def _gathered(
    names: tuple[str, ...], places: np.ndarray, time: np.ndarray, numbers: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One sample of (names * k,) numbers for the rows of one time that follow one another."""
    begins = np.append(True, np.diff(time) != 0)
    group = np.cumsum(begins) - 1
    found = np.full((group[-1] + 1, len(names), numbers.shape[1]), np.nan)
    _, first = np.unique(group * len(names) + places, return_index=True)
    if len(first) < len(group):
        again = np.setdiff1d(np.arange(len(group)), first)[0]
        name = ascii(names[places[again]])[:80]
        raise RecordingError(f"the name {name} comes twice at one time, again in line {lines[again]}")
    found[group, places] = numbers
    return time[begins], found.reshape(len(found), -1), lines[begins]
