"""What the diagnosis says of recordings of real robots, with several seeds.

    python benchmarks/real_robots.py --data data/real [--only bam_servo ...] [--seeds 3]

Every part of a study is a folder in --work, and the same command goes on with what is missing. Prints the tables of
docs/real_robots.md and writes docs/results/real_robots.json.
"""

import argparse
from pathlib import Path

from soro_bench.files import read_json, write_json
from soro_bench.study import HEAD, STUDIES, load_study, row, run_study

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "real_robots.json"


def effects(summary: dict) -> list[str]:
    """What the most probable answer says is missing, as words."""
    best, names = summary["answers"][0], []
    for effect in best["effects"]:
        index = effect["where"].get("index")
        values = ", ".join(f"{name} {value:.3g}" for name, value in effect["parameters"].items())
        names.append(f"{effect['name']} at {effect['where']['name']}{'' if index is None else index} ({values})")
    return names or ["nothing"]


def seeds_table(found: list[dict]) -> str:
    """Markdown: the answer of every seed."""
    lines = ["| robot, part | seed | most probable answer | probability | unknown |", "|---" * 5 + "|"]
    for s in found:
        best = s["answers"][0]
        cells = [f"{s['study']}, {s['part']}", str(s["seed"]), "; ".join(effects(s))]
        lines.append(f"| {' | '.join(cells)} | {best['probability']:.2f} | {s['unknown']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT / "data" / "real")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--only", nargs="+", default=list(STUDIES), choices=list(STUDIES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    found = []
    studies = {name: load_study(name, options.data) for name in options.only}  # before hours of work, not after them
    for name, study in studies.items():
        for seed in range(options.seeds):
            folder = options.work / f"{name}_{seed}"
            found += run_study(
                study, folder, seed, options.threads, lambda s, n=name, k=seed: print(n, k, s, flush=True)
            )
    new = {(s["study"], s["part"], s["seed"]) for s in found}
    old = read_json(RESULTS) if RESULTS.exists() else []
    others = [s for s in old if (s["study"], s["part"], s["seed"]) not in new]
    write_json(RESULTS, sorted(others + found, key=lambda s: (STUDIES.index(s["study"]), s["seed"])))
    print(HEAD + "\n" + row([s for s in found if s["seed"] == 0]))
    print(seeds_table(found))


if __name__ == "__main__":
    main()
