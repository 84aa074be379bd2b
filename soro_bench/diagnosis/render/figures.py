"""Figures of a report as inline PNG images."""

import base64
import io
import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soro_bench.diagnosis.render import words
from soro_bench.diagnosis.result import Finding, Result, Shape
from soro_bench.effects.effect import EVERY, Location
from soro_bench.plotting import pyplot

WINDOW = 1.0  # s, of maps over time
RANKED = 10  # bars of probabilities
NINETY = 1.645  # standard deviations on either side of the middle 90 %
GREY, BLUE, RED = "0.7", "#1f77b4", "#d62728"


def image(figure: Any) -> str:
    """A matplotlib figure as base64 PNG, which closes it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    pyplot().close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def places(result: Result) -> list[Location]:
    """The locations to highlight in the robot's picture."""
    if result.verdict == "outside_catalogue":
        return [each.location for each in result.locations[:1]]
    return [each.location for each in words.best_findings(result) if each.location is not None]


def is_at(shape: Shape, locations: list[Location]) -> bool:
    """Whether a shape stands for one of some locations; "*" is all of a kind."""
    return any(
        own.kind == each.kind and (each.name in (EVERY, own.name)) and own.index == each.index
        for own in shape.locations
        for each in locations
    )


def robot(result: Result) -> str:
    """The robot from two sides, with the locations of the discrepancy highlighted; empty without shapes."""
    if not result.shapes:
        return ""
    points = np.concatenate([np.array(each.points) for each in result.shapes])
    spread = np.ptp(points, axis=0)
    upright = int(np.argmax(spread))
    sides = [axis for axis in np.argsort(-spread) if axis != upright]
    marked = places(result)
    figure, axes = pyplot().subplots(1, 2, figsize=(6, 4), layout="constrained")
    scale = 1e3
    for ax, side in zip(axes, sides, strict=True):
        for strong in (False, True):  # what is highlighted lies on top
            for each in result.shapes:
                if is_at(each, marked) == strong:
                    line = scale * np.array(each.points)[:, [side, upright]]
                    _draw(ax, line, scale * each.radius, strong)
        ax.set(aspect="equal", xlabel=f"{'xyz'[side]} [mm]", ylabel=f"{'xyz'[upright]} [mm]")
        ax.autoscale_view()
        ax.margins(0.08)
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


def probabilities(result: Result) -> str:
    """Bars of the probability of every effect."""
    shown = [(_name(f), f.probability) for f in result.findings[:RANKED]]
    shown = sorted(shown, key=lambda pair: pair[1])
    figure, axes = pyplot().subplots(figsize=(9, 0.6 + 0.3 * len(shown)), layout="constrained")
    axes.barh([name for name, _ in shown], [chance for _, chance in shown], color=BLUE)
    axes.set(xlim=(0, 1), xlabel="probability")
    return image(figure)


def _name(found: Finding) -> str:
    names = {"none": "no discrepancy", "unknown": "outside the catalogue", "outliers": "outliers only"}
    return names.get(found.name) or f"{words.law(found.name)} at {found.location}"


def _signal(result: Result, name: str) -> NDArray[Any]:
    """(T, P, D) of a run, in the unit that is shown."""
    scale, _ = words.shown_unit(result.robot.unit)
    return scale * np.array(getattr(result.replay, name)).reshape(len(result.replay.time), *result.replay.shape)


def error_map(result: Result) -> str:
    """Error of fitted parameters over time and points."""
    error, time = _signal(result, "measured") - _signal(result, "before"), np.array(result.replay.time)
    edges = np.arange(0.0, time[-1] + WINDOW, WINDOW)
    which = np.clip(np.searchsorted(edges, time - 1e-9) - 1, 0, len(edges) - 2)
    shown = np.full((len(edges) - 1, error.shape[1]), np.nan)
    for i in range(len(shown)):
        squares = error[which == i] ** 2
        if np.isfinite(squares).any():
            count = np.isfinite(squares).sum(axis=(0, 2))
            shown[i] = np.sqrt(np.nansum(squares, axis=(0, 2)) / np.where(count, count, np.nan))
    figure, axes = pyplot().subplots(figsize=(9, 3.4), layout="constrained")
    mesh = axes.pcolormesh(edges, np.arange(shown.shape[1] + 1) - 0.5, shown.T, cmap="magma_r")
    axes.set(xlabel="time [s]", ylabel="point of the signal")
    axes.yaxis.set_major_locator(pyplot().MaxNLocator(integer=True))
    figure.colorbar(mesh, label=f"RMSE [{words.shown_unit(result.robot.unit)[1]}]")
    return image(figure)


def before_and_after(result: Result) -> str:
    """Measured less simulated at the point with the largest error, with the band of the noise."""
    measured = _signal(result, "measured")
    errors = {name: measured - _signal(result, name) for name in ("before", "after")}
    point = int(np.nansum(errors["before"] ** 2, axis=(0, 2)).argmax())
    scale, unit = words.shown_unit(result.robot.unit)
    rows, time, noise = measured.shape[2], np.array(result.replay.time), 2 * scale * result.train.noise
    figure, axes = pyplot().subplots(rows, 1, figsize=(9, 1 + 1.5 * rows), sharex=True, layout="constrained")
    axes = np.atleast_1d(axes)
    labels = {"before": "fitted parameters", "after": "with the best hypothesis"}
    for axis, ax in enumerate(axes):
        ax.axhspan(-noise, noise, color="0.88", lw=0)
        for name, color in (("before", RED), ("after", BLUE)):
            values = errors[name][:, point, axis]
            seen = np.isfinite(values)  # a line with gaps would not show what is between two of them
            ax.plot(time[seen], values[seen], color=color, lw=0.9, label=labels[name])
        ax.set_ylabel(f"{'xyz'[axis]} [{unit}]" if rows == 3 else f"[{unit}]")
    axes[0].legend(loc="upper right", ncols=2, frameon=False)
    axes[0].set_title(f"point {point}")
    axes[-1].set_xlabel("time [s]")
    return image(figure)


def gain(result: Result) -> str:
    """Evidence that the best hypothesis gains in every second."""
    time = np.array(result.replay.time)
    edges = np.arange(0.0, time[-1] + WINDOW, WINDOW)
    figure, axes = pyplot().subplots(figsize=(9, 2.4), layout="constrained")
    axes.stairs(np.histogram(time - 1e-9, edges, weights=np.array(result.replay.gain))[0], edges, fill=True)
    axes.set(xlabel="time [s]", ylabel="evidence [nats/s]")
    return image(figure)


def law_curve(result: Result) -> str:
    """What the law does against its state, and what the recordings ask for; empty without a curve."""
    if (curve := result.curve) is None:
        return ""
    figure, axes = pyplot().subplots(figsize=(9, 3.6), layout="constrained")
    axes.axhline(0.0, color="0.85", lw=1)
    columns = zip(("falling", "rising"), curve.state, curve.law, curve.measured, curve.deviation, strict=True)
    for color, (direction, state, law, measured, deviation) in zip((RED, BLUE), columns, strict=True):
        axes.plot(state, law, color=color, label=f"fitted law, {direction}")
        bars = NINETY * np.array(deviation)
        axes.errorbar(state, measured, bars, color=color, fmt="o", capsize=3, label=f"recordings, {direction}")
    axes.set(xlabel=curve.state_label, ylabel=curve.force_label)
    axes.legend(frameon=False, ncols=2)
    return image(figure)


def unknown_input(result: Result) -> str:
    """The input that explains what no law does, over time, of the first recording; empty without one."""
    if (found := result.unknown_input) is None:
        return ""
    first = np.array(found.recording) == 0
    start, values = np.array(found.start_s)[first], np.array(found.values)[first]
    figure, axes = pyplot().subplots(figsize=(9, 3), layout="constrained")
    for name, unit, column in zip(found.components, found.units, values.T, strict=True):
        axes.plot(start, column, label=f"{name} [{unit}]")
    axes.set(xlabel="time [s]")
    axes.legend(loc="upper right")
    return image(figure)
