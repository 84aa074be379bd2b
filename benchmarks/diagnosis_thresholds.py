"""What a development set says about the settings of model probabilities (``ProbabilitySettings``).

    soro-bench prove --out FOLDER --count 40 --seed 1    # any seed but that of a final set
    python benchmarks/diagnosis_thresholds.py FOLDER

It opens the labels, so a set that is still to be scored is none for it. It works on the cases that have a report.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import gumbel_r

from soro_bench.blind_benchmark.score import opened_labels
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.files import read_json
from soro_bench.markdown import table

SETTINGS = DEFAULT.probabilities


def left(hypothesis: dict) -> float:
    """Excess [nats] that a hypothesis of a report leaves."""
    return hypothesis["excess"]


def nominal_of(report: dict) -> dict:
    """The hypothesis without effects."""
    return next(h for h in report["hypotheses"] if not h["names"])


def shares(report: dict) -> tuple[float, float, float]:
    """Excess of the nominal robot and of the best hypothesis [nats], and the share that decides about unknown physics
    (``unknown_share``)."""
    nominal, best = left(nominal_of(report)), min(map(left, report["hypotheses"]))
    least = SETTINGS.healthy_misfit_per_sample * nominal_of(report)["samples"]
    return nominal, best, (best - least) / max(nominal - least, 1.0)


def promises(cases) -> str:
    """How much the best lead promises: of nulls, a Gumbel distribution; of the others, the least."""
    healthy = [report["promised"] for label, report in cases if label["group"] == "none"]
    others = sorted((report["promised"], label["id"]) for label, report in cases if label["group"] != "none")
    lines = [f"healthy cases promise {', '.join(f'{p:.0f}' for p in sorted(healthy))} nats"]
    if len(healthy) > 1:
        location, scale = gumbel_r.fit(healthy)
        lines.append(f"their Gumbel distribution: location {location:.0f}, scale {scale:.0f}, "
                     f"99 % below {gumbel_r.ppf(0.99, location, scale):.0f}")  # fmt: skip
    lines.append("the others, the least first: " + ", ".join(f"{p:.0f} ({name})" for p, name in others[:6]))
    return "\n".join(lines)


def cases_table(cases) -> str:
    """Markdown: what each case leaves."""
    rows = []
    for label, report in cases:
        found = sorted((h for h in report["hypotheses"] if h["names"]), key=lambda h: -h["evidence"])
        said = [" + ".join(h["names"]) for h in found]
        ahead = f"{found[0]['evidence'] - found[1]['evidence']:.0f} ({said[1]})" if len(found) > 1 else ""
        hidden = " + ".join(e.get("law", e["name"]) for e in label["effects"]) or "none"
        nominal, best, share = shares(report)
        cells = [label["id"], label["group"], hidden, said[0] if said else "none", ahead, f"{nominal:.0f}"]
        limit = SETTINGS.unknown_gain + SETTINGS.unknown_gain_of_explained * (nominal - best)
        still = report["still_promised"] / limit
        rows.append((*cells, f"{best:.0f}", f"{share:.2f}", f"{still:.2f}"))
    heads = ("case", "group", "hidden", "first answer", "evidence over the next", "excess, nominal", "best", "share")
    return table((*heads, "still promised / limit"), rows)


def log_loss(cases, nats: float, share: float) -> float:
    """Mean surprise [nats] at the right hypotheses, where there are some among others, if evidence is divided by
    nats + share * excess."""
    found = []
    for label, report in cases:
        truth = {e["name"] for e in label["effects"]}
        named = [h for h in report["hypotheses"] if h["names"]]
        right = np.array([set(h["names"]) <= truth for h in named])
        if right.any() and not right.all():
            evidence = np.array([h["evidence"] for h in named])
            misfit = min(h["excess_of_all"] for h in report["hypotheses"])
            tempered = evidence / (nats + share * max(misfit, 0.0))
            chances = np.exp(tempered - tempered.max())
            found.append(-np.log(max(chances[right].sum() / chances.sum(), 1e-300)))
    return float(np.mean(found)) if found else np.nan


def temper(cases) -> str:
    """Markdown: surprise for choices of the temperature."""
    shares_tried = (0.0, 0.03, 0.1, 0.3)
    rows = [(nats, *(f"{log_loss(cases, nats, s):.3f}" for s in shares_tried)) for nats in (1, 3, 10, 30, 100, 300)]
    return table(("nats", *(f"share {s:g}" for s in shares_tried)), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    labels = {label["id"]: label for label in opened_labels(folder / "cases")}
    cases = [(labels[path.stem], read_json(path)) for path in sorted((folder / "reports").glob("case_*.json"))]
    print("\n\n".join((promises(cases), cases_table(cases), temper(cases))))


if __name__ == "__main__":
    main()
