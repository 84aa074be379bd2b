"""The Gymnasium environment: a task with one simulation."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Floats
from soro_bench.envs.task import CopiedWithTask, checked_flag, checked_options, shown

if TYPE_CHECKING:  # imported when something is drawn
    from soro_bench.envs.rendering import Camera, Viewer

_ONLY = np.arange(1)


class SoftRobotEnv(CopiedWithTask, gymnasium.Env[NDArray[Any], Any]):
    """One simulation of ``task_type``. A copy, by ``copy.deepcopy`` or ``pickle``, goes on with the same bytes.

    Args:
        render_mode: None, "human" (MuJoCo's viewer) or "rgb_array" (480 x 640 pixels).
        flat_info: whether ``info`` has parameters as param_<name> and no dict of them, for libraries such as TorchRL.
        task_options: what the task takes: model (or mesh), action, effects.
    """

    # Gymnasium declares it as a variable of instances
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, flat_info: bool = False, **task_options: Any):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; there are {self.metadata['render_modes']}")
        if several := {"num_envs", "num_threads"} & set(task_options):
            raise TypeError(f"{', '.join(sorted(several))}: gymnasium.make_vec takes this; here is one simulation")
        self._flat_info = checked_flag("flat_info", flat_info)
        self._task_options = {"num_envs": 1, **task_options}
        self.task = self._build_task()
        self.observation_space = self.task.single_observation_space
        self.action_space = self.task.single_action_space
        self.render_mode = render_mode
        self._renderer: Camera | Viewer | None = None
        self._begun = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """As Gymnasium's; the environment's documentation lists the options. ValueError for what is not allowed."""
        super().reset(seed=seed)
        self._begun = False  # if the task refuses, nothing has begun
        observation, info = self.task.reset(_ONLY, [self.np_random], [checked_options(options)])
        self._begun = True
        if self.render_mode == "human":
            self.render()
        return observation[0], _row(shown(info, self._flat_info))

    def step(self, action: ArrayLike) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """As Gymnasium's; truncated where the simulation diverged. ValueError for an action that is none."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded("no episode has begun; reset the environment first")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"the action has the shape {action.shape}; expected {self.action_space.shape}")
        checked = self.task.check_actions(action[None], 1)
        step = self.task.step(_ONLY, checked)
        if self.render_mode == "human":
            self.render()
        # a state that MuJoCo gave up, or that left the space of observations: the episode is cut, not ended
        return (
            step.observation[0],
            float(step.reward[0]),
            bool(step.terminated[0]),
            bool(step.diverged[0]),
            _row(shown(step.info, self._flat_info)),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """(480, 640, 3) pixels for "rgb_array"; None for "human", which shows them."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' or 'human' in gymnasium.make")
            return None
        if self._renderer is None:
            from soro_bench.envs.rendering import make_renderer

            self._renderer = make_renderer(self.task.sim, self.render_mode, self.metadata["render_fps"])
        return self._renderer.render()

    def close(self) -> None:
        """Close what draws, if something does."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _row(info: Mapping[str, Any]) -> dict[str, Any]:
    """The only row of every array in a nested dict, as Python scalars."""
    return {key: _row(value) if isinstance(value, dict) else value[0].item() for key, value in info.items()}
