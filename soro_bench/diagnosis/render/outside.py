"""What is said of a discrepancy that no law of the catalogue describes: its law, its location, and by how much another
simulator may differ."""

from soro_bench.diagnosis.render.replay_errors import BEYOND
from soro_bench.diagnosis.render.words import listed, number, terms
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import NEAR
from soro_bench.effects.effect import Location

VISIBLE = 0.3  # noise deviations from which an error of the model's form is told
BLACK_BOX = "black box"


def unnamed(result: Result) -> str:
    """What the probability of a discrepancy that no law describes stands for."""
    return "physics hidden by model-form error" if model_form(result) else "outside the catalogue"


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


def described(result: Result) -> tuple[str, ...]:
    """The equations of a law outside the catalogue; none where none was found, or a law of the catalogue is enough."""
    found = result.discovery if result.verdict == "outside_catalogue" else None
    return found.equations if found else ()


def label(result: Result) -> str:
    """What describes a discrepancy outside the catalogue: a law, or a black box."""
    return BLACK_BOX if result.discovery and result.discovery.black_box else "law"


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


def unconstrained(result: Result) -> str:
    """What an input without a law would explain, in a sentence; empty where none was estimated or nothing is left."""
    found, errors = result.unknown_input, result.train
    if found is None or not errors.corrected_before > errors.noise:
        return ""
    left = max(found.rmse_after**2 - errors.noise**2, 0.0) / (errors.corrected_before**2 - errors.noise**2)
    return f"To first order, an unconstrained input there explains {100 * max(1.0 - left, 0.0):.0f} % of {BEYOND}."
