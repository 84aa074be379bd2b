"""Entries of the diagnosis track: the scorecard of a method on a set of robots with hidden physics.

An entry is <results>/diagnosis/<name>.json (diagnosis_entry.schema.json). ``soro-bench blind-benchmark`` writes one.
A release is a scored set in one file, <name>.json.xz, some 100 KB: the opened labels of its cases, and what the reports
say of each. It holds what :func:`soro_bench.leaderboard.verify.verify_diagnosis` needs to score it again, and what
releases are compared by; texts, forces and detection limits of the reports are left out. Entries and releases may also
be in the archive of their folder (:mod:`soro_bench.packed`).
"""

import json
import lzma
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soro_bench import packed
from soro_bench.blind_benchmark.criteria import criteria, is_met
from soro_bench.blind_benchmark.score import (
    LABEL_BYTES,
    case_row,
    label_digest,
    opened_labels,
    scored,
)
from soro_bench.files import brief, parsed_json, read_json, replacing, write_json
from soro_bench.leaderboard.strict import REPORT_BYTES, check, read_strict
from soro_bench.sources import versions

FORMAT, SCHEMA = "soro_bench/diagnosis/1", "diagnosis_entry.schema.json"
PARTS = ("gates", "confusion", "calibration", "ablations")
RELEASE = "soro_bench/release/1"
PACKED_BYTES, OPENED_BYTES = 1_000_000, 50_000_000
_FIELDS = {"commitment": str, "method": str, "labels": dict, "reports": dict}  # of a release, in this order
# keys of a report and of its effects that neither a score nor a comparison of releases reads
LEFT_OUT = {"rounds", "places", "residual_force", "detectable", "invisible", "next_recording", "audit"}
LEFT_OUT_OF_EFFECTS = {"when", "condition", "evidence", "against", "together_with"}


@dataclass(frozen=True)
class Release:
    """A release as it was scored.

    Args:
        digest: SHA-256 of the sealed labels, published before the first diagnosis.
        method: version of the method, as ``soro_bench.sources`` gives it.
        labels: content of labels.json: seed, count, and what is hidden in every case.
        reports: by the case's id, without the keys that are left out.
    """

    digest: str
    method: str
    labels: dict
    reports: dict[str, dict]

    @classmethod
    def load(cls, path: str | Path) -> "Release":
        """Read a packed release, in its folder or in the archive of it; ValueError if the file is none."""
        try:
            opener = lzma.LZMADecompressor(memlimit=200_000_000)
            data = opener.decompress(packed.read(path, PACKED_BYTES), OPENED_BYTES)
            if not opener.eof:
                raise ValueError(f"it is cut off, or longer than {OPENED_BYTES} bytes")
            found = parsed_json(data)
            if found["format"] != RELEASE:
                raise ValueError(f"its format is {found['format']!a}; {RELEASE} is needed")
            return cls(*_parts(found))
        except (lzma.LZMAError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no release of the diagnosis: {error}") from error

    @classmethod
    def gather(cls, folder: str | Path) -> "Release":
        """The release that the blind benchmark left in ``folder``: its cases and a report for each."""
        cases, reports = Path(folder) / "cases", Path(folder) / "reports"
        found = {path.stem: _reduced(read_json(path)) for path in sorted(reports.glob("case_*.json"))}
        digest = (cases / "commitment.txt").read_text().strip()
        labels = read_json(cases / "sealed" / "labels.json", OPENED_BYTES)
        return cls(digest, (reports / "method.txt").read_text().strip(), labels, found)

    def pack(self, path: str | Path) -> None:
        """Write the release into one file."""
        content = {
            "format": RELEASE,
            "commitment": self.digest,
            "method": self.method,
            "labels": self.labels,
            "reports": self.reports,
        }
        data = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        with replacing(path) as temporary:
            temporary.write_bytes(lzma.compress(data, preset=9 | lzma.PRESET_EXTREME))

    def unpack(self, folder: str | Path) -> None:
        """Write the release into ``folder`` as the blind benchmark does: cases/ with the labels, and reports/."""
        cases, reports = Path(folder) / "cases", Path(folder) / "reports"
        reports.mkdir(parents=True, exist_ok=True)
        write_json(cases / "sealed" / "labels.json", self.labels)
        (cases / "commitment.txt").write_text(f"{self.digest}\n")
        for name, report in self.reports.items():
            write_json(reports / f"{name}.json", report)
        (reports / "method.txt").write_text(f"{self.method}\n")


def _parts(found: dict) -> Iterator[Any]:
    """The fields of a release that a file holds; ValueError for what is none, as a stranger may have written it."""
    for key, kind in _FIELDS.items():
        if not isinstance(found[key], kind):
            expected = "a text" if kind is str else "an object"
            raise ValueError(f"its {key} is {brief(found[key])}; expected is {expected}")
        yield found[key]
    for name in found["reports"]:
        if Path(name).name != name:
            raise ValueError(f"{brief(name)} is no name of a case")


def _reduced(report: dict) -> dict:
    kept = {key: value for key, value in report.items() if key not in LEFT_OUT}
    effects = [{key: value for key, value in each.items() if key not in LEFT_OUT_OF_EFFECTS}
               for each in report["effects"]]  # fmt: skip
    return kept | {"effects": effects}


def read_entry(path: str | Path) -> dict:
    """A valid entry of the diagnosis track; ValueError names the file, what is wrong and what is allowed."""
    entry = read_strict(path)
    check(entry, SCHEMA, path)
    _check_criteria(entry["gates"], path)
    return entry


def _check_criteria(stated: list[dict], path: str | Path) -> None:
    """ValueError unless criteria and thresholds are those of the blind benchmark, and met agrees with the values."""
    given = [(each["gate"], each["bar"], each["below"]) for each in stated]
    known = [[(name, bar, below) for name, _, _, bar, below in criteria(others)] for others in (False, True)]
    if given not in known:
        odd: object = next((one for one in given if all(one not in each for each in known)), None)
        odd = odd or "too few, twice, or in another order"
        raise ValueError(f"{path}: criteria and thresholds are not those of soro-bench blind-benchmark: {brief(odd)}")
    for each in stated:
        if each["met"] is not is_met(each["value"], each["bar"], each["below"]):
            raise ValueError(f"{path}: {each['gate']} is {each['value']}, for which met cannot be {each['met']}")


def write_entry(path: str | Path, entry: str, method: str, cases: str | Path, card: dict) -> None:
    """Write the entry of a scorecard.

    Args:
        entry: who, or which code base, made the diagnoses.
        method: what it does, in a few words.
        cases: folder of the cases, their labels and the digest of these.
        card: what :func:`soro_bench.blind_benchmark.score.scored` gives, with the rows of the ablations, perhaps none.
    """
    about = {"format": FORMAT, "entry": entry, "method": method, "set": opened(Path(cases))}
    written = {**about, **{part: card[part] for part in PARTS}, "versions": versions()}
    check(written, SCHEMA, path)
    write_json(path, written)


def opened(cases: Path) -> dict:
    """Which set of cases a folder holds, after its labels and their digest."""
    with _called(path := cases / "sealed" / "labels.json"):
        labels = opened_labels(cases)
        return {
            "seed": read_strict(path, LABEL_BYTES)["seed"],
            "count": len(labels),
            "nulls": sum(label["group"] == "none" for label in labels),
            "commitment": label_digest(cases),
        }


def rescored(cases: Path, reports: Path) -> dict:
    """The scorecard of the reports of a set; ValueError names a case whose report is missing or says too little."""
    with _called(cases / "sealed" / "labels.json"):
        labels, found = {label["id"]: label for label in opened_labels(cases)}, {}
    for name, label in labels.items():
        path = reports / f"{name}.json"
        if not path.is_file():
            raise ValueError(f"{path} is missing; every case needs its report")
        found[name] = read_strict(path, REPORT_BYTES)
        with _called(path):
            if not found[name]["unseen"] and "task.parquet" in label.get("sha256", ("task.parquet",)):
                raise ValueError("the case has motion that no diagnosis sees, and the report no errors on it")
            case_row(label, found[name])
    with _called(reports):
        return scored(list(labels.values()), found)


@contextmanager
def _called(path: Path) -> Iterator[None]:
    """Name the file in whatever goes wrong with what a stranger has written."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{path} cannot be scored: {type(error).__name__} {str(error)[:200]}") from error
