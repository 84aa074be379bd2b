"""Numbers that a table has of every recording, such as the weight that hung on the robot, as constant commands."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.recording.importers.mapping import texts
from soro_bench.recording.importers.source import check_keys, read_source
from soro_bench.recording.recording import RecordingError, Signal
from soro_bench.recording.untrusted import named_errors, read_bytes

_KEYS = ("file", "key", "commands")
_MAX_BYTES = 1_000_000


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
    check_keys("takes", takes, _KEYS)
    table = path.parent / takes["file"]
    with named_errors(table):
        rows = list(csv.DictReader(io.StringIO(read_bytes(table, _MAX_BYTES).decode("utf-8-sig"))))
        found = [row for row in rows if row.get(takes["key"]) == path.stem]
        if len(found) != 1:
            raise RecordingError(f"{len(found)} rows with {takes['key']} {path.stem!a}; expected one")
        return {name: _command(name, entry, found[0]) for name, entry in takes["commands"].items()}


def _command(name: str, entry: Mapping[str, Any], row: Mapping[str, str]) -> Signal:
    """One command of a row."""
    source = read_source(entry, ("columns",), False)
    numbers = []
    for column in texts(f"{name} columns", entry.get("columns")):
        try:
            numbers.append(float(row[column]))
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"commands.{name}: {row.get(column)!a} in {column} is no number") from error
    return source.signal(np.zeros(1), np.array([numbers]))
