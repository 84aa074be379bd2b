"""Parquet files from strangers, in bounded memory.

What a footer says of columns is not read: damaged statistics in it end the process (pyarrow 26). Its rows bound what a
column takes, and the memory that pyarrow gets bounds the rest, such as a list of millions in a few bytes.
"""

import itertools
import struct
from collections.abc import Sequence

import pyarrow as pa
import pyarrow.parquet as pq

from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_COLUMNS, MAX_ROWS, bounded_memory

BYTES_PER_VALUE = 12  # a number of 8 bytes and two levels
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
        self._budget = EXPANSION * max_bytes
        _check_ends(data, max_footer)
        with bounded_memory(self._budget):
            self._file = pq.ParquetFile(
                pa.BufferReader(data),
                pre_buffer=False,
                thrift_string_size_limit=max_footer,
                thrift_container_size_limit=2 * _MAX_ROW_GROUPS,
                schema_depth_limit=_MAX_DEPTH,
                page_checksum_verification=True,
                arrow_extensions_enabled=False,
            )
        about = self._file.metadata
        self.num_row_groups = about.num_row_groups
        for label, count, most in (
            ("rows", about.num_rows, MAX_ROWS),
            ("columns", about.num_columns, MAX_COLUMNS),
            ("row groups", self.num_row_groups, _MAX_ROW_GROUPS),
        ):
            if count > most:
                raise RecordingError(f"{count} {label}; at most {most} are read")
        groups = [about.row_group(i) for i in range(self.num_row_groups)]
        self._group_rows = [group.num_rows for group in groups]
        if sum(self._group_rows) != about.num_rows or any(rows < 0 for rows in self._group_rows):
            raise RecordingError("the rows of the footer do not add up")
        if any(group.num_columns != about.num_columns for group in groups):
            raise RecordingError("a row group has not all columns")
        self.schema = self._file.schema_arrow
        names = self.schema.names
        if len(set(names)) < len(names):
            raise RecordingError("two columns have the same name")
        sizes = [_num_leaves(field.type) for field in self.schema]
        firsts = [0, *itertools.accumulate(sizes)]
        self._leaves = dict(zip(names, zip(firsts, sizes, strict=False), strict=True))  # the first leaf below a field

    def read(self, names: Sequence[str], row_groups: Sequence[int] | None = None) -> pa.Table:
        """Columns of numbers, or of lists of numbers, of some row groups (all by default)."""
        row_groups = range(self.num_row_groups) if row_groups is None else row_groups
        leaves = [self._leaf(name) for name in names]
        rows = sum(self._group_rows[group] for group in row_groups)
        self._check(BYTES_PER_VALUE * rows * len(leaves))
        with bounded_memory(self._budget):
            table = self._file.reader.read_row_groups(list(row_groups), column_indices=leaves, use_threads=False)
            table.validate(full=True)
        if table.num_rows != rows or sorted(table.schema.names) != sorted(names):
            raise RecordingError("the content is not as the footer says")
        self._check(table.nbytes)
        self._budget -= table.nbytes
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

    def _check(self, size: int) -> None:
        if size > self._budget:
            raise RecordingError("decoding it would take more memory than its largest size allows")


def _check_ends(data: bytes, most: int) -> None:
    """The length of the footer is known before it is parsed."""
    if len(data) < 12 or data[:4] != _MAGIC or data[-4:] != _MAGIC:
        raise RecordingError("no complete Parquet file; soro-bench import makes one of tables and logs")
    (size,) = struct.unpack("<I", data[-8:-4])
    most = min(len(data) - 12, most)
    if not 0 < size <= most:
        raise RecordingError(f"a footer of {size} bytes; expected at most {most}")


def _num_leaves(kind: pa.DataType) -> int:
    if pa.types.is_nested(kind):
        return sum(_num_leaves(kind.field(i).type) for i in range(kind.num_fields))
    return 1
