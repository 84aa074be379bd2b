"""What PPO makes of MultiGait, on a table of all its six-step sequences instead of the simulation.

    python benchmarks/multigait_ppo.py [--seeds 4]

Without randomisation and noise an episode is determined by its actions, and benchmarks/multigait_gaits.py has walked
all 46,656 of them. From its files a training takes seconds instead of minutes, so variants can be compared over seeds.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from gymnasium import spaces
from multigait_gaits import ACTIONS, STEPS, Tree
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from soro_bench.policies.policy import OBSERVATION_CLIP
from soro_bench.training.ppo import default_config, make_agent

ROOT = Path(__file__).parents[1]
VARIANTS = {
    "discount 0.99, bootstrapped after the last step": {"discount": 0.99, "finite_horizon": False},
    "no discount, bootstrapped": {"finite_horizon": False},
    "discount 0.99, nothing after the last step": {"discount": 0.99},
    "no discount, nothing after the last step": {},
    "the same, twice the steps": {"total_steps": 23_040},
}


class Table(VecEnv):
    """Episodes looked up in the table: ``observations[k]`` (6^k, 8) and ``way[k]`` (6^k,) mm after k actions."""

    def __init__(self, observations, way, num_envs, finite_horizon):
        super().__init__(num_envs, spaces.Box(-1.0, 2.0, (8,), np.float64), spaces.Discrete(ACTIONS))
        self._observations, self._way, self._finite_horizon = observations, way, finite_horizon

    def reset(self):
        self._length, self._place = 0, np.zeros(self.num_envs, int)
        return self._observations[0][self._place]

    def step_async(self, actions):
        self._actions = actions

    def step_wait(self):
        place, before = ACTIONS * self._place + self._actions, self._way[self._length][self._place]
        self._length, self._place = self._length + 1, place
        reward = (self._way[self._length][place] - before).astype(np.float32)
        if self._length < STEPS:
            return self._observations[self._length][place], reward, np.zeros(self.num_envs, bool), [{}] * self.num_envs
        # the state after the last action is not in the table; that before it stands for it
        last = self._observations[STEPS - 1][place // ACTIONS]
        infos = [{"terminal_observation": one, "TimeLimit.truncated": not self._finite_horizon} for one in last]
        return self.reset(), reward, np.ones(self.num_envs, bool), infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        pass

    def env_method(self, method_name, *args, indices=None, **kwargs):
        pass

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def table():
    """Observations and ways, from the files of multigait_gaits.py."""
    tree = Tree(ROOT / "runs" / "multigait_gaits", threads=0)
    states, way = tree.root()
    observations, ways = [tree.observations(states)], [way[:, -1]]
    for level in range(1, STEPS + 1):
        states, way = tree.grow(states, way, level)
        ways.append(way[:, -1])
        if level < STEPS:
            observations.append(tree.observations(states))
    return observations, [1e3 * way for way in ways]


def displacement(observations, way, config) -> float:
    """What the trained policy walks [mm], without exploration."""
    env = Table(observations, way, config.num_envs, config.finite_horizon)
    floor = config.observation_floor**2
    normalised = VecNormalize(env, norm_reward=False, clip_obs=OBSERVATION_CLIP, epsilon=floor)
    agent = make_agent(config, normalised)
    agent.lr_schedule = lambda _: config.learning_rate * (1.0 - agent.num_timesteps / config.total_steps)
    agent.learn(config.total_steps)
    place = 0
    for length in range(STEPS):
        observation = normalised.normalize_obs(observations[length][place : place + 1])
        place = ACTIONS * place + int(agent.predict(observation, deterministic=True)[0][0])
    return float(way[STEPS][place])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    options = parser.parse_args()
    observations, way = table()
    print(f"best of all {len(way[-1])}: {way[-1].max():.2f} mm")
    for name, changes in VARIANTS.items():
        config = replace(default_config("MultiGait-v0"), **changes)
        found = [displacement(observations, way, replace(config, seed=seed)) for seed in range(options.seeds)]
        print(f"{name}: {', '.join(f'{x:.1f}' for x in found)} mm", flush=True)


if __name__ == "__main__":
    main()
