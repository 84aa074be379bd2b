"""From the folder of a training to an entry: the policy is evaluated on the fixed starts of its board."""

import csv
import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from soro_bench.envs.task import effects_of
from soro_bench.files import brief, check_folder, read_json
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.entry import check_free, check_writable, thinned_curve, write_entry
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.policies.policy import Policy, TrainedPolicy
from soro_bench.randomization import Distribution, Gaussian, from_dict, holding
from soro_bench.recording.rerun_log import write_recording
from soro_bench.recording.rerun_stream import require_rerun
from soro_bench.registration import task_type
from soro_bench.training.configuration import PPOConfig

_SETTINGS = tuple(each.name for each in fields(PPOConfig) if each.name != "effects")  # which are entered by their names


def enter(folder: Path, board: str, entry: str, results: Path, threads: int = 0, replace_other: bool = False) -> Path:
    """Evaluate the policy that was trained into ``folder`` on all conditions of a board; returns its entry's file.

    Args:
        folder: as :func:`soro_bench.training.ppo.train` leaves it; gets a rerun recording of every evaluation.
        entry: who, or which code base, trained it.
        results: folder of all entries.
        replace_other: whether the entry may take the place of one with another policy.

    Raises:
        ValueError: says what is wrong in the folder, or that the place is taken; nothing has been evaluated.
    """
    policy, config = Policy.load(folder), read_json(folder / "config.json")
    if missing := sorted({"distribution", "trainer"} - set(config if isinstance(config, dict) else {})):
        raise ValueError(f"{folder / 'config.json'} lacks {', '.join(missing)}; soro-bench train writes both")
    if type(trainer := config["trainer"]) is not int:
        raise ValueError(f"{folder / 'config.json'}: trainer is {trainer!r}; it has to be a number")
    effects = effects_of(config.get("effects", [])) or ()
    _check_fixed(board, config["distribution"], folder)
    training = _training(folder, policy.card.env_id) | {
        "trainer": trainer,
        "algorithm": f"PPO ({config['learner']})" if "learner" in config else "PPO",
        "settings": {name: config[name] for name in _SETTINGS if name in config},
        "effects": [effect.name for effect in effects],
    }
    if "told" in config:
        training["told"] = _told(config["told"], folder)
    if not replace_other:
        check_free(results, board, entry, policy)
    check_writable(results, board, entry, policy)
    evaluations = record_evaluations(policy, board, tuple(BOARDS[board].conditions), folder, threads)
    return write_entry(results, board, entry, policy, evaluations, config["distribution"], training)


def _told(values: Any, folder: Path) -> dict[str, float]:
    """What a policy was told, as config.json has it."""
    numbers = values.values() if isinstance(values, dict) else [values]
    if not all(type(value) in (int, float) and math.isfinite(value) for value in numbers):
        raise ValueError(f"{folder / 'config.json'}: told is {brief(values)}; it has to be finite numbers by name")
    return dict(values)


def _check_fixed(board: str, distribution: dict | None, folder: Path) -> None:
    """Refuse a policy that was not trained with what the task of its board gives."""
    fixed = BOARDS[board].fixed
    given = from_dict(distribution) if distribution else None
    if not all(_holds(given, name, value) for name, value in fixed.items()):
        wanted = ", ".join(f"{name} = {value:g}" for name, value in fixed.items())
        raise ValueError(f"{folder} was not trained with what {board} gives: {wanted} in every episode")


def _holds(given: Distribution | None, name: str, value: float) -> bool:
    """Whether a parameter always had a value in training."""
    if given is None or name not in given.names:
        return ALL_PARAMETERS[name].nominal == value
    if isinstance(given, Gaussian):
        return given.holds(name, value)
    held = holding(given, {name: value})
    return held is not None and held.to_dict() == given.to_dict()


def _training(folder: Path, env_id: str) -> dict:
    path = folder / "curve.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path} has no rows; a training of soro-bench train has one for every update")
    curve = thinned_curve(path, task_type(env_id).metric)
    try:
        seconds = float(rows[-1]["seconds"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} does not say in its last row how many seconds the training took") from error
    return {"seconds": seconds, "curve": curve}


def record_evaluations(
    policy: TrainedPolicy, board: str, labels: Sequence[str], folder: Path, threads: int = 0
) -> dict[str, dict]:
    """The score of a policy under the conditions with these labels; ``folder`` gets a rerun recording of each.

    Raises:
        ValueError: that cannot be written; nothing has been evaluated.
    """
    require_rerun()
    check_folder(folder, [f"evaluation_{label}.rrd" for label in labels])
    scores = {}
    for label in labels:
        episodes = BOARDS[board].play(policy, label, threads)
        title = f"{board} {policy.card.method} on {label}"
        write_recording(folder / f"evaluation_{label}.rrd", episodes, title)
        scores[label] = BOARDS[board].score(episodes)
    return scores
