"""Releases of the diagnosis: packed, unpacked, and measured again.

    python benchmarks/releases.py pack FOLDER docs/results/releases/release_7.json.xz
    python benchmarks/releases.py unpack docs/results/releases/release_6.json.xz FOLDER
    python benchmarks/releases.py cost FOLDER [--cases 20]
    python benchmarks/releases.py accurate FOLDER
    python benchmarks/releases.py tables

FOLDER is as soro-bench blind-benchmark leaves it.

pack, unpack: a scored release becomes one file; its labels and reports are written out again.

cost: seconds and memory of `soro-bench diagnose` on its cases, each in a process of its own. Run it with nothing beside
it. The diagnosis has all processors, or OMP_NUM_THREADS of them. A case that is in FOLDER/cost is not diagnosed again.
Machines are compared by how often the bare engine could have simulated 30 s of the same robot instead.

accurate: what a diagnosis has found with the cheap model, in the accurate one, on motion that it has not seen. Of
robots that are the accurate model with hidden physics, most of what the patched cheap model gets wrong is the
difference between the two models. The fitted parameters and effects belong to the robot, not to a model: this puts them
into the accurate one too. Prints medians over the cases whose report names missing physics.

tables: all scored releases side by side, acceptance criteria and errors on motion that nothing was fitted to, and the
parameters of SoroSim's rods, as in docs/explanation/benchmark.md and docs/archive/diagnosis.md.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from rich.progress import track

from soro_bench.blind_benchmark.ablations import ENV_ID
from soro_bench.blind_benchmark.score import opened_labels
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from soro_bench.leaderboard.diagnosis_entry import Release, read_entry
from soro_bench.markdown import table
from soro_bench.packed import names
from soro_bench.parallel import processors
from soro_bench.recording.parquet import load
from soro_bench.recording.recording import Recording

# --- tables ---

ROOT = Path(__file__).parents[1]
ROBOTS = {"fine": "the lumped model with shorter time steps", "flex": "the accurate model"}
# what a criterion is called in tables and figures; the entries of the leaderboard keep the names they were scored with
WORDS = {
    "detected": "discrepancy detected",
    "first answer right": "first answer correct",
    "right among the first three": "correct among the first three",
    "class right": "class correct",
    "of right names: place right": "of correct laws: location correct",
    "of right names: cable right": "of correct laws: cable correct",
    "of right names: segment or keypoint within one": "of correct laws: segment or keypoint within one",
    "unseen motion: variance explained, median, numerical error off":
        "unseen motion: variance explained, median, discretisation error off",
    "unknown called unknown": "outside the catalogue, flagged so",
    "unknown called so, at the right place": "the same, at the correct location",
    "physics and measurement confused": "physics and sensor fault confused",
    "first answer right where parameters hide 90 %": "first answer correct where parameters absorb 90 %",
    "the same, where they hide half": "the same, where they absorb half",
    "seconds, median": "time, median [s]",
    "other simulators: first answer right": "other simulators: first answer correct",
    "other simulators: of right names, place right": "other simulators: of correct laws, location correct",
}  # fmt: skip
# rows without a threshold
ALSO = ("unseen motion: variance explained, median, all of the error", "the same, where they hide half")


def releases() -> list[Path]:
    """Files of the releases, in their order; they are in the archive beside their folder."""
    folder = ROOT / "docs" / "results" / "releases"
    return [folder / name for name in names(folder) if name.endswith(".json.xz")]


def scores(release: Path) -> list[dict]:
    """The criteria of a release as the leaderboard has them, of which those with a threshold and some others."""
    number = release.name.partition(".")[0].removeprefix("release_")
    entry = read_entry(ROOT / "leaderboard" / "results" / "diagnosis" / f"soro_bench_{number}.json")
    return [gate for gate in entry["gates"] if gate["bar"] is not None or gate["gate"] in ALSO]


def called(criterion: dict) -> str:
    """What a criterion is called."""
    return WORDS.get(criterion["gate"], criterion["gate"])


def threshold(criterion: dict) -> str:
    """The limit of a criterion, with its direction; empty where it has none."""
    return "" if criterion["bar"] is None else f"{'<=' if criterion['below'] else '>='} {criterion['bar']:g}"


def last_release(release: Path) -> str:
    """A row per criterion of one release, Markdown."""
    rows = []
    for each in scores(release):
        value, interval = "no such case", ""
        if each["value"] is not None:
            value, interval = f"{each['value']:.3g}", "{:.3g} to {:.3g}".format(*each["interval"])
        met = {True: "yes", False: "**no**", None: ""}[each["met"]]
        rows.append((called(each), threshold(each), value, interval, each["cases"], met))
    return table(("criterion", "threshold", "value", "95 % interval", "robots", "met"), rows)


def all_releases(files: Sequence[Path]) -> str:
    """A row per criterion, a column per release, Markdown."""
    by_name = [{each["gate"]: each for each in scores(path)} for path in files]
    rows = [
        (called(each), threshold(each), *(_cell(release.get(name)) for release in by_name))
        for name, each in by_name[-1].items()
    ]
    return table(("criterion", "threshold", *map(name_of, files)), rows)


def _cell(criterion: dict | None) -> str:
    """A value with its interval; releases of before have fewer criteria, and had other thresholds."""
    if criterion is None:
        return ""
    if criterion["value"] is None:
        return "no such case"
    low, high = criterion["interval"]
    text = f"{criterion['value']:.3g} [{low:.3g}, {high:.3g}] of {criterion['cases']}"
    return f"**missed:** {text}" if criterion["met"] is False else text


def unseen(files: Sequence[Path]) -> str:
    """Median rms [mm] of the third recording before and after the patch, of robots with an effect of the catalogue;
    Markdown."""
    found = [Release.load(path) for path in files]
    rows = [(text, *(_unseen(release, robot) for release in found)) for robot, text in ROBOTS.items()]
    return table(("the recorded robot is", *(f"{name_of(each)} [mm]" for each in files)), rows)


def _unseen(release: Release, robot: str) -> str:
    labels = release.labels["cases"]
    wanted = [label["id"] for label in labels if label["robot"] == robot and label["group"] in ("one", "two")]
    errors = [release.reports[name]["unseen"] for name in wanted]
    before, after = np.median([(each["rmse_before"], each["rmse_after"]) for each in errors if each], axis=0)
    return f"{1e3 * before:.1f}, {1e3 * after:.1f}"


def rods(release: Path) -> str:
    """How far the parameters of SoroSim's steel rods are off, whose models were wrong by up to 22 %; Markdown."""
    found = Release.load(release)
    labels = [label for label in found.labels["cases"] if label.get("kind") == "sorosim"]
    rows = []
    for name in labels[0]["parameters"] if labels else ():
        pairs = [(each["parameters"][name]["value"], found.reports[each["id"]]["parameters"][name]) for each in labels]
        off = [100 * abs(said["value"] / true - 1.0) for true, said in pairs]
        inside = sum(said["ci90"][0] <= true <= said["ci90"][1] for true, said in pairs)
        rows.append((name, len(pairs), f"{np.median(off):.1f}", f"{np.max(off):.1f}", inside))
    return table(("parameter", "rods", "median error [%]", "largest [%]", "in their 90 % interval"), rows)


def name_of(release: Path) -> str:
    """What a release is called in tables and figures."""
    return release.name.partition(".")[0].replace("_", " ")


# --- cost ---

DURATION = 30.0  # s, of a recording


def bare_replay() -> float:
    """Wall time [s] of mj_step for DURATION of the robot at rest, on one thread; the least of three."""
    model, taken = SuiteRobot(ENV_ID, threads=1).simulation.model, []
    for _ in range(3):
        data, begin = mujoco.MjData(model), time.perf_counter()
        mujoco.mj_step(model, data, nstep=round(DURATION / model.opt.timestep))
        taken.append(time.perf_counter() - begin)
    return min(taken)


def diagnosed(case: Path) -> dict:
    """Wall time [s] and memory [MB] of a diagnosis from the command line, and the verdict."""
    with tempfile.TemporaryDirectory() as out:
        paths = [str(case / "train.parquet"), "--heldout", str(case / "heldout.parquet")]
        command = [sys.executable, "-m", "soro_bench.cli", "diagnose", *paths, "--env", ENV_ID, "--out", out]
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - begin
        if status:
            raise SystemExit(f"the diagnosis of {case} failed")
        result = Result.load(Path(out) / "result.json")
    return {
        "seconds": round(seconds, 1),
        "diagnosis": result.seconds,
        "bare_replay": round(bare_replay(), 3),
        "megabytes": usage.ru_maxrss // 1024,
        "threads": processors(),
        "verdict": result.verdict,
        "effects": [finding.name for finding in result.findings][:3],
    }


def cost(folder: Path, count: int) -> None:
    """Print the table, and medians."""
    cases = sorted((folder / "cases").glob("case_*"))[:count]
    if not cases:
        raise SystemExit(f"{folder} has no cases")
    found = [folder / "cost" / f"{case.name}.json" for case in cases]
    for case, path in track(list(zip(cases, found, strict=True)), "cases"):
        if not path.exists():
            write_json(path, diagnosed(case))
    rows = [read_json(path) for path in found]
    cells = [
        (case.name, row["seconds"], row["diagnosis"], row["megabytes"], ", ".join(row["effects"]))
        for case, row in zip(cases, rows, strict=True)
    ]
    print(table(("case", "seconds, whole command", "of it the diagnosis", "MB", "answers"), cells))
    seconds = [row["diagnosis"] for row in rows]
    print(f"\nMedian {np.median(seconds):.0f} s on {rows[0]['threads']} threads ({min(seconds):.0f} to "
          f"{max(seconds):.0f}), at most {max(row['megabytes'] for row in rows)} MB.")  # fmt: skip
    ratios = [row["diagnosis"] / row["bare_replay"] for row in rows if "bare_replay" in row]  # older ones lack it
    if ratios:
        print(f"Median {np.median(ratios):.0f} times {DURATION:.0f} s of the bare engine on one thread.")


# --- in the accurate model ---

MODELS = ("cable", "flex")


def found(report: dict) -> list[Effect]:
    """The effects of the most probable hypothesis."""
    best, effects = report["hypotheses"][0], []
    for name, location in zip(best["names"], best["where"], strict=True):
        values = next(e["parameters"] for e in report["effects"] if (e["name"], e["where"]) == (name, location))
        effects.append(Effect(name, Location(**location), {key: each["value"] for key, each in values.items()}))
    return effects


def errors(robot: SuiteRobot, report: dict, recording: Recording) -> tuple[float, float]:
    """rms of a coordinate [m] with the fitted parameters, without the effects and with them."""
    measured = robot.measured(recording)
    parameters = np.array([[report["parameters"][prior.name]["value"] for prior in robot.priors]] * 2)
    simulated = robot.simulate(measured.actions, parameters, [(), found(report)])
    return tuple(np.sqrt(np.nanmean((measured.values - simulated) ** 2, axis=(1, 2, 3))))


def accurate(folder: Path) -> None:
    """Print the table."""
    robots = {model: SuiteRobot(ENV_ID, model) for model in MODELS}
    pairs: dict[str, list] = {model: [] for model in MODELS}
    labels = {label["id"]: label for label in opened_labels(folder / "cases")}
    for path in track(sorted((folder / "reports").glob("case_*.json")), "cases"):
        report, label = read_json(path), labels[path.stem]
        if label["robot"] != "flex" or not label["effects"] or report["verdict"] != "missing_physics":
            continue
        for model, robot in robots.items():
            pairs[model].append(errors(robot, report, load(folder / "cases" / path.stem / "task.parquet")))
    rows: list[tuple[str | float, ...]] = []
    for model, both in pairs.items():
        before, after = 1e3 * np.array(both).T
        medians = (f"{np.median(values):.2f}" for values in (before, after, after / before))
        rows.append((f"`{model}`", len(both), *medians))
    heads = ("model", "cases", "fitted parameters only [mm]", "with the effects [mm]", "after over before")
    print(table(heads, rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="do", metavar="pack | unpack | cost | accurate | tables")
    for name in ("pack", "unpack"):
        command = commands.add_parser(name)
        command.add_argument("source", type=Path)
        command.add_argument("target", type=Path)
    for name in ("cost", "accurate"):
        commands.add_parser(name).add_argument("folder", type=Path)
    commands.add_parser("tables")
    commands.choices["cost"].add_argument("--cases", type=int, default=20, help="the first ones")
    options = parser.parse_args()
    if options.do == "pack":
        Release.gather(options.source).pack(options.target)
    elif options.do == "unpack":
        Release.load(options.source).unpack(options.target)
    elif options.do == "tables":
        files = releases()
        shown = last_release(files[-1]), unseen(files[-1:]), rods(files[-1]), all_releases(files), unseen(files)
        print(*shown, sep="\n\n")
    elif options.do == "cost":
        cost(options.folder, options.cases)
    else:
        accurate(options.folder)


if __name__ == "__main__":
    main()
