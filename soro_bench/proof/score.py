"""Scores of diagnoses against the sealed labels: gates with bootstrap intervals, confusions, calibration."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from soro_bench.files import read_json
from soro_bench.proof.magnitude import magnitude_errors

BOOTSTRAP, LEVEL = 2000, 95  # resamples, and per cent of the interval
BINS = 10  # of stated probabilities
_SAME_PLACE = {"tendon", "actuator"}  # a cable and the actuator that pulls it
_SEGMENTS = 1  # a body or keypoint may be off by so many
_FAINT = 0.3  # mm, a change of keypoints that is too small to be explained, against 0.5 mm of noise


def opened_labels(folder: Path) -> list[dict]:
    """The labels of a set of cases; ValueError if they are not those that were committed to."""
    path = folder / "sealed" / "labels.json"
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if (committed := (folder / "commitment.txt").read_text().strip()) != found:
        raise ValueError(f"{path} has the hash {found}, the commitment is {committed}")
    return read_json(path, 100_000_000)["cases"]


def scored(labels: Sequence[dict], reports: dict[str, dict], seed: int = 0) -> dict:
    """The scorecard: what of ``labels`` the ``reports`` (by id) found.

    Returns:
        {"cases": a row per case, "gates": a row per gate, "confusion": (truth, said, count), "calibration": bins}.
    """
    rows = [case_row(label, reports[label["id"]]) for label in labels if label["id"] in reports]
    rng = np.random.default_rng(seed)
    return {
        "cases": rows,
        "gates": [_gate(rows, *gate, rng) for gate in GATES],
        "confusion": _confusion(rows),
        "calibration": _calibration(rows),
    }


def case_row(label: dict, report: dict) -> dict:
    """What a report found of what a label says."""
    first, said = report["effects"][0], [e["name"] for e in report["effects"][:3]]
    if not 0.0 <= first["probability"] <= 1.0:
        raise ValueError(f"the probability of {first['name']} is {first['probability']}; allowed: 0 to 1")
    truth, all_of_them = [e["name"] for e in label["effects"]], report["hypotheses"][0]["names"]
    named = next((e for e in label["effects"] if e["name"] == first["name"]), label["effects"][0] if truth else None)
    concealed = None
    if label["group"] in ("one", "two"):
        left = max(report["fit"]["parameters_only"] ** 2 - label["noise"]["value"] ** 2, 0.0)
        concealed = 1.0 - 3.0 * left / (1e-3 * label["change_mm"]["train"]) ** 2
    error, inside = (named and magnitude_errors(named, first)) or (None, None)
    return {
        "id": label["id"],
        "group": label["group"],
        "robot": label["robot"],
        "truth": truth,
        "said": said,
        "verdict": report["verdict"],
        "probability": first["probability"],
        "alarm": report["verdict"] != "none_detected",
        "first": first["name"] in (truth or ["none"]),
        "first_three": bool(set(said) & set(truth)),
        "exact": report["verdict"] != "unknown_physics" and sorted(all_of_them) == sorted(truth),
        "right_class": report["classes"][0]["class"] in [e["class"] for e in label["effects"]],
        "place": bool(named) and _same_place(named["where"], first["where"]),
        "covered": bool(set(report["credible_set"]) & set(truth or ["none"])),
        "said_measurement": first["class"] == "measurement",
        "is_measurement": label["group"] == "measurement",
        "magnitude_error": error,
        "magnitude_inside": inside,
        "fve_unseen": report["unseen"] and report["unseen"]["fve"],
        "change_unseen_mm": label["change_mm"]["task"],
        "concealed": concealed,
        "seconds": report["seconds"],
    }


def _same_place(truth: dict, said: dict | None) -> bool:
    """Whether a place is right: the same cable, or a segment or keypoint next to it."""
    if not said:
        return False
    kinds = [truth["kind"], said["kind"]]
    if kinds[0] != kinds[1] and not set(kinds) <= _SAME_PLACE:
        return False
    if truth.get("index") is not None:
        return said.get("index") is not None and abs(truth["index"] - said["index"]) <= _SEGMENTS
    if truth["kind"] == "body" and "*" not in (truth["name"], said["name"]):
        numbers = [int("".join(filter(str.isdigit, name)) or -9) for name in (truth["name"], said["name"])]
        return abs(numbers[0] - numbers[1]) <= _SEGMENTS
    return truth["name"] == said["name"]


def _mean(key: str) -> Callable[[list[dict]], float]:
    return lambda rows: float(np.mean([row[key] for row in rows]))


def _median(key: str) -> Callable[[list[dict]], float]:
    return lambda rows: float(np.median([row[key] for row in rows]))


def _both(*keys: str) -> Callable[[list[dict]], float]:
    return lambda rows: float(np.mean([all(row[key] for key in keys) for row in rows]))


def _calibration(rows) -> list[dict]:
    """Stated probability of the first answer against how often it was right, in bins."""
    found = []
    for low in np.arange(BINS) / BINS:
        inside = [r for r in rows if low <= r["probability"] < low + 1 / BINS or (r["probability"] == 1 and low == 0.9)]
        if inside:
            found.append({
                "cases": len(inside),
                "stated": _mean("probability")(inside),
                "right": _mean("first")(inside),
            })
    return found


def _expected_error(rows) -> float:
    """Expected calibration error (Naeini et al., AAAI 2015)."""
    return sum(b["cases"] * abs(b["stated"] - b["right"]) for b in _calibration(rows)) / len(rows)


def _abstained(rows) -> float:
    return float(np.mean([row["verdict"] == "unknown_physics" for row in rows]))


def _confused(rows) -> float:
    return float(np.mean([row["said_measurement"] != row["is_measurement"] for row in rows]))


def _group(*names: str) -> Callable[[dict], bool]:
    return lambda row: row["group"] in names


_NAMED, _ANY = _group("one", "two", "measurement"), _group("none", "one", "two", "measurement", "unknown")
_KNOWN = _group("none", "one", "two", "measurement")


def shows(row) -> bool:
    """Whether concealed physics changes the unseen motion enough to be explained."""
    return row["group"] in ("one", "two") and row["change_unseen_mm"] >= _FAINT


def _measured(row) -> bool:
    return row["first"] and row["magnitude_error"] is not None


def hidden(row) -> bool:
    """Whether parameters absorb more than 90 % of what the concealed physics changes."""
    return row["concealed"] is not None and row["concealed"] > 0.9


# what, of which cases, how it is computed, the bar (None: only reported), and whether it has to be below it
GATES = (
    ("false alarms", _group("none"), _mean("alarm"), 0.03, True),
    ("detected", lambda row: row["group"] != "none", _mean("alarm"), 0.95, False),
    ("first answer right", _NAMED, _mean("first"), 0.80, False),
    ("right among the first three", _NAMED, _mean("first_three"), 0.95, False),
    ("class right", _NAMED, _mean("right_class"), 0.92, False),
    ("place right", lambda row: _NAMED(row) and row["first"], _mean("place"), 0.95, False),
    ("truth in the 90 % set, at least", _KNOWN, _mean("covered"), 0.88, False),
    ("truth in the 90 % set, at most", _KNOWN, _mean("covered"), 0.95, True),
    ("expected calibration error", _ANY, _expected_error, 0.05, True),
    ("variance of unseen motion explained, median", shows, _median("fve_unseen"), 0.90, False),
    ("unknown called unknown", _group("unknown"), _abstained, 0.80, False),
    ("unknown called so, at the right place", _group("unknown"), _both("first", "place"), 0.75, False),
    ("physics and measurement confused", _NAMED, _confused, 0.02, True),
    (
        "first answer right where parameters hide 90 %",
        hidden,
        _mean("first"),
        0.8,
        False,
    ),
    ("seconds, median", _ANY, _median("seconds"), 60.0, True),
    ("two effects: both named, and no other", _group("two"), _mean("exact"), None, False),
    ("magnitude of what is named rightly: error, median", _measured, _median("magnitude_error"), None, True),
    ("magnitude of what is named rightly: in its 90 % interval", _measured, _mean("magnitude_inside"), None, False),
)


def _gate(rows, name, chosen, statistic, bar, below, rng) -> dict:
    members = [row for row in rows if chosen(row)]
    gate = {
        "gate": name,
        "cases": len(members),
        "value": None,
        "interval": None,
        "bar": bar,
        "below": below,
        "met": None,
    }
    if not members:
        return gate
    value = statistic(members)
    draws = [statistic([members[i] for i in rng.integers(len(members), size=len(members))]) for _ in range(BOOTSTRAP)]
    tail = (100 - LEVEL) / 2
    interval = [float(q) for q in np.percentile(draws, (tail, 100 - tail))]
    met = None if bar is None else value <= bar if below else value >= bar
    return gate | {"value": value, "interval": interval, "met": met}


def _confusion(rows) -> list[dict]:
    """What was said of what, the most frequent mistakes first."""
    pairs = Counter()
    for row in rows:
        if not row["first"]:
            said = row["said"][0] if row["alarm"] else "none"
            pairs[" + ".join(row["truth"]) or "none", said] += 1
    return [{"truth": truth, "said": said, "cases": n} for (truth, said), n in pairs.most_common()]


def markdown(card: dict) -> str:
    """The scorecard as tables."""
    gates = _rows("gate", "cases", "value", "95 % interval", "bar", "")
    for gate in card["gates"]:
        bar = "" if gate["bar"] is None else f"{'<=' if gate['below'] else '>='} {gate['bar']:g}"
        value, interval, met = "", "", ""
        if gate["value"] is not None:
            value, interval = f"{gate['value']:.3g}", "{:.3g} .. {:.3g}".format(*gate["interval"])
            met = {True: "met", False: "MISSED", None: ""}[gate["met"]]
        gates.append(f"| {gate['gate']} | {gate['cases']} | {value} | {interval} | {bar} | {met} |")
    confusion = _rows("hidden", "first answer", "cases")
    confusion += [f"| {c['truth']} | {c['said']} | {c['cases']} |" for c in card["confusion"]]
    calibration = _rows("stated probability", "right", "cases")
    calibration += [f"| {b['stated']:.2f} | {b['right']:.2f} | {b['cases']} |" for b in card["calibration"]]
    cases = _rows("case", "robot", "hidden", "verdict", "first three answers", "p", "unseen explained")
    for row in card["cases"]:
        truth, said, explained = " + ".join(row["truth"]) or "none", ", ".join(row["said"]), f"{row['fve_unseen']:.2f}"
        cells = [row["id"], row["robot"], truth, row["verdict"], said, f"{row['probability']:.2f}", explained]
        cases.append(f"| {' | '.join(cells)} |")
    return "\n".join([*gates, "", *confusion, "", *calibration, "", *cases])


def _rows(*head: str) -> list[str]:
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
