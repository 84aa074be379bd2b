"""Scores of diagnoses against the sealed labels: acceptance criteria with intervals, confusions, calibration."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

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
    exact, found = factor * truth["parameters"][own]["value"], said["parameters"][others]
    low, high = found["ci90"]
    size = abs(exact - _NULL.get(truth["name"], 0.0))
    return abs(found["value"] - exact) / size, bool(low <= exact <= high)


BOOTSTRAP, LEVEL = 2000, 95  # resamples, and per cent of the interval
BINS = 10  # of stated probabilities
LABEL_BYTES = 100_000_000
_ID, _HASH = re.compile(r"case_[0-9]{3,}"), re.compile(r"[0-9a-f]{64}")
_DRAWS = 200  # of outcomes, of a method whose probabilities are right
_CABLES = {"tendon", "actuator"}  # a cable and the actuator that pulls it
_SEGMENTS = 1  # a body or keypoint may be off by so many
Chosen = Callable[[dict], bool]  # whether a case, as case_row gives it, counts
Statistic = Callable[[Sequence[dict]], float]  # of such cases
_FAINT = 0.3  # mm, a change of keypoints that is too small to be explained, against 0.5 mm of noise


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
    criteria = (*CRITERIA, *(OF_OTHERS if any(row["kind"] for row in rows) else ()))
    return {
        "cases": rows,
        "gates": [_criterion(rows, *criterion, rng) for criterion in criteria],
        "confusion": _confusion(rows),
        "calibration": _calibration(rows),
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
        numbers = [int("".join(filter(str.isdigit, name)) or -9) for name in (truth["name"], said["name"])]
        return abs(numbers[0] - numbers[1]) <= _SEGMENTS
    return truth["name"] == said["name"]


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


@dataclass(frozen=True)
class Share:
    """The share of cases of which all of some keys are true."""

    keys: tuple[str, ...]

    def __init__(self, *keys: str) -> None:
        object.__setattr__(self, "keys", keys)

    def __call__(self, rows: Sequence[dict]) -> float:
        return self.count(rows) / len(rows)

    def count(self, rows: Sequence[dict]) -> int:
        """How many they are."""
        return sum(all(row[key] for key in self.keys) for row in rows)


def _median(key: str) -> Statistic:
    return lambda rows: float(np.median([row[key] for row in rows]))


def _calibration(rows: Sequence[dict]) -> list[dict]:
    """Stated probability of the first answer against how often it was right, in bins."""
    found = []
    for k in range(BINS):
        if inside := [row for row in rows if _bin(row) == k]:
            found.append({
                "cases": len(inside),
                "stated": float(np.mean([row["probability"] for row in inside])),
                "right": Share("first")(inside),
            })
    return found


def _bin(row: dict) -> int:
    return min(int(BINS * row["probability"]), BINS - 1)


def _expected_error(rows: Sequence[dict]) -> float:
    """Expected calibration error (Naeini et al., AAAI 2015)."""
    return sum(b["cases"] * abs(b["stated"] - b["right"]) for b in _calibration(rows)) / len(rows)


def _error_by_chance(rows: Sequence[dict]) -> float:
    """The expected calibration error of a method whose stated probabilities are right: of few cases it is not zero."""
    stated, bins = np.array([row["probability"] for row in rows]), np.eye(BINS)[[_bin(row) for row in rows]]
    right = np.random.default_rng(0).random((_DRAWS, len(rows))) < stated
    return float(np.abs((right - stated) @ bins).sum(axis=1).mean() / len(rows))


def _group(*names: str) -> Callable[[dict], bool]:
    return lambda row: row["group"] in names


_NAMED, _ANY = _group("one", "two", "measurement"), _group("none", "one", "two", "measurement", "unknown")
_KNOWN = _group("none", "one", "two", "measurement")


def _answered(row: dict) -> bool:
    return _NAMED(row) and row["answered"]


def _rightly_named(part: str) -> Callable[[dict], bool]:
    return lambda row: _NAMED(row) and row["first"] and row["part"] == part


def shows(row: dict) -> bool:
    """Whether hidden physics changes the unseen motion enough to be explained."""
    return row["group"] in ("one", "two") and row["change_unseen_mm"] >= _FAINT


def _shows_on(robot: str) -> Callable[[dict], bool]:
    return lambda row: shows(row) and row["robot"] == robot


def _measured(row: dict) -> bool:
    return row["first"] and row["magnitude_error"] is not None


def absorbed(row: dict, share: float = 0.9) -> bool:
    """Whether parameters absorb more than a share of what the hidden physics changes."""
    return row["absorbed"] is not None and row["absorbed"] > share


# what, of which cases, how it is computed, the threshold (None: only reported), and whether it has to be below it
CRITERIA: tuple[tuple[str, Chosen, Statistic, float | None, bool], ...] = (
    ("false alarms", _group("none"), Share("alarm"), 0.03, True),
    ("detected", lambda row: row["group"] != "none", Share("alarm"), 0.95, False),
    ("first answer right", _NAMED, Share("first"), 0.80, False),
    ("right among the first three", _NAMED, Share("first_three"), 0.95, False),
    ("class right", _NAMED, Share("right_class"), 0.92, False),
    ("of right names: place right", lambda row: _NAMED(row) and row["first"], Share("place"), 0.95, False),
    ("of right names: cable right", _rightly_named("cable"), Share("place"), 0.95, False),
    ("of right names: segment or keypoint within one", _rightly_named("segment"), Share("place"), 0.95, False),
    ("truth in the 90 % set, at least", _KNOWN, Share("covered"), 0.88, False),
    ("truth in the 90 % set, at most", _KNOWN, Share("covered"), 0.95, True),
    ("expected calibration error", _ANY, _expected_error, 0.05, True),
    ("the same of probabilities that are right, by chance", _ANY, _error_by_chance, None, True),
    ("unseen motion: variance explained, median, numerical error off", shows, _median("fve_unseen"), 0.90, False),
    (
        "unseen motion: variance explained, median, all of the error",
        shows,
        _median("fve_unseen_raw"),
        None,
        False,
    ),
    # where the real robot is another model, the difference between the two models is most of the error, patch or not
    ("the same, fine robots: error after over before, median", _shows_on("fine"), _median("error_left"), None, True),
    ("the same, flex robots: error after over before, median", _shows_on("flex"), _median("error_left"), None, True),
    ("unknown called unknown", _group("unknown"), Share("abstained"), 0.80, False),
    ("unknown called so, at the right place", _group("unknown"), Share("first", "place"), 0.75, False),
    ("physics and measurement confused", _NAMED, Share("confused"), 0.02, True),
    ("of those with a name for it: physics and measurement confused", _answered, Share("confused"), None, True),
    ("first answer right where parameters hide 90 %", absorbed, Share("first"), 0.8, False),
    ("the same, where they hide half", lambda row: absorbed(row, 0.5), Share("first"), None, False),
    ("seconds, median", _ANY, _median("seconds"), 60.0, True),
    ("two effects: both named, and no other", _group("two"), Share("exact"), None, False),
    ("magnitude of what is named rightly: error, median", _measured, _median("magnitude_error"), None, True),
    ("magnitude of what is named rightly: in its 90 % interval", _measured, Share("magnitude_inside"), None, False),
)


def _of_kind(kind: str, healthy: bool) -> Chosen:
    return lambda row: row["kind"] == kind and (row["group"] == "none") is healthy


# of sets with cases of other simulators, after the others: entries that were written before have none of them
OF_OTHERS: tuple[tuple[str, Chosen, Statistic, float | None, bool], ...] = (
    ("other simulators: false alarms", lambda row: row["kind"] and row["group"] == "none", Share("alarm"), 0.02, True),
    *(
        (f"other simulators, {kind}: false alarms", _of_kind(kind, True), Share("alarm"), None, True)
        for kind in ("cable", "flex", "links", "pyelastica", "sorosim")
    ),
    ("other simulators: first answer right", _of_kind("hidden", False), Share("first"), 0.80, False),
    (
        "other simulators: of right names, place right",
        lambda row: row["kind"] == "hidden" and row["first"],
        Share("place"),
        0.90,
        False,
    ),
)


def _criterion(
    rows: Sequence[dict],
    name: str,
    chosen: Chosen,
    statistic: Statistic,
    threshold: float | None,
    below: bool,
    rng: np.random.Generator,
) -> dict:
    members = [row for row in rows if chosen(row)]
    criterion = {
        "gate": name,
        "cases": len(members),
        "value": None,
        "interval": None,
        "bar": threshold,
        "below": below,
        "met": None,
    }
    if not members:
        return criterion
    value, interval = statistic(members), _interval(statistic, members, rng)
    return criterion | {"value": value, "interval": interval, "met": is_met(value, threshold, below)}


def is_met(value: float | None, threshold: float | None, below: bool) -> bool | None:
    """Whether a criterion is met; None if there is no such case, or no threshold."""
    if value is None or threshold is None:
        return None
    return value <= threshold if below else value >= threshold


def _interval(statistic: Statistic, members: Sequence[dict], rng: np.random.Generator) -> list[float]:
    """95 %: exact for shares (Clopper and Pearson 1934), where resampling would make none of 40 certain; by bootstrap
    for others."""
    if isinstance(statistic, Share):
        ends = binomtest(statistic.count(members), len(members)).proportion_ci(LEVEL / 100)
        return [float(ends.low), float(ends.high)]
    draws = [statistic([members[i] for i in rng.integers(len(members), size=len(members))]) for _ in range(BOOTSTRAP)]
    tail = (100 - LEVEL) / 2
    return [float(q) for q in np.percentile(draws, (tail, 100 - tail))]


def _confusion(rows: Sequence[dict]) -> list[dict]:
    """What was said of what, the most frequent mistakes first."""
    pairs: Counter[tuple[str, str]] = Counter()
    for row in rows:
        if not row["first"]:
            pairs[" + ".join(row["truth"]) or "none", row["said"][0]] += 1
    return [{"truth": truth, "said": said, "cases": n} for (truth, said), n in pairs.most_common()]
