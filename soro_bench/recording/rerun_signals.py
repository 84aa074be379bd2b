"""A signal of several runs as a rerun recording: for robots that the suite has no drawing of."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.recording.rerun_log import identity, recorded

if TYPE_CHECKING:
    import rerun


def write_signals(path: str | Path, title: str, time: np.ndarray, runs: Mapping[str, np.ndarray]) -> None:
    """Write the same signal of several runs: coordinates as curves, and points in space as points.

    Args:
        time: (T,) s.
        runs: (T, P, D) by name, NaN where missing.
    """
    with recorded(path, title, identity(title, runs.values())) as recording:
        for name, values in runs.items():
            _log(recording, name, time, values)


def _log(recording: "rerun.RecordingStream", name: str, time: np.ndarray, values: np.ndarray) -> None:
    import rerun as rr

    from soro_bench.recording.rerun_entities import TIMELINE

    stamps, (steps, points, coordinates) = [rr.TimeColumn(TIMELINE, duration=time)], values.shape
    for p in range(points):
        for c in range(coordinates):
            columns = rr.Scalars.columns(scalars=values[:, p, c])
            recording.send_columns(f"plots/point_{p}/{'xyz'[c] if coordinates == 3 else c}/{name}", stamps, columns)
    if coordinates == 3:
        columns = rr.Points3D.columns(positions=values.reshape(-1, 3)).partition([points] * steps)
        recording.send_columns(f"world/{name}", stamps, columns)
