"""Tables and plots of results."""

import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from soro_bench.files import read_json, replacing, write_json
from soro_bench.registration import task_type
from soro_bench.results import interval, metric_key


def write_report(folder: str | Path) -> str:
    """Gather every evaluation under ``folder`` into results.json, results.md and a plot each per environment.

    Args:
        folder: holds <environment>/<method>/seed<k>/ as written by :func:`soro_bench.experiment.run_method`.

    Returns:
        The table, Markdown.
    """
    folder = Path(folder)
    results = []
    for env_folder in sorted({path.parents[2] for path in folder.glob("*/*/seed*/evaluation_*.json")}):
        of_env = [read_json(path) for path in sorted(env_folder.glob("*/seed*/evaluation_*.json"))]
        curves = defaultdict(list)
        for path in sorted(env_folder.glob("*/seed*/curve.csv")):
            curves[path.parents[1].name].append(path)
        metric = task_type(env_folder.name).metric
        plot_curves(curves, metric, env_folder / "curves.png")
        plot_results(of_env, metric, env_folder / f"{metric}s.png")
        results += of_env
    table = markdown_table(table_rows(results))
    write_json(folder / "results.json", results)
    with replacing(folder / "results.md") as temporary:
        temporary.write_text(table + "\n")
    return table


def table_rows(results: Sequence[dict]) -> list[dict]:
    """One row per method, training model and evaluation model: mean metric with its bootstrap interval."""
    groups = defaultdict(list)
    for result in results:
        policy = result["policy"]
        groups[policy["env_id"], policy["method"], policy["model"], result["evaluated_on"]].append(result)
    rows = []
    for (env_id, method, trained_on, evaluated_on), members in groups.items():
        metric = task_type(env_id).metric
        values = [member[metric_key(metric)] for member in members]
        mean, low, high = interval(values)
        rows.append({
            "environment": env_id,
            "method": method,
            "trained on": trained_on,
            "evaluated on": evaluated_on,
            "seeds": len(members),
            "episodes": sum(map(len, values)),
            "metric": metric,
            "mean": mean,
            "low": low,
            "high": high,
            "success": float(np.mean([np.mean(member["success"]) for member in members])),
        })  # fmt: skip
    return rows


def markdown_table(rows: Sequence[dict]) -> str:
    """The rows of ``table_rows`` as a Markdown table."""
    lines = [
        "| environment | method | trained on | evaluated on | seeds | metric | mean [mm], 95 % interval | solved |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        figures = f"{row['mean']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"
        cells = [row["environment"], row["method"], row["trained on"], row["evaluated on"], row["seeds"]]
        cells += [f"final {row['metric']}", figures]
        lines.append("| " + " | ".join(map(str, cells)) + f" | {row['success']:.0%} |")
    return "\n".join(lines)


def plot_curves(files: Mapping[str, Sequence[Path]], metric: str, path: str | Path) -> None:
    """Final metric over training steps, from curve.csv files by label: thin lines, and their median."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for i, (label, runs) in enumerate(files.items()):
        curves = [read_curve(run, metric) for run in runs]
        for steps, value in curves:
            axes.plot(steps, value, color=f"C{i}", alpha=0.3, lw=0.8)
        grid = max((steps for steps, _ in curves), key=len)
        median = np.median([np.interp(grid, steps, value) for steps, value in curves], axis=0)
        axes.plot(grid, median, color=f"C{i}", lw=2, label=f"{label} ({len(curves)} runs)")
    axes.set(xlabel="environment steps", ylabel=f"final {metric} in training [mm]")
    if metric == "distance":
        axes.set_yscale("log")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    _save(figure, path)


def plot_results(results: Sequence[dict], metric: str, path: str | Path) -> None:
    """Final metric of every evaluation episode, a column per method and evaluation model, with the means."""
    plt = pyplot()
    groups = defaultdict(list)
    for result in results:
        groups[f"{result['policy']['method']}\non {result['evaluated_on']}"] += result[metric_key(metric)]
    figure, axes = plt.subplots(figsize=(1.5 + 1.2 * len(groups), 4.0), layout="constrained")
    rng = np.random.default_rng(0)
    for i, values in enumerate(groups.values()):
        axes.scatter(i + rng.uniform(-0.18, 0.18, len(values)), values, s=8, alpha=0.5, color=f"C{i}", linewidths=0)
        axes.hlines(np.mean(values), i - 0.3, i + 0.3, color="black", lw=2)
    axes.set_xticks(range(len(groups)), groups)
    axes.set(ylabel=f"final {metric} [mm]", xlim=(-0.6, len(groups) - 0.4))
    if metric == "distance":
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3, axis="y")
    _save(figure, path)


def read_curve(path: str | Path, metric: str, parts: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Steps and mean final metric [mm] of the episodes in each of so many equal parts of a training.

    A part mixes whole updates: the episodes that end early in an update are the successful ones.
    """
    with Path(path).open() as file:
        rows = [tuple(float(row[name]) for name in ("steps", "episodes", metric_key(metric)))
                for row in csv.DictReader(file)]  # fmt: skip
    steps, episodes, value = np.array(rows).T
    part = np.minimum((parts * steps / steps[-1]).astype(int), parts - 1)
    present = np.unique(part)
    means = [np.average(value[part == k], weights=episodes[part == k]) for k in present]
    return (present + 0.5) / parts * steps[-1], np.array(means)


def pyplot():
    """Matplotlib without a display, or ImportError with what to install."""
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("plots need matplotlib: pip install soro_bench[report]") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure, path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix.lstrip("."), dpi=150, metadata={"Software": None})
