"""The time of samples: a signal at the control steps of a robot, from rebuilt time stamps."""

from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.data_quality.stamps import Stamps, interpolated
from soro_bench.diagnosis.robots.measured import ObservedSignal
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DataQualitySettings
from soro_bench.recording.recording import Recording, RecordingError, Signal

_CLOCK_RATE = 5e-4  # deviation of a rebuilt clock's rate; a crystal is within 1e-4


@dataclass(frozen=True)
class RecordedSignal:
    """A signal of a recording, and the robot that explains it."""

    recording: Recording
    robot: Robot
    observed: ObservedSignal
    signal: Signal
    settings: DataQualitySettings

    def retimed(
        self, values: Floats, rows: Bools, found: Stamps | None, spacing: float | None, noise: float
    ) -> tuple[Recording, float, float]:
        """The recording with samples at control steps, from rebuilt time stamps.

        Args:
            values: (T, C) samples, NaN where they are left out. rows: (T,) which of them are taken.
            found: what is wrong with the time stamps of these rows.
            spacing: interval between two rows [s], if the sensor is slower and holds its values; else None.
            noise: standard deviation of the noise.

        Returns:
            the recording, and standard deviations of what may be wrong with its time stamps: a constant error [s], and
            the rate of the clock.
        """
        time, error, rate = self.signal.time[rows], 0.0, 0.0
        recording = self.recording
        if found is not None:
            rebuilt = not {"gaps", "irregular"} >= set(found.kinds)
            time = found.time
            if rebuilt and spacing is not None:
                # all are older than this by the same time, and none is as old as the row before its own; the first one
                # may be from before the recording
                width = max(spacing - float((self.signal.time[rows] - time)[1:].max()), 0.0)
                time, error, rate = time - 0.5 * width, width / np.sqrt(12), _CLOCK_RATE
            elif rebuilt:
                error, rate = found.error, _CLOCK_RATE
                given, time = self.signal.time[rows], self._snapped(found)
                recording = _with_commands(recording, given, time, self.settings)
        if spacing is not None and not rate:  # a fresh value may be as old as the interval between two rows
            error = spacing / np.sqrt(3)
        return self._on_steps(recording, time, values[rows], noise), error, rate

    def replayed(self) -> Floats | None:
        """(T, C) the signal at the times of its samples, as the nominal robot moves; None where nobody can tell."""
        try:
            measured = self.robot.measured(self.recording)
        except RecordingError:  # which is told where the recording is prepared
            return None
        nominal = np.array([[prior.nominal for prior in self.robot.priors]])
        (found,) = self.robot.simulate_all([measured.drive], nominal, [()])
        first, time = 0, self.robot.begins(self.recording) + measured.time
        for each in self.robot.signals:
            if each.name == self.observed.name:
                columns = found[0][:, first : first + each.size]
                return np.stack([np.interp(self.signal.time, time, column) for column in columns.T], axis=1)
            first += each.size
        return None

    def _snapped(self, found: Stamps) -> Floats:
        """Rebuilt time stamps, moved onto control steps where they are as near as their error allows."""
        step, time = self.robot.control_timestep, found.time
        ratio = max(found.period / step, step / found.period)
        whole = round(ratio)
        exact = step * whole if found.period >= step else step / whole
        number = np.round((time - time[0]) / found.period)
        drift = number * (exact - found.period)
        if abs(ratio / whole - 1.0) > self.settings.same_time or abs(drift[-1]) > 0.5 * min(step, found.period):
            return time
        begin = self.robot.begins(self.recording)
        offset = time.mean() - (exact * number).mean()
        nearest = begin + round((offset - begin) / min(exact, step)) * min(exact, step)
        near = abs(offset - nearest) <= max(found.error, self.settings.same_time * step)
        return (nearest if near else offset) + exact * number

    def _on_steps(self, recording: Recording, time: Floats, values: Floats, noise: float) -> Recording:
        """The recording with the signal (T, C) at the ends of control steps, its first sample before them."""
        before = max(int((time < 0.0).sum()) - 1, 0)  # all that was sampled before the recording, but for the last one
        time, values = np.maximum(time[before:], 0.0), values[before:]
        step, begin = self.robot.control_timestep, self.robot.begins(recording)
        count = max(int(np.ceil((time[-1] - begin) / step - 1e-6)), 1)
        wanted = np.asarray(begin + step * np.arange(1, count + 1), float)
        columns = [interpolated(time, column, wanted, step, noise, self.settings) for column in values.T]
        if time[0] <= begin + (1.0 + self.settings.same_time) * step:
            wanted = np.concatenate([[min(time[0], begin)], wanted])
        else:  # a robot that begins at its first sample cannot begin at so late a one
            kept = wanted > time[0]
            wanted, columns = np.concatenate([time[:1], wanted[kept]]), [column[kept] for column in columns]
        return replace(recording, signals={**recording.signals, self.observed.name: self._signal(
            wanted, np.vstack([values[:1], np.stack(columns, axis=1)]))})  # fmt: skip

    def with_samples(self, time: Floats, values: Floats) -> Recording:
        """The recording with other samples (T, C)."""
        return replace(
            self.recording, signals={**self.recording.signals, self.observed.name: self._signal(time, values)}
        )

    def _signal(self, time: Floats, values: Floats) -> Signal:
        shape = self.signal.values.shape[1:]
        return Signal(time, values.reshape(len(time), *shape), self.signal.unit, self.signal.frame)


def _with_commands(recording: Recording, given: Floats, rebuilt: Floats, settings: DataQualitySettings) -> Recording:
    """The recording with the commands that have the same time stamps at the rebuilt ones."""
    commands = {}
    for name, command in recording.commands.items():
        shared = np.isin(command.time, given).mean() > settings.mostly
        commands[name] = command
        if shared:
            late = np.interp(command.time, given, rebuilt - given)
            time = np.maximum(command.time + late, 0.0)
            if (np.diff(time) > 0).all():
                commands[name] = replace(command, time=time)
    return replace(recording, commands=commands)
