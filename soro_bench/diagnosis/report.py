"""report.json and the other files of a diagnosis for programs."""

import math
import sys
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.assembly.findings import (
    NINETY,
    described,
    deviations,
    findings,
    length,
    prior_values,
    tempered,
    unit_at,
)
from soro_bench.diagnosis.assembly.patch import MODEL, ModelPatch, kept, model_patch, patch, rejected, write_model_patch
from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.robots.priors import LIMIT, Baseline
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.experiment_design import DURATION, Proposal
from soro_bench.diagnosis.selection.forward_selection import Round
from soro_bench.diagnosis.selection.model_probabilities import ALPHA, Answer, Comparison, Fit
from soro_bench.effects.catalogue import ALL, CATEGORIES
from soro_bench.effects.effect import load_effects, save_effects
from soro_bench.files import brief, read_json, write_json
from soro_bench.randomization import Gaussian
from soro_bench.recording.excitation import write_actions

SCHEMA = "soro-bench/diagnosis/1"
CREDIBLE = 0.9
NEXT_ACTIONS = "next_actions.csv"


def write_json_report(diagnosis: Diagnosis, folder: str | Path) -> dict:
    """All files for programs: report, effects, posterior, patched model, actions to record next; returns the
    report."""
    folder, model = Path(folder), model_patch(diagnosis)
    report = {**report_of(diagnosis), **_model_patch(model)}
    (folder / "report.json").unlink(missing_ok=True)  # of an earlier diagnosis
    save_effects([*diagnosis.robot.known, *patch(diagnosis)], folder / "effects.json")
    if isinstance(diagnosis.robot, SuiteRobot):  # the others are not trained on
        write_json(folder / "posterior.json", posterior(diagnosis).to_dict())
    if diagnosis.proposal:
        rates, recorded = diagnosis.proposal.motion.actions, diagnosis.explanation.problem.recorded
        actions = diagnosis.robot.commanded(rates, recorded)
        write_actions(folder / NEXT_ACTIONS, diagnosis.robot.control_timestep, actions)
    else:
        (folder / NEXT_ACTIONS).unlink(missing_ok=True)  # of an earlier diagnosis
    write_model_patch(model, folder)
    write_json(folder / "report.json", report)  # the last, so that all others are of the same diagnosis
    return report


def _model_patch(found: ModelPatch) -> dict:
    return {
        "model_patch": MODEL if found.xml else None,
        "model_patch_effects": [effect.name for effect in found.effects],
        "model_patch_lacks": [effect.name for effect in found.remaining],
        "model_patch_obstacle": found.obstacle,
    }


def baseline(folder: str | Path) -> Baseline:
    """What the files of a report say of a robot; ValueError for other files."""
    path = Path(folder) / "report.json"
    report = read_json(path)
    if not isinstance(report, dict) or report.get("schema") != SCHEMA:
        raise ValueError(f"{path} is no report of a diagnosis: its schema has to be {SCHEMA}")
    try:
        found = report["parameters"].items()
        values = {name: _finite(each["value"]) for name, each in found}
        spread = {name: abs(_finite(each["ci90"][1]) - _finite(each["ci90"][0])) / (2 * NINETY) for name, each in found}
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{path} has no parameters with values and intervals ({error!r})") from error
    return Baseline(values, spread, load_effects(Path(folder) / "effects.json", ALL))


def _finite(value) -> float:
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"{brief(value)} is no number")
    return float(value)


def posterior(diagnosis: Diagnosis) -> Gaussian:
    """The parameters of the patched robot, as a distribution to train on."""
    fit, priors = kept(diagnosis), diagnosis.robot.priors
    low, middle, high = (prior_values(priors, fit.x + k * deviations(diagnosis, fit)) for k in (-1.0, 0.0, 1.0))
    width, cov = 0.5 * (high - low), tempered(diagnosis, fit)[: len(priors), : len(priors)]
    scale = np.sqrt(np.diag(cov))
    return Gaussian(tuple(p.name for p in priors), middle, np.outer(width / scale, width / scale) * cov)


def report_of(diagnosis: Diagnosis) -> dict:
    """The contents of report.json."""
    comparison, best = diagnosis.comparison, diagnosis.best
    ranked = [described(diagnosis, finding) for finding in findings(diagnosis)]
    nothing = comparison.nothing
    outliers = only_outliers(diagnosis)
    ranked.append(_nameless("none", 0.0 if outliers else nothing))
    ranked.append(_nameless("unknown", comparison.unknown, diagnosis))
    if diagnosis.outliers.share:
        ranked.append(_outliers(diagnosis, nothing if outliers else 0.0))
    ranked.sort(key=lambda e: -e["probability"])
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "p_value": comparison.p_value,
        "alpha": ALPHA,
        "promised": diagnosis.explanation.predicted_gain,
        "still_promised": diagnosis.explanation.left,
        "effects": ranked,
        "classes": _classes(diagnosis, ranked),
        "hypotheses": [_hypothesis(diagnosis, answer) for answer in comparison.ranked],
        "rounds": [_round(each) for each in diagnosis.explanation.rounds],
        "credible_set": _credible(comparison, "outliers" if outliers else "none"),
        "fit": {
            "train": _fit(best.train),
            "heldout": None if best.heldout is None else _fit(best.heldout),
            "fve_heldout": None if best.heldout is None else _number(best.heldout.explained),
            "parameters_only": diagnosis.explanation.unpatched,
            "unit": diagnosis.explanation.problem.recordings[0].unit,
            "patch": _state_of_patch(diagnosis),
        },
        "parameters": _parameters(diagnosis, kept(diagnosis)),
        "places": [{"where": p.location.to_json(), "gain": p.gain} for p in diagnosis.ranked_locations[:10]],
        "residual_force": _residual_force(diagnosis),
        "detectable": detectable(diagnosis),
        "invisible": invisible(diagnosis),
        "not_looked_for": not_looked_for(diagnosis),
        "next_recording": _next_recording(diagnosis.proposal),
        "audit": [{"noise": a.sigma, "missing": a.missing} for a in diagnosis.data_qualities],
        "seconds": round(diagnosis.seconds, 1),
    }


def _state_of_patch(diagnosis: Diagnosis) -> str:
    """Untested: no recording was held out that could have spoken against it."""
    if rejected(diagnosis):
        return "rejected"
    if not patch(diagnosis):
        return "none"
    return "untested" if diagnosis.best.heldout is None else "accepted"


def only_outliers(diagnosis: Diagnosis) -> bool:
    """Whether samples that are far off are all that there is."""
    return diagnosis.outliers.share > 0 and not diagnosis.detected


def _residual_force(diagnosis: Diagnosis) -> dict | None:
    """What acts at the best place of what has no name, over time."""
    if not diagnosis.ranked_locations:
        return None
    best = diagnosis.ranked_locations[0]
    return {
        "where": best.location.to_json(),
        "components": list(best.force.components),
        "units": list(best.force.units),
        "recording": best.force.recording.tolist(),
        "start_s": best.force.start.tolist(),
        "values": best.force.values.tolist(),
        "rmse_after": best.force.left,
        "linear_in": best.force.shares or None,
    }


def _hypothesis(diagnosis: Diagnosis, answer: Answer) -> dict:
    """What there is to compare hypotheses by: unknowns, and the excess over white noise [nats] that is left."""
    problem, hypothesis = diagnosis.explanation.problem, answer.hypothesis
    return {
        "names": list(answer.names),
        "where": [s.location.to_json() for s in hypothesis.terms],
        "probability": answer.probability,
        "unknowns": len(hypothesis.x),
        "excess": problem.misfit(hypothesis.residual),
        "excess_of_all": answer.misfit,
        "log_evidence": hypothesis.log_evidence(problem),
        "evidence": answer.evidence,
        "samples": int(problem.weight.sum()),
    }


def _round(found: Round) -> dict:
    """What was looked for on top of what, what it promised [nats], and what the fits of it leave [nats]."""
    return {
        "on_top_of": [_named(s) for s in found.on],
        "promised": [_named(s) | {"gain": gain} for s, gain in found.predicted_gain],
        "fitted": [{"effects": [_named(s) for s in terms], "excess": left} for terms, left in found.fitted],
    }


def _named(term: Term) -> dict:
    return {"name": term.name, "where": term.location.to_json()}


def _nameless(name: str, probability: float, diagnosis: Diagnosis | None = None) -> dict:
    location = diagnosis.ranked_locations[0].location.to_json() if diagnosis and diagnosis.ranked_locations else None
    return {"name": name, "class": name, "probability": probability, "where": location, "when": [], "condition": "",
            "parameters": {}, "evidence": [], "against": [], "together_with": []}  # fmt: skip


def _outliers(diagnosis: Diagnosis, probability: float) -> dict:
    """They were left out, so they compete with nothing; they are the answer where nothing else is."""
    found, signal, unit = diagnosis.outliers, diagnosis.robot.signal, diagnosis.robot.unit
    parameters = {"share": {"value": found.share, "unit": "1"}, "size": {"value": found.size, "unit": unit}}
    return {
        **_nameless("outliers", probability),
        "class": "measurement",
        "where": {"kind": "sensor", "name": signal},
        "parameters": parameters,
        "evidence": [f"{100 * found.share:.2g} % of the points are alone {length(found.size, unit)} off; left out"],
    }


def _parameters(diagnosis: Diagnosis, hypothesis: Hypothesis) -> dict:
    spread, priors = deviations(diagnosis, hypothesis), diagnosis.robot.priors
    low, middle, high = (prior_values(priors, hypothesis.x + k * NINETY * spread) for k in (-1.0, 0.0, 1.0))
    return {
        prior.name: {
            "value": middle[i],
            "unit": prior.unit,
            "ci90": sorted((low[i], high[i])),
            "prior_tension_sd": float(hypothesis.x[i]),
        }
        for i, prior in enumerate(priors)
    }


def _fit(fit: Fit) -> dict:
    return {"rmse_before": fit.before, "rmse_after": fit.after, "noise_floor": fit.noise}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _credible(comparison: Comparison, nothing: str) -> list[str]:
    """Names of the effects of the most probable hypotheses that together are as probable as asked; ``nothing`` is the
    name of the one without any."""
    ranked = [(answer.probability, answer.names or (nothing,)) for answer in comparison.answers]
    ranked = sorted([*ranked, (comparison.unknown, ("unknown",))], key=lambda pair: -pair[0])
    chosen, total = [], 0.0
    for probability, names in ranked:
        if total >= CREDIBLE:
            break
        total += probability
        chosen += [name for name in names if name not in chosen]
    return chosen


def _classes(diagnosis: Diagnosis, ranked: list[dict]) -> list[dict]:
    """Classes of effects, the most probable first: laws of one class that look alike count together."""
    chances = {e["class"]: e["probability"] for e in ranked if e["name"] in ("none", "unknown", "outliers")}
    for answer in diagnosis.comparison.answers:
        for name in {CATEGORIES[each] for each in answer.names}:
            chances[name] = min(1.0, chances.get(name, 0.0) + answer.probability)
    return [{"class": n, "probability": p} for n, p in sorted(chances.items(), key=lambda pair: (-pair[1], pair[0]))]


def detectable(diagnosis: Diagnosis) -> dict:
    """The smallest magnitude of each effect, at the place where it shows most, that would have been worth a look: how
    far the quantity is from ``null``, where there is no effect.

    Those that a robot hardly has so much of that it would show are left out.
    """
    found: dict[str, dict] = {}
    for term, x in diagnosis.explanation.minimum:
        if x > LIMIT:
            continue
        q = term.quantities[0]
        change = float(term.deviations[0]) * x
        if not q.bounds[0] <= q.null + change <= q.bounds[1]:
            continue
        value = abs(change)
        if term.name not in found or value < found[term.name]["minimum"]:
            unit = unit_at(diagnosis.robot, q.unit, term.location)
            found[term.name] = {"quantity": q.name, "minimum": value, "unit": unit, "null": q.null,
                                   "where": term.location.to_json()}  # fmt: skip
    return found


def invisible(diagnosis: Diagnosis) -> list[str]:
    """Sorted names of the effects that would not have shown in these recordings."""
    return sorted({term.name for term, _ in diagnosis.explanation.minimum} - set(detectable(diagnosis)))


def not_looked_for(diagnosis: Diagnosis) -> list[str]:
    """Sorted names of the effects that no place of this robot can have, perhaps because of those that it is known to
    have. Outliers are no hypothesis: they are looked for before."""
    return sorted(set(ALL) - diagnosis.explanation.looked_for - {"outliers"})


def _next_recording(proposal: Proposal | None) -> dict | None:
    if proposal is None:
        return None
    return {
        "file": NEXT_ACTIONS,
        "motion": proposal.motion.words,
        "duration_s": DURATION,
        "separates": [list(pair) for pair in proposal.separates],
        "evidence_nats": proposal.evidence,
    }
