"""Stable-Baselines3's view of a vector environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from soro_bench.arrays import Floats
from soro_bench.envs.gymnasium_vector import AutoresetMode
from soro_bench.envs.task import Task
from soro_bench.envs.vector import SoftRobotVectorEnv


class SB3VecEnv(VecEnv):
    """Adapts a :class:`SoftRobotVectorEnv` in "SameStep" mode to Stable-Baselines3's ``VecEnv``.

    Infos hold what Stable-Baselines3 reads (terminal_observation, TimeLimit.truncated, episode, is_success) and
    ``metric``, the task's at the end.

    Args:
        envs: the environments.
        finite_horizon: an episode's last step is the end, and nothing after it counts; otherwise an episode is taken to
            go on after its end, after success too (its value is bootstrapped): the published reward pays so much for
            hovering beside a goal that success would otherwise be avoided.
    """

    def __init__(self, envs: SoftRobotVectorEnv, finite_horizon: bool = False):
        if not isinstance(getattr(envs, "unwrapped", None), SoftRobotVectorEnv):
            raise TypeError(f"{type(envs).__name__}: a vector environment of the suite is needed, from "
                            "gymnasium.make_vec(..., autoreset_mode='SameStep')")  # fmt: skip
        if envs.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ValueError("Stable-Baselines3 resets in the same step: make the envs with autoreset_mode='SameStep'")
        self.envs = envs  # before super().__init__, which reads attributes of it
        self.num_envs = envs.num_envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self._finite_horizon = finite_horizon
        self._seed: int | None = None
        self._actions: NDArray[Any] | None = None
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, int)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Environment i starts from seed + i at the next reset."""
        self._seed = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]

    def reset(self) -> Floats:
        """Observations (N, k) of new episodes in all environments."""
        if any(self._options):
            raise ValueError("reset options are not passed on; wrap the vector environment in one whose reset has them")
        observation, _ = self.envs.reset(seed=self._seed)
        self._seed = None
        self._returns[:] = 0
        self._lengths[:] = 0
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Note the actions (N, ...) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step: observations (N, k), rewards (N,), whether episodes are over (N,), and an info for each."""
        if self._actions is None:
            raise RuntimeError("step_async() comes first: it says with which actions")
        observation, reward, terminated, truncated, info = self.envs.step(self._actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": not self._finite_horizon,
                "episode": {"r": self._returns[i], "l": self._lengths[i]},
                "is_success": bool(info["final_info"]["is_success"][i]),
                "metric": info["final_info"][self.envs.unwrapped.task.metric][i],
            }
        self._returns[done] = 0
        self._lengths[done] = 0
        return observation, reward, done, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each simulation of ``indices``; spaces are those of one simulation, as wrappers show them."""
        if attr_name in ("observation_space", "action_space"):
            return [getattr(self.envs, f"single_{attr_name}")] * len(self._indices(indices))
        values = self.envs.unwrapped.get_attr(attr_name)
        return [values[i] for i in self._indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each simulation of ``indices``; AttributeError for those that simulations share."""
        chosen = self._indices(indices)
        self.envs.unwrapped.set_attr(attr_name, [value] * len(chosen), chosen)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """What a method gives in each simulation of ``indices``; AttributeError for reset and step, as for others."""
        return [method(*method_args, **method_kwargs) for method in self.get_attr(method_name, indices)]

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """(480, 640, 3) pixels of every simulation, of environments made with render_mode="rgb_array"."""
        return list(self.envs.unwrapped.render() or [None] * self.num_envs)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """False for each: wrappers are around the vector environment only."""
        return [False] * len(self._indices(indices))

    def _indices(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))


class ParametersTold(VecEnvWrapper):
    """Observations with physical parameters of their episode behind them, for a policy that is told them.

    Args:
        venv: a :class:`SB3VecEnv`, or wrappers around one.
        task: its simulations.
        names: parameters (d,), which each observation (k,) is followed by [SI units].

    Raises:
        ValueError: the robot has no such parameter.
    """

    def __init__(self, venv: VecEnv, task: Task, names: Sequence[str]):
        space = venv.observation_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"observations of {space}; a box is needed")
        if unknown := [name for name in names if name not in task.parameters.names]:
            raise ValueError(f"the robot has no parameter {unknown[0]!r}; it has {', '.join(task.parameters.names)}")
        low, high = (np.r_[end, np.full(len(names), far)] for end, far in ((space.low, -np.inf), (space.high, np.inf)))
        super().__init__(venv, spaces.Box(low, high, dtype=np.float64))
        self._task, self._columns = task, [task.parameters.names.index(name) for name in names]

    def reset(self) -> Floats:
        """Observations (N, k + d) of new episodes in all environments."""
        return self._with_parameters(np.asarray(self.venv.reset()))

    def step_wait(self) -> VecEnvStepReturn:
        """As that of the wrapped environments; a last observation has the parameters of its own episode."""
        before = self._values()
        observation, reward, done, infos = self.venv.step_wait()
        for i in np.flatnonzero(done):
            infos[i]["terminal_observation"] = np.concatenate([infos[i]["terminal_observation"], before[i]])
        return self._with_parameters(np.asarray(observation)), reward, done, infos

    def _with_parameters(self, observation: Floats) -> Floats:
        return np.concatenate([observation, self._values()], axis=1)

    def _values(self) -> Floats:
        """(N, d) of the present episodes."""
        return np.array(self._task.sim.params[:, self._columns], float)
