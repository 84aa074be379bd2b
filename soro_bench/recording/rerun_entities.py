"""What a rerun recording holds: one group of entities per episode. Time series go in as whole columns."""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import rerun as rr

from soro_bench.envs.episode import Episode
from soro_bench.markdown import table
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.recording.drawing import Drawing, Mesh, Pose
from soro_bench.recording.rerun_stream import TIMELINE

OVERVIEW = "episodes"


def episode_root(i: int) -> str:
    """Entity path of episode i."""
    return f"episode_{i + 1:02d}"


def result(episode: Episode) -> str:
    """How the episode ended, in a word or two."""
    if episode.diverged:
        return "diverged"
    return "solved" if episode.is_success else "not solved"


def log_episodes(
    recording: rr.RecordingStream, episodes: Sequence[Episode], drawings: Sequence[Drawing], title: str
) -> None:
    """Send everything but the layout to a rerun stream."""
    log_static(recording, "/", view_coordinates(drawings[0]))
    log_static(recording, OVERVIEW, markdown(_overview(episodes, title)))
    for i, (episode, drawing) in enumerate(zip(episodes, drawings, strict=True)):
        root = episode_root(i)
        log_static(recording, f"{root}/summary", markdown(_summary(episode, drawing.note)))
        log_drawing(recording, f"{root}/world", episode, drawing)
        _log_task(recording, f"{root}/plots", episode)
        log_plots(recording, f"{root}/plots", episode, drawing)


def _overview(episodes: Sequence[Episode], title: str) -> str:
    rows = [
        (i + 1, _millimetres(e.goal), result(e), f"{1e3 * e.final_metric:.2f}", f"{e.total_reward:.2f}")
        for i, e in enumerate(episodes)
    ]
    solved = sum(e.is_success for e in episodes)
    legend = "Robots: green solved, grey not solved, red diverged. Every episode has a tab above."
    head = [f"# {title}", "", f"{solved} of {len(episodes)} solved", "", legend, ""]
    names = ("episode", "goal [mm]", "result", f"final {episodes[0].metric_name} [mm]", "total reward")
    return "\n".join([*head, table(names, rows)])


def _summary(episode: Episode, note: str) -> str:
    rows = {
        "model": episode.model,
        "result": result(episode),
        f"final {episode.metric_name} [mm]": f"{1e3 * episode.final_metric:.2f}",
        "total reward": f"{episode.total_reward:.3f}",
        "steps": f"{len(episode.time) - 1}",
        "goal [mm]": _millimetres(episode.goal),
    }
    params = {f"{name} [{ALL_PARAMETERS[name].unit}]": f"{value:.4g}" for name, value in episode.params.items()}
    return "\n".join([f"# {episode.env_id}", "", table(("", ""), {**rows, **params}.items()), "", note])


def _millimetres(position: np.ndarray | None) -> str:
    return "none" if position is None else ", ".join(f"{1e3 * x:.4g}" for x in position)


def log_drawing(recording: rr.RecordingStream, root: str, episode: Episode, drawing: Drawing) -> None:
    """Send the robot and its surroundings."""
    time = episode.time
    log_static(recording, root, view_coordinates(drawing))
    for name, mesh in drawing.meshes.items():
        _log_mesh(recording, f"{root}/{name}", time, mesh)
    for name, box in drawing.boxes.items():
        shape = rr.Boxes3D(half_sizes=[box.half_size], colors=[box.color], fill_mode="solid")
        log_static(recording, f"{root}/{name}", shape)
        _log_pose(recording, f"{root}/{name}", time, box.pose)
    for name, line in drawing.lines.items():
        log_static(recording, f"{root}/{name}", rr.LineStrips3D.from_fields(radii=line.radius))
        columns = rr.LineStrips3D.columns(strips=line.points.astype(np.float32), colors=line.colors)
        log_columns(recording, f"{root}/{name}", time, columns)
    if episode.goal is not None:
        goal = rr.Points3D([episode.goal], radii=drawing.goal_radius, colors=drawing.goal_color)
        log_static(recording, f"{root}/goal", goal)


def view_coordinates(drawing: Drawing) -> rr.AsComponents:
    """Which way is up."""
    return rr.ViewCoordinates.RIGHT_HAND_Y_UP if drawing.up[1] else rr.ViewCoordinates.RIGHT_HAND_Z_UP


def _log_mesh(recording: rr.RecordingStream, path: str, time: np.ndarray, mesh: Mesh) -> None:
    vertices, normals = (each.reshape(-1, 3).astype(np.float32) for each in (mesh.vertices, mesh.normals))
    surface = rr.Mesh3D.from_fields(triangle_indices=mesh.faces, albedo_factor=mesh.color)
    if mesh.vertices.ndim == 2:
        surface = rr.Mesh3D.from_fields(
            vertex_positions=vertices, vertex_normals=normals, triangle_indices=mesh.faces, albedo_factor=mesh.color
        )
    log_static(recording, path, surface)
    if mesh.vertices.ndim == 3:
        states, count, _ = mesh.vertices.shape
        columns = rr.Mesh3D.columns(vertex_positions=vertices, vertex_normals=normals)
        log_columns(recording, path, time, columns.partition([count] * states))
    if mesh.pose is not None:
        _log_pose(recording, path, time, mesh.pose)


def _log_pose(recording: rr.RecordingStream, path: str, time: np.ndarray, pose: Pose) -> None:
    if pose.position.ndim == 1:
        turned = rr.Quaternion(xyzw=pose.quaternion)
        log_static(recording, path, rr.Transform3D(translation=pose.position, quaternion=turned))
    else:
        columns = rr.Transform3D.columns(translation=pose.position, quaternion=pose.quaternion)
        log_columns(recording, path, time, columns)


def _log_task(recording: rr.RecordingStream, root: str, episode: Episode) -> None:
    time = episode.time
    log_curves(recording, f"{root}/{episode.metric_name}", time, 1e3 * episode.metric, [episode.metric_name])
    for name, values in episode.rewards.items():  # a reward belongs to the state that its step leads to
        log_curves(recording, f"{root}/reward/{name}", time[1:], values, [name.removeprefix("reward_")])


def log_plots(recording: rr.RecordingStream, root: str, episode: Episode, drawing: Drawing) -> None:
    """Send the robot's own curves, and its actions."""
    time = episode.time
    for name, plot in drawing.plots.items():
        log_curves(recording, f"{root}/{name}", time, plot.values, plot.names, plot.colors)
    actions = episode.actions.reshape(len(time) - 1, -1)
    names = [f"action {i}" for i in range(actions.shape[1])]
    log_curves(recording, f"{root}/action", time[:-1], actions, names, interpolation="StepAfter")


def log_curves(
    recording: rr.RecordingStream,
    path: str,
    time: np.ndarray,
    values: np.ndarray,
    names: Sequence[str],
    colors: Sequence | np.ndarray | None = None,
    interpolation: Literal["StepAfter"] | None = None,
) -> None:
    """k curves: ``values`` (n,) or (n, k) at ``time`` (n,) [s]."""
    log_static(recording, path, rr.SeriesLines(names=names, colors=colors, interpolation_mode=interpolation))
    log_columns(recording, path, time, rr.Scalars.columns(scalars=np.asarray(values, float)))


def markdown(text: str) -> rr.TextDocument:
    """A text as the viewer formats it."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def log_static(recording: rr.RecordingStream, path: str, archetype: rr.AsComponents) -> None:
    """As ``recording.log(..., static=True)``, which however gathers rows in a thread and so mixes up their order."""
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in archetype.as_component_batches()]
    recording.send_columns(path, [], columns, strict=True)


def log_columns(
    recording: rr.RecordingStream, path: str, time: np.ndarray, columns: Iterable[rr.ComponentColumn]
) -> None:
    """One row of ``columns`` per ``time`` [s]."""
    nanoseconds = np.round(1e9 * time).astype("timedelta64[ns]")
    recording.send_columns(path, [rr.TimeColumn(TIMELINE, duration=nanoseconds)], columns, strict=True)
