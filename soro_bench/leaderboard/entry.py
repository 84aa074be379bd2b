"""Entries of the control track: a policy, what it was trained on, and what it did on a board's evaluations.

An entry is <results>/<board>/<entry>/<method>/seed<k>.json (control_entry.schema.json), its policy the file
seed<k>.safetensors or seed<k>.onnx beside it. The files of all seeds may be in <method>.zip instead,
or those of all methods in <entry>.zip (:mod:`soro_bench.packed`); their paths stay the same.
"""

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench import packed
from soro_bench.arrays import Floats
from soro_bench.envs.task import Task
from soro_bench.evaluation import frames_of
from soro_bench.files import check_folder, replacing, write_json
from soro_bench.leaderboard.boards import BOARDS, Board
from soro_bench.leaderboard.strict import ENTRY_BYTES, check, read_strict
from soro_bench.policies.onnx_policy import OnnxPolicy
from soro_bench.policies.policy import MAX_BYTES, Policy, PolicyCard, TrainedPolicy
from soro_bench.registration import make_task, task_type
from soro_bench.sources import metric_key, versions

FORMAT, SCHEMA = "soro_bench/control/1", "control_entry.schema.json"
CURVE_POINTS = 50
_ROUNDING = 1e-9  # of a part, that its end may be off
FARTHEST = 1e6  # mm, of the schema
_KINDS = {kind.suffix: kind for kind in (Policy, OnnxPolicy)}


def read_entry(path: str | Path) -> dict:
    """A valid entry of the control track; ValueError names the file, what is wrong and what is allowed."""
    entry = read_strict(path)
    check_entry(entry, path)
    return entry


def check_entry(entry: dict, path: str | Path) -> None:
    """ValueError if ``entry``, of the file ``path``, breaks the schema or does not fit its board."""
    check(entry, SCHEMA, path)
    if (board := BOARDS.get(entry["board"])) is None:
        raise ValueError(f"{path}: board is {entry['board']!r}; allowed: {', '.join(BOARDS)}")
    for name in ("seed", "steps"):
        if type(entry[name]) is not int:  # 1.0 is one by the schema
            raise ValueError(f"{path}: {name} is {entry[name]!r}; allowed: an integer, written as one")
    if Path(file := entry["policy"]["file"]).stem != f"seed{(seed := entry['seed'])}":
        raise ValueError(f"{path}: policy.file is {file!r}; allowed: seed{seed}.safetensors or seed{seed}.onnx")
    for label, scores in entry["evaluations"].items():
        _check_scores(board, label, scores, path)
    curve = entry.get("training", {}).get("curve", {"steps": (), "final_mm": ()})
    if len(curve["steps"]) != len(curve["final_mm"]):
        raise ValueError(f"{path}: the curve has {len(curve['steps'])} steps and {len(curve['final_mm'])} lengths")


def _check_scores(board: Board, label: str, scores: dict, path: str | Path) -> None:
    if label not in board.conditions:
        raise ValueError(f"{path}: evaluations has {label[:80]!r}; allowed: {', '.join(board.conditions)}")
    starts = len(board.conditions[label].starts)
    allowed = ("final_mm", *(f"{name}_mm" for name in board.beside), "return", "success")
    for name in (name for name in scores if name != "diverged"):
        if name not in allowed:
            raise ValueError(f"{path}: evaluations.{label} has {name}; allowed on this board: {', '.join(allowed)}")
        if (found := len(scores[name])) != starts:
            raise ValueError(f"{path}: evaluations.{label}.{name} has {found} values; allowed: {starts}, one a start")
    if scores["diverged"] > starts:
        raise ValueError(f"{path}: evaluations.{label}.diverged is {scores['diverged']}; allowed: {starts} at most")


def card_of(entry: dict) -> PolicyCard:
    """What the entry's policy was trained for."""
    trained = (entry[name] for name in ("trained_on", "action", "method", "seed", "steps"))
    return PolicyCard(BOARDS[entry["board"]].env_id, *trained)


def policy_bytes(path: str | Path, entry: dict) -> bytes:
    """The content of the policy file of the entry ``path``, beside it or in an archive: while an archived entry is
    replaced, the two differ. ValueError if neither is what was entered."""
    file, entered, found = Path(path).parent / entry["policy"]["file"], entry["policy"]["sha256"], []
    for data in packed.contents(file, MAX_BYTES):
        found.append(hashlib.sha256(data).hexdigest())
        if found[-1] == entered:
            return data
    raise ValueError(f"{file} has the SHA-256 {' and '.join(found)}; {path} says {entered}")


def policy_of(path: str | Path, entry: dict) -> TrainedPolicy:
    """The policy of the entry in the file ``path``."""
    file = Path(path).parent / entry["policy"]["file"]
    policy = _KINDS[file.suffix].from_bytes(card_of(entry), policy_bytes(path, entry), file)
    _check_fit(policy, file)
    return policy


def load_policy(path: str | Path) -> TrainedPolicy:
    """The policy of an entry's file (.json), or of the folder that a training wrote; ValueError if there is none."""
    path = Path(path)
    if path.suffix == ".json" and not path.is_dir():
        return policy_of(path, read_entry(path))
    return Policy.load(path)


def _check_fit(policy: TrainedPolicy, file: Path) -> None:
    """ValueError if a policy does not take its environment's observations or gives other actions."""
    task = _task(policy.card.env_id, policy.card.action)
    try:
        frames_of(task, policy.inputs)
        task.check_actions(policy.act(np.zeros((1, policy.inputs))), 1)
    except ValueError as error:
        raise ValueError(f"{file} is no policy for {policy.card.env_id}: {error}") from error


@cache
def _task(env_id: str, action: str) -> Task:
    return make_task(env_id, 1, 1, task_type(env_id).cheap, action=action)


def entries_of(folder: str | Path) -> list[Path]:
    """Files of the entries in a method's folder and in its archives, by name."""
    return [Path(folder) / name for name in packed.names(folder) if name.endswith(".json")]


def pack_entries(folder: str | Path) -> Path:
    """Move the entries in a method's folder, or in those of all methods in it, with their policies, into its archive;
    returns that.

    Raises:
        ValueError: there is no entry, or one is invalid; nothing has been moved.
    """
    folder, chosen = Path(folder), {}
    inner = [path for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    nearer = [path for path in (folder.iterdir() if folder.is_dir() else ()) if path.suffix == packed.SUFFIX]
    for method in sorted({folder, *inner, *map(packed.folder_of, nearer)}):
        for path in entries_of(method):
            policy_of(path, entry := read_entry(path))
            file = method / entry["policy"]["file"]
            chosen[path.relative_to(folder).as_posix()] = packed.read(path, ENTRY_BYTES)
            chosen[file.relative_to(folder).as_posix()] = policy_bytes(path, entry)
    if not chosen:
        raise ValueError(f"{folder} has no entries to pack")
    archive = packed.pack(folder, chosen)
    for path in nearer:
        path.unlink()
    if nearer and not any(folder.iterdir()):
        folder.rmdir()
    return archive


def write_entry(
    results: str | Path,
    board: str,
    entry: str,
    policy: TrainedPolicy,
    evaluations: Mapping[str, Mapping[str, Any]],
    distribution: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> Path:
    """Write an entry and its policy where they belong under ``results``; returns the entry's file.

    Args:
        board: of BOARDS.
        entry: who, or which code base, trained the policy; method and seed are those of the policy's card.
        evaluations: what :meth:`Board.score` gives, by the condition's label; see :func:`evaluated`.
        distribution: what the training parameters were drawn from; None for the nominal ones.
        training: algorithm, seconds, effects and curve; see :func:`thinned_curve`.

    Raises:
        ValueError: names what is wrong and what is allowed; nothing is written.
    """
    card, data = policy.card, policy.to_bytes()
    file = f"seed{card.seed}{policy.suffix}"
    written = {
        "format": FORMAT,
        "board": board,
        "entry": entry,
        "method": card.method,
        "seed": card.seed,
        "trained_on": card.model,
        "steps": card.steps,
        "action": card.action,
        "policy": {"file": file, "sha256": hashlib.sha256(data).hexdigest()},
        "distribution": distribution,
        "training": dict(training or {}),
        "evaluations": dict(evaluations),
        "versions": versions(),
    }
    path = _path(results, board, entry, card)
    written = json.loads(json.dumps(written, allow_nan=False))  # as it will be read
    check_entry(written, path)
    if (needed := BOARDS[board].env_id) != card.env_id:
        raise ValueError(f"{path}: the policy is for {card.env_id}; the board needs {needed}")
    path.unlink(missing_ok=True)  # killed between the two, an old entry would be of another policy
    with replacing(path.with_name(file)) as temporary:
        temporary.write_bytes(data)
    write_json(path, written)
    return path


def check_free(results: str | Path, board: str, entry: str, policy: TrainedPolicy) -> None:
    """ValueError if another policy's entry is where that of ``policy`` belongs."""
    path = _path(results, board, entry, policy.card)
    if packed.is_there(path) and read_entry(path)["policy"]["sha256"] != hashlib.sha256(policy.to_bytes()).hexdigest():
        raise ValueError(f"{path} is the entry of another policy; --replace puts this one in its place, another name "
                         "of the method (soro-bench train --name) or of the entry beside it")  # fmt: skip


def check_writable(results: str | Path, board: str, entry: str, policy: TrainedPolicy) -> None:
    """ValueError if the entry of a policy and its policy could not be written where they belong."""
    path = _path(results, board, entry, policy.card)
    check_folder(path.parent, [path.name, path.with_suffix(policy.suffix).name])


def _path(results: str | Path, board: str, entry: str, card: PolicyCard) -> Path:
    return Path(results) / board / entry / card.method / f"seed{card.seed}.json"


def evaluated(board: Board, policy: TrainedPolicy, labels: Sequence[str] = (), num_threads: int = 0) -> dict[str, dict]:
    """The scores of a policy on a board, by the labels of the conditions (all by default)."""
    return {label: board.score(board.play(policy, label, num_threads)) for label in labels or board.conditions}


def thinned_curve(path: str | Path, metric: str) -> dict[str, list[float]]:
    """A training's curve.csv as an entry has it: means of some 50 equal parts; ``metric`` is the task's."""
    steps, final = read_curve(path, metric, CURVE_POINTS)
    final = np.clip(final, -FARTHEST, FARTHEST)  # an episode that diverged may have ended anywhere
    return {"steps": [round(float(s)) for s in steps], "final_mm": [round(float(value), 3) for value in final]}


def read_curve(path: str | Path, metric: str, parts: int) -> tuple[Floats, Floats]:
    """Steps and mean final metric [mm] of the episodes in each of so many equal parts of a training.

    A part mixes whole updates: the episodes that end early in an update are the successful ones.

    Raises:
        ValueError: the file is no such table.
    """
    names = ("steps", "episodes", metric_key(metric))
    try:
        with Path(path).open() as file:
            rows = [tuple(float(row[name]) for name in names) for row in csv.DictReader(file)]
        steps, episodes, value = np.array(rows).T
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} is no table of {', '.join(names)} ({type(error).__name__}: {error})") from error
    if not ((steps > 0) & (episodes > 0)).all() or not np.isfinite(rows).all():
        raise ValueError(f"{path} has steps or episodes that are not positive, or other numbers that are not finite")
    part = np.ceil(parts * steps / steps[-1] - _ROUNDING).astype(int) - 1  # an update belongs to the part it ends in
    present = np.unique(part)
    means = [np.average(value[part == k], weights=episodes[part == k]) for k in present]
    return (present + 0.5) / parts * steps[-1], np.array(means)
