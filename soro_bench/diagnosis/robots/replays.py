"""Replays of recordings by simulations side by side, under parameters and effects."""

import itertools
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.robots.measured import Drive, ObservedSignal
from soro_bench.effects.catalogue import MEASUREMENT, between_steps
from soro_bench.effects.effect import Effect
from soro_bench.effects.measurement import distorted
from soro_bench.models.simulation import Simulation
from soro_bench.parallel import side_by_side

SIMULATIONS = 128  # side by side at least; replays of a fit fill them
_REMEMBERED = 64_000_000  # bytes of replays that a robot remembers: about 300 of a trunk that moves for 20 s

_Job = tuple[int, int]  # a replay: the numbers of its drive, and of its parameters and effects


class Memory:
    """The replays that were asked for last, by what they depend on."""

    def __init__(self) -> None:
        self._values: OrderedDict[object, Floats] = OrderedDict()
        self._size = 0

    def get(self, key: object) -> Floats | None:
        """What is remembered; None if nothing is."""
        if (found := self._values.get(key)) is not None:
            self._values.move_to_end(key)
        return found

    def keep(self, key: object, values: Floats) -> None:
        """Remember new values, and forget the oldest beyond a limit of memory."""
        self._values[key] = values
        self._size += values.nbytes
        while self._size > _REMEMBERED:
            self._size -= self._values.popitem(last=False)[1].nbytes


class Replays(ABC):
    """``SIMULATIONS`` simulations or more that replay recordings. Subclasses set the attributes and implement hooks.

    Attributes:
        simulation: N simulations of the robot.
        control_timestep: s, between commands.
        signal: the name of the first signal of recordings that is explained.
        known_effects: those that the robot is known to have, whatever else acts.
        settling: control steps under its first action before a recording begins.
        relaxing: whether it is stopped behind positions of rest meanwhile.
    """

    simulation: Simulation
    control_timestep: float
    signal: str
    known_effects: tuple[Effect, ...] = ()
    settling: int = 0
    relaxing: bool = False

    @property
    def _count(self) -> int:
        """Simulations side by side."""
        return self.simulation.batch.nsim

    @property
    @abstractmethod
    def signals(self) -> tuple[ObservedSignal, ...]:
        """The signals of recordings that are explained; the first one decides the unit of a report."""

    @property
    def columns(self) -> int:
        """Numbers of a sample of all signals."""
        return sum(each.size for each in self.signals)

    @property
    @abstractmethod
    def _second(self) -> "Replays":
        """The same robot with other simulations, which run beside its own."""

    @abstractmethod
    def _begin(self, parameters: Floats, start: Floats | None) -> None:
        """Start simulations 0 .. n - 1 with parameters (n, d), at a signal ``start`` (n, P, D) if it is given."""

    @abstractmethod
    def _step(self, actions: Floats) -> Bools:
        """Advance simulations 0 .. n - 1 by a control step under actions (n, ...); (n,) whether each diverged."""

    @abstractmethod
    def _read(self, count: int) -> Floats:
        """(count, P, D) the first signal of the first ``count`` simulations now."""

    def _read_others(self, count: int) -> list[Floats]:
        """(count, P, D) each of the other signals of the first ``count`` simulations now."""
        return []

    def _happened(self, start: Floats, early: Floats, effects: Sequence[Effect]) -> Floats:
        """A start without the faults of sensors among ``effects``; for robots that begin at it.

        Args:
            early: (E, S) what was recorded then and in the control steps after.
        """
        return start

    def _complete(self, parameters: Floats) -> Floats:
        """(N, D) values of all parameters, from those (N, d) that replays differ in."""
        return parameters

    def _set(self, ids: Ints, settings: Floats) -> None:
        """Give simulations ``ids`` (n,) settings (n, S); for robots that have some."""
        raise NotImplementedError

    def simulate(
        self,
        actions: Floats,
        parameters: Floats,
        effects: Sequence[Sequence[Effect]],
        start: Floats | None = None,
        before_step: Callable[[int], None] | None = None,
        settings: Floats | None = None,
    ) -> Floats:
        """Replays: the first signal, as its sensor would record it.

        Args:
            actions: (T, ...) one per control step.
            parameters: (N, d) values in the order of ``priors``.
            effects: of each of the N replays, physics and faults of measurement.
            start: (P, D) the signal before the first step, as its sensor recorded it, for robots that begin at it.
            before_step: called with the number of every control step; replay i, of ``SIMULATIONS`` at most, then runs
                in simulation i.
            settings: (T, S) as ``Measured`` has them.

        Returns:
            (N, T, P, D), NaN from where a simulation diverged.
        """
        first = self.signals[0]
        (found,) = self.simulate_all([Drive(actions, start, settings)], parameters, effects, before_step)
        return found[:, :, : first.size].reshape(*found.shape[:2], *first.shape)

    def simulate_all(
        self,
        drives: Sequence[Drive],
        parameters: Floats,
        effects: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None = None,
    ) -> list[Floats]:
        """Replays under each of several drives, side by side: (N, T, C) of every drive, the numbers of all signals.
        See :meth:`simulate`."""
        effects = [(*self.known_effects, *each) for each in effects]
        # what differs only in the sensor is simulated once
        physics = [tuple(e for e in each if e.location.kind != "sensor") for each in effects]
        driven = {(k, i): self._driven(drive, each) for k, drive in enumerate(drives) for i, each in enumerate(effects)}
        values = self._replayed(driven, parameters, physics, before_step)
        times = [np.asarray(self.control_timestep * np.arange(len(drive.actions) + 1), float) for drive in drives]
        return [
            np.stack([self._recorded(each, time, values[k, i])[1:] for i, each in enumerate(effects)])
            for k, time in enumerate(times)
        ]

    def _driven(self, drive: Drive, effects: Sequence[Effect]) -> Drive:
        """A drive under effects: it begins at what happened, not at what a wrong sensor recorded of it."""
        if drive.start is None or not any(effect.location.kind == "sensor" for effect in effects):
            return drive
        early = drive.start.reshape(1, -1) if drive.early is None else drive.early
        return replace(drive, start=self._happened(drive.start, early, effects))

    @cached_property
    def _memory(self) -> Memory:
        """Of its replays; fits, comparisons and reports ask for some of them again."""
        return Memory()

    def _replayed(
        self,
        drives: Mapping[_Job, Drive],
        parameters: Floats,
        physics: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None,
    ) -> dict[_Job, Floats]:
        """(1 + T, C) signals of every drive under every row of parameters and effects, each simulated once.

        Args:
            drives: of every replay.
        """
        if before_step:
            return self._simulated(list(drives), drives, parameters, physics, before_step)
        names = tuple(each.name for each in self.signals)
        rows = [(row.tobytes(), repr(each)) for row, each in zip(parameters, physics, strict=True)]
        keys = {job: (names, drive.digest, rows[job[1]]) for job, drive in drives.items()}
        known = {key: found for key in keys.values() if (found := self._memory.get(key)) is not None}
        new = {key: job for job, key in reversed(keys.items()) if key not in known}
        simulated = self._simulated(sorted(new.values()), drives, parameters, physics, None)
        for key, job in new.items():
            known[key] = simulated[job]
            self._memory.keep(key, simulated[job])
        return {job: known[key] for job, key in keys.items()}

    def _simulated(
        self,
        jobs: Sequence[_Job],
        drives: Mapping[_Job, Drive],
        parameters: Floats,
        physics: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None,
    ) -> dict[_Job, Floats]:
        """Signals of some replays, as many side by side as there are simulations."""
        work = [0 if before_step else between_steps(each) for each in physics]

        def alike(job: _Job) -> tuple[int, int]:
            """Replays that run side by side: as much work between steps, as many steps."""
            return work[job[1]], len(drives[job].actions)

        def rolled_out(robot: Replays, parts: Sequence[list[_Job]]) -> dict[_Job, Floats]:
            """Signals of replays, simulated part by part on a robot."""
            found: dict[_Job, Floats] = {}
            for jobs in parts:
                driven, rows = [drives[job] for job in jobs], [i for _, i in jobs]
                values = robot._roll_out(driven, parameters[rows], [physics[i] for i in rows], before_step)
                found |= dict(zip(jobs, values, strict=True))
            return found

        groups = (list(group) for _, group in itertools.groupby(sorted(jobs, key=alike), alike))
        parts = [group[i : i + self._count] for group in groups for i in range(0, len(group), self._count)]
        # what needs nothing between time steps need not wait for what does, which leaves processors idle meanwhile
        native, stepped = ([part for part in parts if (work[part[0][1]] > 0) == slow] for slow in (False, True))
        if native and stepped and self.simulation.batch.nthread > 1:
            found = side_by_side(2, rolled_out, (self, self._second), (native, stepped))
        else:
            found = [rolled_out(self, parts)]
        return {job: each for some in found for job, each in some.items()}

    def _recorded(self, effects: Sequence[Effect], time: Floats, values: Floats) -> Floats:
        """(T, C) numbers of all signals with the faults of their sensors among ``effects``."""
        if not any(effect.location.kind == "sensor" for effect in effects):
            return values
        parts, first = [], 0
        for each in self.signals:
            part = values[:, first : first + each.size].reshape(len(values), *each.shape)
            parts.append(distorted(MEASUREMENT, effects, time, part, each.name).reshape(len(values), -1))
            first += each.size
        return np.concatenate(parts, axis=1)

    def _roll_out(
        self,
        drives: Sequence[Drive],
        parameters: Floats,
        physics: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None,
    ) -> Floats:
        """(n, 1 + T, C) signals of n replays, each with its own drive of T steps, before the first and after every
        step."""
        n, actions = len(drives), np.stack([drive.actions for drive in drives])
        start, settings = drives[0].start, drives[0].settings  # all drives have them, or none
        if start is not None:
            start = np.stack([drive.start for drive in drives if drive.start is not None])
        if settings is not None:
            settings = np.stack([drive.settings for drive in drives if drive.settings is not None])
        self.simulation.assign_effects([*physics, *[()] * (self._count - n)])
        self._begin(self._complete(parameters), start)
        lost, values = np.zeros(n, bool), []
        for step in range(actions.shape[1]):
            if settings is not None:
                before = settings[:, step - 1] if step else np.nan
                self._set(ids := np.flatnonzero((settings[:, step] != before).any(axis=1)), settings[ids, step])
            if step == 0:
                lost |= self._settle(actions[:, 0])
                values.append(self._sample(n))
                values[0][lost] = np.nan
            if before_step:
                before_step(step)
            lost |= self._step(actions[:, step])
            value = self._sample(n)
            value[lost] = np.nan
            values.append(value)
        return np.stack(values, axis=1)

    def _settle(self, actions: Floats) -> Bools:
        """Bring simulations to rest under actions (n, nu), in control steps before a recording begins; (n,) whether
        they have diverged.

        Little damping takes longer than anyone lets a robot settle. So those that relax are stopped behind a position
        of rest, where forces pull back (dynamic relaxation: Barnes, "Form finding and analysis of tension structures
        by dynamic relaxation", 1999). These are the forces without velocities: damping brakes on the way there, too.
        Where stiff constraints act on light bodies, velocities after a stop are large, and stepping alone is better.
        """
        batch, lost = self.simulation.batch, np.zeros(len(actions), bool)
        for name in ("qvel", "qfrc_smooth", "qfrc_constraint"):
            batch.bind(name)
        for _ in range(self.settling):
            lost |= self._step(actions)
            if not self.relaxing:
                continue
            moved = np.array(batch.qvel)
            batch.qvel[:] = 0.0
            batch.forward()
            force = np.asarray(batch.qfrc_smooth) + np.asarray(batch.qfrc_constraint)
            onward = (moved * force).sum(axis=1) >= 0.0
            batch.qvel[onward] = moved[onward]
        return lost

    def _sample(self, count: int) -> Floats:
        """(count, C) numbers of all signals of the first ``count`` simulations now."""
        parts = [self._read(count), *self._read_others(count)]
        return np.concatenate([each.reshape(count, -1) for each in parts], axis=1)
