"""A result in sentences, the same on the console and in the report."""

import math

from soro_bench.diagnosis.render import outside, replay_errors
from soro_bench.diagnosis.render.words import (
    NO_BREAK,
    category,
    chance,
    each_recording,
    law,
    listed,
    located,
    number,
    parameter,
    plain,
    probability,
    quantity,
    terms,
)
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Finding, ReachedLimit

LIKELY = 0.05  # probability from which another hypothesis is mentioned
FAR = 3.0  # standard deviations of the prior from which a parameter is called far off
CLEAR = 0.7  # probability from which a kind of fault is clear
_PAYLOAD = "payload"  # the law whose place within a body is assumed
AHEAD = 0.05  # by which a kind has to be more probable than the law
LIMITS = {
    "force_limit": "At a limit of force",
    "control_limit": "At a limit of control",
    "slack": "Slack",
    "stop": "At a stop",
    "contact": "In contact",
}
SHOWN_LIMITS = 4  # elements of a kind that are named
ANSWERS = {
    "discrepancy": "Not adequate: the simulation lacks physics",
    "outside_catalogue": "Not adequate: a discrepancy outside the catalogue",
    "recordings_disagree": "Not adequate: parameters change from recording to recording",
    "measurement_fault": "Sensor fault: the measurement differs, not the robot",
}


def limits(result: Result) -> list[str]:
    """What the fitted robot reaches in its replay, a sentence for each kind of limit; the largest shares first."""
    found = []
    for name, said in LIMITS.items():
        reached = [each for each in result.limits if each.name == name]
        if reached:
            more = len(reached) - SHOWN_LIMITS
            shares = listed([*map(_share, reached[:SHOWN_LIMITS]), *([f"{more} more"] if more > 0 else [])])
            found.append(f"{said}: {shares} of the time.")
    return found


def _share(found: ReachedLimit) -> str:
    """An element, its limit and the share of the time."""
    value = "" if found.value is None else f" ({number(found.value, found.unit)})"
    return f"{found.element}{value} {100 * found.share:.0f}{NO_BREAK}%"


def disagreement(result: Result) -> list[str]:
    """Which quantities change from recording to recording, in sentences; none where the recordings agree."""
    found = [each for each in result.agreement if each.changes]
    if not found:
        return []
    said = ["Parameters change from recording to recording: the structure of the model is wrong."]
    return said + [f"{quantity(each)}: {each_recording(each)} ({chance(each.p_value)})." for each in found]


def known(result: Result) -> str:
    """The parameters that were known, with their values; empty where all were fitted."""
    return ", ".join(f"{law(each.estimate.name)} {parameter(each)}" for each in result.parameters if each.known)


def best_findings(result: Result) -> list[Finding]:
    """The effects of the hypothesis that the report is about."""
    return [each for each in result.findings if each.is_best]


def headline(result: Result) -> str:
    """The verdict in one line."""
    if result.verdict == "measurement_fault" and not best_findings(result):
        return "Adequate but for outliers"
    plain_error = replay_errors.plain_error(result)
    left = number(plain_error, result.robot.unit)
    if result.verdict == "undecided":
        return f"Undecided: plain replays {f'leave {left} of the motion' if math.isfinite(plain_error) else 'diverge'}"
    if result.verdict == "adequate":
        return f"Adequate within {left}: no discrepancy detected"
    if equations := outside.described(result):
        black_box = "a black box, " if outside.label(result) == outside.BLACK_BOX else ""
        return f"{ANSWERS[result.verdict]}, described by {black_box}{'; '.join(equations)}"
    return ANSWERS[result.verdict]


def seeds(result: Result) -> str:
    """What diagnoses with other random numbers say; empty where there is one."""
    if not (found := result.seeds):
        return ""
    shares = [f"{plain(each.answer)} ({probability(each.share)})" for each in found]
    return f"of {sum(each.count for each in found)}: {', '.join(shares)}"


def data(result: Result) -> list[str]:
    """What sensors and loggers did to the recordings, in a sentence each."""
    count, found = result.trained_on, []
    for each in result.data:
        held = each.recording >= count
        number = each.recording - count if held else each.recording
        several = (len(result.recordings) - count if held else count) > 1
        which = " of ".join(part for part in (f"recording {number + 1}" * several, "the held-out data" * held) if part)
        found.append(f"{which}: {each.text}." if which else f"{each.text}.")
    return found


def alternatives(result: Result) -> list[str]:
    """What else it may be, with probabilities; the most probable first."""
    found = [
        f"{terms(each.effects) or 'no discrepancy'} ({probability(each.probability)})"
        for each in result.hypotheses[1:]
        if each.probability >= LIKELY
    ][:3]
    if result.verdict != "outside_catalogue" and result.unknown >= LIKELY:
        found.append(f"{outside.unnamed(result)} ({probability(result.unknown)})")
    return found


def kind(result: Result) -> str:
    """That the kind of fault is clearer than the law, in a sentence; empty where it is not."""
    found = best_findings(result)
    if len(found) != 1 or result.verdict == "outside_catalogue":
        return ""
    chance = result.categories.get(found[0].category, 0.0)
    if chance < max(CLEAR, found[0].probability + AHEAD):
        return ""
    return f"The kind of fault is clear ({category(found[0].category)}, {probability(chance)}); the exact law is not."


def warnings(result: Result) -> list[str]:
    """What a reader must know before using the numbers."""
    said = replay_errors.of_errors(result)
    if result.verdict == "undecided":
        said.append("Replays that run away from the recording, as of an unstable robot without its controller, test no "
                    "physics. Cut the recording into short pieces, each from its own start.")  # fmt: skip
    if form := outside.model_form(result):
        said.append(form)
    if result.patch.state == "untested" and result.best.effects:
        said.append("No recording was held out: nothing tests the patch on another motion.")
    far = [
        f"{law(each.estimate.name)} {number(each.nominal, each.estimate.unit)} -> "
        f"{number(each.estimate.value, each.estimate.unit)} ({each.prior_deviations:+.1f} sd)"
        for each in result.parameters
        if abs(each.prior_deviations) > FAR
    ]
    if far:
        origin = "the baseline diagnosis" if result.robot.has_baseline else "their nominal values"
        said.append(f"Parameters far from {origin}: {', '.join(far)}. Either they are wrong there, or the discrepancy "
                    "looks like them.")  # fmt: skip
    for finding in best_findings(result):
        if finding.indistinguishable_from:
            name = law(finding.name).capitalize()
            said.append(f"{name} and {plain(finding.indistinguishable_from)} leave the same trace; only clocks or "
                        "motion without a command tell them apart.")  # fmt: skip
        if finding.name == _PAYLOAD and finding.location is not None:
            said.append(f"The mass of the payload is as at the centre of mass of {finding.location}; elsewhere on it "
                        "another mass does the same.")  # fmt: skip
    return said + [f"{each[:1].upper()}{each[1:]}." for each in result.notes]


def patched_model(result: Result) -> list[str]:
    """What patched_model.xml is not, in sentences; none where it is as found and has everything."""
    found, said = result.patch, []
    if found.model is None:
        said.append(f"patched_model.xml is not written: {found.obstacle or 'MJCF cannot hold it'}.")
    elif found.model_state == "refitted":
        said.append(f"patched_model.xml has parameters of its own: with those found, {found.obstacle}.")
    if found.model is not None and found.remaining:
        names = (f"{each.get('name')} at {located(each.get('location'))}" for each in found.remaining)
        said.append(f"Not in the patched model: {listed(names)}; effects.json has them.")
    return said


def next_recording(result: Result) -> str:
    """What to record next, and what for; empty if nothing is left to tell apart."""
    found = result.next_recording
    if found is None:
        return ""
    said = f"next_actions.csv: {found.motion}, {found.duration_s:g} s"
    if not found.separates:
        if len(found.rivals) < 2:
            return f"{said}; shows more of the discrepancy."
        return f"{said}; no motion that was tried separates {plain(listed(found.rivals))}, this one comes nearest."
    pairs = [plain(f"{a} from {b}") for a, b in found.separates]
    return f"{said}; would tell {listed(pairs)}."
