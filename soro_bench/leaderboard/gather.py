"""All entries under a folder of results; the first invalid one stops with its message."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soro_bench.leaderboard import diagnosis_entry
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.entry import entries_of, policy_of, read_entry
from soro_bench.packed import SUFFIX, archive_of, folders, names

DIAGNOSIS = "diagnosis"  # folder of that track, beside those of the boards
OLD = " (old)"  # what was trained before trainers had numbers


@dataclass(frozen=True)
class Group:
    """The policies of one method of one entry on a board, which differ by their training seed.

    Args:
        entries: (file, content), by seed.
        trainer: version of soro_bench's trainer; 0 where the entries name none.
        old: whether the same entry has policies of a newer trainer, on any board.
    """

    board: str
    entry: str
    method: str
    entries: Sequence[tuple[Path, dict]]
    trainer: int = 0
    old: bool = False

    @property
    def name(self) -> str:
        """The method, and if that is old of which trainer."""
        if not self.old:
            return self.method
        return self.method + (f" (trainer {self.trainer})" if self.trainer else OLD)

    @property
    def trained_on(self) -> str:
        """The model or mesh that all of the group's policies were trained on."""
        return self.entries[0][1]["trained_on"]

    @property
    def labels(self) -> list[str]:
        """The conditions that all of the group's policies were evaluated on, in the board's order."""
        return [label for label in BOARDS[self.board].conditions
                if all(label in entry["evaluations"] for _, entry in self.entries)]  # fmt: skip

    def has(self, label: str, name: str) -> bool:
        """Whether all of the group's entries have such values, which need not be entered."""
        return all(name in entry["evaluations"].get(label, {}) for _, entry in self.entries)

    def scores(self, label: str, name: str = "final_mm") -> np.ndarray:
        """(seeds, starts)"""
        return np.array([entry["evaluations"][label][name] for _, entry in self.entries], float)


def gather_control(results: str | Path) -> dict[str, list[Group]]:
    """The groups of every board that has entries; ValueError names what is wrong with a file and what is allowed."""
    results, found = Path(results), defaultdict(list)
    for path in _entries(results):
        entry = read_entry(path)
        expected = results / entry["board"] / entry["entry"] / entry["method"] / f"seed{entry['seed']}.json"
        if path != expected:
            raise ValueError(f"{path} holds what belongs to {expected}")
        policy_of(path, entry)  # refuses what is none
        trainer = entry.get("training", {}).get("trainer", 0)
        found[entry["board"], entry["entry"], entry["method"], trainer].append((path, entry))
    newest: defaultdict[str, int] = defaultdict(int)
    groups: defaultdict[str, list[Group]] = defaultdict(list)
    for _, entry, _, trainer in found:
        newest[entry] = max(newest[entry], trainer)
    for (board, entry, method, trainer), members in found.items():
        members = sorted(members, key=lambda member: member[1]["seed"])
        group = Group(board, entry, method, members, trainer, trainer < newest[entry])
        _check_alike(group)
        groups[board].append(group)
    return {board: groups[board] for board in BOARDS if board in groups}


def _entries(results: Path) -> list[Path]:
    """Files of the control track, also those in archives, by their paths; ValueError for a folder that is a link."""
    if link := next((path for path in results.rglob("*") if path.is_symlink() and path.is_dir()), None):
        raise ValueError(f"{link} is a link to a folder, in which no entries are read; move or copy the folder here")
    found = {path for path in results.rglob("*.json") if path.parent != results / DIAGNOSIS and not path.is_dir()}
    archives = {path for path in results.rglob(f"?*{SUFFIX}") if not path.is_dir()}  # methods may be called so
    archives.discard(archive_of(results / DIAGNOSIS))
    return sorted(found.union(*(entries_of(folder) for archive in archives for folder in folders(archive))))


def _check_alike(group: Group) -> None:
    (first, one), *others = group.entries
    for path, other in others:
        for key, value in _common(one).items():
            if (found := _common(other).get(key)) != value:
                raise ValueError(f"{path}: {key} is {found!r}; allowed: {value!r}, as in {first}")
    seen: dict[str, Path] = {}
    for path, entry in group.entries:
        if (holder := seen.setdefault(entry["policy"]["sha256"], path)) != path:
            raise ValueError(f"{path}: its policy is that of {holder}; every seed needs a training of its own")


def _common(entry: dict) -> dict:
    """What all seeds of a method have in common."""
    training = entry.get("training", {})
    settings = {name: value for name, value in training.get("settings", {}).items() if name != "seed"}
    same = {key: entry[key] for key in ("trained_on", "action", "steps")}
    of_training = {"algorithm": training.get("algorithm"), "effects": training.get("effects", [])}
    return same | of_training | {"settings": settings}


def gather_diagnosis(results: str | Path) -> list[dict]:
    """The entries of the diagnosis track, also those in an archive, by the names of their files."""
    folder = Path(results) / DIAGNOSIS
    return [diagnosis_entry.read_entry(folder / name) for name in names(folder) if name.endswith(".json")]
