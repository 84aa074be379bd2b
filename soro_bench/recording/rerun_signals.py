"""A signal of several runs as a rerun recording: for robots that the suite has no drawing of."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from soro_bench.files import replacing
from soro_bench.recording.rerun_log import APPLICATION_ID, SWITCHED_OFF, identity, require_rerun


def write_signals(path: str | Path, title: str, time: np.ndarray, runs: Mapping[str, np.ndarray]) -> None:
    """Write the same signal of several runs: coordinates as curves, and points in space as points.

    Args:
        time: (T,) s.
        runs: (T, P, D) by name, NaN where missing.
    """
    require_rerun()
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION_ID, recording_id=identity(title, runs.values()), send_properties=False)
    if not recording.is_enabled():
        raise RuntimeError(SWITCHED_OFF)
    memory = recording.memory_recording()
    recording.send_recording_name(title)
    stamps = [rr.TimeColumn("time", duration=time)]
    for name, values in runs.items():
        steps, points, coordinates = values.shape
        for p in range(points):
            for c in range(coordinates):
                columns = rr.Scalars.columns(scalars=values[:, p, c])
                recording.send_columns(f"plots/point_{p}/{'xyz'[c] if coordinates == 3 else c}/{name}", stamps, columns)
        if coordinates == 3:
            columns = rr.Points3D.columns(positions=values.reshape(-1, 3)).partition([points] * steps)
            recording.send_columns(f"world/{name}", stamps, columns)
    with replacing(path) as temporary:
        temporary.write_bytes(memory.drain_as_bytes())
