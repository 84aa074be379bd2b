"""The unknown input where a law is looked for: the motion under it, and what a force of any course would change."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.discovery.library import Read, Shape, Term, series, variables_at
from soro_bench.diagnosis.estimation.fit import Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.input_models import Free
from soro_bench.diagnosis.localisation.test_inputs import AXES, Act, Acting, Source, acts_of, replayed, simulated_under
from soro_bench.diagnosis.localisation.unknown_inputs import Covariance, Estimate
from soro_bench.diagnosis.robots.replays import SIMULATIONS
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.custom_law import CustomLaw, Variable
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank

_PEAKS = 3  # of the input's spectrum, that a periodic law may have
_FIELDS = ("qpos", "qvel", "act", "ctrl", "actuator_force", "ten_length", "ten_velocity", "xipos")
Motion = dict[str, Floats]  # fields of MuJoCo, (1 + T, ...) of a recording


@dataclass(frozen=True)
class Channel:
    """A component of an input as a law may exert it: where, along which axis of the world, and in which unit."""

    location: Location
    direction: str
    unit: str


def channels(robot: Robot, source: Source) -> list[Channel]:
    """Of every component of an input; none where no law can act, as at a sensor or across a neck of flex."""
    found = []
    for each in source.unit_inputs:
        at, direction = each.location, ""
        if each.kind == "joint":
            at = Location("joint", each.component)
            if at not in robot.elements.locations("joint"):
                return []
        elif each.kind == "world":
            direction = each.component
        elif each.kind not in ("tendon", "actuator"):
            return []
        found.append(Channel(at, direction, each.unit))
    return found


class LocatedInput:
    """An input at a location, with the motion under it.

    Attributes:
        channels: K components. force: (T, K) in the control steps of all recordings [their units].
        reads: of each channel, what a law there may read. lengths: control steps of each recording.
        place: (T, 3) m, of the body that it acts on; None elsewhere.
    """

    def __init__(self, problem: Problem, robot: Robot, base: Hypothesis, estimate: Estimate):
        self.problem, self.robot, self.base, self.estimate = problem, robot, base, estimate
        self.channels = channels(robot, estimate.source)
        self.amounts = np.array([each.amount for each in estimate.source.unit_inputs])
        factors = estimate.acting[2]
        self.force = np.concatenate(factors) * self.amounts
        self.lengths = [len(each) for each in factors]
        x, source, _ = estimate.acting
        effects = [*base.effects(problem.parameters), *source.effects]
        acts = acts_of(robot, source) or []
        self._motion = _recorded(problem, robot, x, effects, [(acts, each) for each in factors])
        settings = problem.settings.discovery
        self.reads = []
        for each in self.channels:
            pairs = variables_at(robot, each.location, settings)
            self.reads.append([Read(v, self.values(v, each.location), unit) for v, unit in pairs])
        at = self.channels[0].location
        on_body = at.kind == "body"
        columns = [_values(self._motion, robot, self._dt, Variable(a, "position", 0, 0, None, a), at) for a in AXES
                   if on_body]  # fmt: skip
        self.place = np.stack(columns, axis=1) if on_body else None
        self._respond()

    def values(self, variable: Variable, own: Location) -> Floats:
        """(T,) of a variable in the middle of every control step."""
        return _values(self._motion, self.robot, self._dt, variable, own)

    def seen(self, effect: Effect, tested: Problem, x: Floats, effects: Sequence[Effect]) -> CustomLaw:
        """The law of an effect with the ranges that its variables had in these recordings and in held-out ones.

        Args:
            x, effects: of the robot that replays held-out recordings.
        """
        assert effect.law is not None
        nothing: list[tuple[list[Act], Floats]] = [([], np.zeros((len(each.values), 0))) for each in tested.recordings]
        motion = [*self._motion, *_recorded(tested, self.robot, x, effects, nothing)]
        found = []
        for each in effect.law.variables:
            if each.of != "time":
                values = self._read(motion, each, effect)
                each = replace(each, low=float(values.min()), high=float(values.max()))
            found.append(each)
        return replace(effect.law, variables=tuple(found))

    def _read(self, motion: Sequence[Motion], variable: Variable, effect: Effect) -> Floats:
        """(T,) of a variable of an effect."""
        if variable.of != "distance":
            return _values(motion, self.robot, self._dt, variable, effect.location)
        axes = [Variable(axis, "position", 0.0, 0.0, variable.place, axis) for axis in AXES]
        place = [_values(motion, self.robot, self._dt, each, effect.location) for each in axes]
        point = [effect.parameters[x] if isinstance(x, str) else x for x in variable.point]
        return np.asarray(np.linalg.norm(np.stack(place, axis=1) - point, axis=1))

    def _respond(self) -> None:
        """Replay a pulse of every component at every node; nodes are as close as replays side by side allow."""
        problem, (x, source, factors) = self.problem, self.estimate.acting
        dt, settings, count = problem.robot.control_timestep, problem.settings.localisation, len(self.channels)
        every = max(1, math.ceil(settings.memory / dt * count / SIMULATIONS))
        finer = replace(settings, node_spacing=every * dt, most_values=10**6)
        near = replace(problem, settings=replace(problem.settings, localisation=finer))
        self._nodes = Free(near, count)
        pulses = self._nodes.pulses()
        nothing: Acting = (self.base.x, Source(()), [np.zeros((len(f), 0)) for f in factors])
        asked = [nothing, (x, source, factors)]
        for unit in np.eye(count):
            asked += [(x, source, [f + settings.pulse * one * unit for f, one in zip(factors, pulse, strict=True)])
                      for pulse in pulses]  # fmt: skip
        without, here, *moved = -replayed(problem, self.robot, self.base, asked) / problem.sigma * problem.weight
        rows = np.nan_to_num(np.array(moved) - here) / settings.pulse
        estimate = self.estimate
        left = np.nan_to_num(self.base.residual + here - without) - estimate.x @ estimate.jacobian
        basis = np.concatenate([problem.discretisation.basis, estimate.error, estimate.jacobian])
        smaller = self._smaller(LowRank(basis).without(left))
        self._rows = self._nodes.parts(smaller * rows.reshape(count, len(pulses), -1))
        left, self.covariance = smaller * left, Covariance(smaller * basis)
        self._jacobian = smaller * estimate.jacobian
        self._discretisation = LowRank(smaller * basis[: len(basis) - len(estimate.jacobian)])
        self.origin = left - self.changed(self.force)  # the residual without the input, to first order
        self.explained = self._cost(self.origin) - self._cost(left)
        self._white, self._of_rows = self.covariance.white(self._rows), self._rows @ self._rows.T
        self._pull = self._rows @ self.origin - self._white @ self.covariance.white(self.origin[None])[0]

    def _smaller(self, left: Floats) -> float:
        """How many times smaller than in the fit noise is here: where the misfit dominated, it is what the input
        leaves (M,), as all of the misfit would hide which term is right."""
        problem = self.problem
        rms = float(np.sqrt((left**2).sum() / problem.weight.sum()))
        return 1.0 / min(max(rms, problem.sensor / problem.sigma), 1.0)

    def _cost(self, residual: Floats) -> float:
        return 0.5 * float(residual @ residual - (self.covariance.white(residual[None]) ** 2).sum())

    def changed(self, force: Floats) -> Floats:
        """(M,) change of the residual by a force (T, K), to first order."""
        return np.asarray(self._rows.T @ self.at_nodes(force))

    def at_nodes(self, force: Floats) -> Floats:
        """(N,) a force (T, K) at all nodes, as pulses were replayed there."""
        parts = np.split(force / self.amounts, np.cumsum(self.lengths)[:-1])
        return np.asarray(self._nodes.nodes.values(parts).ravel())

    def products(self, forces: Floats) -> tuple[Floats, Floats]:
        """Products, under the covariance, of what forces (n, N) at the nodes change.

        Pulses that are farther apart than the robot's memory have none, so this costs less than the changes do.

        Returns:
            (n, n) with each other, and (n,) with the residual without the input.
        """
        white = forces @ self._white
        return np.asarray(self._of_rows @ forces.T).T @ forces.T - white @ white.T, forces @ self._pull

    def parameters(self, changed: Floats) -> Floats:
        """(d,) the most probable ones beside a law that changes the residual by (M,), to first order."""
        given = self.origin + changed
        hessian, gradient = normal_equations(self._discretisation, self._jacobian, given, np.zeros(self._d))
        return np.asarray(-np.linalg.solve(hessian, gradient), float)

    @property
    def _d(self) -> int:
        return self.problem.parameters

    def feature(self, term: Term, channel: int) -> Floats:
        """(T,) of a term of the law of a channel."""
        values = {each.name: each.values for each in self.reads[channel]}
        return series(term, values, self.lengths, self._dt)

    def distances(self, effect: Effect) -> list[Read]:
        """Of the body from the points that a law reads."""
        found = []
        for each in effect.law.variables if effect.law else ():
            if each.point and self.place is not None:
                point = [effect.parameters[x] if isinstance(x, str) else x for x in each.point]
                found.append(Read(each, np.linalg.norm(self.place - point, axis=1), "m"))
        return found

    def exerted(self, effect: Effect, reads: Sequence[Read]) -> Floats:
        """(T,) what a law exerts along the motion.

        Args:
            reads: what it may read.
        """
        assert effect.law is not None
        shapes = tuple(Shape(name, value, "") for name, value in effect.parameters.items())
        term = Term(effect.law.expression, "", (), effect.law.states, shapes)
        return series(term, {each.name: each.values for each in reads}, self.lengths, self._dt)

    def along(self, effect: Effect, channel: int) -> Floats:
        """(T,) the input along the direction of a law: of its channel, or towards its point."""
        if effect.law is None or isinstance(effect.law.direction, str) or self.place is None:
            return self.force[:, channel]
        point = [effect.parameters[x] if isinstance(x, str) else x for x in effect.law.direction]
        way = np.array(point) - self.place
        return (self.force * way).sum(axis=1) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)

    @property
    def _dt(self) -> float:
        return self.problem.robot.control_timestep

    def peaks(self) -> list[float]:
        """rad/s, where the spectrum of the input is largest, the largest peak first."""
        dt, longest = self.problem.robot.control_timestep, max(self.lengths)
        frequencies = np.fft.rfftfreq(4 * longest, dt)
        power = np.zeros(len(frequencies))
        for part in np.split(self.force, np.cumsum(self.lengths)[:-1]):
            moved = (part - part.mean(axis=0)) * np.hanning(len(part))[:, None]
            power += (np.abs(np.fft.rfft(moved, 4 * longest, axis=0)) ** 2).sum(axis=1)
        power[frequencies < 1.0 / (longest * dt)] = 0.0
        inner = (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
        peaks = 1 + np.flatnonzero(inner)
        order = peaks[np.argsort(-power[peaks], kind="stable")][:_PEAKS]
        return [2.0 * np.pi * float(frequencies[i]) for i in order]

    def pulls(self, point: Floats, power: float) -> Floats:
        """(T, 3) forces of a power of the distance from a point [m], towards it, of a coefficient of one."""
        assert self.place is not None
        way = np.asarray(point) - self.place
        distance = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-3)
        return way / distance * distance**power

    def meeting_point(self) -> Floats | None:
        """(3,) m, where the lines of a force on a body meet: the nearest point to all of them; None for others."""
        if self.place is None or self.force.shape[1] != len(AXES):
            return None
        size = np.linalg.norm(self.force, axis=1, keepdims=True)
        way = self.force / np.maximum(size, 1e-12)
        across = size[:, :, None] ** 2 * (np.eye(3) - way[:, :, None] * way[:, None, :])
        matrix, right = across.sum(axis=0), (across @ self.place[:, :, None]).sum(axis=0)[:, 0]
        ridge = 1e-3 * np.trace(matrix) / 3.0
        return np.linalg.solve(matrix + ridge * np.eye(3), right + ridge * self.place.mean(axis=0))


def _recorded(
    problem: Problem, robot: Robot, x: Floats, effects: Sequence[Effect],
    inputs: Sequence[tuple[list[Act], Floats]],
) -> list[Motion]:  # fmt: skip
    """Fields before every control step of each recording and after the last one, as the robot moves under inputs."""
    batch, found = robot.simulation.batch, []
    for name in ("ten_J", "xfrc_applied", "qfrc_applied", "xquat", *_FIELDS):
        batch.bind(name)
    parameters = np.array([list(robot.parameters(x[: problem.parameters]).values())])
    for recording, acting in zip(problem.recordings, inputs, strict=True):
        rows = list[Motion]()

        def note(rows: list[Motion] = rows) -> None:
            rows.append({name: np.array(getattr(batch, name)[0]) for name in _FIELDS})

        simulated_under(robot, recording.drive, parameters, [list(effects)], [acting], note)
        note()
        found.append({name: np.array([row[name] for row in rows]) for name in _FIELDS})
    return found


def _values(motion: Sequence[Motion], robot: Robot, dt: float, variable: Variable, own: Location) -> Floats:
    """(T,) of a variable in the middle of every control step of all recordings, as ``effects.custom`` reads it."""
    model, elements, of = robot.elements.model, robot.elements, variable.of

    def middle(field: str, column: int, axis: int | None = None) -> Floats:
        columns = [each[field][:, column] for each in motion]
        parts = columns if axis is None else [each[:, axis] for each in columns]
        return np.concatenate([0.5 * (part[:-1] + part[1:]) for part in parts])

    if of == "time":
        return np.concatenate([dt * (np.arange(len(each["qpos"]) - 1) + 0.5) for each in motion])
    at = own if variable.place is None else Location(variable.place.kind, variable.place.name)
    i = elements.id(at)
    if of == "command":
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR:
            return middle("act", int(model.actuator_actadr[i]))
        return np.concatenate([each["ctrl"][1:, i] for each in motion])
    if of == "force":
        return middle("actuator_force", i)
    if at.kind == "tendon":
        return middle("ten_length", i) - model.tendon_length0[i] if of == "position" else middle("ten_velocity", i)
    if at.kind == "body":
        axis = AXES.index(variable.axis or "x")
        if of == "position":
            return middle("xipos", i, axis)
        return np.concatenate([np.diff(each["xipos"][:, i, axis]) / dt for each in motion])
    if of == "position":
        return middle("qpos", int(model.jnt_qposadr[i]))
    return middle("qvel", int(model.jnt_dofadr[i]))
