"""Acceptance criteria of a blind benchmark: shares and medians of its cases with intervals and thresholds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

BOOTSTRAP, LEVEL = 2000, 95  # resamples, and per cent of the interval
BINS = 10  # of stated probabilities
_DRAWS = 200  # of outcomes, of a method whose probabilities are right
Chosen = Callable[[dict], bool]  # whether a case, as case_row gives it, counts
Statistic = Callable[[Sequence[dict]], float]  # of such cases
Criterion = tuple[str, Chosen, Statistic, float | None, bool]  # see CRITERIA
_FAINT = 0.3  # mm, a change of keypoints that is too small to be explained, against 0.5 mm of noise


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


def calibration(rows: Sequence[dict]) -> list[dict]:
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
    return sum(b["cases"] * abs(b["stated"] - b["right"]) for b in calibration(rows)) / len(rows)


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
CRITERIA: tuple[Criterion, ...] = (
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
OF_OTHERS: tuple[Criterion, ...] = (
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


# thresholds that such sets, which came later, have instead
_STRICTER = {
    "false alarms": 0.01,
    "first answer right": 0.92,
    "truth in the 90 % set, at most": 0.97,
    "expected calibration error": 0.04,
}


def criteria(others: bool) -> tuple[Criterion, ...]:
    """The criteria of a set, with the stricter thresholds and the further rows of one with other simulators."""
    if not others:
        return CRITERIA
    stricter = ((name, of, how, _STRICTER.get(name, bar), below) for name, of, how, bar, below in CRITERIA)
    return (*stricter, *OF_OTHERS)


def measured(
    rows: Sequence[dict],
    name: str,
    chosen: Chosen,
    statistic: Statistic,
    threshold: float | None,
    below: bool,
    rng: np.random.Generator,
) -> dict:
    """A criterion of the cases: its value with a 95 % interval, its threshold, and whether it is met.

    Returns:
        {"gate", "cases", "value", "interval", "bar", "below", "met"}; None where no case is of this kind.
    """
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
