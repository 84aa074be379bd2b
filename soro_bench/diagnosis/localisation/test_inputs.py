"""What may act at a place, whatever it is: forces on tendons, bodies, joints and everything; setpoints and sensors that
are off."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from soro_bench.diagnosis.candidates import term, typical
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import SIMULATIONS, Robot
from soro_bench.effects.effect import Effect, Location

AXES = "xyz"
_SHARE = 0.02  # of the robot's weight, a force on a body
_OFFSET = 2.0  # standard deviations of the noise, an offset of a measured point
_SETPOINT = "pretension", "offset"  # the law that moves a setpoint


@dataclass(frozen=True)
class UnitInput:
    """A force [N] or moment [N m] at a place: along a tendon, on a body or all of them in a direction of the world, on
    a joint of a body or where that has none about an axis of the neck before it. In all it is ``amount`` [unit].

    kind: "tendon", "world" or "joint". axis: of the world, or of the neck.
    """

    location: Location
    kind: str
    component: str
    unit: str
    amount: float
    axis: int = 0

    def on(self, robot: Robot) -> "Act | None":
        """What exerts it on a robot; None where that lacks the place."""
        elements = robot.elements
        if self.location not in robot.locations(self.location.kind):
            return None
        if self.kind == "tendon":
            return _pull(robot, elements.id(self.location), self.amount)
        if self.location.kind == "model":
            return _apply_input(
                np.arange(1, elements.model.nbody), self.axis, self.amount * elements.model.body_mass[1:]
            )
        body = elements.id(self.location)
        if self.kind == "world":
            return _apply_input(np.array([body]), self.axis, np.array([self.amount]))
        if self.component in [elements.model.joint(j).name for j in elements.joints_of(body)]:
            return _turn(elements.model.joint(self.component).dofadr, self.amount)
        flex = elements.flex_before(body)
        return None if flex is None else _couple(robot, body, flex, self.axis, self.amount)


# adds ``factor`` times a push to the wrenches (nbody, 6) on bodies and generalised forces (nv,) of simulation ``row``
Act = Callable[[int, float, np.ndarray, np.ndarray], None]


def _apply_input(bodies, axis, sizes) -> Act:
    def act(row, factor, wrench, force):
        wrench[bodies, axis] += factor * sizes

    return act


def _turn(dof, size) -> Act:
    def act(row, factor, wrench, force):
        force[dof] += factor * size

    return act


def _pull(robot, tendon, size) -> Act:
    batch, model = robot.simulation.batch, robot.simulation.model
    entries = model.ten_J_rowadr[tendon] + np.arange(model.ten_J_rownnz[tendon])
    columns = model.ten_J_colind[entries]

    def act(row, factor, wrench, force):
        force[columns] -= factor * size * batch.ten_J[row, entries]

    return act


def _couple(robot, far, flex, axis, size) -> Act:
    batch, model = robot.simulation.batch, robot.simulation.model
    first = model.flex_nodeadr[flex]
    near = model.flex_nodebodyid[first : first + model.flex_nodenum[flex]].min()

    def act(row, factor, wrench, force):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, batch.xquat[row, near])
        moment = factor * size * matrix.reshape(3, 3)[:, axis]
        wrench[far, 3:] += moment
        wrench[near, 3:] -= moment

    return act


@dataclass(frozen=True)
class Offset:
    """A setpoint, or one coordinate of a measured point, that is off by ``amount`` [unit].

    column: of the points' coordinates, of a measured point.
    """

    location: Location
    component: str
    unit: str
    amount: float
    column: int = -1

    @property
    def kind(self) -> str:
        return self.location.kind

    def on(self, robot: Robot) -> "Act | None":
        """What moves a setpoint of a robot on which ``Source.effects`` are."""

        def act(row, factor, wrench, force):
            robot.simulation.change(_SETPOINT[0], row, self.location, _SETPOINT[1], factor * self.amount)

        return act


@dataclass(frozen=True)
class Source:
    """What acts at a place in K directions at once."""

    unit_inputs: tuple[UnitInput | Offset, ...]

    @property
    def location(self) -> Location:
        return self.unit_inputs[0].location

    @property
    def measured(self) -> bool:
        """Whether it is a fault of a sensor, which needs no replay."""
        return self.location.kind == "sensor"

    @cached_property
    def effects(self) -> list[Effect]:
        """What has to be among the effects of a robot on which it acts."""
        moved = [apply_input.location for apply_input in self.unit_inputs if apply_input.location.kind == "actuator"]
        return [Effect(_SETPOINT[0], location, {_SETPOINT[1]: 0.0}) for location in moved]

    def times(self, factor: float) -> "Source":
        """The same, so many times as large."""
        return Source(
            tuple(replace(apply_input, amount=factor * apply_input.amount) for apply_input in self.unit_inputs)
        )

    def rows(self, problem: Problem) -> np.ndarray:
        """(K, M) change of the residual under each offset of a measured point."""
        one = np.zeros((len(self.unit_inputs), int(np.prod(problem.robot.shape))))
        for row, apply_input in zip(one, self.unit_inputs, strict=True):
            row[apply_input.column] = -apply_input.amount / problem.sigma
        return np.tile(one, sum(len(each.values) for each in problem.recordings)) * problem.weight


def sources(problem: Problem, robot: Robot, base: Hypothesis) -> list[Source]:
    """Everything that may act on a robot with the effects of a hypothesis."""
    return [
        *(Source((apply_input,)) for apply_input in _on_tendons(robot)),
        *_on_bodies(robot),
        *(Source(unit_inputs) for unit_inputs in _on_everything(robot)),
        *(Source((offset,)) for offset in _on_setpoints(problem, robot, base)),
        *(Source(offsets) for offsets in _measured(problem)),
    ]


def _weight(robot) -> float:
    return _gravity(robot) * float(robot.elements.model.body_mass.sum())


def _gravity(robot) -> float:
    return float(np.linalg.norm(robot.elements.model.opt.gravity)) or 9.81


def _on_tendons(robot):
    elements = robot.elements
    for location in robot.locations("tendon"):
        yield UnitInput(location, "tendon", "pull", "N", elements.scale(location, "force"))


def _on_bodies(robot):
    """Forces on every body, and on those of its joints that have a name."""
    elements, size = robot.elements, _SHARE * _weight(robot)
    for location in robot.locations("body"):
        body = elements.id(location)
        yield Source(tuple(UnitInput(location, "world", axis, "N", size, i) for i, axis in enumerate(AXES)))
        joints = [j for j in elements.joints_of(body, bending_only=True) if elements.model.joint(j).name]
        if joints:
            yield Source(tuple(_on_joint(elements, location, joint) for joint in joints))


def _on_joint(elements, location, joint) -> UnitInput:
    model = elements.model
    name, turns = model.joint(joint).name, model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    size = elements.scale(Location("joint", name), "force")
    return UnitInput(
        location, "joint", name, "N m" if turns else "N", size, int(np.abs(model.jnt_axis[joint]).argmax())
    )


def _on_everything(robot):
    """Forces on all bodies by their mass, as gravity."""
    for location in robot.locations("model"):
        size = _SHARE * _gravity(robot)
        yield tuple(UnitInput(location, "world", axis, "m/s^2", size, i) for i, axis in enumerate(AXES))


def _on_setpoints(problem, robot, base):
    for location in robot.locations("actuator"):
        moved = term(robot, _SETPOINT[0], location)
        if robot.accepts([*base.effects(problem.parameters), typical(moved)]):
            yield Offset(location, moved.quantities[0].name, robot.setpoint_unit, moved.typical[0])


def _measured(problem):
    robot = problem.robot
    points, dimension = robot.shape
    names = AXES if dimension == len(AXES) else [str(k) for k in range(dimension)]
    for i in range(points):
        location = Location("sensor", robot.signal, i)
        yield tuple(
            Offset(location, name, robot.unit, _OFFSET * problem.sigma, i * dimension + k)
            for k, name in enumerate(names)
        )


# parameters (d,), what acts, and (T, K) factors in every control step of each recording
Acting = tuple[np.ndarray, Source, Sequence[np.ndarray]]


def replayed(problem: Problem, robot: Robot, base: Hypothesis, acting: Sequence[Acting]) -> np.ndarray:
    """(N, M) simulated [signal's unit], of a hypothesis with what acts on it in each of N replays; NaN where the robot
    lacks the place."""
    for name in ("ten_J", "xfrc_applied", "qfrc_applied", "xquat"):
        robot.simulation.batch.bind(name)
    parameters = np.array([list(robot.parameters(x[: problem.parameters]).values()) for x, _, _ in acting])
    effects = base.effects(problem.parameters)
    found = np.full((len(acting), problem.weight.size), np.nan)
    acts = [[apply_input.on(robot) for apply_input in source.unit_inputs] for _, source, _ in acting]
    possible = [i for i, some in enumerate(acts) if None not in some]
    for first in range(0, len(possible), SIMULATIONS):
        some = possible[first : first + SIMULATIONS]
        given, parts = [[*effects, *acting[i][1].effects] for i in some], []
        for k, each in enumerate(problem.recordings):
            pushed = [(acts[i], acting[i][2][k]) for i in some]
            parts.append(_simulated(robot, each.drive, parameters[some], given, pushed))
        found[some] = np.concatenate(parts, axis=1)
    return found


def _simulated(robot, drive, parameters, effects, pushed) -> np.ndarray:
    """(N, M) while acts with factors (T, K) push each of N simulations."""
    batch = robot.simulation.batch
    baseline = np.zeros((len(pushed), *batch.xfrc_applied.shape[1:]))

    def apply_input(step):
        wrench, force = np.zeros_like(baseline), np.zeros((len(pushed), batch.qfrc_applied.shape[1]))
        for row, (acts, factors) in enumerate(pushed):
            for act, factor in zip(acts, factors[step], strict=True):
                act(row, factor, wrench[row], force[row])
        batch.xfrc_applied[: len(pushed)] += wrench - baseline  # effects of the robot may push the same bodies
        batch.qfrc_applied[: len(pushed)] = force
        baseline[:] = wrench

    simulated = robot.simulate_all([drive], parameters, effects, apply_input)[0]
    batch.xfrc_applied[:] = batch.qfrc_applied[:] = 0.0
    return simulated.reshape(len(pushed), -1)


def setpoints(problem: Problem, robot: Robot, base: Hypothesis) -> list[np.ndarray]:
    """(T, nu) setpoints of the actuators in the middle of every control step of each recording."""
    batch, model = robot.simulation.batch, robot.simulation.model
    for name in ("act", "ctrl"):
        batch.bind(name)
    parameters, found = np.array([list(robot.parameters(base.x).values())]), []
    own = model.actuator_actnum > 0  # where the setpoint is the activation
    for each in problem.recordings:
        rows = []

        def note(step, rows=rows):
            rows.append(batch.ctrl[0].copy())
            rows[-1][own] = batch.act[0, model.actuator_actadr[own]]

        robot.simulate_all([each.drive], parameters, [base.effects(problem.parameters)], note)
        after = np.array([*rows[1:], np.where(own, rows[-1], batch.ctrl[0])])
        found.append(np.where(own, 0.5 * (np.array(rows) + after), after))  # a control is held from before the step on
    return found
