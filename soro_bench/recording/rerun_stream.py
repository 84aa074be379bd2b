"""Rerun recordings as files that appear complete or not at all."""

import hashlib
import importlib.util
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from soro_bench.files import replacing

if TYPE_CHECKING:
    import rerun

APPLICATION_ID = "soro_bench"
TIMELINE = "time"


@contextmanager
def recorded(path: str | Path, title: str, recording_id: str) -> Iterator["rerun.RecordingStream"]:
    """A stream whose content becomes the file ``path`` when the block ends, and nothing if it fails."""
    require_rerun()
    import rerun as rr

    # without properties, which hold the time of writing; in memory, so that a full disk raises below
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id, send_properties=False)
    if not rr.is_enabled(stream):
        raise ValueError("rerun is switched off by the environment variable RERUN; unset it")
    memory = stream.memory_recording()
    stream.send_recording_name(title)
    yield stream
    with replacing(path) as temporary:
        temporary.write_bytes(memory.drain_as_bytes())


def require_rerun() -> None:
    """Raise ImportError if rerun, an optional dependency, is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise ImportError("recordings need rerun: pip install soro_bench[view]")


def identity(title: str, content: Iterable[NDArray[Any]]) -> str:
    """The id of a recording: the viewer takes files of one id for parts of one recording."""
    digest = hashlib.sha256(title.encode())
    for array in content:
        digest.update(np.ascontiguousarray(array).tobytes())
    return str(uuid.UUID(bytes=digest.digest()[:16]))
