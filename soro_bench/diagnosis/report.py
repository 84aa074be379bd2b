"""report.json: what a diagnosis found, for programs; and the same in sentences."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.compare import Answer, Fit, temperature
from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.localise import Regime, explained_over_time, intervals, regimes
from soro_bench.diagnosis.patch import MODEL, ModelPatch, model_patch, patch, rejected, write_model_patch
from soro_bench.diagnosis.pipeline import ALPHA, Diagnosis
from soro_bench.diagnosis.propose import DURATION, Proposal
from soro_bench.diagnosis.robot import Earlier
from soro_bench.diagnosis.suite_robot import SuiteRobot
from soro_bench.diagnosis.suspects import Suspect
from soro_bench.effects.catalogue import CATEGORIES, QUANTITIES
from soro_bench.effects.effect import Effect, Port, load_effects, save_effects
from soro_bench.files import read_json, write_json
from soro_bench.randomization import TruncatedNormal
from soro_bench.recording.excitation import write_actions

SCHEMA = "soro-bench/diagnosis/1"
CREDIBLE = 0.9
NEXT_ACTIONS = "next_actions.csv"
NINETY = 1.645  # standard deviations on either side of the middle 90 %


@dataclass(frozen=True)
class Finding:
    """An effect at a place, in the most probable hypothesis that has it, and its probability in all of them."""

    suspect: Suspect
    effect: Effect
    answer: Answer
    probability: float


def findings(diagnosis: Diagnosis) -> list[Finding]:
    """Every effect of any hypothesis, the most probable first; of those in one hypothesis that which gains most."""
    best: dict[tuple[str, Port], Finding] = {}
    d = diagnosis.explanation.problem.parameters
    for answer in diagnosis.comparison.answers:
        for suspect, effect in zip(answer.hypothesis.suspects, answer.hypothesis.effects(d), strict=True):
            key = (effect.name, effect.where)
            first = best.get(key)
            chance = answer.probability + (first.probability if first else 0.0)
            best[key] = replace(first, probability=chance) if first else Finding(suspect, effect, answer, chance)
    return sorted(best.values(), key=lambda f: -f.probability)


def write_json_report(diagnosis: Diagnosis, folder: str | Path) -> dict:
    """All files for programs: report, effects, posterior, patched model, actions to record next; returns the
    report."""
    folder, model = Path(folder), model_patch(diagnosis)
    report = {**report_of(diagnosis), **_model_patch(model)}
    write_json(folder / "report.json", report)
    save_effects([*diagnosis.robot.known, *patch(diagnosis)], folder / "effects.json")
    if isinstance(diagnosis.robot, SuiteRobot):  # the others are not trained on
        write_json(folder / "posterior.json", posterior(diagnosis).to_dict())
    if diagnosis.proposal:
        actions = diagnosis.robot.commanded(diagnosis.proposal.motion.actions)
        write_actions(folder / NEXT_ACTIONS, diagnosis.robot.control_timestep, actions)
    else:
        (folder / NEXT_ACTIONS).unlink(missing_ok=True)  # of an earlier diagnosis
    write_model_patch(model, folder)
    return report


def _model_patch(found: ModelPatch) -> dict:
    return {
        "model_patch": MODEL if found.xml else None,
        "model_patch_effects": [effect.name for effect in found.effects],
        "model_patch_lacks": [effect.name for effect in found.remaining],
        "model_patch_obstacle": found.obstacle,
    }


def earlier(folder: str | Path) -> Earlier:
    """What the files of a report say of a robot; ValueError for other files."""
    path = Path(folder) / "report.json"
    report = read_json(path)
    if not isinstance(report, dict) or report.get("schema") != SCHEMA:
        raise ValueError(f"{path} is no report of a diagnosis: its schema has to be {SCHEMA}")
    try:
        values = {name: float(each["value"]) for name, each in report["parameters"].items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} has no parameters with values ({error!r})") from error
    return Earlier(values, load_effects(Path(folder) / "effects.json", QUANTITIES))


def posterior(diagnosis: Diagnosis) -> TruncatedNormal:
    """The parameters under the most probable hypothesis, as a distribution to train on."""
    best, priors = diagnosis.comparison.answers[0].hypothesis, diagnosis.robot.priors
    low, middle, high = (_values(priors, best.x + k * _deviations(diagnosis, best)) for k in (-1.0, 0.0, 1.0))
    return TruncatedNormal(tuple(p.name for p in priors), middle, 0.5 * (high - low))


def report_of(diagnosis: Diagnosis) -> dict:
    """The contents of report.json."""
    comparison, best = diagnosis.comparison, diagnosis.comparison.answers[0]
    ranked = [_effect(diagnosis, finding) for finding in findings(diagnosis)]
    nothing = next((a.probability for a in comparison.answers if not a.names), 0.0)
    if diagnosis.outliers.share and not diagnosis.detected:
        nothing = 0.0  # nothing but outliers
    ranked.append(_nameless("none", nothing))
    ranked.append(_nameless("unknown", comparison.unknown, diagnosis))
    if diagnosis.outliers.share:
        ranked.append(_outliers(diagnosis))
    ranked.sort(key=lambda e: -e["probability"])
    return {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "p_value": comparison.p_value,
        "alpha": ALPHA,
        "promised": diagnosis.explanation.promised,
        "effects": ranked,
        "classes": _classes(diagnosis, ranked),
        "hypotheses": [_hypothesis(diagnosis, answer) for answer in comparison.answers],
        "credible_set": _credible(ranked),
        "fit": {
            "train": _fit(best.train),
            "heldout": None if best.heldout is None else _fit(best.heldout),
            "fve_heldout": None if best.heldout is None else _number(best.heldout.explained),
            "unit": diagnosis.explanation.problem.recordings[0].unit,
            "patch": "rejected" if rejected(diagnosis) else "accepted" if patch(diagnosis) else "none",
        },
        "parameters": _parameters(diagnosis, best.hypothesis),
        "places": [{"where": _where(p.where), "gain": p.gain} for p in diagnosis.places[:10]],
        "detectable": _detectable(diagnosis),
        "next_recording": _next_recording(diagnosis.proposal),
        "audit": [{"noise": a.sigma, "missing": a.missing} for a in diagnosis.audits],
        "seconds": round(diagnosis.seconds, 1),
    }


def _effect(diagnosis: Diagnosis, finding: Finding) -> dict:
    problem, nominal = diagnosis.explanation.problem, diagnosis.explanation.nominal
    hypothesis = finding.answer.hypothesis
    gain = explained_over_time(problem, nominal, hypothesis)
    measured = problem.recordings[0]
    shares = regimes(measured, gain, diagnosis.robot.channel(finding.effect.where))
    return {
        "name": finding.effect.name,
        "class": CATEGORIES[finding.effect.name],
        "probability": finding.probability,
        "where": _where(finding.effect.where),
        "when": [{"start_s": a, "end_s": b} for a, b in intervals(measured.time, gain)],
        "condition": _condition(finding.effect, shares),
        "parameters": _quantities(diagnosis, finding),
        "evidence": _evidence(diagnosis, finding.answer),
        "against": _against(diagnosis, finding.answer),
        "together_with": [s.name for s in hypothesis.suspects if s is not finding.suspect],
    }


def _hypothesis(diagnosis: Diagnosis, answer: Answer) -> dict:
    """What there is to compare hypotheses by: unknowns, and the excess over white noise [nats] that is left."""
    problem, hypothesis = diagnosis.explanation.problem, answer.hypothesis
    return {
        "names": list(answer.names),
        "where": [_where(s.where) for s in hypothesis.suspects],
        "probability": answer.probability,
        "unknowns": len(hypothesis.x),
        "excess": problem.excess(hypothesis.residual),
        "log_evidence": hypothesis.log_evidence(problem),
        "samples": int(problem.weight.sum()),
    }


def _nameless(name: str, probability: float, diagnosis: Diagnosis | None = None) -> dict:
    where = _where(diagnosis.places[0].where) if diagnosis and diagnosis.places else None
    return {"name": name, "class": name, "probability": probability, "where": where, "when": [], "condition": "",
            "parameters": {}, "evidence": [], "against": [], "together_with": []}  # fmt: skip


def _outliers(diagnosis: Diagnosis) -> dict:
    """They were left out, so they compete with nothing; they are the answer where nothing else is."""
    found, signal, unit = diagnosis.outliers, diagnosis.robot.signal, diagnosis.robot.unit
    parameters = {"share": {"value": found.share, "unit": "1"}, "size": {"value": found.size, "unit": unit}}
    return {
        **_nameless("outliers", 0.0 if diagnosis.detected else 1.0),
        "class": "measurement",
        "where": {"kind": "sensor", "name": signal},
        "parameters": parameters,
        "evidence": [f"{100 * found.share:.2g} % of the points are alone {_length(found.size, unit)} off; left out"],
    }


def _condition(effect: Effect, shares: list[Regime]) -> str:
    most = max(shares, key=lambda r: r.explained / max(r.time, 0.02))
    one = effect.where.kind in ("tendon", "actuator")
    what, ending = (str(effect.where), "s") if one else ("the commands", "")
    when = {
        "just after reversals": f"just after reversals of {what}",
        "while it moves on": f"while {what} move{ending} on",
        "while it rests": f"while {what} rest{ending}",
    }[most.condition]
    return f"{100 * most.explained:.0f} % of what it explains is {when}, {100 * most.time:.0f} % of the time"


def _quantities(diagnosis: Diagnosis, finding: Finding) -> dict:
    hypothesis, at = finding.answer.hypothesis, diagnosis.explanation.problem.parameters
    for suspect in hypothesis.suspects:
        if suspect is finding.suspect:
            break
        at += suspect.size
    x, spread = hypothesis.x, _deviations(diagnosis, hypothesis)
    part = slice(at, at + finding.suspect.size)
    low, high = (finding.suspect.effect(x[part] + k * NINETY * spread[part]).parameters for k in (-1.0, 1.0))
    return {
        q.name: {
            "value": finding.effect.parameters[q.name],
            "unit": _unit(q.unit, finding.effect.where, *_own_units(diagnosis)),
            "ci90": sorted((low[q.name], high[q.name])),
        }
        for q in QUANTITIES[finding.effect.name]
    }


def _unit(unit: str, where: Port, signal: str, setpoint: str = "setpoint") -> str:
    """Of "N or N m" and the like the one that fits the place: joints turn, cables are long."""
    if unit in ("signal", "setpoint"):
        return signal if unit == "signal" else setpoint
    parts = unit.split(" or ")
    turning = [part for part in parts if "rad" in part or "N m" in part]
    return turning[0] if turning and where.kind in ("joint", "body") else parts[0]


def _own_units(diagnosis: Diagnosis) -> tuple[str, str]:
    """Units of the signal, and of the actuators' setpoints: lengths where they pull tendons."""
    setpoint = "m" if diagnosis.robot.pulls_cables else "setpoint"
    return diagnosis.explanation.problem.recordings[0].unit, setpoint


def _deviations(diagnosis: Diagnosis, hypothesis: Hypothesis) -> np.ndarray:
    """(n,) of x, under evidence tempered as in the comparison: a model that is wrong knows less than it seems."""
    problem = diagnosis.explanation.problem
    heat = temperature(problem.excess(hypothesis.residual))
    return np.minimum(np.sqrt(heat * np.diag(hypothesis.covariance(problem))), 1.0)


def _values(priors, x) -> np.ndarray:
    return np.array([float(prior.value(value)) for prior, value in zip(priors, x[: len(priors)], strict=True)])


def _parameters(diagnosis: Diagnosis, hypothesis: Hypothesis) -> dict:
    spread, priors = _deviations(diagnosis, hypothesis), diagnosis.robot.priors
    low, middle, high = (_values(priors, hypothesis.x + k * NINETY * spread) for k in (-1.0, 0.0, 1.0))
    return {
        prior.name: {
            "value": middle[i],
            "unit": prior.unit,
            "ci90": sorted((low[i], high[i])),
            "prior_tension_sd": float(hypothesis.x[i]),
        }
        for i, prior in enumerate(priors)
    }


def _evidence(diagnosis: Diagnosis, answer: Answer) -> list[str]:
    unit = diagnosis.explanation.problem.recordings[0].unit
    said = [f"explains {_percent(answer.train)} of the variance above the noise ({_before_after(answer.train, unit)})"]
    if answer.heldout is not None:
        said.append(f"held out: {_percent(answer.heldout)} ({_before_after(answer.heldout, unit)})")
    return said


def _against(diagnosis: Diagnosis, answer: Answer) -> list[str]:
    best, said = diagnosis.comparison.answers[0], []
    if answer.heldout is not None and answer.heldout.after > answer.heldout.before:
        said.append("makes held-out recordings worse")
    if answer is not best:
        best_left, left = (_length(a.train.after, diagnosis.robot.unit) for a in (best, answer))
        said.append(f"{' with '.join(best.names) or 'nothing missing'} leaves {best_left}, this {left}")
    return said


def _percent(fit: Fit) -> str:
    return "-" if math.isnan(fit.explained) else f"{100 * fit.explained:.0f} %"


def _before_after(fit: Fit, unit: str) -> str:
    return f"{_length(fit.before, unit)} -> {_length(fit.after, unit)}, noise {_length(fit.noise, unit)}"


def _length(value: float, unit: str) -> str:
    return f"{1e3 * value:.2f} mm" if unit == "m" else f"{value:.3g} {unit}"


def _fit(fit: Fit) -> dict:
    return {"rmse_before": fit.before, "rmse_after": fit.after, "noise_floor": fit.noise}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _where(port: Port) -> dict:
    return {"kind": port.kind, "name": port.name, **({} if port.index is None else {"index": port.index})}


def _credible(ranked: list[dict]) -> list[str]:
    chosen, total = [], 0.0
    for effect in ranked:
        if total >= CREDIBLE:
            break
        total += effect["probability"]
        if effect["name"] not in chosen:
            chosen.append(effect["name"])
    return chosen


def _classes(diagnosis: Diagnosis, ranked: list[dict]) -> list[dict]:
    """Classes of effects, the most probable first: laws of one class that look alike count together."""
    chances = {e["class"]: e["probability"] for e in ranked if e["name"] in ("none", "unknown", "outliers")}
    for answer in diagnosis.comparison.answers:
        for name in {CATEGORIES[each] for each in answer.names}:
            chances[name] = chances.get(name, 0.0) + answer.probability
    return [{"class": n, "probability": p} for n, p in sorted(chances.items(), key=lambda pair: (-pair[1], pair[0]))]


def _detectable(diagnosis: Diagnosis) -> dict:
    """The smallest magnitude of each effect, at the place where it shows most, that would have been worth a look."""
    found: dict[str, dict] = {}
    for suspect, x in diagnosis.explanation.minimum:
        q = QUANTITIES[suspect.name][0]
        coordinates = np.zeros(suspect.size)
        coordinates[0] = x
        value = abs(suspect.effect(coordinates).parameters[q.name] - q.null)
        if suspect.name not in found or value < found[suspect.name]["minimum"]:
            unit = _unit(q.unit, suspect.where, *_own_units(diagnosis))
            found[suspect.name] = {"quantity": q.name, "minimum": value, "unit": unit, "where": _where(suspect.where)}
    return found


def verdict(diagnosis: Diagnosis) -> str:
    """What was found, in sentences."""
    best, unit = diagnosis.comparison.answers[0], diagnosis.explanation.problem.recordings[0].unit
    said = []
    if diagnosis.outliers.share:
        said.append(f"{100 * diagnosis.outliers.share:.2g} % of the points are outliers; they are left out.")
    if not best.names and diagnosis.verdict != "unknown_physics":
        said.append(f"Nothing is missing that this recording shows (p = {diagnosis.comparison.p_value:.2g}).")
        shown = sorted(_detectable(diagnosis).items())
        seen = ", ".join(f"{name} of {d['minimum']:.2g} {d['unit']}" for name, d in shown)
        said.append(f"It would have shown: {seen}.")
        return "\n".join(said)
    if diagnosis.verdict == "unknown_physics":
        place = diagnosis.places[0].where
        nearest = " with ".join(best.names) or "nothing"
        said.append(f"Something acts at {place} that has no name in the catalogue "
                    f"(probability {diagnosis.comparison.unknown:.2f}); nearest is {nearest}.")  # fmt: skip
    else:
        said += [_sentence(diagnosis, f) for f in findings(diagnosis) if f.answer is best]
    said.append(f"Fit: {_before_after(best.train, unit)}.")
    if best.heldout is not None:
        said.append(f"Held out: {_before_after(best.heldout, unit)} ({_percent(best.heldout)} explained).")
        if rejected(diagnosis):
            said.append("The patch is rejected: it makes the held-out recordings worse.")
    others = [a for a in diagnosis.comparison.answers[1:4] if a.probability >= 0.05]
    if others:
        names = ", or ".join(f"{' with '.join(a.names) or 'nothing'} ({a.probability:.2f})" for a in others)
        said.append(f"It may also be {names}.")
        kinds = {CATEGORIES[name] for name in best.names}
        alike = sum(a.probability for a in diagnosis.comparison.answers if {CATEGORIES[n] for n in a.names} == kinds)
        if kinds and alike > best.probability + 0.05:
            said.append(f"The class is clearer than the law: {' with '.join(sorted(kinds))} ({alike:.2f}).")
    if diagnosis.proposal:
        said.append(_what_next(diagnosis.proposal, diagnosis.verdict == "unknown_physics"))
    return "\n".join(said)


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


def _what_next(proposal: Proposal, unknown: bool) -> str:
    """What to record, and what for, in a sentence."""
    file = f"{NEXT_ACTIONS} ({proposal.motion.words})"
    if unknown:
        return f"Record {file} to see more of it."
    best, *others = proposal.rivals
    said = f"{best} cannot be told from {' or '.join(others)} with this recording"
    if not proposal.separates:
        return f"{said}, nor by any motion of {DURATION:g} s that was tried; {file} comes nearest."
    pairs = ", and ".join(f"{a} from {b}" for a, b in proposal.separates)
    every = len(proposal.separates) == math.comb(len(proposal.rivals), 2)
    return f"{said}: record {file} to separate {'them' if every else pairs}."


def _sentence(diagnosis: Diagnosis, finding: Finding) -> str:
    shown = _effect(diagnosis, finding)
    values = ", ".join(
        f"{name} {q['value']:.3g} {q['unit']} [{q['ci90'][0]:.3g}, {q['ci90'][1]:.3g}]"
        for name, q in shown["parameters"].items()
    )
    when = ", ".join(f"{w['start_s']:.0f}-{w['end_s']:.0f} s" for w in shown["when"][:6])
    return (f"{finding.effect.name} at {finding.effect.where} (probability {finding.probability:.2f}): {values}; "
            f"visible at {when}; {shown['condition']}.")  # fmt: skip
