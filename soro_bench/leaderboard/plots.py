"""Plots of the leaderboard's page: SVG in the colours of the page, light or dark, whose text is text."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.leaderboard.gather import Group
from soro_bench.plotting import pyplot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INK = "#010203"  # stands for the page's own colour
_WIDTH = 5.2  # inches: the text stays readable where a phone shrinks the plot
_LETTERS = 28  # of a name
_COLORS = ("#3b82c4", "#d9822b", "#4a9c5d", "#c8504b", "#8f6bb8", "#94745f", "#cc6fa8", "#808080", "#a3a02c", "#2ca3ad")
_SETTINGS = {
    "svg.fonttype": "none", "svg.hashsalt": "soro_bench", "text.parse_math": False, "font.size": 9,
    "font.family": "sans-serif", "text.color": _INK, "axes.labelcolor": _INK, "axes.edgecolor": _INK,
    "xtick.color": _INK, "ytick.color": _INK, "grid.color": _INK, "grid.alpha": 0.15, "axes.grid": True,
    "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "savefig.transparent": True,
    "lines.solid_capstyle": "butt",
}  # fmt: skip


def color_of(number: int) -> str:
    """The colour of a board's method of that number."""
    return _COLORS[number % len(_COLORS)]


def plot_scores(rows: Mapping[str, Sequence[dict]], name: str, label: str) -> str:
    """Interquartile mean and its interval of every row, a line each, under the condition that it is of.

    Args:
        rows: by the condition's label; with "group", "color", "iqm" and "interval" [mm], the best first.
        name: of the plot, unlike others on the page.
        label: of the axis.
    """
    sizes = [len(members) for members in rows.values()]
    with pyplot().rc_context(_SETTINGS):
        figure, all_axes = pyplot().subplots(
            len(rows), 1, squeeze=False, sharex=True, layout="constrained", height_ratios=sizes,
            figsize=(_WIDTH, 0.5 + 0.4 * len(sizes) + 0.2 * sum(sizes)),
        )  # fmt: skip
        for axes, (condition, members) in zip(all_axes[:, 0], rows.items(), strict=True):
            for i, row in enumerate(members):
                if row["interval"]:
                    axes.plot(row["interval"], (i, i), color=row["color"], lw=2)
                axes.plot(row["iqm"], i, "o", color=row["color"], ms=5)
            axes.set_yticks(range(len(members)), [title_of(row["group"]) for row in members])
            axes.set(ylim=(len(members) - 0.5, -0.5))
            axes.set_title(f"on {condition}", fontsize=9, loc="left")
            axes.tick_params(axis="y", length=0)
        axes.set(xlabel=label)
        axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
        return _svg(figure, name)


def plot_curves(groups: Sequence[Group], name: str, label: str, scale: str) -> str:
    """Training curves: thin lines of single runs, and their medians; a group without curves is left out.

    Args:
        scale: of the metric: "log" shows what falls from far away, and "linear" what may be negative. Where nothing is
            above zero, a logarithm would show nothing.
    """
    if max((value for group in groups for _, final in curves_of(group) for value in final), default=0.0) <= 0.0:
        scale = "linear"
    with pyplot().rc_context(_SETTINGS):
        figure, axes = pyplot().subplots(figsize=(_WIDTH, 2.9 + 0.1 * len(groups)), layout="constrained")
        for i, group in enumerate(groups):
            if curves := curves_of(group):
                look = {"color": color_of(i), "ls": "-" if i < len(_COLORS) else "--"}
                for steps, final in curves:
                    axes.plot(steps, final, **look, alpha=0.3, lw=0.7)
                grid = np.array(max((steps for steps, _ in curves), key=len))
                grid = grid[grid <= min(steps[-1] for steps, _ in curves)]  # of all runs, not of those that go on
                median = np.median([np.interp(grid, *curve) for curve in curves], axis=0)
                axes.plot(grid, median, **look, lw=1.8, label=title_of(group))
        axes.set(xlabel="environment steps", ylabel=label, yscale=scale)
        if scale == "log":
            axes.yaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.minorticks_off()
        axes.xaxis.set_major_formatter(lambda steps, _: f"{steps:,.0f}")
        axes.locator_params(axis="x", nbins=5)
        figure.legend(loc="outside lower center", ncols=2)
        return _svg(figure, name)


def plot_calibration(bins: Sequence[dict], name: str) -> str:
    """How often the first answer was right, against its stated probability; areas are numbers of cases."""
    with pyplot().rc_context(_SETTINGS):
        figure, axes = pyplot().subplots(figsize=(_WIDTH, 3.2), layout="constrained")
        axes.plot((0, 1), (0, 1), color=_INK, alpha=0.4, lw=1)
        cases = np.array([row["cases"] for row in bins], float)
        stated, right = ([row[key] for row in bins] for key in ("stated", "right"))
        axes.scatter(stated, right, 15 + 250 * cases / cases.max(), color=_COLORS[0], alpha=0.8, lw=0)
        axes.set(xlabel="stated probability", ylabel="share that was right", xlim=(-0.03, 1.03), ylim=(-0.05, 1.05))
        return _svg(figure, name)


def curves_of(group: Group) -> list[tuple[list[float], list[float]]]:
    """(steps, final metric [mm]) of the group's trainings, as far as they were entered."""
    curves = [entry.get("training", {}).get("curve") for _, entry in group.entries]
    return [(curve["steps"], curve["final_mm"]) for curve in curves if curve]


def title_of(group: Group) -> str:
    """What a group is called in plots; a long name is cut."""
    title = f"{group.name}, {group.entry}"
    return title if len(title) <= _LETTERS else f"{title[: _LETTERS - 1]}…"


def _svg(figure: "Figure", name: str) -> str:
    """The figure as SVG inside a page: names of its own, and the page's colour and font."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    pyplot().close(figure)
    text = buffer.getvalue()
    text = re.sub(r"\s(width|height)=\"[\d.]+pt\"", "", text[text.index("<svg") :], count=2)
    text = re.sub(r"(\bid=\"|href=\"#|url\(#)", rf"\g<1>{name}-", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"font-family: [^;\"]*", "font-family: inherit", text)
    return text.replace(_INK, "currentColor")
