"""The scorecard for people, and what each part of the diagnosis is worth."""

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from soro_bench.blind_benchmark.criteria import absorbed, shows
from soro_bench.blind_benchmark.score import case_row
from soro_bench.markdown import table

_OF_AN_EFFECT = (
    "hidden", "alone", "first answer right", "and its location", "with another effect", "among the first three",
)  # fmt: skip
_OF_A_CASE = (
    "case", "robot", "hidden", "verdict", "first three answers", "p", "unseen explained", "taken up by parameters",
)  # fmt: skip


def markdown(card: dict) -> str:
    """The scorecard as tables."""
    criteria = []
    for criterion in card["gates"]:
        threshold = ""
        if criterion["bar"] is not None:
            threshold = f"{'<=' if criterion['below'] else '>='} {criterion['bar']:g}"
        value, interval, met = "", "", ""
        if criterion["value"] is not None:
            value, interval = f"{criterion['value']:.3g}", "{:.3g} .. {:.3g}".format(*criterion["interval"])
            met = {True: "met", False: "MISSED", None: ""}[criterion["met"]]
        criteria.append((criterion["gate"], criterion["cases"], value, interval, threshold, met))
    confusion = [(c["truth"], c["said"], c["cases"]) for c in card["confusion"]]
    calibration = [(f"{b['stated']:.2f}", f"{b['right']:.2f}", b["cases"]) for b in card["calibration"]]
    cases = []
    for row in card["cases"]:
        truth, said, hides = " + ".join(row["truth"]) or "none", ", ".join(row["said"]), row["absorbed"]
        shares = ("" if share is None else f"{share:.2f}" for share in (row["probability"], row["fve_unseen"], hides))
        cases.append((row["id"], row["robot"], truth, row["verdict"], said, *shares))
    tables = (
        table(("criterion", "cases", "value", "95 % interval", "threshold", ""), criteria),
        table(("hidden", "first answer", "cases"), confusion),
        table(_OF_AN_EFFECT, _by_effect(card["cases"])),
        table(("stated probability", "right", "cases"), calibration),
        table(_OF_A_CASE, cases),
    )
    return "\n\n".join(tables)


def _by_effect(rows: Sequence[dict]) -> list[tuple]:
    """Of every hidden effect: in how many of the cases that have it alone the first answer and its location are right,
    and in how many that have another one too it is among the first three answers; the worst first."""
    found = []
    for name in sorted({name for row in rows for name in row["truth"] or ["none"]}):
        alone = [row for row in rows if (row["truth"] or ["none"]) == [name]]
        pairs = [row for row in rows if name in row["truth"] and len(row["truth"]) > 1]
        right = [row for row in alone if row["first"]]
        located = "" if name == "none" else sum(row["place"] for row in right)
        three = sum(name in row["said"] for row in pairs)
        missed = len(alone) - len(right) + len(pairs) - three
        found.append((-missed / (len(alone) + len(pairs)), name, len(alone), len(right), located, len(pairs), three))
    return [each[1:] for each in sorted(found)]


_COLUMNS = ("false alarms", "first answer right", "class right", "right where parameters hide 90 %",
            "variance of unseen motion explained", "rms on unseen motion [mm]")  # fmt: skip


def ablation_rows(
    labels: Sequence[dict], reports: Mapping[str, dict], others: Mapping[str, Mapping[str, dict]]
) -> list[dict]:
    """A dict per variant: its name, how many cases, and the figures of ``_COLUMNS`` (None where there are none).

    Args:
        labels: of the cases.
        reports: of the whole method, by the cases' ids.
        others: of every ablation, by its name and the cases' ids: reports, or errors on unseen motion only.
    """
    ids = set.intersection(*(set(found) for found in others.values())) if others else set(reports)
    chosen = [label for label in labels if label["id"] in ids and label["id"] in reports]
    variants = {
        "the whole method": reports,
        "no class merge": {name: unmerged(report) for name, report in reports.items()},
        "raw BIC": {name: by_bic(report) for name, report in reports.items()},
        "parameters only, our fit": {name: _unpatched(report) for name, report in reports.items()},
        **others,
    }
    # the same cases for all, by how the whole method saw them
    hard = {label["id"] for label in chosen if absorbed(case_row(label, reports[label["id"]]))}
    rows = [
        {"variant": name, "cases": len(chosen), **_figures(chosen, found, hard)} for name, found in variants.items()
    ]
    # it compares what our detection lets through, which of a null is nothing
    return [row | {"false alarms": None} if row["variant"] == "raw BIC" else row for row in rows]


def _unpatched(report: dict) -> dict:
    """What is known of a report's fit without effects."""
    return {"unseen": report["unseen"] and {"rmse_after": report["unseen"]["rmse_before"]}}


def unmerged(report: dict) -> dict:
    """A report that takes the class of its first answer instead of adding up what is of one class."""
    return report | {"classes": [{"class": report["effects"][0]["class"]}]}


def by_bic(report: dict) -> dict:
    """A report whose hypotheses are compared by the Bayesian information criterion (Schwarz 1978) on the recording;
    nothing competes with outliers."""
    if report["effects"][0]["name"] == "outliers":
        return unmerged(report)
    hypotheses = report["hypotheses"]
    score = np.array([-h["excess"] - 0.5 * h["unknowns"] * math.log(h["samples"]) for h in hypotheses])
    chances = np.exp(score - score.max())
    chances /= chances.sum()
    effects = []
    for effect in report["effects"]:
        own = [c for c, h in zip(chances, hypotheses, strict=True) if _has(h, effect)]
        effects.append(effect | {"probability": min(1.0, float(sum(own)))})
    effects.sort(key=lambda e: -e["probability"])
    nothing = not hypotheses[int(score.argmax())]["names"]
    verdict = "none_detected" if nothing else "missing_physics"
    return unmerged(report | {"effects": effects, "credible_set": [effects[0]["name"]], "verdict": verdict})


def _has(hypothesis: dict, effect: dict) -> bool:
    if effect["name"] == "none":
        return not hypothesis["names"]
    return (effect["name"], effect["where"]) in list(zip(hypothesis["names"], hypothesis["where"], strict=True))


def _figures(labels: Sequence[dict], found: Mapping[str, dict], hard: Collection[str]) -> dict:
    figures: dict[str, float | None] = dict.fromkeys(_COLUMNS)
    fits = [found[label["id"]]["unseen"] for label in labels]
    fits = [fit for fit in fits if fit]
    if all("effects" in report for report in found.values()):
        rows = [case_row(label, found[label["id"]]) for label in labels]
        named = [r for r in rows if r["group"] in ("one", "two", "measurement")]
        figures["false alarms"] = _mean([r["alarm"] for r in rows if r["group"] == "none"])
        figures["first answer right"] = _mean([r["first"] for r in named])
        figures["class right"] = _mean([r["right_class"] for r in named])
        figures["right where parameters hide 90 %"] = _mean([r["first"] for r in named if r["id"] in hard])
        shown = [r["fve_unseen"] for r in rows if shows(r) and r["fve_unseen"] is not None]
        figures["variance of unseen motion explained"] = _median(shown)
    figures["rms on unseen motion [mm]"] = _median([1e3 * fit["rmse_after"] for fit in fits])
    return figures


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def as_tables(rows: Sequence[dict]) -> str:
    """The rows as a table."""
    cells = [["" if row[name] is None else f"{row[name]:.2f}" for name in _COLUMNS] for row in rows]
    found = [[row["variant"], row["cases"], *figures] for row, figures in zip(rows, cells, strict=True)]
    return table(["variant", "cases", *_COLUMNS], found)
