"""The cells of a table as numbers, times and texts: quickly where all is plain, and row by row where it is not.

A block of lines is first read by pyarrow, which knows fewer ways to write a number than there are. What it refuses is
read again cell by cell, which either succeeds or says in which line and why it cannot.
"""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from soro_bench.recording.importers.clock import NO_STAMP, Stamps
from soro_bench.recording.importers.table_text import (
    BLANK,
    MAX_LETTERS,
    MISSING,
    Lines,
    TableText,
    is_grouped,
    plain,
    split,
    value,
)
from soro_bench.recording.recording import ReadingProgress, RecordingError
from soro_bench.recording.untrusted import MAX_ROWS

_MAX_CELLS = 50_000_000  # that a mapping asks for
_BLOCK = 4_000_000  # letters that are read at once
_NO_SIGN = re.compile(rb"\+(?![0-9.])")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_ROWS = 20_000  # that are read at once where cells have quotation marks
_NEWLINE, _QUOTE = b'\n"'


class Chunk(Protocol):
    """Some rows of a table."""

    lines: np.ndarray  # (n,) their numbers in the file

    def numbers(self, position: int, missing: frozenset[str]) -> np.ndarray:
        """(n,) numbers of a column, NaN for a missing one."""

    def texts(self, position: int) -> list[str]:
        """n texts of a column."""


@dataclass(frozen=True)
class Numbers:
    """A column of numbers, with the texts that stand for a missing one, in small letters."""

    position: int
    missing: frozenset[str]

    def read(self, chunk: Chunk) -> np.ndarray:
        """(n,) numbers."""
        return chunk.numbers(self.position, self.missing)


@dataclass(frozen=True)
class Times:
    """One column of dates and times, or one of dates and one of times."""

    positions: tuple[int, ...]
    stamp: Stamps = field(default_factory=Stamps, compare=False)

    def read(self, chunk: Chunk) -> np.ndarray:
        """(n,) whole ns, or NO_STAMP."""
        columns = [chunk.texts(position) for position in self.positions]
        cells = [" ".join(parts).strip() for parts in zip(*columns, strict=True)]
        return np.array([self._stamp(cell, line) for cell, line in zip(cells, chunk.lines, strict=True)], np.int64)

    def _stamp(self, cell: str, line: int) -> int:
        if cell.lower() in MISSING:
            return NO_STAMP
        try:
            return self.stamp(cell)
        except RecordingError as error:
            raise RecordingError(f"line {line}: {error}") from error


@dataclass(frozen=True)
class Labels:
    """Whether one of some texts occurs in a cell of a column; of numbers, whether one equals it."""

    position: int
    only: tuple[str, ...]

    def read(self, chunk: Chunk) -> np.ndarray:
        """(n,) bool."""
        cells = chunk.texts(self.position)
        kept = {cell: any(occurs(text, cell) for text in self.only) for cell in set(cells)}
        return np.array([kept[cell] for cell in cells], bool)


def occurs(text: str, cell: str) -> bool:
    """Whether a text is in a cell, where no number goes on beyond it; of two numbers, whether they are equal."""
    numbers = value(text), value(cell)
    if None not in numbers:
        return numbers[0] == numbers[1]
    before, after = r"(?<!\d)" * text[:1].isdigit(), r"(?!\d)" * text[-1:].isdigit()
    return re.search(f"{before}{re.escape(text)}{after}", cell) is not None


@dataclass(frozen=True)
class Names:
    """Which of some names stands in a cell of a column."""

    position: int
    names: tuple[str, ...]
    found: dict[str, None] = field(default_factory=dict, compare=False)  # the first ones, for a message

    def read(self, chunk: Chunk) -> np.ndarray:
        """(n,) the place of the name among those that are wanted, -1 for others."""
        cells = [cell.strip() for cell in chunk.texts(self.position)]
        self.found.update(dict.fromkeys(sorted(set(cells))[:20]) if len(self.found) < 20 else {})
        places = {name: i for i, name in enumerate(self.names)}
        return np.array([places.get(cell, -1) for cell in cells], int)


Want = Numbers | Times | Labels | Names


def read_columns(
    table: TableText, wants: Sequence[Want], keep: Labels | None, progress: ReadingProgress | None = None
) -> tuple[dict[Want, np.ndarray], np.ndarray]:
    """(rows,) of each column that is wanted, and (rows,) the lines that they are from.

    Args:
        keep: which rows to keep; all by default.
        progress: is told letters that are read, and all.

    Raises:
        RecordingError: names the line of a cell or row that cannot be read.
    """
    wants = list(dict.fromkeys(wants))
    parts: dict[Want, list[np.ndarray]] = {want: [] for want in wants}
    lines, cells = [np.empty(0, int)], 0
    for chunk, done in _chunks(table, [*wants, *([keep] if keep else [])]):
        kept = keep.read(chunk) if keep else slice(None)
        for want in wants:
            parts[want].append(want.read(chunk)[kept])
        lines.append(chunk.lines[kept])
        cells += len(lines[-1]) * len(wants)
        if cells > _MAX_CELLS or cells > MAX_ROWS * len(wants):
            raise RecordingError(f"more than {MAX_ROWS} rows or {_MAX_CELLS} cells")
        if progress:
            progress("read", done - table.start, len(table.text) - table.start)
    empty = {Numbers: np.empty(0), Times: np.empty(0, np.int64), Labels: np.empty(0, bool), Names: np.empty(0, int)}
    return {want: np.concatenate([empty[type(want)], *part]) for want, part in parts.items()}, np.concatenate(lines)


def _chunks(table: TableText, wants: Sequence[Want]) -> Iterator[tuple[Chunk, int]]:
    """All rows, and how many letters are behind them."""
    position, line = table.start, table.line
    while position < len(table.text):
        end = table.text.find("\n", min(position + _BLOCK, len(table.text)) - 1) + 1
        block = table.text[position:end]
        if '"' in block and table.delimiter != BLANK and not _is_regular(block.encode(), table.delimiter):
            yield from _row_chunks(table, Lines(table.text, position, line - 1))  # a cell may go on in the next block
            return
        if chunk := _plain(table, block, line, wants):
            if len(chunk.lines):
                yield chunk, end
        else:
            for rows, done in _row_chunks(table, Lines(block, 0, line - 1)):
                yield rows, position + done
        position, line = end, line + block.count("\n")


def _is_regular(data: bytes, delimiter: str) -> bool:
    """Whether quotation marks stand around whole cells of one line only."""
    letters = np.frombuffer(data, np.uint8)
    marks = np.flatnonzero(letters == _QUOTE)
    lines = np.searchsorted(np.flatnonzero(letters == _NEWLINE), marks)
    if len(marks) % 2 or (lines[::2] != lines[1::2]).any() or len(delimiter.encode()) != 1:
        return False
    borders = (ord(delimiter), _NEWLINE)
    before = letters[np.maximum(marks[::2] - 1, 0)]
    return bool(
        (np.isin(before, borders) | (marks[::2] == 0)).all() and np.isin(letters[marks[1::2] + 1], borders).all()
    )


def _row_chunks(table: TableText, lines: Lines) -> Iterator[tuple["_Rows", int]]:
    """Rows that are read one by one, and how many letters are behind them."""
    rows: list[list[str]] = []
    numbers: list[int] = []
    for row in _parsed(table, lines):
        if len(row) > 1 or any(cell.strip() for cell in row):  # a row of empty cells counts, an empty line does not
            rows.append(_whole(table, row, lines.count))
            numbers.append(lines.count)
        if len(rows) >= _ROWS:
            yield _Rows(rows, np.array(numbers), table), lines.position
            rows, numbers = [], []
    if rows:
        yield _Rows(rows, np.array(numbers), table), lines.position


def _parsed(table: TableText, lines: Lines) -> Iterator[list[str]]:
    """The cells of each row; RecordingError for quotation marks that do not fit together."""
    try:
        yield from table.rows(lines)
    except csv.Error as error:
        raise RecordingError(f"the row in line {lines.count}: {error}; are quotation marks closed?") from error


def _whole(table: TableText, row: list[str], line: int) -> list[str]:
    """A row that is as long as the header."""
    missing = len(table.header) - len(row)
    try:
        extra = table.fits(len(row))
        fits = not any(cell.strip() for cell in row[len(row) - extra :])
    except RecordingError:
        fits = False
    if not fits:
        hint = f'; of several blanks in a row [format] says delimiter = "{BLANK}"' if table.delimiter in " \t" else ""
        hint = hint or ("; what is no row has to begin with #" if missing > 0 else "")
        raise RecordingError(f"line {line} has {len(row)} cells; expected {len(table.header)}{hint}")
    return row + [""] * missing if missing > 0 else row


class _Rows:
    """Rows of texts."""

    def __init__(self, rows: list[list[str]], lines: np.ndarray, table: TableText) -> None:
        self._rows, self.lines, self._table = rows, lines, table

    def numbers(self, position: int, missing: frozenset[str]) -> np.ndarray:
        """(n,) numbers of a column, NaN for a missing one."""
        missing = missing | MISSING
        found = np.empty(len(self._rows))
        for i, row in enumerate(self._rows):
            cell = row[position].strip()
            found[i] = math.nan if cell.lower() in missing else self._number(cell, i, position)
        return found

    def texts(self, position: int) -> list[str]:
        """n texts of a column."""
        return [row[position] for row in self._rows]

    def _number(self, cell: str, i: int, position: int) -> float:
        # Python takes 1_000 for a number; and a point is none where the decimal is another letter
        decimal = self._table.decimal
        foreign = "_" in cell or (decimal != "." and "." in cell)
        try:
            number = math.inf if foreign else float(plain(cell, decimal))
        except ValueError:
            number = math.inf
        if not math.isfinite(number):
            column = ascii(self._table.header[position])[:40]
            hint = self._hint(cell, i)
            raise RecordingError(
                f"line {self.lines[i]}: {ascii(cell)[:40]} is no finite number in column {column}; {hint}"
            )
        return number

    def _hint(self, cell: str, i: int) -> str:
        table = self._table
        if _COMMA.fullmatch(cell) and table.decimal == ".":
            return 'of decimal commas [format] says decimal = ",", and separators of thousands are not read'
        if is_grouped(cell):
            return f"separators of thousands are not read: export the table without them; decimal is {table.decimal!r}"
        if ":" in cell:
            return "times are read if they are written as 2024-06-27T10:11:02.5Z or 10:11:02.5"
        if _is_number(cell) and value(cell) is None:
            return "a unit or mark behind a number is not read; [format] missing has what stands for a missing one"
        if self.lines[i] != table.line or any(_is_number(each) for each in self._rows[i]):
            return "what stands for a missing one belongs into [format] missing, or into missing at one signal"
        if table.header == [str(number + 1) for number in range(len(table.header))]:
            return "if the row is a header, leave [format] header = false out"
        if table.unit_row:
            return "of more rows before the numbers [format] says header = false and skip_rows, and columns are numbers"
        return 'of a row of units [format] says unit_row = "take" or "skip"'


def _is_number(cell: str) -> bool:
    """Whether a cell begins as a number does."""
    return cell.strip().lstrip("+-.")[:1].isdigit()


class _Plain:
    """Rows that pyarrow has read."""

    def __init__(self, columns: dict[int, pa.ChunkedArray], lines: np.ndarray) -> None:
        self._columns, self.lines = columns, lines

    def numbers(self, position: int, missing: frozenset[str]) -> np.ndarray:
        """(n,) numbers of a column, NaN for a missing one."""
        return self._columns[position].to_numpy()

    def texts(self, position: int) -> list[str]:
        """n texts of a column."""
        return self._columns[position].to_pylist()


def _plain(table: TableText, block: str, line: int, wants: Sequence[Want]) -> _Plain | None:
    """The rows of a block as pyarrow reads them; None if it cannot, or not for certain."""
    numeric = {want.position for want in wants if isinstance(want, Numbers)}
    others = [want for want in wants if not isinstance(want, Numbers)]
    textual = {i for want in others for i in (want.positions if isinstance(want, Times) else (want.position,))}
    if numeric & textual:
        return None
    delimiter, data = table.delimiter, block.encode()
    if delimiter == BLANK:
        delimiter, data = " ", _narrowed(data)
    if b"+" in data and not textual:
        data = _unsigned(data, delimiter.encode())
    ends = np.flatnonzero(np.frombuffer(data, np.uint8) == _NEWLINE)
    lengths = np.diff(ends, prepend=-1) - 1
    if not (delimiter + table.decimal).isascii() or lengths.max(initial=0) > MAX_LETTERS or delimiter == table.decimal:
        return None
    if not (filled := np.flatnonzero(lengths)).size:
        return _Plain({i: pa.chunked_array([[]], pa.float64()) for i in (*numeric, *textual)}, filled)
    first = data[ends[filled[0] - 1] + 1 if filled[0] else 0 : ends[filled[0]]]
    count = len(next(split(iter([first.decode()]), table.delimiter)))
    if count == 1 and b'"' in data:
        return None  # an empty cell, which is no row
    try:
        extra = table.fits(count)
    except RecordingError:
        return None
    columns = _arrow(data, delimiter, table.decimal, count, numeric, textual, extra, _words(wants))
    if columns is None or any(len(column) != len(filled) for column in columns.values()):
        return None
    if any(i >= count for i in (*numeric, *textual)):
        return None
    if any(cell.strip() for i in range(count - extra, count) for cell in columns[i].unique().to_pylist()):
        return None
    if any(not np.isfinite(columns[i].drop_null().to_numpy()).all() for i in numeric):
        return None  # inf for a number that is too large, or a form of NaN that nobody has asked for
    return _Plain(columns, line + filled)


def _arrow(
    data: bytes, delimiter: str, decimal: str, count: int, numeric: set[int], textual: set[int], extra: int,
    words: list[str],
) -> dict[int, pa.ChunkedArray] | None:  # fmt: skip
    """Columns by their place; None if anything is unusual."""
    types = {i: pa.float64() for i in numeric} | {i: pa.string() for i in textual}
    types |= {i: pa.string() for i in range(count - extra, count)}
    quote = False if delimiter == " " else '"'
    types = {i: kind for i, kind in types.items() if i < count} or {0: pa.string()}
    try:
        found = pacsv.read_csv(
            pa.py_buffer(data),
            pacsv.ReadOptions(use_threads=False, block_size=len(data) + 1, column_names=[str(i) for i in range(count)]),
            pacsv.ParseOptions(delimiter=delimiter, quote_char=quote, ignore_empty_lines=True),
            pacsv.ConvertOptions(
                column_types={str(i): kind for i, kind in types.items()},
                include_columns=[str(i) for i in types],
                null_values=words,
                decimal_point=decimal,
            ),
        )
    except pa.ArrowException:
        return None
    return {i: found.column(str(i)) for i in types}


def _words(wants: Sequence[Want]) -> list[str]:
    """Texts for a missing number in every column that is asked for, as they are mostly written."""
    sets = [want.missing for want in wants if isinstance(want, Numbers)]
    common = MISSING.union(frozenset.intersection(*sets) if sets else ())
    return sorted({form for word in common for form in (word, word.upper(), word.capitalize())} | {"NaN", "-NaN"})


def _unsigned(data: bytes, delimiter: bytes) -> bytes:
    """Without the plus before numbers, which pyarrow takes for none."""
    if _NO_SIGN.search(data):
        return data
    data = data.replace(delimiter + b"+", delimiter).replace(b"\n+", b"\n")
    return data.removeprefix(b"+")


def _narrowed(data: bytes) -> bytes:
    """With one blank where there are several, and none at the ends of lines."""
    data = data.replace(b"\t", b" ")
    while b"  " in data:
        data = data.replace(b"  ", b" ")
    return data.replace(b"\n ", b"\n").replace(b" \n", b"\n").removeprefix(b" ")
