"""What a diagnosis sees of a recording."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Drive:
    """What drives a robot: (T, ...) actions, where its signal is first (P, D), and (T, S) settings."""

    actions: np.ndarray
    start: np.ndarray | None = None
    settings: np.ndarray | None = None


@dataclass(frozen=True)
class Measured:
    """What a diagnosis sees of a recording.

    actions: (T, ...) one per control step. time: (T,) s, the ends of the control steps. values: (T, P, D) samples of
    one signal at these times, P points of D coordinates; NaN where missing. start: (P, D) the first sample of the
    signal, before the first step. settings: (T, S) what is known of the robot in each control step, for robots that
    have such settings.
    """

    actions: np.ndarray
    time: np.ndarray
    values: np.ndarray
    signal: str
    unit: str
    start: np.ndarray | None = None
    settings: np.ndarray | None = None

    @property
    def drive(self) -> Drive:
        """What drove the robot."""
        return Drive(self.actions, self.start, self.settings)

    def under(self, actions: np.ndarray) -> "Measured":
        """The same robot under other actions, with its settings as at first."""
        settings = None if self.settings is None else np.repeat(self.settings[:1], len(actions), axis=0)
        return replace(self, actions=actions, settings=settings)
