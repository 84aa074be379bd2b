"""Suspects: every effect at every place where it may act, with coordinates in which fits look for its parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from soro_bench.diagnosis.robots.priors import LIMIT
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.catalogue import ALL, PHYSICS, QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, Location, Quantity

MAGNITUDE_DEVIATION, SECOND_DEVIATION = 5.0, 0.7  # of effects: in typical magnitudes at most, in logarithms
PNEUMATIC = ("pressure_leak", "pressure_asymmetry", "supply_coupling")


@dataclass(frozen=True)
class Term:
    """An effect whose parameters are to be found: a law at a port.

    typical: of its quantities, at this port. magnitudes: which of them are null without the effect. idle: quantities of
        the law that can do nothing here; they stay null.
    """

    name: str
    location: Location
    typical: tuple[float, ...]
    magnitudes: tuple[bool, ...]
    idle: frozenset[str] = frozenset()

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Those of the law that do something here."""
        return tuple(q for q in QUANTITIES[self.name] if q.name not in self.idle)

    @property
    def size(self) -> int:
        return len(self.typical)

    @property
    def deviations(self) -> np.ndarray:
        """(size,) standard deviations of the priors: of magnitudes in their units, of others in logarithms.

        A magnitude that ends somewhere, as a share does, is at most as far as that from nothing: clouds that are wider
        than all there is would only see both ends.
        """
        found = np.full(self.size, SECOND_DEVIATION)
        for i, (q, typical) in enumerate(zip(self.quantities, self.typical, strict=True)):
            if self.magnitudes[i]:
                most = q.bounds[1] - q.null if q.null == q.bounds[0] else np.inf
                found[i] = min(MAGNITUDE_DEVIATION * (typical - q.null), most)
        return found

    @property
    def simulated(self) -> np.ndarray:
        """(size,) the coordinates of the effect of typical magnitudes."""
        null = np.array([q.null for q in self.quantities])
        return np.where(self.magnitudes, (np.array(self.typical) - null) / self.deviations, 0.0)

    @property
    def bounds(self) -> np.ndarray:
        """(2, size) the least and the largest coordinates: beyond them the quantities stay at their bounds, so that no
        slope would lead back."""
        found, columns = [], zip(self.quantities, self.typical, self.magnitudes, self.deviations, strict=True)
        for q, typical, magnitude, deviation in columns:
            ends = np.array(q.bounds)
            if magnitude:
                found.append(np.sort((ends - q.null) / deviation))
            else:
                with np.errstate(divide="ignore"):  # the logarithm of zero
                    found.append(np.clip(np.log(ends / typical) / deviation, -LIMIT, LIMIT))
        return np.array(found).T

    def effect(self, x: np.ndarray) -> Effect:
        """The effect at coordinates x (size,), in standard deviations of their priors."""
        values, moved = {q.name: q.null for q in QUANTITIES[self.name]}, self.deviations * x
        for q, typical, magnitude, by in zip(self.quantities, self.typical, self.magnitudes, moved, strict=True):
            values[q.name] = float(np.clip(q.null + by if magnitude else typical * np.exp(by), *q.bounds))
        return Effect(self.name, self.location, values)

    def coordinates(self, values: Mapping[str, float]) -> np.ndarray:
        """(size,) where ``effect`` has these values; zero for quantities without one."""
        found, columns = [], zip(self.quantities, self.typical, self.magnitudes, self.deviations, strict=True)
        for q, typical, magnitude, deviation in columns:
            value = values.get(q.name, q.null if magnitude else typical)
            found.append(((value - q.null) if magnitude else np.log(value / typical)) / deviation)
        return np.array(found)


def effects_at(x: np.ndarray, terms: Sequence[Term]) -> list[Effect]:
    """The suspects with the parameters that the coordinates x stand for."""
    return [term.effect(x[part]) for term, part in zip(terms, slices(terms), strict=True)]


def slices(terms: Sequence[Term], first: int = 0) -> list[slice]:
    """Where each has its coordinates among those of all, which begin at the first one."""
    ends = np.cumsum([first, *(term.size for term in terms)]).tolist()
    return [slice(*pair) for pair in pairwise(ends)]


def terms(robot: Robot) -> list[Term]:
    """Every effect at every port of the robot that can have it, and every fault of its sensor."""
    points, coordinates = robot.shape
    found = []
    for name, law in PHYSICS.items():
        if name in PNEUMATIC and not robot.pneumatic:
            continue
        for kind in law.kinds:
            locations = [] if kind == "joint" and "body" in law.kinds else robot.locations(kind)
            every = [Location(kind, EVERY)] if law.shared and len(locations) > 1 else []
            for one in _possible(robot, name, every if every and law.only_shared else every + locations):
                found += variants(one)
    for name, fault in ALL.items():
        if name not in PHYSICS and name != "outliers" and (coordinates == 3 or name != "frame_misalignment"):
            indices = range(points) if fault.local else [None]
            found += [term(robot, name, Location("sensor", robot.signal, i)) for i in indices]
    return found


def _possible(robot, name, locations) -> list[Term]:
    """A law at those of the ports that can have it; all of them are tried at once first, which takes less time."""
    at = [term(robot, name, location) for location in locations]
    single = [one for one in at if one.location.name != EVERY] or at
    if robot.accepts([one.effect(np.zeros(one.size)) for one in single]):
        return at
    return [one for one in at if robot.accepts([one.effect(np.zeros(one.size))])]


def late(robot: Robot, name: str, location: Location) -> bool:
    """Whether an effect delays all commands or all measurements: either way what follows from a command is measured
    late by as much."""
    all_actuators = location.name == EVERY or robot.locations("actuator") == [location]
    return name == "sensor_delay" or (name == "actuator_delay" and all_actuators)


def term(robot: Robot, name: str, location: Location) -> Term:
    """The candidate term of a law at a location, with the magnitudes that are typical there."""
    one = robot.locations(location.kind)[0] if location.name == EVERY else location
    physics, elements = name in PHYSICS, robot.elements
    idle = ALL[name].idle(elements, one) if physics else ALL[name].idle(robot.shape[1])
    typical, magnitudes = [], []
    for i, q in enumerate(ALL[name].quantities):
        if q.name not in idle:
            magnitudes.append(i == 0 or (q.null == 0.0 and q.bounds[0] < 0))
            typical.append(q.typical * (elements.scale(one, q.of) if physics else 1.0))
    return Term(name, location, tuple(typical), tuple(magnitudes), idle)


def typical(one: Term) -> Effect:
    """The effect of typical magnitudes."""
    return one.effect(one.simulated)


def variants(one: Term) -> list[Term]:
    """A suspect, and those that begin at other values of what shapes the signature."""
    found = [one]
    for i, q in enumerate(one.quantities):
        for value in q.also:
            found.append(replace(one, typical=(*one.typical[:i], value, *one.typical[i + 1 :])))
    return found
