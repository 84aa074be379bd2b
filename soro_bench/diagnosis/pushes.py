"""What may act at a place, whatever it is: forces on tendons, bodies, joints and everything; setpoints and sensors that
are off."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import SIMULATIONS, Robot
from soro_bench.diagnosis.suspects import suspect, typical
from soro_bench.effects.effect import Effect, Port

AXES = "xyz"
_SHARE = 0.02  # of the robot's weight, a force on a body
_OFFSET = 2.0  # standard deviations of the noise, an offset of a measured point
_SETPOINT = "pretension", "offset"  # the law that moves a setpoint


@dataclass(frozen=True)
class Push:
    """A force [N] or moment [N m] at a place, as generalised forces on the bodies or degrees of freedom ``numbers``:
    along a tendon, on a body or all of them in a direction of the world, on a joint. In all it is ``amount`` [unit]."""

    where: Port
    kind: str
    component: str
    unit: str
    amount: float
    numbers: np.ndarray
    sizes: np.ndarray

    def act(self, robot: Robot, row: int, factor: float, before: float) -> None:
        """Let ``factor`` times it act in a simulation until the next control step, after ``before`` times it."""
        batch, model = robot.simulation.batch, robot.simulation.model
        if self.kind == "world":  # where effects of the robot may push the same bodies
            batch.xfrc_applied[row, self.numbers, AXES.index(self.component)] += (factor - before) * self.sizes
        elif self.kind == "joint":
            batch.qfrc_applied[row, self.numbers] = factor * self.sizes
        else:
            (tendon,) = self.numbers
            entries = model.ten_J_rowadr[tendon] + np.arange(model.ten_J_rownnz[tendon])
            batch.qfrc_applied[row, model.ten_J_colind[entries]] = -factor * self.sizes * batch.ten_J[row, entries]


@dataclass(frozen=True)
class Offset:
    """A setpoint, or one coordinate of a measured point, that is off by ``amount`` [unit].

    column: of the points' coordinates, of a measured point.
    """

    where: Port
    component: str
    unit: str
    amount: float
    column: int = -1

    @property
    def kind(self) -> str:
        return self.where.kind

    def act(self, robot: Robot, row: int, factor: float, before: float) -> None:
        """Let a setpoint be off by ``factor`` times as much until the next control step."""
        robot.simulation.change(_SETPOINT[0], row, self.where, _SETPOINT[1], factor * self.amount)


@dataclass(frozen=True)
class Source:
    """What acts at a place in K directions at once."""

    pushes: tuple[Push | Offset, ...]

    @property
    def where(self) -> Port:
        return self.pushes[0].where

    @property
    def measured(self) -> bool:
        """Whether it is a fault of a sensor, which needs no replay."""
        return self.where.kind == "sensor"

    @cached_property
    def effects(self) -> list[Effect]:
        """What has to be among the effects of a robot on which it acts."""
        moved = [push.where for push in self.pushes if push.where.kind == "actuator"]
        return [Effect(_SETPOINT[0], where, {_SETPOINT[1]: 0.0}) for where in moved]

    def rows(self, problem: Problem) -> np.ndarray:
        """(K, M) change of the residual under each offset of a measured point."""
        one = np.zeros((len(self.pushes), int(np.prod(problem.robot.shape))))
        for row, push in zip(one, self.pushes, strict=True):
            row[push.column] = -push.amount / problem.sigma
        return np.tile(one, sum(len(each.values) for each in problem.recordings)) * problem.weight


def sources(problem: Problem, robot: Robot, base: Hypothesis) -> list[Source]:
    """Everything that may act on a robot with the effects of a hypothesis."""
    return [
        *(Source((push,)) for push in _on_tendons(robot)),
        *_on_bodies(robot),
        *(Source(pushes) for pushes in _on_everything(robot)),
        *(Source((offset,)) for offset in _setpoints(problem, robot, base)),
        *(Source(offsets) for offsets in _measured(problem)),
    ]


def _weight(robot) -> float:
    return _gravity(robot) * float(robot.elements.model.body_mass.sum())


def _gravity(robot) -> float:
    return float(np.linalg.norm(robot.elements.model.opt.gravity)) or 9.81


def _on_tendons(robot):
    elements = robot.elements
    for port in robot.ports("tendon"):
        size = elements.scale(port, "force")
        yield Push(port, "tendon", "pull", "N", size, np.array([elements.id(port)]), np.array([size]))


def _on_bodies(robot):
    """Forces on every body, and on its joints."""
    elements, size = robot.elements, _SHARE * _weight(robot)
    for port in robot.ports("body"):
        body = elements.id(port)
        yield Source(tuple(Push(port, "world", axis, "N", size, np.array([body]), np.array([size])) for axis in AXES))
        joints = elements.joints_of(body, bending_only=True)
        if len(joints):
            yield Source(tuple(_on_joint(elements, port, joint) for joint in joints))


def _on_joint(elements, port, joint) -> Push:
    model = elements.model
    name, turns = model.joint(joint).name, model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    size = elements.scale(Port("joint", name), "force")
    unit, dof = "N m" if turns else "N", model.jnt_dofadr[[joint]]
    return Push(port, "joint", name, unit, size, dof, np.array([size]))


def _on_everything(robot):
    """Forces on all bodies by their mass, as gravity."""
    model, size = robot.elements.model, _SHARE * _gravity(robot)
    everything = np.arange(1, model.nbody)
    for port in robot.ports("model"):
        pushed = size * model.body_mass[everything]
        yield tuple(Push(port, "world", axis, "m/s^2", size, everything, pushed) for axis in AXES)


def _setpoints(problem, robot, base):
    for port in robot.ports("actuator"):
        moved = suspect(robot, _SETPOINT[0], port)
        if robot.accepts([*base.effects(problem.parameters), typical(moved)]):
            yield Offset(port, moved.quantities[0].name, robot.setpoint_unit, moved.typical[0])


def _measured(problem):
    robot = problem.robot
    points, dimension = robot.shape
    names = AXES if dimension == len(AXES) else [str(k) for k in range(dimension)]
    for i in range(points):
        where = Port("sensor", robot.signal, i)
        yield tuple(
            Offset(where, name, robot.unit, _OFFSET * problem.sigma, i * dimension + k) for k, name in enumerate(names)
        )


Acting = tuple[Source, Sequence[np.ndarray]]  # and (T, K) factors in every control step of each recording


def replayed(problem: Problem, robot: Robot, base: Hypothesis, acting: Sequence[Acting]) -> np.ndarray:
    """(N, M) simulated [signal's unit], of a hypothesis with what acts on it in each of N replays."""
    batch = robot.simulation.batch
    for name in ("ten_J", "xfrc_applied", "qfrc_applied"):
        batch.bind(name)
    parameters, effects = [list(robot.parameters(base.x).values())], base.effects(problem.parameters)
    found = []
    for first in range(0, len(acting), SIMULATIONS):
        some = acting[first : first + SIMULATIONS]
        given = [[*effects, *source.effects] for source, _ in some]
        parts = []
        for k, each in enumerate(problem.recordings):

            def act(step, some=some, k=k):
                for row, (source, factors) in enumerate(some):
                    now, before = factors[k][step], factors[k][step - 1] if step else np.zeros(len(source.pushes))
                    for push, factor, last in zip(source.pushes, now, before, strict=True):
                        push.act(robot, row, factor, last)

            simulated = robot.simulate_all([each.drive], np.repeat(parameters, len(some), axis=0), given, act)[0]
            parts.append(simulated.reshape(len(some), -1))
            batch.xfrc_applied[:] = batch.qfrc_applied[:] = 0.0
        found.append(np.concatenate(parts, axis=1))
    return np.concatenate(found)
