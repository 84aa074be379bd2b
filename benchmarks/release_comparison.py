"""The present method on the first cases of a release, beside what the release said of them.

    python benchmarks/release_comparison.py --out runs/comparison --jobs 2
    python benchmarks/release_comparison.py --out runs/comparison --only-compare --exact runs/comparison_before

A release keeps the seed of its cases, so this simulates their recordings again and diagnoses them. One JSON file a case
is kept in ``--out``; an interrupted run goes on from these. Another processor changes the last digits of a simulation,
so a release is compared by verdicts, by the effects of the best hypothesis, by their locations, and roughly by numbers.
``--exact`` compares every number with files that the same machine wrote, here or with earlier code: a refactoring must
not change any.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

from soro_bench.blind_benchmark.ablations import ENV_ID
from soro_bench.blind_benchmark.cases import build
from soro_bench.blind_benchmark.draw import Case, draw_cases
from soro_bench.blind_benchmark.report import report_of
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.pipeline import run_diagnosis
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, write_json
from soro_bench.leaderboard.release import Release
from soro_bench.markdown import table
from soro_bench.parallel import Workers, each, one_blas_thread, processors
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording

RELEASE = Path(__file__).parents[1] / "docs" / "results" / "releases" / "release_6.json.xz"
CASES = 40
ROLES = ("train", "heldout")
SHOWN = 10  # exact differences of a case that are printed; the others are counted
NOT_COMPARED = {"seconds", "schema"}  # of two runs with the same result


def cases_of(release: Release) -> list[Case]:
    """All cases of a release, drawn again from its seed."""
    labels = release.labels["cases"]
    healthy = sum(label["group"] == "none" for label in labels)
    cases = draw_cases(len(labels), release.labels["seed"], healthy)
    if [case.id for case in cases] != [label["id"] for label in labels]:
        raise ValueError("the release has other cases than its seed gives")
    return cases


def recordings(case: Case, folder: Path) -> list[Recording]:
    """The recordings of a case to explain and to test on; simulated unless they are in ``folder``."""
    paths = [folder / case.id / f"{role}.parquet" for role in ROLES]
    if not all(path.is_file() for path in paths):
        built, _ = build(case)
        for role, path in zip(ROLES, paths, strict=True):
            save(built[role], path)
    return [load(path) for path in paths]


@one_blas_thread
def diagnosed(case: Case, out: Path) -> None:
    """Diagnose a case, and write what is found into ``out``."""
    train, heldout = recordings(case, out / "cases")
    found = run_diagnosis(SuiteRobot(ENV_ID, threads=processors()), [train], [heldout])
    write_json(out / f"{case.id}.json", report_of(build_result(found)))


def answer(report: dict) -> dict:
    """What two diagnoses of a case have to agree on: verdict, effects of the best hypothesis, their locations."""
    best = report["hypotheses"][0]
    pairs = sorted(zip(best["names"], map(_location, best["where"]), strict=True))
    if report["verdict"] == "unknown_physics":
        unknown = next(effect for effect in report["effects"] if effect["name"] == "unknown")
        pairs = [("unknown", _location(unknown["where"]))]
    if report["verdict"] == "none_detected":
        pairs = []
    return {
        "verdict": report["verdict"],
        "effects": ", ".join(name for name, _ in pairs) or "none",
        "locations": ", ".join(where for _, where in pairs) or "none",
    }


def _location(where: dict | None) -> str:
    if where is None:
        return "no location"
    return " ".join(str(where[key]) for key in ("kind", "name", "index") if where.get(key) is not None)


def parameter_change(report: dict, other: dict) -> float:
    """The largest difference of a robot's parameter between two diagnoses, in widths of its 90 % interval."""
    changes = [0.0]
    for name, found in report["parameters"].items():
        low, high = other["parameters"][name]["ci90"]
        changes.append(abs(found["value"] - other["parameters"][name]["value"]) / max(high - low, 1e-300))
    return max(changes)


def differences(new: object, old: object, path: str = "") -> Iterator[str]:
    """Every entry in which two pieces of JSON differ, to the last digit."""
    if isinstance(new, dict) and isinstance(old, dict):
        for key in sorted((new.keys() | old.keys()) - NOT_COMPARED):
            if key not in new or key not in old:
                yield f"{path}/{key}: only {'before' if key in old else 'now'}"
            else:
                yield from differences(new[key], old[key], f"{path}/{key}")
    elif isinstance(new, list) and isinstance(old, list):
        if len(new) != len(old):
            yield f"{path}: {len(old)} entries before, {len(new)} now"
        for i, (one, other) in enumerate(zip(new, old, strict=False)):
            yield from differences(one, other, f"{path}/{i}")
    elif new != old and not (_is_nan(new) and _is_nan(old)):
        yield f"{path}: {old!r} before, {new!r} now"


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def against_release(reports: dict[str, dict], release: Release) -> str:
    """Markdown: every difference from the release, and how many cases agree in what."""
    agree = dict.fromkeys(("verdict", "effects", "locations"), 0)
    rows: list[tuple[str, str, str, str]] = []
    changes: list[float] = []
    for name, report in reports.items():
        now, before = answer(report), answer(release.reports[name])
        changes.append(parameter_change(report, release.reports[name]))
        for what in agree:
            agree[what] += now[what] == before[what]
            if now[what] != before[what]:
                rows.append((name, what, before[what], now[what]))
    lines = [table(("case", "what", "release", "now"), rows)] if rows else []
    lines += [f"{what}: {count} of {len(reports)} the same" for what, count in agree.items()]
    lines.append(f"parameters: they differ by {max(changes, default=0.0):.2g} widths of a 90 % interval at most")
    return "\n".join(lines)


def exactly(reports: dict[str, dict], folder: Path) -> str:
    """Markdown: every number that differs from the reports in another folder."""
    rows, same, compared = [], 0, 0
    for name, report in reports.items():
        path = folder / f"{name}.json"
        if not path.is_file():
            continue
        old = read_json(path)
        found = list(differences(report, old.get("report", old)))
        compared, same = compared + 1, same + (not found)
        rows += [(name, line) for line in found[:SHOWN]]
        if len(found) > SHOWN:
            rows.append((name, f"and {len(found) - SHOWN} more"))
    lines = [table(("case", "difference"), rows)] if rows else []
    return "\n".join([*lines, f"exactly: {same} of {compared} the same"])


def main() -> None:
    """Diagnose the cases that have no file yet, and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for one JSON file a case")
    parser.add_argument("--release", type=Path, default=RELEASE)
    parser.add_argument("--cases", type=int, default=CASES, help="how many, the first ones")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--only-compare", action="store_true", help="what is there; diagnose nothing")
    parser.add_argument("--exact", type=Path, metavar="FOLDER", help="with files of the same machine")
    options = parser.parse_args()
    release = Release.load(options.release)
    cases, out = cases_of(release)[: options.cases], options.out.resolve()
    todo = [(case, out) for case in cases if not (out / f"{case.id}.json").is_file()]
    if not options.only_compare:
        for done, _ in enumerate(each(diagnosed, todo, Workers(options.jobs)), 1):
            print(f"{len(cases) - len(todo) + done} of {len(cases)} cases diagnosed", flush=True)
    reports = {case.id: read_json(path) for case in cases if (path := out / f"{case.id}.json").is_file()}
    print(against_release(reports, release))
    if options.exact:
        print(exactly(reports, options.exact))


if __name__ == "__main__":
    main()
