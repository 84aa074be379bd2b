"""Bags of ROS 2 (.mcap, .db3, folders) and ROS 1 (.bag), and MCAP files with JSON messages."""

from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from soro_bench.recording.importers.bags.collector import PLACE, Collector
from soro_bench.recording.importers.bags.files import messages
from soro_bench.recording.importers.bags.guess import guess
from soro_bench.recording.importers.bags.logs import Reading
from soro_bench.recording.importers.mapping import FileMapping, load_mapping
from soro_bench.recording.importers.source import Source
from soro_bench.recording.recording import ReadingProgress, Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, named_errors
from soro_bench.recording.untrusted import MAX_BYTES as MAX_MEMORY

__all__ = ["MAX_BYTES", "guess", "import_bag"]

MAX_BYTES = 2_000_000_000  # of all files of a bag, of which one chunk at a time is in memory
_MAX_NUMBERS = 50_000_000
_CHECKED = 1000  # messages, after which their numbers are counted


def import_bag(
    path: str | Path,
    mapping: str | Path | Mapping | None,
    max_bytes: int = MAX_BYTES,
    progress: ReadingProgress | None = None,
) -> Recording:
    """Read a bag with a mapping file; RecordingError says what is wrong with either.

    Only the topics that the mapping names are decoded, and one chunk of the file at a time is in memory.

    Args:
        path: .mcap, .db3 or .bag, each also packed as .zstd, or the folder of a bag with all its parts.
        max_bytes: largest size of all files of the bag; they may unpack to four times as much.
        progress: is told how much has been read.
    """
    path = Path(path)
    if mapping is None:
        raise RecordingError(f"{path}: a bag needs a mapping file; soro-bench import {path} --guess writes one")
    spec = load_mapping(mapping, PLACE, ("source", "unit"), ("definitions",))
    with named_errors(path):
        collectors = _collectors(spec)
        reading = _read(path, [*collectors.values()], max_bytes, progress)
        types = {channel.type for channel in reading.topics.values()}
        if unused := [name for name in spec.format.get("definitions", {}) if name not in types]:
            raise RecordingError(f"[format.definitions] {ascii(unused[0])[:80]} has no effect: no topic has that type")
        labels = {id(source): label for label, source in _sources(spec).items()}

        def samples(source: Source) -> tuple[np.ndarray, np.ndarray]:
            """(T,) times [ns] and (T, k) numbers of a command or signal."""
            label = labels[id(source)]
            return collectors[label].arrays(list(reading.topics), reading.notes, partial(spec.notes.add, label))

        for text in reading.notes:
            spec.notes.add(path.resolve().name, text)
        return spec.recording(samples, path.resolve().name, EXPANSION * MAX_MEMORY)


def _sources(spec: FileMapping) -> dict[str, Source]:
    """Commands and signals by what messages call them."""
    groups = {"commands": spec.commands, "signals": spec.signals}
    return {f"{group}.{name}": source for group in groups for name, source in groups[group].items()}


def _collectors(spec: FileMapping) -> dict[str, Collector]:
    """What gathers the samples of each command and signal."""
    definitions = spec.format.get("definitions", {})
    if not isinstance(definitions, dict) or not all(isinstance(text, str) for text in definitions.values()):
        raise RecordingError("[format.definitions] has texts of .msg files by type, such as "
                             '"my_robot/msg/Pressure" = "float64[] values"')  # fmt: skip
    found = {}
    for label, source in _sources(spec).items():
        try:
            found[label] = Collector(source, spec)
        except RecordingError as error:
            raise RecordingError(f"{label}: {error}") from error
    if "unit" in spec.time and not any(collector.has_unit for collector in found.values()):
        raise RecordingError("[time] unit has no effect: no time is the path of a number")
    if "source" in spec.time and all("time" in source.place for source in _sources(spec).values()):
        raise RecordingError("[time] source has no effect: every command and signal has a time of its own")
    return found


def _read(path: Path, collectors: list[Collector], max_bytes: int, progress: ReadingProgress | None) -> Reading:
    """Give the messages of a bag to the collectors of their topics."""
    by_topic: dict[str, list[Collector]] = defaultdict(list)
    for collector in collectors:
        by_topic[collector.topic].append(collector)
    reading = Reading(lambda channel: channel.topic in by_topic, EXPANSION * max_bytes, progress=progress)
    for i, (channel, received, published, data) in enumerate(messages(path, max_bytes, reading)):
        for collector in by_topic[channel.topic]:
            collector.add(channel, received, published, data)
        if i % _CHECKED == 0 and sum(collector.count for collector in collectors) > _MAX_NUMBERS:
            raise RecordingError(f"more than {_MAX_NUMBERS} numbers: leave out signals, or import a part of the bag")
    return reading
