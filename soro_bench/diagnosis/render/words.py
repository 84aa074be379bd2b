"""Numbers, units and names in words, the same on the console and in the report."""

import math
import re
from collections.abc import Iterable

from soro_bench.diagnosis.result_parts import Agreement, Detectable, Estimate, NamedLocation, ParameterEstimate
from soro_bench.effects.effect import Location
from soro_bench.effects.equations import EQUATIONS

NO_BREAK = "\u00a0"  # the space between a number and its unit
TINY = 1e-3  # a smaller p-value is printed as "p < 0.001"
KINDS = {
    "static_error": "static actuator or load error",
    "friction": "dry friction",
    "hysteresis_or_play": "hysteresis or play",
}
Rows = list[tuple[str, ...]]
_POWERS = {"^2": "²", "^3": "³"}
_LAWS = re.compile(rf"\b({'|'.join(sorted(EQUATIONS, key=len, reverse=True))})\b")


def number(value: float, unit: str, digits: int = 3) -> str:
    """A number with its unit; lengths in mm, "1" is no unit."""
    scale, shown = shown_unit(unit, value)
    return _joined(f"{scale * value:.{digits}g}", shown)


def shown_unit(unit: str, value: float = 0.0) -> tuple[float, str]:
    """Factor and name of the unit that a quantity is shown in; MPa for large pressures."""
    if unit == "m":
        return 1e3, "mm"
    if unit == "Pa":
        return (1e-6, "MPa") if abs(value) >= 1e6 else (1e-3, "kPa")
    for written, shown in _POWERS.items():
        unit = unit.replace(written, shown)
    return 1.0, unit


def estimate(found: Estimate) -> str:
    """A value with its unit and its 90 % interval."""
    if found.low is None or found.high is None:
        return number(found.value, found.unit)
    scale, unit = shown_unit(found.unit, found.value)
    low, high = (f"{scale * each:.3g}" for each in (found.low, found.high))
    return _joined(f"{scale * found.value:.3g} [{low}, {high}]", unit)


def quantity(found: Agreement) -> str:
    """A parameter, or a quantity of a law and where that acts."""
    return f"{law(found.name)} of {law(found.law)} at {found.location}" if found.law else law(found.name)


def each_recording(found: Agreement) -> str:
    """What the recordings say, one after the other."""
    return ", ".join(map(estimate, found.estimates))


def agreement(found: Agreement) -> str:
    """Whether recordings agree on a quantity."""
    if found.overlap:
        return "intervals overlap"
    return f"{'changes' if found.changes else 'intervals apart, may be chance'} ({chance(found.p_value)})"


def parameter(found: ParameterEstimate) -> str:
    """The value of a parameter with its interval, or how it is known."""
    if not found.known:
        return estimate(found.estimate)
    source = {"told": "as told", "recorded": "as recorded"}[found.known]
    return f"{number(found.estimate.value, found.estimate.unit)} ({source})"


def _joined(value: str, unit: str) -> str:
    """A value and its unit, which stay on one line."""
    return value if unit == "1" else f"{value}{NO_BREAK}{unit.replace(' ', NO_BREAK)}"


def detectable(found: Detectable) -> str:
    """The smallest magnitude that would have shown, and what it differs from if that is not zero."""
    return number(found.minimum, found.unit, 2) + (f" off {found.null:g}" if found.null else "")


def change(before: float, after: float, unit: str) -> str:
    """An error before and after; once where it is the same."""
    first, last = error(before, unit), error(after, unit)
    return last if first == last else f"{first.split(NO_BREAK)[0]} -> {last}"


def chance(p_value: float) -> str:
    """A p-value, never smaller than can be known."""
    return "p < 0.001" if p_value < TINY else f"p = {p_value:.2g}"


def law(name: str) -> str:
    """The name of a law as words."""
    return name.replace("_", " ")


def plain(text: str) -> str:
    """A sentence in which the names of laws are words; names of the robot's parts stay as they are."""
    return _LAWS.sub(lambda found: law(found[0]), text)


def category(name: str) -> str:
    """The kind of a law in words."""
    return KINDS.get(name, law(name))


def terms(found: Iterable[NamedLocation]) -> str:
    """Laws and where they act."""
    return " with ".join(f"{law(each.name)} at {each.location}" for each in found)


def probability(value: float) -> str:
    """A probability with two digits."""
    return f"{value:.2f}"


def error(value: float, unit: str) -> str:
    """An error of a plain replay."""
    return number(value, unit) if math.isfinite(value) else "diverges"


def located(location: object) -> str:
    """The location of an effect in a result's JSON, in words."""
    values = location if isinstance(location, dict) else {}
    return str(Location(str(values.get("kind")), str(values.get("name")), values.get("index")))


def listed(words: Iterable[str]) -> str:
    """Words as a list in a sentence."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
