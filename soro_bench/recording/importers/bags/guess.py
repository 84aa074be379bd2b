"""A mapping for a bag, to be corrected: its topics, their fields with sizes, and the names beside values."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import shown
from soro_bench.recording.importers.bags.collector import BINARY
from soro_bench.recording.importers.bags.fields import (
    SECOND,
    Seen,
    Slot,
    Step,
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

_KEPT = 50  # messages of a topic that are looked at
_MOST_FIELDS, _MOST_NUMBERS = 40, 1000  # of a topic, and of a field that becomes a signal
_DAY, _ALIKE = (
    86_400 * SECOND,
    2,
)  # stamps are not set if they are that far away; they go as fast as time within a factor
_STAMPS = ("header.stamp", "stamp", "timestamp", "time")
_COMMANDS = re.compile(
    r"(^|[/_])(cmd|command|commands|action|actions|target|goal|desired|reference|setpoint)s?($|[/_])"
)
_IGNORED = re.compile(r"covariance|^header\.|(^|\.)(stamp|timestamp|time|sec|nanosec|secs|nsecs|seq)$")
_LEFT_OUT = ("/rosout", "/parameter_events", "/tf_static")
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
    problem: str = ""


@dataclass
class _Proposal:
    """A signal that a topic may become."""

    fields: list[str]
    names: list[str]
    size: int
    unit: str


def guess(path: str | Path) -> str:
    """A commented mapping (TOML) of the topics of a bag; RecordingError if it cannot be read."""
    path = Path(path)
    with named_errors(path):
        topics: dict[str, _Topic] = {}
        notes: list[str] = []
        for channel, received, data in _all(path, notes):
            topic = topics.setdefault(channel.topic, _Topic(channel))
            topic.count, topic.first, topic.last = (
                topic.count + 1,
                min(topic.first, received),
                max(topic.last, received),
            )
            if len(topic.contents) < _KEPT and not topic.problem:
                _look(topic, channel, received, data)
        if not topics:
            raise RecordingError("has no messages")
        return _written(path, topics, notes)


def _all(path: Path, notes: list[str]) -> Iterator[tuple[Channel, int, bytes]]:
    from soro_bench.recording.importers.bags import MAX_BYTES

    reading = Reading(lambda channel: True, EXPANSION * MAX_BYTES, notes)
    for channel, received, _, data in messages(path, MAX_BYTES, reading):
        yield channel, received, data


def _look(topic: _Topic, channel: Channel, received: int, data: bytes) -> None:
    """Keep what a message says, or why it cannot be read."""
    try:
        if len(data) > MAX_MESSAGE:
            raise RecordingError(f"messages of {len(data)} bytes; at most {MAX_MESSAGE} are read")
        if channel.encoding in BINARY:
            content: Any = Walk(data, channel.type, channel.types({}), channel.encoding == "cdr").content
        elif channel.encoding == "json":
            content = json.loads(data)
        else:
            raise RecordingError(f"encoded as {channel.encoding[:40]}; only json, cdr and ros1 are read")
    except (ValueError, RecursionError, ImportError) as error:
        topic.problem = shown(str(error))[:200]
        return
    topic.contents.append(content)
    topic.stamps.append(received)


def _written(path: Path, topics: Mapping[str, _Topic], notes: list[str]) -> str:
    proposals = {name: _proposals(topic) for name, topic in sorted(topics.items()) if name not in _LEFT_OUT}
    clocks = {name: _clock(topics[name]) for name, found in proposals.items() if found}
    used = set(clocks.values())
    clock = used.pop() if len(used) == 1 else "log_time"
    others = "or log_time, when messages were received" if clock != "log_time" else "or a stamp that all messages have"
    lines = [
        f"# A guess for {shown(path.name)}. Correct the units and what is a command; remove what is not needed.",
        *(f"# {shown(note)}" for note in notes),
        "",
        "[time]",
        f"source = {_quoted(clock)}  # {others}",
    ]
    taken: set[str] = set()
    for name, topic in sorted(topics.items()):
        lines += ["", *_described(name, topic)]
        group = "commands" if _COMMANDS.search(name.lower()) else "signals"
        for proposal in proposals.get(name, []):
            lines += _section(group, name, proposal, taken)
    return "\n".join(lines) + "\n"


def _described(name: str, topic: _Topic) -> list[str]:
    """Comments on a topic: type, rate and fields."""
    seconds = (topic.last - topic.first) / SECOND
    rate = f", {(topic.count - 1) / seconds:.4g} per s" if seconds > 0 else ""
    lines = [f"# {shown(name)}: {shown(topic.channel.type) or topic.channel.encoding}, {topic.count} messages{rate}"]
    if topic.problem:
        return [*lines, f"#   not read: {topic.problem}"]
    fields = [f"{path} {size}" for path, size, _ in _leaves(topic.contents[0])]
    more = [f"and {len(fields) - _MOST_FIELDS} more"] if len(fields) > _MOST_FIELDS else []
    return [*lines, *(f"#   {shown(text)}" for text in (*fields[:_MOST_FIELDS], *more))]


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
    """Signals of a topic: each list of numbers, and the numbers that stand together in one part of a message."""
    if topic.problem or not topic.contents:
        return []
    groups: dict[str, list[str]] = {}
    found = []
    for path, size, value in _leaves(max(topic.contents, key=lambda content: len(_leaves(content)))):
        if _IGNORED.search(path) or not path or not isinstance(size, int):
            continue
        if not is_list(value):
            groups.setdefault(path.rpartition(".")[0], []).append(path)
        elif 0 < size <= _MOST_NUMBERS and getattr(value, "code", "d") not in ("B", "b"):
            found += [_Proposal([path], names, size, _unit(path)) for names in _names(topic, path)]
    scalars = [_Proposal(paths, [], len(paths), _unit(paths[0])) for paths in groups.values()]
    return [*found, *scalars][:_MOST_FIELDS]


def _names(topic: _Topic, path: str) -> list[list[str]]:
    """The names beside a list, a list for each publisher whose names no other has; [[]] if there are none."""
    found: list[list[str]] = []
    for content in topic.contents:
        try:
            names = names_beside(content, parse_path(path))
        except RecordingError:
            continue
        known = next((each for each in found if set(each) & set(names)), None)
        if known is not None:
            known += [name for name in names if name not in known]
        elif names:
            found.append(names)
    return found or [[]]


def _clock(topic: _Topic) -> str:
    """The stamp in its messages, if it is set and goes on."""
    for path in _STAMPS:
        try:
            found = np.array([_time(content, parse_path(path)) for content in topic.contents])
        except RecordingError:
            continue
        is_set = np.abs(found - np.int64(np.median(found))) < _DAY  # the first ones may not be
        steps, seconds = np.diff(found[is_set]), np.diff(np.array(topic.stamps)[is_set])
        if steps.size and (steps >= 0).all() and seconds.sum() / _ALIKE < steps.sum() < _ALIKE * seconds.sum():
            return path
    return "log_time"


def _time(content: Any, path: tuple[Step, ...]) -> int:
    """The stamp [ns] at a path of a message."""
    parts = stamp_parts(follow(content, path, Seen()), "")
    return nanoseconds([part.value if isinstance(part, Slot) else part for part in parts], 1.0, "")


def _leaves(content: Any, path: str = "") -> list[tuple[str, int | str, Any]]:
    """Path, size and value of every field of a message; of texts, and of lists of other things, what they are."""
    if isinstance(content, Mapping):
        return [
            leaf
            for key, value in content.items()
            for leaf in _leaves(value, f"{path}.{key}".removeprefix("."))
            if re.fullmatch(r"[^.\[\]]+", str(key))
        ]
    if not is_list(content):
        return [(path, 1 if isinstance(content, (int, float, Slot)) else "text", content)]
    if len(content) and isinstance(content[0], Mapping):
        return [(path, f"{len(content)} entries", content), *_leaves(content[0], f"{path}[0]")[:_MOST_FIELDS]]
    if len(content) and all(isinstance(entry, str) for entry in content):
        return [(path, f"texts: {listed(content)}", content)]
    if len(content) and is_list(content[0]):
        return [(path, int(np.size(content)) if _is_even(content) else "uneven lists", content)]
    return [(path, len(content), content)]


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
