"""Jobs for the tests of workers; light to import, since every worker does."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from soro_bench.files import read_json, write_json


def squared(i: int, wait: float = 0.0) -> int:
    """The square of a number, after some seconds; ValueError for a negative one."""
    time.sleep(wait)
    if i < 0:
        raise ValueError(f"{i} is negative")
    return i * i


def die_once(folder: Path) -> None:
    """Kill this process if it is the first to come here, as a machine that runs out of memory would."""
    try:
        (folder / "died").touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), signal.SIGKILL)


def counted(folder: Path, i: int, array: np.ndarray) -> int:
    """Square a number, unless its file is there; the fourth job kills its worker, once."""
    path = folder / f"{i}.json"
    if not path.exists():
        with open(folder / "computed", "a") as file:
            file.write(f"{i}\n")
        if i == 3:
            die_once(folder)
        write_json(path, i * i + int(array.sum()))
    return read_json(path)


def die() -> None:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)


def trained(folder: Path, dying: bool) -> tuple[bytes, bytes]:
    """Train a small policy; the worker is killed after the first of three checkpoints."""
    from soro_bench.training.configuration import PPOConfig
    from soro_bench.training.ppo import train

    config = PPOConfig(
        "TrunkReach-v0", total_steps=600, num_envs=2, rollout_steps=100, rollouts_per_segment=1, batch_size=100,
        epochs=2, hidden=(16,), num_threads=1,
    )  # fmt: skip
    folder.mkdir(exist_ok=True)

    def progress(steps: int, total: int, row: dict) -> None:
        with open(folder / "steps", "a") as file:
            file.write(f"{steps}\n")
        if dying and steps > config.segment_steps:
            die_once(folder)

    train(config, folder, progress=progress)
    return (folder / "policy.safetensors").read_bytes(), (folder / "policy.json").read_bytes()
