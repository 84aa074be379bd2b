"""A signal of several runs in a Rerun recording: for robots that the suite has no drawing of."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from soro_bench.recording.rerun_stream import TIMELINE

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
            entity = f"plots/point_{p}/{'xyz'[c] if coordinates == 3 else c}/{name}"
            recording.log(entity, rr.SeriesLines(colors=[color], names=[name]), static=True)
            recording.send_columns(entity, stamps, rr.Scalars.columns(scalars=values[:, p, c]))
    if coordinates != 3:
        return
    recording.log(f"world/{name}", rr.Points3D.from_fields(colors=[color], radii=[radius]), static=True)
    balls = rr.Points3D.columns(positions=values.reshape(-1, 3)).partition([points] * steps)
    recording.send_columns(f"world/{name}", stamps, balls)
    if is_body and points > 1:
        lines = rr.LineStrips3D.columns(strips=list(np.nan_to_num(values)))
        recording.log(f"world/{name}/body", rr.LineStrips3D.from_fields(colors=[color], radii=[radius]), static=True)
        recording.send_columns(f"world/{name}/body", stamps, lines)
