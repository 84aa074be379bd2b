"""Laws between a command and what the actuator makes of it.

They act on the setpoint: what an actuator is asked to be at, which is its activation where the control is a rate, and
the control otherwise. Those that change the actuator's force act on MuJoCo's own gains.
"""

from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import EffectError, Location, Quantity
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law, per_row
from soro_bench.effects.springs import INFINITE

if TYPE_CHECKING:
    from soro_bench.effects.runtime import ActiveEffects

_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
_SOFTEST = 0.1  # of 1 + k c: a servo that is ten times stiffer than its model
_HIGHEST = 9.0  # of its limit, by which an actuator may be stronger


def _shortest(model: mujoco.MjModel, actuator: int) -> float:
    """s, the shortest time constant of a filter that stays stable."""
    return float(model.opt.timestep) if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_FILTER else 0.0


class SetpointLaw(Law):
    """A causal law from setpoints to setpoints; ``filter`` is called before every time step."""

    kinds = ("actuator",)

    def start(self, which: Bools, setpoint: Floats) -> None:
        """Begin an episode at setpoints (n,)."""

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        """(n,) setpoints of the coming time step for those that were asked for."""
        raise NotImplementedError


class _Following(SetpointLaw):
    """A law whose output remembers where it was, ``output`` (n,)."""

    remembers: ClassVar[tuple[str, ...]] = ("output",)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.output = np.zeros(len(self.rows))

    def start(self, which: Bools, setpoint: Floats) -> None:
        self.output[which] = setpoint


class ActuatorGain(SetpointLaw):
    """The actuator goes gain times as far as it is told: a drum of another radius, a broken cable."""

    name, category = "actuator_gain", "static_error"
    quantities = (Quantity("gain", "1", 0.85, (0.0, 10.0), null=1.0),)
    shared = True

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        return self.values["gain"][which] * setpoint


class Pretension(SetpointLaw):
    """A constant offset of the setpoint: a cable mounted too short or too long."""

    name, category = "pretension", "static_error"
    quantities = (Quantity("offset", "setpoint", 1.0, (-np.inf, np.inf), of="length"),)

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        return setpoint + self.values["offset"][which]


class ActuatorDeadband(SetpointLaw):
    """Nothing happens until the setpoint leaves a zone around zero."""

    name, category = "actuator_deadband", "hysteresis_or_play"
    quantities = (Quantity("width", "setpoint", 1.0, (0.0, np.inf), of="length"),)
    shared = True

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        return setpoint - np.clip(setpoint, -self.values["width"][which], self.values["width"][which])


class Backlash(_Following):
    """Play: after a reversal the output waits until the setpoint has come back by the width."""

    name, category = "backlash", "hysteresis_or_play"
    quantities = (Quantity("width", "setpoint", 1.0, (0.0, np.inf), of="length"),)
    shared = True

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        half = self.values["width"][which] / 2
        self.output[which] = np.clip(self.output[which], setpoint - half, setpoint + half)
        return self.output[which]


class LostMotion(SetpointLaw):
    """Play between a servo and what it moves: within it no force holds, beyond it the servo's own, as if it were asked
    to be at the nearest end. Unlike backlash it shows under a load while the setpoint is constant."""

    name, category, stepped = "lost_motion", "hysteresis_or_play", True
    quantities = (Quantity("width", "m or rad", 0.2, INFINITE, of="length"),)
    outputs = ("actuator_length",)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        model, ids = self.model, self.ids
        servo = (model.actuator_gaintype[ids] == mujoco.mjtGain.mjGAIN_FIXED) & (model.actuator_dyntype[ids] == 0)
        gain = model.actuator_gainprm[ids, 0]
        if not (servo & (gain > 0) & np.isclose(model.actuator_biasprm[ids, 1], -gain)).all():
            raise EffectError(f"{self.name} acts on servos of positions: forces of k (setpoint - length)")

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        half = self.values["width"][which] / 2
        length = self.batch.actuator_length[self.rows[which], self.ids[which]]
        return np.clip(length, setpoint - half, setpoint + half)


class ActuatorLag(_Following):
    """The setpoint is followed with a first-order lag; a negative one takes away from a filter of the model."""

    name, category, shared = "actuator_lag", "timing", True
    quantities = (Quantity("time_constant", "s", 0.015, (-1e3, 1e3), takes=True),)
    fields: ClassVar = ("actuator_dynprm",)

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        model, i = elements.model, elements.id(location)
        filters = model.actuator_dyntype[i] in _FILTERS and model.actuator_actnum[i] == 1
        return max(float(model.actuator_dynprm[i, 0]) - _shortest(model, i), 0.0) if filters else 0.0

    def write(self, which: Bools) -> None:
        for i in np.flatnonzero(which & (self.values["time_constant"] < 0.0)):
            constant, at = self.field("actuator_dynprm"), (self.rows[i], self.ids[i], 0)
            if self.model.actuator_dyntype[self.ids[i]] in _FILTERS:  # of all actuators some may have none
                shorter = constant[at] + self.values["time_constant"][i]
                constant[at] = max(shorter, _shortest(self.model, self.ids[i]))

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        tau = self.values["time_constant"][which]
        share = np.where(tau > 0, -np.expm1(-self.dt / np.maximum(tau, 1e-9)), 1.0)
        moved = self.output[which] + share * (setpoint - self.output[which])
        self.output[which] = np.where(tau > 0, moved, setpoint)
        return self.output[which]


class ActuatorDelay(SetpointLaw):
    """The setpoint arrives later; between two time steps it is interpolated. A negative delay takes away from that of
    the model."""

    name, category, shared = "actuator_delay", "timing", True
    remembers = ("buffer", "next")
    quantities = (Quantity("delay", "s", 0.015, (-2.0, 2.0), takes=True),)
    fields: ClassVar = ("actuator_delay",)

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        return float(elements.model.actuator_delay[elements.id(location)])

    def write(self, which: Bools) -> None:
        for i in np.flatnonzero(which & (self.values["delay"] < 0.0)):
            delay, at = self.field("actuator_delay"), (self.rows[i], self.ids[i])
            delay[at] = max(delay[at] + self.values["delay"][i], 0.0)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        steps = np.maximum(self.values["delay"], 0.0) / self.dt
        self.whole = np.floor(steps + 1e-9).astype(int)
        self.part = np.maximum(steps - self.whole, 0.0)
        self.buffer = np.zeros((len(self.rows), int(self.whole.max(initial=0)) + 2))
        self.next = np.zeros(len(self.rows), int)

    def start(self, which: Bools, setpoint: Floats) -> None:
        self.buffer[which] = setpoint[:, None]

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        entries, size = np.flatnonzero(which), self.buffer.shape[1]
        now, part = self.next[entries], self.part[entries]
        self.buffer[entries, now] = setpoint
        newer = self.buffer[entries, (now - self.whole[entries]) % size]
        older = self.buffer[entries, (now - self.whole[entries] - 1) % size]
        self.next[entries] = (now + 1) % size
        return np.where(part > 0, (1.0 - part) * newer + part * older, newer)


class _Pneumatic(_Following):
    """A law of a chamber that is filled through a supply: an actuator whose control is the rate of its activation."""

    shared, remembers = True, ("output", "asked")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        if (self.model.actuator_dyntype[self.ids] != mujoco.mjtDyn.mjDYN_INTEGRATOR).any():
            raise EffectError(f"{self.name} acts on actuators that integrate their control, such as chambers")
        self.asked = np.zeros(len(self.rows))

    def start(self, which: Bools, setpoint: Floats) -> None:
        super().start(which, setpoint)
        self.asked[which] = setpoint

    def filter(self, which: Bools, setpoint: Floats) -> Floats:
        rows, ids = self.rows[which], self.ids[which]
        change, self.asked[which] = setpoint - self.asked[which], setpoint
        before = self.output[which]
        changed = self.pressure(which, before, change)
        # the supply goes on where the activation has ended: what was lost is filled again, up to the setpoint
        refilled = self.pressure(which, before, change + self.run.beyond[rows, ids])
        refilled = np.clip(refilled, np.minimum(changed, setpoint), np.maximum(changed, setpoint))
        magnitude = self.values[self.quantities[0].name][which]
        self.output[which] = np.where(magnitude > 0, self.run.within("act", rows, ids, refilled), setpoint)
        return self.output[which]

    def pressure(self, which: Bools, before: Floats, change: Floats) -> Floats:
        """(n,) pressures after a time step in which ``change`` was asked for."""
        raise NotImplementedError


class PressureLeak(_Pneumatic):
    """Chambers lose pressure: p' = -rate p beside what is supplied."""

    name, category = "pressure_leak", "slow_drift"
    quantities = (Quantity("rate", "1/s", 0.2, (0.0, 100.0)),)

    def pressure(self, which: Bools, before: Floats, change: Floats) -> Floats:
        return np.exp(-self.values["rate"][which] * self.dt) * before + change


class PressureAsymmetry(_Pneumatic):
    """Filling follows the setpoint more slowly than venting does: time constants apart by a difference."""

    name, category = "pressure_asymmetry", "timing"
    quantities = (
        Quantity("difference", "s", 0.1, (0.0, 100.0)),
        Quantity("venting", "s", 1e-3, (1e-6, 100.0)),
    )

    def pressure(self, which: Bools, before: Floats, change: Floats) -> Floats:
        error = self.asked[which] - before
        slower = np.where(error > 0, self.values["difference"][which], 0.0)
        return before - np.expm1(-self.dt / (slower + self.values["venting"][which])) * error


class SupplyCoupling(_Pneumatic):
    """Chambers on one supply fill more slowly together: each loses a share of its rate per other that fills."""

    name, category = "supply_coupling", "amplitude"
    quantities = (Quantity("coupling", "1", 0.2, (0.0, 1.0)),)

    def pressure(self, which: Bools, before: Floats, change: Floats) -> Floats:
        rows, filling = self.rows[which], (change > 0).astype(float)
        others = np.bincount(rows, filling, minlength=self.batch.nsim)[rows] - filling
        slower = np.maximum(1.0 - self.values["coupling"][which] * others, 0.0)
        return before + np.where(change > 0, slower, 1.0) * change


class Compliance(Law):
    """A spring in series with a servo: a cable, a belt; the servo's stiffness and damping fall by 1 + k c, as does the
    damping of the actuator itself, which is before the spring. A negative one makes the servo stiffer."""

    name, category, kinds = "compliance", "static_error", ("actuator",)
    quantities = (Quantity("compliance", "m/N or rad/(N m)", 1.0, (-np.inf, np.inf), of="compliance", takes=True),)
    fields: ClassVar[tuple[str, ...]] = ("actuator_gainprm", "actuator_biasprm")

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        return (1.0 - _SOFTEST) * elements.scale(location, "compliance")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        fixed = self.model.actuator_gaintype[self.ids] == mujoco.mjtGain.mjGAIN_FIXED
        affine = self.model.actuator_biastype[self.ids] == mujoco.mjtBias.mjBIAS_AFFINE
        of_position, of_velocity = self.model.actuator_biasprm[self.ids, 1:3].T
        if not (fixed & affine & ~((of_position == 0) & (of_velocity != 0))).all():
            raise EffectError(f"{self.name} acts on servos of positions: actuators of fixed gain and affine bias")
        dampings = ("actuator_damping", "actuator_dampingpoly")
        self.dampings = [name for name in dampings if getattr(self.model, name)[self.ids].any()]
        self.fields = (*self.fields, *self.dampings)  # type: ignore[misc]

    def write(self, which: Bools) -> None:
        at = self.rows[which], self.ids[which]
        gain, bias = self.field("actuator_gainprm"), self.field("actuator_biasprm")
        softer = np.maximum(1.0 + gain[at][:, 0] * self.values["compliance"][which], _SOFTEST)
        for values in (gain, bias, *map(self.field, self.dampings)):
            values[at] /= per_row(softer, values[0])


class ActuatorSaturation(Law):
    """An actuator that is weaker than its model: it gives only a share of the force that it should at most. A negative
    loss is the share by which its limit is higher than that of the model."""

    name, category, kinds = "actuator_saturation", "amplitude", ("actuator",)
    quantities = (Quantity("loss", "1", 0.7, (-_HIGHEST, 1.0), also=(0.4, 0.88), takes=True),)
    fields: ClassVar = ("actuator_forcerange",)

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        return _HIGHEST if elements.model.actuator_forcelimited[elements.id(location)] else 0.0

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        if not self.model.actuator_forcelimited[self.ids].all():
            raise EffectError(f"{self.name} acts on actuators with a limit of force")

    def write(self, which: Bools) -> None:
        self.field("actuator_forcerange")[self.rows[which], self.ids[which]] *= 1.0 - self.values["loss"][which, None]


class Commands:
    """The setpoints of some simulations on their way through the laws."""

    def __init__(self, run: "ActiveEffects", ids: Ints):
        self.run, model = run, run.batch.model
        self.rows, self.actuators = run.touched_in(ids)
        i = self.actuators
        self.integrates, self.early = run.integrates[i], model.actuator_actearly[i].astype(bool)
        place = np.zeros(run.setpoint.shape, int)
        place[self.rows, i] = np.arange(len(i))
        self.laws = []
        for law in run.filters:
            which = np.isin(law.rows, ids)
            self.laws.append((law, which, place[law.rows[which], law.ids[which]]))

    def hold(self) -> None:
        """Ask for the control for some time steps."""
        asked = self.run.batch.ctrl[self.rows, self.actuators]
        self.asked = self.run.within("ctrl", self.rows, self.actuators, asked)

    def step(self) -> None:
        """One time step."""
        run, at = self.run, (self.rows, self.actuators)
        before = run.setpoint[at]
        wanted = before + run.timestep * self.asked
        moved = run.within("act", self.rows, self.actuators, wanted)
        run.beyond[at] = np.where(self.integrates, wanted - moved, 0.0)
        now = run.setpoint[at] = np.where(self.integrates, moved, self.asked)
        # a step uses the activation at its start, or at its end if the actuator is early
        output = np.where(self.integrates & ~self.early, before, now)
        asked = run.unchanged[at] = output.copy()
        for law, which, places in self.laws:
            output[places] = law.filter(which, output[places])
        run.added[at] += run.timestep * (output - asked)
        run.batch.ctrl[at] = np.where(self.integrates, 0.0, output)
        own = self.integrates
        run.batch.act[self.rows[own], run.slot[self.actuators[own]]] = output[own]
