"""The part of a recording that a diagnosis uses."""

from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats


@dataclass(frozen=True)
class Drive:
    """Input of a replay.

    actions: (T, ...) one per control step. start: (P, D) the signal before the first step, or (S,) what the recording
    says of the state then. settings: (T, S) what is known of the robot in each control step.
    """

    actions: Floats
    start: Floats | None = None
    settings: Floats | None = None


@dataclass(frozen=True)
class Measured:
    """One signal of a recording at the ends of the control steps.

    actions: (T, ...) one per control step. time: (T,) s, the ends of the control steps. values: (T, P, D) samples of
    the signal at these times, P points of D coordinates [unit]; NaN where missing. signal, unit: its name and unit.
    start: (P, D) the first sample of the signal, before the first step, or (S,) what several signals say of the state
    then. settings: (T, S) what is known of the robot in each control step, for robots that have such settings. notes:
    what a user should know of the recording, in words.
    late: (F, T) s, errors that the time stamps may have, one standard deviation each; none where they are exact.
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

    @property
    def drive(self) -> Drive:
        """The input of the robot."""
        return Drive(self.actions, self.start, self.settings)

    def under(self, actions: Floats) -> "Measured":
        """The same robot under other actions (T', ...), with its first settings throughout."""
        settings = None if self.settings is None else np.repeat(self.settings[:1], len(actions), axis=0)
        return replace(self, actions=actions, settings=settings)
