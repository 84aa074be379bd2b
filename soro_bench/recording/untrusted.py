"""Files from strangers: bounded size, and one kind of error whatever is wrong with them."""

import csv
import os
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from soro_bench.recording.recording import RecordingError

MAX_BYTES = 200_000_000  # of a file
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
    # without waiting for a writer, if it is a pipe
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb") as file:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise RecordingError(f"{path} is no regular file")
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise RecordingError(f"{path} has more than {max_bytes} bytes, which is what is read at most")
    return data
