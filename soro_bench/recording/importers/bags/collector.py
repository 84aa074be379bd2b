"""The samples of one command or signal, taken from the messages of a topic."""

import json
from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from soro_bench.errors import one_line
from soro_bench.files import brief
from soro_bench.recording.importers.bags.fields import (
    MISSING,
    SECOND,
    AbsentError,
    Named,
    Seen,
    Text,
    flatten,
    follow,
    listed,
    nanoseconds,
    number,
    parse_path,
    stamp_parts,
)
from soro_bench.recording.importers.bags.layout import Channel, Layout, Types, Walk
from soro_bench.recording.importers.bags.logs import MAX_MESSAGE
from soro_bench.recording.importers.clock import overflowed
from soro_bench.recording.importers.mapping import FileMapping, texts
from soro_bench.recording.importers.source import Source
from soro_bench.recording.recording import RecordingError

PLACE = ("topic", "fields", "names", "names_from", "time")
CLOCKS = ("log_time", "publish_time")
BINARY = ("cdr", "ros1")
_MAX_LAYOUTS = 1000  # that are kept of one topic; the messages of others are walked through
_DAY = 86_400 * SECOND
_LATE = SECOND  # by which messages that were sent earlier may arrive later
_FROZEN = 1e-3  # of the time in which messages come: stamps that span less stand still
_SLOW = SECOND // 10  # in which messages have to come, to tell that from a few messages
_DRIFT, _SHARE = SECOND // 2, 0.01  # ns, and of the time: what two clocks drift apart beyond both is said
_OFTEN = 0.1  # of the stamps: fewer that repeat are left out
_SELDOM, _PACE = 0.02, 1.5  # of the steps are where a clock was set back; median steps, up to which others are usual


Sample = tuple[Sequence[float], Sequence[Any]]  # its numbers, and the parts of its stamp


class Collector:
    """The samples of one command or signal."""

    def __init__(self, source: Source, spec: FileMapping) -> None:
        self.topic = _text("topic", source.place.get("topic"))
        self._asked = texts("fields", source.place.get("fields"))  # of each number, if they are chosen by name
        self._fields = [parse_path(text) for text in self._asked]
        names = texts("names", source.place["names"]) if "names" in source.place else []
        if "names_from" in source.place and not names:
            raise RecordingError("names_from has no effect without names = [...]")
        if names:
            if any(isinstance(step, Named) for path in self._fields for step in path):
                raise RecordingError("names and a name in the path of a field: write one of them")
            where = _text("names_from", source.place.get("names_from", ""))
            self._fields = [(*path, Named(tuple(names), where, True)) for path in self._fields]
            self._asked = [f"{text}[{name}]" for text in self._asked for name in names]
        self._by_name = any(isinstance(step, Named) for path in self._fields for step in path)
        clock = _text("time", source.place.get("time", spec.time.get("source", "log_time")))
        self._clock, self._path = clock, () if clock in CLOCKS else parse_path(clock)
        self.has_unit = bool(self._path)  # whether [time] unit may say something
        self._to_seconds, self._ordered = spec.to_seconds(), "order" in spec.time
        self._spec = spec
        self._counts = False  # whether stamps are numbers of a unit
        self._known = spec.format.get("definitions", {})
        self._received, self._stamps = array("q"), array("q")  # ns; lists would take four times the memory
        self._numbers = array("d")
        self._size, self._messages = 0, 0
        self._labels: list[list[str]] = []  # the names beside the values of the first sample
        self._layouts: dict[tuple, list[Layout]] = {}
        self._types: dict[Channel, Types] = {}
        self._absence = ""  # what the first message has not that lacks a field
        self._unknown: list[str] = []  # names of the first message that has none of those asked for

    @property
    def count(self) -> int:
        """Numbers so far."""
        return len(self._numbers) + 2 * len(self._received)

    def add(self, channel: Channel, received: int, published: int | None, data: bytes) -> None:
        """Note a message of the topic, with the times [ns] at which it was received and published."""
        if len(data) > MAX_MESSAGE:
            raise RecordingError(f"a message of {len(data)} bytes; at most {MAX_MESSAGE} are read")
        self._messages += 1
        if channel.encoding in BINARY:
            found = self._binary(channel, data)
        elif channel.encoding == "json":
            found = self._json(data)
        else:
            raise RecordingError(
                f"topic {self.topic} is encoded as {brief(channel.encoding)}; only json, cdr and ros1 are read"
            )
        if found is None:
            return
        numbers, parts = found
        if self._received and len(numbers) != self._size:
            raise RecordingError(
                f"topic {self.topic}: {len(numbers)} numbers follow {self._size}; choose them by name with "
                "names = [...], or one by one such as position[0]"
            )
        self._size = len(numbers)
        self._numbers.extend(numbers)
        self._received.append(received)
        if self._path:
            self._counts = len(parts) == 1 and not isinstance(parts[0], (str, bytes))
            self._stamps.append(nanoseconds(parts, self._to_seconds, self.topic))
        elif self._clock == "publish_time":
            if published is None:
                raise RecordingError('a file of this kind has no publish_time; write time = "log_time"')
            self._stamps.append(published)

    def _binary(self, channel: Channel, data: bytes) -> Sample | None:
        key = (channel, len(data), data[:2] if channel.encoding == "cdr" else b"")
        for layout in self._layouts.get(key, ()):
            if found := layout.read(data):
                return found if found[0] else None
        if channel not in self._types:
            self._types[channel] = channel.types(self._known)
        walk = Walk(data, channel.type, self._types[channel], channel.encoding == "cdr")
        leaves, stamp, seen = self._found(walk.content)
        if text := next((leaf for leaf in leaves if isinstance(leaf, Text)), None):
            raise RecordingError(f"topic {self.topic}: {ascii(text)[:80]} is a text, no number")
        layout = Layout(walk, leaves, stamp, seen.compared)
        if sum(map(len, self._layouts.values())) < _MAX_LAYOUTS:
            self._layouts.setdefault(key, []).append(layout)
        found = layout.read(data)
        return found if found and found[0] else None

    def _json(self, data: bytes) -> Sample | None:
        try:
            content = json.loads(data)
        except ValueError as error:
            self._absence = self._absence or f"a message cannot be read as JSON ({one_line(error)})"
            return None
        leaves, stamp, _ = self._found(content)
        return ([number(leaf) for leaf in leaves], stamp) if leaves else None

    def _found(self, content: Any) -> tuple[list[Any], Sequence[Any], Seen]:
        """Numbers or slots of a sample, those of its stamp, and what was compared; none without its fields or names."""
        leaves: list[Any] = []
        seen = Seen()
        try:
            for path in self._fields:
                flatten(follow(content, path, seen), leaves)
        except AbsentError as error:
            self._absence = self._absence or str(error)
            return [], (), seen
        if not leaves:  # an empty list
            return [], (), seen
        if self._by_name and all(leaf is MISSING for leaf in leaves):
            self._unknown = self._unknown or list(dict.fromkeys(seen.names))
            return [], (), seen
        self._labels = self._labels or [seen.labels]
        if seen.labels != self._labels[0]:
            such = max(self._labels[0], seen.labels, key=len)
            raise RecordingError(
                f"topic {self.topic}: the names beside the values change, from {listed(self._labels[0])} to "
                f"{listed(seen.labels)}; choose values by name, such as names = [{listed(map(json.dumps, such))}]"
            )
        if not self._path:
            return leaves, (), seen
        try:
            stamp = follow(content, self._path, Seen())
            if stamp is None:
                raise AbsentError(f"{self._clock} of a message is null")
        except AbsentError as error:
            self._absence = self._absence or str(error)
            return [], (), seen
        return leaves, stamp_parts(stamp, self.topic), seen

    def arrays(
        self, topics: Sequence[str], said: Sequence[str], note: Callable[[str], None]
    ) -> tuple[np.ndarray, np.ndarray]:
        """(T,) times [ns] in order and (T, k) numbers; what is out of the ordinary is noted.

        Args:
            topics, said: those that the file has, and what its reader said, for the message where this one is missing.
        """
        if not self._received:
            there = "; ".join([f"there are {listed(sorted(topics))}" if topics else "there is none", *said])
            if self._absence:
                raise RecordingError(f"topic {self.topic}: {self._absence}")
            if self._messages:
                raise RecordingError(
                    f"no message of topic {self.topic} has a name that is asked for; there are {listed(self._unknown)}"
                )
            raise RecordingError(f"no messages of topic {self.topic}; {there}")
        received = np.frombuffer(self._received, np.int64)
        times = np.frombuffer(self._stamps, np.int64) if self._stamps else received
        numbers = np.frombuffer(self._numbers).reshape(len(received), -1)
        if (back := np.diff(received) < 0).any() and not _set_back(received):  # they lie in the file in another order
            note(f"{back.sum()} messages lie in the file behind later ones; sorted by the times of receipt")
            order = np.argsort(received, kind="stable")
            received, times, numbers = received[order], times[order], numbers[order]
        if self._counts:
            self._spec.check_unit_of_time(self._clock.rpartition(".")[2], self._spec.time.get("unit"))
            counts, overflows, _ = overflowed(times / (SECOND * self._to_seconds))
            times = np.rint(counts * (SECOND * self._to_seconds)).astype(np.int64) if overflows else times
            note(overflows)
        if self._stamps:
            times, numbers = _of_one_clock(times, received, numbers, self._clock, note)
        if not self._ordered:
            times, numbers = _sorted(times, numbers, self._clock, note)
        if self._absence:
            left_out = self._messages - len(received)
            note(f"{left_out} of {self._messages} messages are left out: {self._absence}")
        self._note_missing(numbers, note)
        if not (known := ~np.isnan(numbers).all(axis=1)).any():
            raise RecordingError(f"topic {self.topic}: no message has a number")
        return (times, numbers) if known.all() else (times[known], numbers[known])

    def _note_missing(self, numbers: np.ndarray, note: Callable[[str], None]) -> None:
        """Say which names some messages do not have, so that a signal of several may never be complete."""
        absent = np.isnan(numbers).mean(axis=0) if self._by_name else np.zeros(0)
        if not absent.any() or len(absent) < 2:
            return
        few = [asked for asked, share in zip(self._asked, absent, strict=False) if share > 0]
        note(
            f"{listed(few)} missing in up to {100 * absent.max():.0f} % of the samples; if another node publishes "
            "them, give them a signal of their own"
        )


def _of_one_clock(
    stamps: np.ndarray, received: np.ndarray, numbers: np.ndarray, clock: str, note: Callable[[str], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (T,) [ns] and numbers without those that are not set, or of a clock that was not set yet."""
    tolerance = _DAY + 20 * int(np.ptp(received))
    offset = stamps - received
    far = np.abs(stamps - np.int64(np.median(stamps))) > tolerance
    far &= np.abs(offset - np.int64(np.median(offset))) > tolerance
    if far.any():
        note(f"{far.sum()} of {len(far)} stamps in {clock} are not set or of another clock (the first is "
             f"{stamps[far][0] / SECOND:g} s); these samples are left out")  # fmt: skip
        stamps, received, numbers = stamps[~far], received[~far], numbers[~far]
    if len(stamps) > 2 and np.ptp(received) > _SLOW and np.ptp(stamps) < _FROZEN * np.ptp(received):
        raise RecordingError(
            f"the stamps in {clock} stand still: they span {np.ptp(stamps) / SECOND:g} s, while messages came over "
            f'{np.ptp(received) / SECOND:g} s; write time = "log_time"'
        )
    tenth = max(1, len(stamps) // 10)
    apart = stamps - received
    drift = int(np.median(apart[-tenth:]) - np.median(apart[:tenth]))
    if abs(drift) > max(_DRIFT, _SHARE * np.ptp(received)):
        note(f"{clock} and the times of receipt drift apart by {drift / SECOND:.3g} s (simulated time, a clock that "
             "was set, or a wrong [time] unit)")  # fmt: skip
    return stamps, numbers


def _set_back(times: np.ndarray) -> bool:
    """Whether a clock was set back between (T,) times [ns]: there all later messages go on at the usual pace.

    A message that is only late is followed by a longer step, as those after it are not late.
    """
    steps = np.diff(times)
    back = int((steps < 0).sum())
    if back in (0, len(steps)) or back > max(1, _SELDOM * len(steps)):
        return False
    usual = _PACE * np.median(steps[steps > 0])
    late = times < np.maximum.accumulate(times)
    runs = np.flatnonzero(np.diff(late, prepend=False, append=False)).reshape(-1, 2)  # from, and before which
    return any(end - begin > 1 and bool((steps[begin:end] <= usual).all()) for begin, end in runs)


def _sorted(
    times: np.ndarray, numbers: np.ndarray, clock: str, note: Callable[[str], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) [ns] and numbers in order, if they are late by less than a second; one sample for each time.

    Of samples of one time the numbers of the later count; what it has not is taken from the earlier.
    """
    late = np.maximum.accumulate(times) - times
    if late.max() > _LATE or _set_back(times):
        return times, numbers  # the mapping says what to do
    if late.any():
        note(f"{(late > 0).sum()} messages came up to {late.max() / SECOND:.3g} s later than others that were sent "
             "after them; sorted")  # fmt: skip
        order = np.argsort(times, kind="stable")
        times, numbers = times[order], numbers[order]
    repeats = np.flatnonzero(np.diff(times) == 0)
    if not repeats.size:
        return times, numbers
    differing = 0
    for i in repeats:
        both = ~np.isnan(numbers[i]) & ~np.isnan(numbers[i + 1])
        differing += int((numbers[i][both] != numbers[i + 1][both]).any())
        numbers[i + 1] = np.where(np.isnan(numbers[i + 1]), numbers[i], numbers[i + 1])
    if differing > _OFTEN * len(times):
        raise RecordingError(
            f"{differing} of {len(times)} stamps in {clock} repeat, with other numbers; write time = "
            f'"{"header.stamp" if clock in CLOCKS else "log_time"}", or [time] order = "keep_first" or "keep_last"'
        )
    if differing:
        note(f"{differing} stamps repeat with other numbers; the later count")
    kept = np.append(np.diff(times) > 0, True)
    return times[kept], numbers[kept]


def _text(label: str, value: Any) -> str:
    if not isinstance(value, str):
        raise RecordingError(f"{label} is {ascii(value)[:80]}; expected a text")
    return value
