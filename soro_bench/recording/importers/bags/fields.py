"""Numbers and times in messages: by a path, by the names that stand beside them, in every form of a stamp.

A message is what JSON makes of one: dicts, lists, texts and numbers. Binary messages (:mod:`.layout`) look alike,
with a :class:`Slot` in the place of every number, so that what is found in one message says where it is in others.
"""

import math
import re
import struct
from calendar import timegm
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Any, NamedTuple

from soro_bench.files import brief
from soro_bench.recording.importers.table_text import MISSING as NOTHING
from soro_bench.recording.importers.units import of_text
from soro_bench.recording.recording import MAX_SIZE, RecordingError

SECOND = 1_000_000_000  # ns
_STEP = re.compile(r"([^.\[\]]+)|\[(\d{1,6})\]|\[([^\[\]=]+)=([^\[\]]+)\]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_WHOLE_NUMBER = re.compile(r"[+-]?\d{1,20}")
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d{1,9})\d*)?\s*(Z|[+-]\d\d:?\d\d)?", re.IGNORECASE)
_NAMING = re.compile(r"(^|_)(names?|labels?|frame|frame_id|ids?)$", re.IGNORECASE)  # of lists and of what is in them
_NAME = re.compile(r"(^|_)(name|label|frame|frame_id)$", re.IGNORECASE)  # an id that stands alone may be a counter
_WHOLE, _PART = ("sec", "secs", "seconds", "s"), ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds", "ns")
_LATEST = 2**62  # ns, beyond which differences overflow
_SHOWN = 200  # letters of a list of names in a message


class AbsentError(RecordingError):
    """A message has no such field."""


MISSING = object()  # a value that a message says nothing about


class Slot(NamedTuple):
    """A number in a binary message."""

    offset: int  # bytes
    code: str  # of struct
    value: int | float | bool


class Text(str):
    """A text in a binary message, which begins at ``offset`` and has ``size`` bytes."""

    offset: int
    size: int

    def __new__(cls, value: str, offset: int, size: int) -> "Text":
        self = super().__new__(cls, value)
        self.offset, self.size = offset, size
        return self


class Run(Sequence):
    """Numbers of one type that lie one after the other in a message."""

    def __init__(self, data: bytes, order: str, offset: int, code: str, count: int) -> None:
        self._data, self._order, self._offset, self.code, self._count = data, order, offset, code, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: Any) -> Slot:
        if not 0 <= i < self._count:
            raise IndexError(i)
        offset = self._offset + i * struct.calcsize("=" + self.code)
        return Slot(offset, self.code, struct.unpack_from(self._order + self.code, self._data, offset)[0])


@dataclass(frozen=True)
class Named:
    """A step to the entries that have these names, by a list of names beside them or by a member of their own."""

    names: tuple[str, ...]
    key: str = ""  # where the names are; "": what looks like it
    is_list: bool = False  # whether the entries of all names are meant, or that of the only one

    def __str__(self) -> str:
        names = ", ".join(self.names)
        return f"[{self.key}={names}]" if self.key else f"[{names}]"


Step = str | int | Named


@dataclass
class Seen:
    """What was looked at to find the numbers of a sample."""

    labels: list[str] = field(default_factory=list)  # that stand beside values chosen by their place
    names: list[str] = field(default_factory=list)  # among which one was looked for
    compared: list[Text | Slot] = field(default_factory=list)  # what other messages of the same layout have to say too

    def label(self, value: Any) -> str:
        """A name as text."""
        if type(value) is str:
            return value
        if isinstance(value, (Text, Slot)):
            self.compared.append(value)
        return str(value.value if isinstance(value, Slot) else value)


def parse_path(text: str) -> tuple[Step, ...]:
    """Keys, indices and names of a path such as "pose.position[2]" or "transforms[child_frame_id=tool].x"."""
    if not text or _STEP.sub("", text).strip("."):
        raise RecordingError(f"field {ascii(text)[:80]} is no path such as pose.position[2] or position[name=elbow]")
    found = _STEP.findall(text)
    return tuple(key or (Named((name,), where) if where else int(index)) for key, index, where, name in found)


def shown_path(path: Iterable[Step]) -> str:
    """A path as a mapping has it, cut to a sensible length."""
    texts = [f"[{step}]" if isinstance(step, int) else step if isinstance(step, Named) else f".{step}" for step in path]
    return ascii("".join(map(str, texts)).removeprefix("."))[1:-1][:80]


def follow(content: Any, path: Sequence[Step], seen: Seen) -> Any:
    """What is at a path; MISSING if nothing has the name that it asks for. RecordingError if there is no such field."""
    above: list[Any] = []
    node = content
    for step in path:
        if isinstance(step, Named):
            found = _named(node, above, step, path, seen)
            if step.is_list or found[0] is MISSING:
                return found if step.is_list else MISSING
            node = found[0]
            continue
        if isinstance(step, int) and is_list(node) and step < len(node):
            seen.labels += _labels_of_entry(node, step, above, seen)
        elif isinstance(node, dict):
            above.append(node)
        try:
            node = node[step]
        except (KeyError, IndexError, TypeError) as error:
            raise AbsentError(f"a message has no field {shown_path(path)}{_hint(node, step)}") from error
    if is_list(node):
        seen.labels += [seen.label(name) for names in _beside(node, above).values() for name in names]
    seen.labels += [
        seen.label(value) for each in above for key, value in each.items() if isinstance(value, str) and _is_name(key)
    ]
    return node


def names_beside(content: Any, path: Sequence[Step]) -> list[str]:
    """The names that stand beside the list at a path; none if there are none."""
    seen = Seen()
    node = follow(content, path, seen)
    return seen.labels[: len(node)] if is_list(node) and len(seen.labels) >= len(node) else []


def entry_names(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """How a path chooses each entry of a list by its name, such as "child_frame_id=tool"; none if it cannot."""
    keys = _members(entries[0])
    key = next(iter(keys), "")
    names = [str(entry.get(key)) for entry in entries]
    fit = len(keys) == 1 and len(set(names)) == len(names) and all(_STEP.fullmatch(f"[{key}={name}]") for name in names)
    return [f"{key}={name}" for name in names] if fit and isinstance(keys[key], str) else []


def flatten(node: Any, leaves: list[Any]) -> None:
    """Append the numbers, or what stands for them, of a number or of nested lists."""
    if is_list(node):
        for entry in node:
            if isinstance(entry, (float, Slot)):
                leaves.append(entry)
            else:
                flatten(entry, leaves)
    elif isinstance(node, dict):
        raise RecordingError(f"a field holds {listed(node)}: name one of these in its path")
    else:
        leaves.append(node)
    if len(leaves) > MAX_SIZE:
        raise RecordingError(f"a sample has more than {MAX_SIZE} numbers")


def number(leaf: Any) -> float:
    """A number of a JSON message; null, "NaN" and what tables take for missing are missing ones."""
    if isinstance(leaf, (int, float)):
        return float(leaf)
    if leaf is None or leaf is MISSING:
        return math.nan
    if isinstance(leaf, str) and _NUMBER.fullmatch(leaf.strip()):
        return float(leaf)
    if isinstance(leaf, str) and leaf.strip().lower() in NOTHING:
        return math.nan
    raise RecordingError(f"{ascii(leaf)[:80]} is no number")


def is_list(node: Any) -> bool:
    """Whether it is a list of a message."""
    return isinstance(node, (list, Run))


def stamp_parts(node: Any, topic: str) -> tuple[Any, ...]:
    """Seconds and nanoseconds, or one number or text, of the field that holds a time."""
    if not isinstance(node, dict):
        return (node,)
    whole = [key for key in _WHOLE if key in node]
    if not whole:
        raise RecordingError(
            f"topic {topic}: time holds {listed(node)}: name the field of sec and nanosec, or a number"
        )
    if parts := [key for key in node if of_text(key) in ("us", "ms")]:
        hint = 'write another time, such as "log_time"'
        raise RecordingError(f"topic {topic}: time holds {listed(node)}, and {parts[0]} is not read; {hint}")
    return node[whole[0]], next((node[key] for key in _PART if key in node), 0)


def nanoseconds(parts: Sequence[Any], to_seconds: float, topic: str) -> int:
    """The time [ns] of the parts of a stamp; one number is in a unit of so many seconds."""
    try:
        found = _pair(*parts) if len(parts) == 2 else _single(parts[0], to_seconds)
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"topic {topic}: time {ascii(parts[0])[:80]} {error}") from error
    if not abs(found) < _LATEST:
        raise RecordingError(f"topic {topic}: time {found} ns is out of range; is [time] unit right?")
    return found


def _pair(whole: Any, part: Any) -> int:
    """[ns] of seconds and nanoseconds; ValueError if they are no whole numbers."""
    if type(whole) is int and type(part) is int:
        return SECOND * whole + part
    numbers = (int(each) if isinstance(each, float) and each.is_integer() else each for each in (whole, part))
    texts = [each.strip() if isinstance(each, str) else str(each) for each in numbers]
    if not all(_WHOLE_NUMBER.fullmatch(text) for text in texts):
        raise ValueError(f"and {brief(part)} are not in whole numbers")
    return SECOND * int(texts[0]) + int(texts[1])


def _single(stamp: Any, to_seconds: float) -> int:
    """[ns] of a number or text; ValueError for anything else."""
    if isinstance(stamp, bytes):
        stamp = stamp.rstrip(b"\0").decode()
    if isinstance(stamp, str) and (date := _DATE.fullmatch(stamp.strip())):
        day, clock, fraction, zone = date.groups()
        text = f"{day}T{clock}{(zone or '').upper().replace('Z', '+00:00')}"
        return SECOND * timegm(datetime.fromisoformat(text).utctimetuple()) + int((fraction or "0").ljust(9, "0"))
    if isinstance(stamp, str) and _NUMBER.fullmatch(stamp.strip()):
        stamp = int(stamp) if _WHOLE_NUMBER.fullmatch(stamp.strip()) else float(stamp)
    if isinstance(stamp, bool) or not isinstance(stamp, (int, float)):
        raise ValueError("is no number, no stamp (sec, nanosec) and no text such as 2024-06-26T19:55:53.123Z")
    factor = SECOND * to_seconds
    if isinstance(stamp, int) and factor >= 1 and float(factor).is_integer():
        return int(factor) * stamp  # to the last digit
    return round(factor * stamp)


def _named(node: Any, above: list[Any], step: Named, path: Sequence[Step], seen: Seen) -> list[Any]:
    """The entries of a list that have the names, or the value beside which one stands; MISSING where it is not."""
    if not is_list(node):
        names = _names_alone(above, step.key, path, seen)
        return [node if name in names else MISSING for name in step.names]
    if not len(node):
        return [MISSING for _ in step.names]
    own = _members(node[0]) if isinstance(node[0], dict) else {}
    if step.key in own or (own and not step.key):
        key = step.key or _only(own, path)
        names = [seen.label(entry.get(key)) for entry in node]
    else:
        beside = _beside(node, above, step.key)
        if not beside and (count := max((len(v) for each in above for v in each.values() if _is_names(v)), default=0)):
            raise AbsentError(f"{shown_path(path)}: {len(node)} values stand beside {count} names")
        names = [seen.label(name) for name in beside[_only(beside, path)]]
    seen.names += names
    places = dict(zip(names, range(len(node)), strict=False))
    if len(set(names)) < len(names) and (twice := [name for name in step.names if names.count(name) > 1]):
        raise RecordingError(f"{brief(twice[0])} stands {names.count(twice[0])} times in the names {listed(names)}")
    return [node[places[name]] if name in places else MISSING for name in step.names]


def _names_alone(above: list[Any], key: str, path: Sequence[Step], seen: Seen) -> list[str]:
    """The names that stand beside a single value: the nearest."""
    for each in reversed(above):
        keys = [key] if key else [k for k, v in each.items() if isinstance(v, str) and _is_name(k)]
        if found := [seen.label(each[k]) for k in keys if k in each and not is_list(each[k])]:
            seen.names += found
            return found
    raise RecordingError(f"no name stands beside {shown_path(path)}")


@lru_cache(1000)
def _is_name(key: str) -> bool:
    """Whether what a message calls so is a name."""
    return bool(_NAME.search(key))


def _only(found: Mapping[str, Any], path: Sequence[Step]) -> str:
    """The one key of names; RecordingError if there is none, or several."""
    if len(found) == 1:
        return next(iter(found))
    if found:
        raise RecordingError(f"names of {shown_path(path)} stand in {listed(found)}: say which with names_from")
    raise AbsentError(f"no list of as many names stands beside {shown_path(path)}")


def _beside(node: Any, above: list[Any], key: str = "") -> dict[str, Any]:
    """Lists of names for the entries of a list, by key: the nearest ones."""
    for each in reversed(above):
        if key:
            found = {key: each[key]} if is_list(each.get(key)) else {}
        else:
            found = {k: v for k, v in each.items() if v is not node and _is_names(v) and len(v) == len(node)}
            found = {k: v for k, v in found.items() if _NAMING.search(k)} or found
        if found:
            return found
    return {}


def _is_names(value: Any) -> bool:
    return is_list(value) and len(value) > 0 and all(isinstance(entry, str) for entry in value)


def _members(entry: Mapping[str, Any]) -> dict[str, Any]:
    """What may name an entry of a list: texts, or numbers if there are none."""
    found = {k: v for k, v in entry.items() if _NAMING.search(k) and not is_list(v) and not isinstance(v, dict)}
    return {k: v for k, v in found.items() if isinstance(v, str)} or found


def _labels_of_entry(node: Any, i: int, above: list[Any], seen: Seen) -> list[str]:
    """The names of an entry that is chosen by its place."""
    own = [seen.label(value) for value in _members(node[i]).values()] if isinstance(node[i], dict) else []
    return own + [seen.label(names[i]) for names in _beside(node, above).values()]


def _hint(node: Any, step: Step) -> str:
    if isinstance(node, dict):
        return f"; there {'are' if len(node) > 1 else 'is'} {listed(node)}" if node else ""
    if is_list(node) and isinstance(step, int):
        return f"; there are {len(node)} entries"
    return ""


def listed(names: Iterable[str]) -> str:
    """Names for a message, cut to a sensible length."""

    def parts() -> Iterator[str]:
        left = _SHOWN
        for name in names:
            text = ascii(name)[1:-1]
            if (left := left - len(text) - 2) < 0:
                yield "..."
                return
            yield text

    return ", ".join(parts())
