"""All scored releases of the diagnosis side by side: acceptance criteria, and errors on motion that nothing was fitted
to.

python benchmarks/final_sets.py    # tables of docs/explanation/benchmark.md and docs/archive/diagnosis.md
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soro_bench.leaderboard.diagnosis_entry import Release, read_entry
from soro_bench.markdown import table
from soro_bench.packed import names

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
        (called(each), threshold(each), *(_cell(release[name]) for release in by_name))
        for name, each in by_name[-1].items()
    ]
    return table(("criterion", "threshold", *map(name_of, files)), rows)


def _cell(criterion: dict) -> str:
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


def name_of(release: Path) -> str:
    """What a release is called in tables and figures."""
    return release.name.partition(".")[0].replace("_", " ")


def main() -> None:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    files = releases()
    print(last_release(files[-1]), unseen(files[-1:]), all_releases(files), unseen(files), sep="\n\n")


if __name__ == "__main__":
    main()
