"""Recordings of real robots: where they are published, and how to get them unchanged."""

import csv
import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path, PurePosixPath
from urllib.parse import quote
from urllib.request import urlopen

from soro_bench.files import mjcf_path, read_toml, replacing

_COLUMNS = {  # of the table: field of the log, and decimals
    "t_s": ("timestamp", 6),
    "goal_rad": ("goal_position", 6),
    "pos_rad": ("position", 6),
    "speed_rad_s": ("speed", 6),
    "load": ("load", 3),
    "volts": ("input_volts", 3),
    "temp_C": ("temp", 1),
    "torque_enable": ("torque_enable", None),
}


def bam_table(log: bytes) -> bytes:
    """The CSV table of a JSON log of a servo, as Rhoban/bam publishes them; ValueError if it is none."""
    try:
        entries = json.loads(log)["entries"]
        rows = [[round(entry[field], digits) for field, digits in _COLUMNS.values()] for entry in entries]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"no log of a servo ({error!r})") from error
    text = io.StringIO(newline="")
    csv.writer(text).writerows([_COLUMNS, *rows])
    return text.getvalue().encode()


MAX_BYTES = 10_000_000  # of an original
_TIMEOUT = 30.0  # s
_CONVERSIONS = {(".json", ".csv"): bam_table}


@dataclass(frozen=True)
class PublishedFile:
    """A recording.

    sha256: of the file as we use it. original: its path in the repository; empty where that is not known.
    """

    name: str
    sha256: str
    original: str = ""

    @property
    def conversion(self) -> Callable[[bytes], bytes] | None:
        """What makes the file from its original; None if it is not fetched by this command."""
        types = PurePosixPath(self.original).suffix, PurePosixPath(self.name).suffix
        return bytes if types[0] == types[1] else _CONVERSIONS.get(types)

    def checksum(self, folder: Path) -> str | None:
        """SHA-256 of the file in a folder; None if it is not there."""
        try:
            with (folder / self.name).open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            return None


@dataclass(frozen=True)
class Source:
    """Where the recordings of a robot are published.

    by_hand: what to know of files that cannot be fetched.
    """

    robot: str
    repository: str
    commit: str
    licence: str
    files: tuple[PublishedFile, ...]
    by_hand: str = ""

    @property
    def page(self) -> str:
        """The repository at the commit, for a browser."""
        return f"{self.repository}/tree/{self.commit}"

    def address(self, file: PublishedFile) -> str:
        """Of the original of a file."""
        raw = self.repository.replace("https://github.com/", "https://raw.githubusercontent.com/")
        return f"{raw}/{self.commit}/{quote(file.original)}"


def sources() -> dict[str, Source]:
    """All robots by name."""
    table = read_toml(mjcf_path("real/sources.toml"))
    for entry in table.values():
        entry["files"] = tuple(PublishedFile(name, **keys) for name, keys in entry["files"].items())
    return {name: Source(**entry) for name, entry in table.items()}


def summary(name: str, source: Source, folder: Path) -> str:
    """Some lines about a robot, and which of its files are in a folder."""
    found = [(file.name, file.sha256, file.checksum(folder)) for file in source.files]
    good = sum(expected == checksum for _, expected, checksum in found)
    other = [file for file, expected, checksum in found if checksum not in (expected, None)]
    by_hand = sum(file.conversion is None for file in source.files)
    lines = [f"{name}: {source.robot}; {source.licence}", f"    {source.page}"]
    lines.append(f"    {folder}: {good} of {len(found)} files" + (f"; {by_hand} not fetched" if by_hand else ""))
    return "\n".join(lines + [f"    {file} has another checksum" for file in other])


def fetch(source: Source, folder: Path) -> None:
    """Get the files that are not yet in a folder. ValueError: what is wrong with one, or how to get it."""
    missing = []
    for file in source.files:
        found, convert = file.checksum(folder), file.conversion
        if found is None and convert is None:
            missing.append(file)
        elif found is None and convert is not None:
            _fetch_file(source, file, convert, folder)
        elif found is not None and found != file.sha256:
            raise ValueError(_wrong(folder / file.name, file, found) + "; move it away to get it again")
    if missing:
        raise ValueError(_by_hand(source, missing, folder))


def _fetch_file(source: Source, file: PublishedFile, convert: Callable[[bytes], bytes], folder: Path) -> None:
    address = source.address(file)
    original = _download(address)
    try:
        data = convert(original)
    except ValueError as error:
        raise ValueError(f"{address}: {error}") from error
    found = hashlib.sha256(data).hexdigest()
    if found != file.sha256:
        raise ValueError(_wrong(folder / file.name, file, found) + f", made from {address}; it is not kept")
    with replacing(folder / file.name) as temporary:
        temporary.write_bytes(data)


def _download(address: str) -> bytes:
    try:
        with urlopen(address, timeout=_TIMEOUT) as response:
            if not response.url.startswith("https://"):
                raise OSError(f"leads to {response.url}, which is not https")
            data = response.read(MAX_BYTES + 1)
    except (OSError, HTTPException) as error:
        raise OSError(f"{address}: {error}") from error
    if len(data) > MAX_BYTES:
        raise ValueError(f"{address} has more than {MAX_BYTES} bytes")
    return data


def _wrong(path: Path, file: PublishedFile, found: str) -> str:
    return f"{path}: SHA-256 is {found}, expected {file.sha256}"


def _by_hand(source: Source, files: list[PublishedFile], folder: Path) -> str:
    lines = [
        f"make these files from their originals and put them into {folder}; see {source.page}",
        source.by_hand,
    ]
    return "\n".join(lines + [f"{file.name}  {file.original and 'from ' + file.original}".rstrip() for file in files])
