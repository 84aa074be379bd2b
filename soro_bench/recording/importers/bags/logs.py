"""MCAP files and ROS 1 bags, read record by record: neither the end of the file nor an index is needed."""

import bz2
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from soro_bench.errors import one_line
from soro_bench.recording.importers.bags.fields import SECOND
from soro_bench.recording.importers.bags.layout import Channel
from soro_bench.recording.recording import ReadingProgress, RecordingError

MAX_MESSAGE = 5_000_000  # bytes
MAX_CHUNK = 64_000_000  # bytes of a chunk or another record
ZSTD = b"\x28\xb5\x2f\xfd"  # with which zstd begins
_MAX_TOPICS = 10_000
WINDOW = 2**27  # bytes that zstd may look back
_MCAP, _ROS1 = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 3, 4, 5, 6, 15  # opcodes of MCAP
_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CONNECTION = 2, 5, 7


class Damaged(RecordingError):
    """What follows in a file cannot be read."""


Message = tuple[Channel, int, int | None, bytes]  # received and published [ns]


@dataclass
class Reading:
    """How a file is read, and what there is to say about it.

    Args:
        wanted: whether the messages of a channel are asked for.
        budget: bytes that may still be decompressed.
        notes: grows while the file is read.
    """

    wanted: Callable[[Channel], bool]
    budget: int
    notes: list[str] = field(default_factory=list)
    progress: ReadingProgress | None = None
    total: int = 0  # bytes
    before: int = 0  # bytes of files that are read already
    scale: float = 1.0  # bytes of a file for each one of what is packed in it
    topics: dict[str, Channel] = field(default_factory=dict)

    def asked(self, channel: Channel) -> Channel | None:
        """The channel, if its messages are asked for."""
        self.topics.setdefault(channel.topic, channel)
        if len(self.topics) > _MAX_TOPICS:
            raise RecordingError(f"more than {_MAX_TOPICS} topics")
        return channel if self.wanted(channel) else None

    def cut(self, what: str) -> None:
        """Note that the file ends early."""
        self.notes.append(f"the file is cut {what} (recorder killed?); what is before that is read")

    def at(self, position: int) -> None:
        """Tell how far a file is read."""
        if self.progress:
            self.progress("read", self.before + int(self.scale * position), self.total)

    def spend(self, size: int) -> None:
        """Count bytes that are unpacked; RecordingError if a small file becomes a large one."""
        self.budget -= size
        if self.budget < 0:
            raise RecordingError("it unpacks to more bytes than its largest size allows")

    def unpacked(self, data: bytes, compression: str, size: int, is_cut: bool = False) -> bytes:
        """Decompressed to the ``size`` that is declared and no further; of cut data what can be had."""
        if size > MAX_CHUNK:
            raise RecordingError(f"a chunk of {size} bytes; at most {MAX_CHUNK} are read")
        self.spend(size)
        found = decompressed(data, compression, size + 1, is_cut)
        if len(found) != size and not (is_cut and len(found) < size):
            raise Damaged(f"a chunk has not the {size} bytes that it declares")
        return found


def decompressed(data: bytes, compression: str, most: int, is_cut: bool = False) -> bytes:
    """At most ``most`` bytes; RecordingError if the data are damaged, unless they are known to be cut."""
    if compression in ("", "none"):
        return data
    if compression not in ("zstd", "lz4", "bz2"):
        raise RecordingError(f"compression {ascii(compression)[:40]} is unknown; there are zstd, lz4 and bz2")
    try:
        if compression == "bz2":
            return bz2.BZ2Decompressor().decompress(data, most)
        if compression == "lz4":
            import lz4.frame

            return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
        return _zstd(data, most)
    except (RuntimeError, OSError, EOFError) as error:  # what lz4 and bz2 raise
        if is_cut:
            return b""
        raise Damaged(f"a broken chunk: {one_line(error)[:200]}") from error


def _zstd(data: bytes, most: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor(max_window_size=WINDOW).stream_reader(data) as stream:
            return stream.read(most)
    except zstandard.ZstdError as error:
        raise RuntimeError(error) from error


def mcap_messages(file: BinaryIO, reading: Reading) -> Iterator[Message]:
    """The messages of an MCAP file, in its order."""
    if file.read(len(_MCAP)) != _MCAP:
        raise RecordingError("is no MCAP file: it does not begin like one")
    schemas: dict[int, tuple[str, str, str]] = {}
    channels: dict[int, Channel | None] = {}
    while True:
        reading.at(file.tell())
        head = file.read(9)
        opcode, size = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
        if opcode == _DATA_END:
            return
        if len(head) < 9:
            return reading.cut("between two records")
        if opcode == 0:  # as a file system leaves it after a power cut
            raise Damaged("zeros follow")
        if opcode not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
            file.seek(size, 1)
            continue
        if size > MAX_CHUNK + 1000:
            raise Damaged(f"a record of {size} bytes; at most {MAX_CHUNK} are read")
        data = file.read(size)
        if is_cut := len(data) < size:
            reading.cut("in a chunk" if opcode == _CHUNK else "in a record")
        if opcode == _CHUNK:
            data = _mcap_chunk(data, reading, is_cut)
        elif not is_cut:
            data = head + data
        yield from _mcap_records(data, schemas, channels, reading, is_cut)
        if is_cut:
            return


def _mcap_chunk(data: bytes, reading: Reading, is_cut: bool) -> bytes:
    """The records in a chunk; of a cut one what can be had."""
    if is_cut and len(data) < 40:
        return b""
    size, check, letters = struct.unpack_from("<QII", data, 16)
    compression = data[32 : 32 + letters].decode("latin-1")
    (length,) = struct.unpack_from("<Q", data, 32 + letters)
    packed = data[40 + letters :]
    if len(packed) != length and not is_cut:
        raise Damaged(f"a chunk has {len(packed)} bytes, and says that it has {length}")
    records = reading.unpacked(packed, compression, size, is_cut)
    if check and not is_cut and zlib.crc32(records) != check:
        raise Damaged("the check sum of a chunk is wrong")
    return records


def _mcap_records(
    data: bytes, schemas: dict[int, tuple[str, str, str]], channels: dict[int, Channel | None], reading: Reading,
    is_cut: bool,
) -> Iterator[Message]:  # fmt: skip
    """The messages in records that lie one after the other; the last may be cut."""
    at, end = 0, len(data)
    while at + 9 <= end:
        opcode, size = struct.unpack_from("<BQ", data, at)
        at, first = at + 9 + size, at + 9
        if opcode == 0:
            raise Damaged("zeros follow")
        if at > end:
            break
        if opcode == _MESSAGE:
            number, _, received, published = struct.unpack_from("<HIQQ", data, first)
            if number not in channels:
                raise Damaged(f"a message of the unknown channel {number}")
            if channel := channels[number]:
                yield channel, received, published, data[first + 22 : at]
        elif opcode == _SCHEMA:
            (number,) = struct.unpack_from("<H", data, first)
            name, kind, definition = _texts(data, first + 2, at, 3)
            schemas[number] = name, kind, definition
        elif opcode == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data, first)
            topic, encoding = _texts(data, first + 4, at, 2)
            name, kind, definition = schemas.get(schema, ("", "", ""))
            if number not in channels:
                channels[number] = reading.asked(Channel(topic, name, encoding, definition, kind))
    if at != end and not is_cut:
        raise Damaged("the last record of a chunk is not complete")


def _texts(data: bytes, at: int, end: int, count: int) -> list[str]:
    """Texts that lie one after the other, each behind its length, in a record until ``end``."""
    found = []
    for _ in range(count):
        size = _uint32(data, at)
        if at + 4 + size > end:
            raise Damaged("a text is longer than its record")
        found.append(data[at + 4 : at + 4 + size].decode(errors="replace"))
        at += 4 + size
    return found


def ros1_messages(file: BinaryIO, reading: Reading) -> Iterator[Message]:
    """The messages of a ROS 1 bag, in its order."""
    if file.read(len(_ROS1)) != _ROS1:
        raise RecordingError("is no bag of ROS 1 (version 2.0): it does not begin like one")
    channels: dict[bytes, Channel | None] = {}
    while size := file.read(4):
        reading.at(file.tell())
        header = file.read(min(_uint32(size), MAX_CHUNK)) if len(size) == 4 else b""
        length = file.read(4)
        if len(length) < 4:
            return reading.cut("between two records")
        fields, count = _ros1_fields(header), _uint32(length)
        if fields.get(b"op") != bytes([_ROS1_CHUNK]):  # connections stand in chunks too
            file.seek(count, 1)
            continue
        if count > MAX_CHUNK:
            raise RecordingError(f"a chunk of {count} bytes; at most {MAX_CHUNK} are read")
        data = file.read(count)
        if is_cut := len(data) < count:
            reading.cut("in a chunk")
        compression = fields[b"compression"].decode("latin-1")
        data = reading.unpacked(data, compression, _uint32(fields[b"size"]), is_cut)
        yield from _ros1_records(data, channels, reading, is_cut)


def _ros1_records(
    data: bytes, channels: dict[bytes, Channel | None], reading: Reading, is_cut: bool
) -> Iterator[Message]:
    """The messages in the records of a chunk; the last may be cut."""
    at, end = 0, len(data)
    while at + 4 <= end:
        begin, first = at + 4, at + 4 + _uint32(data, at)
        at = first + 4 + _uint32(data, first) if first + 4 <= end else end + 1
        if at > end:
            break
        fields = _ros1_fields(data[begin:first])
        operation, connection = fields.get(b"op"), fields.get(b"conn", b"")
        if operation == bytes([_ROS1_CONNECTION]) and connection not in channels:
            about = _ros1_fields(data[first + 4 : at])
            topic, kind, definition = (
                about.get(key, b"").decode(errors="replace") for key in (b"topic", b"type", b"message_definition")
            )
            channel = Channel(fields.get(b"topic", b"").decode(errors="replace") or topic, kind, "ros1", definition)
            channels[connection] = reading.asked(channel)
        elif operation == bytes([_ROS1_MESSAGE]):
            if connection not in channels:
                raise Damaged(f"a message of the unknown connection {connection.hex()}")
            if channel_asked := channels[connection]:
                seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
                yield channel_asked, SECOND * seconds + nanoseconds, None, data[first + 4 : at]
    if at != end and not is_cut:
        raise Damaged("the last record of a chunk is not complete")


def _ros1_fields(header: bytes) -> dict[bytes, bytes]:
    """The entries name=value of a header."""
    found, at = {}, 0
    while at + 4 <= len(header):
        size = _uint32(header, at)
        name, equals, value = header[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not equals or at > len(header):
            raise Damaged("the header of a record is wrong")
        found[name] = value
    if not found:  # zeros, as a file system leaves them after a power cut
        raise Damaged("the header of a record is empty")
    return found


def _uint32(data: bytes, at: int = 0) -> int:
    return int(struct.unpack_from("<I", data, at)[0])
