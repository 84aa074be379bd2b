"""Which columns of a table seem to be its times, and what a mapping says about them."""

import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from soro_bench.files import shown, toml
from soro_bench.recording.importers.clock import DATE_ORDERS, of_day, over_midnight, overflowed
from soro_bench.recording.importers.guess_layout import Column
from soro_bench.recording.importers.units import (
    EPOCH,
    UNITS,
    in_brackets,
    of_text,
    origin,
    si,
    split_unit,
    time_unit,
)

_TIME = re.compile(r"(.*[^a-z])?(t|time|timestamp|stamp|zeit|secs?|seconds?|millis|micros|clock|ms|us|ns)([^a-z].*)?")
_COUNT = re.compile(r"(.*[^a-z])?(frame|index|idx|row|sample|nr|no|count|n|#)s?([^a-z].*)?")
_ABROAD = re.compile(
    r"zeit|temps|tiempo|tempo|elapsed|time$|^x_value$|\u6642\u9593|\u6642\u523b"
)  # that goes on evenly
_STEPS = ("s", 1e-5, 2.0), ("ms", 2.0, 2e3), ("us", 2e3, 2e5), ("ns", 2e5, 1e12)  # the step that each unit has
_MORNING, _SLOW, _FAST = 0.01, 5e-5, 1e-6  # of a day: when logs begin; steps of times of day, and of elapsed ones
_ON, _BACK = 0.01, 0.05  # of the steps of a clock go on at least, and back at most
_COUNTED = {  # what lines above a table call the rate and the interval of its rows
    "rate": re.compile(r"(^\W*|sampl\w*[ _-]?|frame[ _-]?|scan[ _-]?|abtast)(rate|freq[a-z]*)(?![a-z])|\bfs\b", re.I),
    "interval": re.compile(r"(delta[ _]?|\bd)[tx](?![a-z])|sampl\w*[ _-]?(interval|period)", re.I),
}
_AMOUNT = re.compile(r"\d+(?:[.,]\d+)?(?:e[+-]?\d+)?", re.I)
_THOUSANDS = re.compile(r"[1-9]\d{0,2},\d{3}")  # or three decimals
_SCALES = {"khz": 1e3, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6}
_HALF = 0.5  # of the stamps are as the one before
_SLASHED = re.compile(r"(\d{1,2})[/-](\d{1,2})[/-]\d{4}")  # a date of which either number may be the day
_MONTHS = 12
_ZONE = "  # dates and times; without a zone they are taken for UTC"
_PARTS = {  # of a time of day, each in a column of its own: their names, and where they begin again
    "h": (("h", "hr", "hrs", "hour", "hours", "hh", "std", "stunde", "stunden"), 24.0),
    "min": (("m", "min", "mins", "minute", "minutes", "mm", "minuten"), 60.0),
    "s": (("s", "sec", "secs", "second", "seconds", "ss", "sekunde", "sekunden"), 60.0),
    "ms": (("ms", "msec", "millis", "millisecond", "milliseconds"), 1e3),
    "us": (("us", "\u00b5s", "usec", "micros", "microsecond", "microseconds"), 1e6),
}
_LEAST = "min", "s"  # of such parts
_CLOCKLIKE = re.compile(r"\d{1,2}:\d\d|\d{8}\D\d{6}")  # in texts that may be times
ROW = "row of units"  # says the unit


def time_section(columns: Sequence[Column], above: Sequence[str]) -> tuple[list[Column], list[Column], list[str]]:
    """The columns of time, those of other clocks, and the section [time], for which the lines above may say a rate."""
    found = [column for column in columns if column.numeric and _goes_on(column)]
    named = [column for column in found if _called_time(column.name)]
    named = named or [column for column in found if _says_time(column)][:1]
    for i, (column, after) in enumerate(zip(columns, [*columns[1:], None], strict=True)):
        if (units := _parts_of_day(columns[i:])) and all(each in columns[i : i + len(units)] for each in named):
            parts = list(columns[i : i + len(units)])
            return parts, [], ["[time]", f"columns = {toml([part.label for part in parts])}", f"units = {toml(units)}"]
        if column.stamped and not (named and _repeats(column)):
            return [column], [], [*_section(column, _ZONE), *_date_order(column)]
        if after is None:
            continue
        labels = f"columns = {toml([column.label, after.label])}"
        if column.dated and after.stamped:
            return [column, after], [], ["[time]", f"{labels}  # a date, and a time", *_date_order(column)]
        if part := _part_of_seconds(column, after):
            return [column, after], [], ["[time]", labels, f'units = ["s", "{part}"]']
    named = named or [column for column in found if _origin(column)][:1]
    steady = [column for column in found if not _COUNT.fullmatch(column.name.lower()) and _is_clock(column)]
    nameless = [column for column in steady if not any(letter.isalpha() for letter in column.name)]
    nameless.sort(key=_counts_rows)
    counted = _counted(above)
    if not (candidates := named or nameless) and (like := next(filter(_like_times, columns), None)):
        text = shown(next(iter(like.words), like.texts[0]))[:40]
        return [], [], ["[time]", f"# column {toml(like.label)} may be the time, but {text} cannot be read as one, or "
                        "repeats: correct it, or write rate = ...  # Hz", *counted]  # fmt: skip
    if not candidates:
        ask = ["# rate = ...  # Hz: no column is called time; write how many rows there are in a second"]
        other = [f"# column = {toml(column.label)}  # increases steadily: is this the time?" for column in steady[:3]]
        return [], [], ["[time]", *(counted or ask), *other]
    column, *others = candidates if named else candidates[:1]
    unit, reason = unit_of_times(column)
    lines = _section(column, "" if named else "  # the numbers increase steadily; is this the time?")
    if reason != ROW and (unit != "s" or column.unit):
        lines.append(f'unit = "{unit}"  # {reason}')
    return [column], others, lines


def _repeats(column: Column) -> bool:
    """Whether most stamps of a column are as the one before, as those without parts of seconds are."""
    same = [text == before for before, text in pairwise(column.texts)]
    return sum(same) > _HALF * len(same)


def _date_order(column: Column) -> list[str]:
    """The entry date of dates such as 28/11/2025, if one of them says which number is the day; else none."""
    found = [match.groups() for text in column.texts if (match := _SLASHED.match(text))]
    is_day = np.any(np.array(found, int).reshape(-1, 2) > _MONTHS, axis=0)
    return [f"date = {toml(DATE_ORDERS[int(is_day[1])])}"] if is_day.sum() == 1 else []


def _counted(above: Sequence[str]) -> list[str]:
    """The entry rate [Hz] or interval [s] that the lines above a table say; none where there are several numbers."""
    found = {}
    for line in above:
        for key, pattern in _COUNTED.items():
            rest = line[said.end() :].lower() if (said := pattern.search(line)) else ""
            amounts = set(_AMOUNT.findall(rest))
            if len(amounts) == 1 and not _THOUSANDS.fullmatch(amount := amounts.pop()):
                scale = next((_SCALES[word] for word in re.findall(r"[a-z\u00b5]+", rest) if word in _SCALES), 1.0)
                found[key, scale * float(amount.replace(",", "."))] = shown(line.strip())[:60]
    entries = [f"{key} = {number:g}  # the file says: {line}" for (key, number), line in found.items() if number > 0]
    return entries if len(entries) == 1 else []


def _section(column: Column, comment: str) -> list[str]:
    return ["[time]", f"column = {toml(column.label)}{comment}"]


def _parts_of_day(columns: Sequence[Column]) -> list[str]:
    """The units of the first columns if they are hours, minutes, seconds and parts of these, or from minutes on."""
    units: list[str] = []
    for column, unit in zip(columns, list(_PARTS)[0 if columns and _is_part(columns[0], "h") else 1 :], strict=False):
        if not _is_part(column, unit):
            break
        units.append(unit)
    if not set(_LEAST) <= set(units):
        return []
    steps = np.diff(_total(columns[: len(units)], units))
    return units if (steps > 0).any() and (steps < 0).mean() < _BACK else []


def _is_part(column: Column, unit: str) -> bool:
    """Whether a column is called like a part of a time of day, and has such numbers."""
    names, most = _PARTS[unit]
    known = column.numbers[np.isfinite(column.numbers)]
    called = any(word in names for word in re.findall(r"[a-z\u00b5]+", column.name.lower()))
    whole = unit == "s" or bool((known == np.rint(known)).all())
    return called and len(known) > 0 and whole and known.min() >= 0 and known.max() < most


def _total(columns: Sequence[Column], units: Sequence[str]) -> np.ndarray:
    """(T,) times [s] in several columns."""
    known = np.all([np.isfinite(column.numbers) for column in columns], axis=0)
    return np.sum([UNITS[u][1] * c.numbers[known] for u, c in zip(units, columns, strict=True)], axis=0)


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


def _is_clock(column: Column) -> bool:
    """Whether numbers increase about evenly."""
    steps = np.diff(column.numbers[np.isfinite(column.numbers)])
    middle = np.median(steps)
    return bool(middle > 0 and (np.abs(steps - middle) < 0.5 * middle).mean() > 0.8)


def _counts_rows(column: Column) -> bool:
    """Whether numbers only say which row they are in, from 0 or 1."""
    return bool((column.numbers - column.numbers[0] == np.arange(len(column.numbers))).all())


def _step(column: Column) -> float:
    """The usual step of a clock."""
    steps = np.diff(column.numbers[np.isfinite(column.numbers)])
    return float(np.median(np.abs(steps[steps != 0])))


def _origin(column: Column) -> tuple[str, str] | None:
    """The unit of dates that are written as numbers, and what they count; None for other numbers."""
    return origin(float(column.numbers[np.isfinite(column.numbers)][0]), _step(column))


def unit_of_times(column: Column) -> tuple[str, str]:
    """The unit of a clock, and why."""
    row = of_text(column.unit) if column.unit else None
    own = time_unit(column.name)
    for said, reason in ((row, ROW), (own, "from its name")):
        if said and si(said)[0] == "s":
            return said, reason
    if found := _origin(column):
        return found[0], f"from its size: {found[1]}"
    numbers, step = column.numbers[np.isfinite(column.numbers)], _step(column)
    if numbers.max() < 1.0 and step < (_SLOW if numbers.min() > _MORNING else _FAST):
        return "d", "from its size: parts of a day, as in spreadsheets; is this right?"
    if (numbers == np.rint(numbers)).all():
        for unit, least, most in _STEPS:
            if least <= step < most:
                return unit, f"from its steps of {step:g}; is this right?"
    return "s", f"the file says {shown(column.unit)}, which is unknown here" if column.unit else ""


def order(*columns: Column) -> list[str]:
    """A comment on stamps that do not increase."""
    if not columns or not all(column.numeric for column in columns):
        return []
    units = _parts_of_day(columns) or ["s", *(_part_of_seconds(*columns) for _ in columns[1:])]
    time = of_day(_total(columns, units))[0]
    steps = np.diff(over_midnight(np.rint(1e9 * time).astype(np.int64)) if units[0] == "h" else overflowed(time)[0])
    same, back = int((steps == 0).sum()), int((steps < 0).sum())
    if not same + back:
        return []
    if back > len(steps) / 2:
        return ['order = "sort"  # the newest row is the first']
    choice = '"keep_first", "keep_last", "sort" or "continue"'
    return [f'# order = "keep_first"  # stamps that repeat: {same}, that go back: {back}; choose {choice}']
