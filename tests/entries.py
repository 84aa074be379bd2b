"""A small board with a small policy, and entries of it.

Jobs for the tests of workers; light to import, since every worker does.
"""

import hashlib
import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from soro_bench.blind_benchmark.score import CRITERIA
from soro_bench.files import read_json, write_json
from soro_bench.leaderboard.boards import BOARDS, Condition
from soro_bench.leaderboard.entry import evaluated, write_entry
from soro_bench.policies.policy import Policy, PolicyCard

BOARD = "TrunkReach-v0"


CARD = PolicyCard(BOARD, "cable", "continuous", "oracle", 0, 1000)


OBSERVED, CABLES = 66, 8


def shrink_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two starts of five steps, on the cheap model."""
    whole = BOARDS[BOARD]
    conditions = {"cable": Condition("cable", whole.conditions["cable"].starts[:2])}
    monkeypatch.setitem(BOARDS, BOARD, replace(whole, conditions=conditions, episode_steps=5))


def policy(seed: int = 0, **card: Any) -> Policy:
    """One random layer."""
    rng = np.random.default_rng(seed)
    tensors: dict[str, np.ndarray] = {"mean": np.zeros(OBSERVED), "std": np.ones(OBSERVED)}
    tensors |= {"w0": rng.normal(size=(CABLES, OBSERVED)), "b0": np.zeros(CABLES)}
    return Policy(replace(CARD, seed=seed, **card), tensors)


def scores(*final_mm: float) -> dict:
    """The scores of episodes that end with these metrics [mm], on the cheap model."""
    return {"cable": {"final_mm": list(final_mm), "return": [0.0] * len(final_mm), "success": [False] * len(final_mm),
                      "diverged": 0}}  # fmt: skip


def true_entry(results: Path, entry: str = "ours", given: Policy | None = None) -> Path:
    """An entry with what its policy does."""
    given = given or policy()
    return write_entry(results, BOARD, entry, given, evaluated(BOARDS[BOARD], given, num_threads=1))


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change the content of an entry."""
    entry = json.loads(path.read_text())
    change(entry)
    write_json(path, entry)


def put_policy(path: Path, name: str, data: bytes) -> None:
    """Another policy file for an entry, with its hash."""
    (path.parent / name).write_bytes(data)
    edit(path, lambda entry: entry.update(policy={"file": name, "sha256": hashlib.sha256(data).hexdigest()}))


def gates(false_alarms: float) -> list[dict]:
    """Those of a diagnosis of which only the first has cases."""
    empty = {"cases": 0, "value": None, "interval": None, "met": None}
    found: list[dict] = [{"gate": name, "bar": bar, "below": below, **empty} for name, _, _, bar, below in CRITERIA]
    found[0] |= {"cases": 20, "value": false_alarms, "interval": [0.0, 0.1], "met": false_alarms <= found[0]["bar"]}
    return found


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
    from soro_bench.training.ppo import PPOConfig, train

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
