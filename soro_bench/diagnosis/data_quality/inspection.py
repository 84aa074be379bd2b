"""Recordings as their sensors made them: what is wrong with the samples is named, and left out or put right."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.data_quality import samples
from soro_bench.diagnosis.data_quality.lattice import is_lattice, lattice_step
from soro_bench.diagnosis.data_quality.noise import noise_or_zero
from soro_bench.diagnosis.data_quality.retiming import RecordedSignal
from soro_bench.diagnosis.data_quality.samples import Channel
from soro_bench.diagnosis.data_quality.stamps import Stamps, stamps
from soro_bench.diagnosis.data_quality.texts import text
from soro_bench.diagnosis.result_robot import DataFinding
from soro_bench.diagnosis.robots.measured import Measured, ObservedSignal
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.recording.importers.wraps import part_of_turn
from soro_bench.recording.recording import Recording, RecordingError, Signal

SEARCHED = 8  # channels, those that move most, in which steps between levels are looked for


@dataclass(frozen=True)
class Inspected:
    """A recording after the inspection of its signal; the same one where nothing is wrong with it.

    findings: what was found. steps: (C,) between the levels of each number [unit], 0 where it is not quantised.
    error, rate: standard deviations of a constant error [s] of time stamps, and of the rate of their clock.
    spikes: points left out; size: their rms distance of a coordinate [unit].
    others: the same of the robot's other signals, in its order.
    """

    recording: Recording
    findings: tuple[DataFinding, ...] = ()
    steps: tuple[float, ...] = ()
    error: float = 0.0
    rate: float = 0.0
    spikes: int = 0
    size: float = 0.0
    others: "tuple[Inspected, ...]" = ()

    @property
    def step(self) -> float:
        """The largest step between levels [unit]; 0 if the signal is not quantised."""
        return max(self.steps, default=0.0)

    @property
    def all_findings(self) -> tuple[DataFinding, ...]:
        """Of all signals."""
        return (*self.findings, *(finding for each in self.others for finding in each.findings))

    def applied(self, measured: Measured) -> Measured:
        """What is measured of the recording, with the possible errors of its time stamps, and without samples that
        only repeat a level."""
        each, count = (self, *self.others), measured.columns.shape[1]
        signals = (measured.values, *measured.others)
        values = tuple(found._without_repeats(part) for found, part in zip(each, signals, strict=True))
        late, first = [], 0
        for found, part in zip(each, values, strict=True):
            if found.error or found.rate:
                about = measured.time - measured.time.mean()
                rows = np.zeros((2, len(about), count))
                own = np.stack([np.full(len(about), found.error), found.rate * about])
                rows[:, :, first : first + part[0].size] = own[:, :, None]
                late.append(rows)
            first += part[0].size
        errors = np.concatenate(late) if late else measured.late
        steps = [found.steps or np.zeros(part[0].size) for found, part in zip(each, signals, strict=True)]
        return replace(measured, values=values[0], others=values[1:], late=errors, steps=np.concatenate(steps))

    def _without_repeats(self, values: Floats) -> Floats:
        """(T, P, D) samples of the signal without those that only repeat a level."""
        if not any(self.steps):
            return values
        columns = values.reshape(len(values), -1).copy()
        for i in np.flatnonzero(self.steps):
            columns[samples.repeats(columns[:, i]), i] = np.nan
        return columns.reshape(values.shape)


def inspected(recording: Recording, number: int, robot: Robot, settings: Settings = DEFAULT) -> Inspected:
    """A recording whose signals are freed of what their sensors and loggers did to them.

    Args:
        number: index of the recording in the result.
        robot: whose signals it has; a recording without one of them is left to :meth:`Robot.measured`.

    Raises:
        RecordingError: nothing of a signal is left.
    """
    found: list[Inspected] = []
    for each in robot.signals:
        found.append(_of_signal(found[-1].recording if found else recording, recording, number, robot, each, settings))
    return replace(found[0], recording=found[-1].recording, others=tuple(found[1:]))


def _of_signal(
    recording: Recording, given: Recording, number: int, robot: Robot, observed: ObservedSignal, settings: Settings
) -> Inspected:
    """A recording of which one signal is inspected; ``given`` is before others were."""
    signal = recording.signals.get(observed.name)
    if signal is None or signal.unit != observed.unit or signal.values[0].size != observed.size:
        return Inspected(recording)
    return _Inspection(recording, given, number, robot, observed, settings, signal).result()


class _Inspection:
    """One signal on its way through all checks; ``values`` (T, C) lose what is spoilt."""

    def __init__(
        self,
        recording: Recording,
        given: Recording,
        number: int,
        robot: Robot,
        observed: ObservedSignal,
        settings: Settings,
        signal: Signal,
    ):
        self.recording, self.number, self.robot, self.signal = recording, number, robot, signal
        self.given = given
        self.observed = observed
        self.recorded = RecordedSignal(recording, robot, observed, signal, settings.data_quality)
        self.settings = settings.data_quality
        self.values = signal.values.reshape(len(signal.time), -1).copy()
        self.changes = _changes(recording.commands.values(), signal.time)
        self.points, self.coordinates = observed.shape
        self.findings: list[DataFinding] = []
        self.spikes, self.size = 0, 0.0

    def result(self) -> Inspected:
        """The recording and what was found."""
        missing = int(np.isnan(self.values).sum())
        self._check_numbers()
        turned = self._unwrap()
        self._leave_out_placeholders()
        steps = self._steps()
        self.noise = max(self._noise(), steps.max() / np.sqrt(12))
        self._leave_out_clipped(steps)
        held, spacing = self._leave_out_stale(steps)
        self._leave_out_spikes()
        rows = self._usable()
        if not held:  # lost rows are those of the log, not those that were left out
            rows[:] = True
        found = stamps(self.signal.time[rows], self.values[rows], self.settings, held, self._beside(rows))
        recording, error, rate = self.recording, 0.0, 0.0
        if found is not None or held:
            self._note_stamps(found, held)
            recording, error, rate = self.recorded.retimed(
                self.values, rows, found, spacing if held else None, self.noise
            )
        elif turned or self.findings:
            recording = self.recorded.with_samples(self.signal.time, self.values)
        lost = found.missing * self.values.shape[1] if found and not held else 0
        if lost or missing:
            self._note("missing_samples", lost + missing, lost)
        if not self.findings:
            return Inspected(self.recording)
        return Inspected(recording, tuple(self.findings), tuple(steps.tolist()), error, rate, self.spikes, self.size)

    def _beside(self, rows: Bools) -> list[Floats]:
        """(T, C) rows of the other signals that are explained and have the same time stamps."""
        others = [self.given.signals[each.name] for each in self.robot.signals
                  if each.name != self.observed.name and each.name in self.given.signals]  # fmt: skip
        return [other.values.reshape(len(other.time), -1)[rows] for other in others
                if np.array_equal(other.time, self.signal.time)]  # fmt: skip

    def _check_numbers(self) -> None:
        """Refuse what no sensor gives, before it is squared."""
        self._usable()
        largest, allowed = float(np.nanmax(np.abs(self.values))), float(np.sqrt(np.finfo(float).max / self.values.size))
        if largest > allowed:
            raise RecordingError(f"{self.observed.name} has a number of the size {largest:.3g}; at most {allowed:.3g} "
                                 "is allowed, so the log is corrupt")  # fmt: skip

    def _usable(self) -> Bools:
        """(T,) samples with any number.

        Raises:
            RecordingError: there are too few.
        """
        rows = np.isfinite(self.values).any(axis=1)
        if (count := int(rows.sum())) < (least := self.settings.least_samples):
            why = "".join(f"; {each.text}" for each in self.findings)
            raise RecordingError(f"{self.observed.name} has {count} usable samples; {least} are needed{why}")
        return rows

    def _note(self, name: str, count: int, lost: int = 0, **values: float) -> None:
        """Tell that ``count`` numbers of the signal are concerned, of which ``lost`` are not in the log."""
        share = min(count / (self.values.size + lost), 1.0)
        said = text(name, self.observed.name, self.observed.unit, share, values)
        self.findings.append(DataFinding(name, self.observed.name, self.number, int(count), float(share), said))

    def _note_stamps(self, found: Stamps | None, held: bool) -> None:
        """Tell what is wrong with the time stamps; gaps are told as missing samples."""
        if found is None or held:  # which rounds stamps to rows
            return
        for name, count in zip(found.kinds, found.affected, strict=True):
            if name != "gaps":
                self._note(name, count * self.values.shape[1], late=found.size)

    def _noise(self) -> float:
        """Standard deviation of the noise of samples that do not repeat the ones before."""
        fresh = self.values.copy()
        fresh[1:][np.diff(self.values, axis=0) == 0] = np.nan
        return noise_or_zero(fresh, self.settings)

    def _channels(self, steps: Floats) -> Iterator[tuple[int, Channel]]:
        for i in range(self.values.shape[1]):
            yield i, Channel(self.values[:, i], self.noise, float(steps[i]), self.changes)

    @cached_property
    def _replay(self) -> Floats | None:
        return self.recorded.replayed()

    def _replayed(self, number: int, channel: Channel) -> Channel:
        """The channel beside a replay of the nominal robot."""
        return channel if self._replay is None else replace(channel, replay=self._replay[:, number])

    def _unwrap(self) -> bool:
        """Take out the wraps of angles; RecordingError where they are of no whole turn, which the import has to say."""
        if self.observed.unit != "rad" or self.coordinates != 1:
            return False
        count, turn = 0, 0.0
        for i in range(self.values.shape[1]):
            found, period = samples.wrapped(self.values[:, i], self.settings)
            if found and (part := part_of_turn(self.values[:, i], period)):
                back = np.degrees(part.counts)
                raise RecordingError(
                    f"{self.observed.name} jumps back by about {back:.4g} deg, which is no whole turn; if it wraps "
                    "there, write unwrap = true and period = ... in the mapping of the import"
                )
            if found:
                self.values[:, i] = samples.unwrapped(self.values[:, i], period)
                self._take_off_turns(i, period)
                count, turn = count + found, period
        if count:
            self._note("wrap", count, turn=turn)
        return count > 0

    def _take_off_turns(self, channel: int, period: float) -> None:
        """Move an unwrapped channel to where the robot begins: a wrapped log does not say in which turn. A robot that
        begins at its signal is not moved."""
        seen = np.flatnonzero(np.isfinite(self.values[:, channel]))
        if self.observed.name != self.robot.signal or not len(seen):
            return
        try:
            drive = self.robot.measured(self.recorded.with_samples(self.signal.time, self.values)).drive
        except RecordingError:  # which is told where it is measured
            return
        begin = replace(
            drive, actions=drive.actions[:1], settings=None if drive.settings is None else drive.settings[:1]
        )
        nominal = np.array([[prior.nominal for prior in self.robot.priors]])
        (first,) = self.robot.simulate_all([begin], nominal, [()])
        turns = (self.values[seen[0], channel] - first.ravel()[channel]) / period
        if np.isfinite(turns):
            self.values[:, channel] -= period * np.round(turns)

    def _leave_out_placeholders(self) -> None:
        """Leave out values that stand for missing samples: all coordinates of a point have them."""
        self.noise = self._noise()
        count, value = 0, 0.0
        for p in range(self.points):
            columns = slice(p * self.coordinates, (p + 1) * self.coordinates)
            at, stands = samples.placeholder(self.values[:, columns], self.noise, self.settings)
            if at.any():
                self.values[at, columns] = np.nan
                count, value = count + int(at.sum()) * self.coordinates, stands
        if count:
            self._note("placeholders", count, value=value)

    def _steps(self) -> Floats:
        """(C,) steps between the levels of quantised channels; 0 for the others."""
        steps = np.zeros(self.values.shape[1])
        seen = np.isfinite(self.values).any(axis=0)
        reach = np.zeros(len(steps))
        reach[seen] = np.nanmax(self.values[:, seen], axis=0) - np.nanmin(self.values[:, seen], axis=0)
        noisy = min(self.noise, noise_or_zero(self.values, self.settings))
        least = max(self.settings.least_step * noisy, self.settings.least_noise * float(reach.max()))
        for i in np.argsort(-reach, kind="stable")[:SEARCHED]:
            steps[i] = lattice_step(self.values[:, i], least, self.settings)
        if (found := steps[steps > 0]).size:
            for i in np.flatnonzero(steps == 0):
                steps[i] = next((s for s in found if is_lattice(self.values[:, i], s, self.settings)), 0.0)
            count = int(np.isfinite(self.values[:, steps > 0]).sum())
            self._note("quantisation", count, step=float(steps.max()))
        return steps

    def _leave_out_clipped(self, steps: Floats) -> None:
        """Leave out what lies at the end of a sensor's range, unless the simulated robot stops there too."""
        count = 0
        for i, channel in self._channels(steps):
            at = samples.clipped(channel, self.settings)
            if at.any():
                at = samples.clipped(self._replayed(i, channel), self.settings)
            self.values[at, i] = np.nan
            count += int(at.sum())
        if count:
            self._note("clipping", count)

    def _leave_out_stale(self, steps: Floats) -> tuple[bool, float]:
        """Leave out values that are only held; whether the sensor holds throughout, and the interval of rows [s]."""
        counts = {"held": 0, "frozen": 0}
        given = self.values.copy()
        for i, channel in self._channels(steps):
            at, kind = samples.stale(channel, self.settings)
            if kind == "frozen":
                at, kind = samples.stale(self._replayed(i, channel), self.settings)
            self.values[at, i] = np.nan
            if kind:
                counts[kind] += int(at.sum())
        counts["frozen"] += self._leave_out_beside(given)
        for name, count in counts.items():
            if count:
                self._note(name, count)
        return counts["held"] > 0, float(np.median(np.diff(self.signal.time)))

    def _leave_out_beside(self, given: Floats) -> int:
        """Leave out the other coordinates of points that are only held, where they repeat themselves too; how many.

        Args:
            given: (T, C) before any were left out.
        """
        again = np.zeros(given.shape, bool)
        again[1:] = np.diff(given, axis=0) == 0
        left_out = np.isnan(self.values) & np.isfinite(given)
        of_point = left_out.reshape(len(given), self.points, -1).any(axis=2).repeat(self.coordinates, axis=1)
        more = of_point & again & ~left_out
        self.values[more] = np.nan
        return int(more.sum())

    def _leave_out_spikes(self) -> None:
        """Leave out points that are alone and far off."""
        squares: list[float] = []
        points = self.values.reshape(len(self.values), self.points, self.coordinates)
        for p, at in enumerate(samples.spikes(points, self.noise, self.settings).T):
            if at.any():
                squares += _distances(points[:, p].copy(), at)
                points[at, p] = np.nan
                self.spikes += int(at.sum())
        if self.spikes:
            self.size = float(np.sqrt(np.mean(squares)))
            self._note("spikes", self.spikes * self.coordinates, size=self.size)


def _changes(commands: Iterable[Signal], time: Floats) -> tuple[Ints, ...]:
    """Of each number of the commands, the first samples at times (T,) after it changes."""
    found = []
    for each in commands:
        changed = np.diff(each.values.reshape(len(each.time), -1), axis=0) != 0
        found += [np.unique(np.searchsorted(time, each.time[1:][column])) for column in changed.T]
    return tuple(found)


def _distances(point: Floats, at: Bools) -> list[float]:
    """Squares of the distances of samples of a point (T, D) from the line through those around them."""
    good = np.flatnonzero(~at & np.isfinite(point).all(axis=1))
    rows = np.flatnonzero(at)
    return [
        float(each)
        for i in range(point.shape[1])
        for each in (point[at, i] - np.interp(rows, good, point[good, i])) ** 2
    ]
