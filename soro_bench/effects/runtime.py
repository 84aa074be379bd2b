"""Effects at work in N simulations, each with its own."""

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from soro_bench.effects.catalogue import PHYSICS
from soro_bench.effects.commands import SetpointLaw
from soro_bench.effects.effect import Effect, EffectError, checked
from soro_bench.effects.elements import Elements
from soro_bench.effects.necks import NECKS

_RANGES = ("actuator_ctrlrange", "actuator_actrange")


class ActiveEffects:
    """The effects of N simulations of one model, which ``instrument`` has prepared.

    Args:
        batch: the simulations; a persistent batch.
    """

    def __init__(self, batch: Batch):
        self.batch, self.elements = batch, Elements(batch.model)
        self._nominal = batch.model
        self._fields: set[str] = set()
        self.assign([()] * batch.nsim)

    def assign(self, effects: Sequence[Sequence[Effect]]) -> None:
        """Give simulation i the effects ``effects[i]``; the parameters have to be set again after this.

        Raises:
            EffectError: an effect has no place in the model, or two need the same spring.
        """
        by_law: dict[tuple[str, bool], list] = {}
        for row, of_row in enumerate(effects):
            for effect in of_row:
                if effect.name not in PHYSICS:
                    raise EffectError(f"{effect.name} is no physics of the robot; there are {', '.join(PHYSICS)}")
                law = PHYSICS[effect.name]
                complete = checked(effect, law.quantities)
                if effect.where.kind not in law.kinds:
                    raise EffectError(f"{effect.name} acts on {', '.join(law.kinds)}, not on {effect.where}")
                for port in self.elements.expand(effect.where):
                    by_law.setdefault((effect.name, self._on_neck(port)), []).append((row, port, complete))
        self._claimed: dict[tuple[int, int], str] = {}
        kinds = [(name, on_neck) for name in PHYSICS for on_neck in (False, True) if (name, on_neck) in by_law]
        self._laws = [(NECKS if on_neck and name in NECKS else PHYSICS)[name](self, by_law[name, on_neck])
                      for name, on_neck in kinds]  # fmt: skip
        self._fields |= {field for law in self._laws for field in law.fields}
        self._filters = [law for law in self._laws if isinstance(law, SetpointLaw)]
        self._stepped = [law for law in self._laws if law.stepped]
        self._prepare_setpoints()

    def _on_neck(self, port) -> bool:
        """Whether a body hangs on what precedes it by a flex, not by joints that could have springs."""
        return port.kind == "body" and not len(self.elements.joints_of(self.elements.id(port)))

    def claim(self, law, rows, springs) -> None:
        """Note that a law uses springs; EffectError if another one does."""
        for key in zip(rows.tolist(), springs.tolist(), strict=True):
            if key in self._claimed:
                raise EffectError(f"{self._claimed[key]} and {law.name} need the same spring")
            self._claimed[key] = law.name

    def restore(self, ids: np.ndarray) -> None:
        """Model fields that effects changed become nominal again."""
        for field in self._fields:
            nominal = getattr(self._nominal.opt, field[4:]) if field.startswith("opt.") else getattr(
                self._nominal, field)  # fmt: skip
            self.batch.expand(field)[ids] = nominal

    def write(self, ids: np.ndarray) -> None:
        """Change model fields of simulations ``ids``, whose parameters have just been set."""
        for law in self._laws:
            law.write(np.isin(law.rows, ids))
        if self._filters:  # a setpoint may move faster and farther than commands may
            rows, actuators = self._touched_in(ids)
            for field in _RANGES:
                self.batch.expand(field)[rows, actuators] = (-1e9, 1e9)

    def reset(self, ids: np.ndarray) -> None:
        """Begin an episode in simulations ``ids``, whose state is complete."""
        self._setpoint[ids] = self.batch.act[ids][:, self._slot] if self.batch.model.na else 0.0
        for law in self._laws:
            law.reset(np.isin(law.rows, ids))
        for law in self._filters:
            which = np.isin(law.rows, ids)
            law.start(which, self._setpoint[law.rows[which], law.ids[which]])

    def step(self, ids: np.ndarray, nstep: int, stage: int) -> None:
        """Advance simulations ``ids`` as ``Batch.step`` does."""
        if not (self._filters or self._stepped):
            self.batch.step(ids, nstep=nstep, stage=stage)
            return
        asked = self.batch.ctrl[ids]
        which = {law: np.isin(law.rows, ids) for law in {*self._filters, *self._stepped}}
        for _ in range(nstep):
            self._command(ids, asked, which)
            for law in self._stepped:
                law.step(which[law])
            # with the forward stages at the new state, which laws read and a persistent batch reuses
            self.batch.step(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.batch.ctrl[ids] = asked

    def _prepare_setpoints(self):
        model = self.batch.model
        self._integrates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        self._early = model.actuator_actearly.astype(bool)
        # where the control is a rate, the setpoint is the activation; the slot of others is not used
        self._slot = np.maximum(model.actuator_actadr, 0)
        self._setpoint = np.zeros((self.batch.nsim, model.nu))
        touched = np.zeros((self.batch.nsim, model.nu), bool)
        for law in self._filters:
            touched[law.rows, law.ids] = True
        self._touched = touched
        if self._filters:
            self._fields |= set(_RANGES)

    def _command(self, ids, asked, which):
        """Pass the setpoints of a time step through the laws."""
        if not self._filters:
            return
        model, dt = self.batch.model, self.batch.model.opt.timestep
        low, high = model.actuator_ctrlrange.T
        limited = np.where(model.actuator_ctrllimited, np.clip(asked, low, high), asked)
        moved = self._setpoint[ids] + dt * limited
        low, high = model.actuator_actrange.T
        moved = np.where(model.actuator_actlimited, np.clip(moved, low, high), moved)
        before, self._setpoint[ids] = self._setpoint.copy(), np.where(self._integrates, moved, limited)
        # a step uses the activation at its start, or at its end if the actuator is early
        output = np.where(self._integrates & ~self._early, before, self._setpoint)
        for law in self._filters:
            at = law.rows[which[law]], law.ids[which[law]]
            output[at] = law.filter(which[law], output[at])
        rows, actuators = self._touched_in(ids)
        self.batch.ctrl[rows, actuators] = np.where(self._integrates[actuators], 0.0, output[rows, actuators])
        rows, actuators = rows[self._integrates[actuators]], actuators[self._integrates[actuators]]
        self.batch.act[rows, self._slot[actuators]] = output[rows, actuators]

    def _touched_in(self, ids):
        """Simulations among ``ids`` and actuators whose setpoints are changed."""
        rows, actuators = np.nonzero(self._touched)
        chosen = np.isin(rows, ids)
        return rows[chosen], actuators[chosen]
