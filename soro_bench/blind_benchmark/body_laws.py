"""Hidden physics that acts on vertebrae from outside: loads, gravity, drag, bands, gusts and obstacles."""

from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.robot import Law, Robot

_GUSTS_PER_SECOND = 0.4


@dataclass
class Payload(Law):
    """A point mass at a vertebra's centre of mass."""

    vertebra: int
    mass: float  # kg

    def install(self, robot: Robot) -> None:
        robot.model.body_mass[robot.links[self.vertebra + 1]] += self.mass


@dataclass
class Tilt(Law):
    """Gravity is turned about a horizontal axis, for good or to and fro."""

    angle: float  # rad
    azimuth: float  # rad, of the axis, from x towards z
    frequency: float = 0.0  # Hz

    def install(self, robot: Robot) -> None:
        down = robot.model.opt.gravity.copy()
        axis = np.array([np.cos(self.azimuth), 0.0, np.sin(self.azimuth)])
        self._down, self._sideways = down, np.cross(axis, down)
        if not self.frequency:
            self._turn(robot, self.angle)

    def push(self, robot: Robot) -> None:
        if self.frequency:
            self._turn(robot, self.angle * np.sin(2 * np.pi * self.frequency * robot.data.time))

    def _turn(self, robot: Robot, angle: float) -> None:
        robot.model.opt.gravity[:] = np.cos(angle) * self._down + np.sin(angle) * self._sideways


@dataclass
class Drag(Law):
    """A fluid resists all vertebrae by the square of their speeds."""

    drag: float  # N s^2/m^2, of each

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._place = robot.data.xipos[robot.links[1:]].copy()

    def push(self, robot: Robot) -> None:
        place = robot.data.xipos[robot.links[1:]].copy()
        velocity = (place - self._place) / robot.timestep
        self._place = place
        speed = np.sqrt((velocity * velocity).sum(axis=1))
        robot.data.xfrc_applied[robot.links[1:], :3] -= self.drag * speed[:, None] * velocity


@dataclass
class RubberBand(Law):
    """A band from a vertebra to a place in the world, which pulls when it is longer than at rest."""

    vertebra: int
    stiffness: float  # N/m
    offset: np.ndarray  # (3,) m, of the place from the vertebra's centre at the start
    length: float  # m

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._place = robot.data.xipos[robot.links[self.vertebra + 1]] + self.offset

    def push(self, robot: Robot) -> None:
        body = robot.links[self.vertebra + 1]
        span = self._place - robot.data.xipos[body]
        distance = np.sqrt(span @ span)
        stretch = max(distance - self.length, 0.0)
        robot.data.xfrc_applied[body, :3] += self.stiffness * stretch / max(distance, 1e-6) * span


@dataclass
class Wall(Law):
    """A soft wall that only one vertebra's centre can hit."""

    vertebra: int
    stiffness: float  # N/m
    normal: np.ndarray  # (3,) into the wall
    position: float  # m, of its surface along the normal

    def push(self, robot: Robot) -> None:
        body = robot.links[self.vertebra + 1]
        depth = max(robot.data.xipos[body] @ self.normal - self.position, 0.0)
        robot.data.xfrc_applied[body, :3] -= self.stiffness * depth * self.normal


@dataclass
class Gusts(Law):
    """Half-sine pulses of force on one vertebra along one line, at random times and in random senses."""

    vertebra: int
    force: float  # N, largest
    direction: np.ndarray  # (3,)
    length: float  # s, of a pulse

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        count = max(2, round(_GUSTS_PER_SECOND * robot.duration))
        self._starts = np.sort(rng.uniform(0.05, 0.95, count)) * robot.duration
        self._signs = rng.choice([-1.0, 1.0], count)

    def push(self, robot: Robot) -> None:
        phase = (robot.data.time - self._starts) / self.length
        active = (phase > 0) & (phase < 1)
        force = self.force * (self._signs * np.sin(np.pi * phase))[active].sum()
        robot.data.xfrc_applied[robot.links[self.vertebra + 1], :3] += force * self.direction
