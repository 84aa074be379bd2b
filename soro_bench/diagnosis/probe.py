"""Probes: where on the robot something acts, whatever it is.

A constant force is let act at one place after the other, and the robot replayed: along every tendon, in three
directions on every body, on the joints of every body, and in three directions on all bodies by their mass, as gravity.
Cut into short windows, of which each may be scaled freely, these responses stand for any force at a place that changes
slowly within a window; a free offset of each measured point stands for a fault there. The place at which they explain
most of what parameters and numerical error do not explain is where something acts. No law is assumed.

A body is pushed in three directions where a tendon pulls in one, so the windows of a tendon are a third as long: every
place has as many free numbers. With the same windows for all, a force at the tip explained more of what the motor of
one cable did to another than that cable.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.localise import windows
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import SIMULATIONS, Robot
from soro_bench.effects.effect import Port

WINDOW = 0.15  # s, times the number of directions
_SHARE = 0.02  # of the robot's weight, a force on a body
_OFFSET = 2.0  # standard deviations of the noise, an offset of a measured point
_SCALES = np.geomspace(0.03, 30.0, 13)  # of a force in a window, standard deviations of the prior in those units


@dataclass(frozen=True)
class Place:
    """A place, and the evidence (natural logarithm) that any force there gains."""

    where: Port
    gain: float


def places(problem: Problem, robot: Robot, base: Hypothesis) -> list[Place]:
    """Where forces would explain most of what a hypothesis leaves, the best place first.

    Args:
        robot: that is pushed, with the time steps of its model.
    """
    pushes = _pushes(robot)
    groups: dict[tuple, list[np.ndarray]] = {}
    for push, row in zip(pushes, _responses(problem, robot, base, pushes), strict=True):
        groups.setdefault((push.where, push.kind), []).append(row)
    best: dict[Port, float] = {}
    for (where, _), rows in [*groups.items(), *_offsets(problem)]:
        best[where] = max(_gain(problem, base, np.array(rows)), best.get(where, -np.inf))
    return sorted((Place(*each) for each in best.items()), key=lambda place: -place.gain)


@dataclass(frozen=True)
class _Push:
    """A force [N] or moment [N m] at a place, as generalised forces on the bodies or degrees of freedom ``numbers``:
    along a tendon, on a body or all of them in a direction of the world, on a joint."""

    where: Port
    kind: str
    numbers: np.ndarray
    sizes: np.ndarray
    axis: int = 0

    def act(self, batch, model, row: int) -> None:
        """Let it act in a simulation until its next control step."""
        if self.kind == "world":
            batch.xfrc_applied[row, self.numbers, self.axis] = self.sizes
        elif self.kind == "joint":
            batch.qfrc_applied[row, self.numbers] = self.sizes
        else:
            (tendon,) = self.numbers
            entries = model.ten_J_rowadr[tendon] + np.arange(model.ten_J_rownnz[tendon])
            batch.qfrc_applied[row, model.ten_J_colind[entries]] = -self.sizes * batch.ten_J[row, entries]


def _pushes(robot: Robot) -> list[_Push]:
    """Every place in every direction in which it is pushed."""
    elements, model = robot.elements, robot.elements.model
    gravity = float(np.linalg.norm(model.opt.gravity)) or 9.81
    weight, found = gravity * float(model.body_mass.sum()), []
    for port in robot.ports("tendon"):
        size = np.array([elements.scale(port, "force")])
        found.append(_Push(port, "tendon", np.array([elements.id(port)]), size))
    bodies = [elements.id(port) for port in robot.ports("body")]
    for port, body in zip(robot.ports("body"), bodies, strict=True):
        size = np.array([_SHARE * weight])
        found += [_Push(port, "world", np.array([body]), size, axis) for axis in range(3)]
        for joint in elements.joints_of(body, bending_only=True):
            size = np.array([elements.scale(Port("joint", model.joint(joint).name), "force")])
            found.append(_Push(port, "joint", model.jnt_dofadr[[joint]], size))
    mass = model.body_mass[bodies]
    for port in robot.ports("model"):
        found += [_Push(port, "world", np.array(bodies), _SHARE * gravity * mass, axis) for axis in range(3)]
    return found


def _responses(problem, robot, base, pushes: Sequence[_Push]) -> np.ndarray:
    """(P, M) change of the residual under each push, in units of the noise."""
    batch, model = robot.simulation.batch, robot.simulation.model
    for name in ("ten_J", "xfrc_applied", "qfrc_applied"):
        batch.bind(name)
    parameters = np.array([list(robot.parameters(base.x).values())])
    effects, found = base.effects(problem.parameters), []
    for first in range(0, len(pushes), SIMULATIONS - 1):
        some = pushes[first : first + SIMULATIONS - 1]  # and one replay that is not pushed

        def push(_, some=some):
            for row, one in enumerate(some):
                one.act(batch, model, row)

        n = len(some) + 1
        parts = [
            robot.simulate_all([each.drive], np.repeat(parameters, n, axis=0), [effects] * n, push)[0]
            for each in problem.recordings
        ]
        rows = np.concatenate([part.reshape(n, -1) for part in parts], axis=1)
        found.append((rows[-1] - rows[:-1]) / problem.sigma * problem.weight)
        batch.xfrc_applied[:] = 0.0
        batch.qfrc_applied[:] = 0.0
    return np.nan_to_num(np.concatenate(found))


def _offsets(problem) -> list[tuple[tuple[Port, str], np.ndarray]]:
    """Of every measured point, its place and an offset of each of its coordinates, (D, M)."""
    robot = problem.robot
    points, dimension = robot.shape
    found = []
    for i in range(points):
        rows = []
        for k in range(dimension):
            one = np.zeros((points, dimension))
            one[i, k] = _OFFSET
            rows.append(np.concatenate([np.tile(one.ravel(), len(each.values)) for each in problem.recordings]))
        found.append(((Port("sensor", robot.signal, i), "sensor"), np.array(rows) * problem.weight))
    return found


def _gain(problem, base, rows) -> float:
    """Evidence of free combinations of rows (K, M) in every window, for the best of several sizes."""
    window = windows(problem, WINDOW * len(rows))
    free = np.concatenate([rows * (window == w) for w in np.unique(window)])
    floor = base.floor(problem)
    hessian = floor.product(base.slope, base.slope) + np.eye(len(base.x))
    cross = floor.product(free, base.slope)
    reduced = np.linalg.solve(hessian, cross.T)
    information = floor.product(free, free) - cross @ reduced
    gradient = floor.product(base.slope, base.residual[None])[:, 0] + base.x
    pull = floor.product(free, base.residual[None])[:, 0] - reduced.T @ gradient
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values, pull = np.maximum(values, 0.0), vectors.T @ pull
    return max(
        0.5 * float((pull**2 / (values + scale**-2)).sum() - np.log1p(scale**2 * values).sum()) for scale in _SCALES
    )
