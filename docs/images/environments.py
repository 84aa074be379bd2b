"""Draws <id>.png for every environment: what its render() gives after some actions.

MUJOCO_GL=egl python docs/images/environments.py
"""

from pathlib import Path

import gymnasium
from PIL import Image
from trunk import EPISODES

import soro_bench  # noqa: F401  registers the environments

SIZE = (480, 360)
CHEAP = {"model": "cable"}  # what the trunk's actions were found on
WALK = ([(0, 2), (2, 1)], {})  # inflate the centre, then the front legs


def main():
    for env_id, (actions, options) in {**EPISODES, "MultiGait-v0": WALK}.items():
        env = gymnasium.make(env_id, render_mode="rgb_array", **(CHEAP if env_id in EPISODES else {}))
        env.reset(seed=1, options=options)
        for action, repetitions in actions:
            for _ in range(repetitions):
                env.step(action)
        picture = Image.fromarray(env.render()).resize(SIZE, Image.Resampling.LANCZOS)
        picture.save(Path(__file__).with_name(f"{env_id}.png"), optimize=True)
        env.close()


if __name__ == "__main__":
    main()
