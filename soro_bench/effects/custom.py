"""Custom laws at work: forces, moments and offsets that are data (custom_law.py), in N simulations at once.

Entries with the same expression are evaluated together, so a law costs as much at one location as at all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.custom_law import AXES, KINDS, NAME, CustomLaw, Memory, Variable
from soro_bench.effects.effect import Effect, EffectError, Location
from soro_bench.effects.elements import Elements
from soro_bench.effects.expression import bounded, evaluated
from soro_bench.effects.law import Law
from soro_bench.effects.setpoints import SetpointLaw

if TYPE_CHECKING:
    from soro_bench.effects.runtime import ActiveEffects

_ACCELERATION = 0.02  # s, time constant of the filter of accelerations, which are differences of velocities
_SLOTS = 3  # numbers that a variable or a state may remember
_NEEDS = {  # data fields that are read beside the state
    ("position", "tendon"): "ten_length",
    ("velocity", "tendon"): "ten_velocity",
    ("acceleration", "tendon"): "ten_velocity",
    ("force", "actuator"): "actuator_force",
}


class _Custom(Law):
    """What custom laws have in common: ``exerted`` evaluates them."""

    name, category, kinds = NAME, "outside_catalogue", KINDS
    quantities = ()
    stepped, adds, welded = True, True, True
    remembers: ClassVar[tuple[str, ...]] = ("memory", "fresh")

    def __init__(self, run: "ActiveEffects", entries: Sequence[tuple[int, Location, Effect]]):
        self._effects = [effect for _, _, effect in entries]
        self.outputs = tuple(sorted({name for _, at, effect in entries for name in _read(effect, at)}))  # type: ignore[misc]
        super().__init__(run, entries)

    def prepare(self, elements: Elements) -> None:
        # of gravity there is one, which has no number
        self.ids = np.array([-1 if at.kind == "model" else elements.id(at) for at in self.locations])
        members: dict[tuple[CustomLaw, str], list[int]] = {}
        for i, (effect, location) in enumerate(zip(self._effects, self.locations, strict=True)):
            members.setdefault((_law(effect), location.kind), []).append(i)
        self.groups = [_Group(self, elements, law, kind, np.array(own)) for (law, kind), own in members.items()]
        slots = max((len(each.law.variables) + len(each.law.states) for each in self.groups), default=0)
        self.memory = np.zeros((len(self.rows), max(slots, 1), _SLOTS))
        self.fresh = np.ones(len(self.rows), bool)
        self._chosen: tuple[Bools, list[Ints]] | None = None

    def reset(self, which: Bools) -> None:
        self.memory[which], self.fresh[which] = 0.0, True

    def chosen(self, which: Bools) -> list[Ints]:
        """Of each group, which of its entries are among ``which``; mostly the same as in the last time step."""
        if self._chosen is None or self._chosen[0] is not which:
            self._chosen = which, [np.flatnonzero(which[group.entries]) for group in self.groups]
        return self._chosen[1]


def _law(effect: Effect) -> CustomLaw:
    assert isinstance(effect.law, CustomLaw)
    return effect.law


def _read(effect: Effect, location: Location) -> list[str]:
    """Data fields that an effect reads."""
    found = ["ten_J"] if location.kind == "tendon" else []
    if isinstance(_law(effect).direction, tuple):
        found.append("xipos")
    for each in _law(effect).variables:
        kind = each.place.kind if each.place else location.kind
        if kind == "body" and each.of != "time":
            found.append("xipos")
        elif (each.of, kind) in _NEEDS:
            found.append(_NEEDS[each.of, kind])
    return found


@dataclass(frozen=True)
class _Source:
    """A variable of a group: a kind of location, and of each entry the element that is read."""

    variable: Variable
    kind: str
    ids: Ints


class _Group:
    """Entries of one law at one kind of location."""

    def __init__(self, of: _Custom, elements: Elements, law: CustomLaw, kind: str, entries: Ints):
        self.of, self.law, self.entries = of, law, entries
        self.rows, self.ids = of.rows[entries], of.ids[entries]
        given = [of._effects[i].parameters for i in entries]
        names = [name for name in given[0] if all(name in each for each in given)]  # one may have more than the law has
        self.parameters = {name: np.array([each[name] for each in given]) for name in names}
        self.sources = [self._source(elements, each, kind) for each in law.variables]

    def _source(self, elements: Elements, variable: Variable, kind: str) -> _Source:
        if variable.place is None:
            return _Source(variable, kind, self.ids)
        place = Location(variable.place.kind, variable.place.name)
        (found,) = elements.expand(place, welded=True)[:1]
        return _Source(variable, place.kind, np.full(len(self.rows), elements.id(found)))

    @np.errstate(all="ignore")  # of numbers that are too large, which are bounded
    def exerted(self, some: Ints) -> Floats:
        """(n,) what the law exerts in some of the entries, which step on."""
        values = {name: each[some] for name, each in self.parameters.items()}
        entries, fresh = self.entries[some], self.of.fresh[self.entries[some]]
        for slot, source in enumerate(self.sources):
            of = source.variable
            read = self._read(source, some, values, self.of.memory[:, slot], entries, fresh)
            values[of.name] = np.minimum(np.maximum(read, of.low), of.high)
        first = len(self.sources)
        for slot, state in enumerate(self.law.states, first):
            follows = np.broadcast_to(bounded(evaluated(state.input, values)), some.shape)
            memory, size = self.of.memory[:, slot], np.abs(_value(state.parameter, values))
            values[state.name] = _followed(state, follows, np.maximum(size, 1e-9), memory, entries, fresh, self.of.dt)
        self.of.fresh[entries] = False
        limit = self.law.limit
        return np.clip(np.broadcast_to(bounded(evaluated(self.law.expression, values)), some.shape), -limit, limit)

    def _read(
        self, source: _Source, some: Ints, values: dict[str, Floats], memory: Floats, entries: Ints, fresh: Bools
    ) -> Floats:
        """(n,) a variable now."""
        batch, model = self.of.batch, self.of.batch.model
        rows, ids, of = self.rows[some], source.ids[some], source.variable
        if of.of == "time":
            return batch.time[rows]
        if of.of == "command":
            return self.of.run.asked(rows, ids)
        if of.of == "force":
            return batch.actuator_force[rows, ids]
        if of.of == "distance":
            return np.linalg.norm(batch.xipos[rows, ids] - _point(of.point, values), axis=-1)
        if source.kind == "body":
            place = batch.xipos[rows, ids, AXES.index(of.axis or "x")]
            if of.of == "position":
                return place
            velocity = self._rate(place, memory, entries, fresh)
            if of.of == "velocity":
                return velocity
            return self._filtered(np.where(fresh, np.nan, velocity), memory, entries)
        if source.kind == "tendon":
            if of.of == "position":
                return batch.ten_length[rows, ids] - model.tendon_length0[ids]
            velocity = batch.ten_velocity[rows, ids]
        else:
            if of.of == "position":
                return batch.qpos[rows, model.jnt_qposadr[ids]]
            velocity = batch.qvel[rows, model.jnt_dofadr[ids]]
        if of.of == "velocity":
            return velocity
        memory[entries[fresh], 2] = np.nan
        return self._filtered(velocity, memory, entries)

    def _rate(self, value: Floats, memory: Floats, entries: Ints, fresh: Bools) -> Floats:
        """(n,) rates of change since the last time step, 0 in the first one."""
        rate = np.where(fresh, 0.0, (value - memory[entries, 0]) / self.of.dt)
        memory[entries, 0] = value
        return rate

    def _filtered(self, velocity: Floats, memory: Floats, entries: Ints) -> Floats:
        """(n,) filtered rates of change of velocities, 0 until two are known."""
        rate = np.nan_to_num((velocity - memory[entries, 2]) / self.of.dt)
        memory[entries, 1] += -np.expm1(-self.of.dt / _ACCELERATION) * (rate - memory[entries, 1])
        memory[entries, 2] = velocity
        return memory[entries, 1]

    def directions(self, some: Ints) -> Floats:
        """(n, 3) unit vectors of the world, along which it acts."""
        direction = self.law.direction
        if isinstance(direction, str):
            return np.tile(np.eye(3)[AXES.index(direction)], (len(some), 1))
        values = {name: each[some] for name, each in self.parameters.items()}
        way = _point(direction, values) - self.of.batch.xipos[self.rows[some], self.ids[some]]
        return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)


def _value(number: float | str, values: dict[str, Floats]) -> Any:
    return values[number] if isinstance(number, str) else number


def _point(point: Sequence[float | str], values: dict[str, Floats]) -> Floats:
    """(3,) or (n, 3) m."""
    return np.stack(np.broadcast_arrays(*(_value(each, values) for each in point)), axis=-1)


def _followed(
    state: Memory, follows: Floats, size: Floats, memory: Floats, entries: Ints, fresh: Bools, dt: float
) -> Floats:
    """(n,) a hidden state, a time step on: the output of a play, of a first-order lag, the stretch of the spring of a
    Maxwell element, or the share of its largest force that a Bouc-Wen element of exponent one exerts."""
    before, last = memory[entries, 0], memory[entries, 1]
    memory[entries, 1] = follows
    if state.of == "bouc_wen":
        way = np.where(fresh, 0.0, follows - last)
        after = np.where(fresh, 0.0, before) + (np.sign(way) - np.where(fresh, 0.0, before)) * -np.expm1(
            -np.abs(way) / size
        )
    else:
        before = np.where(fresh, follows, before)
        if state.of == "play":
            after = np.clip(before, follows - 0.5 * size, follows + 0.5 * size)
        else:
            after = before - np.expm1(-dt / size) * (follows - before)
    memory[entries, 0] = after
    return follows - after if state.of == "maxwell" else after


class Custom(_Custom):
    """A law that is data, as a force or moment of a joint, a pull of a tendon, a force on a body along an axis or
    towards a point, or an acceleration of everything."""

    remembers = ("memory", "fresh", "pushed")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        for name in ("qfrc_applied", "xfrc_applied"):
            self.batch.bind(name)
        model = self.model
        width = max([3, *(int(model.ten_J_rownnz[i]) for i in np.unique(self.ids[self._at("tendon")]))])
        self.pushed = np.zeros((len(self.rows), width))
        self.of_kind = {kind: own for kind in KINDS if (own := self._at(kind)).any()}
        if any(location.kind == "model" for location in self.locations):
            self.fields = ("opt.gravity",)  # type: ignore[misc]
            self.run.scaled("opt.gravity")

    def _at(self, kind: str) -> Bools:
        return np.array([location.kind == kind for location in self.locations], bool)

    def reset(self, which: Bools) -> None:
        super().reset(which)
        self.pushed[which] = 0.0
        rows, ids = self.rows, self.ids
        for i in np.flatnonzero(which):
            kind = self.locations[i].kind
            if kind == "joint":
                self.batch.qfrc_applied[rows[i], self.model.jnt_dofadr[ids[i]]] = 0.0
            elif kind == "tendon":
                self.batch.qfrc_applied[rows[i], self._columns(ids[i])] = 0.0
            elif kind == "body":
                self.batch.xfrc_applied[rows[i], ids[i], :3] = 0.0

    def _columns(self, tendon: int) -> Ints:
        """Degrees of freedom that a tendon moves."""
        first = self.model.ten_J_rowadr[tendon]
        return self.model.ten_J_colind[first : first + self.model.ten_J_rownnz[tendon]]

    def step(self, which: Bools) -> None:
        value, ways = np.zeros(len(self.rows)), np.zeros((len(self.rows), 3))
        for group, some in zip(self.groups, self.chosen(which), strict=True):
            entries = group.entries[some]
            value[entries] = group.exerted(some)
            if group.law.direction:
                ways[entries] = group.directions(some)
        # in the order of their effects, so that sums do not depend on the laws of other simulations
        for kind, own in self.of_kind.items():
            if len(entries := np.flatnonzero(which & own)):
                self._exert(kind, entries, value[entries], ways[entries])

    def _exert(self, kind: str, entries: Ints, value: Floats, ways: Floats) -> None:
        rows, ids = self.rows[entries], self.ids[entries]
        if kind == "joint":
            more = value - self.pushed[entries, 0]
            self.pushed[entries, 0] = value
            np.add.at(self.batch.qfrc_applied, (rows, self.model.jnt_dofadr[ids]), more)
        elif kind == "tendon":
            for tendon in np.unique(ids):
                self._pull(tendon, ids == tendon, rows, entries, value)
        elif kind == "body":
            push = value[:, None] * ways
            more, self.pushed[entries, :3] = push - self.pushed[entries, :3], push
            np.add.at(self.batch.xfrc_applied[:, :, :3], (rows, ids), more)
        else:  # every time step begins with the model's own gravity
            np.add.at(self.field("opt.gravity"), rows, value[:, None] * ways)

    def _pull(self, tendon: int, own: Bools, rows: Ints, entries: Ints, value: Floats) -> None:
        """Shorten a tendon by a force."""
        columns, first = self._columns(tendon), self.model.ten_J_rowadr[tendon]
        jacobian = self.batch.ten_J[rows[own], first : first + len(columns)]
        push = -value[own, None] * jacobian
        before = self.pushed[entries[own], : len(columns)]
        np.add.at(self.batch.qfrc_applied, (rows[own][:, None], columns[None]), push - before)
        self.pushed[entries[own], : len(columns)] = push


class CustomSetpoint(_Custom, SetpointLaw):  # type: ignore[misc]
    """A law that is data, as an offset of a setpoint."""

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.actuators = np.unique(self.rows * self.model.nu + self.ids, return_inverse=True)[1]

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        added = np.zeros(len(self.rows))
        for group, some in zip(self.groups, self.chosen(which), strict=True):
            added[group.entries[some]] = group.exerted(some)
        return setpoint + np.bincount(self.actuators, added)[self.actuators[which]]  # several add up

    def step(self, which: Bools) -> None:
        """Nothing: it acts on setpoints, and reads the state as laws that step do."""


def checked_custom(effect: Effect) -> Effect:
    """The effect, whose law is data; EffectError where it lacks one, or a parameter that its law names."""
    if not isinstance(effect.law, CustomLaw):
        raise EffectError("custom has no law; an effects file gives it one under the key law")
    if missing := sorted({name for name, _ in effect.law.units} - set(effect.parameters)):
        raise EffectError(f"custom at {effect.location} lacks its parameter {missing[0]}")
    return replace(effect, parameters={name: float(value) for name, value in effect.parameters.items()})
