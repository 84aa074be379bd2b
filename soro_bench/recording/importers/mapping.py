"""Which part of a foreign file is which command or signal: a TOML file, described in docs/reference/recordings.md."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from soro_bench.files import parsed_toml, shown
from soro_bench.recording.importers.clock import ORDERS, chosen, continued, of_day, overflowed
from soro_bench.recording.importers.source import Source, check_keys, positive, read_source, when_left
from soro_bench.recording.importers.units import si, split_unit, time_unit
from soro_bench.recording.importers.wraps import thousands, unwrapped
from soro_bench.recording.recording import MAX_SIGNALS, MAX_TEXT, NOTES, Recording, RecordingError, Signal, check_name
from soro_bench.recording.untrusted import named_errors, read_bytes

MAX_BYTES = 1_000_000
_ROUNDING = 1e-9  # s
_REGULAR = 1.5  # times the median interval, up to which others are regular too
_FEW = 10  # samples, of which nothing is asked
_PACE = 2.5e-5, 5.0  # s between samples of a robot
_SELDOM = 100.0  # s between its commands
_LATEST = 1e11  # s since 1970, or since a computer was started: 3000 years
_APART = 86_400.0  # s, between the beginnings of two signals: their clocks differ
_NEARLY = 0.1  # of a thousand, by which the ratio of two durations differs from it at most
_PAUSE, _INTERVALS = 1.0, 20  # a gap is longer than both, in s and in median intervals
NO_COMMAND = "# Nothing is called like a command; what moved the robot belongs in [commands.NAME], not [signals.NAME]."
_SECTIONS = ("format", "time", "commands", "signals", "parameters", "metadata")
_CLOCKS = ("column", "columns", "array", "source", "interval", "rate")  # one of them says when samples are
_COUNTED = ("interval", "rate")

T = TypeVar("T")
Numbers = TypeVar("Numbers", np.ndarray, np.number)  # one or many
Read = Callable[[Source], tuple[np.ndarray, ...]]


class Notes:
    """What an import has left out, mended or seen; the recording's metadata keep it."""

    def __init__(self) -> None:
        self._labels: dict[str, list[str]] = {}

    def add(self, label: str, text: str) -> None:
        """Note a text about a command, a signal or the file; nothing if the text is empty."""
        if text and label not in self._labels.setdefault(text, []):
            self._labels[text].append(label)

    def lines(self) -> list[str]:
        """A line for each text, after what it is about."""
        return [shown(f"{', '.join(filter(None, labels))}: {text}") for text, labels in self._labels.items()]


@dataclass(frozen=True)
class FileMapping:
    """A whole mapping file."""

    commands: dict[str, Source] = field(default_factory=dict)
    signals: dict[str, Source] = field(default_factory=dict)
    time: dict[str, Any] = field(default_factory=dict)
    format: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    notes: Notes = field(default_factory=Notes, compare=False)
    periods: list[float] = field(default_factory=list, compare=False)  # s, of clocks that have overflowed

    def to_seconds(self, unit: str | None = None) -> float:
        """What a number of a unit, or of [time] unit, is [s]."""
        name = unit if unit is not None else self.time.get("unit", "s")
        dimension, factor = si(name)
        if dimension != "s":
            raise RecordingError(f"[time] unit = {name!r} is no unit of time")
        return factor

    def check_unit_of_time(self, name: str, unit: str | None, key: str = "[time] unit") -> None:
        """Compare the unit in the name of a column of times with that of the mapping, and note where they differ.

        Raises:
            RecordingError: the mapping has no unit, and the name another one than s.
        """
        own = time_unit(name)
        if own is None or si(own) == si(unit or "s"):
            return
        if unit is None:
            raise RecordingError(
                f'the name {ascii(name)[:80]} says {own}; write {key} = "{own}", or "s" if the name is wrong'
            )
        self.notes.add(key, f"{unit!r}, and the name {ascii(name)[:80]} says {own}; which one is right?")

    def clock(self, numbers: np.ndarray, unit: str | None = None) -> np.ndarray:
        """(T,) times [s] from the numbers of a clock of that unit, or of [time] unit.

        A counter that overflows is unwrapped: by [time] period, or where the numbers show it.
        """
        if "period" in self.time:
            period = positive("[time] period", self.time["period"])
            if (span := np.ptp(numbers) if len(numbers) else 0.0) > period:
                raise RecordingError(f"[time] period = {period:g}, and its times span {span:g}; a clock that begins "
                                     "anew spans less: correct period, or leave it out")  # fmt: skip
            numbers, note = unwrapped(numbers, period), ""
        else:
            numbers, note = of_day(numbers) if self.to_seconds(unit) == 1.0 else (numbers, "")
            numbers, note, period = (numbers, note, 0.0) if note else overflowed(numbers)
            self.periods.extend([self.to_seconds(unit) * period] if period else [])
        self.notes.add("[time]", note)
        return self.to_seconds(unit) * numbers

    def continued(self, time: np.ndarray) -> np.ndarray:
        """(T,) times that go on where the clock was set back, if [time] order asks for it."""
        if self.time.get("order") != "continue":
            return time
        time, note = continued(time)
        self.notes.add("[time]", note)
        return time

    def counted(self, rows: int) -> np.ndarray:
        """(rows,) times [s] of a file without any, from [time] interval or rate."""
        if "rate" in self.time:
            return np.arange(rows) / positive("[time] rate", self.time["rate"])
        if "interval" not in self.time:
            raise RecordingError("no times: [time] says neither where they are nor an interval or rate of rows")
        return self.to_seconds() * positive("[time] interval", self.time["interval"]) * np.arange(rows)

    def recording(
        self, read: Read, file_name: str, most: int, unit_of: Callable[[Source], str] | None = None
    ) -> Recording:
        """The recording whose signals ``read(source)`` gives as (T,) times and (T, ...) numbers.

        Times are in s, or whole nanoseconds of type int64. A third array, (T,), says in which line of the file each
        sample is. Time is counted from the first sample of all, or from [time] begin after it; the metadata keep
        where that was, as "start_time" [s], and the notes. Signals of more than ``most`` bytes altogether are refused.

        Args:
            unit_of: the unit of a source that has none, from the file.
        """
        self._check_effects()
        found = {}
        for group, sources in (("commands", self.commands), ("signals", self.signals)):
            for name, source in sources.items():
                label = f"{group}.{name}"
                time, numbers, *rows = _named(label, read, source)
                most -= numbers.nbytes
                if most < 0:  # a small file may be asked for the same numbers again and again
                    raise RecordingError("the mapping asks for more numbers than the largest size of the file allows")
                if (infinite := np.isinf(numbers)).any():
                    self.notes.add(label, f"{infinite.sum()} infinite numbers are taken as missing")
                    numbers = np.where(infinite, np.nan, numbers)
                numbers = source.known(numbers)
                found[group, name] = _named(label, self._ordered, label, source, time, numbers, *rows)
        found = self._overflowed_before(found)
        begins = {".".join(key): float(seconds(time[0])) for key, (time, *_) in found.items() if len(time)}
        _check_clocks(begins)
        self.notes.add(*_thousandfold({".".join(key): time for key, (time, *_) in found.items() if len(time) > _FEW}))
        if min(begins.values(), default=0.0) > _LATEST:
            self.notes.add("[time]", f"begins at {min(begins.values()):.3g} s; is the unit of time right?")
        if len({time.dtype.kind for time, *_ in found.values()}) > 1:
            found = {key: (_nanoseconds(time), *others) for key, (time, *others) in found.items()}
        start = min((time[0] for time, *_ in found.values() if len(time)), default=np.int64(0))
        groups: dict[str, dict[str, Signal]] = {"commands": {}, "signals": {}}
        for group, name in list(found):
            samples = found.pop((group, name))  # so that their numbers are not kept twice
            source = getattr(self, group)[name]
            unit = unit_of(source) if unit_of and source.unit is None else None
            label = f"{group}.{name}"
            groups[group][name] = self._signal(label, source, unit, start, *samples)
        for name, command in groups["commands"].items():
            if self.commands[name].leaves is None:
                self.notes.add(f"commands.{name}", _short(command, [*groups["signals"].values()]))
        begin = self.time.get("begin", 0.0)
        about = {"source": shown(file_name[:200]), "start_time": repr(float(seconds(start) + begin))}
        if lines := self.notes.lines():
            about[NOTES] = "\n".join(lines)[:MAX_TEXT]
        return Recording(groups["commands"], groups["signals"], self.parameters, {**about, **self.metadata})

    def _overflowed_before(self, found: dict[tuple[str, str], tuple]) -> dict[tuple[str, str], tuple]:
        """Samples with times [s] of a clock that overflowed before the first of them, moved to those beside."""
        period = max(self.periods, default=0.0)
        ends = {key: (time[0], time[-1]) for key, (time, *_) in found.items() if len(time) and time.dtype.kind == "f"}
        last = max((end for _, end in ends.values()), default=0.0)
        first = min((begin for begin, end in ends.values() if end > last - period / 2), default=0.0)
        for key, (begin, end) in ends.items() if period else ():
            if end < first <= end + period and begin + period < last:
                found[key] = found[key][0] + period, *found[key][1:]
                self.notes.add(".".join(key), f"its clock overflowed before its first sample: {period:g} s are added")
        return found

    def _check_effects(self) -> None:
        """Refuse entries of [time] that would do nothing."""
        sources = [*self.commands.values(), *self.signals.values()]
        own = [source for source in sources if "time" in source.place]
        counted = [key for key in _COUNTED if key in self.time]
        if counted and len(own) == len(sources):
            self.notes.add(f"[time] {counted[0]}", "not used, as every command and signal has a time of its own")
        for key in ("unit", "units", "period", "order", "date") if counted and not own else ():
            if key in self.time and not (key == "unit" and "interval" in self.time):
                raise RecordingError(f"[time] {key} has no effect: {counted[0]} counts rows")

    def _ordered(self, label: str, source: Source, time: np.ndarray, numbers: np.ndarray, *rows: np.ndarray) -> tuple:
        """Shifted times, numbers and lines, in the order that [time] order asks for."""
        if not np.isfinite(time).all():
            raise RecordingError("time is not finite")
        time = self.continued(time)
        if (order := self.time.get("order", "refuse")) != "refuse":  # which looks at what is left after cutting
            kept, note = chosen(time, order)
            self.notes.add(label, note)
            time, numbers, rows = time[kept], numbers[kept], tuple(each[kept] for each in rows)
        if not source.leaves:  # which shifts by itself
            time = _shifted(time, source.shift)
        return time, numbers, *rows

    def _signal(
        self, label: str, source: Source, unit: str | None, start: Any, time: np.ndarray, numbers: np.ndarray,
        *rows: np.ndarray,
    ) -> Signal:  # fmt: skip
        """The signal, cut from [time] begin to until."""
        begin, until = self.time.get("begin", 0.0), self.time.get("until", math.inf)
        since = seconds(time - start) - begin
        kept = _between(since, until)
        if label.startswith("commands.") and not (_regular(since) and kept.size):
            kept = np.union1d(_in_force(since[: kept[-1] + 1] if kept.size else since), kept)
        if len(time) and not kept.size:
            raise RecordingError(f"{label} has nothing from [time] begin = {begin:g} to until = {until:g}")
        if len(kept) < len(time):
            time, numbers, since, rows = time[kept], numbers[kept], since[kept], tuple(each[kept] for each in rows)
        _named(label, chosen, time, "refuse", *rows)
        is_command = label.startswith("commands.")
        if not is_command:
            self.notes.add(label, source.lost(numbers))
        self.notes.add(label, thousands(numbers))
        self.notes.add(label, _named(label, source.note, numbers, unit, is_command))
        self.notes.add(label, _pace(since, _SELDOM if is_command else _PACE[1]))
        self.notes.add(label, _pause(since))
        found = _named(label, source.signal, np.maximum(since, 0.0), numbers, unit)
        if source.leaves is not None:
            self.notes.add(label, when_left(found))
        return found


def _between(since: np.ndarray, until: float) -> np.ndarray:
    """The rows from the first one not before zero to the first one not before ``until`` [s], whatever their order."""
    begun = np.flatnonzero(since > -_ROUNDING)
    if not begun.size:
        return begun
    ended = np.flatnonzero(since[begun[0] :] >= until - _ROUNDING)
    return np.arange(begun[0], begun[0] + ended[0] if ended.size else len(since))


def _pace(since: np.ndarray, most: float) -> str:
    """A question about the unit of times that robots do not have, or ""."""
    step = float(np.median(np.diff(since))) if len(since) > _FEW else 1.0
    return "" if _PACE[0] <= step <= most else f"a sample every {step:g} s; is the unit of time right?"


def _pause(since: np.ndarray) -> str:
    """Where nothing came for long in (T,) times [s], or ""."""
    steps = np.diff(since)
    if steps.size < 2 or not steps.max() > max(_PAUSE, _INTERVALS * float(np.median(steps))):
        return ""
    after = since[steps.argmax()] - since[0]
    return f"nothing came for {steps.max():.3g} s, {after:.3g} s after its first sample; [time] begin and until cut"


def _thousandfold(times: Mapping[str, np.ndarray]) -> tuple[str, str]:
    """What lasts a thousand or a million times as long as another one, and a question about it; or empty texts."""
    spans = {label: float(seconds(time[-1] - time[0])) for label, time in times.items()}
    short, long = (choose(spans, key=lambda label: spans[label], default="") for choose in (min, max))
    for factor in (1e3, 1e6):
        if short and abs(spans[long] - factor * spans[short]) < _NEARLY * factor * spans[short]:
            return long, f"it lasts {factor:g} times as long as {short}; are the units of both times right?"
    return "", ""


def _short(command: Signal, signals: Sequence[Signal]) -> str:
    """Where a command begins long before all signals, or they go on long before or after one at intervals, or ""."""
    time = command.time[np.isfinite(command.values).reshape(len(command.time), -1).all(axis=1)]
    signals = [each for each in signals if len(each.time)]
    if not len(time) or not signals:
        return ""
    begin, end = min(each.time[0] for each in signals), max(each.time[-1] for each in signals)
    if begin - time[0] > max(_PAUSE, end - begin):
        return f"begins {begin - time[0]:.3g} s before the first signal; [time] begin leaves that out"
    if not _regular(time):
        return ""
    least = max(_PAUSE, _INTERVALS * float(np.median(np.diff(time))))
    late, early = time[0] - begin, end - time[-1]
    found = [f"begins {late:.3g} s after the first signal"] * bool(late > least)
    found += [f"ends {early:.3g} s before the last signal, and is held"] * bool(early > least)
    return " and ".join(found) + "; is it complete, and on the same clock?" if found else ""


def _check_clocks(begins: Mapping[str, float]) -> None:
    """Refuse commands and signals whose first samples [s] cannot be of one clock."""
    first, last = (choose(begins, key=lambda label: begins[label], default="") for choose in (min, max))
    if begins and begins[last] - begins[first] > _APART:
        raise RecordingError(
            f"{last} begins {begins[last] - begins[first]:.4g} s after {first}: their clocks differ; take the same "
            'clock for all, such as [time] source = "log_time" in a bag, or write shift = ... [s] at one'
        )


def _regular(since: np.ndarray) -> bool:
    """Whether a command comes at intervals; others come where they change."""
    intervals = np.diff(since)
    return len(intervals) > 0 and intervals.max() < _REGULAR * np.median(intervals)


def _in_force(since: np.ndarray) -> np.ndarray:
    """The row of the last command until the beginning, at zero, if there is one."""
    return np.flatnonzero(since < _ROUNDING)[-1:]


def seconds(time: Numbers) -> Numbers:
    """Times [s] as they are, or from whole nanoseconds, whose differences have to be taken before."""
    return time * 1e-9 if np.asarray(time).dtype.kind == "i" else time


def _nanoseconds(time: np.ndarray) -> np.ndarray:
    return time if time.dtype.kind == "i" else np.rint(1e9 * time).astype(np.int64)


def load_mapping(
    mapping: str | Path | Mapping,
    place_keys: tuple[str, ...],
    time_keys: tuple[str, ...] = (),
    format_keys: tuple[str, ...] = (),
    unit_optional: bool = False,
) -> FileMapping:
    """Read a mapping file.

    Args:
        mapping: the file, or what one says.
        place_keys, time_keys, format_keys: what the importer knows in a command or signal, in [time] and in [format].
        unit_optional: whether the file may say the unit.

    Raises:
        RecordingError: names what is wrong and what is allowed.
    """
    label = "the mapping" if isinstance(mapping, Mapping) else mapping
    with named_errors(label):
        table = dict(mapping) if isinstance(mapping, Mapping) else parsed_toml(in_utf8(read_bytes(mapping, MAX_BYTES)))
        check_keys("the mapping", table, _SECTIONS)
        for section in table:
            if not isinstance(table[section], dict):
                raise RecordingError(f"{section} has to be a section, [{section}]")
        check_keys("[format]", table.get("format", {}), format_keys)
        if (count := sum(len(table.get(group, {})) for group in ("commands", "signals"))) > MAX_SIGNALS:
            raise RecordingError(f"it has {count} commands and signals; expected at most {MAX_SIGNALS}")
        for group in ("commands", "signals"):
            table[group] = {
                check_name(name): _named(f"{group}.{name}", read_source, entry, place_keys, unit_optional)
                for name, entry in table.get(group, {}).items()
            }
        if wrong := [name for name, source in table["signals"].items() if source.leaves is not None]:
            raise RecordingError(f"signals.{wrong[0]}: leaves makes a command; write [commands.{wrong[0]}]")
        if not table["commands"] and not table["signals"]:
            raise RecordingError("the mapping has neither [commands.<name>] nor [signals.<name>]")
        _check_time(table.get("time", {}), time_keys)
        # numbers are as good as texts there
        table["metadata"] = {
            k: v if type(v) not in (int, float) else repr(v) for k, v in table.get("metadata", {}).items()
        }
        return FileMapping(**table)


def in_utf8(data: bytes) -> str:
    """The text of a file, without the mark that Windows puts before UTF-8; RecordingError for another encoding."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(f"is no text in UTF-8 (line {line}); save it as UTF-8") from error


def unit_doubt(source: Source, names: Sequence[str]) -> str:
    """What to say where the name of a column has another unit than the mapping, which scales nothing; or ""."""
    said = si(source.unit) if source.unit and (np.abs(source.scale) == 1).all() else None
    for name in names if said else ():
        own = split_unit(name)[1]
        if said and own and si(own)[0] == said[0] and si(own) != said:
            return f"unit = {source.unit!r}, and the name {ascii(name)[:80]} says {own}; which one is right?"
    return ""


def _check_time(time: Mapping, time_keys: tuple[str, ...]) -> None:
    """Refuse entries of [time] that are wrong or contradict each other."""
    check_keys("[time]", time, (*time_keys, "begin", "until", "order"))
    clocks = [key for key in _CLOCKS if key in time]
    if len(clocks) > 1:
        raise RecordingError(f"[time] says both {clocks[0]} and {clocks[1]}; keep the one that is right")
    for key in ("begin", "until", *_COUNTED, "period"):
        if key in time:
            positive(f"[time] {key}", time[key])
    if "order" in time and time["order"] not in ORDERS:
        raise RecordingError(f"[time] order = {ascii(time['order'])[:80]}; expected one of {', '.join(ORDERS)}")


def texts(label: str, values: object) -> list[str]:
    """Return a non-empty list of texts, each once; raise RecordingError for anything else."""
    if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected a list of texts")
    if len(set(values)) < len(values):
        raise RecordingError(f"{label} is {ascii(values)[:80]}; expected each once")
    return values


def typed(label: str, table: Mapping[str, Any], key: str, default: T) -> T:
    """``table[key]`` of the type of the default; RecordingError for another type."""
    value = table.get(key, default)
    if type(value) is not type(default):
        raise RecordingError(f"{label} {key} = {ascii(value)[:80]}; expected something like {default!r}")
    return value


def _shifted(time: np.ndarray, shift: float) -> np.ndarray:
    """Times [s], or whole nanoseconds, some seconds later."""
    return time + (round(1e9 * shift) if np.asarray(time).dtype.kind == "i" else shift)


def _named(label: str, function: Callable[..., T], *arguments: Any) -> T:
    try:
        return function(*arguments)
    except RecordingError as error:
        raise RecordingError(f"{label}: {error}") from error
