"""N simulations of one model, each with its own physical parameters, on ``mujoco.batch``."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import Effect, EffectError, Location
from soro_bench.effects.runtime import ActiveEffects
from soro_bench.parameters import ParameterSet

_BAD_STATE = np.array([
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
])


class _Quiet:
    """How many callers want MuJoCo to be quiet now. Its handler changes before the first and after the last of them
    only: the simulations of other threads may be calling it."""

    def __init__(self) -> None:
        self.lock, self.callers, self.before = threading.Lock(), 0, None

    def begin(self) -> None:
        """One caller more."""
        with self.lock:
            if self.callers == 0:
                self.before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(lambda message: None)
            self.callers += 1

    def end(self) -> None:
        """One caller less."""
        with self.lock:
            self.callers -= 1
            if self.callers == 0:
                mujoco.set_mju_user_warning(self.before)


_QUIET = _Quiet()


@contextmanager
def quiet() -> Iterator[None]:
    """MuJoCo neither prints its warnings nor logs them to MUJOCO_LOG.TXT; ``Simulation.bad_states`` says what has
    diverged."""
    _QUIET.begin()
    try:
        yield
    finally:
        _QUIET.end()


@dataclass(frozen=True)
class FieldWrite:
    """Values for some rows of one MjModel field: ``values`` is (N, len(rows), ...)."""

    field: str
    rows: Ints
    values: Floats


class ParameterMap(Protocol):
    """Turns physical parameters into model fields."""

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter, in SI units."""


class Simulation:
    """N simulations of one compiled model with per-simulation parameters.

    Args:
        model: the compiled model; not modified.
        parameters: the parameters of the model, in order.
        maps: what turns them into model fields.
        nsim: number of simulations N.
        nthread: threads, 0 for all processors. Results do not depend on it.
        effects: physics that the model leaves out, for all simulations (``assign_effects`` gives each its own); the
            model has to be prepared by :func:`soro_bench.effects.elements.instrument`. None for one that is not.

    Attributes:
        xp: the array library of the state, as the array API standard has it: NumPy here, PyTorch on a GPU.
    """

    xp: Any = np

    def __init__(
        self,
        model: mujoco.MjModel,
        parameters: ParameterSet,
        maps: Sequence[ParameterMap],
        nsim: int,
        nthread: int = 1,
        effects: Sequence[Effect] | None = None,
    ):
        self.model = model
        self.parameters = parameters
        self._maps = tuple(maps)
        # persistent: observations need the forward stages at the new state, which the next step then reuses
        self.batch = Batch(model, nsim, nthread, persistent=True)
        self.params = np.tile(parameters.nominal, (nsim, 1))
        self._effects = None if effects is None else ActiveEffects(self.batch)
        if effects is None:
            self.set_params(np.arange(nsim), self.params)
        else:
            self.assign_effects([effects] * nsim)

    def assign_effects(self, effects: Sequence[Sequence[Effect]]) -> None:
        """Give each of the N simulations its own effects, from its next reset on."""
        self._instrumented.assign(effects)
        self.set_params(np.arange(len(effects)), self.params)

    def accepts(self, effects: Sequence[Effect]) -> bool:
        """Whether a simulation can have these effects at once; those that the simulations have stay."""
        try:
            self._instrumented.tried(effects)
        except EffectError:
            return False
        return True

    def in_fields(self, effects: Sequence[Effect]) -> bool:
        """Whether these effects would be in model fields and nowhere else; those that the simulations have stay.

        Raises:
            EffectError: a simulation cannot have them.
        """
        return self._instrumented.tried(effects).native

    def change(self, name: str, row: int, location: Location, quantity: str, value: float) -> None:
        """Give an effect that acts in simulation ``row`` another value of a quantity, from the next time step on."""
        self._instrumented.change(name, row, location, quantity, value)

    @property
    def native(self) -> bool:
        """Whether the effects are in model fields and nowhere else."""
        return self._effects is None or self._effects.native

    @property
    def setpoints(self) -> tuple[Floats, Floats]:
        """(N, nu) what actuators are asked for, where laws change it, and what they have added, summed over time."""
        return self._instrumented.setpoint, self._instrumented.added

    def commanded(
        self, row: int, model: mujoco.MjModel | None = None, data: mujoco.MjData | None = None
    ) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of a simulation, perhaps written into others, with controls, activations and their ranges as
        before laws of setpoints."""
        model, data = self.batch.get_model(row, model), self.batch.get_data(row, data)
        self._instrumented.without_laws(row, model, data)
        return model, data

    @property
    def _instrumented(self) -> ActiveEffects:
        """The effects of a simulation whose model is prepared for them; RuntimeError for another."""
        if self._effects is None:
            raise RuntimeError("the model is not prepared for effects; see soro_bench.effects.elements.instrument")
        return self._effects

    def array(self, values: Any) -> Any:
        """Numbers from the host as an array of the state's library."""
        return np.asarray(values)

    def on_host(self, values: Any) -> Any:
        """The same, an array or a dict of them, as NumPy arrays in double precision."""
        return values

    def expect(self, ids: Ints, warning: mujoco.mjtWarning) -> None:
        """Be silent about a warning that these simulations give in every step.

        MuJoCo prints a warning when it counts the first of its kind; a count that starts at 1 is silent.
        """
        self.batch.warning[ids, warning, 1] = 1

    @quiet()
    def set_params(self, ids: Ints, params: Floats) -> None:
        """Give simulations ``ids`` the parameters ``params`` (len(ids), d); MuJoCo's derived constants follow."""
        self.params[ids] = params
        named = dict(zip(self.parameters.names, np.asarray(params, float).T, strict=True))
        column = np.asarray(ids)[:, None]
        if self._effects:
            self._effects.restore(ids)
        for parameter_map in self._maps:
            for write in parameter_map.writes(named):
                self.batch.expand(write.field)[column, write.rows] = write.values
        if self._effects:
            self._effects.write(ids)
        self.batch.set_const(ids)

    @quiet()
    def begin(self, ids: Ints) -> None:
        """Compute what positions and velocities determine, at the start of an episode or after a change of state."""
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        if self._effects:
            self._effects.reset(ids)

    def remembered(self, ids: Ints) -> Floats | None:
        """(n, k) what effects of simulations ``ids`` remember, as numbers; None where there are no effects."""
        return None if self._effects is None else self._effects.remembered(ids)

    @quiet()
    def go_on(self, ids: Ints, remembered: Floats) -> None:
        """Let the effects of simulations ``ids``, which ``begin`` has begun, go on from what they remembered (n, k)."""
        self._instrumented.go_on(ids, remembered)
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._instrumented.go_on(ids, remembered)  # what only a time step computes

    def saved(self) -> dict[str, Any]:
        """Copies of what ``resume`` needs: parameters, states, counted warnings, model fields and what effects
        remember."""
        fields = {name: values.copy() for name in MODEL_FIELDS if (values := self.batch.expanded(name)) is not None}
        effects = None if self._effects is None else self._effects.memory()
        return {
            "params": self.params.copy(),
            "state": self.batch.state.copy(),
            "warning": self.batch.warning.copy(),
            "fields": fields,
            "effects": effects,
        }

    @quiet()
    def resume(self, saved: Mapping[str, Any]) -> None:
        """Go on, to the last bit, as the simulations did that saved this; of as many of the same model and effects."""
        everyone = np.arange(self.batch.nsim)
        if self._effects is not None:
            self._effects.recall(saved["effects"])
        self.set_params(everyone, saved["params"])
        for name, values in saved["fields"].items():
            self.batch.expand(name)[...] = values
        self.batch.state[...] = saved["state"]
        self.batch.forward(everyone, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.batch.warning[...] = saved["warning"]
        if self._effects is not None:
            self._effects.show(saved["effects"])

    def bad_states(self, ids: Ints) -> Bools:
        """(n,) whether MuJoCo has found a state to be NaN or huge, and reset it, since this was asked last."""
        entries = np.ix_(
            ids, _BAD_STATE, np.array([1])
        )  # MuJoCo counts anew when it resets, so that one more is not seen
        found = self.batch.warning[entries].any(axis=(1, 2))
        self.batch.warning[entries] = 0
        return found

    @quiet()
    def step(self, ids: Ints, nstep: int, stage: int = mujoco.mjtStage.mjSTAGE_VEL) -> None:
        """Advance by ``nstep`` time steps and compute the stages up to ``stage`` at the new state, which a persistent
        batch reuses in its next step."""
        if self._effects:
            self._effects.step(ids, nstep, stage)
        else:
            self.batch.step(ids, nstep=nstep, stage=stage)
