"""Sets of hidden cases: two recordings of each real robot for everybody, and sealed labels.

A case is drawn without simulating anything (``draw_cases``); then its effects are scaled so that each changes the
training recording's keypoints by a target. Every recording starts from a fresh robot, with the same laws: what has
drifted, slipped or yielded in one is as new in the other. Only gusts and outliers come at other times.
"""

import hashlib
import os
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from gymnasium import spaces

from soro_bench.blind_benchmark.bench import Bench, change
from soro_bench.blind_benchmark.draw import Case, draw_cases, manoeuvre
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP
from soro_bench.blind_benchmark.score import opened_labels
from soro_bench.files import read_json, replacing, write_json
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.parallel import HERE, Workers, each
from soro_bench.recording.excitation import excitation
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.simulated import COMMAND

NOISE = 0.0005  # m, standard deviation of each coordinate
DURATIONS = {"train": 30.0, "heldout": 12.0, "task": 30.0}  # s; "task" is to train on where excitation is to be judged
_DATE = 946684800  # s, the 1st of January 2000: when a file was made would tell how long its case took
_ROLES = ("train", "heldout", "task")
_SEED_BITS = 59  # as many as labels, which are read as strictly as files of strangers, may have digits for


def build(case: Case, durations: dict[str, float] = DURATIONS) -> tuple[dict[str, Recording], dict]:
    """The recordings of a case by role, and its label."""
    streams: dict[str, tuple[int, ...]] = {name: (*case.seed, i) for i, name in enumerate(("drawing", *_ROLES), 1)}
    actions = {
        "train": excitation(_action_space(), CONTROL_TIMESTEP, durations["train"], _number(streams["train"])),
        "heldout": manoeuvre(durations["heldout"], streams["heldout"]),
        "task": manoeuvre(durations["task"], streams["task"]),
    }
    bench = Bench(case, actions, streams)
    effects, points = bench.realised(np.random.default_rng(streams["drawing"]))
    changes = {role: change(points[role], bench.points(role, [])) for role in _ROLES}
    recordings = {
        role: recording(actions[role], points[role], np.random.default_rng([*streams[role], 1])) for role in _ROLES
    }
    label = {
        "id": case.id,
        "group": case.group,
        "robot": case.robot,
        "parameters": {p.name: {"value": case.parameters[p.name], "unit": p.unit} for p in trunk.PARAMETERS},
        "effects": [effect.label() for effect in effects],
        "change_mm": changes,
        "noise": {"value": NOISE, "unit": "m"},
        "seeds": {name: list(stream) for name, stream in streams.items()},
    }
    return recordings, label


def write_cases(
    folder: str | Path,
    count: int,
    seed: int,
    healthy: int | None = None,
    workers: Workers = HERE,
    progress: Callable[[int, int], None] = lambda done, count: None,
    durations: dict[str, float] = DURATIONS,
) -> None:
    """Write the recordings of ``count`` cases, the sealed labels and their digest.

    In ``folder``: case_000/train.parquet, heldout.parquet, task.parquet and so on; sealed/labels.json; commitment.txt,
    the SHA-256 of the labels. Called again, it goes on where it stopped; what has been committed to stays.

    Args:
        workers: what simulates them; those of a cluster see the same folder.
        progress: is told how many of the cases are done.
        durations: s, of the recordings by role; an excitation takes at least 18.2 s.

    Raises:
        ValueError: the folder has other cases, or recordings that are not those of the labels.
    """
    folder = Path(folder).resolve()  # workers of a cluster start elsewhere
    cases = draw_cases(count, seed, healthy)
    _check_plan(folder, {"count": count, "seed": seed, "nulls": healthy, "durations": durations})
    for i, _ in enumerate(each(_write_case, [(folder, case, durations) for case in cases], workers)):
        progress(i + 1, count)
    if (folder / "commitment.txt").exists():
        _check_recordings(folder)
        return
    labels = {
        "count": count,
        "seed": seed,
        "cases": [read_json(_label_path(folder, case)) for case in cases],
    }
    path = folder / "sealed" / "labels.json"
    write_json(path, labels)
    with replacing(folder / "commitment.txt") as temporary:
        temporary.write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")


def sealed_seed(folder: str | Path) -> int:
    """The seed of the cases in a folder; if there are none a new one.

    Commands are drawn from it, as all that is sealed is: whoever can count up to a seed finds it by the commands of a
    recording, and with it the labels.
    """
    path = Path(folder) / "sealed" / "plan.json"
    return read_json(path)["seed"] if path.exists() else secrets.randbits(_SEED_BITS)


def _action_space() -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (len(geo.CABLE_NAMES),), np.float32)


def _number(stream: Sequence[int]) -> int:
    """A seed for what takes one number only."""
    return int(np.random.SeedSequence(stream).generate_state(1)[0])


def recording(actions: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> Recording:
    """What is recorded of actions (T, 8) and keypoints (T + 1, 21, 3) [m], with noise."""
    stamps = CONTROL_TIMESTEP * np.arange(len(points))
    measured = points + NOISE * rng.standard_normal(points.shape)
    metadata = {"env_id": "TrunkReach-v0", "action": "continuous", "noise": repr(NOISE)}
    return Recording(
        {COMMAND: Signal(stamps[:-1], actions, "1")},
        {"keypoints": Signal(stamps, measured, "m", "world")},
        {},
        metadata,
    )


def _check_plan(folder: Path, plan: dict) -> None:
    """Refuse to mix two sets of cases in one folder."""
    path = folder / "sealed" / "plan.json"
    if not path.exists():
        write_json(path, plan)
    elif (other := read_json(path)) != plan:
        raise ValueError(f"{folder} has the cases of {other}, not of {plan}")


def _check_recordings(folder: Path) -> None:
    """Refuse recordings other than those that the labels belong to."""
    for label in opened_labels(folder):
        for name, committed in label["sha256"].items():
            path = folder / label["id"] / name
            if (found := hashlib.sha256(path.read_bytes()).hexdigest()) != committed:
                raise ValueError(f"{path} has the hash {found}, its label says {committed}")


def _label_path(folder: Path, case: Case) -> Path:
    return folder / "sealed" / "cases" / f"{case.id}.json"


def _recording_path(folder: Path, case: Case, role: str) -> Path:
    return folder / case.id / f"{role}.parquet"


def _write_case(folder: Path, case: Case, durations: dict[str, float]) -> None:
    """Unless it is there. The label, which has the hashes of the recordings, is written last."""
    paths = [_label_path(folder, case), *(_recording_path(folder, case, role) for role in _ROLES)]
    if all(path.is_file() for path in paths):
        return
    recordings, label = build(case, durations)
    hashes = {}
    for role in _ROLES:
        path = _recording_path(folder, case, role)
        save(recordings[role], path)
        hashes[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        os.utime(path, (_DATE, _DATE))
    os.utime(folder / case.id, (_DATE, _DATE))
    write_json(_label_path(folder, case), label | {"sha256": hashes})
