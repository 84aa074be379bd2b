"""Measured points, and robots that were simulated with the same actions, over each other as a rerun recording.

Every run has its own entities (/before/world, /before/plots) and its own tab; the first tab has all of them, and how
far each is from what was measured.
"""

from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from soro_bench.evaluation import Episode
from soro_bench.markdown import table
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.recording.distances import distances, measured_points, over_points
from soro_bench.recording.drawing import Drawing, Points
from soro_bench.recording.recording import Recording
from soro_bench.recording.rerun_entities import (
    blueprint,
    log_columns,
    log_curves,
    log_drawing,
    log_plots,
    log_static,
    markdown,
    painted,
    plot,
    plots,
    view3d,
    view_coordinates,
)
from soro_bench.recording.rerun_log import draw
from soro_bench.recording.rerun_stream import identity, recorded
from soro_bench.recording.simulated import replay, replay_begins

_COLORS = ((214, 39, 40), (31, 119, 180))  # before and after, as in the report
_MEASURED = "measured"


def write_runs(
    path: str | Path,
    title: str,
    runs: Mapping[str, Episode],
    measured: Mapping[str, Points],
    away: Mapping[str, np.ndarray],
) -> None:
    """Write one or two runs and the measured points, both by name, into the file ``path``, complete or not at all.

    Args:
        away: (n, points, runs) m, how far the runs are from measured points, by their name.
    """
    runs = {name: replace(run, goal=None) for name, run in runs.items()}  # nobody aimed at it
    drawings = {name: draw(run) for name, run in runs.items()}
    content = [*(run.metric for run in runs.values()), *(each.positions for each in measured.values())]
    with recorded(path, title, identity(title, content)) as recording:
        recording.send_blueprint(_layout(drawings, away))
        recording.flush()  # what comes now must not overtake it
        log_static(recording, "/", view_coordinates(next(iter(drawings.values()))))
        log_static(recording, "summary", markdown(_summary(title, runs)))
        for name, run in runs.items():
            log_drawing(recording, f"{name}/world", run, drawings[name])
            log_plots(recording, f"{name}/plots", run, drawings[name])
        for name, points in measured.items():
            _log_points(recording, f"{_MEASURED}/{name}", points)
        for name, values in away.items():
            curves = 1e3 * over_points(values)
            log_curves(recording, f"distance/{name}", measured[name].time, curves, list(runs), _colors(runs))
            _log_maps(recording, name, 1e3 * values, runs)


def _log_points(recording: rr.RecordingStream, path: str, points: Points) -> None:
    present = np.isfinite(points.positions).all(axis=-1)
    log_static(recording, path, rr.Points3D.from_fields(radii=points.radius, colors=points.color))
    columns = rr.Points3D.columns(positions=points.positions[present].astype(np.float32))
    log_columns(recording, path, points.time, columns.partition(present.sum(axis=1)))


def _log_maps(recording: rr.RecordingStream, name: str, values: np.ndarray, runs: Iterable[str]) -> None:
    """A picture for each run, points by times, in the same colours; black where there is nothing."""
    shown = np.where(np.isfinite(values), values, 0.0).astype(np.float32)
    for i, run in enumerate(runs):
        tensor = rr.Tensor(shown[..., i].T, dim_names=("point", "sample"), value_range=(0.0, _brightest(values)))
        log_static(recording, f"map/{name}/{run}", tensor)


def _brightest(values: np.ndarray) -> float:
    """What is white in a map of distances."""
    return float(np.max(values, initial=1e-6, where=np.isfinite(values)))


def _colors(runs: Sized) -> Sequence[tuple[int, int, int]]:
    return _COLORS[-len(runs) :]


def _summary(title: str, runs: Mapping[str, Episode]) -> str:
    lines = ", ".join(f"{name} {color}" for name, color in zip(runs, ("red", "blue")[-len(runs) :], strict=True))
    rows = [["model", *(run.model for run in runs.values())]]
    for name in next(iter(runs.values())).params:
        values = (f"{run.params[name]:.4g}" for run in runs.values())
        rows.append([f"{name} [{ALL_PARAMETERS[name].unit}]", *values])
    return "\n".join([f"# {title}", "", f"Dots: measured. Robots: {lines}.", "", table(["", *runs], rows)])


def _layout(drawings: Mapping[str, Drawing], away: Mapping[str, np.ndarray]) -> rrb.Blueprint:
    """It opens on the tab of all runs, and plays."""
    first, colors = next(iter(drawings.values())), _colors(drawings)
    contents, overrides = [f"/{_MEASURED}/**"], dict[str, Any]()
    for (name, drawing), color in zip(drawings.items(), colors, strict=True):
        overrides |= painted(f"/{name}/world", drawing, color)
    contents += overrides
    curves = [plot("/distance/" + name, f"distance from measured {name} [mm]") for name in away]
    text = rrb.TextDocumentView(origin="/summary", name="parameters")
    overview = rrb.Horizontal(
        view3d("/", contents, first, overrides), rrb.Vertical(*curves, text), column_shares=[3, 2], name="all"
    )
    maps = [_map(name, run, 1e3 * values) for name, values in away.items() for run in drawings]
    tabs = [rrb.Vertical(*maps, name="map")] if maps else []
    return blueprint([overview, *tabs, *(_tab(name, drawing) for name, drawing in drawings.items())], active=0)


def _map(name: str, run: str, values: np.ndarray) -> rrb.TensorView:
    title = f"{run}: distance from measured {name}, points by samples, up to {_brightest(values):.3g} mm (white)"
    colors = rrb.TensorScalarMapping(colormap="magma")
    return rrb.TensorView(origin=f"/map/{name}/{run}", name=title, scalar_mapping=colors, view_fit="fill")


def _tab(name: str, drawing: Drawing) -> rrb.Horizontal:
    view = view3d("/", [f"/{name}/world/**", f"/{_MEASURED}/**"], drawing)
    return rrb.Horizontal(view, rrb.Vertical(*plots(f"/{name}", drawing)), column_shares=[5, 4], name=name)


def write_comparison(
    recording: Recording, path: str | Path, title: str, runs: Mapping[str, Episode] | None = None
) -> None:
    """Write the measured points of a recording and robots that got its actions into a Rerun file.

    Args:
        runs: what one or two robots did, by name. By default the replay; ValueError if the recording has none.
    """
    runs = runs or {"replay": replay(recording)}
    measured = measured_points(recording, replay_begins(recording))
    write_runs(path, title, runs, measured, distances(runs, measured))
