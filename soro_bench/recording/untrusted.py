"""Files from strangers: bounded size, and one kind of error whatever is wrong with them."""

import csv
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from soro_bench import files
from soro_bench.recording.recording import RecordingError

MAX_BYTES = 200_000_000  # of a file
EXPANSION = 4  # decoded bytes per byte that a file may have
MAX_ROWS = 10_000_000
MAX_COLUMNS = 5000
_BROKEN = (
    OSError, ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError, RecursionError, csv.Error,
    struct.error, pa.ArrowException,
)  # fmt: skip


@contextmanager
def named_errors(path: str | Path) -> Iterator[None]:
    """Turn every error that bad content can cause into a RecordingError that names the file."""
    try:
        yield
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error
    except _BROKEN as error:
        raise RecordingError(f"{path} cannot be read: {type(error).__name__}: {str(error)[:200]}") from error


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """The content of a regular file; FileNotFoundError, or RecordingError if it is no file or too large."""
    try:
        return files.read_bytes(path, max_bytes)
    except ValueError as error:
        raise RecordingError(str(error)) from error
