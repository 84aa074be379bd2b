"""comparison.rrd: the recording beside plain replays before and after the patch, for the Rerun viewer."""

from pathlib import Path

import numpy as np

from soro_bench.diagnosis.result import Result
from soro_bench.recording.rerun_stream import identity, log_signal, recorded

COLORS = {"measured": (120, 120, 120), "before": (214, 39, 40), "after": (31, 119, 180)}
RADIUS = 0.01  # m, of a body whose thickness is unknown
BALL = 0.6  # of a body's radius: that of a measured point


def write_comparison(result: Result, path: str | Path) -> None:
    """Points in space become bodies as thick as the robot, measured ones balls; all other signals are curves."""
    replay, title = result.replay, f"diagnosis of {result.robot.name}"
    time, shape = np.array(replay.time), (len(replay.time), *replay.shape)
    runs = {name: np.array(getattr(replay, name)).reshape(shape) for name in COLORS}
    radius = thickness(result)
    with recorded(path, title, identity(title, runs.values())) as recording:
        for name, values in runs.items():
            is_body = name != "measured"
            log_signal(recording, name, time, values, COLORS[name], radius if is_body else BALL * radius, is_body)


def thickness(result: Result) -> float:
    """The median radius [m] of the robot's parts."""
    radii = [each.radius for each in result.shapes if len(each.points) > 1 and each.radius > 0]
    return float(np.median(radii)) if radii else RADIUS
