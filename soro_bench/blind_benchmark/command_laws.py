"""Hidden physics between what is commanded and what a cable's servo is told. All displacements are in metres."""

from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.robot import Law, Robot


@dataclass
class Backlash(Law):
    """Play: the servo follows only when the command has moved by half the width beyond it."""

    cable: int
    width: float  # m

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._held = 0.0

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        asked = pull[self.cable]
        self._held = min(max(self._held, asked - self.width / 2), asked + self.width / 2)
        return _replaced(pull, self.cable, self._held)


@dataclass
class Gain(Law):
    """The servo does a multiple of what is asked."""

    cable: int
    gain: float

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        return _replaced(pull, self.cable, self.gain * pull[self.cable])


@dataclass
class Offset(Law):
    """A constant is added to the command: pretension, or slack if negative."""

    cable: int
    offset: float  # m

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        return _replaced(pull, self.cable, pull[self.cable] + self.offset)


@dataclass
class Deadband(Law):
    """The servo does nothing within the width about zero, and that much less beyond."""

    cable: int
    width: float  # m, on either side

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        asked = pull[self.cable]
        return _replaced(pull, self.cable, np.sign(asked) * max(abs(asked) - self.width, 0.0))


@dataclass
class Delay(Law):
    """All commands arrive later."""

    delay: float  # s

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        place = self.delay / robot.timestep
        self._whole = int(place)
        self._part = place - self._whole
        self._past = [np.zeros(len(robot.cables))] * (self._whole + 2)

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        self._past = [*self._past[1:], pull]
        return (1 - self._part) * self._past[1] + self._part * self._past[0]


@dataclass
class Lag(Law):
    """All servos follow their commands as first-order systems."""

    time_constant: float  # s

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._reached = np.zeros(len(robot.cables))

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        kept = np.exp(-robot.timestep / self.time_constant) if self.time_constant > 0 else 0.0
        self._reached = pull + kept * (self._reached - pull)
        return self._reached


@dataclass
class CrossTalk(Law):
    """One motor moves another's cable too."""

    source: int
    cable: int
    share: float

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        return _replaced(pull, self.cable, pull[self.cable] + self.share * pull[self.source])


def _replaced(pull: np.ndarray, cable: int, value: float) -> np.ndarray:
    pull = pull.copy()
    pull[cable] = value
    return pull
