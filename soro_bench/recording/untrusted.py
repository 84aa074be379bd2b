"""Files from strangers: bounded size, and one kind of error whatever is wrong with them."""

import csv
import os
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from soro_bench import files
from soro_bench.files import shown
from soro_bench.recording.recording import RecordingError

MAX_BYTES = 200_000_000  # of a file
EXPANSION = 4  # decoded bytes per byte that a file may have
MAX_ROWS = 10_000_000
MAX_COLUMNS = 5000
_SLACK = 64_000_000  # bytes that a decoder may need whatever it decodes: its own buffers, and a thread's stack
_STATUS = Path("/proc/self/statm")  # of Linux; its first number is the address space in pages
_ONE_LIMIT = threading.Lock()  # at a time, as it is one of the whole process
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
        if str(error).startswith(str(path)):  # a file of a folder, which has been named
            raise
        raise RecordingError(f"{path}: {error}") from error
    except _BROKEN as error:
        first = shown(str(error).strip().split("\n")[0][:200])  # libraries say more in further lines
        raise RecordingError(f"{path} cannot be read: {type(error).__name__}: {first}") from error


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """The content of a regular file; FileNotFoundError, or RecordingError if it is no file or too large."""
    try:
        return files.read_bytes(path, max_bytes)
    except ValueError as error:
        raise RecordingError(str(error)) from error


@contextmanager
def bounded_memory(most: int) -> Iterator[None]:
    """Refuse what would take more than about ``most`` further bytes: a small file may ask its decoder for gigabytes.

    The limit is one of the process (RLIMIT_AS), which Linux has; elsewhere the checks of each reader have to do.
    """
    if not _STATUS.exists():
        yield
        return
    import resource

    with _ONE_LIMIT:
        used = int(_STATUS.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        before, ceiling = resource.getrlimit(resource.RLIMIT_AS)
        limits = [limit for limit in (before, used + most + _SLACK) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(limits), ceiling))
        try:
            yield
        except MemoryError as error:
            raise RecordingError("decoding it would take more memory than its largest size allows") from error
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (before, ceiling))
