"""Figures of a report as inline PNG images."""

import base64
import io
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soro_bench.diagnosis.render import sentences, words
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import NINETY
from soro_bench.diagnosis.result_robot import Shape
from soro_bench.effects.effect import EACH, EVERY, Location
from soro_bench.plotting import pyplot

WINDOW = 1.0  # s, of maps over time
WIDTH = 6.5  # inches of figures; letters stay readable on a phone
WIDEST, TALLEST = 3.2, 3.6  # inches of the robot's picture
FRAME = (0.9, 0.7)  # inches of labels beside an axis
SLIM = 0.3  # of the robot's largest span: the smallest one that is drawn
SMALL = 8  # points, of its letters
MM = 1e3  # per m
GREY, BLUE, RED = "0.7", "#1f77b4", "#d62728"


def image(figure: Any) -> str:
    """A matplotlib figure as base64 PNG, which closes it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    pyplot().close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def places(result: Result) -> list[Location]:
    """The locations to highlight in the robot's picture."""
    if result.verdict == "outside_catalogue":
        return [each.location for each in result.locations[:1]]
    return [each.location for each in sentences.best_findings(result) if each.location is not None]


def is_at(shape: Shape, locations: list[Location]) -> bool:
    """Whether a shape stands for one of some locations; "*" is all of a kind."""
    return any(
        own.kind == each.kind and (each.name in (EVERY, EACH, own.name)) and own.index == each.index
        for own in shape.locations
        for each in locations
    )


def marked(result: Result) -> str:
    """The highlighted locations, in words; empty where the picture shows none of them."""
    shown = [each for each in places(result) if any(is_at(shape, [each]) for shape in result.shapes)]
    return ", ".join(map(str, shown))


def robot(result: Result) -> str:
    """The robot from the two sides that show most, with the discrepancy's locations highlighted; empty without shapes.

    Sides stand beside each other, or below each other where the robot lies.
    """
    if not result.shapes:
        return ""
    lows = [MM * (np.min(each.points, axis=0) - each.radius) for each in result.shapes]
    highs = [MM * (np.max(each.points, axis=0) + each.radius) for each in result.shapes]
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    spans = np.maximum(high - low, SLIM * float((high - low).max()) + 1e-9)
    views = sorted(((0, 2), (1, 2), (0, 1)), key=lambda axes: -spans[axes[0]] * spans[axes[1]])[:2]
    wide, tall = (np.array([spans[view[k]] for view in views]) for k in (0, 1))
    lies = wide.sum() > 2 * tall.sum()
    rows, columns = (2, 1) if lies else (1, 2)
    extent = np.array([wide.max(), tall.sum()] if lies else [wide.sum(), tall.max()])
    size = extent * min(WIDEST / extent[0], TALLEST / extent[1]) + np.array([columns, rows]) * FRAME
    ratios = {"height_ratios": tall} if lies else {"width_ratios": wide}
    figure, axes = pyplot().subplots(rows, columns, figsize=size, layout="constrained", gridspec_kw=ratios)
    highlighted = places(result)
    for ax, (across, up) in zip(axes, views, strict=True):
        for strong in (False, True):  # what is highlighted lies on top
            for each in result.shapes:
                if is_at(each, highlighted) == strong:
                    _draw(ax, MM * np.array(each.points)[:, [across, up]], MM * each.radius, strong)
        for k, name in ((across, "x"), (up, "y")):
            middle = (low[k] + high[k]) / 2
            ax.set(**{f"{name}lim": (middle - 0.54 * spans[k], middle + 0.54 * spans[k])})
            getattr(ax, f"{name}axis").set_major_locator(pyplot().MaxNLocator(1 if spans[k] < 0.5 * spans.max() else 4))
        ax.set(aspect="equal", xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]")
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=SMALL)
        ax.xaxis.label.set_size(SMALL)
        ax.yaxis.label.set_size(SMALL)
    return image(figure)


def _draw(ax: Any, line: NDArray[Any], radius: float, strong: bool) -> None:
    color, order = (RED if strong else GREY), (3 if strong else 2)
    if radius > 0:
        for a, b in itertools.pairwise(line) if len(line) > 1 else [(line[0], line[0])]:
            across = np.array([a[1] - b[1], b[0] - a[0]])
            across = radius * across / max(float(np.linalg.norm(across)), 1e-12)
            if len(line) > 1:
                ax.fill(*np.array([a + across, b + across, b - across, a - across]).T, color=color, lw=0, zorder=order)
            for end in (a, b):
                ax.add_patch(pyplot().Circle(end, radius, color=color, lw=0, zorder=order))
    else:
        ax.plot(*line.T, color=color, lw=2.5 if strong else 0.8, zorder=order)


def _signal(result: Result, name: str) -> NDArray[Any]:
    """(T, P, D) of a run, in the unit that is shown."""
    scale, _ = words.shown_unit(result.robot.unit)
    return scale * np.array(getattr(result.replay, name)).reshape(len(result.replay.time), *result.replay.shape)


def error(result: Result) -> str:
    """Error of fitted parameters over time: a map over the points, or a curve where there is one point."""
    off, time = _signal(result, "measured") - _signal(result, "before"), np.array(result.replay.time)
    edges, which = _windows(time)
    shown = np.full((len(edges) - 1, off.shape[1]), np.nan)
    for i in range(len(shown)):
        squares = off[which == i] ** 2
        if np.isfinite(squares).any():
            count = np.isfinite(squares).sum(axis=(0, 2))
            shown[i] = np.sqrt(np.nansum(squares, axis=(0, 2)) / np.where(count, count, np.nan))
    scale, unit = words.shown_unit(result.robot.unit)
    label = f"RMSE [{unit}]"
    if shown.shape[1] == 1:
        figure, axes = pyplot().subplots(figsize=(WIDTH, 2.2), layout="constrained")
        axes.stairs(shown[:, 0], edges, color=RED, baseline=None, label="fitted parameters")
        axes.axhline(scale * result.train.noise, color="0.5", lw=1, ls="--", label="noise")
        axes.set(xlabel="time [s]", ylabel=label, ylim=(0, None))
        axes.legend(frameon=False, ncols=2)
        return image(figure)
    figure, axes = pyplot().subplots(figsize=(WIDTH, 2.8), layout="constrained")
    mesh = axes.pcolormesh(edges, np.arange(shown.shape[1] + 1) - 0.5, shown.T, cmap="magma_r", vmin=0)
    axes.set(xlabel="time [s]", ylabel="point of the signal")
    axes.yaxis.set_major_locator(pyplot().MaxNLocator(integer=True))
    figure.colorbar(mesh, label=label)
    return image(figure)


def _windows(time: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Edges [s] of windows that span a recording, the last one shorter, and which one each sample is in."""
    edges = np.arange(0.0, time[-1], WINDOW)
    if len(edges) > 1 and time[-1] - edges[-1] < 0.2 * WINDOW:
        edges = edges[:-1]
    edges = np.append(edges, time[-1])
    return edges, np.clip(np.searchsorted(edges, time - 1e-9) - 1, 0, len(edges) - 2)


def before_and_after(result: Result) -> str:
    """Measured less simulated at the point with the largest error, with the band of the noise."""
    measured = _signal(result, "measured")
    errors = {name: measured - _signal(result, name) for name in ("before", "after")}
    point = int(np.nansum(errors["before"] ** 2, axis=(0, 2)).argmax())
    scale, unit = words.shown_unit(result.robot.unit)
    rows, time, noise = measured.shape[2], np.array(result.replay.time), 2 * scale * result.train.noise
    figure, axes = pyplot().subplots(rows, 1, figsize=(WIDTH, 1 + 1.2 * rows), sharex=True, layout="constrained")
    axes = np.atleast_1d(axes)
    labels = {"before": "fitted parameters", "after": "with the best hypothesis"}
    for axis, ax in enumerate(axes):
        ax.axhspan(-noise, noise, color="0.88", lw=0)
        for name, color in (("before", RED), ("after", BLUE)):
            values = errors[name][:, point, axis]
            seen = np.isfinite(values)  # a line with gaps would not show what is between two of them
            ax.plot(time[seen], values[seen], color=color, lw=0.9, label=labels[name])
        ax.set_ylabel(f"{'xyz'[axis]} [{unit}]" if rows == 3 else f"[{unit}]")
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False, borderaxespad=0.2)
    if measured.shape[1] > 1:
        axes[0].set_title(f"point {point} of the signal", loc="left", fontsize="medium")
    axes[-1].set_xlabel("time [s]")
    return image(figure)


def gain(result: Result) -> str:
    """Evidence that the best hypothesis gains per second."""
    time = np.array(result.replay.time)
    edges, which = _windows(time)
    rates = np.bincount(which, np.array(result.replay.gain), minlength=len(edges) - 1) / np.diff(edges)
    figure, axes = pyplot().subplots(figsize=(WIDTH, 2.2), layout="constrained")
    axes.stairs(rates, edges, fill=True)
    axes.set(xlabel="time [s]", ylabel="evidence [nats/s]")
    return image(figure)


def law_curve(result: Result) -> str:
    """What the law does against its state, and what the recordings ask for; empty without a curve."""
    if (curve := result.curve) is None:
        return ""
    figure, axes = pyplot().subplots(figsize=(WIDTH, 3.2), layout="constrained")
    axes.axhline(0.0, color="0.85", lw=1)
    columns = zip(("falling", "rising"), curve.state, curve.law, curve.measured, curve.deviation, strict=True)
    for color, (direction, state, law, measured, deviation) in zip((RED, BLUE), columns, strict=True):
        axes.plot(state, law, color=color, label=f"fitted law, {direction}")
        bars = NINETY * np.array(deviation)
        axes.errorbar(state, measured, bars, color=color, fmt="o", capsize=3, label=f"recordings, {direction}")
    axes.set(xlabel=curve.state_label, ylabel=curve.force_label)
    axes.legend(frameon=False, ncols=2)
    return image(figure)


def discovered(result: Result) -> str:
    """The input that explains what no law does against the main state of a discovered law, and the law."""
    if (found := result.discovery) is None or not found.effects:
        return ""
    figure, axes = pyplot().subplots(figsize=(WIDTH, 3.2), layout="constrained")
    axes.axhline(0.0, color="0.85", lw=1)
    axes.plot(found.state, found.force, ".", ms=3, color=GREY, label="input, free in time")
    axes.plot(found.state, found.law, ".", ms=3, color=RED, label="black box" if found.black_box else "law")
    axes.set(xlabel=found.state_label, ylabel=found.force_label)
    axes.legend(frameon=False, ncols=2)
    return image(figure)


def unknown_input(result: Result) -> str:
    """The input that explains what no law does, over time, of the first recording; empty without one."""
    if (found := result.unknown_input) is None:
        return ""
    first = np.array(found.recording) == 0
    start, values = np.array(found.start_s)[first], np.array(found.values)[first]
    figure, axes = pyplot().subplots(figsize=(WIDTH, 2.6), layout="constrained")
    for name, unit, column in zip(found.components, found.units, values.T, strict=True):
        axes.plot(start, column, label=f"{name} [{unit}]")
    axes.set(xlabel="time [s]")
    axes.legend(loc="upper right")
    return image(figure)
