"""The robots of the suite: what is known of them for a diagnosis."""

import mujoco
import numpy as np

from soro_bench.diagnosis.robots.priors import Baseline, Prior
from soro_bench.diagnosis.robots.robot import SIMULATIONS, Robot
from soro_bench.effects.elements import instrument
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.simulated import COMMAND, recorded_actions
from soro_bench.registration import make_task, task_type

_TRUNK = ("tendon", "actuator", "body", "model")  # its necks have no friction of their own
# where something may be missing; the nodes of a mesh are no bodies that anything could be attached to
_KINDS = {
    "TrunkReach-v0": _TRUNK,
    "TrunkPush-v0": (*_TRUNK, "geom"),
    "TrunkLift-v0": (*_TRUNK, "geom"),
    "MultiGait-v0": ("actuator", "flex", "geom", "model"),
}
# how far a calibrated robot may be from its nominal parameters: a quarter for what scales, 0.03 for Poisson's ratio,
# 1 cm for a wall
_SCALE_DEVIATION = 0.25
_DEVIATIONS = {"poisson_ratio": 0.03, "pdms_poisson_ratio": 0.03, "ecoflex_poisson_ratio": 0.03, "wall_offset": 0.01}
# of the solver, as flex has it: with 1e-8 keypoints of cable are elsewhere by 0.1 um (rms of 30 s of TrunkReach), and a
# step costs a sixth more
_TOLERANCE = 1e-5


class SuiteRobot(Robot):
    """The robot of an environment of the suite.

    Args:
        env_id: the environment.
        model: its model or mesh; the cheap one by default.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        earlier: what is known of the robot from an earlier diagnosis.
    """

    def __init__(
        self,
        env_id: str,
        model: str | None = None,
        threads: int = 0,
        shorter: int = 1,
        baseline: Baseline | None = None,
    ):
        if env_id not in _KINDS:
            raise ValueError(f"{env_id!r} cannot be diagnosed; allowed are {', '.join(_KINDS)}")
        kind = task_type(env_id)
        self.name = self.env_id = env_id
        self.threads, self.model_name, self._earlier = threads, model or kind.cheap, baseline
        self.shorter = shorter
        self._task = make_task(env_id, SIMULATIONS, threads, self.model_name, action="continuous", effects=())
        self._task.refine(shorter)
        self._task.sim.batch.expand("opt.tolerance")[...] = _TOLERANCE
        self.simulation, self.control_timestep = self._task.sim, self._task.control_timestep
        self.kinds, self.pneumatic = _KINDS[env_id], env_id == "MultiGait-v0"
        self.signal = kind.inferred_from[0]
        self.unit, self.frame = kind.signal_units[self.signal]
        self.shape = self._task.signals(np.arange(1))[self.signal].shape[1:]
        self.priors = tuple(_prior(p) for p in kind.parameters.parameters.values())
        self._remember(baseline)

    def shortened(self, factor: int) -> Robot:
        """The same robot with shorter time steps."""
        return SuiteRobot(self.env_id, self.model_name, self.threads, factor, self._earlier)

    def accurate(self) -> Robot | None:
        """By the accurate model of the suite, unless its signal has other points, as those of another mesh are."""
        other = SuiteRobot(self.env_id, task_type(self.env_id).accurate, self.threads, baseline=self._earlier)
        return other if other.shape == self.shape else None

    def spec(self) -> mujoco.MjSpec:
        """The model of the task's scene, with what effects need."""
        return instrument(self._task.spec())

    @property
    def moves(self) -> np.ndarray:
        """(A, nu) 1 where a number of an action moves an actuator, else 0."""
        return self._task.moves

    def actions(self, recording: Recording) -> np.ndarray:
        """Rates of the cables, as the environment takes them."""
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
        """With the first action."""
        return recording.control_steps([COMMAND], self.control_timestep)[0]

    def _begin(self, parameters, start):
        n, names = len(parameters), [prior.name for prior in self.priors]
        options = [{"params": dict(zip(names, row, strict=True))} for row in parameters.tolist()]
        self._task.reset(np.arange(n), [np.random.default_rng(0)] * n, options)

    def _step(self, actions):
        return self._task.hold(np.arange(len(actions)), actions)[1]

    def _read(self, count):
        return self._task.signals(np.arange(count))[self.signal]


def _prior(parameter) -> Prior:
    deviation = _DEVIATIONS.get(parameter.name, _SCALE_DEVIATION)
    logarithmic = parameter.name not in _DEVIATIONS
    return Prior(parameter.name, parameter.unit, parameter.nominal, deviation, logarithmic, parameter.bounds)
