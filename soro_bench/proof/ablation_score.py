"""Scores of the ablations beside those of the whole method, on the same cases."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from soro_bench.proof.score import case_row

_COLUMNS = ("false alarms", "first answer right", "class right", "held-out variance explained", "held-out rms [mm]",
            "right where parameters hide 90 %")  # fmt: skip


def ablation_rows(labels: Sequence[dict], reports: Mapping[str, dict], others: Mapping[str, Mapping[str, dict]]):
    """A dict per variant: its name, how many cases, and the figures of ``_COLUMNS`` (None where there are none).

    Args:
        labels: of the cases.
        reports: of the whole method, by the cases' ids.
        others: of every ablation, by its name and the cases' ids: reports, or fits that name nothing.
    """
    ids = set.intersection(*(set(found) for found in others.values())) if others else set(reports)
    chosen = [label for label in labels if label["id"] in ids and label["id"] in reports]
    variants = {
        "the whole method": reports,
        "no class merge": {name: unmerged(report) for name, report in reports.items()},
        "raw BIC": {name: by_bic(report) for name, report in reports.items()},
        **others,
    }
    return [{"variant": name, "cases": len(chosen), **_figures(chosen, found)} for name, found in variants.items()]


def unmerged(report: dict) -> dict:
    """A report that takes the class of its first answer instead of adding up what is of one class."""
    return report | {"classes": [{"class": report["effects"][0]["class"]}]}


def by_bic(report: dict) -> dict:
    """A report whose hypotheses are compared by the Bayesian information criterion (Schwarz 1978) on the recording."""
    hypotheses = report["hypotheses"]
    score = np.array([-h["excess"] - 0.5 * h["unknowns"] * math.log(h["samples"]) for h in hypotheses])
    chances = np.exp(score - score.max())
    chances /= chances.sum()
    effects = []
    for effect in report["effects"]:
        own = [c for c, h in zip(chances, hypotheses, strict=True) if _has(h, effect)]
        effects.append(effect | {"probability": float(sum(own))})
    effects.sort(key=lambda e: -e["probability"])
    nothing = not hypotheses[int(score.argmax())]["names"]
    verdict = "none_detected" if nothing else "missing_physics"
    return unmerged(report | {"effects": effects, "credible_set": [effects[0]["name"]], "verdict": verdict})


def _has(hypothesis, effect) -> bool:
    if effect["name"] == "none":
        return not hypothesis["names"]
    return (effect["name"], effect["where"]) in list(zip(hypothesis["names"], hypothesis["where"], strict=True))


def _figures(labels, found) -> dict:
    names = all("effects" in report for report in found.values())
    rows = [case_row(label, found[label["id"]]) for label in labels] if names else []
    fits = [found[label["id"]]["fit"]["heldout"] if names else found[label["id"]] for label in labels]
    figures: dict[str, float | None] = dict.fromkeys(_COLUMNS)
    if names:
        named = [r for r in rows if r["group"] in ("one", "two", "measurement")]
        figures["false alarms"] = _mean([r["alarm"] for r in rows if r["group"] == "none"])
        figures["first answer right"] = _mean([r["first"] for r in named])
        figures["class right"] = _mean([r["right_class"] for r in named])
        figures["right where parameters hide 90 %"] = _mean([r["first"] for r in named if (r["concealed"] or 0) > 0.9])
    figures["held-out variance explained"] = _median([_explained(fit) for fit in fits if fit])
    figures["held-out rms [mm]"] = _median([1e3 * fit["rmse_after"] for fit in fits if fit])
    return figures


def _explained(fit) -> float:
    noise = fit["noise_floor"] ** 2
    above = fit["rmse_before"] ** 2 - noise
    return 1.0 - max(fit["rmse_after"] ** 2 - noise, 0.0) / above if above > 0 else math.nan


def _mean(values) -> float | None:
    return float(np.mean(values)) if values else None


def _median(values) -> float | None:
    kept = [value for value in values if not math.isnan(value)]
    return float(np.median(kept)) if kept else None


def markdown(rows: Sequence[dict]) -> str:
    """The rows as a table."""
    lines = [f"| variant | cases | {' | '.join(_COLUMNS)} |", "|---" * (2 + len(_COLUMNS)) + "|"]
    for row in rows:
        cells = ["" if row[name] is None else f"{row[name]:.2f}" for name in _COLUMNS]
        lines.append(f"| {row['variant']} | {row['cases']} | {' | '.join(cells)} |")
    return "\n".join(lines)
