"""The robot of a diagnosis: a simulation that replays a recording under parameters and effects."""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import mujoco
import numpy as np

from soro_bench.diagnosis.robots.measured import Drive, Measured
from soro_bench.diagnosis.robots.priors import Baseline, CannotHave, Prior
from soro_bench.effects.catalogue import ALL, MEASUREMENT, between_steps
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.effects.elements import Elements
from soro_bench.effects.measurement import distorted
from soro_bench.models.simulation import Simulation
from soro_bench.parallel import side_by_side
from soro_bench.recording.recording import Recording, RecordingError, resampled, sampled

SIMULATIONS = 128  # side by side, at least
# time steps, in one of the given robot, of the one that is fitted and of the refined one: fitted to a trunk with far
# shorter steps, one leaves 0.66 mm with the given steps of 10 ms and 0.29 mm with half of them
# (benchmarks/diagnosis_floor.py)
FITTED, REFINED = 2, 4


class Robot(ABC):
    """A robot with ``SIMULATIONS`` simulations or more. Subclasses set the attributes and implement the hooks below.

    Attributes:
        name: of the robot, for people.
        simulation: N simulations of it.
        control_timestep: s, between commands.
        signal: what is explained: the name of a signal of recordings, with its unit, frame and shape (P, D).
        kinds: the kinds of ports at which something may be missing.
        priors: of its parameters.
        pneumatic: whether its actuators fill chambers.
        known: effects that it is known to have, whatever else is missing.
        since: whether an earlier diagnosis says where its parameters were.
        shorter: how many times shorter its time steps are than those of its model.
        settling: control steps under its first action before a recording begins.
    """

    name: str
    simulation: Simulation
    control_timestep: float
    signal: str
    unit: str
    frame: str
    shape: tuple[int, int]
    kinds: tuple[str, ...]
    priors: tuple[Prior, ...]
    pneumatic: bool = False
    known: tuple[Effect, ...] = ()
    from_baseline: bool = False
    shorter: int = 1
    settling: int = 0

    def _remember(self, baseline: Baseline | None) -> None:
        """Begin where an earlier diagnosis of the robot ended; ValueError if it was that of another one."""
        if baseline:
            names = [prior.name for prior in self.priors]
            if sorted(names) != sorted(baseline.parameters):
                raise ValueError(f"the earlier diagnosis has {sorted(baseline.parameters)}; this robot has {names}")
            self.known, self.from_baseline = baseline.effects, True
            self.priors = tuple(p.about(baseline.parameters[p.name], baseline.spread[p.name]) for p in self.priors)
            if not self.accepts([]):
                raise CannotHave("the earlier diagnosis has effects that this robot cannot have")

    @property
    def elements(self) -> Elements:
        """The elements of its model."""
        return Elements(self.simulation.model)

    @property
    def _count(self) -> int:
        """Simulations side by side."""
        return self.simulation.batch.nsim

    @abstractmethod
    def shortened(self, factor: int) -> "Robot":
        """The same robot with time steps that are shorter by a factor than those of its model."""

    @abstractmethod
    def accurate(self) -> "Robot | None":
        """The same robot by a more accurate model, if there is one; CannotHave if that lacks a place for what is
        known."""

    @cached_property
    def _second(self) -> "Robot":
        """The same with simulations of its own, to run beside it."""
        return self.shortened(self.shorter)

    def refined(self) -> "list[Robot]":
        """The same robot simulated more accurately."""
        try:
            finer = self.accurate()
        except CannotHave:  # its parts are others; that of shorter time steps has the same
            finer = None
        return [self.shortened(REFINED), *([finer] if finer else [])]

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """What its model is compiled from."""

    @abstractmethod
    def actions(self, recording: Recording) -> np.ndarray:
        """(T, ...) checked commands of a recording, one per control step; RecordingError says what it lacks."""

    @abstractmethod
    def begins(self, recording: Recording) -> float:
        """When the first control step of a recording begins [s]."""

    @abstractmethod
    def _begin(self, parameters: np.ndarray, start: np.ndarray | None) -> None:
        """Start simulations 0 .. n - 1 with parameters (n, d), from where the signal is ``start`` (n, P, D)."""

    @abstractmethod
    def _step(self, actions: np.ndarray) -> np.ndarray:
        """Advance simulations 0 .. n - 1 by a control step under actions (n, ...); (n,) whether each diverged."""

    @abstractmethod
    def _read(self, count: int) -> np.ndarray:
        """(count, P, D) the signal now."""

    def settings(self, recording: Recording, steps: int) -> np.ndarray | None:
        """(steps, S) what is known of the robot in each control step; None where it has no settings."""
        return None

    def _set(self, ids: np.ndarray, settings: np.ndarray) -> None:
        """Give simulations ``ids`` (n,) settings (n, S); for robots that have some."""
        raise NotImplementedError

    def locations(self, kind: str) -> list[Location]:
        """The ports of a kind at which something may be missing."""
        return self.elements.locations(kind) if kind in self.kinds else []

    def beside(self, location: Location) -> list[Location]:
        """The ports before and after one that is a body or a measured point; of others, which have no order, none."""
        if location.index is not None:
            row = [replace(location, index=i) for i in range(self.shape[0])]
        else:
            row = self.locations("body") if location.kind == "body" else []
        if location not in row:
            return []
        i = row.index(location)
        return row[max(i - 1, 0) : i] + row[i + 1 : i + 2]

    @property
    def pulls_cables(self) -> bool:
        """Whether all its actuators pull tendons."""
        kinds = self.elements.model.actuator_trntype
        return "tendon" in self.kinds and bool((kinds == int(mujoco.mjtTrn.mjTRN_TENDON)).all())

    @property
    def setpoint_unit(self) -> str:
        """Of all actuators: lengths where they are servos that pull tendons."""
        servos = self.elements.model.actuator_biasprm[:, 1] != 0
        return "m" if self.pulls_cables and servos.all() else "setpoint"

    @property
    def moves(self) -> np.ndarray:
        """(A, nu) 1 where a number of an action moves an actuator, else 0."""
        return np.eye(self.elements.model.nu)

    @property
    def channels(self) -> list[str]:
        """What each number of an action moves, such as "cable L0"."""
        kind, names = "cable" if self.pulls_cables else "actuator", np.array(self.actuator_names)
        return [f"{kind} {' and '.join(names[row > 0])}" for row in self.moves]

    @property
    def actuator_names(self) -> list[str]:
        """Of all actuators."""
        model = self.elements.model
        return [model.actuator(i).name for i in range(model.nu)]

    def channel(self, location: Location) -> int | None:
        """The number of an action that moves a cable or actuator; None for what no single one moves."""
        if location.kind not in ("tendon", "actuator") or location.name == EVERY:
            return None
        ids = self.elements.actuators_on(location) if location.kind == "tendon" else [self.elements.id(location)]
        channels = np.unique(self.moves[:, ids].argmax(axis=0)) if len(ids) else ()
        return int(channels[0]) if len(channels) == 1 else None

    def rates(self, actions: np.ndarray) -> np.ndarray:
        """(T, A) how fast actions (T, A) move each channel, in any unit."""
        return actions

    def commanded(self, rates: np.ndarray, recorded: np.ndarray) -> np.ndarray:
        """(T, A) actions that move as rates (T, A) from -1 to 1 do, one column per channel.

        Args:
            recorded: (S, A) actions that the robot has done, where nothing else says how far it may go.
        """
        return rates

    def parameters(self, x: np.ndarray) -> dict[str, float]:
        """Values by name of the first unknowns in ``x``."""
        return {prior.name: float(prior.value(value)) for prior, value in zip(self.priors, x, strict=False)}

    def accepts(self, effects: Sequence[Effect]) -> bool:
        """Whether the robot can have these effects at once: none twice at a place, beside what is known only laws that
        add up, and no two on the same spring."""
        found = [(e.name, e.location) for e in effects]
        once = [(e.name, e.location) for e in self.known if not getattr(ALL[e.name], "adds", False)]
        if len({*once, *found}) < len(once) + len(found):
            return False
        effects = [*self.known, *effects]
        return self.simulation.accepts([e for e in effects if e.location.kind != "sensor"])

    def native(self, effect: Effect) -> bool:
        """Whether an effect is in the fields of the model, and nowhere else."""
        if effect.location.kind == "sensor":
            return False
        self.simulation.assign_effects([[effect]] * self._count)
        return self.simulation.native

    def model(self, parameters: Mapping[str, float], effects: Sequence[Effect]) -> mujoco.MjModel:
        """Its model with parameters, and with effects that are native."""
        sim = self.simulation
        sim.assign_effects([effects] * self._count)
        sim.set_params(np.arange(1), sim.parameters.to_array(parameters)[None])
        return sim.batch.get_model(0)

    def measured(self, recording: Recording) -> Measured:
        """The part of a recording that a diagnosis uses; RecordingError says what it lacks."""
        actions = self.actions(recording)
        if self.signal not in recording.signals:
            raise RecordingError(f"the recording has no signal {self.signal!r}; it has {', '.join(recording.names)}")
        given = recording.signals[self.signal]
        if (given.unit, given.frame) != (self.unit, self.frame):
            hint = "; imported recordings are in SI units" if given.unit != self.unit else ""
            raise RecordingError(
                f"{self.signal} is in {given.unit!r}, frame {given.frame!r}; expected are {self.unit!r}, {self.frame!r}"
                f"{hint}"
            )
        shape = given.values.shape[1:]
        if math.prod(shape) != math.prod(self.shape) or (len(shape) > 1 and shape != self.shape):
            raise RecordingError(
                f"{self.signal} has samples of shape {shape}; those of this robot have {self.shape}, points first"
            )
        _check_clocks(self.signal, given.time, [command.time for command in recording.commands.values()])
        begin = self.begins(recording)
        times = begin + self.control_timestep * np.arange(1, len(actions) + 1)
        values = resampled(given, times).values.reshape(-1, *self.shape)
        values[~sampled(given.time, times)] = np.nan
        first = given.values[0].reshape(self.shape)
        settings = self.settings(recording, len(actions))
        return Measured(actions, times - begin, values, self.signal, self.unit, first, settings)

    def simulate(
        self,
        actions: np.ndarray,
        parameters: np.ndarray,
        effects: Sequence[Sequence[Effect]],
        start: np.ndarray | None = None,
        before_step: Callable[[int], None] | None = None,
        settings: np.ndarray | None = None,
    ) -> np.ndarray:
        """What the sensor would have recorded.

        Args:
            actions: (T, ...) one per control step.
            parameters: (N, d) values in the order of ``priors``.
            effects: of each of the N replays, physics and faults of measurement.
            start: (P, D) the signal before the first step, for robots that begin where it does.
            before_step: called with the number of every control step; replay i, of ``SIMULATIONS`` at most, then runs
                in simulation i.
            settings: (T, S) as ``Measured`` has them.

        Returns:
            (N, T, P, D), NaN from where a simulation diverged.
        """
        return self.simulate_all([Drive(actions, start, settings)], parameters, effects, before_step)[0]

    def simulate_all(
        self,
        drives: Sequence[Drive],
        parameters: np.ndarray,
        effects: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None = None,
    ) -> list[np.ndarray]:
        """The same under each of several drives, side by side: (N, T, P, D) of every drive."""
        effects = [(*self.known, *each) for each in effects]
        # what differs only in the sensor is simulated once
        physics = [tuple(e for e in each if e.location.kind != "sensor") for each in effects]
        keys = [(row.tobytes(), repr(each)) for row, each in zip(parameters, physics, strict=True)]
        first = range(len(keys)) if before_step else [keys.index(key) for key in keys]
        work = {i: 0 if before_step else between_steps(physics[i]) for i in sorted(set(first))}

        def alike(job):
            return work[job[1]], len(drives[job[0]].actions)

        def rolled_out(robot, parts):
            found = {}
            for jobs in parts:
                driven, rows = [drives[k] for k, _ in jobs], [i for _, i in jobs]
                values = robot._roll_out(driven, parameters[rows], [physics[i] for i in rows], before_step)
                found |= dict(zip(jobs, values, strict=True))
            return found

        jobs = sorted(itertools.product(range(len(drives)), work), key=alike)
        groups = (list(group) for _, group in itertools.groupby(jobs, alike))
        parts = [group[i : i + self._count] for group in groups for i in range(0, len(group), self._count)]
        # what needs nothing between time steps need not wait for what does, which leaves processors idle meanwhile
        native, stepped = ([part for part in parts if (work[part[0][1]] > 0) == slow] for slow in (False, True))
        if native and stepped and self.simulation.batch.nthread > 1:
            found = side_by_side(2, rolled_out, (self, self._second), (native, stepped))
        else:
            found = [rolled_out(self, parts)]
        values = {job: each for some in found for job, each in some.items()}
        times = [self.control_timestep * np.arange(len(drive.actions) + 1) for drive in drives]
        return [
            np.stack([
                distorted(MEASUREMENT, each, time, values[k, i], self.signal)[1:]
                for i, each in zip(first, effects, strict=True)
            ])
            for k, time in enumerate(times)
        ]

    def _roll_out(self, drives, parameters, physics, before_step):
        """(n, 1 + T, P, D) of replays, each with its own drive of T steps: before the first, and after every one."""
        n, actions = len(drives), np.stack([drive.actions for drive in drives])
        start, settings = drives[0].start, drives[0].settings  # all drives have them, or none
        if start is not None:
            start = np.stack([drive.start for drive in drives])
        if settings is not None:
            settings = np.stack([drive.settings for drive in drives])
        self.simulation.assign_effects([*physics, *[()] * (self._count - n)])
        self._begin(parameters, start)
        lost, values = np.zeros(n, bool), []
        for step in range(actions.shape[1]):
            if settings is not None:
                before = settings[:, step - 1] if step else np.nan
                self._set(ids := np.flatnonzero((settings[:, step] != before).any(axis=1)), settings[ids, step])
            if step == 0:
                for _ in range(self.settling):
                    self._step(actions[:, 0])
                values.append(self._read(n).copy())
            if before_step:
                before_step(step)
            lost |= self._step(actions[:, step])
            value = self._read(n).copy()
            value[lost] = np.nan
            values.append(value)
        return np.stack(values, axis=1)


def _check_clocks(name, times, commands) -> None:
    """Refuse commands that are all after a signal, or before it by more than it lasts; some come only where they
    change."""
    start, end = times[0], times[-1]
    first, last = (least([stamps[i] for stamps in commands], default=start) for i, least in ((0, min), (-1, max)))
    if first > end or last < start - (end - start):
        raise RecordingError(f"{name} is from {start:.6g} to {end:.6g} s, and the commands from {first:.6g} to "
                             f"{last:.6g} s; do they have the same clock?")  # fmt: skip
