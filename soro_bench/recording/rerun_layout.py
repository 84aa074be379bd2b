"""How rerun's viewer arranges a recording: a tab for all episodes together and one for each."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from soro_bench.envs.episode import Episode
from soro_bench.recording.drawing import Drawing
from soro_bench.recording.rerun_entities import OVERVIEW, episode_root, result
from soro_bench.recording.rerun_stream import TIMELINE

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
