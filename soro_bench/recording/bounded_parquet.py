"""Parquet files from strangers, in bounded memory."""

import itertools
import struct
from collections.abc import Sequence

import pyarrow as pa
import pyarrow.parquet as pq

from soro_bench.recording.parquet_pages import Column, Footer, decoded_bytes, read_footer
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_COLUMNS, MAX_ROWS

_MAX_ROW_GROUPS = 10_000
MAX_FOOTER = 1_000_000  # bytes; grows some hundredfold in memory
_MAX_DEPTH = 20  # of the schema
_NUMBERS = {"BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE"}
_MAGIC = b"PAR1"


class BoundedParquet:
    """A Parquet file in memory, of which some columns of numbers can be read.

    Args:
        data: the file; it may decode to four times ``max_bytes``.
        max_footer: bytes.

    Raises:
        RecordingError, or what ``named_errors`` turns into one.
    """

    def __init__(self, data: bytes, max_bytes: int = MAX_BYTES, max_footer: int = MAX_FOOTER) -> None:
        self._data, self._budget, self._footer = data, EXPANSION * max_bytes, _footer(data, max_footer)
        self.num_row_groups = len(self._footer.groups)
        for label, count, most in (
            ("rows", self._footer.num_rows, MAX_ROWS),
            ("columns", max(map(len, self._footer.groups), default=0), MAX_COLUMNS),
            ("row groups", self.num_row_groups, _MAX_ROW_GROUPS),
        ):
            if count > most:
                raise RecordingError(f"{count} {label}; at most {most} are read")
        self._file = pq.ParquetFile(
            pa.BufferReader(data),
            pre_buffer=False,
            thrift_string_size_limit=max_footer,
            thrift_container_size_limit=2 * _MAX_ROW_GROUPS,
            schema_depth_limit=_MAX_DEPTH,
            page_checksum_verification=True,
            arrow_extensions_enabled=False,
        )
        self.schema = self._file.schema_arrow
        names = self.schema.names
        if any(len(group) != len(self._file.schema) for group in self._footer.groups):
            raise RecordingError("a row group has not all columns")
        if len(names) > MAX_COLUMNS:  # without a row group the footer does not count them
            raise RecordingError(f"{len(names)} columns; at most {MAX_COLUMNS} are read")
        if len(set(names)) < len(names):
            raise RecordingError("two columns have the same name")
        sizes = [_num_leaves(field.type) for field in self.schema]
        firsts = [0, *itertools.accumulate(sizes)]
        self._leaves = dict(zip(names, zip(firsts, sizes, strict=False), strict=True))  # the first leaf below a field

    def read(self, names: Sequence[str], row_groups: Sequence[int] | None = None) -> pa.Table:
        """Columns of numbers, or of lists of numbers, of some row groups (all by default)."""
        row_groups = range(self.num_row_groups) if row_groups is None else row_groups
        leaves = [self._leaf(name) for name in names]
        for group in row_groups:
            for leaf in leaves:
                self._spend(self._footer.groups[group][leaf])
        table = self._file.reader.read_row_groups(list(row_groups), column_indices=leaves, use_threads=False)
        table.validate(full=True)
        if table.num_rows != sum(self._footer.group_rows[group] for group in row_groups) or sorted(
            table.schema.names
        ) != sorted(names):
            raise RecordingError("the content is not as the footer says")
        return table

    def _leaf(self, name: str) -> int:
        """Index of the one column of numbers below a field."""
        if name not in self._leaves:
            raise RecordingError(f"no column {name!r}; there are {', '.join(self.schema.names[:20])}")
        first, size = self._leaves[name]
        if size != 1 or self._file.schema.column(first).physical_type not in _NUMBERS:
            kind = str(self.schema.field(name).type)[:80]
            raise RecordingError(f"column {name!r} has type {kind}; expected numbers or lists of them")
        return first

    def _spend(self, column: Column) -> None:
        self._budget -= decoded_bytes(self._data, column)
        if self._budget < 0:
            raise RecordingError("decoding it would take more memory than its largest size allows")


def _footer(data: bytes, most: int) -> Footer:
    """Its length is known before it is parsed."""
    if len(data) < 12 or data[:4] != _MAGIC or data[-4:] != _MAGIC:
        raise RecordingError("no complete Parquet file; soro-bench import makes one of tables and logs")
    (size,) = struct.unpack("<I", data[-8:-4])
    most = min(len(data) - 12, most)
    if not 0 < size <= most:
        raise RecordingError(f"a footer of {size} bytes; expected at most {most}")
    return read_footer(data, len(data) - 8 - size, len(data) - 8)


def _num_leaves(kind: pa.DataType) -> int:
    if pa.types.is_nested(kind):
        return sum(_num_leaves(kind.field(i).type) for i in range(kind.num_fields))
    return 1
