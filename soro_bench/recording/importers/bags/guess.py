"""A mapping for a bag, to be corrected: its topics, their fields with sizes, and the names beside values."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from soro_bench.errors import one_line
from soro_bench.files import shown
from soro_bench.recording.importers.bags.collector import BINARY
from soro_bench.recording.importers.bags.fields import (
    SECOND,
    Seen,
    Slot,
    Step,
    entry_names,
    follow,
    is_list,
    listed,
    names_beside,
    nanoseconds,
    parse_path,
    stamp_parts,
)
from soro_bench.recording.importers.bags.files import messages
from soro_bench.recording.importers.bags.layout import Channel, Walk
from soro_bench.recording.importers.bags.logs import MAX_MESSAGE, Reading
from soro_bench.recording.importers.tracks import signal_name
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import EXPANSION, named_errors

_IS_NUMBER = re.compile(r"[+-]?(nan|inf(inity)?|[\d.]+)", re.IGNORECASE)  # as JSON has those that it cannot write
_BYTES = "Bb?"  # codes of what is rarely a signal
_MOST_PUBLISHERS = 8  # of a topic
_KEPT_BYTES, _TOPIC_BYTES = 20_000_000, 1_000_000  # of all messages that are looked at, and of those of a topic
_KEPT = 50  # messages of a topic that are looked at
_MOST_FIELDS, _MOST_NUMBERS = 40, 1000  # of a topic, and of a field that becomes a signal
_MOST_LEAVES = 200  # of a message that are looked at
_DAY, _ALIKE = (
    86_400 * SECOND,
    2,
)  # stamps are not set if they are that far away; they go as fast as time within a factor
_MOST_SAID = 200  # letters of a list of topics
_APART = 1.0  # s, by which stamps of two topics are ahead of when they came, and one clock is set wrong
_RECEIVED = "log_time"
_STAMPS = ("header.stamp", "stamp", "timestamp", "time")
_COMMANDS = re.compile(
    r"(^|[/_])(cmd|command|commands|action|actions|target|goal|desired|reference|setpoint)s?($|[/_])"
)
_IGNORED = re.compile(
    r"covariance|variance|^header\.|^layout\.|(^|\.)(stamp|timestamp|time|sec|nanosec|secs|nsecs|seq)$"
)
_LEFT_OUT = re.compile(  # types that hold no signals
    r"/(Log|ParameterEvent|DiagnosticArray|(Compressed)?Image|CameraInfo|PointCloud2?|LaserScan|OccupancyGrid|Marker(Array)?)$"
)
_UNITS = (  # by the end of the path, the first that fits
    (r"angular_velocity(\.[xyz])?|angular\.[xyz]|velocity|velocities", "rad/s"),
    (r"linear_acceleration(\.[xyz])?|accel\.linear\.[xyz]", "m/s^2"),
    (r"linear\.[xyz]", "m/s"),
    (r"(position|translation|point)\.[xyz]|range", "m"),
    (r"positions?", "rad"),
    (r"force(\.[xyz])?", "N"),
    (r"torque(\.[xyz])?|efforts?", "Nm"),
    (r"pressures?|fluid_pressure", "Pa"),
    (r"currents?", "A"),
    (r"voltages?", "V"),
)


@dataclass
class _Topic:
    """What is known of a topic."""

    channel: Channel
    count: int = 0
    first: int = 2**62  # ns, at which messages were received
    last: int = -(2**62)
    contents: list[Any] = field(default_factory=list)  # of its first messages
    stamps: list[int] = field(default_factory=list)  # when these were received
    left: int = _TOPIC_BYTES  # that may still be looked at
    problem: str = ""
    damaged: str = ""  # what is wrong with the first message that is no JSON


@dataclass
class _Proposal:
    """A signal that a topic may become."""

    fields: list[str]
    names: list[str]
    unit: str


class _Leaf(NamedTuple):
    """What a field of a message holds."""

    kind: str  # numbers, text, names, entries, bytes
    size: int | None
    is_list: bool


def guess(path: str | Path) -> str:
    """A commented mapping (TOML) of the topics of a bag; RecordingError if it cannot be read."""
    path = Path(path)
    with named_errors(path):
        topics: dict[str, _Topic] = {}
        notes: list[str] = []
        left = _KEPT_BYTES
        for channel, received, data in _all(path, notes):
            topic = topics.setdefault(channel.topic, _Topic(channel))
            topic.count, topic.first, topic.last = (
                topic.count + 1,
                min(topic.first, received),
                max(topic.last, received),
            )
            if len(topic.contents) < _KEPT and min(left, topic.left) > 0 and not topic.problem:
                left, topic.left = left - len(data), topic.left - len(data)
                _look(topic, channel, received, data)
        if not topics:
            raise RecordingError("has no messages")
        for topic in topics.values():
            topic.problem = topic.problem or ("" if topic.contents else topic.damaged)
        return _written(path, topics, notes)


def _all(path: Path, notes: list[str]) -> Iterator[tuple[Channel, int, bytes]]:
    from soro_bench.recording.importers.bags import MAX_BYTES

    reading = Reading(lambda channel: True, EXPANSION * MAX_BYTES, notes)
    for channel, received, _, data in messages(path, MAX_BYTES, reading):
        yield channel, received, data


def _look(topic: _Topic, channel: Channel, received: int, data: bytes) -> None:
    """Keep what a message says, or why it cannot be read."""
    try:
        if _LEFT_OUT.search(channel.type):
            raise RecordingError("messages of this type hold no signals")
        if len(data) > MAX_MESSAGE:
            raise RecordingError(f"messages of {len(data)} bytes; at most {MAX_MESSAGE} are read")
        if channel.encoding in BINARY:
            content: Any = Walk(data, channel.type, channel.types({}), channel.encoding == "cdr").content
        elif channel.encoding == "json":
            content = json.loads(data)
        else:
            raise RecordingError(f"encoded as {channel.encoding[:40]}; only json, cdr and ros1 are read")
    except json.JSONDecodeError as error:  # others may be whole
        topic.damaged = topic.damaged or f"a message cannot be read as JSON ({one_line(error)[:200]})"
        return
    except (ValueError, RecursionError, ImportError) as error:
        topic.problem = one_line(error)[:200]
        return
    topic.contents.append(content)
    topic.stamps.append(received)


def _written(path: Path, topics: Mapping[str, _Topic], notes: list[str]) -> str:
    proposals = {name: _proposals(topic) for name, topic in sorted(topics.items())}
    clock, about = _common_clock({name: _clock(topics[name]) for name, found in proposals.items() if found})
    lines = [
        f"# A guess for {shown(path.name)}. Correct the units and what is a command; remove what is not needed.",
        *(f"# {shown(note)}" for note in notes),
        "",
        "[time]",
        f"source = {_quoted(clock)}  # {about}",
    ]
    taken: set[str] = set()
    for name, topic in sorted(topics.items()):
        lines += ["", *_described(name, topic)]
        group = "commands" if _COMMANDS.search(name.lower()) else "signals"
        for proposal in proposals[name]:
            lines += _section(group, name, proposal, taken)
    return "\n".join(lines) + "\n"


def _described(name: str, topic: _Topic) -> list[str]:
    """Comments on a topic: type, rate and fields."""
    seconds = (topic.last - topic.first) / SECOND
    rate = f", {(topic.count - 1) / seconds:.4g} per s" if seconds > 0 else ""
    lines = [f"# {shown(name)}: {shown(topic.channel.type) or topic.channel.encoding}, {topic.count} messages{rate}"]
    if topic.problem:
        return [*lines, f"#   not read: {topic.problem}"]
    fields = [f"{path}: {_sizes(leaves)}" for path, leaves in _fields(topic).items()]
    more = [f"and {len(fields) - _MOST_FIELDS} more"] if len(fields) > _MOST_FIELDS else []
    return [*lines, *(f"#   {shown(text)}" for text in (*fields[:_MOST_FIELDS], *more))]


def _sizes(leaves: list[_Leaf]) -> str:
    """What a field holds in all messages."""
    sizes = sorted({leaf.size for leaf in leaves if leaf.size is not None})
    if not sizes:
        return leaves[0].kind
    count = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else f"{sizes[0]}"
    return count if leaves[0].kind == "numbers" else f"{count} {leaves[0].kind}"


def _section(group: str, topic: str, proposal: _Proposal, taken: set[str]) -> list[str]:
    base = name = signal_name(f"{topic}_{_common(proposal.fields)}")
    number = 1
    while name in taken:
        number += 1
        name = f"{base}_{number}"
    taken.add(name)
    doubt = "" if proposal.unit != "1" else "  # correct it if it has one"
    return [
        "",
        f"[{group}.{name}]",
        f"topic = {_quoted(topic)}",
        f"fields = [{', '.join(map(_quoted, proposal.fields))}]",
        *([f"names = [{', '.join(map(_quoted, proposal.names))}]"] if proposal.names else []),
        f"unit = {_quoted(proposal.unit)}{doubt}",
    ]


def _common(fields: list[str]) -> str:
    """What a signal of these fields is called."""
    return fields[0] if len(fields) == 1 else fields[0].rpartition(".")[0]


def _proposals(topic: _Topic) -> list[_Proposal]:
    """Signals of a topic: lists of numbers, and the numbers of one unit that stand together in a part of a message."""
    if topic.problem:
        return []
    groups: dict[tuple[str, str], list[str]] = {}
    found = []
    for path, leaves in _fields(topic).items():
        sizes = {leaf.size for leaf in leaves}
        if leaves[0].kind != "numbers" or _IGNORED.search(path) or not path:
            continue
        if not leaves[0].is_list:
            groups.setdefault((path.rpartition(".")[0], _unit(path)), []).append(path)
        elif 0 < max(filter(None, sizes), default=0) <= _MOST_NUMBERS:
            names = _names(topic, path)
            if names or len(sizes) == 1:  # otherwise which number is which changes
                found += [_Proposal([path], each, _unit(path)) for each in names or [[]]]
    return [*found, *(_Proposal(paths, [], unit) for (_, unit), paths in groups.items())][:_MOST_FIELDS]


def _names(topic: _Topic, path: str) -> list[list[str]]:
    """The names beside a list, a list for each publisher whose names no other has; none if there are none."""
    found: list[list[str]] = []
    for content in topic.contents:
        try:
            names = names_beside(content, parse_path(path))
        except RecordingError:
            continue
        known = next((each for each in found if set(each) & set(names)), None)
        if known is not None:
            known += [name for name in names if name not in known]
        elif names and len(set(names)) == len(names):
            found.append(names)
    return found[:_MOST_PUBLISHERS]


class _Clock(NamedTuple):
    """What says when messages of a topic are from."""

    path: str  # of the stamp in them, or log_time
    ahead: float = 0.0  # s, of when they were received


def _common_clock(clocks: Mapping[str, _Clock]) -> tuple[str, str]:
    """The path of times that all topics share, and what there is to say: signals of one recording need one clock."""
    paths = {clock.path for clock in clocks.values()} or {_RECEIVED}
    if paths == {_RECEIVED}:
        return _RECEIVED, "or a stamp that all messages have"
    if len(paths) > 1:
        found = [f"{shown(name)} has {clock.path}" for name, clock in clocks.items() if clock.path != _RECEIVED]
        return _RECEIVED, f"when messages were received, as only {', '.join(found)[:_MOST_SAID]}"
    first, last = (choose(clocks, key=lambda name: clocks[name].ahead) for choose in (min, max))
    path, apart = clocks[last].path, clocks[last].ahead - clocks[first].ahead
    if apart > _APART:
        doubt = f"{path} of {shown(last)} is {apart:.3g} s ahead of that of {shown(first)}"
        return _RECEIVED, f"when messages were received, as {doubt}"
    return path, "or log_time, when messages were received"


def _clock(topic: _Topic) -> _Clock:
    """The stamp in its messages, if it is set and goes on, but for messages that came late."""
    received = np.array(topic.stamps)
    for path in _STAMPS:
        try:
            found = np.array([_time(content, parse_path(path)) for content in topic.contents])
        except RecordingError:
            continue
        is_set = np.abs(found - np.int64(np.median(found))) < _DAY  # the first ones may not be
        steps, seconds = np.diff(found[is_set]), np.diff(received[is_set])
        late = np.maximum.accumulate(found[is_set]) - found[is_set]
        if steps.size and late.max() <= SECOND and seconds.sum() / _ALIKE < steps.sum() < _ALIKE * seconds.sum():
            return _Clock(path, float(np.median(found[is_set] - received[is_set])) / SECOND)
    return _Clock(_RECEIVED)


def _time(content: Any, path: tuple[Step, ...]) -> int:
    """The stamp [ns] at a path of a message."""
    parts = stamp_parts(follow(content, path, Seen()), "")
    return nanoseconds([part.value if isinstance(part, Slot) else part for part in parts], 1.0, "")


def _fields(topic: _Topic) -> dict[str, list[_Leaf]]:
    """What messages hold, by path: a leaf for each message that has it."""
    found: dict[str, list[_Leaf]] = {}
    for content in topic.contents:
        for path, leaf in islice(_leaves(content, ""), _MOST_LEAVES):
            found.setdefault(path, []).append(leaf)
    return found


def _leaves(content: Any, path: str) -> Iterator[tuple[str, _Leaf]]:
    """Every field of a message, and of the entries of its lists those that have names, or the first."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            if re.fullmatch(r"[^.\[\]]+", str(key)):
                yield from _leaves(value, f"{path}.{key}".removeprefix("."))
    elif not is_list(content):
        is_number = isinstance(content, (int, float, Slot)) or content is None
        yield path, _Leaf("numbers", 1, False) if is_number else _Leaf("text", None, False)
    elif len(content) and isinstance(content[0], Mapping):
        yield path, _Leaf("entries", len(content), True)
        names = entry_names(content)
        for i, entry in enumerate(content[: len(names) or 1]):
            place = f"{path}[{names[i]}]" if names else f"{path}[0]"
            yield from _leaves(entry, place)
    elif len(content) and all(isinstance(entry, str) and not _IS_NUMBER.fullmatch(entry) for entry in content):
        yield path, _Leaf(f"names ({listed(content)})", len(content), True)
    elif len(content) and is_list(content[0]):
        is_even = _is_even(content)
        yield path, _Leaf("numbers" if is_even else "uneven lists", int(np.size(content)) if is_even else None, True)
    elif getattr(content, "code", "d") in _BYTES:
        yield path, _Leaf("bytes", len(content), True)
    else:
        yield path, _Leaf("numbers", len(content), True)


def _is_even(content: Any) -> bool:
    """Whether nested lists have one length each."""
    try:
        return np.asarray(content).dtype.kind in "fiub"
    except ValueError:
        return False


def _unit(path: str) -> str:
    return next((unit for pattern, unit in _UNITS if re.search(rf"(^|\.|_)({pattern})$", path)), "1")


def _quoted(text: str) -> str:
    """A text for TOML."""
    return json.dumps(text).replace("\x7f", "\\u007f")
