"""Binary messages of ROS, as CDR (ROS 2) or as ROS 1 writes them: where their numbers are.

Messages of a topic mostly have the same texts and list lengths, so that their numbers lie at the same places. One is
walked through to find these; a single call of ``struct`` then reads each message that has the same lengths and names.
Definitions are read by rosbags, which knows those of ROS itself. Its own decoders are not used: they are code that it
generates from the definitions in a file.
"""

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from typing import Any

from soro_bench.errors import one_line
from soro_bench.recording.importers.bags.fields import MISSING, Run, Slot, Text
from soro_bench.recording.recording import RecordingError

_CODES = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_SEPARATOR = "=" * 80 + "\n"
_MAX_DEFINITION = 200_000  # letters
_MAX_NODES = 300_000  # of one message
_MAX_DEPTH = 32  # of types in types
_PADDING = 3  # bytes behind a message

Field = tuple[str, str, int | None]  # name, type, and of a list its length, or -1 if the message says it
Types = dict[str, list[Field]]


@lru_cache(100)
def types_of(name: str, definition: str, kind: str) -> Types:
    """The fields of a message type and of those in it, from its definition as ROS has it.

    Args:
        name: such as "sensor_msgs/msg/JointState".
        definition: the text of its .msg file, or of its .idl file, with those of the types in it; "" for a type of
            ROS itself.
        kind: "ros2idl" for IDL, anything else for MSG.

    Raises:
        RecordingError: the definition is missing or cannot be read.
        ImportError: says what to install.
    """
    try:
        from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ImportError("binary messages of ROS need rosbags: pip install soro_bench[ros]") from error
    if len(definition) > _MAX_DEFINITION:
        raise RecordingError(f"the definition of {ascii(name)[:80]} has more than {_MAX_DEFINITION} letters")
    found: dict[str, Any] = {}
    known = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    try:
        if kind == "ros2idl":
            for part in definition.split(_SEPARATOR):
                found |= (
                    get_types_from_idl(part.split("\n", 1)[-1] if part.startswith("IDL: ") else part) if part else {}
                )
        elif definition.strip():
            lines = "\n".join(line for line in definition.splitlines() if line.strip())  # blank ones cost a lot of time
            found = dict(get_types_from_msg(lines, name))
    except TypesysError as error:
        raise RecordingError(f"the definition of {ascii(name)[:80]} cannot be read: {one_line(error)[:200]}") from error
    if full(name) not in found and full(name) not in known:
        raise RecordingError(
            f"the file has no definition of the type {ascii(name)[:80]}; write the text of its .msg file into the "
            f'mapping: [format.definitions] "{ascii(name)[1:-1][:80]}" = """..."""'
        )
    return {key: [_field(*each) for each in fields] for key, (_, fields) in {**known, **found}.items()}


@dataclass(eq=False)
class Channel:
    """A topic in a file, and how its messages are written."""

    topic: str
    type: str
    encoding: str  # json, cdr, ros1, or another, which is not read
    definition: str = ""
    kind: str = ""  # of the definition: ros2msg, ros2idl, ros1msg, jsonschema

    def types(self, known: dict[str, str]) -> Types:
        """The fields of its type; ``known`` definitions of the mapping come before that of the file."""
        definition = known.get(self.type, self.definition)
        return types_of(self.type, definition, "" if self.type in known else self.kind)


def full(name: str) -> str:
    """The name of a type in the style of ROS 2: "std_msgs/Header" is "std_msgs/msg/Header"."""
    parts = name.split("/")
    return name if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


def _field(name: str, description: Any) -> Field:
    from rosbags.interfaces import Nodetype

    kind, detail = description
    if kind in (Nodetype.BASE, Nodetype.NAME):
        return name, detail[0] if kind == Nodetype.BASE else detail, None
    (inner_kind, inner), length = detail
    inner_name = inner[0] if inner_kind == Nodetype.BASE else inner
    return name, inner_name, length if kind == Nodetype.ARRAY else -1


class Walk:
    """What a binary message holds, and where.

    Args:
        types: of :func:`types_of`.
        is_cdr: whether it is CDR; otherwise as ROS 1 writes it.

    Raises:
        RecordingError: it is no message of that type.
    """

    def __init__(self, data: bytes, name: str, types: Types, is_cdr: bool) -> None:
        self.data, self._types, self._name, self._is_cdr = data, types, name, is_cdr
        self.order, self._base = "<", 0
        if is_cdr:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise self._wrong(f"begins with {data[:2].hex()}; only plain CDR is read")
            self.order, self._base = ("<" if data[1] else ">"), 4
        self._at, self._nodes = self._base, 0
        self.lengths: list[Slot] = []  # of lists and texts
        self.content = self._struct(full(name), 0)
        if not 0 <= len(data) - self._at <= (_PADDING if is_cdr else 0):
            raise self._wrong(f"has {len(data) - self._at} bytes more than its definition")

    def _struct(self, name: str, depth: int) -> dict[str, Any]:
        if depth > _MAX_DEPTH or name not in self._types:
            raise self._wrong(
                f"nests deeper than {_MAX_DEPTH}" if depth > _MAX_DEPTH else f"has the unknown {name[:80]}"
            )
        if not self._types[name] and self._is_cdr:
            self._at += 1  # ROS 2 gives an empty message a byte
        return {field: self._value(kind, count, depth) for field, kind, count in self._types[name]}

    def _value(self, kind: str, count: int | None, depth: int) -> Any:
        if count is None:
            return self._one(kind, depth)
        count = self._length() if count < 0 else count
        if code := _CODES.get(kind):
            return self._run(code, count)
        if count > len(self.data):  # each takes a byte at least, if it is not empty
            raise self._wrong(f"has a list of {count} entries in {len(self.data)} bytes")
        return [self._one(kind, depth) for _ in range(count)]

    def _one(self, kind: str, depth: int) -> Any:
        self._nodes += 1
        if self._nodes > _MAX_NODES:
            raise self._wrong(f"has more than {_MAX_NODES} parts")
        if code := _CODES.get(kind):
            return self._run(code, 1)[0]
        if kind == "string":
            size = self._length()
            offset = self._advance(size)
            text = self.data[offset : offset + size].removesuffix(b"\0" if self._is_cdr else b"")
            return Text(text.decode(errors="replace"), offset, size)
        if kind in ("wstring", "wchar", "float128", "fixed"):
            raise self._wrong(f"has a {kind}, which is not read")
        return self._struct(full(kind), depth + 1)

    def _run(self, code: str, count: int) -> Run:
        size = struct.calcsize("=" + code)
        if count:
            self._align(size)
        return Run(self.data, self.order, self._advance(count * size), code, count)

    def _length(self) -> int:
        self._align(4)
        offset = self._advance(4)
        self.lengths.append(Slot(offset, "I", struct.unpack_from(self.order + "I", self.data, offset)[0]))
        return int(self.lengths[-1].value)

    def _align(self, size: int) -> None:
        if self._is_cdr:
            self._at += -(self._at - self._base) % size

    def _advance(self, size: int) -> int:
        offset, self._at = self._at, self._at + size
        if self._at > len(self.data):
            raise self._wrong(f"ends after {len(self.data)} bytes, but says that it has {self._at} or more")
        return offset

    def _wrong(self, what: str) -> RecordingError:
        return RecordingError(f"a message of type {ascii(self._name)[1:-1][:80]} {what}")


class Layout:
    """Reads the messages that have the same lengths and names as one that has been walked through.

    Args:
        numbers: what to read, MISSING for a missing number.
        stamp: the parts of its time, empty if it is not in the message.
        compared: what has to be the same in other messages, besides the lengths.
    """

    def __init__(self, walk: Walk, numbers: Sequence[Any], stamp: Sequence[Any], compared: Iterable[Any]) -> None:
        codes: dict[int, str] = {}
        same = [*walk.lengths, *(place for place in compared if not isinstance(place, Text) or place.size)]
        for place in (*same, *numbers, *stamp):
            if isinstance(place, (Slot, Text)):
                codes[place.offset] = place.code if isinstance(place, Slot) else f"{place.size}s"
        offsets = sorted(codes)
        index = {offset: i for i, offset in enumerate(offsets)}
        self._unpack = struct.Struct(walk.order + _format(offsets, codes)).unpack_from
        self._missing = (math.nan,) if any(leaf is MISSING for leaf in numbers) else ()
        self._numbers = _getter([len(offsets) if leaf is MISSING else index[leaf.offset] for leaf in numbers])
        self._stamp = [(index[part.offset], part) if isinstance(part, (Slot, Text)) else (-1, part) for part in stamp]
        self._same = _getter([index[place.offset] for place in same])
        self._expected = self._same(self._unpack(walk.data))

    def read(self, data: bytes) -> tuple[tuple, list[Any]] | None:
        """Numbers and the parts of the stamp of a message of the same size; None if it has another layout."""
        values = self._unpack(data)
        if self._same(values) != self._expected:
            return None
        return self._numbers(values + self._missing), [values[i] if i >= 0 else part for i, part in self._stamp]


def _format(offsets: Sequence[int], codes: Mapping[int, str]) -> str:
    """For struct: these places of a message, and what lies between them left out."""
    parts, at = [], 0
    for offset in offsets:
        code = codes[offset]
        parts.append(f"{offset - at}x{code}" if offset > at else code)
        at = offset + struct.calcsize("=" + code)
    return "".join(parts)


def _getter(positions: Sequence[int]) -> Callable[[tuple], tuple]:
    """What is at these positions of a tuple, as a tuple."""
    if not positions:
        return lambda values: ()
    first, last = positions[0], positions[-1]
    if list(positions) == list(range(first, last + 1)):
        return itemgetter(slice(first, last + 1))
    return itemgetter(*positions)
