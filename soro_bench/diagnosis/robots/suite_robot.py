"""The robots of the suite, for a diagnosis: their locations, priors and signals."""

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import partial

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.robots.measured import Drive, ObservedSignal
from soro_bench.diagnosis.robots.model_state import as_axes, axes
from soro_bench.diagnosis.robots.priors import Baseline, Prior
from soro_bench.diagnosis.robots.replays import SIMULATIONS
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.variants import Variant, plain, trunk_chains, with_other_integrator
from soro_bench.diagnosis.settings import RobotSettings
from soro_bench.effects.elements import instrument
from soro_bench.envs.trunk import given_point
from soro_bench.envs.trunk_push import TrunkPushV1Task
from soro_bench.files import brief
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import Parameter
from soro_bench.recording.known import Known
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.simulated import COMMAND, recorded_actions, start_of
from soro_bench.registration import ENV_IDS, make_task, task_type

_TRUNK = ("tendon", "actuator", "body", "model")  # its necks have no friction of their own
# kinds of locations that candidate terms may have; nothing can be attached to the nodes of a mesh
_KINDS = {
    "TrunkReach": _TRUNK,
    "TrunkPush": (*_TRUNK, "geom"),
    "TrunkLift": (*_TRUNK, "geom"),
    "TrunkGrasp": (*_TRUNK, "geom"),
    "MultiGait": ("actuator", "flex", "geom", "model"),
}
_SETTINGS = RobotSettings()
_SOLVER_TOLERANCE = 1e-5  # of simulations; keypoints move by 0.1 um, steps cost less
_WALKER_DURATION = 36.0  # s, of a recording that is explained: all channels move; a replay of 130 s takes 6 s
_LONGER = Fraction(1, 2)  # of time steps: twice as long
_NOTHING = Known()
_BOUND = ("site_xpos", "xpos", "xquat", "actuator_length", "actuator_velocity")  # what the tasks read
_QUATERNION = "quaternion"  # how the names of the tasks' orientations end
_POISSON = ("poisson_ratio", "pdms_poisson_ratio", "ecoflex_poisson_ratio")
# prior deviations of the parameters that have no normal logarithm
_DEVIATIONS = {name: _SETTINGS.poisson_deviation for name in _POISSON} | {"wall_offset": _SETTINGS.wall_deviation}


class SuiteRobot(Robot):
    """The robot of an environment of the suite.

    Args:
        env_id: the environment.
        model: its model or mesh; the cheap one by default.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        baseline: result of a baseline diagnosis of the same robot.
        known: parameters that are known.
        signals: names of the signals that are explained beside the first; by default those that parameters are
            inferred from, such as the pose of an object.
        xml: MJCF with the same elements, which is simulated as it is in the place of the model; parameters change
            nothing then.
    """

    def __init__(
        self,
        env_id: str,
        model: str | None = None,
        threads: int = 0,
        shorter: int = 1,
        baseline: Baseline | None = None,
        known: Known = _NOTHING,
        signals: Sequence[str] | None = None,
        xml: str | None = None,
    ):
        if env_id not in ENV_IDS:
            raise ValueError(f"{env_id!r} cannot be diagnosed; allowed are {', '.join(ENV_IDS)}")
        kind = task_type(env_id)
        self.name = self.env_id = env_id
        self.threads, self.model_name, self._baseline = threads, model or kind.cheap, baseline
        self._known_parameters, self._xml = known, xml
        self.shorter = shorter
        self._task = make_task(env_id, SIMULATIONS, threads, self.model_name, action="continuous", effects=())
        if xml is None:
            self._task.sim.batch.expand("opt.tolerance")[...] = _SOLVER_TOLERANCE
        else:
            self._task.sim = self._as_it_is()
        self._task.refine(shorter)
        self.simulation, self.control_timestep = self._task.sim, self._task.control_timestep
        self.kinds, self.pneumatic = _KINDS[env_id.split("-")[0]], env_id.startswith("MultiGait")
        self.longest = _WALKER_DURATION if self.pneumatic else math.inf
        self.signal = kind.inferred_from[0]
        self.unit, self.frame = kind.signal_units[self.signal]
        self.shape = self._task.signals(np.arange(1))[self.signal].shape[1:]
        self.others = self._others(kind.inferred_from[1:] if signals is None else signals)
        self.priors = tuple(_prior(p) for p in kind.parameters.parameters.values())
        self._remember(baseline)
        self._fix(known)

    def shortened(self, factor: int) -> Robot:
        """The same robot with shorter time steps."""
        return self._again(factor, self._known_parameters)

    def knowing(self, known: Known) -> Robot:
        """The same robot with some parameters fixed."""
        return self._again(self.shorter, known)

    def _again(self, shorter: int, known: Known) -> Robot:
        robot = SuiteRobot(self.env_id, self.model_name, self.threads, shorter, self._baseline, known, xml=self._xml)
        return self._alike(robot)

    def _others(self, names: Sequence[str]) -> tuple[ObservedSignal, ...]:
        """The signals with these names, beside the first.

        Raises:
            ValueError: the robot has no such signal.
        """
        units, now = task_type(self.env_id).signal_units, self._task.signals(np.arange(1))
        found = []
        for name in dict.fromkeys(names):
            if name not in units:
                raise ValueError(f"{self.env_id} has no signal {brief(name)}; it has {', '.join(units)}")
            size, (unit, frame) = now[name][0].size, units[name]
            turned, points = name.endswith(_QUATERNION), unit == "m" and size % 3 == 0
            shape = (3 * size // 4, 3) if turned else (size // 3, 3) if points else (size, 1)
            found += [ObservedSignal(name, unit, frame, shape, turned)] if name != self.signal else []
        return tuple(found)

    def converted(self, signal: ObservedSignal, given: Signal) -> Signal:
        """A recorded signal as it is explained: of quaternions the axes of their frames."""
        if not signal.directions or 3 * given.values[0].size != 4 * signal.shape[0]:
            return given
        return as_axes(signal.name, given, signal.shape)

    def as_built(self, xml: str | None = None) -> Robot:
        """The same robot by its own model or another one, without a baseline."""
        xml = self._xml if xml is None else xml
        return self._alike(SuiteRobot(self.env_id, self.model_name, self.threads, xml=xml))

    def _as_it_is(self) -> Simulation:
        """Simulations of the given MJCF, whatever the parameters are."""
        found = Simulation(self.spec().compile(), self._task.sim.parameters, (), SIMULATIONS, self.threads, ())
        for name in _BOUND:
            found.batch.bind(name)
        return found

    def accurate(self) -> Robot | None:
        """The same robot by the suite's accurate model; None if its signals have other points, as on another mesh."""
        names, accurate = [each.name for each in self.others], task_type(self.env_id).accurate
        other = SuiteRobot(self.env_id, accurate, self.threads, 1, self._baseline, self._known_parameters, names)
        same = [each.shape for each in other.signals] == [each.shape for each in self.signals]
        return self._alike(other) if same else None

    def variants(self) -> tuple[Variant, ...]:
        """By another integrator where a flex does not need its own, by the accurate model with longer time steps, and
        as chains of other links."""
        found = []
        if not self.simulation.model.nflex:
            found.append(plain(with_other_integrator(self.shortened(self.shorter))))
        if isinstance(coarse := self.accurate(), SuiteRobot):
            coarse._task.refine(_LONGER)
            found.append(plain(coarse))
        if self.env_id == "TrunkReach-v0" and not self.others:
            chains = trunk_chains(self._names, self.control_timestep)
            found += [partial(self._by_chain, each) for each in chains]
        return tuple(found)

    def _by_chain(self, chain: Variant, drives: Sequence[Drive], parameters: Floats) -> list[Floats]:
        return chain(drives, self._complete(parameters))

    def spec(self) -> mujoco.MjSpec:
        """The model of the task's scene, with what effects need where its model has that: a mesh has no springs."""
        if self._xml is not None:
            return instrument(mujoco.MjSpec.from_string(self._xml))
        spec = self._task.spec()
        return instrument(spec) if self.elements.model.ntendon else spec

    @property
    def moves(self) -> Floats:
        """(A, nu) 1 where a number of an action moves an actuator, else 0."""
        return self._task.moves

    def actions(self, recording: Recording) -> Floats:
        """(T, ...) actions of the environment, one per control step.

        Raises:
            RecordingError: they are of another environment, or not continuous.
        """
        env_id, actions = recorded_actions(recording)
        if env_id != self.env_id or recording.metadata["action"] != "continuous":
            raise RecordingError(
                f"a recording of {env_id} with {recording.metadata['action']} actions; "
                f"this robot is {self.env_id} with continuous ones"
            )
        try:
            return self._task.check_actions(actions, len(actions))
        except ValueError as error:
            raise RecordingError(str(error)) from error

    def begins(self, recording: Recording) -> float:
        """When the first action begins [s]."""
        return recording.control_steps([COMMAND], self.control_timestep)[0]

    def _begin(self, parameters: Floats, start: Floats | None) -> None:
        """Start the simulations; see :meth:`Robot._begin`."""
        n, names = len(parameters), task_type(self.env_id).parameters.names
        options = [{"params": dict(zip(names, row, strict=True))} for row in parameters.tolist()]
        self._task.reset(np.arange(n), [np.random.default_rng(0) for _ in options], options)

    def settings(self, recording: Recording, steps: int) -> Floats | None:
        """(steps, 2) x and z [m] of the place where the object begins, in tasks that may put it anywhere, else None."""
        start = start_of(recording)
        if not start:
            return None
        try:
            return np.tile(given_point("object", start["object"], 2), (steps, 1))
        except ValueError as error:
            raise RecordingError(str(error)) from error

    def _set(self, ids: Ints, settings: Floats) -> None:
        """Put the objects of simulations ``ids`` where they begin."""
        assert isinstance(self._task, TrunkPushV1Task)  # of no other task a recording says a place
        self._task.put(ids, settings)
        self.simulation.begin(ids)

    def _step(self, actions: Floats) -> Bools:
        """Advance the simulations by a control step; (n,) whether each diverged."""
        return self._task.hold(np.arange(len(actions)), actions)[1]

    def _read(self, count: int) -> Floats:
        """(count, P, D) the signal now."""
        return self._task.signal(np.arange(count), self.signal)

    def _read_others(self, count: int) -> list[Floats]:
        """(count, P, D) each of the other signals now."""
        if not self.others:
            return []
        now, found = self._task.signals(np.arange(count)), []
        for each in self.others:
            values = now[each.name].reshape(count, -1)
            found.append((axes(values) if each.directions else values).reshape(count, *each.shape))
        return found


def _prior(parameter: Parameter) -> Prior:
    """The prior of a parameter of the suite, about its nominal value."""
    deviation = _DEVIATIONS.get(parameter.name, _SETTINGS.suite_deviation)
    logarithmic = parameter.name not in _DEVIATIONS
    return Prior(parameter.name, parameter.unit, parameter.nominal, deviation, logarithmic, parameter.bounds)
