"""Draws walker.png: MultiGait flat, and with centre and front legs inflated on the coarse and the fine mesh.

MUJOCO_GL=egl python docs/images/walker.py
"""

from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

import soro_bench  # noqa: F401  registers the environments

ROWS, COLUMNS = slice(110, 400), slice(60, 600)  # what the robot takes of a picture
SHOWN = (("coarse", []), ("coarse", [0, 0, 2]), ("fine", [0, 0, 2]))


def main():
    pictures = []
    for mesh, actions in SHOWN:
        env = gymnasium.make("MultiGait-v0", mesh=mesh, render_mode="rgb_array")
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        pictures.append(env.render()[ROWS, COLUMNS])
        env.close()
    whole = Image.fromarray(np.hstack(pictures))
    whole.resize((1080, 193), Image.LANCZOS).save(Path(__file__).with_name("walker.png"), optimize=True)


if __name__ == "__main__":
    main()
