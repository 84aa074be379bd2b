"""What a GPU changes, and how simulation threads scale: run it on a machine with both.

    python benchmarks/gpu.py

Prints what renders the environments and how fast; milliseconds of PPO's update and of its actions for all environments,
on CPU and on CUDA, in turn; whether a short training writes the same policy with the GPU hidden as with it, and with
one simulation thread as with all; and environment steps per second by the number of threads.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch

import soro_bench  # before OpenGL, for which it chooses EGL where there is no display
from soro_bench.markdown import table
from soro_bench.training.ppo import default_config, make_agent, make_env, train

from OpenGL import GL  # isort: skip

ENV_ID = "TrunkReach-v0"
NUM_ENVS = 64
FRAMES = 50
REPEATS = 5
STEPS = 20  # of all environments, per measurement of threads


def rendering() -> None:
    """Frames per second of every environment, and the name of what draws them."""
    rows = []
    for env_id in soro_bench.ENV_IDS:
        env = gymnasium.make(env_id, render_mode="rgb_array")
        env.reset(seed=0)
        env.render()  # the first one makes the context
        start = time.perf_counter()
        for _ in range(FRAMES):
            frame = np.asarray(env.render())
        rate = FRAMES / (time.perf_counter() - start)
        drawn_by = GL.glGetString(GL.GL_RENDERER).decode()
        rows.append((env_id, f"{frame.shape[1]}x{frame.shape[0]}", f"{rate:.0f}", drawn_by))
        env.close()
    print(table(("environment", "size", "frames/s", "drawn by"), rows), flush=True)


def updates() -> None:
    """PPO's update and actions by device."""
    torch.set_num_threads(1)  # as in training
    config = default_config(ENV_ID, num_threads=1)
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    agents = {}
    for device in devices:
        agents[device] = make_agent(config, make_env(config), device)
        agents[device].learn(config.num_envs * config.rollout_steps)
    found: dict[str, list[tuple[float, float]]] = {device: [] for device in devices}
    for _ in range(REPEATS):
        for device, agent in agents.items():
            start = time.perf_counter()
            agent.train()  # ends with losses as numbers, so CUDA has caught up
            observations, updated = agent._last_obs, time.perf_counter()
            assert observations is not None  # it has learned
            for _ in range(config.rollout_steps):
                agent.predict(observations)
            found[device].append((updated - start, (time.perf_counter() - updated) / config.rollout_steps))
    rows = [(device, *(f"{1e3 * np.median(column):.2f}" for column in zip(*seconds, strict=True)))
            for device, seconds in found.items()]  # fmt: skip
    print(table(("device", "update [ms]", "actions [ms]"), rows), flush=True)


def policy_hash(threads: int) -> str:
    """SHA-256 of the policy that a short training writes."""
    with tempfile.TemporaryDirectory() as folder:
        train(default_config(ENV_ID, 32_000, num_threads=threads), folder)
        return hashlib.sha256((Path(folder) / "policy.safetensors").read_bytes()).hexdigest()


def same_policy() -> None:
    """The same training with all threads, with one, and with one where CUDA sees no GPU."""
    here, one = policy_hash(0), policy_hash(1)
    command = [sys.executable, __file__, "--policy"]
    hidden = subprocess.run(
        command, env=os.environ | {"CUDA_VISIBLE_DEVICES": ""}, capture_output=True, text=True, check=True
    )
    found = {"all threads": here, "one thread": one, "one thread, GPU hidden": hidden.stdout.split()[-1]}
    print(f"torch {torch.__version__}, CUDA {'available' if torch.cuda.is_available() else 'not available'}")
    print(table(("training", "policy"), [(name, value[:12]) for name, value in found.items()]), flush=True)


def threads() -> None:
    """Environment steps per second, and the gain over one thread."""
    counts = [2**k for k in range((os.cpu_count() or 1).bit_length())]
    rng, rows = np.random.default_rng(0), []
    for model in ("cable", "flex"):
        envs = {
            count: gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, num_threads=count, model=model, action="continuous")
            for count in counts
        }
        shape = next(iter(envs.values())).action_space.shape or ()
        actions = rng.uniform(-1, 1, (STEPS, *shape)).astype(np.float32)
        rates: dict[int, list[float]] = {count: [] for count in counts}
        for _ in range(REPEATS):
            for count, vector in envs.items():
                vector.reset(seed=0)
                start = time.perf_counter()
                for action in actions:
                    vector.step(action)
                rates[count].append(STEPS * NUM_ENVS / (time.perf_counter() - start))
        median = {count: np.median(rate) for count, rate in rates.items()}
        rows += [(model, count, f"{rate:.0f}", f"{rate / median[1]:.2f}x") for count, rate in median.items()]
    print(table(("model", "threads", "env steps/s", "of one"), rows))


if __name__ == "__main__":
    if sys.argv[1:] == ["--policy"]:
        print(policy_hash(1))
    else:
        for part in (rendering, updates, same_policy, threads):
            part()
