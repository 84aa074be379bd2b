"""The files of LeRobot datasets of versions 2.0, 2.1 and 3: what they are about, and the rows of one episode.

Sources: lerobot's modules datasets/utils.py and scripts/convert_dataset_v21_to_v30.py, which name files and columns.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from soro_bench.recording.bounded_parquet import BoundedParquet
from soro_bench.recording.recording import RecordingError
from soro_bench.recording.untrusted import named_errors, read_bytes

EPISODE, TIME = "episode_index", "timestamp"
NUMBERS = ("float16", "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool")
_VERSION = re.compile(r"v(\d)\.\d{1,3}")
_MAX_FILES, _MAX_INFO_BYTES, _MAX_LINES_BYTES = 10_000, 10_000_000, 50_000_000
_MAX_FOOTER = 4_000_000  # bytes: a row group per episode takes some 800
_LENGTH, _CHUNK, _FILE = "length", "data/chunk_index", "data/file_index"


@dataclass(frozen=True)
class Dataset:
    """A dataset in a folder, and what its meta/info.json says."""

    folder: Path
    major: int  # version
    features: dict[str, dict[str, Any]]
    fps: float | None
    robot: str
    episodes: int | None

    def names(self, column: str) -> list[str]:
        """Of the numbers of a feature, one after the other; RecordingError if there are none."""
        names = _texts(self.features.get(column, {}).get("names"))
        shape = self.features.get(column, {}).get("shape")
        if not names:
            raise RecordingError(f"meta/info.json has no names of {ascii(column)[:60]}; choose by indices instead")
        if isinstance(shape, list) and len(shape) == 1 and shape[0] != len(names):
            raise RecordingError(
                f"meta/info.json has {len(names)} names of {ascii(column)[:60]}, whose shape is {shape}; correct one"
            )
        return names

    def rows(self, episode: int, columns: Sequence[str], max_bytes: int) -> pa.Table:
        """All rows of an episode, which may lie in several files; RecordingError if there are none, or not all."""
        if self.episodes is not None and episode >= self.episodes:
            raise RecordingError(f"there is no episode {episode}; there are {self.episodes}, counted from 0")
        length, first = self._declared(episode, max_bytes)
        parts: list[pa.Table] = []
        for file in self._files(episode, first):
            with named_errors(file):
                parquet = BoundedParquet(read_bytes(_inside(self.folder, file), max_bytes), max_bytes, _MAX_FOOTER)
                found, beyond = _part(parquet, episode, columns)
            parts += found
            if (length is not None and sum(len(part) for part in parts) >= length) or (beyond and parts):
                break
        if not parts:
            raise RecordingError(f"there is no episode {episode} in the files of data/")
        table = pa.concat_tables(parts)
        if length is not None and len(table) != length:
            raise RecordingError(f"episode {episode} has {len(table)} of {length} rows; download all files of data/")
        return table

    def _files(self, episode: int, first: str) -> list[Path]:
        """Data files in which an episode may be, from a first one on: where the format has them, as a pattern in
        info.json could lead anywhere."""
        pattern, other = "file-*", "episode_*"
        if self.major == 2:
            pattern, other = other, pattern
        files = sorted((self.folder / "data").glob(f"chunk-*/{pattern}.parquet"))[: _MAX_FILES + 1]
        if not files and any((self.folder / "data").glob(f"chunk-*/{other}.parquet")):
            raise RecordingError(f"meta/info.json says version {self.major}, and data/ has files {other}.parquet; "
                                 "correct codebase_version")  # fmt: skip
        if not 1 <= len(files) <= _MAX_FILES:
            raise RecordingError(f"has {len(files)} files data/chunk-*/{pattern}.parquet; expected 1 to {_MAX_FILES}")
        if self.major == 2:
            return [file for file in files if file.stem == f"episode_{episode:06d}"]
        return [file for file in files if f"{file.parent.name}/{file.stem}" >= first]

    def _declared(self, episode: int, max_bytes: int) -> tuple[int | None, str]:
        """How many rows an episode has, and in which file it begins, if meta/ says it; else None and ""."""
        if self.major == 2:
            lines = self.folder / "meta" / "episodes.jsonl"
            if not lines.is_file():
                return None, ""
            with named_errors(lines):
                return _length_in_lines(read_bytes(_inside(self.folder, lines), _MAX_LINES_BYTES), episode), ""
        for file in sorted((self.folder / "meta" / "episodes").glob("chunk-*/file-*.parquet"))[:_MAX_FILES]:
            with named_errors(file):
                parquet = BoundedParquet(read_bytes(_inside(self.folder, file), max_bytes), max_bytes, _MAX_FOOTER)
                table = parquet.read([EPISODE, _LENGTH, _CHUNK, _FILE])
                found = table.filter(pc.equal(table.column(EPISODE), episode)).to_pylist()
            if found:
                chunk, number = int(found[0][_CHUNK]), int(found[0][_FILE])
                return int(found[0][_LENGTH]), f"chunk-{chunk:03d}/file-{number:03d}"
        return None, ""


def opened(folder: Path) -> Dataset:
    """The dataset in a folder; RecordingError names what is missing or wrong in its meta/info.json."""
    file = folder / "meta" / "info.json"
    if not file.is_file():
        raise RecordingError("there is no meta/info.json; expected the folder of a LeRobot dataset")
    info = json.loads(read_bytes(_inside(folder, file), _MAX_INFO_BYTES))
    if not isinstance(info, dict):
        raise RecordingError("meta/info.json is no JSON object; expected that of a LeRobot dataset")
    said = info.get("codebase_version")
    version = _VERSION.fullmatch(said[:20]) if isinstance(said, str) else None
    if version is None or version[1] not in "23":
        found = "no codebase_version" if said is None else f"codebase_version = {ascii(said)[:40]}"
        raise RecordingError(f'meta/info.json has {found}; "v2.0", "v2.1" and "v3.0" are read: convert it with lerobot')
    features = info.get("features")
    if not isinstance(features, dict):
        raise RecordingError("meta/info.json has no features by name, each with dtype, shape and names")
    features = {name: feature for name, feature in features.items() if isinstance(feature, dict)}
    fps, count = info.get("fps"), info.get("total_episodes")
    if fps is not None and (type(fps) not in (int, float) or not 0 < fps < 1e6):
        raise RecordingError(f"meta/info.json has fps = {ascii(fps)[:40]}; expected frames per second")
    if count is not None and (type(count) is not int or count < 1):
        raise RecordingError(f"meta/info.json has total_episodes = {ascii(count)[:40]}; expected how many there are")
    robot = str(info.get("robot_type") or "")[:100]
    return Dataset(folder, int(version[1]), features, None if fps is None else float(fps), robot, count)


def _inside(folder: Path, file: Path) -> Path:
    """The file, if it lies in the folder and no link leads out of it, but to where Hugging Face's cache, with folders
    snapshots/<version>, keeps all files: blobs."""
    dataset, target = folder.resolve(), file.resolve()
    allowed = [dataset, *([dataset.parents[1] / "blobs"] if dataset.parent.name == "snapshots" else [])]
    if not any(target.is_relative_to(place) for place in allowed):
        raise RecordingError(f"{file} leads out of the dataset")
    return file


def _texts(names: Any) -> list[str]:
    """The names in a list, also where it is below a name of its own, as in {"motors": [...]}, or none."""
    if isinstance(names, dict) and all(type(place) is int for place in names.values()):
        return [str(name) for name, _ in sorted(names.items(), key=lambda entry: entry[1])]
    if isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    return [str(name) for name in names] if isinstance(names, list) else []


def _part(file: BoundedParquet, episode: int, columns: Sequence[str]) -> tuple[list[pa.Table], bool]:
    """The rows of an episode in each row group of a file, and whether the file goes on to later episodes."""
    parts, beyond = [], False
    for group in range(file.num_row_groups):
        found = file.read([EPISODE], [group]).column(EPISODE)
        rows = pc.equal(found, episode)
        beyond |= bool(pc.any(pc.greater(found, episode)).as_py())
        if pc.any(rows).as_py():
            parts.append(file.read(list(columns), [group]).filter(rows))
        elif beyond:
            break
    return parts, beyond


def _length_in_lines(data: bytes, episode: int) -> int | None:
    """The length of an episode in lines of JSON."""
    for entry in _entries(data):
        if entry.get(EPISODE) == episode:
            length = entry.get(_LENGTH)
            if type(length) is not int:
                raise RecordingError(f"episode {episode} has length {ascii(length)[:40]}; expected its number of rows")
            return length
    return None


def _entries(data: bytes) -> Iterator[dict[str, Any]]:
    for line in data.splitlines():
        entry = json.loads(line) if line.strip() else {}
        if isinstance(entry, dict):
            yield entry
