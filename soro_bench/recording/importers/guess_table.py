"""A first mapping of a table of text, from its header and its numbers, for the user to correct."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from soro_bench.files import shown
from soro_bench.recording.importers.clock import overflowed
from soro_bench.recording.importers.guess_layout import Column, layout
from soro_bench.recording.importers.mapping import NO_COMMAND
from soro_bench.recording.importers.table_text import is_grouped
from soro_bench.recording.importers.tracks import signal_name
from soro_bench.recording.importers.units import (
    EPOCH,
    UNITS,
    in_brackets,
    of_text,
    si,
    since_1970,
    split_unit,
    time_unit,
)
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

_TIME = re.compile(r"(.*[^a-z])?(t|time|timestamp|stamp|zeit|secs?|seconds?|millis|micros|clock|ms|us|ns)([^a-z].*)?")
_COUNT = re.compile(r"(.*[^a-z])?(frame|index|idx|row|sample|nr|no|count|n|#)s?([^a-z].*)?")
_COMMAND = re.compile(
    r"(.*[^a-z])?(cmd|command|commanded|goal|target|desired|des|setpoint|sp|ref|reference|soll|sollwert|action|ctrl|"
    r"control|demand|pwm|duty|enable|enabled|u\d*|consigne|consigna|commande|comando|\u6307\u4ee4|\u76ee\u6a19)s?"
    r"([^a-z].*)?"
)
_ABROAD = re.compile(r"zeit|temps|tiempo|tempo|elapsed|^x_value$|\u6642\u9593|\u6642\u523b")  # of what goes on evenly
_STEPS = ("s", 1e-5, 2.0), ("ms", 2.0, 2e3), ("us", 2e3, 2e5), ("ns", 2e5, 1e12)  # the step that each unit has
_HELD = 0.8  # of the samples of a command are as the one before
_ON, _BACK = 0.01, 0.05  # of the steps of a clock go on at least, and back at most
_REPEATED, _NAMES = 0.7, 100  # of the stamps are others, where rows of several names share one; names at most
_NEARLY = 0.9  # of a turn, that an angle that wraps has seen
_ROW = "row of units"
_SEPARATORS = "has separators of thousands, which are not read: export the table without them"
_CLOCKLIKE = re.compile(r"\d{1,2}:\d\d|\d{8}\D\d{6}")  # in texts that may be times


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
        options, columns = layout(data)
        clock, others, lines = _time(columns)
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
        lines = [*lines, *([] if beside else _order(*clock))]
        sections = [[*head, *_format(options)], lines, *([about] if about else []), *entries]
        text = "\n\n".join("\n".join(section) for section in sections) + "\n"
        return text


def _format(options: dict) -> list[str]:
    if not options:
        return []
    return ["", "[format]", *(f"{key} = {toml(value)}" for key, value in options.items())]


def toml(value: object) -> str:
    """A text, number, truth value or list as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml, value))}]"
    if not isinstance(value, str):
        return repr(value)
    letters = ("\\t" if c == "\t" else c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
    return f'"{"".join(letters)}"'


def _time(columns: Sequence[Column]) -> tuple[list[Column], list[Column], list[str]]:
    """The columns of time, those of other clocks, and the section [time]."""
    for column, after in zip(columns, [*columns[1:], None], strict=True):
        if column.stamped:
            return [column], [], _section(column, "  # dates and times; without a zone they are taken for UTC")
        if after is None:
            continue
        labels = f"columns = {toml([column.label, after.label])}"
        if column.dated and after.stamped:
            return [column, after], [], ["[time]", f"{labels}  # a date, and a time"]
        if part := _part_of_seconds(column, after):
            return [column, after], [], ["[time]", labels, f'units = ["s", "{part}"]']
    found = [column for column in columns if column.numeric and _goes_on(column)]
    named = [column for column in found if _called_time(column.name)]
    named = named or [column for column in found if _says_time(column)][:1]
    steady = [column for column in found if not _COUNT.fullmatch(column.name.lower()) and _is_clock(column)]
    nameless = [column for column in steady if not any(letter.isalpha() for letter in column.name)]
    nameless.sort(key=_counts_rows)
    if not (candidates := named or nameless) and (like := next(filter(_like_times, columns), None)):
        text = shown(next(iter(like.words), like.texts[0]))[:40]
        return [], [], ["[time]", f"# column {toml(like.label)} may be the time, but {text} cannot be read as one, or "
                        "repeats: correct it, or write rate = ...  # Hz"]  # fmt: skip
    if not candidates:
        rate = "# rate = ...  # Hz: no column is called time; write how many rows there are in a second"
        other = [f"# column = {toml(column.label)}  # increases steadily: is this the time?" for column in steady[:3]]
        return [], [], ["[time]", rate, *other]
    column, *others = candidates if named else candidates[:1]
    unit, reason = _time_unit(column)
    lines = _section(column, "" if named else "  # the numbers increase steadily; is this the time?")
    if reason != _ROW and (unit != "s" or column.unit):
        lines.append(f'unit = "{unit}"  # {reason}')
    return [column], others, lines


def _section(column: Column, comment: str) -> list[str]:
    return ["[time]", f"column = {toml(column.label)}{comment}"]


def _part_of_seconds(first: Column, second: Column) -> str:
    """The unit of a column that goes on within the whole seconds of the one before it: ms, us or ns; else ""."""
    if (split_unit(first.name)[1] or "s") != "s" or _COUNT.fullmatch(second.name.lower()):
        return ""
    a, b = (column.numbers[np.isfinite(column.numbers)] for column in (first, second))
    if not len(a) or len(a) != len(b) or (a != np.rint(a)).any() or (b != np.rint(b)).any():
        return ""
    if b.min() < 0 or np.abs(np.diff(a)).max(initial=0.0) > 1e4:
        return ""
    (whole, _), (part, unit) = map(_time_name, (first.name, second.name))
    if unit in ("ms", "us") and part in ("", whole) and _called_time(first.name):
        scale = UNITS[unit][1]
        back = np.diff(a + scale * b) < 0
        return unit if b.max() * scale < 1 and b.min() < b.max() and back.mean() < _BACK else ""
    named = re.search("nsec|nano", second.name.lower()) is not None
    return "ns" if b.max() < 1e9 and (named or (EPOCH[0] < a[0] < EPOCH[1] and b.max() > 1e6)) else ""


def _called_time(name: str) -> bool:
    """Whether a name without its unit is one of times, or with one behind another mark than _, as in "elapsed ms"."""
    stem, unit = split_unit(name)
    whole = unit is not None and f"{stem}_{unit}" != name and in_brackets(name) is None
    return any(_TIME.fullmatch(text.lower()) for text in ([stem, name] if whole else [stem]))


def _says_time(column: Column) -> bool:
    """Whether the unit of a column is one of times, or its name one in another language."""
    unit = (of_text(column.unit) if column.unit.strip() else None) or time_unit(column.name)
    if unit and si(unit)[0] == "s":
        return True
    return _ABROAD.search(column.name.lower()) is not None and _is_clock(column)


def _time_name(name: str) -> tuple[str, str | None]:
    """A name of times without its unit, and the unit: of "usec", "tv_usec" or "time_us"."""
    stem, unit = split_unit(name)
    if unit is None:
        stem, _, last = name.rpartition(max("_. ", key=name.rfind))
        unit = of_text(last)
    return (stem if unit else name).lower(), unit


def _goes_on(column: Column) -> bool:
    """Whether numbers increase but for some, or stay for some rows each time; those of a column called time may
    decrease, where the newest row is the first."""
    steps = np.diff(column.numbers[np.isfinite(column.numbers)])
    called = _called_time(column.name)
    if called and len(steps) > 0 and (steps < 0).mean() > 1.0 - _BACK:
        return True
    return len(steps) > 0 and (steps > 0).mean() > (_ON if called else 0.5) and (steps < 0).mean() < _BACK


def _like_times(column: Column) -> bool:
    """Whether a column seems to hold times that an import cannot use."""
    if not column.numeric:
        said = next(iter(column.words), "")
        return _CLOCKLIKE.search(said) is not None or (_called_time(column.name) and said[:1].isdigit())
    steps = np.diff(column.numbers[np.isfinite(column.numbers)])
    return _called_time(column.name) and len(steps) > 0 and bool((steps >= 0).all())


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


def _is_clock(column: Column) -> bool:
    """Whether numbers increase about evenly."""
    steps = np.diff(column.numbers[np.isfinite(column.numbers)])
    middle = np.median(steps)
    return bool(middle > 0 and (np.abs(steps - middle) < 0.5 * middle).mean() > 0.8)


def _counts_rows(column: Column) -> bool:
    """Whether numbers only say which row they are in, from 0 or 1."""
    return bool((column.numbers - column.numbers[0] == np.arange(len(column.numbers))).all())


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


def _time_unit(column: Column) -> tuple[str, str]:
    """The unit of a clock, and why."""
    row = of_text(column.unit) if column.unit else None
    own = time_unit(column.name)
    for said, reason in ((row, _ROW), (own, "from its name")):
        if said and si(said)[0] == "s":
            return said, reason
    numbers = column.numbers[np.isfinite(column.numbers)]
    steps = np.diff(numbers)
    step = float(np.median(np.abs(steps[steps != 0])))
    if epoch := since_1970(float(numbers[0]), step):
        return epoch, "from its size: a time since 1970"
    if (numbers == np.rint(numbers)).all():
        for unit, least, most in _STEPS:
            if least <= step < most:
                return unit, f"from its steps of {step:g}; is this right?"
    return "s", f"the file says {shown(column.unit)}, which is unknown here" if column.unit else ""


def _order(*columns: Column) -> list[str]:
    """A comment on stamps that do not increase."""
    if not columns or not all(column.numeric for column in columns):
        return []
    known = np.all([np.isfinite(column.numbers) for column in columns], axis=0)
    scales = (1.0, *(UNITS[_part_of_seconds(*columns)][1] for _ in columns[1:]))
    time = sum(scale * column.numbers[known] for scale, column in zip(scales, columns, strict=True))
    steps = np.diff(overflowed(np.asarray(time))[0])
    same, back = int((steps == 0).sum()), int((steps < 0).sum())
    if not same + back:
        return []
    if back > len(steps) / 2:
        return ['order = "sort"  # the newest row is the first']
    choice = '"keep_first", "keep_last", "sort" or "continue"'
    return [f'# order = "keep_first"  # stamps that repeat: {same}, that go back: {back}; choose {choice}']


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
    return (of_text(column.unit) if column.unit else None) or split_unit(column.name)[1]


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
        unit, reason = _time_unit(group.clock)
        lines.append(f"time = {toml(group.clock.label)}  # the clock before it")
        lines += [f'time_unit = "{unit}"  # {reason}'] if reason and reason != _ROW else []
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
    ends = f"  # from {finite.min():.6g} to {finite.max():.6g}" if finite.size else "  # no numbers"
    return f"{ends}, {missing} of {len(numbers)} rows lack one" if missing else ends


def _text_column(column: Column) -> str:
    found = ", ".join(shown(word) for word, _ in column.words.most_common(5))[:100]
    use = "rows can be chosen by them (label, only), or numbers by names (names, names_from)"
    return f"# column {toml(column.label)} holds texts: {found}; {use}"
