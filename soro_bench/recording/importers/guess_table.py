"""A first mapping of a table of text, from its header and its numbers, for the user to correct."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soro_bench.files import shown, toml
from soro_bench.recording.importers.guess_layout import Column, layout
from soro_bench.recording.importers.guess_time import ROW, order, time_section, unit_of_times
from soro_bench.recording.importers.mapping import NO_COMMAND
from soro_bench.recording.importers.table_text import is_grouped
from soro_bench.recording.importers.tracks import signal_name
from soro_bench.recording.importers.units import UNITS, in_brackets, of_text, si, split_unit
from soro_bench.recording.importers.wraps import (
    counter_period,
    lost_number,
    part_of_turn,
    saw_period,
    seen_wraps,
    thousands,
)
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import MAX_BYTES, named_errors, read_bytes

_COMMAND = re.compile(
    r"(.*[^a-z])?(cmd|command|commanded|goal|target|desired|des|setpoint|sp|ref|reference|soll|sollwert|action|ctrl|"
    r"control|demand|pwm|duty|enable|enabled|u\d*|consigne|consigna|commande|comando|\u6307\u4ee4|\u76ee\u6a19)s?"
    r"([^a-z].*)?"
)
_HELD = 0.8  # of the samples of a command are as the one before
_REPEATED, _NAMES = 0.7, 100  # of the stamps are others, where rows of several names share one; names at most
_NEARLY = 0.9  # of a turn, that an angle that wraps has seen
_SEPARATORS = "has separators of thousands, which are not read: export the table without them"


@dataclass
class Group:
    """Columns that belong to one signal."""

    name: str
    columns: list[Column] = field(default_factory=list)
    points: bool = False  # x, y and z, one point after the other
    clock: Column | None = None  # with other times than those of [time]
    beside: Column | None = None  # the names that stand beside its numbers

    def alike(self, other: "Group") -> bool:
        """Whether both are parts of one signal."""
        mine, its = ((g.name, g.points, g.clock, _unit(g.columns[0]), g.command) for g in (self, other))
        return mine == its

    @property
    def command(self) -> bool:
        """Whether the name is one of a command."""
        return _COMMAND.fullmatch(split_unit(self.columns[0].name)[0].lower()) is not None


def guessed(path: str | Path) -> str:
    """A commented mapping (TOML) of everything in a table, to be corrected.

    Raises:
        RecordingError: it looks like no table.
    """
    data = read_bytes(path, MAX_BYTES)
    with named_errors(path):
        options, columns, above = layout(data)
        clock, others, lines = time_section(columns, above)
        rest = [column for column in columns if column not in clock]
        beside, numbers = _beside(rest, clock), [c for c in rest if c.numeric or c in others]
        groups = _groups(numbers, others) if beside is None else [Group(c.name, [c], beside=beside) for c in numbers]
        names: set[str] = set()
        entries = [_entry(group, names) for group in groups]
        if not entries:
            raise RecordingError(f"no column of numbers is found beside time{_no_number(rest)}")
        head = [f"# A guess from {shown(Path(path).name)}: correct what is wrong, and take out what you do not need."]
        head += [] if any(group.command for group in groups) else [NO_COMMAND]
        about = [_text_column(column) for column in rest if not column.numeric and any(column.texts)]
        about += _separators(columns)
        lines = [*lines, *([] if beside else order(*clock))]
        sections = [[*head, *_format(options)], lines, *([about] if about else []), *entries]
        text = "\n\n".join("\n".join(section) for section in sections) + "\n"
        return text


def _format(options: dict) -> list[str]:
    if not options:
        return []
    return ["", "[format]", *(f"{key} = {toml(value)}" for key, value in options.items())]


def _beside(columns: Sequence[Column], clock: Sequence[Column]) -> Column | None:
    """The column whose names come once at each time, where times repeat: a row for each joint."""
    times = list(zip(*(column.texts for column in clock), strict=True))
    if not times or len(set(times)) > _REPEATED * len(times):
        return None
    for column in columns:
        pairs = set(zip(times, column.texts, strict=True))
        if not column.numeric and 1 < len(column.words) <= _NAMES and len(pairs) == len(times):
            return column
    return None


def _no_number(columns: Sequence[Column]) -> str:
    """What a cell has instead of a number."""
    words = sorted((word for column in columns for word in column.words), key=is_grouped, reverse=True)
    return "".join(f"; {shown(word)[:40]} {_SEPARATORS if is_grouped(word) else 'is none'}" for word in words[:1])


def _separators(columns: Sequence[Column]) -> list[str]:
    """Comments on columns with separators of thousands, or numbers that look like them."""
    lines = []
    for column in columns:
        word = next(filter(is_grouped, column.words), "")
        about = f"{shown(word)} {_SEPARATORS}"
        if doubt := about if word else thousands(column.numbers) if column.numeric else "":
            lines.append(f"# column {toml(column.label)}: {doubt}")
    return lines


def _groups(columns: Sequence[Column], clocks: Sequence[Column]) -> list[Group]:
    """Neighbours whose names differ by a number at the end, or are x, y and z; after another clock, with its times."""
    groups: list[Group] = []
    clock: Column | None = None
    i = 0
    while i < len(columns):
        if columns[i] in clocks:
            clock = columns[i] if i else None  # beside the first one it is a second clock of all
            i += 1
            continue
        size, stem = next(((n, stem) for n in (4, 3) if (stem := _axes(columns[i : i + n], n)) is not None), (1, None))
        taken = list(columns[i : i + size])
        whole = stem if stem is not None else split_unit(columns[i].name)[0]
        group = Group(re.sub(r"[\W_]*\d+$", "", whole), taken, size == 3, clock)
        last = groups[-1] if groups else None
        if last and group.name and re.search(r"\d+$", whole) and size != 4 and last.alike(group):
            last.columns += taken
        else:
            groups.append(group)
        i += size
    return groups


def _axes(columns: Sequence[Column], count: int) -> str | None:
    """What columns of x, y and z, or of a quaternion, have in common; None if they are none."""
    names = [split_unit(column.name)[0] for column in columns]
    found = [match for name in names if (match := re.fullmatch(r"(.*?)[\W_]*([xyzwXYZW])[\W_]*(\d*)", name))]
    if len(found) < count:
        return None
    stems = {match[1] + match[3] for match in found}
    axes = "".join(match[2].lower() for match in found)
    return stems.pop() if len(stems) == 1 and axes in ("xyz", "xyzw", "wxyz") else None


def _unit(column: Column) -> str | None:
    """The unit of a signal that its column says; [min] behind a name is the least one, and no minute."""
    unit = split_unit(column.name)[1]
    return (of_text(column.unit) if column.unit else None) or (unit if unit != "min" else None)


def _entry(group: Group, names: set[str]) -> list[str]:
    """The section of a signal or command, whose name is none of those that are taken."""
    first = group.columns[0]
    numbers = np.column_stack([column.numbers for column in group.columns])
    if group.beside:
        numbers = numbers[np.array(group.beside.texts) == min(group.beside.words)]
    section = "commands" if group.command else "signals"
    name = signal_name(group.name or split_unit(first.name)[0])
    while name in names:
        name += "_"
    names.add(name)
    lost = lost_number(numbers) if section == "signals" else None
    if lost:
        numbers = np.where(numbers == lost.number, np.nan, numbers)
    held = (np.diff(numbers, axis=0) == 0).all(axis=1)
    lines = [f"[{section}.{name}]{_range(numbers)}"]
    if section == "signals" and len(held) and _HELD < held.mean() < 1:
        lines.append(f"# {100 * held.mean():.0f} % of its samples repeat the one before: [commands.{name}]?")
    lines.append(f"columns = {toml([column.label for column in group.columns])}")
    if group.clock:
        unit, reason = unit_of_times(group.clock)
        lines.append(f"time = {toml(group.clock.label)}  # the clock before it")
        lines += [f'time_unit = "{unit}"  # {reason}'] if reason and reason != ROW else []
    if group.beside:
        lines += [f"names = {toml(sorted(group.beside.words))}", f"names_from = {toml(group.beside.label)}"]
    lines += _unit_lines(group, numbers)
    if group.points:
        lines += [f"shape = [{len(group.columns) // 3}, 3]"] if len(group.columns) > 3 else []
        lines.append('# frame = "world"  # if the axes are those of the robot')
    words = sorted({word for column in group.columns for word in column.words})
    texts: list[str | float] = [word for word in words if not any(map(str.isdigit, word))]
    odd = ", ".join(shown(word) for word in words if word not in texts and not is_grouped(word))[:100]
    about = "texts among its numbers" if texts else ""
    if lost:
        about = f"{lost.count} are exactly {lost.number:.10g}, far from those beside: missing?"
        texts = [lost.number, *texts]
    lines += [f"missing = {toml(texts[:20])}  # {about}"] if texts else []
    lines += [f"# not read: {odd}; are they numbers, or missing = [...]?"] if odd else []
    return lines


def _unit_lines(group: Group, numbers: np.ndarray) -> list[str]:
    """What a mapping says about the unit, and whether to unwrap."""
    first = group.columns[0]
    if (unit := _unit(first)) is not None:
        taken = bool(first.unit) and {of_text(column.unit) for column in group.columns} == {unit}
        lines = [f'# unit = "{unit}", from the row of units' if taken else f'unit = "{unit}"']
        wraps = seen_wraps(numbers, 2 * np.pi / si(unit)[1]) if si(unit)[0] == "rad" else 0
        wraps = 0 if wraps and part_of_turn(numbers, 2 * np.pi / si(unit)[1]) else wraps
    else:
        unit, wraps = _angle(numbers)
        found = in_brackets(first.name)
        said = first.unit or (found[1] if found and not found[1].isdecimal() else "")
        reason = (
            f"the file says {shown(said)}, which is unknown here: write scale" if said else "which? nothing says it"
        )
        lines = [f'unit = "{unit}"  # {"it seems to wrap; is it an angle?" if wraps else reason}']
    period = None
    if not wraps and unit in ("1", "rad", "deg", "rev") and not group.command:
        turn = 0.0 if unit == "1" else 2 * np.pi / si(unit)[1]
        period = (counter_period(numbers) if unit == "1" else None) or saw_period(numbers, turn)
    if period:
        turns = seen_wraps(numbers, period.counts)
        doubt = f"  #{period.doubt}" if period.doubt else ""
        lines.append(f"unwrap = true  # jumps of nearly {period.counts:.10g}: {turns}; a counter?")
        lines.append(f"period = {period.counts:.10g}{doubt}")
    if wraps and not group.command:
        lines.append(f"unwrap = true  # jumps of nearly a turn: {wraps}")
    return lines


def _angle(numbers: np.ndarray) -> tuple[str, int]:
    """ "deg" or "rad" and the jumps of numbers that wrap at a turn; "1" and none for others."""
    for unit in ("deg", "rad"):
        turn = 2 * np.pi / UNITS[unit][1]
        if (wraps := seen_wraps(numbers, turn)) and np.nanmax(numbers) - np.nanmin(numbers) > _NEARLY * turn:
            return unit, wraps
    return "1", 0


def _range(numbers: np.ndarray) -> str:
    finite = numbers[np.isfinite(numbers)]
    missing = int(np.isnan(numbers).any(axis=1).sum())
    ends = f"  # from {finite.min() + 0.0:.6g} to {finite.max() + 0.0:.6g}" if finite.size else "  # no numbers"
    return f"{ends}, {missing} of {len(numbers)} rows lack one" if missing else ends


def _text_column(column: Column) -> str:
    found = ", ".join(shown(word) for word, _ in column.words.most_common(5))[:100]
    use = "rows can be chosen by them (label, only), or numbers by names (names, names_from)"
    return f"# column {toml(column.label)} holds texts: {found}; {use}"
