"""Numbers that are chosen by the names that stand beside them, in whatever order they come."""

from collections.abc import Sequence

import numpy as np

from soro_bench.recording.importers.table_cells import Names
from soro_bench.recording.recording import RecordingError


def chosen_by_name(
    wants: Sequence[Names], places: np.ndarray, time: np.ndarray, numbers: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(T,) times, (T, k) numbers in the order of the names, and (T,) lines.

    Args:
        places: (rows, m) which of the names stands in each column of names, -1 for none of them.
        time: (rows,).
        numbers: (rows, m) beside the names, or (rows, k) of the one name of a row, where m is 1.
        lines: (rows,).

    Raises:
        RecordingError: a name never occurs, or occurs twice at one time.
    """
    names = wants[0].names
    for i, name in enumerate(names):
        if not (places == i).any():
            there = ", ".join(ascii(each)[1:-1] for want in wants for each in want.found)[:200]
            raise RecordingError(f"no row has the name {ascii(name)[:80]}; there are {there}")
    if len(wants) > 1:
        return time, _beside(names, places, numbers, lines), lines
    kept = places[:, 0] >= 0
    return _gathered(names, places[kept, 0], time[kept], numbers[kept], lines[kept])


def _beside(names: tuple[str, ...], places: np.ndarray, numbers: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """(rows, names) the number beside each name, NaN where it is not there."""
    found = np.full((len(places), len(names)), np.nan)
    for i, name in enumerate(names):
        hit = places == i
        if (twice := hit.sum(axis=1) > 1).any():
            raise RecordingError(f"the name {ascii(name)[:80]} stands twice in line {lines[twice][0]}")
        column = hit.argmax(axis=1)
        found[:, i] = np.where(hit.any(axis=1), numbers[np.arange(len(numbers)), column], np.nan)
    return found


def _gathered(
    names: tuple[str, ...], places: np.ndarray, time: np.ndarray, numbers: np.ndarray, lines: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One sample of (names * k,) numbers for the rows of one time that follow one another."""
    begins = np.append(True, np.diff(time) != 0)
    group = np.cumsum(begins) - 1
    found = np.full((group[-1] + 1, len(names), numbers.shape[1]), np.nan)
    _, first = np.unique(group * len(names) + places, return_index=True)
    if len(first) < len(group):
        again = np.setdiff1d(np.arange(len(group)), first)[0]
        name = ascii(names[places[again]])[:80]
        raise RecordingError(f"the name {name} comes twice at one time, again in line {lines[again]}")
    found[group, places] = numbers
    return time[begins], found.reshape(len(found), -1), lines[begins]
