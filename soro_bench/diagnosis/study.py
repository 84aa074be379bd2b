"""Studies of real robots: a model, a map, and recordings by the questions that they answer.

A study is a table of ``assets/studies.toml``: a model, its mapping, how its recordings are imported, and parts. A part
names recordings to explain, held-out ones and unseen ones, as files with the changes that their import makes to the
mapping. The result of the part that it comes ``after`` is its baseline. Where a table of the recordings has a row for
each file (``takes``), its numbers become commands of that recording. What the groups of ``name`` find in a file's name
become metadata. :mod:`soro_bench.diagnosis.study_runs` diagnoses them."""

import csv
import glob
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import asset_path, brief, read_toml
from soro_bench.recording.importers import import_recording
from soro_bench.recording.importers.mapping import in_utf8, texts
from soro_bench.recording.importers.source import check_keys, read_source
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.untrusted import named_errors, read_bytes

STUDIES = tuple(read_toml(asset_path("studies.toml")))
KINDS = ("train", "heldout", "unseen")  # of recordings of a part
_TAKES = ("file", "key", "commands")
_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Part:
    """Recordings of one question: to explain (train), to compare answers on too (heldout), and that play no part
    (unseen). ``after`` names the part whose result is the baseline. Parameters ``anew`` may have changed since
    as much as they were unknown before, as of markers that were put on again."""

    name: str
    question: str
    train: tuple[Recording, ...]
    heldout: tuple[Recording, ...]
    after: str | None
    unseen: tuple[Recording, ...] = ()
    anew: tuple[str, ...] = ()


@dataclass(frozen=True)
class Study:
    """A robot and its recordings; its map is a file or the content of one."""

    name: str
    model: Path
    map: Path | Mapping[str, Any]
    parts: tuple[Part, ...]


def load_study(
    name: str, data: str | Path, files: Mapping[str, Sequence[str]] | None = None, part: str | None = None
) -> Study:
    """A study of the suite with its recordings, from a folder that ``soro-bench data`` has filled.

    Args:
        name: of the study.
        data: the folder with the study's own folder of recordings in it, that folder, or one in it.
        files: patterns of other files to explain ("train"), to hold out and not to see, instead of all of the part's.
        part: the only part to load; needed with ``files`` where there are several.

    Raises:
        ValueError: there is no such study or part, or ``files`` needs one.
        FileNotFoundError: a recording is not there.
    """
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}; there are {', '.join(STUDIES)}")
    table = read_toml(asset_path("studies.toml"))[name]
    parts = table["parts"]
    if part is not None and part not in parts:
        raise ValueError(f"unknown part {part!r} of {name}; there are {', '.join(parts)}")
    chosen = {key: each for key, each in parts.items() if part in (None, key)}
    if files and len(chosen) > 1:
        raise ValueError(f"which part of {name} are these files for? Write --part and one of {', '.join(parts)}")
    given = Path(data).resolve()
    folder = given if table["data"] in given.parts else given / table["data"]
    loaded = []
    for key, each in chosen.items():
        entries = _replaced(folder, table, each, files) if files else {kind: each.get(kind, []) for kind in KINDS}
        train, heldout, unseen = (_recordings(folder, table, entries[kind]) for kind in KINDS)
        question = f"other files: {_listed(files)}" if files else each["question"]
        anew = tuple(each.get("anew", ()))
        loaded.append(Part(key, question, train, heldout, each.get("after"), unseen, anew))
    robot_map = table["map"]
    if isinstance(robot_map, str):
        robot_map = asset_path(f"mjcf/{robot_map}")
    return Study(name, asset_path(f"mjcf/{table['model']}"), robot_map, tuple(loaded))


def _listed(files: Mapping[str, Sequence[str]]) -> str:
    return "; ".join(f"{kind} {', '.join(patterns)}" for kind, patterns in files.items() if patterns)


def _replaced(
    folder: Path, study: Mapping[str, Any], part: Mapping[str, Any], files: Mapping[str, Sequence[str]]
) -> dict[str, list[dict]]:
    """Entries for other files, one each. A file is imported as the entry of the same kind whose pattern it matches; any
    other with the changes that all entries of the part have in common."""
    own = [entry for kind in KINDS for entry in part.get(kind, [])]
    common = {key: value for key, value in own[0].items() if all(entry.get(key) == value for entry in own)}

    def like(kind: str, path: Path) -> dict:
        name = path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name
        matching = [entry for entry in part.get(kind, []) if fnmatchcase(name, entry["files"])]
        return {**(matching[0] if matching else common), "files": str(path)}

    return {
        kind: [like(kind, path) for pattern in files.get(kind, ()) for path in _paths(folder, study, pattern)]
        for kind in KINDS
    }


def _paths(folder: Path, study: Mapping[str, Any], pattern: str) -> list[Path]:
    """The files of a pattern below a folder, or of one with a path of its own, but for a table of takes.

    Raises:
        FileNotFoundError: there are none.
    """
    takes = study.get("takes", {}).get("file")
    named = [pattern] if (folder / pattern).is_file() else sorted(glob.glob(pattern, root_dir=folder))
    paths = [folder / each for each in named if Path(each).name != takes]
    if not paths:
        raise FileNotFoundError(f"no {pattern} in {folder}; --data names another folder, soro-bench data gets some")
    return paths


def _recordings(folder: Path, study: Mapping[str, Any], entries: Sequence[dict]) -> tuple[Recording, ...]:
    """Of each entry the files, imported by the study's mapping with the sections that the entry changes."""
    found, mapping = [], study["import"]
    if isinstance(mapping, str):
        mapping = read_toml(asset_path(f"mjcf/{mapping}"))
    for entry in entries:
        changes = {key: value for key, value in entry.items() if isinstance(value, dict)}
        sections = {key: {**mapping.get(key, {}), **value} for key, value in changes.items()}
        for path in _paths(folder, study, entry["files"]):
            changed = {**mapping, **sections}
            if in_name := _from_name(path, study):
                changed["metadata"] = {**changed.get("metadata", {}), **in_name}
            recording = import_recording(path, changed)
            if takes := study.get("takes"):
                recording = replace(recording, commands={**recording.commands, **commands_of_take(path, takes)})
            found.append(recording)
    return tuple(found)


def _from_name(path: Path, study: Mapping[str, Any]) -> dict[str, str]:
    """Metadata in the name of a file; RecordingError where its study needs some and finds none."""
    if "name" not in study:
        return {}
    if not (found := re.search(study["name"], path.name)):
        raise RecordingError(f"{path}: this study's recordings have names like {study['name']}, a regular expression; "
                             "is it of another robot or kind?")  # fmt: skip
    return {name: text for name, text in found.groupdict().items() if text is not None}


def commands_of_take(path: Path, takes: Mapping[str, Any]) -> dict[str, Signal]:
    """The commands that a table has for a recording, each one sample at time 0.

    Args:
        path: of the recording; the table lies in its folder.
        takes: ``file``, the name of the table; ``key``, its column with the names of recordings without suffix; and
            ``commands``, a section as in an import mapping for each command.

    Raises:
        RecordingError: the table has no row for the recording, or several; or a number is none.
        FileNotFoundError: there is no table.
    """
    check_keys("takes", takes, _TAKES)
    table = path.parent / takes["file"]
    if not table.is_file():
        raise FileNotFoundError(f"no {takes['file']} beside {path}; it has a row for each recording")
    with named_errors(table):
        # of which some spreadsheets end lines as old Macs do
        reader = csv.DictReader(io.StringIO(in_utf8(read_bytes(table, _MAX_BYTES)), newline=None))
        columns, rows = [takes["key"], *_columns(takes["commands"])], list(reader)
        if wrong := [each for each in columns if list(reader.fieldnames or ()).count(each) != 1]:
            raise RecordingError(f"its first line has to name {', '.join(columns)} once each, between commas; "
                                 f"not so {', '.join(wrong)}")  # fmt: skip
        found = [row for row in rows if row.get(takes["key"]) == path.stem]
        if len(found) != 1:
            raise RecordingError(f"{len(found)} rows with {takes['key']} {path.stem!a}; expected one")
        return {name: _command(name, entry, found[0]) for name, entry in takes["commands"].items()}


def _columns(commands: Mapping[str, Any]) -> list[str]:
    """The columns of all commands of a table of takes."""
    return [column for name, entry in commands.items() for column in texts(f"{name} columns", entry.get("columns"))]


def _command(name: str, entry: Mapping[str, Any], row: Mapping[str, str]) -> Signal:
    """One command of a row."""
    source = read_source(entry, ("columns",), False)
    numbers = []
    for column in texts(f"{name} columns", entry.get("columns")):
        text = row[column] or ""
        try:
            numbers.append(float(text.replace("_", "no number")))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise RecordingError(f"commands.{name}: {brief(text)} in {column} is no finite number")
    return source.signal(np.zeros(1), np.array([numbers]))
