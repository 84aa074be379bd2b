"""Probes: where on the robot something acts, whatever it is.

A constant force is let act at one place after the other, and the robot replayed: along every tendon, in three
directions on every body, on the joints of every body, and in three directions on all bodies by their mass, as gravity.
The setpoint of every actuator is moved as well, since a servo gives way to no force. Cut into short windows, of which
each may be scaled freely, these responses stand for anything at a place that changes slowly within a window; a free
offset of each measured point stands for a fault there. The place at which they explain most of what parameters and
numerical error do not explain is where something acts. No law is assumed.

A body is pushed in three directions where a tendon or an actuator pulls in one, so the windows of those are a third as
long: every place has as many free numbers. With the same windows for all, a force at the tip explained more of what the
motor of one cable did to another than that cable.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.linalg import block_diag

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.localise import WINDOWS, windows
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.robot import SIMULATIONS, Robot
from soro_bench.diagnosis.screen import responses
from soro_bench.diagnosis.suspects import suspect, typical
from soro_bench.effects.effect import Port

WINDOW = 0.15  # s, times the number of directions
UNKNOWNS = 1000  # of a place; in long recordings windows are longer
_AXES = "xyz"
_SHARE = 0.02  # of the robot's weight, a force on a body
_OFFSET = 2.0  # standard deviations of the noise, an offset of a measured point
_SCALES = np.geomspace(0.03, 30.0, 13)  # of a force in a window, standard deviations of the prior in those units


@dataclass(frozen=True)
class Force:
    """What explains most of what a hypothesis leaves if anything may act at a place, to first order.

    components: K names, such as "x" (of the world) or "pull". units: of each. start: (W,) s, beginnings of the windows,
    of all recordings one after the other; recording: (W,) their numbers; window: s, their length. values: (W, K). left:
    rms [signal's unit] of what it does not explain.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    recording: np.ndarray
    window: float
    values: np.ndarray
    left: float


@dataclass(frozen=True)
class Place:
    """A place, the evidence (natural logarithm) that any force there gains, and that force."""

    where: Port
    gain: float
    force: Force


def places(problem: Problem, robot: Robot, base: Hypothesis) -> list[Place]:
    """Where forces would explain most of what a hypothesis leaves, the best place first.

    Args:
        robot: that is pushed, with the time steps of its model.
    """
    pushes = _pushes(robot)
    pushed = zip(pushes, _responses(problem, robot, base, pushes), strict=True)
    groups: dict[tuple, list[tuple[_Push | _Offset, np.ndarray]]] = {}
    for push, row in [*pushed, *_setpoints(problem, robot, base), *_offsets(problem)]:
        groups.setdefault((push.where, push.kind), []).append((push, row))
    best: dict[Port, Place] = {}
    for (where, _), members in groups.items():
        found = _place(problem, base, where, [push for push, _ in members], np.array([row for _, row in members]))
        if where not in best or found.gain > best[where].gain:
            best[where] = found
    return sorted(best.values(), key=lambda place: -place.gain)


@dataclass(frozen=True)
class _Offset:
    """A setpoint, or one coordinate of a measured point, that is off by ``amount`` [unit]."""

    where: Port
    component: str
    unit: str
    amount: float

    @property
    def kind(self) -> str:
        return self.where.kind


@dataclass(frozen=True)
class _Push:
    """A force [N] or moment [N m] at a place, as generalised forces on the bodies or degrees of freedom ``numbers``:
    along a tendon, on a body or all of them in a direction of the world, on a joint. In all it is ``amount`` [unit]."""

    where: Port
    kind: str
    component: str
    unit: str
    amount: float
    numbers: np.ndarray
    sizes: np.ndarray

    def act(self, batch, model, row: int, step: int) -> None:
        """Let it act in a simulation until its next control step."""
        if self.kind == "world":
            if step == 0:  # and stay; effects of the robot may push the same bodies
                batch.xfrc_applied[row, self.numbers, _AXES.index(self.component)] += self.sizes
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
        size = elements.scale(port, "force")
        found.append(_Push(port, "tendon", "pull", "N", size, np.array([elements.id(port)]), np.array([size])))
    bodies = [elements.id(port) for port in robot.ports("body")]
    for port, body in zip(robot.ports("body"), bodies, strict=True):
        size = _SHARE * weight
        found += [_Push(port, "world", axis, "N", size, np.array([body]), np.array([size])) for axis in _AXES]
        for joint in elements.joints_of(body, bending_only=True):
            name, turns = model.joint(joint).name, model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
            size = elements.scale(Port("joint", name), "force")
            dof = model.jnt_dofadr[[joint]]
            found.append(_Push(port, "joint", name, "N m" if turns else "N", size, dof, np.array([size])))
    everything, size = np.arange(1, model.nbody), _SHARE * gravity
    for port in robot.ports("model"):
        pushed = size * model.body_mass[everything]
        found += [_Push(port, "world", axis, "m/s^2", size, everything, pushed) for axis in _AXES]
    return found


def _responses(problem, robot, base, pushes: Sequence[_Push]) -> np.ndarray:
    """(P, M) change of the residual under each push, in units of the noise."""
    batch, model = robot.simulation.batch, robot.simulation.model
    for name in ("ten_J", "xfrc_applied", "qfrc_applied"):
        batch.bind(name)
    parameters = np.array([list(robot.parameters(base.x).values())])
    effects, found = base.effects(problem.parameters), [np.zeros((0, problem.weight.size))]
    for first in range(0, len(pushes), SIMULATIONS - 1):
        some = pushes[first : first + SIMULATIONS - 1]  # and one replay that is not pushed

        def push(step, some=some):
            for row, one in enumerate(some):
                one.act(batch, model, row, step)

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


def _setpoints(problem, robot, base) -> list[tuple[_Offset, np.ndarray]]:
    """An offset of the setpoint of each actuator, with its (M,) change of the residual."""
    moved = [suspect(robot, "pretension", port) for port in robot.ports("actuator")]
    moved = [each for each in moved if robot.accepts([*base.effects(problem.parameters), typical(each)])]
    return [
        (
            _Offset(each.where, each.quantities[0].name, robot.setpoint_unit, each.typical[0]),
            rows[0] * each.simulated[0],
        )
        for each, rows in zip(moved, responses(problem, base, moved, robot) if moved else [], strict=True)
    ]


def _offsets(problem) -> list[tuple[_Offset, np.ndarray]]:
    """An offset of each coordinate of every measured point, with its (M,) change of the residual."""
    robot, found = problem.robot, []
    points, dimension = robot.shape
    for i in range(points):
        for k in range(dimension):
            one = np.zeros((points, dimension))
            one[i, k] = -_OFFSET
            row = np.concatenate([np.tile(one.ravel(), len(each.values)) for each in problem.recordings])
            where = Port("sensor", robot.signal, i)
            component = _AXES[k] if dimension == len(_AXES) else str(k)
            found.append((_Offset(where, component, robot.unit, _OFFSET * problem.sigma), row * problem.weight))
    return found


def _place(problem, base, where, pushes, rows) -> Place:
    """Free combinations of rows (K, M) in every window, the best of several sizes."""
    duration = sum(each.time[-1] for each in problem.recordings)
    length = max(WINDOW * len(rows), duration * len(rows) / UNKNOWNS)
    free = _Windowed(rows, windows(problem, length))
    numbers, floor = free.numbers, base.floor(problem)
    hessian = floor.product(base.slope, base.slope) + np.eye(len(base.x))
    explained, inner = free.times(floor.basis), np.eye(len(floor.basis)) + floor.basis @ floor.basis.T

    def product(other):
        """Of the free combinations with rows (C, M), the floor marginalised."""
        return free.times(other) - explained @ np.linalg.solve(inner, floor.basis @ other.T)

    cross = product(base.slope)
    reduced = np.linalg.solve(hessian, cross.T)
    information = free.squares() - explained @ np.linalg.solve(inner, explained.T) - cross @ reduced
    gradient = floor.product(base.slope, base.residual[None])[:, 0] + base.x
    pull = product(base.residual[None])[:, 0] - reduced.T @ gradient
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values, turned = np.maximum(values, 0.0), vectors.T @ pull
    gains = [
        0.5 * float((turned**2 / (values + scale**-2)).sum() - np.log1p(scale**2 * values).sum()) for scale in _SCALES
    ]
    scale = _SCALES[int(np.argmax(gains))]
    found = -vectors @ (turned / (values + scale**-2))
    step = -np.linalg.solve(hessian, gradient) - reduced @ found
    left = problem.left(base.residual + step @ base.slope + free.sum(found))
    force = Force(
        tuple(push.component for push in pushes),
        tuple(push.unit for push in pushes),
        length * (numbers % WINDOWS),
        numbers // WINDOWS,
        length,
        found.reshape(len(numbers), -1) * [push.amount for push in pushes],
        left,
    )
    return Place(where, max(gains), force)


class _Windowed:
    """Rows (K, M), each free in every window: W times K rows, a window after the other, that are zero outside theirs.

    Attributes:
        numbers: (W,) of the windows.
    """

    def __init__(self, rows: np.ndarray, window: np.ndarray):
        self.numbers, first = np.unique(window, return_index=True)  # windows rise
        self._cuts, self._parts = first[1:], np.split(rows, first[1:], axis=1)

    def times(self, other: np.ndarray) -> np.ndarray:
        """(W K, C) products with rows (C, M)."""
        parts = np.split(other, self._cuts, axis=1)
        return np.concatenate([own @ part.T for own, part in zip(self._parts, parts, strict=True)])

    def squares(self) -> np.ndarray:
        """(W K, W K) products with themselves."""
        return block_diag(*[part @ part.T for part in self._parts])

    def sum(self, factors: np.ndarray) -> np.ndarray:
        """(M,) of all, times factors (W K,)."""
        each = factors.reshape(len(self._parts), -1)
        return np.concatenate([row @ part for row, part in zip(each, self._parts, strict=True)])
