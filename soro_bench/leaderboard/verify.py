"""Whether an entry is what its policy, or its reports, give today: every number, exactly."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.diagnosis_entry import Release, opened, rescored
from soro_bench.leaderboard.diagnosis_entry import read_entry as read_diagnosis_entry
from soro_bench.leaderboard.entry import evaluated, policy_of, read_entry


def verify_control(path: str | Path, labels: Sequence[str] = (), num_threads: int = 0) -> dict[str, str]:
    """Evaluate an entry's policy again: for every label "same", or what differs and by how much.

    Args:
        labels: conditions to evaluate; by default all that were entered.
    """
    entry = read_entry(path)
    if missing := [label for label in labels if label not in entry["evaluations"]]:
        raise ValueError(f"{path}: {missing[0]!r} was not entered; there are {', '.join(entry['evaluations'])}")
    policy, board = policy_of(path, entry), BOARDS[entry["board"]]
    found = evaluated(board, policy, labels or list(entry["evaluations"]), num_threads)
    return {label: _compared(entry["evaluations"][label], scores) for label, scores in found.items()}


def _compared(entered: dict, found: dict) -> str:
    differences = []
    for name in [name for name in entered if name.endswith("_mm")] + ["return"]:
        unit = "" if name == "return" else " mm"
        largest = float(np.abs(np.subtract(entered[name], found[name])).max())
        if largest != 0.0:
            differences.append(f"{name} by up to {largest:.4g}{unit}")
    if entered["success"] != found["success"]:
        wrong = sum(a != b for a, b in zip(entered["success"], found["success"], strict=True))
        differences.append(f"success of {wrong} of {len(found['success'])}")
    if entered["diverged"] != found["diverged"]:
        differences.append(f"diverged {entered['diverged']}, now {found['diverged']}")
    return f"differs: {', '.join(differences)}" if differences else "same"


def verify_diagnosis(path: str | Path, cases: str | Path, reports: str | Path) -> dict[str, str]:
    """Score an entry's reports again against the opened labels: for every part "same", or the first that differs;
    of the ablations, that they are not verified.

    Args:
        cases: folder with the sealed labels and their digest.
        reports: folder with the report of every case, <case>.json.
    """
    entry = read_diagnosis_entry(path)
    about, card = opened(Path(cases)), rescored(Path(cases), Path(reports))
    found = {"set": "same" if entry["set"] == about else f"differs: entered {entry['set']}, found {about}"}
    for part in ("gates", "confusion", "calibration"):
        found[part] = _first_difference(entry[part], card[part])
    if entry["ablations"]:
        found["ablations"] = "not verified, as their reports are not asked for"
    return found


def verify_release(path: str | Path, release: str | Path) -> dict[str, str]:
    """As :func:`verify_diagnosis`, of the labels and reports in the file of a release."""
    with tempfile.TemporaryDirectory() as folder:
        Release.load(release).unpack(folder)
        return verify_diagnosis(path, Path(folder) / "cases", Path(folder) / "reports")


def _first_difference(entered: list, found: list) -> str:
    if len(entered) != len(found):
        return f"differs: {len(entered)} rows were entered, {len(found)} are found"
    for one, other in zip(entered, found, strict=True):
        if one != other:
            return f"differs: entered {one}, found {other}"
    return "same"
