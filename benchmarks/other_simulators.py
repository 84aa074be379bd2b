"""Other simulators as robots: does a diagnosis take what another simulator does differently for physics?

    python benchmarks/other_simulators.py --out FOLDER [--healthy | --hidden] [--kind flex links] [--count 4]
        [--seed 1000] [--sorosim data/real/sorosim_reference] [--diagnose] [--cost]

Writes a folder for each case: train.parquet, heldout.parquet and label.json. Healthy robots are of every kind of
``soro_bench/blind_benchmark/healthy.py``, --count of each, and with --sorosim, the folder of its releases, steel rods
of SoroSim (also model.xml and map.toml, nothing held out). Hidden physics acts in trunks that PyElastica simulates, one
law after the other, --count cases in all. With --diagnose also answer.json of each case, and then tables, with
intervals of 95 %: false alarms by kind, right names and locations by law. The same command goes on with what is
missing. With --cost each case is diagnosed on all processors in a process of its own, and a table says what that
costs: wall time, CPU time, peak memory, how many replays of the recording the CPU time is worth, and the share of each
stage. PyElastica needs `pip install ".[simulators]"`. Seeds from 1000 are for development; thresholds are never set on
others.
"""

import argparse
import itertools
import multiprocessing
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from scipy.stats import binomtest

from soro_bench.blind_benchmark import healthy, sorosim
from soro_bench.blind_benchmark.score import same_location
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.pipeline import Run, run_diagnosis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording

LABEL, ANSWER, MODEL, MAP = "label.json", "answer.json", "model.xml", "map.toml"
COST = "cost.json"
SIDE_BY_SIDE = 16  # replays that are timed
HIDDEN, SOROSIM = "hidden", "sorosim"


def write_case(kind: str, seed: int, folder: Path, data: Path | None) -> None:
    """Unless its label, which is written last, is there; ``data`` is the folder of SoroSim's releases."""
    if (folder / LABEL).exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    if kind == SOROSIM:
        if data is None:
            raise ValueError("recordings of SoroSim are in a folder that --sorosim names")
        files, recording, label = sorosim.build(data, seed)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        recordings = {"train": recording}
    elif kind == HIDDEN:
        from soro_bench.blind_benchmark import cosserat_laws  # needs a package that healthy robots do not

        recordings, label = cosserat_laws.build(seed)
    else:
        recordings, label = healthy.build(kind, seed)
    for role, recording in recordings.items():
        save(recording, folder / f"{role}.parquet")
    write_json(folder / LABEL, label)


def given(folder: Path, threads: int) -> tuple[Robot, list[Recording], list[Recording]]:
    """The robot of a case, the recording to explain and a held-out one, if there is one."""
    robot: Robot
    if (folder / MODEL).exists():
        robot = ModelRobot(folder / MODEL, folder / MAP, threads)
    else:
        robot = SuiteRobot("TrunkReach-v0", threads=threads)
    return robot, [load(folder / "train.parquet")], [load(path) for path in folder.glob("heldout.parquet")]


def diagnosed(folder: Path) -> dict:
    """What a diagnosis of a case says."""
    begin = time.process_time()
    result = diagnose(*given(folder, threads=1))
    first = result.findings[0]
    place = first.location.to_json() if first.location else None
    return {
        "verdict": result.verdict, "name": first.name, "location": place, "probability": first.probability,
        "seconds": result.seconds, "cpu_seconds": time.process_time() - begin,
        "hypotheses": [[list(each.names), each.evidence, each.misfit_total] for each in result.hypotheses],
    }  # fmt: skip


def cost(folder: Path) -> dict:
    """What a diagnosis of a case costs on all processors: seconds of wall and CPU, also by stage, memory, and CPU
    seconds of one plain replay of the recording to explain."""
    marks = [("", time.perf_counter(), time.process_time())]

    def progress(stage: str) -> None:
        marks.append((stage, time.perf_counter(), time.process_time()))

    robot, recordings, heldout = given(folder, threads=0)
    found = run_diagnosis(robot, recordings, heldout, Run(progress=progress))
    progress("result")
    result = build_result(found)
    progress("")
    stages: dict[str, float] = {}
    for (stage, _, begin), (_, _, end) in itertools.pairwise(marks):
        stages[stage or "beginning"] = stages.get(stage or "beginning", 0.0) + end - begin
    (_, first, begin), (_, last, end) = marks[0], marks[-1]
    wall, processor = last - first, end - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    drive = robot.measured(recordings[0]).drive
    nominal = np.array([prior.nominal for prior in robot.priors])
    parameters = nominal * (1.0 + 1e-6 * np.arange(SIDE_BY_SIDE)[:, None])  # the same ones would be simulated once
    begin = time.process_time()
    robot.simulate_all([drive], parameters, [()] * SIDE_BY_SIDE)
    replay = (time.process_time() - begin) / SIDE_BY_SIDE
    return {"verdict": result.verdict, "wall_seconds": wall, "cpu_seconds": processor, "memory_gb": memory,
            "replay_cpu_seconds": replay, "stages": stages}  # fmt: skip


def cost_table(costs: Sequence[tuple[str, dict]]) -> str:
    """Markdown: what each case costs, and medians."""
    rows = []
    for name, found in costs:
        processor = found["cpu_seconds"]
        shares = [f"{stage} {100 * part / processor:.0f}" for stage, part in found["stages"].items()]
        large = [share for share, part in zip(shares, found["stages"].values(), strict=True) if part > 0.01 * processor]
        cores, replays = processor / found["wall_seconds"], processor / found["replay_cpu_seconds"]
        rows.append((name, found["wall_seconds"], processor, cores, found["memory_gb"], replays, ", ".join(large)))
    columns = list(zip(*rows, strict=True))
    rows.append(("median", *(median(column) for column in columns[1:-1]), ""))
    texts = [[a, f"{b:.0f}", f"{c:.0f}", f"{d:.2f}", f"{e:.2f}", f"{f:.0f}", g] for a, b, c, d, e, f, g in rows]
    return table(["case", "wall [s]", "CPU [s]", "cores", "memory [GB]", "replays", "share of stages [%]"], texts)


def summary(cases: Sequence[tuple[dict, dict]]) -> str:
    """Markdown: two tables of (label, answer)."""
    alarms, names = [], []
    for kind in sorted({label["kind"] for label, _ in cases}):
        chosen = [(label, answer) for label, answer in cases if label["kind"] == kind]
        cost = f"{median(answer['cpu_seconds'] for _, answer in chosen):.0f}"
        if not chosen[0][0]["effects"]:
            alarms.append([kind, *share([answer["verdict"] != "adequate" for _, answer in chosen]), cost])
            continue
        right = [answer["name"] in label["effects"][0]["names"] for label, answer in chosen]
        place = [same_location(label["effects"][0]["where"], answer["location"]) for label, answer in chosen]
        names.append([kind, *share(right), *share(place), cost])
    healthy_table = table(["healthy robot", "false alarms", "95 % [%]", "median CPU [s]"], alarms)
    columns = ["hidden", "right name first", "95 % [%]", "right location", "95 % [%]", "median CPU [s]"]
    return "\n\n".join([healthy_table] * bool(alarms) + [table(columns, names)] * bool(names))


def share(said: Sequence[bool]) -> tuple[str, str]:
    """How many are true, and the interval of their share."""
    low, high = binomtest(sum(said), len(said)).proportion_ci(method="wilson")
    return f"{sum(said)} of {len(said)}", f"{100 * low:.0f} to {100 * high:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--healthy", action="store_true", help="healthy robots only")
    which.add_argument("--hidden", action="store_true", help="robots with hidden physics only")
    parser.add_argument("--kind", nargs="+", choices=tuple(healthy.ROBOTS), default=list(healthy.ROBOTS))
    parser.add_argument("--count", type=int, default=4, help="healthy cases of each kind, and hidden cases")
    parser.add_argument("--seed", type=int, default=1000, help="of the first case")
    parser.add_argument("--sorosim", type=Path, help="folder with SoroSim's releases.csv")
    parser.add_argument("--diagnose", action="store_true")
    parser.add_argument("--cost", action="store_true", help="what a diagnosis of each case costs")
    chosen = parser.parse_args()
    kinds = [*chosen.kind, *[SOROSIM] * (chosen.sorosim is not None)] if not chosen.hidden else []
    kinds += [HIDDEN] * (not chosen.healthy)
    cases = [
        (kind, seed, chosen.out / f"{kind}_{seed}")
        for kind in kinds
        for seed in range(chosen.seed, chosen.seed + chosen.count)
    ]
    for kind, seed, folder in cases:
        write_case(kind, seed, folder, chosen.sorosim)
        print(folder, flush=True)
        if chosen.diagnose and not (folder / ANSWER).exists():
            write_json(folder / ANSWER, diagnosed(folder))
        if chosen.cost and not (folder / COST).exists():
            with multiprocessing.get_context("spawn").Pool(1) as pool:  # its peak of memory is of this case alone
                write_json(folder / COST, pool.apply(cost, (folder,)))
    if costs := [(f.name, read_json(f / COST)) for _, _, f in cases if (f / COST).exists()]:
        print(cost_table(costs))
    done = [(read_json(f / LABEL), read_json(f / ANSWER)) for _, _, f in cases if (f / ANSWER).exists()]
    if done:
        (chosen.out / "summary.md").write_text(summary(done) + "\n", encoding="utf-8")
        print(summary(done))


if __name__ == "__main__":
    main()
