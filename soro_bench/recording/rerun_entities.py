"""What a rerun recording holds: one group of entities per episode. Time series go in as whole columns."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from soro_bench.evaluation import Episode
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


_BACKGROUND = (214, 219, 225)
_RESULT_COLORS = {"solved": (34, 139, 34), "not solved": (90, 100, 115), "diverged": (200, 40, 40)}
_BODY_ALPHA = 90  # of 255: measured points and other robots show through


def layout(episodes: Sequence[Episode], drawings: Sequence[Drawing]) -> rrb.Blueprint:
    """The blueprint; it opens on the first episode and plays."""
    tabs = [_overview_tab(episodes, drawings)]
    tabs += [_episode_tab(i, *both) for i, both in enumerate(zip(episodes, drawings, strict=True))]
    return blueprint(tabs, active=1)


def blueprint(tabs: Iterable[rrb.Container | rrb.View], active: int) -> rrb.Blueprint:
    """The tabs, without the viewer's own panels; it plays."""
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=active),
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", loop_mode="all", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _overview_tab(episodes: Sequence[Episode], drawings: Sequence[Drawing]) -> rrb.Horizontal:
    """All robots, coloured by how the episode ended, and their objects beside the table of results."""
    contents: list[str] = []
    overrides: dict[str, Any] = {}
    for i, (episode, drawing) in enumerate(zip(episodes, drawings, strict=True)):
        world = f"/{episode_root(i)}/world"
        contents += [f"{world}/{name}" for name in ("goal", *({"object"} & drawing.boxes.keys()))]
        overrides |= painted(world, drawing, _RESULT_COLORS[result(episode)])
    contents += overrides
    view, text = view3d("/", contents, drawings[0], overrides), rrb.TextDocumentView(origin=f"/{OVERVIEW}")
    return rrb.Horizontal(view, text, column_shares=[3, 2], name="all")


def _episode_tab(i: int, episode: Episode, drawing: Drawing) -> rrb.Horizontal:
    root, end = f"/{episode_root(i)}", result(episode)
    curves = [
        plot(f"{root}/plots/{episode.metric_name}", f"{episode.metric_name} [mm]", legend=False),
        plot(f"{root}/plots/reward", "reward"),
        *plots(root, drawing),
    ]
    return rrb.Horizontal(
        view3d(f"{root}/world", "$origin/**", drawing),
        rrb.Vertical(*curves, row_shares=[2, 2, 5, *([3] * (len(drawing.plots) - 1)), 2]),
        rrb.TextDocumentView(origin=f"{root}/summary", name="episode"),
        column_shares=[5, 4, 2],
        name=f"{i + 1}: " + (end if end != "not solved" else f"{1e3 * episode.final_metric:.0f} mm"),
    )


def painted(world: str, drawing: Drawing, color: tuple[int, int, int]) -> dict[str, Any]:
    """What a view changes to show a robot, as thick as it is, in one colour: its line opaque, its body transparent.

    Args:
        world: the entity path of the drawing.
        color: red, green and blue, 0 to 255.

    Returns:
        rerun archetypes by entity path, of all entities that are to be seen.
    """
    body = rr.Mesh3D.from_fields(albedo_factor=(*color, _BODY_ALPHA))
    return {
        f"{world}/{drawing.outline}": rr.LineStrips3D.from_fields(colors=color),
        **{f"{world}/{name}": body for name in drawing.body},
    }


def plots(root: str, drawing: Drawing) -> list[rrb.TimeSeriesView]:
    """The robot's own curves, and its actions."""
    # the first has the room for a legend, whose colours hold for the others
    own = [plot(f"{root}/plots/{name}", each.title, k == 0) for k, (name, each) in enumerate(drawing.plots.items())]
    return [*own, plot(f"{root}/plots/action", "action", legend=False)]


def plot(origin: str, title: str, legend: bool = True) -> rrb.TimeSeriesView:
    """All curves below a path."""
    return rrb.TimeSeriesView(origin=origin, name=title, plot_legend=rrb.PlotLegend(visible=legend))


def view3d(
    origin: str, contents: str | list[str], drawing: Drawing, overrides: Mapping[Any, Any] | None = None
) -> rrb.Spatial3DView:
    """A view of the scene from where the robot's drawing is best looked at."""
    grid = rrb.LineGrid3D(visible=False)
    if drawing.floor is not None:
        grid = rrb.LineGrid3D(plane=rr.components.Plane3D(drawing.up, drawing.floor), spacing=0.05)
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents,
        name="world",
        eye_controls=rrb.EyeControls3D(position=drawing.eye, look_target=drawing.target, eye_up=drawing.up),
        line_grid=grid,
        background=_BACKGROUND,
        overrides=overrides,
    )
