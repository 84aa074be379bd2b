"""A Rerun recording as a stream of our own: the same bytes for the same content; and signals over time in it."""

import hashlib
import importlib.util
import os
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
_OFF = ("0", "false", "off")  # what rerun takes in its variable, in small or large letters


@contextmanager
def recorded(path: str | Path, title: str, recording_id: str) -> Iterator["rerun.RecordingStream"]:
    """A stream whose content becomes the file ``path`` when the block ends, and nothing if it fails."""
    require_rerun()
    import rerun as rr

    # without properties, which hold the time of writing; in memory, so that a full disk raises below
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=recording_id, send_properties=False)
    memory = stream.memory_recording()
    stream.send_recording_name(title)
    yield stream
    with replacing(path) as temporary:
        temporary.write_bytes(memory.drain_as_bytes())


def require_rerun() -> None:
    """Raise ImportError if rerun, an optional dependency, is not installed, and ValueError if it is switched off."""
    if importlib.util.find_spec("rerun") is None:
        raise ImportError("recordings need rerun: pip install soro_bench[view]")
    if (said := os.environ.get("RERUN", "")).lower() in _OFF:
        raise ValueError(f"recordings need rerun, which the environment variable RERUN={said} switches off; unset it")


def identity(title: str, content: Iterable[NDArray[Any]]) -> str:
    """The id of a recording: the viewer takes files of one id for parts of one recording."""
    digest = hashlib.sha256(title.encode())
    for array in content:
        digest.update(np.ascontiguousarray(array).tobytes())
    return str(uuid.UUID(bytes=digest.digest()[:16]))


if TYPE_CHECKING:
    import rerun


def log_signal(
    recording: "rerun.RecordingStream",
    name: str,
    time: NDArray[np.floating[Any]],
    values: NDArray[np.floating[Any]],
    color: tuple[int, int, int],
    radius: float,
    is_body: bool,
) -> None:
    """Log a signal of one run: coordinates as curves, points in space as balls or as a body.

    Args:
        time: (T,) s.
        values: (T, P, D), NaN where missing.
        radius: of points in space [m].
        is_body: whether a thick line joins the points.
    """
    import rerun as rr

    stamps, (steps, points, coordinates) = [rr.TimeColumn(TIMELINE, duration=time)], values.shape
    for p in range(points):
        for c in range(coordinates):
            log_curve(recording, f"{curve(p, c, coordinates)}/{name}", name, time, values[:, p, c], color)
    if coordinates != 3:
        return
    recording.log(f"world/{name}", rr.Points3D.from_fields(colors=[color], radii=[radius]), static=True)
    balls = rr.Points3D.columns(positions=values.reshape(-1, 3)).partition([points] * steps)
    recording.send_columns(f"world/{name}", stamps, balls)
    if is_body and points > 1:
        lines = rr.LineStrips3D.columns(strips=list(np.nan_to_num(values)))
        recording.log(f"world/{name}/body", rr.LineStrips3D.from_fields(colors=[color], radii=[radius]), static=True)
        recording.send_columns(f"world/{name}/body", stamps, lines)


def curve(point: int, coordinate: int, coordinates: int) -> str:
    """The entity whose children are the curves of one number of a signal, of all runs."""
    return f"plots/point_{point}/{'xyz'[coordinate] if coordinates == 3 else coordinate}"


def log_curve(
    recording: "rerun.RecordingStream",
    entity: str,
    name: str,
    time: NDArray[np.floating[Any]],
    values: NDArray[np.floating[Any]],
    color: tuple[int, int, int],
) -> None:
    """Log a curve of (T,) values at (T,) times [s]."""
    import rerun as rr

    recording.log(entity, rr.SeriesLines(colors=[color], names=[name]), static=True)
    recording.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=time)], rr.Scalars.columns(scalars=values))
