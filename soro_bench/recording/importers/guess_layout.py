"""How a table of text seems to be laid out: encoding, delimiter, decimal mark, header, units."""

import csv
import re
from bisect import bisect
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from soro_bench.recording.importers.clock import is_stamp
from soro_bench.recording.importers.table_text import BLANK, MISSING, TableText, decoded, plain, read_text, split
from soro_bench.recording.importers.units import of_text
from soro_bench.recording.recording import RecordingError

_HEAD = 4_000_000  # bytes that are looked at
_TRIED = 200  # lines of which the delimiter is tried
_ROWS = 20_000  # rows that are looked at
_DELIMITERS = (",", ";", "\t", "|", BLANK)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_DATE = re.compile(r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[./-]\w{1,3}[./-]\d{4}")
_TYPE = re.compile(r"(float|double|single|real|u?int|long|bool(ean)?|str(ing)?|object)\d*")
_JAPANESE = re.compile(r"[\u3040-\u30ff\u4e00-\u9fff]{2,}")
_SURE = 0.8  # of all cells are numbers in rows of one length: blanks delimit nothing
_PAIRS = 10  # rows of numbers in a header of names and values at most
_MOST = 0.5  # of the cells of a row of data that are numbers


@dataclass(frozen=True)
class Column:
    """What a column of the first rows holds.

    Args:
        label: its name as a mapping gives it: a text, or its number where that is the only one.
        name: as in the header; its number without one.
        unit: the text of the row of units; "" without one.
        numbers: (rows,) NaN where there is none.
        texts: (rows,) the cells.
        words: those that are neither a number nor known to be missing, and how often.
    """

    label: str | int
    name: str
    unit: str
    numbers: np.ndarray
    texts: list[str]
    words: Counter[str]

    @property
    def numeric(self) -> bool:
        """Whether most cells that say something are numbers."""
        return np.isfinite(self.numbers).sum() > sum(self.words.values())

    @property
    def stamped(self) -> bool:
        """Whether it holds times of day, with or without dates."""
        said = [text for text in self.texts[:_TRIED] if text.lower() not in MISSING]
        return bool(said) and all(map(is_stamp, said))

    @property
    def dated(self) -> bool:
        """Whether it holds dates only."""
        said = [text for text in self.texts[:_TRIED] if text.lower() not in MISSING]
        return bool(said) and all(_DATE.fullmatch(text) for text in said)


def layout(data: bytes) -> tuple[dict[str, Any], list[Column], list[str]]:
    """The entries of [format], the columns of a table and the lines above it; RecordingError if it looks like none."""
    head = data if len(data) <= _HEAD else data[: data.rfind(b"\n", 0, _HEAD) + 1] or data[:_HEAD]
    encoding = _encoding(head)
    text = decoded(head, encoding)
    options: dict[str, Any] = {} if encoding == "utf-8" else {"encoding": encoding}
    first = text.partition("\n")[0]
    excel = first.lower().startswith("sep=") and len(first) == 5
    lines = [line for line in text.split("\n")[1 if excel else 0 :][:_TRIED]]
    delimiter, decimal = (first[4], _best([first[4]], lines)[1]) if excel else _best(_DELIMITERS, lines)
    options |= {"delimiter": delimiter} if delimiter != "," and not excel else {}
    options |= {"decimal": decimal} if decimal != "." else {}
    rows = _cells(lines, delimiter)
    before, names = _rows_before(rows, decimal, delimiter)
    options |= before
    above = [" ".join(row) for row in rows[: before.get("skip_rows", 0)]]
    return options, _columns(read_text(head, options), names), above


def is_number(text: str, decimal: str) -> bool:
    """Whether a cell is a number or a truth value."""
    text = text.strip()
    return _NUMBER.fullmatch(plain(text, decimal)) is not None and (decimal == "." or "." not in text)


def _encoding(head: bytes) -> str:
    if head.startswith((b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff")):
        return "utf-32"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    for name, place in (("utf-16-le", 1), ("utf-16-be", 0)):
        if len(head) > 3 and head[place:200:2].count(0) > 0.8 * len(head[place:200:2]):
            return name
    for name in ("utf-8", "shift_jis", "cp1252"):
        try:
            text = decoded(head, name)
        except (RecordingError, UnicodeDecodeError):
            continue
        if name != "shift_jis" or _is_japanese(text):
            return name
    return "latin-1"


def _is_japanese(text: str) -> bool:
    """Whether most letters beyond ASCII are Japanese ones in a row; single ones come of western letters."""
    return 2 * sum(map(len, _JAPANESE.findall(text))) > sum(not letter.isascii() for letter in text)


def _cells(lines: list[str], delimiter: str) -> list[list[str]]:
    """The cells of each line; none where they cannot be told."""
    found = []
    for line in lines:
        try:
            rows = list(split(iter([line]), delimiter))
        except csv.Error:
            rows = []
        found.append([cell.strip() for cell in rows[0]] if rows else [])
    return found


def _good(cell: str, decimal: str) -> bool:
    return cell.lower() in MISSING or is_number(cell, decimal) or is_stamp(cell)


def _best(delimiters: Any, lines: list[str]) -> tuple[str, str]:
    """The delimiter and decimal mark with which most cells are numbers, in rows of one length."""
    found, best = (delimiters[0], "."), (-1.0, 0.0, 0)
    for delimiter in delimiters:
        rows = [row for row in _cells(lines, delimiter) if any(row)]
        if not rows or (delimiter == BLANK and best[0] > _SURE and best[1]):
            continue
        count = Counter(map(len, rows)).most_common(1)[0][0]
        cells = [cell for row in rows if len(row) == count for cell in row if cell]
        for decimal in (".", ","):
            if not cells:
                continue
            share = sum(_good(cell, decimal) for cell in cells) / len(cells)
            whole = sum(len(row) == count for row in rows) / len(rows)
            score = (round(share * whole, 2), float(count > 1), count)
            if score > best:
                best, found = score, (delimiter, decimal)
    return found


def _rows_before(rows: list[list[str]], decimal: str, delimiter: str) -> tuple[dict[str, Any], list[str]]:
    """What [format] says about the rows before the numbers, and names of columns that it cannot say."""
    filled = [row for row in rows if any(row)]
    if not filled:
        raise RecordingError("there are no rows")
    count = Counter(map(len, filled)).most_common(1)[0][0]
    numeric = _numeric([row for row in filled if abs(len(row) - count) <= 1], decimal)
    data = _first_data(rows, count, numeric, decimal)
    if data is None:
        raise RecordingError("no row of numbers is found; a table of text has rows of numbers between delimiters")
    if data + 1 < len(rows) and _is_counted(rows[data]) and not all(cell.isdigit() for cell in rows[data + 1]):
        return {"skip_rows": data} if data else {}, []  # a header of numbers
    if 0 in numeric and _counts_channels(rows[data]):
        data = next((i for i in range(data + 1, len(rows)) if _is_data(rows[i], numeric, decimal)), data)
    above = [i for i in range(data) if any(rows[i])]
    if delimiter == "," and above and _split_decimals(rows[above[-1]], rows[data]):
        raise RecordingError(f"{len(rows[above[-1]])} names stand above {len(rows[data])} cells; are these decimal "
                             "commas between commas? Export with semicolons or decimal points")  # fmt: skip
    if names := _names_further_up([rows[i] for i in above], rows[data], delimiter):
        return {"header": False, "skip_rows": data}, names
    if not above or not _names(rows[above[-1]], rows[data], delimiter):
        return {"header": False, **({"skip_rows": data} if data else {})}, []
    header, options = above[-1], {}
    if len(above) > 1 and _is_units(rows[above[-1]]) and _names(rows[above[-2]], rows[data], delimiter):
        header, options = above[-2], {"unit_row": "take"}
    return ({"skip_rows": header} if any(any(row) for row in rows[:header]) else {}) | options, []


def _names_further_up(above: list[list[str]], data: list[str], delimiter: str) -> list[str]:
    """The name of each column with its unit, where other rows stand between names and numbers; none if none do."""
    near = above[-2:-1] if above and _is_units(above[-1]) else above[-1:]
    headers = [i for i, row in enumerate(above) if _is_header(row, data)]
    if not headers or (near and _names(near[0], data, delimiter) and _fills(near[0], data) and not _is_typing(near[0])):
        return []
    rows = [row for row in above[headers[-1] :] if _names(row, data, delimiter) and not _is_typing(row)]
    units = next((row for row in rows if _is_units(row)), [])
    names = [_lowest([row for row in rows if row is not units], i) for i in range(len(data))]
    return [f"{name} [{units[i]}]" if units[i : i + 1] > [""] else name for i, name in enumerate(names)]


def _lowest(rows: list[list[str]], i: int) -> str:
    """What the last row says that says something in a column."""
    return next((row[i] for row in reversed(rows) if i < len(row) and row[i]), "")


def _is_header(row: list[str], data: list[str]) -> bool:
    """Whether a row surely has the names of the columns of a row of numbers."""
    return _filled(row) == _filled(data) and _fills(row, data) and not _is_units(row) and not _is_typing(row)


def _fills(row: list[str], data: list[str]) -> bool:
    """Whether a row names most columns in which a row of numbers says something."""
    return sum(map(bool, row)) > _MOST * sum(map(bool, data))


def _is_typing(row: list[str]) -> bool:
    """Whether a row has types of numbers, or lines that are drawn, instead of names."""
    return all(_TYPE.fullmatch(cell.lower()) or not any(map(str.isalnum, cell)) for cell in row)


def _first_data(rows: list[list[str]], count: int, numeric: list[int], decimal: str) -> int | None:
    """The first row of numbers: behind the last row of names that follows a few of them, as in a header of pairs."""
    found = [i for i, row in enumerate(rows) if abs(len(row) - count) <= 1 and _is_data(row, numeric, decimal)]
    first = found[0] if found else None
    for i, row in enumerate(rows):
        before = bisect(found, i)
        if 0 < before <= _PAIRS and before < len(found) and abs(len(row) - count) <= 1 and row not in rows[:i]:
            first = found[before] if _is_heading(row, decimal) else first
    return first


def _is_heading(row: list[str], decimal: str) -> bool:
    """Whether each cell that says something names another column."""
    said = [cell for cell in row if cell]
    return 1 < len(said) == len(set(said)) and not any(_good(cell, decimal) or _DATE.fullmatch(cell) for cell in said)


def _is_counted(row: list[str]) -> bool:
    """Whether cells count the columns from 0, as programs write that know no names; there may be one of the index."""
    said = row if all(row) else row[1:]
    return len(said) > 2 and said == [str(i) for i in range(len(said))]


def _counts_channels(row: list[str]) -> bool:
    """Whether cells behind a name count from 1, as the channels of an oscilloscope do."""
    name, *others = row[: _filled(row)]
    return any(map(str.isalpha, name)) and others == [str(i + 1) for i in range(len(others))] != []


def _split_decimals(names: list[str], cells: list[str]) -> bool:
    """Whether two whole numbers stand under each name."""
    whole = all(cell.removeprefix("-").isdigit() for cell in cells)
    return len(names) > 1 and len(cells) == 2 * len(names) and whole and all(any(map(str.isalpha, n)) for n in names)


def _names(header: list[str], row: list[str], delimiter: str) -> bool:
    """Whether a header names the columns of a row; delimiters at the end of either do not count."""
    mark = delimiter == BLANK and header[:1] in (["#"], ["%"])
    return min(abs(len(header) - mark - len(row)), abs(_filled(header) - mark - _filled(row))) <= 1


def _filled(row: list[str]) -> int:
    """How many cells there are up to the last one that says something."""
    return max((i + 1 for i, cell in enumerate(row) if cell), default=0)


def _numeric(rows: list[list[str]], decimal: str) -> list[int]:
    """The columns that are numbers or times in most rows."""
    found = []
    for i in range(max(map(len, rows), default=0)):
        said = [row[i] for row in rows if i < len(row) and row[i]]
        good = sum(is_number(cell, decimal) or is_stamp(cell) for cell in said)
        found += [i] if good > _MOST * len(said) else []
    return found


def _is_data(row: list[str], numeric: list[int], decimal: str) -> bool:
    """Whether most cells of a row are numbers where they are expected."""
    said = [row[i] for i in numeric if i < len(row) and row[i]]
    good = sum(is_number(cell, decimal) or is_stamp(cell) for cell in said)
    return good > 0 and good > _MOST * len(said)


def _is_units(row: list[str]) -> bool:
    said = [cell for i, cell in enumerate(row) if cell and not (i == 0 and cell in "#%")]
    return sum(of_text(cell) is not None for cell in said) > _MOST * len(said)


def _columns(table: TableText, names: list[str]) -> list[Column]:
    """The columns of the first rows; ``names`` where the header says none."""
    rows: list[list[str]] = []
    for row in table.rows(table.lines()):
        if any(cell.strip() for cell in row):
            rows.append([cell.strip() for cell in row] + [""] * (len(table.header) - len(row)))
        if len(rows) == _ROWS:
            break
    found = []
    for i, title in enumerate(table.header):
        texts = [row[i] for row in rows]
        good = [is_number(text, table.decimal) for text in texts]
        numbers = [float(plain(text, table.decimal)) if ok else np.nan for text, ok in zip(texts, good, strict=True)]
        words = Counter(text for text, ok in zip(texts, good, strict=True) if not ok and text.lower() not in MISSING)
        title, name = (text.lstrip("#% ") if i == 0 else text for text in (title, names[i] if names else title))
        label = title if title and table.header.count(table.header[i]) == 1 else i + 1
        units = table.units[i] if i < len(table.units) else ""
        found.append(Column(label, name, units, np.array(numbers), texts, words))
    return found
