"""A vector environment of PyTorch tensors: many simulations on one GPU, which no number leaves (``gpu`` extra).

The task's own code computes observations, rewards and ends, on the device. Starts and parameters are drawn on the CPU,
by the same code and the same generators as everywhere else, while the device simulates.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding

from soro_bench.models.warp_simulation import WarpSimulation
from soro_bench.randomization import Distribution
from soro_bench.registration import make_task, task_type

_DRAWN_AHEAD = 0.04  # share of the worlds whose next episode is drawn in a step; episodes have 100 steps


class TorchVectorEnv:
    """``num_envs`` simulations of one environment on a device. Ended episodes begin anew in the same step.

    World i of ``reset(seed=s)`` has the goals and parameters of ``gymnasium.make(env_id)`` reset with seed s + i, in
    all its episodes. States differ by single precision.

    Args:
        env_id: such as "TrunkReach-v0".
        num_envs: number of simulations N.
        device: "cuda:0", another GPU, or "cpu", which is slow: to develop and to test.
        model: of the robot, such as "cable"; that to train on by default.
        action: "continuous" (default) or "discrete".
        distribution: what parameters are drawn from; None: nominal ones.
        effects: physics that the model leaves out, as far as it is in model fields.
        max_episode_steps: steps after which an episode is truncated; the registered number by default.
        deterministic: the same bytes from run to run on one kind of GPU; slower.
        on_nan: "raise" an error where a state is no number, or "truncate" the episode.
        guard: folder for the state and parameters of such a world.
        room: contacts of a world on average, "nconmax", and most constraint rows of each, "njmax".

    Raises:
        ValueError: what the device cannot simulate, or an argument that is not allowed.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        device: str = "cuda:0",
        model: str | None = None,
        action: str = "continuous",
        distribution: Distribution | None = None,
        effects: Any = None,
        max_episode_steps: int | None = None,
        deterministic: bool = False,
        on_nan: str = "raise",
        guard: str | Path | None = None,
        room: Mapping[str, int] | None = None,
    ):
        simulation = partial(
            WarpSimulation, device=device, deterministic=deterministic, on_nan=on_nan, guard=guard, room=room
        )
        options = {} if effects is None else {"effects": effects}
        model = task_type(env_id).cheap if model is None else model
        self.task: Any = make_task(  # whose arrays are tensors here
            env_id, num_envs, 0, model, action=action, simulation=simulation, **options
        )
        self.task.randomize(distribution)
        self.num_envs, self.device = num_envs, torch.device(device)
        self.single_observation_space = self.task.single_observation_space
        self.single_action_space = self.task.single_action_space
        if max_episode_steps is not None and (not max_episode_steps >= 1 or max_episode_steps % 1):
            raise ValueError(f"max_episode_steps={max_episode_steps}: a whole number of 1 or more is needed")
        self.max_episode_steps = max_episode_steps or gymnasium.spec(env_id).max_episode_steps or math.inf
        self.elapsed = torch.zeros(num_envs, dtype=torch.int64, device=device)  # steps of the present episodes
        self._everyone = torch.arange(num_envs, device=device)
        self._rngs: list[np.random.Generator] = []
        # start and parameters of worlds' next episodes, and what their generators were in before
        self._next: dict[int, tuple[Any, np.ndarray, dict[str, Any]]] = {}
        self._missing: list[int] = []  # worlds without
        self._begun = False
        sim: Any = self.task.sim
        sim.meanwhile = self._draw_ahead

    def reset(
        self, seed: int | None = None, options: Sequence[Mapping[str, Any]] | None = None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Begin new episodes everywhere.

        Args:
            seed: of world 0; world i has the seed after it by i. None goes on with the generators that there are.
            options: reset options of each world.

        Returns:
            Observations (N, k) and info, a dict of (N,) tensors.
        """
        self._begun = False
        if seed is not None or not self._rngs:
            first = int(np.random.default_rng().integers(2**31)) if seed is None else seed
            self._rngs = [seeding.np_random(first + i)[0] for i in range(self.num_envs)]
            self._next, self._missing = {}, []
        ids = np.arange(self.num_envs)
        if self._next and options is None:
            self._begin(ids)
        else:
            options = options or [{}] * self.num_envs
            if len(options) != self.num_envs:
                raise ValueError(f"{len(options)} reset options for {self.num_envs} worlds; one each is needed")
            for i, (*_, before) in self._next.items():  # drawn ahead, and not wanted
                self._rngs[i].bit_generator.state = before
            self._next = {}
            self.task.begin(ids, *self.task.draw(self._rngs, options), self.task.states(options))
            self._missing = ids.tolist()
        self.elapsed[:], self._begun = 0, True
        return self.task.observe(self._everyone), self.task._info(self._everyone)

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Apply an action to every world for one control step.

        Args:
            actions: (N, a) from -1 to 1, or (N,) integers from 0 on; those beyond their bounds are clipped.

        Returns:
            observations (N, k), rewards (N,), terminated (N,), truncated (N,), and info. Where an episode has ended the
            observation is that of the next one, and ``info["final_obs"]`` (N, k) has the last one.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("no episode has begun; reset the environments first")
        space = self.single_action_space
        if (found := tuple(actions.shape)) != (expected := (self.num_envs, *(space.shape or ()))):
            raise ValueError(f"actions have shape {found}; expected {expected}")
        if isinstance(space, gymnasium.spaces.Discrete):
            actions = actions.clamp(0, int(space.n) - 1)
        else:
            sim: Any = self.task.sim
            sim.refused = ~actions.isfinite().all(dim=1)  # looked at with the states, as asking waits for the device
            actions = actions.clamp(-1.0, 1.0)
        step = self.task.step(self._everyone, actions)
        self.elapsed += 1
        truncated = (self.elapsed >= self.max_episode_steps) | step.diverged
        done = truncated | step.terminated
        observation = step.observation
        info = {**step.info, "final_obs": observation, "done": done}
        ended = done.nonzero().flatten().cpu().numpy()
        if len(ended):
            self._begin(ended)
            self.elapsed[done] = 0
            where = self._everyone[done]
            observation = observation.clone()
            observation[where] = self.task.observe(where)
        return observation, step.reward, step.terminated, truncated, info

    def _draw_ahead(self) -> None:
        """Draw the next episodes of some worlds that have none yet."""
        count = max(1, int(_DRAWN_AHEAD * self.num_envs))
        now, self._missing = self._missing[:count], self._missing[count:]
        self._draw(now)

    def _draw(self, ids: Sequence[int]) -> None:
        if ids:
            rngs = [self._rngs[i] for i in ids]
            before = [dict(rng.bit_generator.state) for rng in rngs]
            self._next.update(zip(ids, zip(*self.task.draw(rngs, [{}] * len(ids)), before, strict=True), strict=True))

    def _begin(self, ids: np.ndarray) -> None:
        """Begin the next episodes of worlds ``ids``."""
        late = [i for i in ids.tolist() if i not in self._next]
        self._draw(late)
        drawn = [self._next.pop(i) for i in ids.tolist()]
        known = set(late)
        self._missing = [i for i in self._missing if i not in known] + ids.tolist()
        self.task.begin(ids, [start for start, *_ in drawn], np.array([params for _, params, _ in drawn]))
