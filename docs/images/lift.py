"""Draws lift.png: how episodes of TrunkLift end, by trained policies and by commands that a search has found.

MUJOCO_GL=egl python docs/images/lift.py
"""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image
from trunk import HEIGHT, WIDTH, draw, state_of

import soro_bench  # noqa: F401  registers the environments
from soro_bench.files import read_json
from soro_bench.training.policy import Policy

ROOT = Path(__file__).parents[2]
MASS = 0.05  # kg
POLICIES = [ROOT / f"leaderboard/results/TrunkLift-v0-50g/ppo/{method}/seed0.json" for method in ("no_dr", "dr")]
SEARCHED = ROOT / "baselines/lift_sequences/cable_0.05kg_wall.json"
MODELS = ("cable", "flex")


def episode(model: str, act):
    """Model and data after an episode of an action per observation, and the object's elevation and clearance [mm]."""
    env = gymnasium.make("TrunkLift-v0", model=model, action="continuous")
    observation, _ = env.reset(seed=0, options={"params": {"cube_mass": MASS}})
    for step in range(env.spec.max_episode_steps):
        observation, _, _, _, info = env.step(act(step, observation))
    return *state_of(env), 1e3 * info["elevation"], 1e3 * info["clearance"]


def by(policy: Policy):
    """A policy as a function of step and observation."""
    return lambda step, observation: policy.act(observation[None])[0]


def main():
    sequence = np.array(read_json(SEARCHED)["actions"], np.float32)
    rows = [by(Policy.load(path)) for path in POLICIES] + [lambda step, observation: sequence[step]]
    names = ["policy, fixed wall", "policy, random wall", "searched on cable"]
    picture = Image.new("RGB", (len(rows) * (WIDTH + 8) - 8, len(MODELS) * (HEIGHT + 8) - 8), "white")
    for row, model in enumerate(MODELS):
        for column, (name, act) in enumerate(zip(names, rows, strict=True)):
            compiled, data, elevation, clearance = episode(model, act)
            print(f"{model}, {name}: elevation {elevation:.1f} mm, lowest corner {clearance:.1f} mm")
            picture.paste(draw(compiled, data), (column * (WIDTH + 8), row * (HEIGHT + 8)))
    picture.save(Path(__file__).with_suffix(".png"), optimize=True)


if __name__ == "__main__":
    main()
