"""Draws trunk.png, the README's picture: the end of one open-loop episode of each task.

MUJOCO_GL=egl python docs/images/trunk.py
"""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from PIL import Image

import soro_bench  # noqa: F401  registers the environments

HEIGHT, WIDTH, OVERSAMPLING = 480, 560, 2
EYE, TARGET, FIELD_OF_VIEW = (0.31, 0.09, 0.20), (0.0, -0.05, 0.085), 38.0  # m, m, degrees
# (action, repetitions), found by random search on the cheap model; and reset options
EPISODES = {
    "TrunkReach-v0": ([(1, 4), (7, 3)], {"goal": (-0.016, -0.050, 0.115)}),
    "TrunkPush-v0": ([(1, 3), (2, 5), (3, 2), (12, 2), (3, 1), (8, 4), (9, 3)], {}),
    "TrunkLift-v0": (
        [
            (14, 2),
            (12, 10),
            (11, 3),
            (10, 2),
            (2, 2),
            (7, 1),
            (10, 1),
            (6, 4),
            (13, 3),
            (9, 6),
            (5, 6),
            (4, 5),
            (15, 2),
            (4, 1),
        ],
        {},
    ),
}


def final_state(env_id: str, actions, options) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data after the episode."""
    env = gymnasium.make(env_id, model="cable")
    env.reset(seed=1, options=options)
    for action, repetitions in actions:
        for _ in range(repetitions):
            env.step(action)
    return state_of(env)


def state_of(env: gymnasium.Env) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data of an environment as it is."""
    batch = env.unwrapped.task.sim.batch
    model = batch.get_model(0)
    data = mujoco.MjData(model)
    batch.get_data(0, data)
    return model, data


def aim(model: mujoco.MjModel):
    """Point the scene's camera at the trunk; y is up."""
    backward = np.subtract(EYE, TARGET)
    backward /= np.linalg.norm(backward)
    right = np.cross([0, 1, 0], backward)
    right /= np.linalg.norm(right)
    mujoco.mju_mat2Quat(model.cam_quat[0], np.column_stack([right, np.cross(backward, right), backward]).ravel())
    model.cam_pos[0], model.cam_fovy[0] = EYE, FIELD_OF_VIEW


def draw(model: mujoco.MjModel, data: mujoco.MjData) -> Image.Image:
    """The picture, drawn larger and scaled down."""
    aim(model)
    model.vis.global_.offheight, model.vis.global_.offwidth = OVERSAMPLING * HEIGHT, OVERSAMPLING * WIDTH
    model.vis.map.shadowclip = 2  # else the shadow map ends inside the picture
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, OVERSAMPLING * HEIGHT, OVERSAMPLING * WIDTH) as renderer:
        renderer.update_scene(data, camera=0)
        return Image.fromarray(renderer.render()).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def main():
    """Draw the three tasks side by side."""
    picture = Image.new("RGB", (len(EPISODES) * (WIDTH + 8) - 8, HEIGHT), "white")
    for i, (env_id, (actions, options)) in enumerate(EPISODES.items()):
        picture.paste(draw(*final_state(env_id, actions, options)), (i * (WIDTH + 8), 0))
    picture.save(Path(__file__).with_suffix(".png"), optimize=True)


if __name__ == "__main__":
    main()
