"""Laws that are data: what they read, what they remember, and the expression of what they exert."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from soro_bench.effects.expression import LawError, Node, name_of, number, parsed, to_json, written
from soro_bench.files import brief

NAME = "custom"
KINDS = ("joint", "tendon", "body", "actuator", "model")  # of locations, where they act
READS = {  # a variable, and the kinds of locations that it may be of
    "position": ("joint", "tendon", "body"),
    "velocity": ("joint", "tendon", "body"),
    "acceleration": ("joint", "tendon", "body"),
    "command": ("actuator",),
    "force": ("actuator",),
    "distance": ("body",),
    "time": (),
}
MEMORIES = {"play": "width", "bouc_wen": "width", "lag": "time", "maxwell": "time"}  # a state, and its parameter
AXES = ("x", "y", "z")
_MOST = {"variables": 12, "states": 4, "parameters": 16}
_LARGEST_LIMIT = 1e6
_KEYS = {"unit", "limit", "direction", "variables", "states", "expression", "units"}


@dataclass(frozen=True)
class Place:
    """An element that a law reads: its kind and name."""

    kind: str
    name: str


@dataclass(frozen=True)
class Variable:
    """What a law reads. Outside the range that was seen, it is held at its end.

    of: a key of READS. place: of what; None for where the law acts. axis: of a body's position. point: from which a
    body's distance counts [m], numbers or names of parameters.
    """

    name: str
    of: str
    low: float
    high: float
    place: Place | None = None
    axis: str | None = None
    point: tuple[float | str, ...] = ()


@dataclass(frozen=True)
class Memory:
    """A hidden state: of kind ``of`` (MEMORIES), that follows ``input``; ``parameter`` is its width or time [s]."""

    name: str
    of: str
    input: Node
    parameter: float | str


@dataclass(frozen=True)
class CustomLaw:
    """A force, moment, acceleration or offset as an expression of what a law reads and remembers.

    unit: of it. limit: it is never larger. direction: of a force on a body or of gravity: an axis of the world, or a
    point towards which it pulls. units: of parameters, by name.
    """

    unit: str
    limit: float
    expression: Node
    variables: tuple[Variable, ...] = ()
    states: tuple[Memory, ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    direction: str | tuple[float | str, ...] = ""

    def to_json(self) -> dict[str, Any]:
        """As effects files have it."""
        found: dict[str, Any] = {"unit": self.unit, "limit": self.limit}
        if self.direction:
            found["direction"] = self.direction if isinstance(self.direction, str) else list(self.direction)
        found["variables"] = {each.name: _variable_json(each) for each in self.variables}
        if self.states:
            found["states"] = {
                each.name: {"of": each.of, "input": to_json(each.input), MEMORIES[each.of]: each.parameter}
                for each in self.states
            }
        return {**found, "expression": to_json(self.expression), "units": dict(self.units)}

    def equation(self, parameters: Mapping[str, float]) -> str:
        """One line of text, with the values of parameters in the place of their names."""
        values = {name: f"{value:.4g}" for name, value in parameters.items()}
        return f"F = {written(self.expression, values)}"

    def legend(self) -> dict[str, str]:
        """What each name in its equation is, with the range in which it was seen."""
        found = {each.name: _said(each) for each in self.variables}
        for each in self.states:
            found[each.name] = f"{each.of.replace('_', '-')} of {written(each.input, {})}"
        return found


def _said(variable: Variable) -> str:
    place = "" if variable.place is None else f" of {variable.place.kind} {variable.place.name}"
    axis = f" along {variable.axis}" if variable.axis else ""
    return f"{variable.of}{axis}{place}, seen from {variable.low:.3g} to {variable.high:.3g}"


def _variable_json(each: Variable) -> dict[str, Any]:
    found: dict[str, Any] = {"of": each.of, "range": [each.low, each.high]}
    if each.place is not None:
        found["location"] = {"kind": each.place.kind, "name": each.place.name}
    if each.axis:
        found["axis"] = each.axis
    if each.point:
        found["point"] = list(each.point)
    return found


def read_law(data: object, parameters: object, kind: str) -> CustomLaw:
    """The law that a JSON object describes, for a kind of location.

    Args:
        parameters: of the effect, numbers by name.

    Raises:
        LawError: says what is wrong.
    """
    if not isinstance(data, dict) or not {"unit", "limit", "expression"} <= data.keys() <= _KEYS:
        raise LawError(f"a custom law has unit, limit and expression, and may have {', '.join(sorted(_KEYS))}; "
                       f"this one is {brief(data)}")  # fmt: skip
    variables, states, units = (_dictionary(data.get(key, {}), key) for key in ("variables", "states", "units"))
    named = {name_of(name, "a parameter") for name in _dictionary(parameters, "parameters")}
    names = [*named, *(name_of(each, "a variable") for each in variables), *(name_of(s, "a state") for s in states)]
    if len(names) > len(set(names)):
        raise LawError(f"parameters, variables and states share a name: {brief(sorted(names))}")
    read = tuple(_variable(name, each, named, kind) for name, each in variables.items())
    known = named | {each.name for each in read}
    kept = []
    for name, each in states.items():  # a state may follow those before it
        kept.append(_memory(name, each, frozenset(known), named))
        known.add(name)
    expression = parsed(data["expression"], frozenset(known), "the expression")
    limit = number(data["limit"], "the limit")
    if not 0.0 < limit <= _LARGEST_LIMIT:
        raise LawError(f"the limit is {limit:g}; allowed is above 0, {_LARGEST_LIMIT:g} at most")
    of_units = tuple((name_of(key, "a unit"), _text(value, f"unit of {brief(key)}")) for key, value in units.items())
    direction = _direction(data.get("direction"), named, kind)
    return CustomLaw(_text(data["unit"], "the unit"), limit, expression, read, tuple(kept), of_units, direction)


def _dictionary(data: object, key: str) -> dict[str, Any]:
    most = _MOST.get(key, _MOST["parameters"])
    if not isinstance(data, Mapping) or len(data) > most:
        raise LawError(f"{key} are {brief(data)}; expected is an object of {most} entries at most")
    return dict(data)


def _text(data: object, where: str) -> str:
    if not isinstance(data, str) or len(data) > 40 or not data.isprintable():
        raise LawError(f"{where} is {brief(data)}; expected is a short text")
    return data


def _variable(name: str, data: object, parameters: set[str], kind: str) -> Variable:
    where = f"variable {name}"
    if not isinstance(data, dict) or not {"of", "range"} <= data.keys() <= {"of", "range", "location", "axis", "point"}:
        raise LawError(f"{where} is {brief(data)}; it has of and range, and may have location, axis and point")
    of, span = data["of"], data["range"]
    if not isinstance(of, str) or of not in READS:
        raise LawError(f"{where} is of {brief(of)}; there are {', '.join(READS)}")
    if not isinstance(span, list) or len(span) != 2:
        raise LawError(f"range of {name} is {brief(span)}; expected are its two ends")
    low, high = (number(end, f"an end of the range of {name}") for end in span)
    if low > high:
        raise LawError(f"range of {name} is {brief(span)}; its ends have to rise")
    place = _place(data.get("location"), where)
    if of == "time" and place:
        raise LawError(f"{where} is of time, which has no location")
    if READS[of] and (place.kind if place else kind) not in READS[of]:
        raise LawError(f"{where} is of {of}, which {place.kind if place else kind} has not; "
                       f"allowed is a location of kind {', '.join(READS[of])}")  # fmt: skip
    on_body = (place.kind if place else kind) == "body" and of in ("position", "velocity", "acceleration")
    axis = data.get("axis")
    if (axis is not None or on_body) and (not on_body or axis not in AXES):
        raise LawError(f"axis of {name} is {brief(axis)}; of a body it is x, y or z, and else there is none")
    point = data.get("point", [])
    if (of == "distance") != bool(point):
        raise LawError(f"{where} has the point {brief(point)}; a distance has one, and nothing else")
    return Variable(name, of, low, high, place, axis, _point(point, parameters, where) if point else ())


def _place(data: object, where: str) -> Place | None:
    if data is None:
        return None
    valid = isinstance(data, dict) and data.keys() == {"kind", "name"}
    if not valid or not all(isinstance(each, str) and len(each) < 200 for each in data.values()):  # type: ignore[attr-defined]
        raise LawError(f"location of {where} is {brief(data)}; it has a kind and a name")
    if data["name"].startswith("*"):  # type: ignore[index]
        raise LawError(f"location of {where} is {brief(data)}; it has to be one element")
    return Place(data["kind"], data["name"])  # type: ignore[index]


def _point(data: object, parameters: set[str], where: str) -> tuple[float | str, ...]:
    if not isinstance(data, list) or len(data) != 3:
        raise LawError(f"point of {where} is {brief(data)}; expected are three numbers or names of parameters")
    return tuple(_parameter(each, parameters, f"point of {where}") for each in data)


def _parameter(data: object, parameters: set[str], where: str) -> float | str:
    if isinstance(data, str):
        if data not in parameters:
            raise LawError(f"{where} is {brief(data)}; parameters are {', '.join(sorted(parameters)) or 'none'}")
        return data
    return number(data, where)


def _memory(name: str, data: object, known: frozenset[str], parameters: set[str]) -> Memory:
    of = data.get("of") if isinstance(data, dict) else None
    if not isinstance(data, dict) or not isinstance(of, str) or of not in MEMORIES:
        raise LawError(f"state {name} is {brief(data)}; it is of {', '.join(MEMORIES)}")
    if data.keys() != {"of", "input", MEMORIES[of]}:
        raise LawError(f"state {name} has {brief(sorted(map(str, data)))}; {of} has of, input and {MEMORIES[of]}")
    follows = parsed(data["input"], known, f"the input of {name}")
    return Memory(name, of, follows, _parameter(data[MEMORIES[of]], parameters, f"{MEMORIES[of]} of {name}"))


def _direction(data: object, parameters: set[str], kind: str) -> str | tuple[float | str, ...]:
    if kind not in ("body", "model"):
        if data is not None:
            raise LawError(f"the direction is {brief(data)}; only laws of bodies and of gravity have one")
        return ""
    if isinstance(data, str) and data in AXES:
        return data
    if kind == "model" or not isinstance(data, list):
        raise LawError(f"the direction is {brief(data)}; expected is x, y or z" + (" or a point" * (kind == "body")))
    return _point(data, parameters, "the direction")
