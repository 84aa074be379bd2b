"""Hidden physics of cables: what reaches their servos of a command, friction, compliance, a limit of the tension.

All displacements are in metres.
"""

import math
from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.robot import Law, Robot
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo


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


# N/m, of what gives before a cable slides. The forces are explicit: a time step times it has to stay below the 15 N s/m
# with which the softest trunk resists a slack cable.
_BRISTLE_STIFFNESS = 3000.0
_CAPSTAN_PRESLIDING = 0.001  # m, from no friction to all of it


@dataclass
class Friction(Law):
    """Dry friction on a cable: it sticks on a spring until the force is at its limit, then slides.

    The limit falls from ``breakaway * level`` at rest to ``level`` at speeds far above ``speed``.
    """

    cable: int
    level: float  # N
    breakaway: float = 1.0
    speed: float = 0.005  # m/s

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._place = robot.data.actuator_length[robot.cables[self.cable]]
        self.force = 0.0  # N, on the cable's shortening

    def push(self, robot: Robot) -> None:
        place = robot.data.actuator_length[robot.cables[self.cable]]
        moved, self._place = place - self._place, place
        misfit = (self.breakaway - 1) * math.exp(-((moved / robot.timestep / self.speed) ** 2))
        limit = self.level * (1 + misfit)
        self.force = min(max(self.force - _BRISTLE_STIFFNESS * moved, -limit), limit)
        robot.push_cable(self.cable, self.force)


@dataclass
class Capstan(Law):
    """Friction of a cable over its bends: the far tension is the servo's times exp(-coefficient * bend * direction)."""

    cable: int
    coefficient: float  # 1/rad

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._fields = _ServoFields(robot, self.cable)  # with what other laws have made of them
        self._necks = geo.NUM_NECKS if self.cable < 4 else 4  # that the cable passes
        self._place = robot.data.actuator_length[robot.cables[self.cable]]
        self._direction = 0.0  # from -1, paying out, to 1, pulling

    def push(self, robot: Robot) -> None:
        place = robot.data.actuator_length[robot.cables[self.cable]]
        moved, self._place = place - self._place, place
        self._direction = min(max(self._direction + moved / _CAPSTAN_PRESLIDING, -1.0), 1.0)
        angle = np.sqrt((robot.bend()[: self._necks] ** 2).sum(axis=1)).sum()
        self._fields.scale(math.exp(-self.coefficient * angle * self._direction))


@dataclass
class Viscous(Law):
    """A drag on a cable in proportion to its speed."""

    cable: int
    drag: float  # N s/m

    def install(self, robot: Robot) -> None:
        robot.model.tendon_damping[robot.model.actuator_trnid[robot.cables[self.cable], 0]] += self.drag


@dataclass
class Compliance(Law):
    """A further spring in series with a cable."""

    cable: int
    compliance: float  # m/N

    def install(self, robot: Robot) -> None:
        stiffness = robot.model.actuator_gainprm[robot.cables[self.cable], 0]
        _ServoFields(robot, self.cable).scale(1 / (1 + stiffness * self.compliance), limit=False)


@dataclass
class TensionLimit(Law):
    """The servo can pull no harder."""

    cable: int
    limit: float  # N

    def install(self, robot: Robot) -> None:
        robot.model.actuator_forcerange[robot.cables[self.cable], 1] = min(self.limit, trunk.MAX_TENSION)


class _ServoFields:
    """The model fields that make a servo's tension, which is linear in them."""

    def __init__(self, robot: Robot, cable: int) -> None:
        self._model, self._row = robot.model, robot.cables[cable]
        self._fields = [robot.model.actuator_gainprm, robot.model.actuator_biasprm]
        self._values = [field[self._row].copy() for field in self._fields]
        self._limit = robot.model.actuator_forcerange[self._row, 1]

    def scale(self, factor: float, limit: bool = True) -> None:
        """Scale the tension, with its limit or below the same limit."""
        for field, value in zip(self._fields, self._values, strict=True):
            field[self._row] = factor * value
        if limit:
            self._model.actuator_forcerange[self._row, 1] = factor * self._limit
