"""MCAP files whose messages are JSON: what robots log through Foxglove and ROS bridges."""

import io
import json
import re
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soro_bench.recording.importers.mapping import FileMapping, Source, load_mapping, texts
from soro_bench.recording.recording import MAX_SIZE, Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors, read_bytes

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, Message

_PLACE = ("topic", "fields", "time")
_CLOCKS = ("log_time", "publish_time")
_MAX_NUMBERS = 50_000_000
_MAX_CHUNK = 64_000_000  # bytes of a chunk or another record
_MAX_MESSAGE = 5_000_000  # bytes
_STEP = re.compile(r"([^.\[\]]+)|\[(\d{1,6})\]")


def import_mcap(path: str | Path, mapping: str | Path | Mapping | None, max_bytes: int = MAX_BYTES) -> Recording:
    """Read an MCAP file with a mapping file; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: an MCAP file needs a mapping file; docs/how_to/import_a_log.md has an example")
    spec = load_mapping(mapping, _PLACE, ("source", "unit"))
    data = read_bytes(path, max_bytes)
    with named_errors(path):
        sources = [*spec.commands.values(), *spec.signals.values()]
        collectors = {id(source): _Collector(source, spec) for source in sources}
        for channel, message in _messages(data, EXPANSION * max_bytes):
            for collector in collectors.values():
                if collector.topic == channel.topic:
                    collector.add(channel, message)
            if sum(collector.count for collector in collectors.values()) > _MAX_NUMBERS:
                raise RecordingError(f"more than {_MAX_NUMBERS} numbers")
        return spec.recording(lambda source: collectors[id(source)].arrays(), Path(path).name, EXPANSION * max_bytes)


class _Collector:
    """The samples of one command or signal."""

    def __init__(self, source: Source, spec: FileMapping) -> None:
        self.topic = source.place.get("topic")
        if not isinstance(self.topic, str):
            raise RecordingError(f"topic is {ascii(self.topic)[:80]}; expected a text")
        self._fields = [_steps(text) for text in texts("fields", source.place.get("fields"))]
        clock = source.place.get("time", spec.time.get("source", "log_time"))
        if not isinstance(clock, str):
            raise RecordingError(f"time is {ascii(clock)[:80]}; expected log_time, publish_time or a field")
        self._clock = clock if clock in _CLOCKS else _steps(clock)
        self._to_seconds = spec.to_seconds()
        self._times, self._numbers = array("q"), array("d")  # lists would take four times the memory
        self._size = 0  # numbers in a sample
        self.count = 0

    def add(self, channel: "Channel", message: "Message") -> None:
        """Note a message of the topic."""
        if (encoding := channel.message_encoding) != "json":
            raise RecordingError(f"topic {self.topic} is encoded as {encoding[:40]!r}; only json is read")
        if len(message.data) > _MAX_MESSAGE:
            raise RecordingError(f"a message of {len(message.data)} bytes; at most {_MAX_MESSAGE} are read")
        content = json.loads(message.data)
        sample: list[float] = []
        for steps in self._fields:
            _flatten(_follow(content, steps), sample)
        if self._times and len(sample) != self._size:
            raise RecordingError(f"topic {self.topic}: {len(sample)} numbers follow {self._size}")
        self._size = len(sample)
        self._numbers.extend(sample)
        self._times.append(self._nanoseconds(content, message))
        self.count += len(sample) + 1

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """(T,) times [ns] in order and (T, k) numbers; of two samples of one time, the later in the file counts."""
        if not self._times:
            raise RecordingError(f"no messages of topic {self.topic}")
        # messages may lie in the file in another order than they were sent
        times, rows = np.unique(np.array(self._times)[::-1], return_index=True)
        return times, np.array(self._numbers).reshape(len(self._times), -1)[::-1][rows]

    def _nanoseconds(self, content: Any, message: "Message") -> int:
        if isinstance(self._clock, str):
            return getattr(message, self._clock)
        stamp = _follow(content, self._clock)
        if isinstance(stamp, dict) and "sec" in stamp:  # as in ROS
            parts = stamp["sec"], stamp.get("nanosec", stamp.get("nsec", 0))
            if any(type(part) is not int for part in parts):
                raise RecordingError(f"topic {self.topic}: time {ascii(stamp)[:80]} is not in whole numbers")
            return 1_000_000_000 * parts[0] + parts[1]
        if isinstance(stamp, bool) or not isinstance(stamp, (int, float)):
            raise RecordingError(f"topic {self.topic}: time {ascii(stamp)[:80]} is no number")
        return round(1e9 * self._to_seconds * stamp)


def _messages(data: bytes, budget: int) -> Iterator:
    """Channel and message of every message, in the order of the file."""
    try:
        from mcap.exceptions import McapError
        from mcap.records import Channel, Chunk, Message
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ImportError as error:
        raise ImportError("MCAP files need mcap: pip install soro_bench[mcap]") from error

    channels = {}
    reader = StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True, record_size_limit=_MAX_CHUNK)
    try:
        for outer in reader.records:
            records = [outer]
            if isinstance(outer, Chunk):
                budget -= outer.uncompressed_size
                if budget < 0 or outer.uncompressed_size > _MAX_CHUNK:
                    raise RecordingError("its chunks take more memory than its largest size allows")
                _decompress(outer)
                records = breakup_chunk(outer, validate_crc=True)
            for record in records:
                if isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    if record.channel_id not in channels:
                        raise RecordingError(f"a message of the unknown channel {record.channel_id}")
                    yield channels[record.channel_id], record
    except McapError as error:
        raise RecordingError(f"no complete MCAP file: {type(error).__name__} {error}") from error


def _decompress(chunk: "Chunk") -> None:
    """Decompress in place, to the size that the chunk declares and no further."""
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        import zstandard

        try:
            with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(chunk.data) as stream:
                chunk.data = stream.read(size + 1)
        except zstandard.ZstdError as error:
            raise RecordingError(f"a broken chunk: {error}") from error
    elif chunk.compression == "lz4":
        import lz4.frame

        try:
            chunk.data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        except RuntimeError as error:  # what lz4 raises
            raise RecordingError(f"a broken chunk: {error}") from error
    elif chunk.compression:
        raise RecordingError(f"compression {ascii(chunk.compression)[:40]} is unknown; there are zstd and lz4")
    if len(chunk.data) != size:
        raise RecordingError(f"a chunk has not the {size} bytes that it declares")
    chunk.compression = ""


def _steps(path: str) -> list[str | int]:
    """Keys and indices of a path such as "pose.position[2]"."""
    if not path or _STEP.sub("", path).strip("."):
        raise RecordingError(f"field {ascii(path)[:80]} is no path such as pose.position[2]")
    return [key or int(index) for key, index in _STEP.findall(path)]


def _follow(content: Any, steps: list[str | int]) -> Any:
    for step in steps:
        try:
            content = content[step]
        except (KeyError, IndexError, TypeError) as error:
            raise RecordingError(f"a message has no field {'.'.join(map(str, steps))[:80]}") from error
    return content


def _flatten(value: object, numbers: list[float]) -> None:
    """Append the numbers of a number or nested lists; null is a missing number."""
    if isinstance(value, list):
        for entry in value:
            _flatten(entry, numbers)
    elif value is None:
        numbers.append(np.nan)
    elif isinstance(value, (int, float)):
        numbers.append(float(value))
    else:
        raise RecordingError(f"{ascii(value)[:80]} is no number")
    if len(numbers) > MAX_SIZE:
        raise RecordingError(f"a sample has more than {MAX_SIZE} numbers")
