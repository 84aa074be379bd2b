"""What a diagnosis found: effects with their probabilities, magnitudes and evidence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.assembly.errors import PlainReplays
from soro_bench.diagnosis.candidates import Term, late, slices
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.residual_maps import Regime, explained_over_time, intervals, regimes
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_parts import NINETY, Estimate, Finding
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer, temperature
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Location

_LEAST_SHARE = 0.02  # of the time; what is explained in less is not concentrated there but chance
_TELLS = 1.2  # times more than its share of the time has to be explained for a condition to say when an effect acts

_TOO_MUCH = {
    "actuator_saturation": "The model's limit of force is too low.",
    "compliance": "The model's servo is too soft.",
}


@dataclass(frozen=True)
class _Found:
    """A term of a hypothesis, the most probable one that has it, and its probability in all of them."""

    term: Term
    answer: Answer
    probability: float


def findings(diagnosis: Diagnosis, replays: PlainReplays) -> list[Finding]:
    """Every effect of any hypothesis, the most probable first; of those in one hypothesis that which gains most."""
    best: dict[tuple[str, Location], _Found] = {}
    for answer in diagnosis.comparison.ranked:
        for term in answer.hypothesis.terms:
            key = (term.name, term.location)
            first = best.get(key)
            chance = min(1.0, answer.probability + (first.probability if first else 0.0))  # but for rounding
            best[key] = replace(first, probability=chance) if first else _Found(term, answer, chance)
    return [_finding(diagnosis, replays, found) for found in sorted(best.values(), key=lambda f: -f.probability)]


def _finding(diagnosis: Diagnosis, replays: PlainReplays, found: _Found) -> Finding:
    problem, hypothesis, term = diagnosis.explanation.problem, found.answer.hypothesis, found.term
    gain = explained_over_time(problem, _lacking(diagnosis, found), hypothesis)
    measured, robot = problem.recordings[0], diagnosis.robot
    channel = robot.channel(term.location)
    rates = robot.rates(measured.actions)
    shares = regimes(measured.time, rates if channel is None else rates[:, [channel]], gain, problem.settings)
    train, heldout = replays.errors(diagnosis, found.answer)
    return Finding(
        name=term.name,
        category=CATEGORIES[term.name],
        probability=float(found.probability),
        location=term.location,
        estimates=_estimates(diagnosis, found),
        intervals=tuple(intervals(measured.time, gain, problem.settings.localisation)),
        condition=" ".join(filter(None, (_taken(term), _condition(term.location, shares, channel is not None)))),
        train=train,
        heldout=heldout,
        drawbacks=tuple(_drawbacks(diagnosis, replays, found.answer)),
        together_with=tuple(s.name for s in hypothesis.terms if s is not term),
        indistinguishable_from=_indistinguishable(robot, term),
        is_best=found.answer is diagnosis.best,
    )


def _taken(term: Term) -> str:
    """That the model has too much of something, in words; empty for a term that adds."""
    return _TOO_MUCH.get(term.name, "The model has more of it than the robot.") if term.removable else ""


def _indistinguishable(robot: Robot, term: Term) -> str:
    """What hardly any recording can tell from a term; nothing if there is no such thing."""
    if not late(robot, term.name, term.location):
        return ""
    return "actuator_delay at every actuator" if term.name == "sensor_delay" else "sensor_delay"


def _lacking(diagnosis: Diagnosis, finding: _Found) -> Hypothesis:
    """The answer without the effect: with parameters fitted anew where it is alone, and all else as it is where there
    are others."""
    problem, whole = diagnosis.explanation.problem, finding.answer.hypothesis
    if len(whole.terms) < 2:
        return diagnosis.explanation.nominal
    which = next(i for i, term in enumerate(whole.terms) if term is finding.term)
    x = np.delete(whole.x, np.r_[slices(whole.terms, problem.parameters)[which]])
    others = whole.terms[:which] + whole.terms[which + 1 :]
    return replace(whole, x=x, terms=others, residual=problem.residuals([(x, others)])[0])


def _condition(location: Location, shares: Sequence[Regime], single: bool) -> str:
    """When an effect mainly acts, in words; empty where neither commands nor the clock tell.

    Args:
        single: whether a single channel moves where the effect acts.
    """
    most = max(shares, key=lambda regime: regime.explained / max(regime.time, _LEAST_SHARE))
    if most.explained <= _TELLS * most.time:
        return ""
    subject = location.name if single else "a command"
    when = {
        "just after reversals": f"just after {subject} reverses",
        "while it moves on, fast": f"while {subject} moves fast",
        "while it moves on, slowly": f"while {subject} moves slowly",
        "while it rests": f"while {subject} rests",
        "early": "in the first half",
        "late": "in the second half",
    }[most.condition]
    share, time = (f"{100 * each:.0f} %" for each in (most.explained, most.time))
    return f"Acts mainly {when}: {share} of the improvement falls in that {time} of the recording."


def _estimates(diagnosis: Diagnosis, finding: _Found) -> tuple[Estimate, ...]:
    hypothesis, first, term = finding.answer.hypothesis, diagnosis.explanation.problem.parameters, finding.term
    which = next(i for i, each in enumerate(hypothesis.terms) if each is term)
    part = slices(hypothesis.terms, first)[which]
    return estimates_of(diagnosis.robot, term, hypothesis.x[part], tempered(diagnosis, hypothesis)[part, part])


def estimates_of(robot: Robot, term: Term, x: np.ndarray, covariance: np.ndarray) -> tuple[Estimate, ...]:
    """Of every quantity of a term; magnitudes that each element has of its own come with the element's name.

    Args:
        x: (size,) coordinates of the term, with their covariance (size, size).
    """
    found: list[Estimate] = []
    shape: list[Estimate] = []  # the same at all elements
    parts = list(zip(term.parts(x), term.deviations_of_parts(covariance), strict=True))
    for i, ((one, middle), spread) in enumerate(parts):
        low, value, high = (one.effect(middle + k * NINETY * spread).parameters for k in (-1.0, 0.0, 1.0))
        for q, magnitude in zip(one.quantities, one.magnitudes, strict=True):
            if i > 0 and not magnitude:
                continue
            name = f"{q.name} at {one.location.name}" if magnitude and len(parts) > 1 else q.name
            ends = sorted((float(low[q.name]), float(high[q.name])))
            group = found if magnitude or len(parts) == 1 else shape
            group.append(Estimate(name, float(value[q.name]), robot.unit_at(q.unit, one.location), *ends))
    return (*found, *shape)


def deviations(diagnosis: Diagnosis, hypothesis: Hypothesis) -> np.ndarray:
    """(n,) of x."""
    return np.sqrt(np.diag(tempered(diagnosis, hypothesis)))


def tempered(diagnosis: Diagnosis, hypothesis: Hypothesis) -> np.ndarray:
    """(n, n) covariance of x in the problem of a diagnosis, see :func:`tempered_by`."""
    return tempered_by(diagnosis.explanation.problem, hypothesis)


def tempered_by(problem: Problem, hypothesis: Hypothesis) -> np.ndarray:
    """(n, n) covariance of x, under evidence of the fitted recordings that is tempered by their misfit: a model that is
    wrong knows less than it seems. Priors are as they are."""
    temper = temperature(problem.misfit(hypothesis.residual), problem.settings.probabilities)
    prior = np.eye(len(hypothesis.x))  # its precision
    return np.linalg.inv((np.linalg.inv(hypothesis.covariance(problem)) - prior) / temper + prior)


def prior_values(priors: Sequence[Prior], x: np.ndarray) -> np.ndarray:
    """(d,) values of the parameters at coordinates x (n,), of which they are the first d."""
    return np.array([float(prior.value(value)) for prior, value in zip(priors, x[: len(priors)], strict=True)])


def _drawbacks(diagnosis: Diagnosis, replays: PlainReplays, answer: Answer) -> list[str]:
    """What speaks against a hypothesis, in words; errors are those of plain replays."""
    best, unit = diagnosis.best, diagnosis.robot.unit
    _, heldout = replays.errors(diagnosis, answer)
    said = []
    if heldout is not None and heldout.after > heldout.before:
        said.append(f"makes held-out worse ({length(heldout.before, unit)} -> {length(heldout.after, unit)})")
    elif heldout is not None and heldout.is_worse:
        said.append("makes held-out worse, discretisation error taken off")
    return said if answer is best else [*said, *_ahead(best, answer, replays, unit)]


def _ahead(best: Answer, answer: Answer, replays: PlainReplays, unit: str) -> list[str]:
    """In what the best answer is better than another one: what it leaves, or else its evidence. None if only one of its
    effects is likelier, whatever comes with that."""
    name = " with ".join(best.names) or "no discrepancy"
    errors = zip(replays.rms(best.hypothesis), replays.rms(answer.hypothesis), strict=True)
    for (own, other), which in zip(errors, ("", " of held-out recordings"), strict=False):
        if own < other:
            return [f"leaves {length(other, unit)}{which}, {name} {length(own, unit)}"]
    ahead = best.evidence - answer.evidence
    return [f"{name} has {ahead:.0f} nats more evidence: it fits as well with less"] if ahead > 0 else []


def length(value: float, unit: str) -> str:
    """A number of a signal with its unit; lengths in mm."""
    if not math.isfinite(value):
        return "a replay that diverges"
    return f"{1e3 * value:.3g} mm" if unit == "m" else f"{value:.3g} {unit}"
