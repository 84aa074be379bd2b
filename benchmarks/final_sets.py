"""All scored releases of the diagnosis side by side: criteria, and errors on motion that nothing was fitted to.

python benchmarks/final_sets.py    # the tables of docs/diagnosis.md and docs/proof.md, from docs/results/releases
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soro_bench.files import read_json
from soro_bench.leaderboard.release import Release
from soro_bench.markdown import table

ROOT = Path(__file__).parents[1]
ROBOTS = {"fine": "another time step", "flex": "another model"}
# rows without a bar
ALSO = ("unseen motion: variance explained, median, all of the error", "the same, where they hide half")


def releases() -> list[Path]:
    """Files of the releases, in their order."""
    return sorted((ROOT / "docs" / "results" / "releases").glob("release_*.json.xz"))


def scores(release: Path) -> list[dict]:
    """The criteria of a release as the leaderboard has them."""
    number = release.name.partition(".")[0].removeprefix("release_")
    return read_json(ROOT / "leaderboard" / "results" / "diagnosis" / f"soro_bench_{number}.json")["gates"]


def gate_rows(files: Sequence[Path]) -> list[list[str]]:
    """A row per criterion: its name, the threshold, and what every release came to."""
    gates = [{gate["gate"]: gate for gate in scores(path)} for path in files]
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


def unseen_rows(files: Sequence[Path]) -> list[list[str]]:
    """Median rms [mm] of the third recording before and after the patch, of robots with physics that has a name."""
    found = [Release.load(path) for path in files]
    return [[text, *(_unseen(release, robot) for release in found)] for robot, text in ROBOTS.items()]


def _unseen(release: Release, robot: str) -> str:
    labels = release.labels["cases"]
    wanted = [label["id"] for label in labels if label["robot"] == robot and label["group"] in ("one", "two")]
    errors = [release.reports[name]["unseen"] for name in wanted]
    before, after = np.median([(each["rmse_before"], each["rmse_after"]) for each in errors if each], axis=0)
    return f"{1e3 * before:.1f}, {1e3 * after:.1f}"


def gates(files: Sequence[Path]) -> str:
    """The criteria, Markdown."""
    return table(["gate", "bar", *map(name_of, files)], gate_rows(files))


def unseen(files: Sequence[Path]) -> str:
    """The errors on motion that nothing was fitted to, Markdown."""
    return table(["the recorded robot has", *(f"{name_of(each)} [mm]" for each in files)], unseen_rows(files))


def name_of(release: Path) -> str:
    """What a release is called in tables and figures."""
    return release.name.partition(".")[0].replace("_", " ")


def main() -> None:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    files = releases()
    print(gates(files[-1:]), gates(files), unseen(files), sep="\n\n")


if __name__ == "__main__":
    main()
