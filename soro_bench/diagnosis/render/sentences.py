"""A result in sentences, the same on the console and in the report."""

import math

from soro_bench.diagnosis.render.words import (
    NO_BREAK,
    Rows,
    category,
    chance,
    change,
    each_recording,
    error,
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
from soro_bench.diagnosis.result_parts import NEAR, Finding, ReachedLimit
from soro_bench.diagnosis.result_robot import ACCURATE
from soro_bench.effects.effect import Location

LIKELY = 0.05  # probability from which another hypothesis is mentioned
VISIBLE = 0.3  # noise deviations from which an error of the model's form is told
CORRECTED = 1.3  # ratio of plain to corrected errors from which the report warns
LEAVES_MOST = 0.7  # of the motion's rms, half of its square; a replay that leaves more tests nothing
FAR = 3.0  # standard deviations of the prior from which a parameter is called far off
CLEAR = 0.7  # probability from which a kind of fault is clear
AHEAD = 0.05  # by which a kind has to be more probable than the law
_BLACK_BOX = "black box"
ROBOTS = {  # whose plain replays are shown
    "nominal": "model as built",
    "fitted": "fitted parameters",
    "patched": "with effects",
    "best": "best hypothesis",
    "accurate": "effects, accurate model",
}
BEYOND = "the variance beyond noise and discretisation error"
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


def unnamed(result: Result) -> str:
    """What the probability of a discrepancy that no law describes stands for."""
    return "physics hidden by model-form error" if model_form(result) else "outside the catalogue"


def best_findings(result: Result) -> list[Finding]:
    """The effects of the hypothesis that the report is about."""
    return [each for each in result.findings if each.is_best]


def headline(result: Result) -> str:
    """The verdict in one line."""
    if result.verdict == "measurement_fault" and not best_findings(result):
        return "Adequate but for outliers"
    if result.verdict == "adequate":
        error = _plain_error(result)
        left = number(error, result.robot.unit)
        if says_little(result):
            return f"Undecided: plain replays {f'leave {left} of the motion' if math.isfinite(error) else 'diverge'}"
        return f"Adequate within {left}: no discrepancy detected"
    if equations := described(result):
        black_box = "a black box, " if label(result) == _BLACK_BOX else ""
        return f"{ANSWERS[result.verdict]}, described by {black_box}{'; '.join(equations)}"
    return ANSWERS[result.verdict]


def says_little(result: Result) -> bool:
    """Whether a robot without a discrepancy leaves so much of the motion that its replays test nothing."""
    motion = (result.heldout or result.train).motion
    return result.verdict == "adequate" and motion is not None and not _plain_error(result) < LEAVES_MOST * motion


def described(result: Result) -> tuple[str, ...]:
    """The equations of a law outside the catalogue; none where none was found, or a law of the catalogue is enough."""
    found = result.discovery if result.verdict == "outside_catalogue" else None
    return found.equations if found else ()


def label(result: Result) -> str:
    """What describes a discrepancy outside the catalogue: a law, or a black box."""
    return _BLACK_BOX if result.discovery and result.discovery.black_box else "law"


def _in_time_only(result: Result) -> str:
    """Why no law of state describes what is outside the catalogue, and what to record."""
    if (found := result.discovery) is None:
        if not result.locations:
            return ("No force at one place explains it, so no law was looked for. Record one channel moving at a time: "
                    "the place shows then.")  # fmt: skip
        why = f"No law was looked for at {result.locations[0].location}: the difference is seen in time only."
    else:
        why = "Neither a law of state nor a black box holds on held-out motion: the force is seen in time only."
        if peaks := found.peaks or (found.peak,) * bool(found.peak):
            why += f" Its spectrum peaks at {listed(f'{each:.3g}' for each in peaks)} Hz."
    return f"{why} Record the same commands twice: what repeats has a law, what does not is a disturbance."


def discovered(result: Result) -> list[str]:
    """What a law outside the catalogue reads and explains, or that none holds, in sentences."""
    if result.verdict != "outside_catalogue":
        return []
    if (found := result.discovery) is None or not found.effects:
        return [_in_time_only(result)]
    names = "; ".join(f"{name}: {said}" for name, said in found.legend.items())
    test = "the ends of the recordings, which were not fitted to" if found.own_test else "held-out recordings"
    share = f"{100 * found.explained:.1f} % of the squared error"
    held = "Outside these ranges it is held."
    if found.black_box:
        limits = (number(each["law"]["limit"], each["law"]["unit"]) for each in found.effects)
        most = "; ".join(dict.fromkeys(limits))
        held = f"{held} It is no law: g is a sum of bumps that says where and how much, not why, {most} at most."
    said = [f"With {names}. {held}",
            f"On {test} it explains {share} ({100 * found.noise_share:.1f} % is noise), the nearest law of the "
            f"catalogue {100 * max(found.nearest, 0.0):.1f} %."]  # fmt: skip
    return said + ([f"About as good: {'; or '.join(found.others)}."] if found.others else [])


def _plain_error(result: Result) -> float:
    """Of a plain replay with fitted parameters, of held-out recordings where there are any."""
    for each in result.robots:
        if each.name == "fitted":
            return each.train if each.heldout is None else each.heldout
    return (result.heldout or result.train).before  # results before replays were part of them


def model_form(result: Result) -> str:
    """What another simulator of the robot may differ by, where that much is left, and the laws that cannot be told from
    such a difference, the one that explains most first; else ""."""
    form, unit = result.model_form, result.robot.unit
    if result.verdict != "adequate" or form is None or not form.possible or form.left < VISIBLE * result.train.noise:
        return ""
    left, largest = number(form.left, unit, 2), number(form.largest, unit, 2)
    said = (f"Beyond noise and discretisation error {left} is left. Another simulator of this robot may differ by "
            f"{largest}, so a law of that size cannot be told from one.")  # fmt: skip
    of_nominal = max((each.misfit_total for each in result.hypotheses if not each.effects), default=0.0)
    laws = sorted((each for each in result.hypotheses if each.effects), key=lambda each: each.misfit_total)
    may = [
        f"{terms(each.effects)} ({100 * (1.0 - each.misfit_total / of_nominal):.0f} %)"
        for each in laws
        if each.misfit_total < of_nominal
    ]
    begins = "It may be part of what is left"
    if result.rounds and not laws:  # what they gain says that no fit is worth it
        begins, of_nominal = "As predicted, it may be part of what is left", result.hypotheses[0].misfit
        gains = ((terms((each.term,)), each.predicted_gain / of_nominal) for each in result.rounds[0].screened)
        may = [f"{named} ({100 * share:.0f} %)" for named, share in gains if share > 0.0]
    return f"{said} {begins}: {', or '.join(may[:3])} of the misfit." if may else said


def where(result: Result) -> str:
    """The location of a discrepancy outside the catalogue, or the region of it, and others that explain nearly as
    much."""
    if not result.locations:
        return "no single location"
    first, *others = result.locations
    inside = {Location("body", name) for name in result.region}
    near = [str(each.location) for each in others if each.gain >= NEAR * first.gain and each.location not in inside]
    said = str(first.location)
    if result.region:
        said = f"bodies {result.region[0]} to {result.region[-1]}, best {first.location.name}"
    if not near:
        return said
    more = f" and {len(near) - 3} more" if len(near) > 3 else ""
    return f"{said}; nearly as well {', '.join(near[:3])}{more}"


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
        found.append(f"{unnamed(result)} ({probability(result.unknown)})")
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


def unconstrained(result: Result) -> str:
    """What an input without a law would explain, in a sentence; empty where none was estimated or nothing is left."""
    found, errors = result.unknown_input, result.train
    if found is None or not errors.corrected_before > errors.noise:
        return ""
    left = max(found.rmse_after**2 - errors.noise**2, 0.0) / (errors.corrected_before**2 - errors.noise**2)
    return f"To first order, an unconstrained input there explains {100 * max(1.0 - left, 0.0):.0f} % of {BEYOND}."


def replays(result: Result) -> Rows:
    """Errors of plain replays on the recordings fitted to and on held-out ones, a row for each robot; then what the
    covariance of discretisation error takes off the last one."""
    unit, both = result.robot.unit, [result.train, *([result.heldout] if result.heldout else [])]
    rows: Rows = []
    for each in filter(lambda robot: robot.name in ROBOTS, result.robots):
        name = "fitted, known effects" if each.name == "fitted" and each.effects else ROBOTS[each.name]
        if each.name == ACCURATE and not result.best.effects:
            rows.append((ROBOTS["patched"], "no effects", *[""] * (len(both) - 1)))
            name = "fitted, accurate model"
        values = [math.nan if value is None else value for value in (each.train, each.heldout)][: len(both)]
        rows.append((name, *(error(value, unit) for value in values)))
    if rows and not result.best.effects and not any(each.name == ACCURATE for each in result.robots):
        rows.append((ROBOTS["patched"], "no effects", *[""] * (len(both) - 1)))
    elif not rows:  # of an older version
        rows.append((ROBOTS["fitted"], *(error(each.before, unit) for each in both)))
        if result.best.effects:
            rows.append((ROBOTS["best"], *(error(each.after, unit) for each in both)))
    return [*rows, ("may be discretisation", *(_taken_off(each.after, each.corrected_after, unit) for each in both))]


def signals(result: Result) -> list[str]:
    """Errors of plain replays of every signal, where there are several, a sentence each."""
    found = []
    for each in result.signals:
        said = f"{each.name}: RMSE {change(each.before, each.after, each.unit)}"
        if each.heldout_before is not None and each.heldout_after is not None:
            said += f", held out {change(each.heldout_before, each.heldout_after, each.unit)}"
        found.append(f"{said}; noise {number(each.noise, each.unit)}")
    return found


def _taken_off(plain: float, corrected: float, unit: str) -> str:
    """What the covariance of discretisation error takes off an error."""
    square = plain**2 - corrected**2
    if not math.isfinite(square):
        return ""
    return number(math.sqrt(square), unit) if square > 0 else "none"


def explained(result: Result) -> str:
    """What the effects explain beyond noise and discretisation error, in a sentence; empty without effects."""
    found, which = (result.heldout, "held-out") if result.heldout else (result.train, "fitted")
    if not result.best.effects or math.isnan(found.explained):
        return ""
    do = "add to" if found.is_worse else f"explain {100 * found.explained:.0f} % of"
    what = "the nearest laws of the catalogue" if result.verdict == "outside_catalogue" else "the effects"
    return f"On {which} recordings {what} {do} {BEYOND}."


def _of_errors(result: Result) -> list[str]:
    """Where plain errors are not what the verdict is about, and where the effects make replays worse."""
    said, heldout, unit, far = [], result.heldout, result.robot.unit, []
    if not result.robots:
        said.append("Of an older version: replays had half the model's time step, unlike those of soro-bench check.")
    for name, each in (("fitted", result.train), ("held-out", heldout)):
        pairs = [("with fitted parameters", each.before, each.corrected_before)] if each else []
        if each and result.best.effects:
            pairs.insert(0, ("with the effects", each.after, each.corrected_after))
        large = [row for row in pairs if 0.0 < row[1] < math.inf and row[1] > CORRECTED * row[2]]
        far += [f"{_taken_off(error, left, unit)} of {number(error, unit)} {which} on {name} recordings"
                for which, error, left in large[:1]]  # fmt: skip
    if far:
        said.append(f"Discretisation error may be {listed(far)}. It is no evidence, and stays in every replay.")
    worse = heldout is None or heldout.after > heldout.before
    if result.patch.state == "rejected":
        off = "" if worse else ", discretisation error taken off"
        said.append(f"The patch is rejected: it makes held-out recordings worse{off}.")
    elif heldout and worse and result.best.effects:
        said.append("A plain replay of held-out recordings is worse with the effects than without them.")
    return said


def worse(result: Result) -> str:
    """That replays are worse than those of the model as built, in a sentence; empty where none is."""
    found, unit = [], result.robot.unit
    for name in dict.fromkeys(each.robot for each in result.worse_replays):
        some = [each for each in result.worse_replays if each.robot == name]
        pairs = (f"{change(each.built, each.found, unit)} on {each.recordings} recordings" for each in some)
        found.append(f"{ROBOTS.get(name, name)} {listed(pairs)}")
    return f"Plain replays are worse than those of the model as built: {'; '.join(found)}." if found else ""


def warnings(result: Result) -> list[str]:
    """What a reader must know before using the numbers."""
    said = _of_errors(result)
    if says_little(result):
        said.append("Replays that run away from the recording, as of an unstable robot without its controller, test no "
                    "physics. Cut the recording into short pieces, each from its own start.")  # fmt: skip
    if form := model_form(result):
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


def alone(result: Result) -> str:
    """Errors of replays of the patched model alone, on the recordings fitted to and on held-out ones."""
    pairs = zip(("fitted", "held-out"), result.patch.replays, strict=False)
    return ", ".join(f"{change(each.built, each.patched, result.robot.unit)} on {name}" for name, each in pairs)


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
