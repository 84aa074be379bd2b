"""The final sets of all releases of the diagnosis, side by side: gates, and errors on motion that had no say.

python benchmarks/final_sets.py                # docs/results/proof_*, the tables of docs/diagnosis.md and docs/proof.md
python benchmarks/final_sets.py FOLDER...      # with labels.json, scorecard.json and reports/
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soro_bench.files import read_json
from soro_bench.markdown import table

RESULTS = Path(__file__).parents[1] / "docs" / "results"
ROBOTS = {"fine": "another time step", "flex": "another model"}
# rows without a bar
ALSO = ("unseen motion: variance explained, median, all of the error", "the same, where they hide half")


def scored_folders() -> list[Path]:
    """Those of the releases that are scored, in their order."""
    return sorted(path.parent for path in RESULTS.glob("proof_*/scorecard.json"))


def gate_rows(folders: Sequence[Path]) -> list[list[str]]:
    """A row per gate: its name, the bar, and what every release came to."""
    gates = [{gate["gate"]: gate for gate in read_json(path / "scorecard.json")["gates"]} for path in folders]
    return [
        [name, _bar(gate), *(_cell(release[name]) for release in gates)]
        for name, gate in gates[-1].items()
        if gate["bar"] is not None or name in ALSO
    ]


def _bar(gate: dict) -> str:
    return "" if gate["bar"] is None else f"{'<=' if gate['below'] else '>='} {gate['bar']:g}"


def _cell(gate: dict) -> str:
    if gate["value"] is None:
        return "no such case"
    low, high = gate["interval"]
    text = f"{gate['value']:.3g} [{low:.3g}, {high:.3g}] of {gate['cases']}"
    return f"**missed:** {text}" if gate["met"] is False else text


def unseen_rows(folders: Sequence[Path]) -> list[list[str]]:
    """Median rms [mm] of the third recording before and after the patch, of robots with physics that has a name."""
    return [[text, *(_unseen(folder, robot) for folder in folders)] for robot, text in ROBOTS.items()]


def _unseen(folder: Path, robot: str) -> str:
    labels = read_json(folder / "labels.json", 100_000_000)["cases"]
    wanted = [label["id"] for label in labels if label["robot"] == robot and label["group"] in ("one", "two")]
    errors = [read_json(folder / "reports" / f"{name}.json")["unseen"] for name in wanted]
    before, after = np.median([(each["rmse_before"], each["rmse_after"]) for each in errors if each], axis=0)
    return f"{1e3 * before:.1f}, {1e3 * after:.1f}"


def gates(folders: Sequence[Path]) -> str:
    """The gates, Markdown."""
    return table(["gate", "bar", *map(_release, folders)], gate_rows(folders))


def unseen(folders: Sequence[Path]) -> str:
    """The errors on motion that had no say, Markdown."""
    return table(["the recorded robot has", *(f"{_release(each)} [mm]" for each in folders)], unseen_rows(folders))


def _release(folder: Path) -> str:
    return folder.name.replace("proof_", "release ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    folders = parser.parse_args().folders or scored_folders()
    print(gates(folders[-1:]), gates(folders), unseen(folders), sep="\n\n")


if __name__ == "__main__":
    main()
