"""Draws <id>.gif for every environment: trained policies of the leaderboard, and of TrunkLift a search's lift.

MUJOCO_GL=egl python docs/images/gifs.py
"""

import argparse
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

from soro_bench.leaderboard.entry import policy_of, read_entry
from soro_bench.leaderboard.strict import read_strict
from soro_bench.registration import task_type

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
RESULTS = ROOT / "leaderboard" / "results"
LIFT = ROOT / "baselines" / "lift_sequences" / "cable_0.05kg_wall.json"
SIZE, COLORS = (400, 300), 64
LARGEST = 250_000  # bytes
ENTRIES = {
    "TrunkReach-v0": "TrunkReach-v0/ppo/oracle/seed0.json",
    "TrunkPush-v0": "TrunkPush-v0/ppo/oracle/seed1.json",
    "MultiGait-v0": "MultiGait-v0-12/ppo/no_dr/seed7.json",
}
GOALS = (0, 26, 6, 20)  # of TrunkReach's evaluation, one episode each
STEPS = {"TrunkReach-v0": 16, "TrunkPush-v0": 40, "TrunkLift-v0": 100, "MultiGait-v0": 8}  # of an episode
EVERY = {"TrunkReach-v0": 1, "TrunkPush-v0": 1, "TrunkLift-v0": 2, "MultiGait-v0": 6}  # steps or updates per frame
FRAME = {"TrunkReach-v0": 80, "TrunkPush-v0": 100, "TrunkLift-v0": 100, "MultiGait-v0": 120}  # ms


def frames(env_id: str) -> Iterator[np.ndarray]:
    """Pictures of an environment in motion."""
    if env_id == "TrunkLift-v0":
        actions = np.array(read_strict(LIFT)["actions"], np.float32)
        yield from episodes(env_id, "cable", "continuous", lambda step, observation: actions[step])
    else:
        path = RESULTS / ENTRIES[env_id]
        policy = policy_of(path, read_entry(path))
        card = policy.card
        yield from episodes(env_id, card.model, card.action, lambda step, seen: policy.act(seen[None])[0])


def episodes(env_id: str, model: str, mode: str, act: Callable) -> Iterator[np.ndarray]:
    """Pictures of one or several episodes."""
    task_class = task_type(env_id)
    env = gymnasium.make(env_id, render_mode="rgb_array", action=mode, max_episode_steps=-1,
                         **{task_class.variant_name: model})  # fmt: skip
    inside = pictures_within_steps(env, EVERY[env_id]) if env_id == "MultiGait-v0" else None
    starts = [task_class.evaluation[i] for i in GOALS] if env_id == "TrunkReach-v0" else [task_class.evaluation[0]]
    for start in starts:
        observation, _ = env.reset(seed=0, options=dict(start))
        yield env.render()
        for step in range(STEPS[env_id]):
            observation, _, solved, *_ = env.step(act(step, observation))
            if inside is not None:
                yield from inside
                inside.clear()
            elif step % EVERY[env_id] == 0 or solved:
                yield env.render()
            if solved:
                yield from [env.render()] * 3
                break


def pictures_within_steps(env: gymnasium.Env, every: int) -> list[np.ndarray]:
    """A list that is filled while the environment steps: those of the walker are too long for a picture each."""
    simulation, pictures, calls = env.unwrapped.task.sim, [], itertools.count()
    step = simulation.step

    def drawn(*args):
        step(*args)
        if next(calls) % every == 0:
            pictures.append(env.render())

    simulation.step = drawn
    return pictures


def shared_palette(pictures: list[Image.Image]) -> Image.Image:
    """Colours of all pictures, in which those of small things such as a goal count more than they cover."""
    pixels = np.concatenate([np.asarray(picture).reshape(-1, 3) for picture in pictures[::4]])
    colors, counts = np.unique(pixels // 4 * 4 + 2, axis=0, return_counts=True)
    is_goal = colors[:, 1] > 1.25 * np.maximum(colors[:, 0], colors[:, 2])  # a green ball
    weights = np.ceil(np.sqrt(counts)).astype(int) * np.where(is_goal, 10, 1)
    colors = np.repeat(colors, weights, axis=0)
    return Image.fromarray(colors[None]).quantize(COLORS)


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for env_id in STEPS:
        pictures = [Image.fromarray(each).resize(SIZE, Image.Resampling.LANCZOS) for each in frames(env_id)]
        palette = shared_palette(pictures)
        # one palette and no dithering: what does not move stays the same, and costs nothing
        flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        path = FOLDER / f"{env_id}.gif"
        flat[0].save(path, save_all=True, append_images=flat[1:], duration=FRAME[env_id], loop=0, optimize=True)
        print(path.name, len(flat), path.stat().st_size)
        assert path.stat().st_size <= LARGEST, path


if __name__ == "__main__":
    main()
