"""Draws lift.png: how episodes of TrunkLift end on cable, by trained policies and by commands that a search has found.

MUJOCO_GL=egl python docs/images/lift.py
"""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image
from trunk import HEIGHT, WIDTH, draw, state_of

import soro_bench  # noqa: F401  registers the environments
from soro_bench.leaderboard.entry import load_policy
from soro_bench.leaderboard.strict import read_strict

ROOT = Path(__file__).parents[2]
MASS = 0.05  # kg
ENTRIES = ("no_dr/seed0", "no_dr/seed2", "dr/seed0")  # two kinds of what a fixed wall leads to; all random ones
SEARCHED = ROOT / "baselines" / "lift_sequences" / "cable_0.05kg_wall.json"


def by_policy(entry: str):
    """An entry's action for a step and an observation."""
    policy = load_policy(ROOT / "leaderboard" / "results" / "TrunkLift-v0-50g" / "ppo" / f"{entry}.json")
    return lambda step, observation: policy.act(observation[None])[0]


def by_search():
    """What the search has found, whatever is observed."""
    actions = np.array(read_strict(SEARCHED)["actions"], np.float32)
    return lambda step, observation: actions[step]


def final_picture(act) -> Image.Image:
    """Of the end of an episode."""
    env = gymnasium.make("TrunkLift-v0", model="cable", action="continuous")
    observation, _ = env.reset(seed=0, options={"params": {"cube_mass": MASS}})
    for step in range(env.spec.max_episode_steps):
        observation, _, _, _, info = env.step(act(step, observation))
    print(f"elevation {1e3 * info['elevation']:.1f} mm, lowest corner {1e3 * info['clearance']:.1f} mm")
    return draw(*state_of(env))


def main():
    acts = [*map(by_policy, ENTRIES), by_search()]
    picture = Image.new("RGB", (len(acts) * (WIDTH + 8) - 8, HEIGHT), "white")
    for i, act in enumerate(acts):
        picture.paste(final_picture(act), (i * (WIDTH + 8), 0))
    picture.save(Path(__file__).with_suffix(".png"), optimize=True)


if __name__ == "__main__":
    main()
