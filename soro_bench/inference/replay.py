"""A recording replayed in simulation under other parameters: the one call that every inference method makes."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.task import Task
from soro_bench.models.simulation import quiet
from soro_bench.parallel import processors
from soro_bench.parameters import Parameter
from soro_bench.recording.recording import Recording, RecordingError, Signal, resampled, sampled
from soro_bench.recording.simulated import COMMAND, recorded_actions, start_of
from soro_bench.registration import make_task, task_type

# What a simulation is trusted to beside the sensor's noise, standard deviations by unit: in metres that of the
# published eps, 1e-4 mm^2 (what rf-dropo's README asks for); without a unit (quaternions, half of 0.8 mrad) the same
# 12.5 mm off the centre; of forces what stretches a cable of 10 N/mm by as much
RESOLUTION = {"m": 1e-5, "1": 4e-4, "N": 0.1}
MISSING = 1e6  # standard deviation of a sample that is missing: it says nothing
SIMULATIONS = 32  # at a time


class Replay:
    """Open-loop replays of one recording, from its reset; another process can be sent one (pickle).

    Args:
        recording: of one of the suite's environments, from its reset on. Its own parameters are not looked at.
        names: parameters to infer; by default what the published study randomises in the environment, but for the
            known ones.
        known: values of parameters that are not inferred; the others have their nominal values.
        model: the environment's model or mesh; by default what was recorded.
        noise: standard deviation [m] of the recorded positions; so are orientations, as of points 12.5 mm off the
            centre.
        restart: every time step starts from the recorded state, for a recording with its full state, instead of from
            what was simulated before.
        threads: 0 for all processors; results do not depend on it.
        also: signals to infer from beside those that the environment observes, such as tension [N].
    """

    def __init__(
        self,
        recording: Recording,
        names: Sequence[str] | None = None,
        known: Mapping[str, float] | None = None,
        model: str | None = None,
        noise: float = 0.0,
        restart: bool = False,
        threads: int = 0,
        also: Sequence[str] = (),
    ):
        if not 0.0 <= noise < math.inf:
            raise ValueError(f"noise {noise}: a standard deviation [m] of 0 or more is needed")
        env_id, self.actions = recorded_actions(recording)
        kind, metadata = task_type(env_id), recording.metadata
        self.model = model or metadata.get("model") or kind.accurate
        self._simulated = (env_id, self.model, metadata["action"], threads)
        try:
            self._task.check_actions(self.actions, len(self.actions))
        except ValueError as error:
            raise RecordingError(str(error)) from error
        self.known = self._task.parameters.check(known or {})
        if names is None:
            names = [p.name for p in kind.randomized if p.name not in self.known]
        self._task.parameters.check_names(names)
        if twice := sorted({name for name in names if list(names).count(name) > 1}):
            raise ValueError(f"{', '.join(twice)} cannot be inferred twice")
        if both := set(names) & set(self.known):
            raise ValueError(f"{', '.join(sorted(both))} cannot be both known and inferred")
        if not names:
            raise ValueError("there is nothing to infer: every parameter is known")
        for name in also:
            if name not in kind.signal_units:
                raise ValueError(f"cannot infer from {name!r}; {env_id} has {', '.join(kind.signal_units)}")
        self.names, self.signal_names = tuple(names), tuple(dict.fromkeys((*self._task.inferred_from, *also)))
        self._states = _states(recording, len(self.actions), self._task) if restart else None
        self._start = start_of(recording)
        self._read(recording, noise)

    def _read(self, recording: Recording, noise: float) -> None:
        begin, _ = recording.control_steps([COMMAND], self._task.control_timestep)
        times = begin + self._task.control_timestep * np.arange(1, len(self.actions) + 1)
        measured: list[Floats] = []
        deviation: list[Floats] = []
        sensor: list[float] = []
        self.groups: list[slice] = []
        first = 0
        try:
            self._task.reset(np.arange(1), [np.random.default_rng(0)], [self._start])  # another replay may have used it
        except ValueError as error:
            raise RecordingError(str(error)) from error
        simulated = self._task.signals(np.arange(1))
        for name in self.signal_names:
            if name not in recording.signals:
                raise RecordingError(f"the recording has no {name}; it has {', '.join(recording.names)}")
            given = _checked(name, recording.signals[name], self._task.signal_units[name], simulated[name][0])
            signal = resampled(given, times)
            rows = signal.values.reshape(len(times), -1)
            rows = np.where(sampled(given.time, times)[:, None], rows, np.nan)
            if not np.isfinite(rows).any():
                raise RecordingError(
                    f"{name} has no sample at the end of any control step, from {times[0]:g} to {times[-1]:g} s"
                )
            measured.append(rows)
            # orientations come from the same markers: their noise grows with that of positions
            noisy = 0.0 if signal.unit == "N" else RESOLUTION[signal.unit] * noise / RESOLUTION["m"]
            sensor += [noisy] * rows.shape[1]
            deviation.append(np.full_like(rows, np.hypot(RESOLUTION[signal.unit], noisy)))
            self.groups.append(slice(first, first := first + rows.shape[1]))
        self.sensor_noise = np.array(sensor)  # (k,) standard deviations
        self.measured = np.concatenate(measured, axis=1)  # (T, k), NaN where missing
        self.deviation = np.concatenate(deviation, axis=1)  # (T, k), of what is measured from what is simulated
        self.deviation[np.isnan(self.measured)] = MISSING

    @property
    def _task(self) -> Task:
        return _simulations(*self._simulated)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The inferred parameters."""
        return tuple(self._task.parameters.parameters[name] for name in self.names)

    @property
    def units(self) -> dict[str, str]:
        """The SI unit of every signal that is inferred from."""
        return {name: self._task.signal_units[name][0] for name in self.signal_names}

    @property
    def steps(self) -> int:
        """T, the number of recorded actions."""
        return len(self.actions)

    @property
    def restarts(self) -> bool:
        """Whether every time step starts from the recorded state."""
        return self._states is not None

    def fingerprint(self) -> str:
        """Names what is replayed: another recording, environment, model or known value has another one."""
        named = (*self._simulated[:2], self.names, sorted(self.known.items()), *self._start.items())
        digest, nominal = hashlib.sha256(repr(named).encode()), self._task.parameters.nominal
        for array in (nominal, self.actions, self.measured, self.deviation, *(self._states or {}).values()):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    def simulate(self, params: Floats, steps: int | None = None) -> Floats:
        """What is measured, simulated under each of the parameter vectors.

        Args:
            params: (N, d) in the order of ``names``.
            steps: how many actions to replay; all by default.

        Returns:
            (N, steps, k), NaN from where a simulation diverged.
        """
        params = np.atleast_2d(params)
        steps = self.steps if steps is None else steps
        signals = np.empty((len(params), steps, self.measured.shape[1]))
        for first in range(0, len(params), SIMULATIONS):
            part = params[first : first + SIMULATIONS]
            signals[first : first + len(part)] = self._roll_out(part, steps)
        return signals

    @quiet()  # of every process that replays
    def residuals(self, params: Floats, steps: int | None = None) -> Floats:
        """(N, steps, k) measured less simulated, 0 where nothing was measured."""
        simulated = self.simulate(params, steps)
        measured = self.measured[: simulated.shape[1]]
        return np.where(np.isnan(measured), 0.0, measured - simulated)

    @cached_property
    def nominal_residual(self) -> Floats:
        """(T, k) measured less simulated with nominal values of what is inferred, 0 where nothing was measured."""
        return self.residuals(np.array([[p.nominal for p in self.parameters]]))[0]

    def _roll_out(self, params: Floats, steps: int) -> Floats:
        task, ids = self._task, np.arange(len(params))
        rows = [{**self.known, **dict(zip(self.names, row, strict=True))} for row in params.tolist()]
        task.reset(ids, [np.random.default_rng(0) for _ in ids], [{"params": row, **self._start} for row in rows])
        lost, samples = np.zeros(len(ids), bool), []
        for t, action in enumerate(self.actions[:steps]):
            if self._states is not None:
                task.set_state(ids, {name: values[t] for name, values in self._states.items()})
                lost[:] = False
            lost |= task.step(ids, np.repeat(action[None], len(ids), axis=0)).diverged
            row = self._measure(ids)
            row[lost] = np.nan
            samples.append(row)
        return np.stack(samples, axis=1)

    def _measure(self, ids: Ints) -> Floats:
        signals = self._task.signals(ids)
        return np.concatenate([signals[name].reshape(len(ids), -1) for name in self.signal_names], axis=1)


def _checked(name: str, signal: Signal, kind: tuple[str, str], simulated: Floats) -> Signal:
    """The signal, quaternions without jumps to their negatives; RecordingError if it is not what is simulated.

    Args:
        kind: unit and frame that it has to have.
        simulated: a sample at rest.
    """
    if (signal.unit, signal.frame) != kind or signal.values.shape[1:] != simulated.shape:
        raise RecordingError(
            f"{name} is in {signal.unit!r}, frame {signal.frame!r}, with samples of shape {signal.values.shape[1:]}; "
            f"expected are {kind[0]!r}, {kind[1]!r}, {simulated.shape}"
        )
    if signal.unit not in RESOLUTION:
        raise RecordingError(f"{name} is in {signal.unit!r}; allowed are {', '.join(RESOLUTION)}")
    return replace(signal, values=_continuous(signal.values, simulated)) if name.endswith("_quaternion") else signal


def _continuous(quaternions: Floats, rest: Floats) -> Floats:
    """(T, ..., 4) quaternions w, x, y, z, each of the sign nearer to the one before it, the first to rest (..., 4)."""
    found = quaternions.copy()
    for body in np.ndindex(rest.shape[:-1]):
        turning, before = found[:, *body], rest[body]
        for i in np.flatnonzero(~np.isnan(turning).any(axis=1)):
            turning[i] *= -1.0 if turning[i] @ before < 0 else 1.0
            before = turning[i]
    return found


@lru_cache(4)
def _simulations(env_id: str, model: str, action: str, threads: int) -> Task:
    """Once in every process, not a part of the replay: they cannot be pickled, and compiling them takes a while."""
    return make_task(env_id, SIMULATIONS, threads or processors(), model, action=action)


def _states(recording: Recording, steps: int, task: Task) -> dict[str, Floats]:
    """The recorded state before every action, by the name of its part."""
    timestep = task.control_timestep
    found: dict[str, Floats] = {}
    times = recording.control_steps([COMMAND], timestep)[0] + timestep * np.arange(steps)
    for part, (own,) in task.state(np.arange(1)).items():
        name = f"state.{part}"
        if name not in recording.signals:
            raise RecordingError(f"restarting needs the full state, and the recording has no {name}; make it with "
                                 "soro-bench record --full-state")  # fmt: skip
        signal = recording.signals[name]
        if signal.values.shape[1:] != own.shape:
            raise RecordingError(
                f"{name} has samples of shape {signal.values.shape[1:]}, {own.shape} here; was it another model?"
            )
        found[part] = resampled(signal, times).values
        if not np.isfinite(found[part]).all():
            raise RecordingError(f"{name} has no value before some of the actions; restarting needs all of them")
    return found
