"""Test inputs: what may act at a location, without a law.

Forces on tendons, bodies, joints and on all bodies at once; offsets of setpoints and of measured points.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from soro_bench.diagnosis.candidates import term, typical
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.replays import SIMULATIONS
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect, Location
from soro_bench.effects.elements import Elements

AXES = "xyz"
_WEIGHT_SHARE = 0.02  # of a robot's weight, first size of a force on a body, which is then scaled
_SETPOINT = "pretension", "offset"  # the law that moves a setpoint, and its quantity

# adds ``factor`` times an input to the wrenches (nbody, 6) on bodies and generalised forces (nv,) of simulation ``row``
Act = Callable[[int, float, np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class UnitInput:
    """A force [N] or moment [N m] of a factor of one.

    It acts along a tendon; on a body, or on all of them, in a direction of the world; on a joint of a body; or, where a
    body has no joint, about an axis of the neck before it.

    kind: "tendon", "world" or "joint". component: its name. amount: of it in all, in ``unit``. axis: of the world, or
    of the neck.
    """

    location: Location
    kind: str
    component: str
    unit: str
    amount: float
    axis: int = 0

    def on(self, robot: Robot) -> Act | None:
        """What exerts it on a robot; None where the robot lacks the location."""
        elements = robot.elements
        if self.location not in robot.locations(self.location.kind):
            return None
        if self.kind == "tendon":
            return _pull(robot, elements.id(self.location), self.amount)
        if self.location.kind == "model":
            bodies = np.arange(1, elements.model.nbody)
            return _force(bodies, self.axis, self.amount * elements.model.body_mass[1:])
        body = elements.id(self.location)
        if self.kind == "world":
            return _force(np.array([body]), self.axis, np.array([self.amount]))
        if self.component in [elements.model.joint(j).name for j in elements.joints_of(body)]:
            return _turn(elements.model.joint(self.component).dofadr, self.amount)
        flex = elements.flex_before(body)
        return None if flex is None else _couple(robot, body, flex, self.axis, self.amount)


def _force(bodies: np.ndarray, axis: int, sizes: np.ndarray) -> Act:
    """Forces of these sizes [N] on bodies, along an axis of the world."""

    def act(row: int, factor: float, wrench: np.ndarray, force: np.ndarray) -> None:
        wrench[bodies, axis] += factor * sizes

    return act


def _turn(dof: np.ndarray, size: float) -> Act:
    """A force or moment along a degree of freedom."""

    def act(row: int, factor: float, wrench: np.ndarray, force: np.ndarray) -> None:
        force[dof] += factor * size

    return act


def _pull(robot: Robot, tendon: int, size: float) -> Act:
    """A force [N] that shortens a tendon."""
    batch, model = robot.simulation.batch, robot.simulation.model
    entries = model.ten_J_rowadr[tendon] + np.arange(model.ten_J_rownnz[tendon])
    columns = model.ten_J_colind[entries]

    def act(row: int, factor: float, wrench: np.ndarray, force: np.ndarray) -> None:
        force[columns] -= factor * size * batch.ten_J[row, entries]

    return act


def _couple(robot: Robot, far: int, flex: int, axis: int, size: float) -> Act:
    """A moment [N m] between the two bodies of a neck, about an axis of the one near the base."""
    batch, model = robot.simulation.batch, robot.simulation.model
    first = model.flex_nodeadr[flex]
    near = model.flex_nodebodyid[first : first + model.flex_nodenum[flex]].min()

    def act(row: int, factor: float, wrench: np.ndarray, force: np.ndarray) -> None:
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, batch.xquat[row, near])
        moment = factor * size * matrix.reshape(3, 3)[:, axis]
        wrench[far, 3:] += moment
        wrench[near, 3:] -= moment

    return act


@dataclass(frozen=True)
class Offset:
    """A setpoint, or one coordinate of a measured point, that is off by ``amount`` [unit].

    column: of the numbers of a sample, of a measured point.
    """

    location: Location
    component: str
    unit: str
    amount: float
    column: int = -1

    @property
    def kind(self) -> str:
        """The kind of its location."""
        return self.location.kind

    def on(self, robot: Robot) -> Act | None:
        """What moves a setpoint of a robot that has the effects of its ``Source``."""

        def act(row: int, factor: float, wrench: np.ndarray, force: np.ndarray) -> None:
            robot.simulation.change(_SETPOINT[0], row, self.location, _SETPOINT[1], factor * self.amount)

        return act


@dataclass(frozen=True)
class Source:
    """A test input: K unit inputs that act at a location at once."""

    unit_inputs: tuple[UnitInput | Offset, ...]

    @property
    def location(self) -> Location:
        """Where it acts."""
        return self.unit_inputs[0].location

    @property
    def kind(self) -> str:
        """Of its unit inputs."""
        return self.unit_inputs[0].kind

    @property
    def measured(self) -> bool:
        """Whether it is a sensor fault, which needs no replay."""
        return self.location.kind == "sensor"

    @cached_property
    def effects(self) -> list[Effect]:
        """Effects that a robot needs for it to act."""
        moved = [unit_input.location for unit_input in self.unit_inputs if unit_input.location.kind == "actuator"]
        return [Effect(_SETPOINT[0], location, {_SETPOINT[1]: 0.0}) for location in moved]

    def times(self, factor: float) -> "Source":
        """The same, ``factor`` times as large."""
        return Source(tuple(replace(each, amount=factor * each.amount) for each in self.unit_inputs))

    def rows(self, problem: Problem) -> np.ndarray:
        """(K, M) change of the residual by each offset of a measured point."""
        rows, sigmas = np.zeros((len(self.unit_inputs), problem.robot.columns)), problem.of_columns(problem.sigmas)
        for row, offset in zip(rows, self.unit_inputs, strict=True):
            if isinstance(offset, Offset):
                row[offset.column] = -offset.amount / sigmas[offset.column]
        return np.tile(rows, sum(len(recording.values) for recording in problem.recordings)) * problem.weight


def sources(problem: Problem, robot: Robot, base: Hypothesis) -> list[Source]:
    """Every test input of a robot with the effects of a hypothesis."""
    return [
        *(Source((pull,)) for pull in _on_tendons(robot)),
        *_on_bodies(robot, _WEIGHT_SHARE),
        *(Source(accelerations) for accelerations in _on_everything(robot, _WEIGHT_SHARE)),
        *(Source((offset,)) for offset in _on_setpoints(problem, robot, base)),
        *(Source(offsets) for offsets in _on_sensor(problem)),
    ]


def _weight(robot: Robot) -> float:
    """Of all bodies [N]."""
    return _gravity(robot) * float(robot.elements.model.body_mass.sum())


def _gravity(robot: Robot) -> float:
    """Its size in the model [m/s^2], or that on earth where the model has none."""
    return float(np.linalg.norm(robot.elements.model.opt.gravity)) or 9.81


def _on_tendons(robot: Robot) -> Iterator[UnitInput]:
    """A pull of every tendon."""
    elements = robot.elements
    for location in robot.locations("tendon"):
        yield UnitInput(location, "tendon", "pull", "N", elements.scale(location, "force"))


def _on_bodies(robot: Robot, share: float) -> Iterator[Source]:
    """Forces of a share of the robot's weight on every body, and on those of its joints that have a name."""
    elements, size = robot.elements, share * _weight(robot)
    for location in robot.locations("body"):
        body = elements.id(location)
        yield Source(tuple(UnitInput(location, "world", axis, "N", size, i) for i, axis in enumerate(AXES)))
        joints = [j for j in elements.joints_of(body, bending_only=True) if elements.model.joint(j).name]
        if joints:
            yield Source(tuple(_on_joint(elements, location, joint) for joint in joints))


def _on_joint(elements: Elements, location: Location, joint: int) -> UnitInput:
    """A moment about a hinge, or a force along a slide."""
    model = elements.model
    name, turns = model.joint(joint).name, model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    size, axis = elements.scale(Location("joint", name), "force"), int(np.abs(model.jnt_axis[joint]).argmax())
    return UnitInput(location, "joint", name, "N m" if turns else "N", size, axis)


def _on_everything(robot: Robot, share: float) -> Iterator[tuple[UnitInput, ...]]:
    """Forces on all bodies by their mass, as a share of gravity."""
    for location in robot.locations("model"):
        size = share * _gravity(robot)
        yield tuple(UnitInput(location, "world", axis, "m/s^2", size, i) for i, axis in enumerate(AXES))


def _on_setpoints(problem: Problem, robot: Robot, base: Hypothesis) -> Iterator[Offset]:
    """An offset of every setpoint that can have one beside the effects of the hypothesis."""
    for location in robot.locations("actuator"):
        moved = term(robot, _SETPOINT[0], location, problem.settings.priors)
        if robot.accepts([*base.effects(problem.parameters), typical(moved)]):
            yield Offset(location, moved.quantities[0].name, robot.setpoint_unit_at(location), moved.typical[0])


def _on_sensor(problem: Problem) -> Iterator[tuple[Offset, ...]]:
    """Offsets of every measured point."""
    first = 0
    for signal, sigma in zip(problem.robot.signals, problem.sigmas, strict=True):
        points, dimension = signal.shape
        names = AXES if dimension == len(AXES) else [str(k) for k in range(dimension)]
        size = problem.settings.localisation.reach * sigma
        # the axes of a frame are not offset alone
        for i in range(0 if signal.directions and signal in problem.robot.others else points):
            location, start = Location("sensor", signal.name, i), first + i * dimension
            yield tuple(Offset(location, name, signal.unit, size, start + k) for k, name in enumerate(names))
        first += signal.size


# parameters (d,), the test input, and (T, K) factors in every control step of each recording
Acting = tuple[np.ndarray, Source, Sequence[np.ndarray]]


def replayed(problem: Problem, robot: Robot, base: Hypothesis, acting: Sequence[Acting]) -> np.ndarray:
    """(N, M) signal [signal's unit] of N replays of a hypothesis under test inputs.

    NaN where the robot lacks the location.

    Args:
        acting: of each replay: parameters (d,), the test input, and its factors (T, K) in each recording.
    """
    for name in ("ten_J", "xfrc_applied", "qfrc_applied", "xquat"):
        robot.simulation.batch.bind(name)
    parameters = np.array([list(robot.parameters(x[: problem.parameters]).values()) for x, _, _ in acting])
    effects = base.effects(problem.parameters)
    signals = np.full((len(acting), problem.weight.size), np.nan)
    acts = [acts_of(robot, source) for _, source, _ in acting]
    possible = [i for i, own in enumerate(acts) if own is not None]
    for first in range(0, len(possible), SIMULATIONS):
        batch = possible[first : first + SIMULATIONS]
        given, parts = [[*effects, *acting[i][1].effects] for i in batch], []
        for k, recording in enumerate(problem.recordings):
            inputs = [(acts[i] or [], acting[i][2][k]) for i in batch]
            parts.append(simulated_under(robot, recording.drive, parameters[batch], given, inputs))
        signals[batch] = problem.scaled(parts)
    return signals


def acts_of(robot: Robot, source: Source) -> list[Act] | None:
    """What exerts the unit inputs of a test input on a robot; None where it lacks the location."""
    acts = [unit_input.on(robot) for unit_input in source.unit_inputs]
    possible = [act for act in acts if act is not None]
    return possible if len(possible) == len(acts) else None


def simulated_under(
    robot: Robot,
    drive: Drive,
    parameters: np.ndarray,
    effects: Sequence[Sequence[Effect]],
    inputs: Sequence[tuple[list[Act], np.ndarray]],
    note: Callable[[], None] | None = None,
) -> np.ndarray:
    """(N, T, C) signals while acts with factors (T, K) are exerted in each of N simulations.

    Args:
        note: called before every control step.
    """
    batch = robot.simulation.batch
    before = np.zeros((len(inputs), *batch.xfrc_applied.shape[1:]))
    turned = np.zeros((len(inputs), batch.qfrc_applied.shape[1]))

    def exert(step: int) -> None:
        if note:
            note()
        wrench, force = np.zeros_like(before), np.zeros_like(turned)
        for row, (acts, factors) in enumerate(inputs):
            for act, factor in zip(acts, factors[step], strict=True):
                act(row, factor, wrench[row], force[row])
        batch.xfrc_applied[: len(inputs)] += wrench - before  # effects of the robot may act on the same bodies
        batch.qfrc_applied[: len(inputs)] += force - turned
        before[:], turned[:] = wrench, force

    try:
        return robot.simulate_all([drive], parameters, effects, exert)[0]
    finally:
        batch.xfrc_applied[:] = batch.qfrc_applied[:] = 0.0


def setpoints(problem: Problem, robot: Robot, base: Hypothesis) -> list[np.ndarray]:
    """(T, nu) setpoints of the actuators in the middle of every control step of each recording."""
    batch, model = robot.simulation.batch, robot.simulation.model
    for name in ("act", "ctrl"):
        batch.bind(name)
    parameters, middles = np.array([list(robot.parameters(base.x).values())]), []
    own = model.actuator_actnum > 0  # where the setpoint is the activation
    for recording in problem.recordings:
        rows: list[np.ndarray] = []

        def note(step: int, rows: list[np.ndarray] = rows) -> None:
            rows.append(batch.ctrl[0].copy())
            rows[-1][own] = batch.act[0, model.actuator_actadr[own]]

        robot.simulate_all([recording.drive], parameters, [base.effects(problem.parameters)], note)
        after = np.array([*rows[1:], np.where(own, rows[-1], batch.ctrl[0])])
        # a control is held from before the step on
        middles.append(np.where(own, 0.5 * (np.array(rows) + after), after))
    return middles
