"""The robot of a diagnosis: a simulation that replays a recording under parameters and effects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench.effects.catalogue import MEASUREMENT
from soro_bench.effects.effect import Effect, EffectError, Port
from soro_bench.effects.elements import Elements, instrument
from soro_bench.effects.measurement import distorted
from soro_bench.models import trunk
from soro_bench.recording.recording import Recording, RecordingError, resampled
from soro_bench.recording.simulated import recorded_actions
from soro_bench.registration import make_task, task_type

SIMULATIONS = 64  # at a time


@dataclass(frozen=True)
class Measured:
    """What a diagnosis sees of a recording.

    actions: (T, ...) one per control step. time: (T,) s, the ends of the control steps. values: (T, P, D) samples of
    one signal at these times, P points of D coordinates; NaN where missing.
    """

    actions: np.ndarray
    time: np.ndarray
    values: np.ndarray
    signal: str
    unit: str


@dataclass(frozen=True)
class Prior:
    """What is believed of a parameter: normal in its logarithm, or in itself."""

    name: str
    unit: str
    nominal: float
    deviation: float
    logarithmic: bool
    bounds: tuple[float, float]

    def value(self, x):
        """Values from coordinates ``x`` in standard deviations from the nominal one."""
        value = self.nominal * np.exp(self.deviation * x) if self.logarithmic else self.nominal + self.deviation * x
        return np.clip(value, *self.bounds)


# how far a calibrated robot may be from its nominal parameters: a third for what scales, 0.03 for Poisson's ratio
_SCALE_DEVIATION = 0.25
_RATIO_DEVIATION = 0.03


class Robot:
    """The trunk of TrunkReach.

    Args:
        env_id: the environment; the others of the suite, and models of other robots, are to come.
        model: its model or mesh; the cheap one by default.
        threads: 0 for all processors; results do not depend on it.
    """

    def __init__(self, env_id: str, model: str | None = None, threads: int = 0):
        if env_id != "TrunkReach-v0":
            raise ValueError(f"{env_id!r} cannot be diagnosed yet; allowed is TrunkReach-v0")
        kind = task_type(env_id)
        self.env_id, self.threads = env_id, threads
        self.model_name = model or kind.cheap
        self._task = make_task(env_id, SIMULATIONS, threads, self.model_name, action="continuous", effects=())
        self.signal = kind.inferred_from[0]
        self.elements = Elements(self._task.model)
        self.priors = tuple(_prior(p) for p in kind.parameters.parameters.values())

    def refined(self) -> "list[Robot]":
        """The same robot simulated more accurately: with half the time step, and with the accurate model."""
        finer = Robot(self.env_id, self.model_name, self.threads)
        finer._task.refine(2)
        return [finer, Robot(self.env_id, task_type(self.env_id).accurate, self.threads)]

    def ports(self, kind: str) -> list[Port]:
        """The ports of a kind at which something may be missing."""
        return self.elements.ports(kind) if kind in _KINDS else []

    def parameters(self, x: np.ndarray) -> dict[str, float]:
        """Values by name of the first unknowns in ``x``."""
        return {prior.name: float(prior.value(value)) for prior, value in zip(self.priors, x, strict=False)}

    def accepts(self, effects: Sequence[Effect]) -> bool:
        """Whether the robot can have these effects at once: none twice at a place, no two on the same spring."""
        if len({(e.name, e.where) for e in effects}) < len(effects):
            return False
        try:
            self._task.sim.assign_effects([[e for e in effects if e.where.kind != "sensor"]] * SIMULATIONS)
        except EffectError:
            return False
        return True

    def native(self, effect: Effect) -> bool:
        """Whether an effect is in the fields of the model, and nowhere else."""
        if effect.where.kind == "sensor":
            return False
        self._task.sim.assign_effects([[effect]] * SIMULATIONS)
        return self._task.sim.native

    def spec(self) -> mujoco.MjSpec:
        """What its model is compiled from."""
        return instrument(trunk.build_spec(self._task.scene, self.model_name))

    def model(self, parameters: Mapping[str, float], effects: Sequence[Effect]) -> mujoco.MjModel:
        """Its model with parameters, and with effects that are native."""
        sim = self._task.sim
        sim.assign_effects([effects] * SIMULATIONS)
        sim.set_params(np.arange(1), sim.parameters.to_array(parameters)[None])
        return sim.batch.get_model(0)

    def measured(self, recording: Recording) -> Measured:
        """The part of a recording that a diagnosis uses; RecordingError says what it lacks."""
        env_id, actions = recorded_actions(recording)
        if env_id != self.env_id or recording.metadata["action"] != "continuous":
            raise RecordingError(
                f"a recording of {env_id} with {recording.metadata['action']} actions; "
                f"this robot is {self.env_id} with continuous ones"
            )
        try:
            self._task.check_actions(actions, len(actions))
        except ValueError as error:
            raise RecordingError(str(error)) from error
        times = recording.start + self._task.control_timestep * np.arange(1, len(actions) + 1)
        if self.signal not in recording.signals:
            raise RecordingError(f"the recording has no {self.signal}; it has {', '.join(recording.names)}")
        given = recording.signals[self.signal]
        if (given.unit, given.frame) != (own := task_type(self.env_id).signal_units[self.signal]):
            raise RecordingError(f"{self.signal} is in {given.unit!r}, frame {given.frame!r}; expected are {own}")
        signal = resampled(given, times)
        shape = self._task.signals(np.arange(1))[self.signal].shape[1:]
        if signal.values.shape[1:] != shape:
            raise RecordingError(
                f"{self.signal} has samples of shape {signal.values.shape[1:]}; those of this robot have {shape}"
            )
        return Measured(actions, times - recording.start, signal.values, self.signal, signal.unit)

    def simulate(self, actions: np.ndarray, parameters: np.ndarray, effects: Sequence[Sequence[Effect]]) -> np.ndarray:
        """What the sensor would have recorded.

        Args:
            actions: (T, ...) one per control step.
            parameters: (N, d) values in the order of ``priors``.
            effects: of each of the N replays, physics and faults of measurement.

        Returns:
            (N, T, P, D), NaN from where a simulation diverged.
        """
        # what differs only in the sensor is simulated once
        physics = [tuple(e for e in each if e.where.kind != "sensor") for each in effects]
        keys = [(row.tobytes(), repr(each)) for row, each in zip(parameters, physics, strict=True)]
        first = {key: i for i, key in reversed(list(enumerate(keys)))}
        unique = sorted(first.values())
        parts = []
        for start in range(0, len(unique), SIMULATIONS):
            rows = unique[start : start + SIMULATIONS]
            parts.append(self._roll_out(actions, parameters[rows], [physics[i] for i in rows]))
        values, place = np.concatenate(parts), {i: k for k, i in enumerate(unique)}
        time = self._task.control_timestep * np.arange(1, len(actions) + 1)
        return np.stack([
            distorted(MEASUREMENT, each, time, values[place[first[key]]], self.signal)
            for key, each in zip(keys, effects, strict=True)
        ])

    def _roll_out(self, actions, parameters, physics):
        task, ids, n = self._task, np.arange(len(parameters)), len(parameters)
        task.sim.assign_effects([*physics, *[()] * (SIMULATIONS - n)])
        names = [prior.name for prior in self.priors]
        options = [{"params": dict(zip(names, row, strict=True))} for row in parameters.tolist()]
        task.reset(ids, [np.random.default_rng(0)] * n, options)
        lost, rows = np.zeros(n, bool), []
        for action in actions:
            lost |= task.step(ids, np.repeat(action[None], n, axis=0)).diverged
            row = task.signals(ids)[self.signal].copy()
            row[lost] = np.nan
            rows.append(row)
        return np.stack(rows, axis=1)


# a trunk's necks have no friction of their own, and TrunkReach no contacts
_KINDS = ("tendon", "actuator", "body", "model")


def _prior(parameter) -> Prior:
    logarithmic = parameter.name != "poisson_ratio"
    deviation = _SCALE_DEVIATION if logarithmic else _RATIO_DEVIATION
    return Prior(parameter.name, parameter.unit, parameter.nominal, deviation, logarithmic, parameter.bounds)
