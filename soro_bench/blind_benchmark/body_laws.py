"""Hidden physics of vertebrae and necks: loads, gravity, drag, obstacles; moments and stiffness of the material.

The moments are explicit. The necks' own damping, implicit in the engine, is their stiffness times 0.07 s or more, so a
further stiffness of twenty times the neck's is stable at a step of 5 ms.
"""

from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.robot import Law, Robot
from soro_bench.models import trunk_geometry as geo

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
    """A band from a vertebra to a point of the world, which pulls when it is longer than at rest."""

    vertebra: int
    stiffness: float  # N/m
    offset: np.ndarray  # (3,) m, of the point from the vertebra's centre at the start
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


_YIELDS = np.array([0.4, 1.0, 2.2])  # of the elements of a hysteresis, in parts of the yield angle
_SHARES = np.array([0.45, 0.35, 0.2])  # of its moment


@dataclass
class Hysteresis(Law):
    """Three springs with dry sliders, parallel to one neck's bending."""

    neck: int
    moment: float  # N m, when all slide
    angle: float  # rad, about which they begin to

    @property
    def stiffness(self) -> float:
        """Of all springs before they slide [N m/rad]."""
        return float(self.moment * (_SHARES / (self.angle * _YIELDS)).sum())

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._stretch = np.zeros((len(_YIELDS), 3))  # rad, of the springs
        self._bend = robot.bend()[self.neck]

    def push(self, robot: Robot) -> None:
        bend, limits = robot.bend()[self.neck], self.angle * _YIELDS
        self._stretch += bend - self._bend
        self._bend = bend
        size = np.sqrt((self._stretch**2).sum(axis=1))
        self._stretch *= np.minimum(1, limits / np.maximum(size, 1e-12))[:, None]
        moment = -self.moment * (_SHARES / limits) @ self._stretch
        robot.push_necks(_only(self.neck, moment))


@dataclass
class PlasticSet(Law):
    """A neck's rest shape moves when it is bent too far: by ``share`` of what exceeds the yield angle."""

    neck: int
    angle: float  # rad
    share: float

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self.rest = np.zeros(3)  # rad

    def push(self, robot: Robot) -> None:
        if self.share == 0:
            return
        misfit = robot.bend()[self.neck] - self.rest / self.share
        size = np.sqrt(misfit @ misfit)
        if size > self.angle:
            self.rest = self.rest + self.share * (1 - self.angle / size) * misfit
        robot.push_necks(_only(self.neck, robot.neck_stiffness[self.neck] * self.rest))


@dataclass
class LocalStiffness(Law):
    """One neck is a multiple as stiff as it should be, with its damping."""

    neck: int
    factor: float

    def install(self, robot: Robot) -> None:
        robot.neck_factors[self.neck] *= self.factor
        robot.scale_necks()


@dataclass
class StiffnessDrift(Law):
    """All necks become stiffer, or softer, with the clock."""

    rate: float  # 1/s

    def push(self, robot: Robot) -> None:
        robot.scale_necks(1 + self.rate * robot.data.time)


@dataclass
class Creep(Law):
    """All necks are standard linear solids in bending: a spring and a dashpot in series lie parallel to each."""

    ratio: float  # of that spring to the neck
    time_constant: float  # s

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._dashpot = robot.bend()

    def push(self, robot: Robot) -> None:
        bend = robot.bend()
        self._dashpot += -np.expm1(-robot.timestep / self.time_constant) * (bend - self._dashpot)
        robot.push_necks(self.ratio * robot.neck_stiffness[:, None] * (self._dashpot - bend))


@dataclass
class Stiffening(Law):
    """All necks resist bending with a cubic term too."""

    cubic: float  # 1/rad^2

    def push(self, robot: Robot) -> None:
        bend = robot.bend()
        square = (bend * bend).sum(axis=1)
        robot.push_necks(-(self.cubic * robot.neck_stiffness * square)[:, None] * bend)


@dataclass
class Mullins(Law):
    """All necks are softer below the largest bend that they have had; the first time, they follow their own curve."""

    softening: float  # largest share of the stiffness that is lost
    angle: float  # rad, over which it is lost

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        self._largest = np.full(geo.NUM_NECKS, 1e-9)

    def push(self, robot: Robot) -> None:
        bend = robot.bend()
        size = np.sqrt((bend * bend).sum(axis=1))
        self._largest = np.maximum(self._largest, size)
        lost = self.softening * -np.expm1(-self._largest / self.angle) * (1 - size / self._largest)
        robot.push_necks((lost * robot.neck_stiffness)[:, None] * bend)


@dataclass
class CoupledBend(Law):
    """One neck is bent in proportion to another's bend, a quarter turn about the axis away."""

    source: int
    neck: int
    share: float  # of the neck's stiffness

    def push(self, robot: Robot) -> None:
        x, y, _ = robot.bend()[self.source]
        robot.push_necks(_only(self.neck, self.share * robot.neck_stiffness[self.neck] * np.array([-y, x, 0.0])))


def _only(neck: int, moment: np.ndarray) -> np.ndarray:
    """(10, 3) moments, all but one zero."""
    moments = np.zeros((geo.NUM_NECKS, 3))
    moments[neck] = moment
    return moments
