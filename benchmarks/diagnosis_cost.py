"""Seconds and memory of `soro-bench diagnose` on cases of a blind benchmark, each in a process of its own.

    python benchmarks/diagnosis_cost.py FOLDER --cases 20    # as soro-bench blind-benchmark leaves it

Run it with nothing beside it. The diagnosis has all processors, or OMP_NUM_THREADS of them. A case that is in
FOLDER/cost is not diagnosed again. Machines are compared by how often the bare engine could have simulated 30 s of the
same robot instead.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from rich.progress import track

from soro_bench.blind_benchmark.ablations import ENV_ID
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.parallel import processors

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
        report = json.loads((Path(out) / "report.json").read_text())
    return {
        "seconds": round(seconds, 1),
        "diagnosis": report["seconds"],
        "bare_replay": round(bare_replay(), 3),
        "megabytes": usage.ru_maxrss // 1024,
        "threads": processors(),
        "verdict": report["verdict"],
        "effects": [effect["name"] for effect in report["effects"]][:3],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=20, help="the first ones")
    options = parser.parse_args()
    cases = sorted((options.folder / "cases").glob("case_*"))[: options.cases]
    if not cases:
        parser.error(f"{options.folder} has no cases")
    found = [options.folder / "cost" / f"{case.name}.json" for case in cases]
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


if __name__ == "__main__":
    main()
