"""The robots of the suite: what is known of them for a diagnosis."""

import mujoco
import numpy as np

from soro_bench.diagnosis.robot import SIMULATIONS, Earlier, Prior, Robot
from soro_bench.effects.elements import instrument
from soro_bench.models import trunk
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.simulated import recorded_actions
from soro_bench.registration import make_task, task_type

# how far a calibrated robot may be from its nominal parameters: a third for what scales, 0.03 for Poisson's ratio
_SCALE_DEVIATION = 0.25
_RATIO_DEVIATION = 0.03


class SuiteRobot(Robot):
    """The trunk of TrunkReach.

    Args:
        env_id: the environment; the others of the suite are to come.
        model: its model or mesh; the cheap one by default.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        earlier: what is known of the robot from an earlier diagnosis.
    """

    kinds = ("tendon", "actuator", "body", "model")  # its necks have no friction of their own, and it touches nothing

    def __init__(
        self, env_id: str, model: str | None = None, threads: int = 0, shorter: int = 1, earlier: Earlier | None = None
    ):
        if env_id != "TrunkReach-v0":
            raise ValueError(f"{env_id!r} cannot be diagnosed yet; allowed is TrunkReach-v0")
        kind = task_type(env_id)
        self.name = self.env_id = env_id
        self.threads, self.model_name, self._earlier = threads, model or kind.cheap, earlier
        self._task = make_task(env_id, SIMULATIONS, threads, self.model_name, action="continuous", effects=())
        self._task.refine(shorter)
        self.simulation, self.control_timestep = self._task.sim, self._task.control_timestep
        self.signal = kind.inferred_from[0]
        self.unit, self.frame = kind.signal_units[self.signal]
        self.shape = self._task.signals(np.arange(1))[self.signal].shape[1:]
        self.priors = tuple(_prior(p) for p in kind.parameters.parameters.values())
        self._remember(earlier)

    def shortened(self, factor: int) -> Robot:
        """The same trunk with shorter time steps."""
        return SuiteRobot(self.env_id, self.model_name, self.threads, factor, self._earlier)

    def accurate(self) -> list[Robot]:
        """By the accurate model of the suite."""
        accurate = task_type(self.env_id).accurate
        return [SuiteRobot(self.env_id, accurate, self.threads, earlier=self._earlier)]

    def spec(self) -> mujoco.MjSpec:
        """The model of the task's scene, with what effects need."""
        return instrument(trunk.build_spec(self._task.scene, self.model_name))

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

    def _begin(self, parameters, start):
        n, names = len(parameters), [prior.name for prior in self.priors]
        options = [{"params": dict(zip(names, row, strict=True))} for row in parameters.tolist()]
        self._task.reset(np.arange(n), [np.random.default_rng(0)] * n, options)

    def _step(self, actions):
        return self._task.step(np.arange(len(actions)), actions).diverged

    def _read(self, count):
        return self._task.signals(np.arange(count))[self.signal]


def _prior(parameter) -> Prior:
    logarithmic = parameter.name != "poisson_ratio"
    deviation = _SCALE_DEVIATION if logarithmic else _RATIO_DEVIATION
    return Prior(parameter.name, parameter.unit, parameter.nominal, deviation, logarithmic, parameter.bounds)
