"""The library of candidate terms: every law at every location where it may act, with coordinates for fits.

A coordinate is in standard deviations of its prior. Where all magnitudes have coordinate zero, a term does nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.robots.measured import ObservedSignal
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import PriorSettings
from soro_bench.effects.catalogue import ALL, MEASUREMENT, PHYSICS, QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, Location, Quantity
from soro_bench.effects.measurement import MarkerSlip

_OF_CLOCKS = ("sensor_delay", "clock_skew")
PNEUMATIC = ("pressure_leak", "pressure_asymmetry", "supply_coupling")
_DEFAULT = PriorSettings()
_OFFSET_SHARE = 0.02  # of the range of a signal in the recordings: a typical offset of it
_SHARE_REMOVED = 0.5  # of what the model has, at most, that a screened term takes away


@dataclass(frozen=True)
class Term:
    """A law at a location, whose quantities are to be found.

    name: of the law. typical: values of its quantities at this location. magnitudes: which of them are null without the
    effect; the others shape it. idle: quantities of the law that can do nothing here and stay null. settings: widths of
    its priors. removable: 0 for a term that adds; else how much of the first quantity the model has here, which this
    term takes away.
    """

    name: str
    location: Location
    typical: tuple[float, ...]
    magnitudes: tuple[bool, ...]
    idle: frozenset[str] = frozenset()
    settings: PriorSettings = _DEFAULT
    removable: float = 0.0

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantities of the law that do something here."""
        return tuple(q for q in QUANTITIES[self.name] if q.name not in self.idle)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.typical)

    @property
    def deviations(self) -> Floats:
        """(size,) standard deviations of the priors: of magnitudes in their units, of others in logarithms.

        That of a magnitude with an end, as a share has, is at most its distance from null: wider samples would lie at
        both ends only.
        """
        found = np.full(self.size, self.settings.shape_deviation)
        for i, (q, typical) in enumerate(zip(self.quantities, self.typical, strict=True)):
            if self.magnitudes[i]:
                low, high = self._ends(q)
                wide = self.settings.magnitude_deviation * (typical - q.null)
                found[i] = max(wide, low - q.null) if q.null == high else wide
                found[i] = min(wide, high - q.null) if q.null == low else found[i]
        return found

    def _ends(self, q: Quantity) -> tuple[float, float]:
        """Between which values a quantity is: those of a term that takes away are below null."""
        if not q.takes:
            return q.bounds
        return (max(q.null - self.removable, q.bounds[0]), q.null) if self.removable else (q.null, q.bounds[1])

    @property
    def simulated(self) -> Floats:
        """(size,) coordinates of the effect with typical magnitudes."""
        null = np.array([q.null for q in self.quantities])
        return np.where(self.magnitudes, (np.array(self.typical) - null) / self.deviations, 0.0)

    @property
    def bounds(self) -> Floats:
        """(2, size) least and largest coordinates. Beyond them quantities stay at their bounds, and a Jacobian is 0."""
        found, columns = [], zip(self.quantities, self.typical, self.magnitudes, self.deviations, strict=True)
        limit = self.settings.limit
        for q, typical, magnitude, deviation in columns:
            ends = np.array(self._ends(q))
            if magnitude:
                found.append(np.sort((ends - q.null) / deviation))
            else:
                with np.errstate(divide="ignore"):  # the logarithm of zero
                    found.append(np.clip(np.log(ends / typical) / deviation, -limit, limit))
        return np.array(found).T

    def effect(self, x: Floats) -> Effect:
        """The effect at coordinates x (size,)."""
        values = {q.name: q.null if q.bounds[0] <= q.null else q.typical for q in QUANTITIES[self.name]}
        moved = self.deviations * x
        for q, typical, magnitude, by in zip(self.quantities, self.typical, self.magnitudes, moved, strict=True):
            values[q.name] = float(np.clip(q.null + by if magnitude else typical * np.exp(by), *self._ends(q)))
        return Effect(self.name, self.location, values)

    def parts(self, x: Floats) -> list[tuple["Term", Floats]]:
        """Terms of one effect each, with their coordinates: this one, or those of all elements (spread_terms.py)."""
        return [(self, x)]

    def deviations_of_parts(self, covariance: Floats) -> list[Floats]:
        """Standard deviations of the coordinates of each part.

        Args:
            covariance: (size, size) of the coordinates of this term.
        """
        return [np.sqrt(np.diag(covariance))]

    def effects(self, x: Floats) -> list[Effect]:
        """The effects at coordinates x (size,)."""
        return [one.effect(part) for one, part in self.parts(x)]

    def coordinates(self, values: Mapping[str, float]) -> Floats:
        """(size,) coordinates at which ``effect`` has these values; zero for quantities without one."""
        found, columns = [], zip(self.quantities, self.typical, self.magnitudes, self.deviations, strict=True)
        for q, typical, magnitude, deviation in columns:
            value = values.get(q.name, q.null if magnitude else typical)
            found.append(((value - q.null) if magnitude else np.log(value / typical)) / deviation)
        return np.array(found)


def effects_at(x: Floats, terms: Sequence[Term]) -> list[Effect]:
    """The effects of some terms at the coordinates x (n,) of all of them."""
    pairs = zip(terms, slices(terms), strict=True)
    return [effect for term, part in pairs for effect in term.effects(x[part])]


def slices(terms: Sequence[Term], first: int = 0) -> list[slice]:
    """Which of the coordinates of all terms belong to each; they begin at index ``first``."""
    ends = np.cumsum([first, *(term.size for term in terms)]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def terms(robot: Robot, settings: PriorSettings = _DEFAULT) -> list[Term]:
    """Every law at every location of the robot that can have it, and every fault of its sensor."""
    found: list[Term] = []
    for name, law in PHYSICS.items():
        if name in PNEUMATIC and not robot.pneumatic:
            continue
        for kind in law.kinds:
            locations = [] if kind == "joint" and "body" in law.kinds else robot.locations(kind)
            locations += robot.welded() if law.welded and kind == "body" else []
            every = [Location(kind, EVERY)] if law.shared and len(locations) > 1 else []
            possible = _possible(robot, name, every if every and law.only_shared else every + locations, settings)
            found += [each for one in possible for each in variants(one)]
            found += _removals(robot, [one for one in possible if one.location.name != EVERY])
    for name, fault in MEASUREMENT.items():
        if name == "outliers":
            continue
        for signal in robot.signals:
            if _has_fault(robot, signal, name):
                indices: Sequence[int | None] = range(signal.shape[0]) if fault.local else [None]
                found += [term(robot, name, Location("sensor", signal.name, i), settings) for i in indices]
        if robot.others and name in _OF_CLOCKS:  # one logger may have recorded all signals
            found.append(term(robot, name, Location("sensor", EVERY), settings))
    return found


def within(candidates: Sequence[Term], longest: float) -> list[Term]:
    """The candidates, with slips that are not after the middle of the longest recording [s]: later ones show little."""
    latest = round(0.5 * longest, 3)  # ms: ends of control steps are sums
    return [
        replace(one, typical=(*one.typical[:-1], min(one.typical[-1], latest))) if one.name == MarkerSlip.name else one
        for one in candidates
    ]


def _has_fault(robot: Robot, signal: ObservedSignal, name: str) -> bool:
    """Whether a signal may have a fault: the axes of a frame are no points, and only points are in a frame. A clock may
    differ from that of commands, or of other signals."""
    if name in _OF_CLOCKS:
        return robot.has_commands or bool(robot.others)
    if signal in robot.others and (signal.directions or (name == "frame_misalignment" and signal.unit != "m")):
        return False
    return signal.shape[1] == 3 or name != "frame_misalignment"


def _possible(robot: Robot, name: str, locations: Sequence[Location], settings: PriorSettings) -> list[Term]:
    """A law at each of the locations that can have it. All of them are tried at once first, which takes less time."""
    at = [term(robot, name, location, settings) for location in locations]
    single = [one for one in at if one.location.name != EVERY] or at
    if robot.accepts([one.effect(np.zeros(one.size)) for one in single]):
        return at
    return [one for one in at if robot.accepts([one.effect(np.zeros(one.size))])]


def _removals(robot: Robot, possible: Sequence[Term]) -> list[Term]:
    """The terms of a law that take away what the model has of it, at each of some locations and at all of them."""
    found, elements = [], robot.elements
    for one in possible:
        if (most := PHYSICS[one.name].removable(elements, one.location)) > 0.0:
            null = one.quantities[0].null
            magnitude = min(abs(one.typical[0] - null), _SHARE_REMOVED * most)
            shapes = frozenset(q.name for q in one.quantities[1:])  # what is taken away has none
            found.append(
                Term(one.name, one.location, (null - magnitude,), (True,), one.idle | shapes, one.settings, most)
            )
    if len(found) < 2:
        return found
    largest = max(found, key=lambda each: each.removable)
    every = replace(largest, location=Location(largest.location.kind, EVERY))
    return [every, *found] if robot.accepts([typical(every)]) else found


def late(robot: Robot, name: str, location: Location) -> bool:
    """Whether an effect delays all commands or all measurements. The two are indistinguishable: either way the motion
    is measured late after its command."""
    all_actuators = location.name == EVERY or robot.locations("actuator") == [location]
    all_signals = location.name == EVERY or not robot.others
    return (name == "sensor_delay" and all_signals) or (name == "actuator_delay" and all_actuators)


def term(robot: Robot, name: str, location: Location, settings: PriorSettings = _DEFAULT) -> Term:
    """The candidate term of a law at a location, with the magnitudes that are typical there."""
    physics, elements = name in PHYSICS, robot.elements
    one = robot.locations(location.kind)[0] if physics and location.name == EVERY else location
    signal = robot.observed(location)
    idle = PHYSICS[name].idle(elements, one) if physics else MEASUREMENT[name].idle(signal.shape[1])
    typical, magnitudes = [], []
    for i, q in enumerate(ALL[name].quantities):
        if q.name not in idle:
            magnitudes.append(i == 0 or (q.null == 0.0 and q.bounds[0] < 0))
            size = q.typical * (elements.scale(one, q.of) if physics else 1.0)
            of_range = q.unit == "signal" and signal.reach > 0
            typical.append(_OFFSET_SHARE * signal.reach if of_range else size)
    return Term(name, location, tuple(typical), tuple(magnitudes), idle, settings)


def typical(one: Term) -> Effect:
    """The effect with typical magnitudes."""
    return one.effect(one.simulated)


def variants(one: Term) -> list[Term]:
    """A term, and the same law with other values of the quantities that shape its signature."""
    found = [one]
    for i, q in enumerate(one.quantities):
        for value in q.also:
            found.append(replace(one, typical=(*one.typical[:i], value, *one.typical[i + 1 :])))
    return found
