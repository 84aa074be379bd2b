"""A diagnosis in sentences."""

import math
from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.assembly.findings import Finding, before_after, described, findings, length, percent, spaced
from soro_bench.diagnosis.assembly.patch import kept, patch, rejected
from soro_bench.diagnosis.candidates import late
from soro_bench.diagnosis.localisation.ranking import RankedLocation
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.report import NEXT_ACTIONS, detectable, invisible, not_looked_for
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.experiment_design import DURATION, Proposal, labels
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Effect

MENTIONED = 0.05  # probability
NEARLY, NAMED = 0.9, 3  # of the evidence that the best place gains; places that are named
FAR = 3.0  # standard deviations of its prior: one parameter in 400 is that far from its nominal value


def verdict(diagnosis: Diagnosis) -> str:
    """What was found, in sentences."""
    best, unit = diagnosis.best, diagnosis.explanation.problem.recordings[0].unit
    said = []
    terms = best.hypothesis.terms
    if diagnosis.verdict == "measurement_fault" and not any(late(diagnosis.robot, s.name, s.location) for s in terms):
        said.append("This is a fault of the measurement, not of the robot.")
    if diagnosis.outliers.share:
        said.append(f"{100 * diagnosis.outliers.share:.2g} % of the points are outliers; they are left out.")
    if not best.names and diagnosis.verdict != "unknown_physics":
        said.append(f"Nothing is missing that this recording shows (p = {diagnosis.comparison.p_value:.2g}).")
        shown = sorted(detectable(diagnosis).items())
        seen = ", ".join(f"{name} {_least(d)}" for name, d in shown)
        said.append(f"It would have shown: {seen}.")
        if blind := invisible(diagnosis):
            said.append(f"It could hardly have shown: {', '.join(blind)}.")
        if lacking := not_looked_for(diagnosis):
            said.append(f"Not looked for (it has no place here, or none beside known effects): {', '.join(lacking)}.")
        return "\n".join(said)
    if diagnosis.verdict == "unknown_physics":
        site = f" at {diagnosis.ranked_locations[0].location}" if diagnosis.ranked_locations else ""
        nearest = " with ".join(best.names) or "nothing"
        said.append(f"Something acts{site} that has no name in the catalogue "
                    f"(probability {diagnosis.comparison.unknown:.2f}); nearest is {nearest}.")  # fmt: skip
        if diagnosis.ranked_locations:
            said += [_force(diagnosis, unit), *_elsewhere(diagnosis.ranked_locations)]
        else:
            said.append("No force at a single place explains any of it.")
    else:
        found = [f for f in findings(diagnosis) if f.answer is best]
        said += [_sentence(diagnosis, f) + _indistinguishable(diagnosis.robot, f.effect) for f in found]
    if far := _far(diagnosis):
        said.append(far)
    said.append(f"Fit: {before_after(best.train, unit)}.")
    if best.heldout is not None:
        said.append(f"Held out: {before_after(best.heldout, unit)} ({percent(best.heldout)} explained).")
        if rejected(diagnosis):
            said.append("The patch is rejected: it makes the held-out recordings worse.")
        elif diagnosis.verdict == "unknown_physics" and best.names:
            said.append(_of_the_nearest(bool(patch(diagnosis)), " with ".join(best.names)))
    if best.names and best.heldout is None:
        said.append("No recording was held out, so nothing says whether this holds for other motion.")
    others = [a for a in diagnosis.comparison.ranked[1:] if a.probability >= MENTIONED][:3]
    names = ["nothing" if name == "none" else name for name in labels([best, *others])[1:]]
    also = [f"{name} ({a.probability:.2f})" for name, a in zip(names, others, strict=True)]
    if diagnosis.verdict != "unknown_physics" and (unknown := diagnosis.comparison.unknown) >= MENTIONED:
        also.append(f"something without a name ({unknown:.2f})")
    if also:
        said.append(f"It may also be {', or '.join(also)}.")
    if others:
        kinds = {CATEGORIES[name] for name in best.names}
        alike = sum(a.probability for a in diagnosis.comparison.answers if {CATEGORIES[n] for n in a.names} == kinds)
        if kinds and alike > best.probability + 0.05:
            said.append(f"The class is clearer than the law: {' with '.join(sorted(kinds))} ({alike:.2f}).")
    if diagnosis.proposal:
        said.append(_what_next(diagnosis.proposal, diagnosis.verdict == "unknown_physics"))
    return "\n".join(said)


def _of_the_nearest(worth: bool, names: str) -> str:
    """Whether the nearest that has a name is in the patch, as a sentence."""
    if worth:
        return f"So the patch has {names} all the same."
    return f"There is no patch: {names} explains much less of the held-out recordings than of the others."


def _least(seen: dict) -> str:
    """The smallest magnitude that would have shown, in words."""
    unit = spaced(seen["unit"])
    if seen["null"]:
        return f"with a {seen['quantity']} {seen['minimum']:.2g}{unit} off {seen['null']:g}"
    return f"of {seen['minimum']:.2g}{unit}"


def _force(diagnosis: Diagnosis, unit: str) -> str:
    """The force without a law that stands for what has no name."""
    force, problem = diagnosis.ranked_locations[0].force, diagnosis.explanation.problem
    sizes = (f"{size:.2g} {u} ({name})" for size, u, name in
             zip(np.sqrt((force.values**2).mean(axis=0)), force.units, force.components, strict=True))  # fmt: skip
    before = problem.left(diagnosis.explanation.nominal.residual)
    input_model = ", ".join(f"{name} {share:.2f}" for name, share in list(force.shares.items())[:3])
    input_model = (
        f"linear in what the robot is told and in its shape (mostly in: {input_model})"
        if force.shares
        else "free in time"
    )
    return (f"Without a law: what acts there is {', '.join(sizes)} rms; with it, {input_model}, "
            f"{length(force.left, unit)} of {length(before, unit)} would be left.")  # fmt: skip


def _elsewhere(ranked_locations: Sequence[RankedLocation]) -> list[str]:
    """Where forces explain nearly as much as at the first place, as a sentence; none if nowhere."""
    near = [str(site.location) for site in ranked_locations[1:] if site.gain >= NEARLY * ranked_locations[0].gain]
    more = len(near) - NAMED
    names = near[:NAMED] + [f"{more} other place{'s' * (more > 1)}"] * (more > 0)
    return [f"So it may be elsewhere: forces at {', '.join(names)} explain nearly as much."] if near else []


def _far(diagnosis: Diagnosis) -> str:
    """Which parameters have gone where hardly anybody expected them, as a sentence; nothing if none has."""
    x, robot = kept(diagnosis).x, diagnosis.robot
    far = [_change(prior, x[i]) for i, prior in enumerate(robot.priors) if abs(x[i]) > FAR]
    if not far:
        return ""
    begin, why = (
        ("Far from what the earlier diagnosis found", "these have changed")
        if robot.from_baseline
        else ("Far from their nominal values", "those are wrong")
    )
    return (f"{begin}, in standard deviations of their priors: {', '.join(far)}; either {why}, or what is missing "
            f"looks like these parameters.")  # fmt: skip


def _change(prior: Prior, x: float) -> str:
    """How far a parameter has gone, in words."""
    return f"{prior.name} from {prior.nominal:.3g} to {prior.value(x):.3g}{spaced(prior.unit)} ({x:+.1f})"


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
    shown = described(diagnosis, finding)
    values = ", ".join(
        f"{name} {q['value']:.3g}{spaced(q['unit'])} [{q['ci90'][0]:.3g}, {q['ci90'][1]:.3g}]"
        for name, q in shown["parameters"].items()
    )
    when = ", ".join(f"{w['start_s']:.0f}-{w['end_s']:.0f} s" for w in shown["when"][:6])
    if len(diagnosis.explanation.problem.recordings) > 1:
        when = f"{when} of the first recording" if when else "no time of the first recording"
    return (f"{finding.effect.name} at {finding.effect.location} (probability {finding.probability:.2f}): {values}; "
            f"visible at {when or 'no time'}; {shown['condition']}.")  # fmt: skip


def _indistinguishable(robot: Robot, effect: Effect) -> str:
    """What hardly any recording can tell from an effect, as a sentence; nothing if there is no such thing."""
    if not late(robot, effect.name, effect.location):
        return ""
    twin = "actuator_delay at every actuator" if effect.name == "sensor_delay" else "sensor_delay"
    return f" Only motion that no command began tells it from {twin}; clocks do."
