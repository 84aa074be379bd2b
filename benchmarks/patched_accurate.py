"""What a diagnosis has found with the cheap model, in the accurate one: errors on motion that it has not seen.

    python benchmarks/patched_accurate.py FOLDER    # as soro-bench blind-benchmark leaves it, with scored reports

Of robots that are the accurate model with hidden physics, most of what the patched cheap model gets wrong is the
difference between the two models. The fitted parameters and effects belong to the robot, not to a model: this puts them
into the accurate one too. Prints medians over the cases whose report names missing physics.
"""

import argparse
from pathlib import Path

import numpy as np
from rich.progress import track

from soro_bench.blind_benchmark.ablations import ENV_ID
from soro_bench.blind_benchmark.score import opened_labels
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json
from soro_bench.markdown import table
from soro_bench.recording.parquet import load

MODELS = ("cable", "flex")


def found(report: dict) -> list[Effect]:
    """The effects of the most probable hypothesis."""
    best, effects = report["hypotheses"][0], []
    for name, location in zip(best["names"], best["where"], strict=True):
        values = next(e["parameters"] for e in report["effects"] if (e["name"], e["where"]) == (name, location))
        effects.append(Effect(name, Location(**location), {key: each["value"] for key, each in values.items()}))
    return effects


def errors(robot: SuiteRobot, report: dict, recording) -> tuple[float, float]:
    """rms of a coordinate [m] with the fitted parameters, without the effects and with them."""
    measured = robot.measured(recording)
    parameters = np.array([[report["parameters"][prior.name]["value"] for prior in robot.priors]] * 2)
    simulated = robot.simulate(measured.actions, parameters, [(), found(report)])
    return tuple(np.sqrt(np.nanmean((measured.values - simulated) ** 2, axis=(1, 2, 3))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    robots = {model: SuiteRobot(ENV_ID, model) for model in MODELS}
    found = {model: [] for model in MODELS}
    labels = {label["id"]: label for label in opened_labels(folder / "cases")}
    for path in track(sorted((folder / "reports").glob("case_*.json")), "cases"):
        report, label = read_json(path), labels[path.stem]
        if label["robot"] != "flex" or not label["effects"] or report["verdict"] != "missing_physics":
            continue
        for model, robot in robots.items():
            found[model].append(errors(robot, report, load(folder / "cases" / path.stem / "task.parquet")))
    rows = []
    for model, pairs in found.items():
        before, after = 1e3 * np.array(pairs).T
        medians = (f"{np.median(values):.2f}" for values in (before, after, after / before))
        rows.append((f"`{model}`", len(pairs), *medians))
    heads = ("model", "cases", "fitted parameters only [mm]", "with the effects [mm]", "after over before")
    print(table(heads, rows))


if __name__ == "__main__":
    main()
