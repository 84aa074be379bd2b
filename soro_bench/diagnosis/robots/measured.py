"""The part of a recording that a diagnosis uses."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.recording.recording import RecordingError, Signal, resampled, sampled


@dataclass(frozen=True)
class ObservedSignal:
    """A signal of recordings that a robot explains.

    unit, frame: as recordings have them. shape: (P, D), points and coordinates, as it is explained.
    directions: whether the points are the axes of frames, as of a recorded quaternion.
    reach: largest range of a coordinate in the recordings [unit]; 0 where it is not known.
    """

    name: str
    unit: str
    frame: str
    shape: tuple[int, int]
    directions: bool = False
    reach: float = 0.0

    @property
    def size(self) -> int:
        """Numbers of a sample."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class Drive:
    """Input of a replay.

    actions: (T, ...) one per control step. start: (P, D) the signal before the first step, or (S,) what the recording
    says of the state then. settings: (T, S) what is known of the robot in each control step. early: as of ``Measured``.
    """

    actions: Floats
    start: Floats | None = None
    settings: Floats | None = None
    early: Floats | None = None

    @cached_property
    def digest(self) -> bytes:
        """What tells the input of one simulation from another."""
        parts = [np.zeros(0) if part is None else part for part in (self.actions, self.start, self.settings)]
        # shapes too: without commands actions have no numbers, and still as many steps as the recording
        return hashlib.sha256(b"".join(repr(part.shape).encode() + part.tobytes() for part in parts)).digest()


@dataclass(frozen=True)
class Measured:
    """The explained signals of a recording at the ends of the control steps.

    actions: (T, ...) one per control step. time: (T,) s, the ends of the control steps. values: (T, P, D) samples of
    the first signal at these times, P points of D coordinates [unit]; NaN where missing. signal, unit: its name and
    unit. others: samples of the robot's other signals, in its order.
    start: of robots that begin at it, (P, D) the first sample of the signal, before the first step, or (S,) what
    several signals say of the state then. settings: (T, S) what is known of the robot in each control step, for robots
    that have such settings. notes: what a user should know of the recording, in words.
    early: (E, S) of robots that begin at a signal, the numbers of ``start`` as recorded then and in each control step
    after, for as long as a sensor may be late.
    late: (F, T, C) s, errors that the time stamps of each number may have, one standard deviation each; None where
    they are exact. steps: (C,) between the levels of each number [its unit], 0 where it is not quantised; None where
    nobody has looked. file: of the recording, for messages.
    """

    actions: Floats
    time: Floats
    values: Floats
    signal: str
    unit: str
    start: Floats | None = None
    settings: Floats | None = None
    notes: tuple[str, ...] = ()
    late: Floats | None = None
    others: tuple[Floats, ...] = ()
    early: Floats | None = None
    steps: Floats | None = None
    file: str = ""

    @property
    def columns(self) -> Floats:
        """(T, C) the numbers of all signals, one signal after the other."""
        return np.concatenate([each.reshape(len(each), -1) for each in (self.values, *self.others)], axis=1)

    @property
    def reach(self) -> float:
        """The largest range of a column [unit]; 0 where none has samples."""
        moved = self.columns[:, np.isfinite(self.columns).any(axis=0)]
        return float(np.max(np.nanmax(moved, axis=0) - np.nanmin(moved, axis=0), initial=0.0))

    def without(self, left_out: Bools) -> "Measured":
        """The same with nothing measured in some control steps (T,)."""
        kept = [np.where(left_out[:, None, None], np.nan, each) for each in (self.values, *self.others)]
        return replace(self, values=kept[0], others=tuple(kept[1:]))

    def only(self, which: int, signal: ObservedSignal) -> "Measured":
        """The same with samples of one signal only.

        Args:
            which: its number.
            signal: that signal.
        """
        if not self.others:
            return self
        values = (self.values, *self.others)[which]
        return replace(self, values=values, signal=signal.name, unit=signal.unit, late=None, others=(), steps=None)

    def first(self, steps: int) -> "Measured":
        """The same of the first control steps only."""
        settings, late = self.settings, self.late
        return replace(
            self,
            actions=self.actions[:steps],
            time=self.time[:steps],
            values=self.values[:steps],
            settings=None if settings is None else settings[:steps],
            late=None if late is None else late[:, :steps],
            others=tuple(each[:steps] for each in self.others),
        )

    @property
    def drive(self) -> Drive:
        """The input of the robot."""
        return Drive(self.actions, self.start, self.settings, self.early)

    def under(self, actions: Floats) -> "Measured":
        """The same robot under other actions (T', ...), with its first settings throughout."""
        settings = None if self.settings is None else np.repeat(self.settings[:1], len(actions), axis=0)
        return replace(self, actions=actions, settings=settings)


def samples_at(signal: ObservedSignal, given: Signal, commands: Sequence[Signal], times: Floats) -> Floats:
    """(T, P, D) a recorded signal at times (T,).

    Raises:
        RecordingError: it is not as expected, or on another clock than the commands.
    """
    name, shape, recorded = signal.name, signal.shape, given.values.shape[1:]
    if (given.unit, given.frame) != (signal.unit, signal.frame):
        hint = "; imported recordings are in SI units" if given.unit != signal.unit else ""
        raise RecordingError(
            f"{name} is in {given.unit!r}, frame {given.frame!r}; expected are {signal.unit!r}, {signal.frame!r}{hint}"
        )
    if math.prod(recorded) != signal.size or (len(recorded) > 1 and recorded != shape):
        raise RecordingError(f"{name} has samples of shape {recorded}; those of this robot have {shape}, points first")
    _check_clocks(name, given.time, [command.time for command in commands])
    values = resampled(given, times).values.reshape(-1, *shape)
    values[~sampled(given.time, times)] = np.nan
    return values


def _check_clocks(name: str, times: Floats, commands: Sequence[Floats]) -> None:
    """Refuse commands that are all after a signal, or before it by more than it lasts; some come only where they
    change.

    Raises:
        RecordingError: they are.
    """
    start, end = times[0], times[-1]
    first, last = (least([stamps[i] for stamps in commands], default=start) for i, least in ((0, min), (-1, max)))
    if first > end or last < start - (end - start):
        raise RecordingError(f"{name} is from {start:.6g} to {end:.6g} s, and the commands from {first:.6g} to "
                             f"{last:.6g} s; do they have the same clock?")  # fmt: skip
