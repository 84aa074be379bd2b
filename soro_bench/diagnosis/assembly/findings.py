"""What a diagnosis found: effects with their probabilities, magnitudes and evidence."""

import math
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, slices
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.localisation.residual_maps import Regime, explained_over_time, intervals, regimes
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer, Fit, temperature
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Effect, Location

NINETY = 1.645  # standard deviations on either side of the middle 90 %
_TELLS = 1.2  # times more than its share of the time has to be explained for a condition to say when an effect acts


@dataclass(frozen=True)
class Finding:
    """An effect at a place, in the answer that the report is of, or the most probable one that has it, and its
    probability in all of them."""

    term: Term
    effect: Effect
    answer: Answer
    probability: float


def findings(diagnosis: Diagnosis) -> list[Finding]:
    """Every effect of any hypothesis, the most probable first; of those in one hypothesis that which gains most."""
    best: dict[tuple[str, Location], Finding] = {}
    d = diagnosis.explanation.problem.parameters
    for answer in diagnosis.comparison.ranked:
        for term, effect in zip(answer.hypothesis.terms, answer.hypothesis.effects(d), strict=True):
            key = (effect.name, effect.location)
            first = best.get(key)
            chance = min(1.0, answer.probability + (first.probability if first else 0.0))  # but for rounding
            best[key] = replace(first, probability=chance) if first else Finding(term, effect, answer, chance)
    return sorted(best.values(), key=lambda f: -f.probability)


def described(diagnosis: Diagnosis, finding: Finding) -> dict:
    problem, hypothesis = diagnosis.explanation.problem, finding.answer.hypothesis
    gain = explained_over_time(problem, _lacking(diagnosis, finding), hypothesis)
    measured = problem.recordings[0]
    channel = diagnosis.robot.channel(finding.effect.location)
    rates = diagnosis.robot.rates(measured.actions)
    shares = regimes(measured.time, rates if channel is None else rates[:, [channel]], gain)
    return {
        "name": finding.effect.name,
        "class": CATEGORIES[finding.effect.name],
        "probability": finding.probability,
        "where": finding.effect.location.to_json(),
        "when": [{"start_s": a, "end_s": b} for a, b in intervals(measured.time, gain)],
        "condition": _condition(finding.effect, shares, channel is not None),
        "parameters": _quantities(diagnosis, finding),
        "evidence": _evidence(diagnosis, finding.answer),
        "against": _against(diagnosis, finding.answer),
        "together_with": [s.name for s in hypothesis.terms if s is not finding.term],
    }


def _lacking(diagnosis: Diagnosis, finding: Finding) -> Hypothesis:
    """The answer without the effect: with parameters fitted anew where it is alone, and all else as it is where there
    are others."""
    problem, whole = diagnosis.explanation.problem, finding.answer.hypothesis
    if len(whole.terms) < 2:
        return diagnosis.explanation.nominal
    which = next(i for i, term in enumerate(whole.terms) if term is finding.term)
    x = np.delete(whole.x, np.r_[slices(whole.terms, problem.parameters)[which]])
    others = whole.terms[:which] + whole.terms[which + 1 :]
    return replace(whole, x=x, terms=others, residual=problem.residuals([(x, others)])[0])


def _condition(effect: Effect, shares: list[Regime], one: bool) -> str:
    """When most is explained; ``one``: whether a single channel moves where the effect acts."""
    most = max(shares, key=lambda r: r.explained / max(r.time, 0.02))
    what, ending = (str(effect.location), "s") if one else ("the commands", "")
    when = {
        "just after reversals": f"just after reversals of {what}",
        "while it moves on, fast": f"while {what} move{ending} on, fast",
        "while it moves on, slowly": f"while {what} move{ending} on, slowly",
        "while it rests": f"while {what} rest{ending}",
        "early": "in the first half",
        "late": "in the second half",
    }[most.condition]
    if most.explained <= _TELLS * most.time:
        return "neither commands nor the clock tell when it acts"
    return f"{100 * most.explained:.0f} % of what it explains is {when}, {100 * most.time:.0f} % of the time"


def _quantities(diagnosis: Diagnosis, finding: Finding) -> dict:
    hypothesis, first = finding.answer.hypothesis, diagnosis.explanation.problem.parameters
    x, spread = hypothesis.x, deviations(diagnosis, hypothesis)
    which = next(i for i, term in enumerate(hypothesis.terms) if term is finding.term)
    part = slices(hypothesis.terms, first)[which]
    low, high = (finding.term.effect(x[part] + k * NINETY * spread[part]).parameters for k in (-1.0, 1.0))
    return {
        q.name: {
            "value": finding.effect.parameters[q.name],
            "unit": unit_at(diagnosis.robot, q.unit, finding.effect.location),
            "ci90": sorted((low[q.name], high[q.name])),
        }
        for q in finding.term.quantities
    }


def unit_at(robot: Robot, unit: str, location: Location) -> str:
    """What a quantity of an effect is in at a place: of "N or N m" and the like the one that fits what turns or slides
    there."""
    return robot.unit_at(unit, location)


def deviations(diagnosis: Diagnosis, hypothesis: Hypothesis) -> np.ndarray:
    """(n,) of x."""
    return np.sqrt(np.diag(tempered(diagnosis, hypothesis)))


def tempered(diagnosis: Diagnosis, hypothesis: Hypothesis) -> np.ndarray:
    """(n, n) covariance of x, under evidence tempered as in the comparison: a model that is wrong knows less than it
    seems. Priors are as they are."""
    problem = diagnosis.explanation.problem
    temper, prior = temperature(problem.misfit(hypothesis.residual)), np.eye(len(hypothesis.x))
    return np.linalg.inv((np.linalg.inv(hypothesis.covariance(problem)) - prior) / temper + prior)


def prior_values(priors, x) -> np.ndarray:
    return np.array([float(prior.value(value)) for prior, value in zip(priors, x[: len(priors)], strict=True)])


def _evidence(diagnosis: Diagnosis, answer: Answer) -> list[str]:
    unit = diagnosis.explanation.problem.recordings[0].unit
    said = [f"explains {percent(answer.train)} of the variance above the noise ({before_after(answer.train, unit)})"]
    if answer.heldout is not None:
        said.append(f"held out: {percent(answer.heldout)} ({before_after(answer.heldout, unit)})")
    return said


def _against(diagnosis: Diagnosis, answer: Answer) -> list[str]:
    best, said = diagnosis.best, []
    if answer.heldout is not None and answer.heldout.after > answer.heldout.before:
        said.append("makes held-out recordings worse")
    if answer is not best:
        said += _ahead(best, answer, diagnosis.robot.unit)
    return said


def _ahead(best: Answer, answer: Answer, unit: str) -> list[str]:
    """In what the best answer is better than another one: what it leaves, or else its evidence. None if only one of its
    effects is likelier, whatever comes with that."""
    name = " with ".join(best.names) or "nothing missing"
    if best.train.after < answer.train.after:
        return [f"{name} leaves {length(best.train.after, unit)}, this {length(answer.train.after, unit)}"]
    if best.heldout is not None and best.heldout.after < answer.heldout.after:
        left, more = (length(each.heldout.after, unit) for each in (best, answer))
        return [f"{name} leaves {left} of held-out recordings, this {more}"]
    ahead = best.evidence - answer.evidence
    return [f"{name} has {ahead:.0f} nats more evidence, as it needs less to fit as well"] if ahead > 0 else []


def percent(fit: Fit) -> str:
    return "-" if math.isnan(fit.explained) else f"{100 * fit.explained:.0f} %"


def before_after(fit: Fit, unit: str) -> str:
    return f"{length(fit.before, unit)} -> {length(fit.after, unit)}, noise {length(fit.noise, unit)}"


def length(value: float, unit: str) -> str:
    return f"{1e3 * value:.3g} mm" if unit == "m" else f"{value:.3g} {unit}"


def spaced(unit: str) -> str:
    """A unit behind a number; nothing where there is none."""
    return "" if unit == "1" else f" {unit}"
