"""The grammar of laws outside the catalogue: terms in what a location, its neighbours, commands and time do."""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DiscoverySettings
from soro_bench.effects.custom_law import Memory, Place, Variable
from soro_bench.effects.effect import Location
from soro_bench.effects.expression import Node, evaluated

_FAR = 1e6  # s or m, of ranges that are not known yet
_LONGEST = 18  # characters of a variable; what is named after it adds six at most, and a name in a law has 24
# where fits of shapes begin: s, of lags and Maxwell elements; shares of a range of position, of play and hysteresis;
# periods in that range; and shares of a range of velocity, in which the sign of a law changes
_TIMES, _WIDTHS, _WAVES, _SMOOTHINGS = (0.1, 0.3, 1.0), (0.05, 0.2), (1.0, 1.5, 2.0, 3.0), (0.005, 0.02)
_OWN = {"position": "q", "velocity": "v"}
_OTHER = {"position": "q", "velocity": "v", "command": "u", "force": "f"}


@dataclass(frozen=True)
class Shape:
    """A parameter that shapes a term: where its fit begins, its unit, and whether it stays positive."""

    name: str
    value: float
    unit: str
    positive: bool = True
    deviation: float = 0.0  # of its prior, where it may have any sign


@dataclass(frozen=True)
class Term:
    """A term of a law without its coefficient.

    expression: of names of variables, states and shapes. unit: of it.
    """

    expression: Node
    unit: str
    variables: tuple[Variable, ...] = ()
    states: tuple[Memory, ...] = ()
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class Read:
    """A variable with its values (T,) in the control steps of all recordings, and its unit."""

    variable: Variable
    values: Floats
    unit: str

    @property
    def name(self) -> str:
        """Of the variable."""
        return self.variable.name

    @property
    def span(self) -> float:
        """But for the extreme percent, half of the range of a position, which may be far from zero, and how far from
        zero others go."""
        low, high = np.quantile(self.values, (0.01, 0.99))
        half = 0.5 * (high - low) if self.variable.of == "position" else max(abs(low), abs(high))
        return float(max(half, 1e-9))


Group = tuple[Term, ...]  # terms that come together, as the sine and the cosine of a period


def variables_at(robot: Robot, location: Location, settings: DiscoverySettings) -> list[tuple[Variable, str]]:
    """What a law at a location may read, with units: its own motion first.

    Args:
        location: of a joint, tendon, body, actuator, or gravity.
    """
    elements, found = robot.elements, list[tuple[Variable, str]]()
    taken: set[str] = set()

    def add(of: str, name: str, unit: str, place: Place | None, axis: str | None = None) -> None:
        name = _not_taken(name, taken)
        taken.add(name)
        found.append((Variable(name, of, -_FAR, _FAR, place, axis), unit))

    kind = location.kind
    if kind in ("joint", "tendon"):
        unit = "rad" if elements.turns(location) else "m"
        for of, name in _OWN.items():
            add(of, name, unit if of == "position" else f"{unit}/s", None)
    elif kind == "body":
        for axis in "xyz":
            add("position", axis, "m", None, axis)
            add("velocity", f"v{axis}", "m/s", None, axis)
    like = "joint" if kind in ("joint", "actuator", "model") else "tendon" if kind == "tendon" else ""
    others = [each for each in (elements.locations(like) if like else []) if each != location]
    if len(others) <= settings.elements:
        for each in others:
            unit = "rad" if elements.turns(each) else "m"
            for of in _OWN:
                place = Place(each.kind, each.name)
                add(of, _named(of, each.name), unit if of == "position" else f"{unit}/s", place)
    actuators = elements.locations("actuator")[: settings.elements]
    for each in actuators:
        add("command", _named("command", each.name), robot.setpoint_unit_at(each), Place("actuator", each.name))
    for each, unit in zip(actuators, robot.force_units, strict=False):
        add("force", _named("force", each.name), unit, Place("actuator", each.name))
    add("time", "t", "s", None)
    return found


def _named(of: str, element: str) -> str:
    return f"{_OTHER[of]}_{re.sub(r'[^0-9A-Za-z]', '_', element)}"[:_LONGEST]


def _not_taken(name: str, taken: set[str]) -> str:
    """The name, or as much of it as there is room for with the first number that makes it another one."""
    numbers = (f"_{k}" for k in itertools.count(2))
    names = itertools.chain([name], (f"{name[: _LONGEST - len(number)]}{number}" for number in numbers))
    return next(each for each in names if each not in taken)


def groups(reads: Sequence[Read], frequencies: Sequence[float]) -> list[Group]:
    """All terms of the grammar.

    Args:
        reads: what the location may read. frequencies: rad/s, of peaks in the spectrum of the input.
    """
    moving = [each for each in reads if each.values.std() > 1e-9]
    by = {each.name: each for each in moving}
    found: list[Group] = [(Term(1.0, "1"),)]
    for each in moving:
        found += [(term,) for term in _of_one(each)]
    time = by.get("t")
    own = [by[name] for name in ("q", "v") if name in by]
    for one, other in _pairs(moving, own):
        found.append((_product(one, other),))
    for each in own:
        found += _memories(each)
        found += _frictions(each, moving)
    for each in moving:
        if each.variable.of in ("position", "command") and each not in own:
            found += _memories(each, lags_only=True)
        if each.variable.of == "position":
            found += _waves(each)
    found += _periodic(time, frequencies) if time else []
    return found


def _simple(read: Read, expression: Node, unit: str, *shapes: Shape) -> Term:
    return Term(expression, unit, (read.variable,), (), shapes)


def _of_one(each: Read) -> Iterator[Term]:
    """Powers, sides and signs of a variable."""
    x, unit = each.name, each.unit
    yield _simple(each, x, unit)
    if each.variable.of == "time":
        times = [float(each.span * share) for share in (0.3, 1.0)]
        for time in times:
            shape = Shape("T", time, "s")
            yield _simple(each, ("exp", ("multiply", -1.0, x, ("power", "T", -1.0))), "1", shape)
        return
    yield _simple(each, ("multiply", x, x), f"{unit}^2")
    yield _simple(each, ("multiply", x, ("abs", x)), f"{unit}^2")
    yield _simple(each, ("multiply", x, x, x), f"{unit}^3")
    yield _simple(each, ("abs", x), unit)
    yield _simple(each, ("positive", x), unit)
    yield _simple(each, ("negative", x), unit)
    if each.variable.of == "velocity":
        for shape in _smooth(each):
            yield _simple(each, ("sign", x, shape.name), "1", shape)


def _smooth(each: Read) -> list[Shape]:
    """Within which a sign changes."""
    return [Shape(f"s_{each.name}", share * each.span, each.unit) for share in _SMOOTHINGS]


def _pairs(moving: Sequence[Read], own: Sequence[Read]) -> Iterator[tuple[Read, Read]]:
    """Variables whose products are tried: the location's own with every other, and time with every other."""
    for one in own:
        for other in moving:
            if other is not one and not (other.name == "q" and one.name == "v"):
                yield one, other
    for each in moving:
        if each.variable.of == "time":
            for other in moving:
                if other.name not in ("q", "v", "t"):
                    yield other, each
    commands = [each for each in moving if each.variable.of == "command"]
    yield from itertools.combinations(commands, 2)


def _product(one: Read, other: Read) -> Term:
    return Term(("multiply", one.name, other.name), f"{one.unit} {other.unit}", (one.variable, other.variable))


def _frictions(own: Read, moving: Sequence[Read]) -> list[Group]:
    """Friction whose size depends on something, and damping that does; ``own`` is a velocity."""
    if own.variable.of != "velocity":
        return []
    found: list[Group] = []
    signs: list[tuple[Node, Shape]] = [(("sign", own.name, each.name), each) for each in _smooth(own)]
    for each in moving:
        if each is own or each.variable.of in ("velocity", "time"):
            continue
        x, both = each.name, (own.variable, each.variable)
        square: Node = ("multiply", x, x)
        sizes: list[Node] = [x, ("abs", x), ("positive", x), square]
        for size in sizes:
            unit = f"{each.unit}^2" if size is square else each.unit
            found += [(Term(("multiply", size, sign), unit, both, (), (shape,)),) for sign, shape in signs]
        found.append((Term(("multiply", square, own.name), f"{each.unit}^2 {own.unit}", both),))
    return found


def _memories(each: Read, lags_only: bool = False) -> list[Group]:
    x, found = each.name, list[Group]()
    for time in _TIMES:
        found.append((_memory("lag", each, Shape(f"T_{x}", time, "s"), each.unit),))
        if not lags_only:
            found.append((_memory("maxwell", each, Shape(f"T_{x}", time, "s"), each.unit),))
    if each.variable.of != "position" or lags_only:
        return found
    for share in _WIDTHS:
        shape = Shape(f"w_{x}", share * each.span, each.unit)
        found.append((_memory("play", each, shape, each.unit),))
        found.append((_memory("bouc_wen", each, shape, "1"),))
    return found


def _memory(of: str, each: Read, shape: Shape, unit: str) -> Term:
    name = f"{of}_{each.name}"
    shape = replace(shape, name=f"{shape.name}_{of}")
    state = Memory(name, of, each.name, shape.name)
    return Term(name, unit, (each.variable,), (state,), (shape,))


def _waves(each: Read) -> list[Group]:
    """Periodic in a position, as cogging is."""
    found = list[Group]()
    for count in _WAVES:
        shape = Shape(f"n_{each.name}", float(np.pi * count / each.span), f"1/{each.unit}")
        turned: Node = ("multiply", shape.name, each.name)
        found.append((_simple(each, ("sin", turned), "1", shape), _simple(each, ("cos", turned), "1", shape)))
    return found


def _periodic(time: Read, frequencies: Sequence[float]) -> list[Group]:
    found = list[Group]()
    for omega in frequencies:
        shape = Shape("omega", float(omega), "rad/s", False, float(np.pi / max(time.span, 1e-9)))
        turned: Node = ("multiply", shape.name, time.name)
        found.append((_simple(time, ("sin", turned), "1", shape), _simple(time, ("cos", turned), "1", shape)))
    return found


def series(term: Term, values: dict[str, Floats], lengths: Sequence[int], dt: float) -> Floats:
    """(T,) of a term along recordings, one after the other.

    Args:
        values: (T,) of variables. lengths: control steps of each recording. dt: s between them.
    """
    names = {**values, **{each.name: np.asarray(each.value) for each in term.shapes}}
    for state in term.states:
        parts = np.split(names[str(state.input)], np.cumsum(lengths)[:-1])
        size = float(names[str(state.parameter)])
        names[state.name] = np.concatenate([_followed(state.of, part, size, dt) for part in parts])
    return np.asarray(np.broadcast_to(evaluated(term.expression, names), (sum(lengths),)), float)


def _followed(of: str, follows: Floats, size: float, dt: float) -> Floats:
    """(T,) a hidden state along one recording; as ``effects.custom`` steps it."""
    found, share = np.zeros(len(follows)), -np.expm1(-dt / size)
    state = 0.0 if of == "bouc_wen" else float(follows[0])
    last = float(follows[0])
    for i, x in enumerate(follows.tolist()):
        if of == "bouc_wen":
            state += (np.sign(x - last) - state) * -np.expm1(-abs(x - last) / size)
        elif of == "play":
            state = min(max(state, x - 0.5 * size), x + 0.5 * size)
        else:
            state += share * (x - state)
        found[i], last = state, x
    return follows - found if of == "maxwell" else found
