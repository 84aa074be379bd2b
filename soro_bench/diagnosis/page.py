"""report.html: a diagnosis to look at, in one file without scripts; and the robot before and after, for rerun."""

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.assembly.findings import NINETY, findings, spaced
from soro_bench.diagnosis.assembly.force_against_state import Curve, force_against_state
from soro_bench.diagnosis.assembly.patch import REMAINING, kept, patch
from soro_bench.diagnosis.localisation.residual_maps import explained_over_time, left_over, map_window, residual_map
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.report import only_outliers, write_json_report
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.verdict import verdict
from soro_bench.files import replacing
from soro_bench.plotting import pyplot
from soro_bench.recording.comparison import write_comparison
from soro_bench.recording.distances import distances, measured_points, over_points
from soro_bench.recording.recording import Recording
from soro_bench.recording.rerun_signals import write_signals
from soro_bench.recording.simulated import replay, replay_begins

_STYLE = """body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
img { width: 100% } table { border-collapse: collapse; font-size: 90% } td, th { padding: .2rem .8rem .2rem 0;
text-align: left; vertical-align: top; border-bottom: 1px solid #ddd } .verdict { background: #f3f6fa; padding: 1rem;
white-space: pre-line } figcaption { color: #555; margin-bottom: 1.5rem }"""
_RANKED = 10  # effects in the table
_CURVE = (
    "Lines: what the fitted law does at {} on average, while the state falls and while it rises; they describe "
    "{:.0f} % of it. Points: what has to act there, to first order, to move the robot as in the recordings, with 90 % "
    "intervals. Points beside the lines speak for another law. Where the recordings say little there is no point."
)


def write_reports(diagnosis: Diagnosis, recordings: Sequence[Recording], folder: str | Path) -> str:
    """All files of a diagnosis in a folder; returns the verdict in sentences."""
    folder = Path(folder)
    report = write_json_report(diagnosis, folder)
    text = verdict(diagnosis)
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(_page(diagnosis, report, text), encoding="utf-8")
    _write_comparison(diagnosis, recordings[0], folder / "comparison.rrd")
    return text


def _write_comparison(diagnosis, recording, path) -> None:
    """Measured points beside the simulated robot, before (with fitted parameters) and after (with the patch).

    By the model that is closer then: where a cheap one explains what an accurate one does, what differs between the two
    hides all the rest.
    """
    if not isinstance(diagnosis.robot, SuiteRobot):
        _write_curves(diagnosis, path)
        return
    effects, robot = patch(diagnosis), diagnosis.robot
    signal = recording.signals[robot.signal]  # the samples of which may be flat
    ranked_locations = replace(signal, values=signal.values.reshape(-1, *robot.shape))
    aimless = {name: text for name, text in recording.metadata.items() if name != "goal"}  # nothing is said of goals
    recording = replace(recording, signals={**recording.signals, robot.signal: ranked_locations}, metadata=aimless)
    models = dict.fromkeys(each.model_name for each in (robot, *robot.refined()) if each.accepts(effects))
    runs = min(
        (_runs(diagnosis, recording, model, effects) for model in models), key=lambda r: _away(recording, robot, r)
    )
    write_comparison(recording, path, f"diagnosis of {robot.name}", runs)


def _runs(diagnosis, recording, model, effects):
    runs, given = {}, {"before": (diagnosis.explanation.nominal, []), "after": (kept(diagnosis), effects)}
    for name, (hypothesis, some) in given.items():
        physics = [each for each in (*diagnosis.robot.known, *some) if each.location.kind != "sensor"]
        fitted = replace(recording, parameters=diagnosis.robot.parameters(hypothesis.x))
        runs[name] = replay(fitted, model, effects=physics)
    return runs


def _away(recording, robot, runs):
    """How far the patched robot is from what was measured, on average [m]."""
    measured = measured_points(recording, replay_begins(recording))
    return float(np.nanmean(over_points(distances(runs, measured)[robot.signal])[:, 1]))


def _write_curves(diagnosis, path) -> None:
    problem, measured = diagnosis.explanation.problem, diagnosis.explanation.problem.recordings[0]
    runs = {"measured": measured.values}
    for name, hypothesis in (("before", diagnosis.explanation.nominal), ("after", kept(diagnosis))):
        runs[name] = measured.values - problem.sigma * problem.split(hypothesis.residual)[0]
    write_signals(path, f"diagnosis of {diagnosis.robot.name}", measured.time, runs)


def _page(diagnosis: Diagnosis, report: dict, text: str) -> str:
    count = len(diagnosis.explanation.problem.recordings)
    which = f" The first of {count} recordings." if count > 1 else ""
    plots = [
        ("What was found", "Probability of every effect.", _ranking(diagnosis)),
        ("Where and when", "What the nominal robot leaves, with its parameters fitted and numerical error taken off."
         + which, _heat(diagnosis)),
        ("Before and after", "The point with the largest error: measured less simulated. The band is two standard "
         "deviations of the noise." + which, _overlay(diagnosis)),
    ]  # fmt: skip
    if diagnosis.best.names:
        caption = "Evidence gained by the best hypothesis in every second." + which
        plots.append(("When it is explained", caption, _gain(diagnosis)))
    if curve := force_against_state(diagnosis):
        caption = _CURVE.format(curve.effect.location, 100 * curve.share)
        plots.append((f"What {curve.effect.name} does", caption, _curve(curve)))
    if diagnosis.ranked_locations:
        site = diagnosis.ranked_locations[0]
        input_model = "linear in what the robot is told and in its shape" if site.force.shares else "free in time"
        caption = f"What would explain most of it at {site.location}, {input_model}.{which}"
        plots.append(("What has no name", caption, _residual_force(site.force)))
    figures = "".join(
        f"<h2>{title}</h2><figure><img alt='{html.escape(caption)}' src='data:image/png;base64,{image}'>"
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for title, caption, image in plots
    )
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>Diagnosis</title><style>{_STYLE}</style>"
        f"<h1>Diagnosis of {html.escape(diagnosis.robot.name)}</h1><p class='verdict'>{html.escape(text)}</p>"
        f"{_effects_table(report)}{_next_table(report)}{_model_note(report)}{figures}"
        f"{_parameters_table(report)}{_rounds_table(report)}{_detectable_table(report)}</html>\n"
    )


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = "".join(f"<th>{html.escape(each)}</th>" for each in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(each)}</td>" for each in row) + "</tr>" for row in rows)
    return f"<h2>{html.escape(title)}</h2><table><tr>{cells}</tr>{body}</table>"


def _effects_table(report) -> str:
    rows = []
    for effect in report["effects"][:_RANKED]:
        location = effect["where"]
        site = " ".join(str(location[key]) for key in ("kind", "name", "index") if key in location) if location else ""
        values = "; ".join(_value(name, q) for name, q in effect["parameters"].items())
        said = "; ".join([*effect["evidence"], *(f"but {each}" for each in effect["against"])])
        rows.append([f"{effect['probability']:.2f}", effect["name"], site, values, said])
    return _table("Effects", ["probability", "effect", "place", "parameters", "evidence"], rows)


def _next_table(report) -> str:
    if (proposed := report["next_recording"]) is None:
        return ""
    pairs = "; ".join(" from ".join(pair) for pair in proposed["separates"]) or "-"
    row = [proposed["file"], proposed["motion"], pairs, f"{proposed['evidence_nats']:.0f}"]
    return _table("What to record next", ["actions", "motion", "would tell apart", "evidence [nats]"], [row])


def _model_note(report) -> str:
    if report["model_patch"] is None:
        said = f"There is no patched model: {report['model_patch_obstacle']}."
    else:
        has = " and ".join(["the fitted parameters", *report["model_patch_effects"]])
        said = f"{report['model_patch']} is the robot in MJCF with {has}."
    if report["model_patch"] and report["model_patch_lacks"]:
        said += f" It lacks {' and '.join(report['model_patch_lacks'])}, see {REMAINING}."
    return f"<h2>Patched model</h2><p>{html.escape(said)}</p>"


def _value(name, q) -> str:
    interval = f" [{q['ci90'][0]:.3g}, {q['ci90'][1]:.3g}]" if "ci90" in q else ""
    return f"{name} {q['value']:.3g}{interval}{spaced(q['unit'])}"


def _parameters_table(report) -> str:
    rows = []
    for name, p in report["parameters"].items():
        low, high = p["ci90"]
        rows.append([name, f"{p['value']:.4g}", f"{low:.4g} .. {high:.4g}", p["unit"], f"{p['prior_tension_sd']:+.1f}"])
    return _table("Parameters", ["parameter", "value", "90 %", "unit", "standard deviations from nominal"], rows)


def _rounds_table(report) -> str:
    rows = []
    for each in report["rounds"]:
        predicted_gain = "; ".join(
            f"{_at(screened_candidate)} {screened_candidate['gain']:.0f}" for screened_candidate in each["promised"]
        )
        fitted = "; ".join(f"{_together(one['effects'])} {one['excess']:.0f}" for one in each["fitted"])
        rows.append([_together(each["on_top_of"]) or "nothing", predicted_gain, fitted])
    head = ["on top of", "one more effect promises [nats]", "what the fits leave above noise [nats]"]
    return _table("How it came about", head, rows) if rows else ""


def _together(effects) -> str:
    return " with ".join(map(_at, effects))


def _at(effect) -> str:
    location = effect["where"]
    return " ".join(str(part) for part in (effect["name"], location["name"], location.get("index")) if part is not None)


def _detectable_table(report) -> str:
    rows = []
    for name, d in sorted(report["detectable"].items()):
        off = f" off {d['null']:g}" if d["null"] else ""
        rows.append([name, d["quantity"], f"{d['minimum']:.2g}{spaced(d['unit'])}{off}"])
    rows += [[name, "", "not with these recordings"] for name in report["invisible"]]
    rows += [[name, "", "not looked for: no place here"] for name in report["not_looked_for"]]
    return _table("What would just have been seen", ["effect", "quantity", "smallest magnitude"], rows)


def _ranking(diagnosis) -> str:
    shown = [(f"{f.effect.name} at {f.effect.location}", f.probability) for f in findings(diagnosis)][:_RANKED]
    nothing = diagnosis.comparison.nothing
    no_more = "outliers only" if only_outliers(diagnosis) else "nothing missing"
    shown = sorted([*shown, (no_more, nothing), ("unknown", diagnosis.comparison.unknown)], key=lambda pair: pair[1])
    figure, axes = pyplot().subplots(figsize=(9, 0.4 + 0.3 * len(shown)), layout="constrained")
    axes.barh([name for name, _ in shown], [chance for _, chance in shown])
    axes.set(xlim=(0, 1), xlabel="probability")
    return _image(figure)


def _heat(diagnosis) -> str:
    scale, unit = _scale(diagnosis)
    shown = scale * residual_map(diagnosis.explanation.problem, diagnosis.explanation.nominal.residual)
    figure, axes = pyplot().subplots(figsize=(9, 3.6), layout="constrained")
    window = map_window(diagnosis.explanation.problem)
    edges = window * np.arange(len(shown) + 1)
    mesh = axes.pcolormesh(edges, np.arange(shown.shape[1] + 1), shown.T, cmap="magma_r")
    axes.set(xlabel="time [s]", ylabel="point of the signal")
    figure.colorbar(mesh, label=f"rms left [{unit}]")
    return _image(figure)


def _overlay(diagnosis) -> str:
    explanation = diagnosis.explanation
    problem, best = explanation.problem, diagnosis.best.hypothesis
    measured = problem.recordings[0]
    before, after = (left_over(problem, h.residual) for h in (explanation.nominal, best))
    point = int(np.nansum(before**2, axis=(0, 2)).argmax())
    (scale, unit), rows = _scale(diagnosis), before.shape[2]
    figure, axes = pyplot().subplots(rows, 1, figsize=(9, 1 + 1.5 * rows), sharex=True, layout="constrained")
    axes = np.atleast_1d(axes)
    for axis, ax in enumerate(axes):
        ax.axhspan(-2 * scale * problem.sensor, 2 * scale * problem.sensor, color="0.85", lw=0)
        for left, color, label in ((before, "C3", "parameters fitted"), (after, "C0", "best hypothesis")):
            values = scale * left[:, point, axis]
            seen = np.isfinite(values)  # a line with gaps would not show what is between two of them
            ax.plot(measured.time[seen], values[seen], color=color, lw=0.8, label=label)
        ax.set_ylabel(f"{'xyz'[axis]} [{unit}]" if rows == 3 else f"[{unit}]")
    axes[0].legend(loc="upper right", ncols=2, frameon=False)
    axes[0].set_title(f"point {point}")
    axes[-1].set_xlabel("time [s]")
    return _image(figure)


def _residual_force(force) -> str:
    figure, axes = pyplot().subplots(figsize=(9, 3), layout="constrained")
    first = force.recording == 0
    for name, unit, values in zip(force.components, force.units, force.values[first].T, strict=True):
        axes.plot(force.start[first], values, label=f"{name} [{unit}]")
    axes.set(xlabel="time [s]")
    axes.legend(loc="upper right")
    return _image(figure)


def _gain(diagnosis) -> str:
    explanation = diagnosis.explanation
    measured = explanation.problem.recordings[0]
    gain = explained_over_time(explanation.problem, explanation.nominal, diagnosis.best.hypothesis)
    figure, axes = pyplot().subplots(figsize=(9, 2.4), layout="constrained")
    edges = np.arange(0.0, measured.time[-1] + 1.0)
    axes.stairs(np.histogram(measured.time - 1e-9, edges, weights=gain)[0], edges, fill=True)
    axes.set(xlabel="time [s]", ylabel="evidence [nats/s]")
    return _image(figure)


def _curve(curve: Curve) -> str:
    figure, axes = pyplot().subplots(figsize=(9, 3.6), layout="constrained")
    axes.axhline(0.0, color="0.85", lw=1)
    columns = zip(("falling", "rising"), curve.state, curve.law, curve.measured, curve.deviation, strict=True)
    for color, (direction, state, law, measured, deviation) in zip(("C0", "C1"), columns, strict=True):
        axes.plot(state, law, color=color, label=f"fitted law, {direction}")
        label = f"recordings, {direction}"
        axes.errorbar(state, measured, NINETY * deviation, color=color, fmt="o", capsize=3, label=label)
    axes.set(xlabel=curve.labels[0], ylabel=curve.labels[1])
    axes.legend(frameon=False, ncols=2)
    return _image(figure)


def _scale(diagnosis) -> tuple[float, str]:
    """What lengths and others are shown in."""
    unit = diagnosis.robot.unit
    return (1e3, "mm") if unit == "m" else (1.0, unit)


def _image(figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    pyplot().close(figure)
    return base64.b64encode(buffer.getvalue()).decode()
