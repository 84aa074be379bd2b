"""How much memory a column of a Parquet file takes, found without decoding it.

The footer of a file may claim anything. What a reader allocates follows from the header of each page: the size that the
page is decompressed to, and the number of values in it, which a run of equal values can make huge in a few bytes. So
the headers are read here, which the Parquet format writes as structs in Thrift's compact protocol.
"""

from soro_bench.recording.recording import RecordingError

_BYTES_PER_VALUE = 12  # a number of 8 bytes and two levels
_MAX_DEPTH = 4
_DATA_PAGES, _DICTIONARY_PAGE = (5, 8), 7  # fields of PageHeader


def decoded_bytes(data: bytes, column) -> int:
    """About how many bytes reading a column chunk takes.

    Args:
        data: the whole file.
        column: a pyarrow ColumnChunkMetaData of numbers.

    Raises:
        RecordingError: the pages do not lie in the file, or do not hold what the footer says.
    """
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < column.dictionary_page_offset < start:
        start = column.dictionary_page_offset
    end = start + column.total_compressed_size
    if not 4 <= start <= end <= len(data):
        raise RecordingError("a column lies outside the file")
    total = values = 0
    while start < end:
        header = _Thrift(data, start, end)
        page = header.struct()
        pages = [page[i] for i in _DATA_PAGES if isinstance(page.get(i), dict)]
        count = sum(_size(inner, 1) for inner in pages)
        values += count
        if isinstance(page.get(_DICTIONARY_PAGE), dict):
            count += _size(page[_DICTIONARY_PAGE], 1)
        total += _size(page, 2) + _BYTES_PER_VALUE * count
        start = header.position + _size(page, 3)
    if start != end or values != column.num_values:
        raise RecordingError("the pages of a column are not as the footer says")
    return total


def _size(struct: dict, number: int) -> int:
    size = struct.get(number)
    if type(size) is not int or not 0 <= size < 2**31:
        raise RecordingError("a page has an invalid header")
    return size


class _Thrift:
    """Reads one struct of Thrift's compact protocol: integers and structs by field number, the rest is skipped."""

    def __init__(self, data: bytes, position: int, end: int):
        self._data, self.position, self._end = data, position, end

    def struct(self, depth: int = 0) -> dict:
        if depth > _MAX_DEPTH:
            raise RecordingError("a page has an invalid header")
        fields, number = {}, 0
        while head := self._byte():
            number = number + (head >> 4) if head >> 4 else self._integer()
            if number in fields or not 0 < number < 2**15:  # other readers would take another of them
                raise RecordingError("a page has an invalid header")
            fields[number] = self._value(head & 15, depth)
        return fields

    def _value(self, kind: int, depth: int):
        if kind in (1, 2):  # true and false have no bytes of their own
            return None
        if kind == 3:
            return self._byte()
        if kind in (4, 5, 6):
            return self._integer()
        if kind in (7, 8):  # a double, or bytes behind their number
            return self._skip(8 if kind == 7 else self._varint())
        if kind == 12:
            return self.struct(depth + 1)
        raise RecordingError("a page has an invalid header")  # lists and maps are not in it

    def _byte(self) -> int:
        self._skip(1)
        return self._data[self.position - 1]

    def _skip(self, count: int) -> None:
        self.position += count
        if self.position > self._end:
            raise RecordingError("a page lies outside its column")

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise RecordingError("a page has an invalid header")

    def _integer(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
