"""The present method on the first cases of a release, beside what the release said of them.

    python benchmarks/release_comparison.py --out runs/comparison --jobs 2
    python benchmarks/release_comparison.py --out runs/comparison --only-compare --exact runs/comparison_before

A release keeps the seed of its cases, so this simulates their recordings again and diagnoses them. One JSON file a case
is kept in ``--out``; an interrupted run goes on from these. Another processor changes the last digits of a simulation,
so a release is compared by verdicts, by the effects of the best hypothesis, by their locations, and roughly by numbers.
``--exact`` compares every number with files that the same machine wrote, here or with earlier code (report.json of
schema 1): a refactoring must not change any.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from soro_bench.blind_benchmark.ablations import ENV_ID
from soro_bench.blind_benchmark.cases import build
from soro_bench.blind_benchmark.draw import Case, draw_cases
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Errors, NamedLocation
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Location
from soro_bench.files import read_json, write_json
from soro_bench.leaderboard.diagnosis_entry import Release
from soro_bench.markdown import table
from soro_bench.parallel import Workers, each, processors
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording

RELEASE = Path(__file__).parents[1] / "docs" / "results" / "releases" / "release_6.json.xz"
CASES = 40
ROLES = ("train", "heldout")
SHOWN = 10  # exact differences of a case that are printed; the others are counted
VERDICTS = {
    "none_detected": "adequate",
    "missing_physics": "discrepancy",
    "unknown_physics": "outside_catalogue",
    "measurement_fault": "measurement_fault",
}  # of schema 1, and what they are now


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


def diagnosed(case: Case, out: Path) -> None:
    """Diagnose a case, and write all digits of what is compared into ``out``."""
    train, heldout = recordings(case, out / "cases")
    result = diagnose(SuiteRobot(ENV_ID, threads=processors()), [train], [heldout])
    write_json(out / f"{case.id}.json", content(result))


def content(result: Result) -> dict[str, Any]:
    """Numbers and names of a result that earlier code had too, as JSON."""
    unknown = result.unknown_input
    return {
        "verdict": result.verdict,
        "p_value": result.p_value,
        "alpha": result.alpha,
        "predicted_gain": result.predicted_gain,
        "remaining_gain": result.remaining_gain,
        "findings": {
            _key(f.name, _location(f.location)): {
                "probability": f.probability,
                "estimates": {e.name: [e.value, e.low, e.high] for e in f.estimates},
                "intervals": [list(pair) for pair in f.intervals],
            }
            for f in result.findings
        },
        "hypotheses": [
            {
                "effects": [_named(one) for one in h.effects],
                "probability": h.probability,
                "unknowns": h.unknowns,
                "samples": h.samples,
                "misfit": h.misfit,
                "misfit_total": h.misfit_total,
                "log_evidence": h.log_evidence,
                "evidence": h.evidence,
            }
            for h in result.hypotheses
        ],
        "rounds": [
            {
                "on_top_of": [_named(one) for one in r.on_top_of],
                "screened": [[_named(one.term), one.predicted_gain] for one in r.screened],
                "fitted": [[[_named(one) for one in f.terms], f.misfit] for f in r.fitted],
            }
            for r in result.rounds
        ],
        "credible_set": list(result.credible_set),
        "train": _errors(result.train),
        "heldout": _errors(result.heldout),
        "parameters_only": result.parameters_only,
        "patch": result.patch.state,
        "parameters": {
            p.estimate.name: [p.estimate.value, p.estimate.low, p.estimate.high, p.prior_deviations]
            for p in result.parameters
        },
        "locations": [[_location(one.location), one.gain] for one in result.locations],
        "unknown_input": unknown
        and {
            "location": _location(unknown.location),
            "start_s": list(unknown.start_s),
            "values": [list(row) for row in unknown.values],
            "rmse_after": unknown.rmse_after,
        },
        "detectable": {d.name: [d.quantity, d.minimum, d.null, _location(d.location)] for d in result.detectable},
        "undetectable": list(result.undetectable),
        "not_searched": list(result.not_searched),
        "recordings": [[quality.noise, quality.missing] for quality in result.recordings],
        "next_recording": result.next_recording
        and {
            "motion": result.next_recording.motion,
            "separates": [list(pair) for pair in result.next_recording.separates],
            "evidence": result.next_recording.evidence,
        },
    }


def _errors(errors: Errors | None) -> list[float] | None:
    return None if errors is None else [errors.corrected_before, errors.corrected_after, errors.noise]


def _location(location: Location | None) -> str:
    return "" if location is None else _where(location.to_json())


def _where(where: dict[str, Any] | None) -> str:
    return " ".join(str(where[key]) for key in ("kind", "name", "index") if where.get(key) is not None) if where else ""


def _key(name: str, location: str) -> str:
    return f"{name} at {location}" if location else name


def _named(effect: NamedLocation) -> str:
    return _key(effect.name, _location(effect.location))


def content_of_schema_1(report: dict[str, Any]) -> dict[str, Any]:
    """The same of a report.json of schema 1, as far as it is there: packed releases keep less."""
    fit, unknown, proposal = report["fit"], report.get("residual_force"), report.get("next_recording")
    found = {
        "verdict": VERDICTS[report["verdict"]],
        "p_value": report["p_value"],
        "alpha": report["alpha"],
        "predicted_gain": report["promised"],
        "remaining_gain": report["still_promised"],
        "findings": {
            _key(e["name"], _where(e["where"])): {
                "probability": e["probability"],
                "estimates": {
                    name: [each["value"], *each.get("ci90", [None, None])] for name, each in e["parameters"].items()
                },
            }
            | ({"intervals": [[w["start_s"], w["end_s"]] for w in e["when"]]} if "when" in e else {})
            for e in report["effects"]
        },
        "hypotheses": [
            {
                "effects": [_key(*pair) for pair in zip(h["names"], map(_where, h["where"]), strict=True)],
                "probability": h["probability"],
                "unknowns": h["unknowns"],
                "samples": h["samples"],
                "misfit": h["excess"],
                "misfit_total": h["excess_of_all"],
                "log_evidence": h["log_evidence"],
                "evidence": h["evidence"],
            }
            for h in report["hypotheses"]
        ],
        "credible_set": report["credible_set"],
        "train": _old_errors(fit["train"]),
        "heldout": _old_errors(fit["heldout"]),
        "parameters_only": fit["parameters_only"],
        "patch": fit["patch"],
        "parameters": {
            name: [each["value"], *each["ci90"], each["prior_tension_sd"]]
            for name, each in report["parameters"].items()
        },
    }
    if "rounds" in report:  # a whole report
        found |= {
            "rounds": [
                {
                    "on_top_of": [_old_named(one) for one in r["on_top_of"]],
                    "screened": [[_old_named(one), one["gain"]] for one in r["promised"]],
                    "fitted": [[[_old_named(one) for one in f["effects"]], f["excess"]] for f in r["fitted"]],
                }
                for r in report["rounds"]
            ],
            "locations": [[_where(one["where"]), one["gain"]] for one in report["places"]],
            "unknown_input": unknown
            and {
                "location": _where(unknown["where"]),
                "start_s": unknown["start_s"],
                "values": unknown["values"],
                "rmse_after": unknown["rmse_after"],
            },
            "detectable": {
                name: [each["quantity"], each["minimum"], each["null"], _where(each["where"])]
                for name, each in report["detectable"].items()
            },
            "undetectable": report["invisible"],
            "recordings": [[each["noise"], each["missing"]] for each in report["audit"]],
            "next_recording": proposal
            and {
                "motion": proposal["motion"],
                "separates": proposal["separates"],
                "evidence": proposal["evidence_nats"],
            },
        }
    if "not_looked_for" in report:
        found["not_searched"] = report["not_looked_for"]
    return found


def _old_errors(fit: dict[str, float] | None) -> list[float] | None:
    return None if fit is None else [fit["rmse_before"], fit["rmse_after"], fit["noise_floor"]]


def _old_named(effect: dict[str, Any]) -> str:
    return _key(effect["name"], _where(effect["where"]))


def answer(found: dict[str, Any]) -> dict[str, str]:
    """What two diagnoses of a case have to agree on: verdict, effects of the best hypothesis, their locations."""
    effects = found["hypotheses"][0]["effects"]
    if found["verdict"] == "outside_catalogue":
        effects = [key for key in found["findings"] if key.partition(" at ")[0] == "unknown"]
    if found["verdict"] == "adequate":
        effects = []
    pairs = sorted(key.partition(" at ")[::2] for key in effects)
    return {
        "verdict": found["verdict"],
        "effects": ", ".join(name for name, _ in pairs) or "none",
        "locations": ", ".join(where for _, where in pairs) or "none",
    }


def parameter_change(new: dict[str, Any], old: dict[str, Any]) -> float:
    """The largest difference of a robot's parameter between two diagnoses, in widths of its 90 % interval."""
    changes = [0.0]
    for name, (value, low, high, _) in old["parameters"].items():
        changes.append(abs(new["parameters"][name][0] - value) / max(high - low, 1e-300))
    return max(changes)


def differences(new: object, old: object, path: str = "") -> Iterator[str]:
    """Every entry that two pieces of JSON both have, and in which they differ, to the last digit."""
    if isinstance(new, dict) and isinstance(old, dict):
        for key in sorted(new.keys() & old.keys()):
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


def against_release(now: dict[str, dict[str, Any]], release: Release) -> str:
    """Markdown: every difference from the release, and how many cases agree in what."""
    agree = dict.fromkeys(("verdict", "effects", "locations"), 0)
    rows: list[tuple[str, str, str, str]] = []
    changes: list[float] = []
    for name, found in now.items():
        released = content_of_schema_1(release.reports[name])
        new, old = answer(found), answer(released)
        changes.append(parameter_change(found, released))
        for what in agree:
            agree[what] += new[what] == old[what]
            if new[what] != old[what]:
                rows.append((name, what, old[what], new[what]))
    lines = [table(("case", "what", "release", "now"), rows), ""] if rows else []
    lines += [f"{what}: {count} of {len(now)} the same" for what, count in agree.items()]
    lines.append(f"parameters: they differ by {max(changes, default=0.0):.2g} widths of a 90 % interval at most")
    return "\n".join(lines)


def exactly(now: dict[str, dict[str, Any]], folder: Path) -> str:
    """Markdown: every number that differs from those of files in another folder."""
    rows: list[tuple[str, str]] = []
    same, compared = 0, 0
    for name, found in now.items():
        path = folder / f"{name}.json"
        if not path.is_file():
            continue
        old = read_json(path)
        old = old.get("report", old)
        old = content_of_schema_1(old) if "effects" in old else old
        lines = list(differences(found, old))
        missing = set(found["findings"]) ^ set(old["findings"])
        lines += [f"finding only before or only now: {key}" for key in sorted(missing)]
        compared, same = compared + 1, same + (not lines)
        rows += [(name, line) for line in lines[:SHOWN]]
        if len(lines) > SHOWN:
            rows.append((name, f"and {len(lines) - SHOWN} more"))
    return "\n".join([*([table(("case", "difference"), rows), ""] if rows else []),
                      f"to the last digit: {same} of {compared} the same"])  # fmt: skip


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
    now = {case.id: read_json(path) for case in cases if (path := out / f"{case.id}.json").is_file()}
    print(against_release(now, release))
    if options.exact:
        print(exactly(now, options.exact))


if __name__ == "__main__":
    main()
