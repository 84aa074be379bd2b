"""Other simulators as robots: does a diagnosis take what another simulator does differently for physics?

    python benchmarks/other_simulators.py --out FOLDER [--kind flex links] [--count 4] [--seed 1000] [--diagnose]

Writes a folder for each case: train.parquet, heldout.parquet and label.json. With --diagnose also answer.json, and then
prints and writes a table: false alarms by kind with intervals of 95 %. The same command goes on with what is missing.
The kind pyelastica needs `pip install ".[simulators]"`. Seeds from 1000 are for development; thresholds are never set
on others.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from scipy.stats import binomtest

from soro_bench.blind_benchmark import healthy
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.parquet import load, save

LABEL, ANSWER = "label.json", "answer.json"


def write_case(kind: str, seed: int, folder: Path) -> None:
    """Unless its label, which is written last, is there."""
    if (folder / LABEL).exists():
        return
    recordings, label = healthy.build(kind, seed)
    folder.mkdir(parents=True, exist_ok=True)
    for role, recording in recordings.items():
        save(recording, folder / f"{role}.parquet")
    write_json(folder / LABEL, label)


def diagnosed(folder: Path) -> dict:
    """What a diagnosis of a case says."""
    begin = time.process_time()
    robot = SuiteRobot("TrunkReach-v0", threads=1)
    result = diagnose(robot, [load(folder / "train.parquet")], [load(folder / "heldout.parquet")])
    first = result.findings[0]
    place = first.location.to_json() if first.location else None
    return {
        "verdict": result.verdict, "name": first.name, "location": place, "probability": first.probability,
        "seconds": result.seconds, "cpu_seconds": time.process_time() - begin,
    }  # fmt: skip


def false_alarms(cases: Sequence[tuple[dict, dict]]) -> str:
    """Markdown: by kind, of (label, answer)."""
    rows = []
    for kind in sorted({label["kind"] for label, _ in cases}):
        answers = [answer for label, answer in cases if label["kind"] == kind]
        alarms = sum(answer["verdict"] != "adequate" for answer in answers)
        low, high = binomtest(alarms, len(answers)).proportion_ci(method="wilson")
        seconds = sorted(answer["cpu_seconds"] for answer in answers)[len(answers) // 2]
        rows.append([kind, f"{alarms} of {len(answers)}", f"{100 * low:.0f} to {100 * high:.0f}", f"{seconds:.0f}"])
    return table(["robot", "false alarms", "95 % [%]", "median CPU [s]"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kind", nargs="+", choices=tuple(healthy.ROBOTS), default=list(healthy.ROBOTS))
    parser.add_argument("--count", type=int, default=4, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=1000, help="of the first case")
    parser.add_argument("--diagnose", action="store_true")
    chosen = parser.parse_args()
    cases = [
        (kind, seed, chosen.out / f"{kind}_{seed}")
        for kind in chosen.kind
        for seed in range(chosen.seed, chosen.seed + chosen.count)
    ]
    for kind, seed, folder in cases:
        write_case(kind, seed, folder)
        print(folder, flush=True)
        if chosen.diagnose and not (folder / ANSWER).exists():
            write_json(folder / ANSWER, diagnosed(folder))
    done = [(read_json(f / LABEL), read_json(f / ANSWER)) for _, _, f in cases if (f / ANSWER).exists()]
    if done:
        (chosen.out / "summary.md").write_text(false_alarms(done) + "\n", encoding="utf-8")
        print(false_alarms(done))


if __name__ == "__main__":
    main()
