"""How much memory a column of a Parquet file takes, found without decoding it.

The footer of a file may claim anything. What a reader allocates follows from the header of each page: the size that the
page is decompressed to, and the number of values in it, which a run of equal values can make huge in a few bytes. So
footer and headers are read here, which the Parquet format writes as structs in Thrift's compact protocol. (Asking
pyarrow for the footer's content would not do: it ends the process when statistics in it are damaged.)
"""

from dataclasses import dataclass
from typing import Any

from soro_bench.recording.recording import RecordingError

BYTES_PER_VALUE = 12  # a number of 8 bytes and two levels
_BYTES_PER_PAGE = 1000  # for what an empty one costs too
_MAX_HEADER = 100_000  # bytes of a page's; grows some seventyfold in memory
_MAX_DEPTH = 10
_MAX_SIZE = 2**62
# fields of the structs, as numbered by the format
_FILE_ROWS, _FILE_GROUPS = 3, 4
_GROUP_COLUMNS, _GROUP_ROWS = 1, 3
_COLUMN_FILE, _COLUMN_ABOUT = 1, 3
_NUM_VALUES, _COMPRESSED, _DATA_PAGE, _DICTIONARY_PAGE = 5, 7, 9, 11
_PAGE_UNCOMPRESSED, _PAGE_COMPRESSED, _PAGE_DICTIONARY, _PAGES_OF_DATA = 2, 3, 7, (5, 8)


@dataclass(frozen=True)
class Column:
    """Where the pages of one column of one row group are."""

    start: int  # bytes from the beginning of the file
    end: int
    num_values: int


@dataclass(frozen=True)
class Footer:
    """What a footer says of a file's size."""

    num_rows: int
    group_rows: list[int]
    groups: list[list[Column]]  # columns of each row group


def read_footer(data: bytes, start: int, end: int) -> Footer:
    """Parse the footer in ``data[start:end]``; RecordingError if it is not consistent."""
    file = _Thrift(data, start, end).struct()
    groups = _list(file, _FILE_GROUPS)
    footer = Footer(
        _size(file, _FILE_ROWS),
        [_size(group, _GROUP_ROWS) for group in groups],
        [[_column(column, start) for column in _list(group, _GROUP_COLUMNS)] for group in groups],
    )
    if sum(footer.group_rows) != footer.num_rows:
        raise RecordingError("the rows of the footer do not add up")
    return footer


def decoded_bytes(data: bytes, column: Column) -> int:
    """About how many bytes reading a column of numbers takes; ``data`` is the whole file.

    Raises:
        RecordingError: the pages do not hold what the footer says.
    """
    total = values = 0
    position = column.start
    while position < column.end:
        header = _Thrift(data, position, min(column.end, position + _MAX_HEADER))
        page = header.struct()
        count = sum(_size(page[i], 1) for i in _PAGES_OF_DATA if i in page)
        values += count
        if _PAGE_DICTIONARY in page:
            count += _size(page[_PAGE_DICTIONARY], 1)
        total += _size(page, _PAGE_UNCOMPRESSED) + BYTES_PER_VALUE * count + _BYTES_PER_PAGE
        position = header.position + _size(page, _PAGE_COMPRESSED)
    if position != column.end or values != column.num_values:
        raise RecordingError("the pages of a column are not as the footer says")
    return total


def _column(column: Any, footer_start: int) -> Column:
    about = column.get(_COLUMN_ABOUT) if isinstance(column, dict) else None
    if not isinstance(about, dict) or _COLUMN_FILE in column:
        raise RecordingError("a column lies in another file or is encrypted")
    start = _size(about, _DATA_PAGE)
    if 0 < about.get(_DICTIONARY_PAGE, 0) < start:
        start = about[_DICTIONARY_PAGE]
    end = start + _size(about, _COMPRESSED)
    if not 4 <= start <= end <= footer_start:
        raise RecordingError("a column lies outside the file")
    return Column(start, end, _size(about, _NUM_VALUES))


def _size(struct: object, number: int) -> int:
    size = struct.get(number) if isinstance(struct, dict) else None
    if type(size) is not int or not 0 <= size < _MAX_SIZE:
        raise _invalid()
    return size


def _list(struct: object, number: int) -> list:
    found = struct.get(number) if isinstance(struct, dict) else None
    if not isinstance(found, list):
        raise _invalid()
    return found


def _invalid() -> RecordingError:
    return RecordingError("its structure is damaged")


class _Thrift:
    """Reads one struct of Thrift's compact protocol: integers, lists and structs by field number."""

    def __init__(self, data: bytes, position: int, end: int) -> None:
        self._data, self.position, self._end = data, position, end

    def struct(self, depth: int = 0) -> dict:
        """Values by field number; what is neither integer, list nor struct is None."""
        if depth > _MAX_DEPTH:
            raise _invalid()
        fields, number = {}, 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            if number in fields or not 0 < number < 2**15:  # other readers would take another of them
                raise _invalid()
            # true and false have no bytes of their own
            fields[number] = None if head & 15 in (1, 2) else self._value(head & 15, depth)
        return fields

    def _value(self, kind: int, depth: int) -> int | list | dict | None:
        if kind in (1, 2, 3):
            self._skip(1)
            return None
        if kind in (4, 5, 6):
            return self._integer()
        if kind in (7, 8):  # a double, or bytes behind their number
            self._skip(8 if kind == 7 else self._varint())
            return None
        if kind == 9:
            return self._list(depth)
        if kind == 12:
            return self.struct(depth + 1)
        raise _invalid()  # sets and maps are not in the format

    def _list(self, depth: int) -> list:
        head = self._byte()
        count = head >> 4 if head >> 4 < 15 else self._varint()
        if count > self._end - self.position or depth > _MAX_DEPTH:  # an entry has a byte at least
            raise _invalid()
        return [self._value(head & 15, depth + 1) for _ in range(count)]

    def _byte(self) -> int:
        self._skip(1)
        return self._data[self.position - 1]

    def _skip(self, count: int) -> None:
        self.position += count
        if self.position > self._end:
            raise _invalid()

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise _invalid()

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
