"""The text of a table: its encoding, delimiter, header and units, and where its rows end."""

import codecs
import csv
import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from soro_bench.recording.importers.mapping import typed
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import MAX_COLUMNS, MAX_ROWS

FORMAT = ("delimiter", "decimal", "encoding", "skip_rows", "header", "unit_row", "missing", "label", "only")
BLANK = "blank"  # the delimiter of columns that are separated by one or more blanks or tabs
ENCODINGS = (
    "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "ascii", "latin-1", "iso-8859-15", "mac-roman",
    "cp437", "cp850", "cp1250", "cp1251", "cp1252", "cp1253", "cp1254", "cp1257", "koi8-r", "shift_jis", "euc_jp",
    "euc_kr", "gbk", "gb18030", "big5",
)  # fmt: skip
MISSING = frozenset((
    "", "nan", "+nan", "-nan", "nan(ind)", "-nan(ind)", "-nan(snan)", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind",
    "1.#inf", "-1.#inf", "1.#qnan0", "-1.#qnan0", "1.#ind00", "-1.#ind00", "1.#inf00", "-1.#inf00",
    "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity", "na", "n/a", "#n/a", "<na>", "n. def.",
    "null", "none", "#div/0!", "#value!", "#ref!", "#num!", "#name?", "#null!",
    "#nv", "#wert!", "#bezug!", "#zahl!", "#n/d", "#valeur!", "#nombre!", "#nom?", "#nul!",
))  # fmt: skip
MAX_LETTERS = 1_000_000  # of a row, as every cell of it is a text of its own before they are counted
_SEP = re.compile(r"sep=(.)\n?", re.IGNORECASE)  # the first line of what Excel writes
_MOST_INTERRUPTIONS = 100_000  # lines of comments, or of the header again, between the rows
_LOOKED_AT = 1000  # lines before the last one, that it is compared with
# by the bytes that a file begins with
_PACKED = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip, such as an Excel workbook", b"\x28\xb5\x2f\xfd": "zstd"}
_WIDE = 0.3  # of the bytes of text are zeros, where each letter takes two
_TRUTHS = {
    **dict.fromkeys(("true", "wahr", "vrai", "on", "yes", "ja", "oui"), "1"),
    **dict.fromkeys(("false", "falsch", "faux", "off", "no", "nein", "non"), "0"),
}
_MINUS = str.maketrans("\u2212\u2013", "--")  # that office programs write before numbers
_FORTRAN = re.compile(r"([+-]?(?:\d+\.\d*|\.\d+))[dD]([+-]?\d{1,3})")  # a number of double precision
_GROUPED = re.compile(r"[+-]?\d{1,3}((,\d{3})+(\.\d+)?|(\.\d{3})+(,\d+)?|(['\u2019\s]\d{3})+([.,]\d+)?)")
_HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]{1,13}")
_ZERO, _END = "\x00", "\x1a"  # where the power was lost; the end of a file in DOS


@dataclass(frozen=True)
class TableText:
    """The rows of a table after its header, each with a line end."""

    text: str
    start: int  # where the rows begin in it
    line: int  # of the file, where they begin
    header: list[str]
    units: list[str]  # the texts of a row of units; none without one
    delimiter: str
    decimal: str
    note: str  # what has been left out at the end
    unit_row: bool = False  # whether a row after the header is taken for units, or skipped

    def lines(self) -> "Lines":
        """The lines of all rows."""
        return Lines(self.text, self.start, self.line - 1)

    def rows(self, lines: Iterator[str]) -> Iterator[list[str]]:
        """The cells of each row; an empty line has none."""
        for row in split(lines, self.delimiter):
            if isinstance(lines, Lines):
                lines.begin_row()
            yield row

    def fits(self, count: int) -> int:
        """By how many nameless columns a row of ``count`` cells is longer than the header, which have to be empty.

        RecordingError if it is too short.
        """
        named = len(self.header)
        while named > count and not self.header[named - 1]:
            named -= 1
        if named > count:
            raise RecordingError(f"{count} cells; expected {len(self.header)}")
        return max(count - len(self.header), 0)

    def position(self, name: Any) -> int:
        """Where a column is, from its name or from its number, which counts from 1."""
        if type(name) is int:
            if not 1 <= name <= len(self.header):
                raise RecordingError(f"there is no column {name}; there are 1 to {len(self.header)}")
            return name - 1
        found = [i for i, column in enumerate(self.header) if column == name]
        if not found and self.header[0].lstrip("#% ") == name:  # a header that is a comment elsewhere
            found = [0]
        if len(found) == 1:
            return found[0]
        there = ", ".join(ascii(column)[1:-1] for column in self.header)[:200]
        called = f"called {ascii(name)[:80]}; there {'is' if len(self.header) == 1 else 'are'} {there}"
        if not found:
            odd = len(self.header) == 1 or not any(letter.isalpha() for column in self.header for letter in column)
            hint = "; are [format] delimiter, skip_rows and header right?" if odd else ""
            raise RecordingError(f"no column is {called}{hint}")
        numbers = ", ".join(str(i + 1) for i in found)
        raise RecordingError(f"{len(found)} columns are {called}; choose one by its number, without quotes: {numbers}")


def read_text(data: bytes, options: Mapping[str, Any]) -> TableText:
    """The text of a file; RecordingError says what is wrong with it or with [format]."""
    label = "[format]"
    text = decoded(data, typed(label, options, "encoding", "utf-8"))
    decimal, skip = typed(label, options, "decimal", "."), typed(label, options, "skip_rows", 0)
    if not 0 <= skip <= MAX_ROWS:
        raise RecordingError(f"{label} skip_rows = {skip}; expected 0 to {MAX_ROWS}")
    has_header, unit_row = typed(label, options, "header", True), typed(label, options, "unit_row", "")
    if unit_row not in ("", "take", "skip") or (unit_row and not has_header):
        raise RecordingError(f'{label} unit_row = {unit_row!r}; expected "take" or "skip", of the row after a header')
    text, note = _without_end(text)
    delimiter, lines = _delimiter(text, options, skip), Lines(text)
    if len(decimal) != 1 or delimiter in ("\n", "\r", '"') or (len(delimiter) != 1 and delimiter != BLANK):
        raise RecordingError(f"{label} delimiter {delimiter!r} and decimal {decimal!r}: one letter each, or {BLANK!r}")
    for _ in range(skip or (1 if _SEP.match(text) else 0)):
        lines.skip()
    before = lines.position, lines.count
    first = _first(lines, delimiter)
    if not first:
        raise RecordingError("there are no rows; is the file empty, or [format] skip_rows too large?")
    if not 1 <= len(first) <= MAX_COLUMNS:
        raise RecordingError(f"{len(first)} columns; expected 1 to {MAX_COLUMNS}")
    if not has_header:
        first, (lines.position, lines.count) = [str(i + 1) for i in range(len(first))], before
    units = _first(lines, delimiter) if unit_row else []
    if any(units) and _has_numbers([cell for cell in units if cell]):
        raise RecordingError(f"{label} unit_row = {unit_row!r}, and the row after the header has numbers; leave it out")
    units += [""] * (len(first) - len(units))
    head = text[before[0] : lines.position].split("\n") if has_header else []
    table = TableText(
        text,
        lines.position,
        lines.count + 1,
        first,
        units[: len(first)] if unit_row == "take" else [],
        delimiter,
        decimal,
        note,
        bool(unit_row),
    )
    return _without_cut_line(_without_interruptions(table, {line for line in head if any(map(str.isalpha, line))}))


def _has_numbers(cells: list[str]) -> bool:
    """Whether most cells are numbers that mean no unit, as 1 does, or all cells are numbers."""
    numbers = [number for cell in cells if (number := value(cell)) is not None]
    return len(numbers) == len(cells) or 2 * sum(number != 1 for number in numbers) > len(cells)


def decoded(data: bytes, encoding: str) -> str:
    """Text with the line ends of Unix; RecordingError names the entry that is wrong."""
    codec = _codec(encoding)
    if kind := next((kind for begin, kind in _PACKED.items() if data.startswith(begin)), ""):
        raise RecordingError(f"is no text but packed ({kind}); unpack it, or save it as CSV")
    try:
        text = data.decode(codec)
    except UnicodeDecodeError as error:
        if (
            error.start == 0
            or len(data) - error.start > 3
            or error.reason not in ("unexpected end of data", "truncated data")
        ):
            raise RecordingError(_undecodable(data, encoding, error)) from error
        text = data[: error.start].decode(codec)  # cut within a letter
    text = text.removeprefix("\ufeff")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    if (zero := text.rstrip(_ZERO).find(_ZERO)) >= 0:
        wide = 'of text of two bytes a letter [format] says encoding = "utf-16"'
        hint = wide if text.count(_ZERO) > _WIDE * len(text) else "the file is damaged there; keep the lines before it"
        line = text.count("\n", 0, zero) + 1
        raise RecordingError(f"zero bytes in line {line}; {hint}")
    return text


def _codec(encoding: str) -> str:
    """Python's name of an encoding of texts; others could run code, or take memory without bound."""
    try:
        name = codecs.lookup(encoding).name
    except (LookupError, ValueError):
        name = ""
    if name not in {codecs.lookup(known).name for known in ENCODINGS}:
        raise RecordingError(f"[format] encoding = {ascii(encoding)[:40]}; expected one of {', '.join(ENCODINGS)}")
    return name


def _undecodable(data: bytes, encoding: str, error: UnicodeDecodeError) -> str:
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    advice = '"utf-16"' if wide else '"cp1252" (Windows in western Europe), "utf-16" or another'
    line = data.count(b"\n", 0, error.start) + 1
    byte = f"byte 0x{data[error.start]:02x} in line {line}"
    return f"cannot be read as {encoding}: {byte}; write [format] encoding = {advice}"


def _without_end(text: str) -> tuple[str, str]:
    """Without what is no text at the end, and what there is to say."""
    kept = text.rstrip(_ZERO + _END)
    zeros = text.count(_ZERO, len(kept))
    return kept, f"{zeros} zero bytes at its end are left out" if zeros else ""


def _delimiter(text: str, options: Mapping[str, Any], skip: int) -> str:
    found, said = _SEP.match(text), typed("[format]", options, "delimiter", ",")
    if not found or skip:
        return said
    if "delimiter" in options and said != found[1]:
        raise RecordingError(f"[format] delimiter = {said!r}, and the first line of the file says sep={found[1]}")
    return found[1]


def split(lines: Iterator[str], delimiter: str) -> Iterator[list[str]]:
    """The cells of each row."""
    if delimiter == BLANK:
        return (line.split() for line in lines)
    return csv.reader(lines, delimiter=delimiter, strict=True)


class Lines:
    """The lines of a text, of which a quoted cell may join several to a row of at most MAX_LETTERS."""

    def __init__(self, text: str, position: int = 0, count: int = 0) -> None:
        self._text, self.position, self.count = text, position, count
        self._letters = 0

    def __iter__(self) -> "Lines":
        return self

    def __next__(self) -> str:
        if self.position >= len(self._text):
            raise StopIteration
        end = self._text.find("\n", self.position) + 1 or len(self._text)
        self._letters += end - self.position
        self.count += 1
        if self._letters > MAX_LETTERS:
            raise RecordingError(f"the row in line {self.count} has more than {MAX_LETTERS} letters")
        line, self.position = self._text[self.position : end], end
        return line

    def begin_row(self) -> None:
        """Count letters anew."""
        self._letters = 0

    def skip(self) -> None:
        """Leave a line out, however long it is."""
        self.position = self._text.find("\n", self.position) + 1 or len(self._text)
        self.count += 1


def _first(lines: Lines, delimiter: str) -> list[str]:
    """The next row that is not empty, without the sign of a comment in a cell of its own."""
    for row in split(lines, delimiter):
        lines.begin_row()
        if any(cell.strip() for cell in row):
            cells = [cell.strip() for cell in row]
            return cells[1:] if delimiter == BLANK and cells[0] in ("#", "%") else cells
    return []


def _without_interruptions(table: TableText, head: set[str]) -> TableText:
    """Without comments between the rows, and lines of the header again where a log was started anew.

    The lines stay, empty, so that others keep their numbers.
    """
    text = table.text
    again = (start for line in head for start in _line_starts(text, table.start, f"{line}\n"))
    comments = (start for mark in "#%" for start in _line_starts(text, table.start, mark) if _comment(table, start))
    starts = set(itertools.islice(itertools.chain(again, comments), _MOST_INTERRUPTIONS + 1))
    if len(starts) > _MOST_INTERRUPTIONS:
        raise RecordingError(f"more than {_MOST_INTERRUPTIONS} lines between the rows are comments, or the header "
                             "again; take them out")  # fmt: skip
    if not starts:
        return table
    pieces, position = [], 0
    for start in sorted(starts):
        pieces.append(text[position:start])
        position = _line_end(text, start)
    count = table.line + text.count("\n", table.start, min(starts))
    note = f"lines that are comments or repeat the header are left out: {len(starts)}, the first is line {count}"
    return replace(table, text="".join([*pieces, text[position:]]), note="; ".join(filter(None, (table.note, note))))


def _line_starts(text: str, start: int, begin: str) -> Iterator[int]:
    """Where lines after a start begin with a text."""
    position = text.find(f"\n{begin}", start - 1)
    while position >= 0:
        yield position + 1
        position = text.find(f"\n{begin}", position + 1)


def _line_end(text: str, start: int) -> int:
    """Where a line ends, before its line end."""
    end = text.find("\n", start)
    return end if end >= 0 else len(text)


def _comment(table: TableText, start: int) -> bool:
    """Whether a line, which begins as a comment does, does not fit as a row."""
    line = table.text[start : _line_end(table.text, start)]
    if '"' in line or len(line) > MAX_LETTERS:
        return False
    cells = next(table.rows(iter([line])))
    try:
        extra = table.fits(len(cells))
    except RecordingError:
        return cells[0].strip().lower() not in MISSING
    return any(cell.strip() for cell in cells[len(cells) - extra :])


def _without_cut_line(table: TableText) -> TableText:
    """Without a last line that may have been cut, as no line end follows it; else the line gets one."""
    text = table.text
    if len(text) == table.start or text.endswith("\n"):
        return table
    start = max(text.rfind("\n") + 1, table.start)
    last = text[start:]
    begin = start
    for _ in range(_LOOKED_AT):
        begin = max(text.rfind("\n", 0, max(begin - 1, 0)) + 1, table.start)
        if begin == table.start:
            break
    if not last.strip() or _complete(table, last, text[begin:start]):
        return replace(table, text=text + "\n")
    line = table.line + text.count("\n", table.start)
    note = f"line {line}, the last one, is left out: it has no line end and may be cut"
    return replace(table, text=text[:start], note="; ".join(filter(None, (table.note, note))))


def _complete(table: TableText, last: str, before: str) -> bool:
    """Whether a line has all cells, and its last cell is as long as those before it are.

    That is: as many decimals as all of them, or as many letters as the longest one.
    """
    try:
        (row,), others = table.rows(iter([last])), [row for row in table.rows(iter(before.split("\n"))) if row]
        table.fits(len(row))
    except (csv.Error, ValueError):
        return False
    if not others:
        return True
    cells = [row[len(row) - 1] for row in others]
    shapes = {_decimals(cell, table.decimal) for cell in cells}
    return shapes == {_decimals(row[-1], table.decimal)} != {""} or len(row[-1]) >= max(map(len, cells))


def _decimals(cell: str, decimal: str) -> str:
    """What follows the decimal point, of which only the form counts."""
    return re.sub(r"\d", "0", cell.partition(decimal)[2]).replace("-", "+")


def words(label: str, values: Any, least: int = 0) -> list[str]:
    """The texts of an entry such as missing or only: a list of texts and numbers, each once, or one of them.

    RecordingError for anything else, or fewer than ``least``.
    """
    listed = values if isinstance(values, list) else [values]
    found = [str(each) for each in listed if type(each) in (str, int, float)]
    if len(found) < max(least, len(listed)):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected a list of texts or numbers")
    if len(set(found)) < len(found):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected each once")
    return found


def value(word: str) -> float | None:
    """The finite number that a text is, with a decimal point or comma, if it is one."""
    try:
        found = float(word.replace(",", "."))
    except ValueError:
        return None
    return found if math.isfinite(found) else None


def is_grouped(cell: str) -> bool:
    """Whether a cell that is no number would be one without separators of thousands."""
    return _GROUPED.fullmatch(cell) is not None


def plain(cell: str, decimal: str) -> str:
    """A cell as Python writes a number or a truth value, 1 or 0, if it is one."""
    if cell.lower() in _TRUTHS:
        return _TRUTHS[cell.lower()]
    if _HEXADECIMAL.fullmatch(cell):
        return str(int(cell, 16))
    cell = cell.translate(_MINUS).replace(decimal, ".")
    return f"{found[1]}e{found[2]}" if (found := _FORTRAN.fullmatch(cell)) else cell
