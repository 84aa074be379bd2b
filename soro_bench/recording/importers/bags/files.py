"""The files of a bag: one file, or a folder with the parts of one, packed or not."""

import re
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from soro_bench.errors import one_line
from soro_bench.recording.importers.bags.database import database_messages
from soro_bench.recording.importers.bags.fields import listed
from soro_bench.recording.importers.bags.logs import (
    MAX_MESSAGE,
    WINDOW,
    ZSTD,
    Damaged,
    Message,
    Reading,
    decompressed,
    mcap_messages,
    ros1_messages,
)
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import named_errors, read_bytes

SUFFIXES = (".mcap", ".db3", ".bag")
PACKED = (".zstd", ".zst")
ACTIVE = ".active"  # behind the name of a bag of ROS 1 that is being written
METADATA = "metadata.yaml"
MAX_FILES = 1000
_MAX_METADATA = 2_000_000  # bytes
_PART = re.compile(r"_\d{1,6}$")
_BLOCK = 1_000_000  # bytes that are unpacked together


def is_bag(path: Path) -> bool:
    """Whether a file or folder looks like a bag."""
    if path.is_dir():
        return (path / METADATA).is_file() or bool(_inside(path))
    return bool(_kind(path))


def files_of(path: Path, notes: list[str]) -> list[Path]:
    """The files of a bag in their order; RecordingError if some are missing, or they are of several bags."""
    if not path.is_dir():
        if path.name.lower().endswith(ACTIVE):
            notes.append("is of a recorder that was killed; what is there is read")
        return [path]
    there = _inside(path)
    if not (path / METADATA).is_file() or not (path / METADATA).stat().st_size:
        stems = {_PART.sub("", _stem(file)) for file in there}
        if len(stems) != 1:
            raise RecordingError(f"no {METADATA}, and files of {len(stems)} bags: {_names(there)}; import one of them")
        notes.append(f"{METADATA} is missing or empty (recorder killed?); {len(there)} files are read")
        return there
    files = [_present(path, name) for name in _listed(path / METADATA)]
    if others := [file for file in there if file not in files]:
        notes.append(f"{METADATA} does not name {_names(others)}; not read")
    return files


def messages(path: Path, max_bytes: int, reading: Reading) -> Iterator[Message]:
    """The messages of a bag, in the order of its files; RecordingError if these are too large or damaged."""
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there")
    files = files_of(path, reading.notes)
    for file in files:
        if not file.is_file() or not _kind(file):
            raise RecordingError(f"{file.name} is no file {', '.join(SUFFIXES)}")
    reading.total = sum(file.stat().st_size for file in files)
    if reading.total > max_bytes:
        raise RecordingError(
            f"has {reading.total} bytes; at most {max_bytes} are read: keep the topics that are needed, with "
            "ros2 bag convert or mcap filter"
        )
    for file in files:
        with named_errors(file.name) if len(files) > 1 else nullcontext(), _unpacked(file, reading) as plain:
            reading.scale = file.stat().st_size / max(plain.stat().st_size, 1)
            for channel, received, published, data in _plain_messages(plain, reading):
                if channel.encoding == "cdr" and data.startswith(ZSTD):  # CDR itself begins with 0
                    data = decompressed(data, "zstd", MAX_MESSAGE + 1)
                    reading.spend(len(data))
                yield channel, received, published, data
        reading.before += file.stat().st_size
        reading.at(0)


def _plain_messages(file: Path, reading: Reading) -> Iterator[Message]:
    if _kind(file) == ".db3":
        yield from database_messages(file, reading)
        return
    last = None
    try:
        with open(file, "rb") as opened:
            for message in (ros1_messages if _kind(file) == ".bag" else mcap_messages)(opened, reading):
                if last:
                    yield last
                last = message
    except (Damaged, struct.error, KeyError) as error:
        return reading.cut(f"or damaged ({one_line(error)[:200]})")  # and of the last message the end may be missing
    if last:
        yield last


@contextmanager
def _unpacked(file: Path, reading: Reading) -> Iterator[Path]:
    """The file, or a temporary one with what is packed in it."""
    if file.suffix.lower() not in PACKED:
        yield file
        return
    import zstandard

    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, _stem(file) + _kind(file))
        with open(file, "rb") as packed, open(plain, "wb") as out:
            try:
                stream = zstandard.ZstdDecompressor(max_window_size=WINDOW).stream_reader(packed)
                while block := stream.read(_BLOCK):
                    reading.spend(len(block))
                    out.write(block)
            except zstandard.ZstdError as error:
                raise RecordingError(f"is no file packed with zstd, or damaged: {one_line(error)[:200]}") from error
        yield plain


def _inside(folder: Path) -> list[Path]:
    """The files of bags in a folder, part 2 before part 10."""
    found = [file for file in folder.iterdir() if _kind(file) and file.is_file()]
    if len(found) > MAX_FILES:
        raise RecordingError(f"{len(found)} files; at most {MAX_FILES} are read")

    def place(file: Path) -> tuple[str, int, str]:
        part = _PART.search(_stem(file))
        return _PART.sub("", _stem(file)), int(part[0][1:]) if part else -1, file.name

    return sorted(found, key=place)


def _kind(path: Path) -> str:
    """The suffix of a bag, without that of what it is packed with; "" if it is none."""
    name = path.name.lower()
    for suffix in (*PACKED, ACTIVE):
        name = name.removesuffix(suffix)
    return next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")


def _stem(file: Path) -> str:
    """The name of a bag without its suffixes."""
    return re.sub(
        rf"({'|'.join(map(re.escape, SUFFIXES))})({'|'.join(map(re.escape, PACKED))})?$", "", file.name, flags=re.I
    )


def _names(files: list[Path]) -> str:
    return listed([file.name for file in files])


def _listed(metadata: Path) -> list[str]:
    """The names of the files that the description of a bag has."""
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError as error:
        raise ImportError("folders of ROS 2 bags need ruamel.yaml: pip install soro_bench[ros]") from error
    try:
        content: Any = YAML(typ="safe", pure=True).load(read_bytes(metadata, _MAX_METADATA).decode())
    except (YAMLError, ValueError) as error:
        raise RecordingError(f"{METADATA} cannot be read: {one_line(error)[:200]}") from error
    about = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    if not isinstance(names, list) or not 0 < len(names) <= MAX_FILES or not all(isinstance(n, str) for n in names):
        raise RecordingError(f"{METADATA} has no list relative_file_paths of 1 to {MAX_FILES} files")
    return names


def _present(folder: Path, name: str) -> Path:
    """A file of a bag; older bags name the folder too, and a file may have been packed or unpacked since."""
    plain = Path(name.replace("\\", "/")).name
    base = plain.removesuffix(".zstd").removesuffix(".zst")
    for candidate in (plain, base, f"{base}.zstd", f"{base}.zst"):
        if _kind(Path(candidate)) and (folder / candidate).is_file():
            return folder / candidate
    raise RecordingError(f"the bag is not complete: {METADATA} names {ascii(name)[:80]}, which is not there")
