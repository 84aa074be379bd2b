"""Entries of the diagnosis track: the scorecard of a method on a set of robots with hidden physics.

An entry is <results>/diagnosis/<name>.json (diagnosis_entry.schema.json). ``soro-bench blind-benchmark`` writes one.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from soro_bench.blind_benchmark.score import (
    CRITERIA,
    LABEL_BYTES,
    case_row,
    is_met,
    label_digest,
    opened_labels,
    scored,
)
from soro_bench.files import brief, write_json
from soro_bench.leaderboard.strict import REPORT_BYTES, check, read_strict
from soro_bench.results import versions

FORMAT, SCHEMA = "soro_bench/diagnosis/1", "diagnosis_entry.schema.json"
PARTS = ("gates", "confusion", "calibration", "ablations")


def read_entry(path: str | Path) -> dict:
    """A valid entry of the diagnosis track; ValueError names the file, what is wrong and what is allowed."""
    entry = read_strict(path)
    check(entry, SCHEMA, path)
    _check_criteria(entry["gates"], path)
    return entry


def _check_criteria(gates: list[dict], path: str | Path) -> None:
    """ValueError unless criteria and thresholds are those of the blind benchmark, and met agrees with the values."""
    given, known = ([(gate["gate"], gate["bar"], gate["below"]) for gate in gates],
                    [(name, bar, below) for name, _, _, bar, below in CRITERIA])  # fmt: skip
    if given != known:
        odd = next((one for one in given if one not in known), None) or "too few, twice, or in another order"
        raise ValueError(f"{path}: criteria and thresholds are not those of soro-bench blind-benchmark: {brief(odd)}")
    for gate in gates:
        if gate["met"] is not is_met(gate["value"], gate["bar"], gate["below"]):
            raise ValueError(f"{path}: {gate['gate']} is {gate['value']}, for which met cannot be {gate['met']}")


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
            if not found[name]["unseen"]:
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
