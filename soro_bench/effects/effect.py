"""What an effect is: a law by name, where it acts, and its parameters; and files of effects."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from soro_bench.effects import custom_law
from soro_bench.effects.custom_law import CustomLaw
from soro_bench.effects.expression import LawError, number
from soro_bench.files import brief, read_json, write_json

SCHEMA = "soro-bench/effects/2"
OLD_SCHEMA = "soro-bench/effects/1"  # its locations have the key "where"; it is still read
KINDS = ("tendon", "joint", "actuator", "body", "flex", "geom", "model", "sensor")
EVERY = "*"  # the name that means all locations of a kind
EACH = "*each"  # the same, with a magnitude of its own at each: of several effects, never of one
MAX_EFFECTS = 100


@dataclass(frozen=True)
class Location:
    """Where an effect acts: a named element of a MuJoCo model, all of a kind ("*"), or an entry of a signal. A finding
    of a diagnosis may be at "*each" of a kind, with a magnitude of its own at each.

    ``kind`` is one of KINDS. For "model" the name says what of it, for "sensor" it is a signal's name, and ``index``
    the point of it that is concerned.
    """

    kind: str
    name: str
    index: int | None = None

    def __str__(self) -> str:
        place = "" if self.index is None else f"[{self.index}]"
        all_of_kind = {EVERY: f"every {self.kind}", EACH: f"each {self.kind}"}
        return all_of_kind.get(self.name, f"{self.kind} {self.name}{place}")

    def to_json(self) -> dict[str, Any]:
        """As effects files have it."""
        place = {} if self.index is None else {"index": self.index}
        return {"kind": self.kind, "name": self.name, **place}


@dataclass(frozen=True)
class Quantity:
    """A parameter of a law.

    typical: where a search begins; a multiple of the location's scale of force, damping, length or so if ``of``
        says so.
    null: where the law does nothing, if this is its first parameter.
    also: other values that make another signature, from which a search begins too.
    takes: whether values below null take away from what the model has of the same (``Law.removable``).
    """

    name: str
    unit: str
    typical: float
    bounds: tuple[float, float]
    null: float = 0.0
    also: tuple[float, ...] = ()  # other values where a search begins
    of: Literal["force", "damping", "length", "compliance", "mass"] | None = None
    takes: bool = False


@dataclass(frozen=True)
class Effect:
    """A law at a location with its parameters (SI units). ``law`` is that of "custom", which no catalogue has."""

    name: str
    location: Location
    parameters: Mapping[str, float]
    law: CustomLaw | None = None

    def to_json(self) -> dict[str, Any]:
        """As effects files have it."""
        found = {"name": self.name, "location": self.location.to_json(), "parameters": dict(self.parameters)}
        return found if self.law is None else {**found, "law": self.law.to_json()}


class Acting(Protocol):
    """What is asked of a law, physical or of measurement, when an effect is read."""

    kinds: ClassVar[tuple[str, ...]]  # of KINDS, where it can act
    quantities: ClassVar[tuple[Quantity, ...]]


class EffectError(ValueError):
    """An effect is unknown, out of its bounds, or has no place in the model."""


def effect_from(data: object, laws: Mapping[str, type[Acting]]) -> Effect:
    """The effect that a JSON object describes.

    Args:
        data: {"name", "location": {"kind", "name", "index"?}, "parameters": {name: number}}, and "law" if its name is
            "custom" (see ``custom_law.read_law``).
        laws: by name; classes with ``kinds`` and ``quantities``, such as catalogue.ALL.

    Raises:
        EffectError: says what is wrong.
    """
    if isinstance(data, dict) and "where" in data and "location" not in data:  # as in the old schema
        data = {"location" if key == "where" else key: value for key, value in data.items()}
    if isinstance(data, dict) and data.get("law", ...) is None:  # of an Effect that is in the catalogue, as a dict
        data = {key: value for key, value in data.items() if key != "law"}
    custom = isinstance(data, dict) and data.get("name") == custom_law.NAME
    expected = {"name", "location", "parameters", *(["law"] if custom else [])}
    if not isinstance(data, dict) or data.keys() != expected:
        law = " and, as it is custom, a law" if custom else ""
        raise EffectError(f"an effect has name, location and parameters{law}; this one is {brief(data)}")
    name, location = data["name"], data["location"]
    if not isinstance(name, str) or not (custom or name in laws):
        raise EffectError(f"unknown effect {brief(name)}; there are {', '.join(sorted([*laws, custom_law.NAME]))}")
    valid = isinstance(location, dict) and location.keys() - {"index"} == {"kind", "name"} and location["kind"] in KINDS
    valid = valid and isinstance(location["name"], str)
    valid = valid and ((index := location.get("index")) is None or (type(index) is int and index >= 0))
    if not valid:
        raise EffectError(
            f"location of {name} is {brief(location)}; it has a kind ({', '.join(KINDS)}), a name, an index"
        )
    if location["name"] == EACH:
        raise EffectError(f"{name} is at {EACH!r}, which names no location; give every location an effect of its own")
    kinds = custom_law.KINDS if custom else laws[name].kinds
    if location["kind"] not in kinds:
        raise EffectError(f"{name} acts on {', '.join(kinds)}, not on {brief(location['kind'])}")
    if custom:
        return _custom(Location(**location), data)
    return checked(Effect(name, Location(**location), data["parameters"]), laws[name].quantities)


def _custom(location: Location, data: Mapping[str, Any]) -> Effect:
    """An effect whose law is data."""
    try:
        law = custom_law.read_law(data["law"], data["parameters"], location.kind)
        values = {name: number(value, f"parameter {name}") for name, value in data["parameters"].items()}
    except LawError as error:
        raise EffectError(f"custom at {location}: {error}") from error
    return Effect(custom_law.NAME, location, values, law)


def checked(effect: Effect, quantities: Sequence[Quantity]) -> Effect:
    """The effect with every parameter of its law; one that is missing has its typical value, if that is absolute."""
    given, known = effect.parameters, {q.name: q for q in quantities}
    if not isinstance(given, Mapping):
        raise EffectError(f"parameters of {effect.name} are {brief(given)}; expected numbers by name")
    if unknown := sorted(set(given) - set(known), key=str):
        raise EffectError(f"{effect.name} has no {brief(unknown[0])}; it has {', '.join(known)}")
    values = {}
    for q in quantities:
        if q.name not in given and q.of not in (None, "mass"):
            raise EffectError(f"{effect.name} needs its {q.name} [{q.unit}]")
        value = given.get(q.name, q.typical)
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
        if not number or not q.bounds[0] <= value <= q.bounds[1]:
            low, high = q.bounds
            raise EffectError(f"{q.name} of {effect.name} is {brief(value)}; allowed is {low:g} to {high:g} {q.unit}")
        values[q.name] = float(value)
    return Effect(effect.name, effect.location, values)


def save_effects(effects: Sequence[Effect], path: str | Path) -> None:
    """Write an effects file (JSON)."""
    write_json(path, {"schema": SCHEMA, "effects": [effect.to_json() for effect in effects]})


def load_effects(path: str | Path, laws: Mapping[str, type[Acting]]) -> tuple[Effect, ...]:
    """Read an effects file with effects of some laws (as of ``effect_from``); EffectError says what is wrong."""
    try:
        data = read_json(path)
    except (ValueError, RecursionError) as error:
        raise EffectError(f"{path} is no effects file: {error}") from error
    known = isinstance(data, dict) and data.get("schema") in (SCHEMA, OLD_SCHEMA)
    if not known or not isinstance(data.get("effects"), list):
        raise EffectError(f"{path} is no effects file: its schema has to be {SCHEMA}, with a list of effects")
    if len(data["effects"]) > MAX_EFFECTS:
        raise EffectError(f"{path} has {len(data['effects'])} effects; at most {MAX_EFFECTS} are allowed")
    found = []
    for i, item in enumerate(data["effects"], 1):
        try:
            found.append(effect_from(item, laws))
        except EffectError as error:
            raise EffectError(f"{path}, effect {i}: {error}") from error
    return tuple(found)
