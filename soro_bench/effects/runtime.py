"""Effects at work in N simulations, each with its own."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import DATA_FIELDS, Batch

from soro_bench.arrays import Floats, Ints
from soro_bench.effects.catalogue import PHYSICS, SIMULATED
from soro_bench.effects.custom import Custom, CustomSetpoint, checked_custom
from soro_bench.effects.effect import Effect, EffectError, Location, checked
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law, Scaled
from soro_bench.effects.necks import NECKS
from soro_bench.effects.setpoints import Commands, SetpointLaw

_RANGES = ("actuator_ctrlrange", "actuator_actrange")
_REMEMBERED = ("setpoint", "added", "beyond", "_starts")  # arrays of N rows
_OF_STATE = ("time", "qfrc_applied", "xfrc_applied")  # what laws read or write of MuJoCo's state
_OF_STEP = ("actuator_force", "qfrc_actuator", "qfrc_constraint")  # what of the outputs only a time step computes


class ActiveEffects:
    """The effects of N simulations of one model, which ``instrument`` has prepared.

    Args:
        batch: the simulations; a persistent batch.
    """

    def __init__(self, batch: Batch):
        self.batch: _Once | _Untouched = _Once(batch)
        self.elements = Elements(batch.model)
        self._nominal, self._plastic = batch.model, mujoco.MjData(batch.model).plastic.copy()
        self._fields: set[str] = set()
        self.assign([()] * batch.nsim)

    def assign(self, effects: Sequence[Sequence[Effect]]) -> None:
        """Give simulation i the effects ``effects[i]``; the parameters have to be set again after this.

        Raises:
            EffectError: an effect has no place in the model, comes twice at one, or two need the same spring; those
                before it go on.
        """
        before, fields = dict(vars(self)), set(self._fields)
        try:
            self._assign(effects)
        except EffectError:
            vars(self).update(before)
            self._fields = fields
            raise

    def _assign(self, effects: Sequence[Sequence[Effect]]) -> None:
        by_law: dict[tuple[str, bool], list] = {}  # and whether it needs another class there
        seen = set()
        for row, of_row in enumerate(effects):
            for effect in of_row:
                if effect.name not in SIMULATED:
                    raise EffectError(f"{effect.name} is no physics of the robot; there are {', '.join(PHYSICS)}")
                law = SIMULATED[effect.name]
                complete = checked_custom(effect) if law is Custom else checked(effect, law.quantities)
                if effect.location.kind not in law.kinds:
                    raise EffectError(f"{effect.name} acts on {', '.join(law.kinds)}, not on {effect.location}")
                try:
                    places = self.elements.expand(effect.location, law.elastic, law.welded)
                except EffectError as error:
                    raise EffectError(f"{effect.name}: {error}") from error
                self._check_taken(law, complete, places)
                for location in places:
                    if (row, law, location) in seen and not law.adds:
                        raise EffectError(f"{effect.name} acts twice at {location}; once is allowed")
                    seen.add((row, law, location))
                    other = location.kind == "actuator" if law is Custom else self._on_neck(location)
                    by_law.setdefault((effect.name, other), []).append((row, location, complete))
        refined = self.batch.expanded("opt.timestep")  # the same in all simulations
        self.timestep = float(self._nominal.opt.timestep if refined is None else refined.flat[0])
        self._claimed: dict[tuple[int, int], str] = {}
        self._scaled: dict[str, Scaled] = {}
        others: dict[str, type[Law]] = {**NECKS, Custom.name: CustomSetpoint}
        kinds = [(name, other) for name in SIMULATED for other in (False, True) if (name, other) in by_law]
        self._laws = [(others if other and name in others else SIMULATED)[name](self, by_law[name, other])
                      for name, other in kinds]  # fmt: skip
        self._fields |= {field for law in self._laws for field in law.fields}
        self.filters = [law for law in self._laws if isinstance(law, SetpointLaw)]
        self._stepped = [law for law in self._laws if law.stepped]
        self._prepare_setpoints()
        self._ids: Ints | None = None  # of the last step

    def _check_taken(self, law: type[Law], effect: Effect, locations: Sequence[Location]) -> None:
        """Refuse an effect that takes away what the model has nowhere."""
        if not law.quantities:
            return
        first = law.quantities[0]
        value = effect.parameters[first.name]
        if first.takes and value < first.null and not any(law.removable(self.elements, each) for each in locations):
            raise EffectError(
                f"{first.name} of {law.name} is {value:g}, and the model has nothing to take it from at "
                f"{effect.location}; allowed is {first.null:g} or more"
            )

    def tried(self, effects: Sequence[Effect]) -> "ActiveEffects":
        """What these would be with some effects in one simulation; they, and the simulations, stay as they are.

        Raises:
            EffectError: as ``assign`` does.
        """
        trial = copy.copy(self)  # ``assign`` replaces every attribute, but for the fields, which it adds to
        trial._fields, trial.batch = set(self._fields), _Untouched(self.batch)
        trial.assign([effects, *[()] * (self.batch.nsim - 1)])
        return trial

    @property
    def native(self) -> bool:
        """Whether everything that the effects do is in model fields."""
        return not (self.filters or self._stepped)

    def _on_neck(self, location: Location) -> bool:
        """Whether a body hangs on what precedes it by a flex, not by joints that could have springs."""
        return location.kind == "body" and not len(self.elements.sprung(self.elements.id(location)))

    def claim(self, law: Law, rows: Ints, springs: Ints) -> None:
        """Note that a law uses springs; EffectError if another one does."""
        for key in zip(rows.tolist(), springs.tolist(), strict=True):
            if key in self._claimed:
                raise EffectError(f"{self._claimed[key]} and {law.name} need the same spring")
            self._claimed[key] = law.name

    def scaled(self, name: str) -> None:
        """Note that a law multiplies a model field before every time step."""
        self._scaled.setdefault(name, Scaled(self.batch.expand(name)))

    def change(self, name: str, row: int, location: Location, quantity: str, value: float) -> None:
        """Give a law of setpoints that acts in a simulation another value of a quantity, from the next time step on.
        Others write it to fields once, and have it at several joints.

        Raises:
            EffectError: no such law acts there.
        """
        for law in self.filters:
            for i in np.flatnonzero(law.rows == row):
                if law.name == name and law.locations[i] == location:
                    law.values[quantity][i] = value
                    return
        raise EffectError(f"simulation {row} has no law of setpoints called {name} at {location}")

    def memory(self) -> dict[str, Any]:
        """Copies of what effects go on from: what they remember, and what their laws read of the last time step."""
        read = {name for law in self._laws for name in law.outputs}
        return {
            "own": {name: getattr(self, name).copy() for name in _REMEMBERED},
            "laws": [{name: array.copy() for name, array in _arrays(law).items()} for law in self._laws],
            "outputs": {name: getattr(self.batch, name).copy() for name in sorted(read)},
        }

    def recall(self, memory: Mapping[str, Any]) -> None:
        """Remember what the same effects of as many simulations did."""
        for name, values in memory["own"].items():
            getattr(self, name)[...] = values
        for law, arrays in zip(self._laws, memory["laws"], strict=True):
            own = _arrays(law)
            for name, values in arrays.items():
                own[name][...] = values

    def show(self, memory: Mapping[str, Any]) -> None:
        """Let laws read the last time step of the simulations whose memory this is, until the next time step."""
        for name, values in memory["outputs"].items():
            output = getattr(self.batch, name)
            output.flags.writeable = True  # MuJoCo's own memory, which it writes again in the next time step
            output[...] = values
            output.flags.writeable = False

    def remembered(self, ids: Ints) -> Floats | None:
        """(n, k) numbers that effects of simulations ``ids`` go on from, beside positions, velocities and activations;
        rows of simulations with less to remember end with zeros. None where there are no effects."""
        if not self._laws:
            return None
        rows = [np.concatenate([np.ravel(array[at]) for array, at in self._memories(i)]) for i in ids]
        found = np.zeros((len(rows), max(map(len, rows))))
        for row, numbers in zip(found, rows, strict=True):
            row[: len(numbers)] = numbers
        return found

    def go_on(self, ids: Ints, remembered: Floats) -> None:
        """Let the effects of simulations ``ids`` remember what the same effects did, (n, k) numbers."""
        for i, numbers in zip(ids, remembered, strict=True):
            first = 0
            for array, at in self._memories(i):
                part, writeable = array[at], array.flags.writeable
                array.flags.writeable = True  # of outputs, MuJoCo's own memory as in ``show``
                array[at] = numbers[first : first + np.size(part)].reshape(np.shape(part))
                array.flags.writeable = writeable
                first += np.size(part)

    def _memories(self, row: int) -> Iterator[tuple[np.ndarray, Any]]:
        """Arrays, and where in them is what the effects of a simulation go on from."""
        yield from ((getattr(self, name), row) for name in _REMEMBERED)
        yield from ((getattr(self.batch, name), row) for name in _OF_STATE)
        for law in self._laws:
            yield from law.remembered(law.rows == row)
        read = {name for law in self._laws for name in law.outputs}
        yield from ((getattr(self.batch, name), row) for name in _OF_STEP if name in read)

    def restore(self, ids: Ints) -> None:
        """Model fields that effects changed become nominal again."""
        for field in self._fields:
            nominal = getattr(self._nominal.opt, field[4:]) if field.startswith("opt.") else getattr(
                self._nominal, field)  # fmt: skip
            self.batch.expand(field)[ids] = nominal

    def write(self, ids: Ints) -> None:
        """Change model fields of simulations ``ids``, whose parameters have just been set."""
        for law in self._laws:
            law.write(np.isin(law.rows, ids))
        for scaled in self._scaled.values():
            scaled.keep(ids)
        for field in _RANGES:
            if (values := self.batch.expanded(field)) is not None:
                self.ranges[field][ids] = values[ids]
        if self.filters:  # a setpoint may move faster and farther than commands may
            rows, actuators = self.touched_in(ids)
            # the activation of others than integrators is MuJoCo's own
            for field, chosen in zip(_RANGES, (np.full(len(rows), True), self.integrates[actuators]), strict=True):
                self.batch.expand(field)[rows[chosen], actuators[chosen]] = (-1e9, 1e9)

    def reset(self, ids: Ints) -> None:
        """Begin an episode in simulations ``ids``, whose state is complete."""
        # as after a reset of the simulation too, where an episode begins from a given state
        self.batch.time[ids], self.batch.plastic[ids] = 0.0, self._plastic
        self.added[ids], self._starts[ids] = 0.0, True
        for law in self._laws:
            law.reset(np.isin(law.rows, ids))

    def step(self, ids: Ints, nstep: int, stage: int) -> None:
        """Advance simulations ``ids`` as ``Batch.step`` does."""
        if self.native:
            self.batch.step(ids, nstep=nstep, stage=stage)
            return
        asked = self.batch.ctrl[ids]
        self._choose(ids)
        if self.filters:
            self._start(ids[self._starts[ids]])
            self._commands.hold()
        reads, nothing = any(law.outputs for law in self._stepped), mujoco.mjtStage.mjSTAGE_NONE
        for left in range(nstep - 1, -1, -1):
            if self.filters:
                self._commands.step()
            for scaled in self._scaled.values():
                scaled.begin(ids)
            for law in self._stepped:
                law.step(self._which[law])
            # forward stages at the new state only where they are read: a persistent batch reuses them, but not
            # once a law has written a field
            between = mujoco.mjtStage.mjSTAGE_VEL if reads else nothing
            self.batch.step(ids, stage=between if left or stage == nothing else stage)
        self.batch.ctrl[ids] = asked

    def _choose(self, ids: Ints) -> None:
        """Look up the effects in simulations ``ids``, which are mostly those of the last step."""
        if self._ids is None or not np.array_equal(ids, self._ids):
            self._ids = ids.copy()
            self._which = {law: np.isin(law.rows, ids) for law in self._stepped}
            self._commands = Commands(self, ids)

    def _start(self, ids: Ints) -> None:
        """The first setpoints of an episode: the activation, or where it is none the first control."""
        control = self.batch.ctrl[ids]
        activation = self.batch.act[ids][:, self.slot] if self.batch.model.na else control
        self.setpoint[ids], self._starts[ids] = np.where(self.integrates, activation, control), False
        for law in self.filters:
            which = np.isin(law.rows, ids)
            law.start(which, self.setpoint[law.rows[which], law.ids[which]])

    def _prepare_setpoints(self) -> None:
        model = self.batch.model
        self.integrates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        # where the control is a rate, the setpoint is the activation; the slot of others is not used
        self.slot = np.maximum(model.actuator_actadr, 0)
        # asked for; and what the laws have added to it, summed over time [s] since the reset
        self.setpoint, self.added = np.zeros((2, self.batch.nsim, model.nu))
        # of the time step at hand, before laws change it; of actuators that have laws
        self.unchanged = np.zeros_like(self.setpoint)
        # how far beyond their ends activations would have gone in the last time step
        self.beyond = np.zeros_like(self.setpoint)
        self._starts = np.ones(self.batch.nsim, bool)
        self._touched = np.zeros((self.batch.nsim, model.nu), bool)
        for law in self.filters:
            self._touched[law.rows, law.ids] = True
        if self.filters:
            self._check_actuators(np.flatnonzero(self._touched.any(axis=0)))
        # as models and parameters have them
        self.ranges = {name: np.tile(getattr(model, name), (self.batch.nsim, 1, 1)) for name in _RANGES}
        if self.filters:
            self._fields |= set(_RANGES)

    def _check_actuators(self, touched: Ints) -> None:
        """Refuse laws of setpoints at actuators that they cannot act on."""
        model = self.batch.model
        if (several := np.flatnonzero(model.actuator_ctrlnum != 1)).size:
            raise EffectError(f"no law changes setpoints of this model: actuator {model.actuator(several[0]).name} has "
                              f"{model.actuator_ctrlnum[several[0]]} controls")  # fmt: skip
        for i in touched:
            if self.integrates[i] and model.actuator_delay[i] > 0:
                raise EffectError(f"no law changes the setpoint of actuator {model.actuator(i).name}: it integrates "
                                  "its control after a delay of its own")  # fmt: skip

    def within(self, name: str, rows: Ints, actuators: Ints, values: Floats) -> Floats:
        """(n,) controls or activations within their ranges, before laws widened these.

        Args:
            name: "ctrl" or "act".
        """
        limited = getattr(self.batch.model, f"actuator_{name}limited")[actuators].astype(bool)
        return np.where(limited, np.clip(values, *self.ranges[f"actuator_{name}range"][rows, actuators].T), values)

    def without_laws(self, row: int, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Give copies of a simulation's model and data the ranges and activations that commands have before laws of
        setpoints change them."""
        for name, values in self.ranges.items():
            getattr(model, name)[...] = values[row]
        own = self._touched[row] & self.integrates
        data.act[self.slot[own]] = self.setpoint[row, own]

    def asked(self, rows: Ints, actuators: Ints) -> Floats:
        """(n,) setpoints of the time step at hand as they were commanded, before laws change them."""
        model = self.batch.model
        now = self.within("ctrl", rows, actuators, self.batch.ctrl[rows, actuators])
        if model.na:
            at_start = self.batch.act[rows, self.slot[actuators]]
            at_end = self.within("act", rows, actuators, at_start + self.timestep * now)
            used = np.where(model.actuator_actearly[actuators], at_end, at_start)
            now = np.where(self.integrates[actuators], used, now)
        return np.where(self._touched[rows, actuators], self.unchanged[rows, actuators], now)

    def touched_in(self, ids: Ints) -> tuple[Ints, Ints]:
        """Simulations among ``ids`` and actuators whose setpoints are changed."""
        rows, actuators = np.nonzero(self._touched)
        chosen = np.isin(rows, ids)
        return rows[chosen], actuators[chosen]


def _arrays(law: Law) -> dict[str, np.ndarray]:
    """All arrays of a law, its parameters too."""
    arrays = {name: value for name, value in vars(law).items() if isinstance(value, np.ndarray)}
    return {**arrays, **{f"values of {name}": values for name, values in law.values.items()}}


class _Once:
    """A batch whose fields are looked up once; itself it makes a view of the state each time that it is asked for."""

    def __init__(self, batch: Batch):
        self._batch = batch

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._batch, name)
        if name in DATA_FIELDS:
            setattr(self, name, found)
        return found


class _Untouched:
    """A batch that can be read: what laws would prepare in it is left out, and fields are copies."""

    def __init__(self, batch: "_Once | _Untouched"):
        self._batch = batch

    def __getattr__(self, name: str) -> Any:
        return getattr(self._batch, name)

    def bind(self, name: str) -> None:
        """Prepare nothing for a field that is read."""

    def expand(self, name: str) -> Floats:
        """A copy of a field's values."""
        found = self._batch.expanded(name)
        return np.array(attrgetter(name)(self._batch.model)[None] if found is None else found)
