"""Scores of diagnoses against the sealed labels: what of every case was found, confusions."""

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soro_bench.blind_benchmark.criteria import calibration, criteria, measured
from soro_bench.files import brief, parsed_json, read_bytes

# of an effect: what the label calls its magnitude, what a report does, and how many of its units one of the label's is
_SAME = {
    "actuator_deadband": ("width", "width", 1.0),
    "actuator_delay": ("delay", "delay", 1.0),
    "actuator_gain": ("gain", "gain", 1.0),
    "actuator_lag": ("time_constant", "time_constant", 1.0),
    "backlash": ("width", "width", 1.0),
    "clock_skew": ("skew", "rate", -1.0),  # of a slow clock, and of a fast one
    "compliance": ("compliance", "compliance", 1.0),
    "coulomb_friction": ("friction", "friction", 1.0),
    "fluid_drag": ("drag", "drag", 1.0),
    "load_friction": ("coefficient", "mu", 1.0),
    "local_stiffness": ("factor", "factor", 1.0),
    "mullins_softening": ("softening", "softening", 1.0),
    "payload": ("mass", "mass", 1.0),
    "pretension": ("offset", "offset", 1.0),
    "sensor_delay": ("delay", "delay", 1.0),
    "stiffening": ("cubic", "beta", 1.0),
    "stiffness_drift": ("rate", "rate", 60.0),  # 1/s and 1/min
    "stribeck_friction": ("friction", "friction", 1.0),
    "viscoelastic_creep": ("stiffness_ratio", "ratio", 1.0),
    "viscous_friction": ("drag", "damping", 1.0),
}
_NULL = {"actuator_gain": 1.0, "local_stiffness": 1.0}  # what stands for no effect, where that is not zero


def magnitude_errors(truth: dict, said: dict) -> tuple[float, bool] | None:
    """Error of the magnitude, as a share of how far it is from that of no effect, and whether the truth is in its 90 %
    interval; None where the two sides have no magnitude in common.

    Args:
        truth: an effect of a label.
        said: the same effect in a report.
    """
    if truth["name"] != said["name"] or truth["name"] not in _SAME:
        return None
    own, others, factor = _SAME[truth["name"]]
    if others not in said["parameters"]:  # a law at every element has a magnitude at each
        return None
    exact, found = factor * truth["parameters"][own]["value"], said["parameters"][others]
    low, high = found["ci90"]
    size = abs(exact - _NULL.get(truth["name"], 0.0))
    return abs(found["value"] - exact) / size, bool(low <= exact <= high)


LABEL_BYTES = 100_000_000
_ID, _HASH = re.compile(r"case_[0-9]{3,}"), re.compile(r"[0-9a-f]{64}")
_CABLES = {"tendon", "actuator"}  # a cable and the actuator that pulls it
_SEGMENTS = 1  # a body or keypoint may be off by so many


def opened_labels(folder: Path) -> list[dict]:
    """The labels of a set of cases; ValueError if they are not those that were committed to."""
    path = folder / "sealed" / "labels.json"
    content = read_bytes(path, LABEL_BYTES, links=False)
    found = hashlib.sha256(content).hexdigest()
    if (committed := label_digest(folder)) != found:
        raise ValueError(f"{path} has the hash {found}, the digest is {committed}")
    labels = parsed_json(content)["cases"]
    for label in labels:
        if not _ID.fullmatch(label["id"]):  # it becomes the name of a file
            raise ValueError(f"{path} has the case {brief(label['id'])}; expected case_000 or the like")
    if len({label["id"] for label in labels}) < len(labels):
        raise ValueError(f"{path} has two cases of one name")
    return labels


def label_digest(folder: Path) -> str:
    """The hash of sealed labels, in hexadecimal digits."""
    path = folder / "commitment.txt"
    text = read_bytes(path, 1000, links=False).decode(errors="replace").strip()
    if not _HASH.fullmatch(text):
        raise ValueError(f"{path} holds no SHA-256, which has 64 hexadecimal digits")
    return text


def scored(labels: Sequence[dict], reports: dict[str, dict], seed: int = 0) -> dict:
    """The scorecard: what of ``labels`` the ``reports`` (by id) found.

    Returns:
        {"cases": a row per case, "gates": a row per criterion, "confusion": (truth, said, count), "calibration": bins}.
        Criteria about other simulators stand last, where a set has cases of them.
    """
    rows = [case_row(label, reports[label["id"]]) for label in labels if label["id"] in reports]
    rng = np.random.default_rng(seed)
    return {
        "cases": rows,
        "gates": [measured(rows, *each, rng) for each in criteria(any(row["kind"] for row in rows))],
        "confusion": _confusion(rows),
        "calibration": calibration(rows),
    }


def case_row(label: dict, report: dict) -> dict:
    """What a report found of what a label says."""
    first = _first(report)
    said = [first["name"], *(e["name"] for e in report["effects"] if e is not first)][:3]
    if not 0.0 <= first["probability"] <= 1.0:
        raise ValueError(f"the probability of {first['name']} is {first['probability']}; allowed: 0 to 1")
    truth, all_of_them = [e["name"] for e in label["effects"]], report["hypotheses"][0]["names"]
    right = [name for e in label["effects"] for name in _names(e)] or ["none"]
    named = next((e for e in label["effects"] if first["name"] in _names(e)), label["effects"][0] if truth else None)
    absorbed_share = None
    if label["group"] in ("one", "two"):
        left = max(report["fit"]["parameters_only"] ** 2 - label["noise"]["value"] ** 2, 0.0)
        absorbed_share = 1.0 - 3.0 * left / (1e-3 * label["change_mm"]["train"]) ** 2
    error, inside = (named and magnitude_errors(named, first)) or (None, None)
    return {
        "id": label["id"],
        "group": label["group"],
        "robot": label["robot"],
        "kind": label.get("kind", ""),
        "truth": truth,
        "said": said,
        "verdict": report["verdict"],
        "probability": first["probability"],
        "alarm": report["verdict"] != "none_detected",
        "first": first["name"] in right,
        "first_three": bool(set(said) & set(right)),
        "exact": report["verdict"] != "unknown_physics" and sorted(all_of_them) == sorted(truth),
        "right_class": report["classes"][0]["class"] in [e["class"] for e in label["effects"]],
        "place": named is not None and same_location(named["where"], first["where"]),
        "part": named and _part(named["where"]),
        "covered": bool(set(report["credible_set"]) & set(right)),
        "abstained": report["verdict"] == "unknown_physics",
        "confused": (first["class"] == "measurement") != (label["group"] == "measurement"),
        "answered": first["name"] not in ("none", "unknown"),
        "magnitude_error": error,
        "magnitude_inside": inside,
        "fve_unseen": report["unseen"] and report["unseen"]["fve"],
        "fve_unseen_raw": report["unseen"] and _raw_explained(report["unseen"]),
        "error_left": report["unseen"] and report["unseen"]["rmse_after"] / report["unseen"]["rmse_before"],
        "change_unseen_mm": label["change_mm"]["task"],
        "absorbed": absorbed_share,
        "seconds": report["seconds"],
    }


def _names(effect: dict) -> list[str]:
    """Names of the catalogue that are right for an effect of a label; there may be some for another simulator's."""
    return effect.get("names", [effect["name"]])


def _first(report: dict) -> dict:
    """The first answer of a report; where its verdict is that nothing was detected, that, whatever is likelier."""
    found = report["effects"][0]
    if report["verdict"] == "none_detected" and found["name"] != "none":
        nothing = {"name": "none", "class": "none", "where": None, "probability": 0.0}
        return next((e for e in report["effects"] if e["name"] == "none"), nothing)
    return found


def same_location(truth: dict, said: dict | None) -> bool:
    """Whether a location is right: the same cable, or a segment or keypoint next to it."""
    if not said:
        return False
    kinds = [truth["kind"], said["kind"]]
    if kinds[0] != kinds[1] and not set(kinds) <= _CABLES:
        return False
    if truth.get("index") is not None:
        return said.get("index") is not None and abs(truth["index"] - said["index"]) <= _SEGMENTS
    if truth["kind"] == "body" and "*" not in (truth["name"], said["name"]):
        (chain, number), (other, near) = (_numbered(location["name"]) for location in (truth, said))
        return chain == other and abs(number - near) <= _SEGMENTS
    return truth["name"] == said["name"]


def _numbered(name: str) -> tuple[str, int]:
    """The name of a body without its last number, and that number; 0 where it has none."""
    if (found := re.search(r"\d+(?=\D*$)", name)) is None:
        return name, 0
    return f"{name[: found.start()]}#{name[found.end() :]}", int(found[0])


def _part(location: dict) -> str:
    """Of which kind a location is: one cable, one segment or keypoint, or the whole robot."""
    if location.get("index") is not None:
        return "segment"
    part = "cable" if location["kind"] in _CABLES else "segment" if location["kind"] == "body" else "whole"
    return "whole" if location["name"] == "*" else part


def _raw_explained(unseen: dict) -> float:
    """The share of the variance above the noise that is explained, numerical error and all; 0 where there is none."""
    before, after = (unseen[key] ** 2 - unseen["noise_floor"] ** 2 for key in ("rmse_before", "rmse_after"))
    return 1.0 - max(after, 0.0) / before if before > 0 else 0.0


def _confusion(rows: Sequence[dict]) -> list[dict]:
    """What was said of what, the most frequent mistakes first."""
    pairs: Counter[tuple[str, str]] = Counter()
    for row in rows:
        if not row["first"]:
            pairs[" + ".join(row["truth"]) or "none", row["said"][0]] += 1
    return [{"truth": truth, "said": said, "cases": n} for (truth, said), n in pairs.most_common()]
