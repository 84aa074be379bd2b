"""comparison.rrd: the recording beside plain replays before and after the patch, for the Rerun viewer."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.result import Result
from soro_bench.recording.rerun_stream import TIMELINE, curve, identity, log_curve, log_signal, recorded

if TYPE_CHECKING:
    import rerun.blueprint as rrb

COLORS = {"measured": (120, 120, 120), "before": (214, 39, 40), "after": (31, 119, 180)}
RADIUS = 0.01  # m, of a body whose thickness is unknown
BALL = 0.6  # of a body's radius: that of a measured point
ERROR = "error"  # entity of the curves of the RMSE
DIRECTION = (1.0, 0.5, 0.7)  # of the eye from the robot, in sizes of the robot's workspace
PLOTS = 4  # that fit on a screen one below the other


def write_comparison(result: Result, path: str | Path) -> None:
    """Points in space become bodies as thick as the robot, measured ones balls; all other signals are curves."""
    replay, title = result.replay, f"diagnosis of {result.robot.name}"
    time, shape = np.array(replay.time), (len(replay.time), *replay.shape)
    runs = {name: np.array(getattr(replay, name)).reshape(shape) for name in COLORS}
    errors = {name: rmse(runs["measured"], runs[name]) for name in ("before", "after")}
    radius = thickness(result)
    with recorded(path, title, identity(title, runs.values())) as recording:
        recording.send_blueprint(layout(result, runs))
        recording.flush()  # what comes now must not overtake it
        for name, values in runs.items():
            is_body = name != "measured"
            log_signal(recording, name, time, values, COLORS[name], radius if is_body else BALL * radius, is_body)
        for name, values in errors.items():
            log_curve(recording, f"{ERROR}/{name}", name, time, values, COLORS[name])


def layout(result: Result, runs: dict[str, Floats]) -> "rrb.Blueprint":
    """What the viewer shows: the error over time, and the numbers with the largest errors; points in space beside them.

    Args:
        runs: (T, P, D) the recording, "measured", and its replays "before" and "after".
    """
    import rerun.blueprint as rrb

    robot, coordinates = result.robot, result.replay.shape[1]
    left = np.nan_to_num(runs["measured"] - runs["before"])
    sizes = (left**2).sum(axis=0)  # (P, D)
    if in_space := coordinates == 3:
        shown = [(int(sizes.sum(axis=1).argmax()), c) for c in range(coordinates)]
    else:
        order = np.argsort(-sizes, axis=None, kind="stable")[:PLOTS]
        shown = sorted(divmod(int(i), coordinates) for i in order)
    plots = [
        rrb.TimeSeriesView(
            origin=f"/{curve(p, c, coordinates)}",
            name=" ".join([robot.signal, *label(p, c, result), f"[{robot.unit}]"]),
        )
        for p, c in shown
    ]
    column = rrb.Vertical(rrb.TimeSeriesView(origin=f"/{ERROR}", name=f"RMSE of a replay [{robot.unit}]"), *plots)
    content = rrb.Horizontal(_view3d(runs["before"], robot.signal), column) if in_space else column
    return rrb.Blueprint(
        content,
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", loop_mode="all", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _view3d(values: Floats, name: str) -> "rrb.Spatial3DView":
    """A view of all that points (T, P, 3) [m] pass through."""
    import rerun.blueprint as rrb

    low, high = np.nanmin(values, axis=(0, 1)), np.nanmax(values, axis=(0, 1))
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    return rrb.Spatial3DView(
        origin="/world",
        name=name,
        eye_controls=rrb.EyeControls3D(position=centre + size * np.array(DIRECTION), look_target=centre),
        line_grid=rrb.LineGrid3D(visible=False),
    )


def label(point: int, coordinate: int, result: Result) -> tuple[str, ...]:
    """Which number of a signal: its point, counted from 0 as in the report, and its coordinate."""
    points, coordinates = result.replay.shape
    axis = "xyz"[coordinate] if coordinates == 3 else str(coordinate + 1) if coordinates > 1 else ""
    return tuple(part for part in (str(point) if points > 1 else "", axis) if part)


def rmse(measured: Floats, simulated: Floats) -> Floats:
    """(T,) error of (T, P, D) numbers at each time; NaN where none is measured."""
    squares, present = (measured - simulated) ** 2, np.isfinite(measured)
    count = present.sum(axis=(1, 2))
    total = np.where(present, squares, 0.0).sum(axis=(1, 2))
    return np.sqrt(np.divide(total, count, out=np.full(len(measured), np.nan), where=count > 0))


def thickness(result: Result) -> float:
    """The median radius [m] of the robot's parts."""
    radii = [each.radius for each in result.shapes if len(each.points) > 1 and each.radius > 0]
    return float(np.median(radii)) if radii else RADIUS
