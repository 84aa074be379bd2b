"""Writing files so that nobody ever sees half of one, and reading them whatever they hold."""

import json
import math
import os
import reprlib
import secrets
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that becomes ``path`` when the block ends, and vanishes if it fails."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    temporary.touch(exist_ok=False)  # with the permissions that the user's umask gives, unlike those of tempfile
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def shown(text: str) -> str:
    """One line, in which what cannot be shown is escaped: it may be from a stranger's file."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def brief(value: object) -> str:
    """A value for a message, cut to a sensible length."""
    text = ascii(value)
    return text if len(text) <= 80 else text[:77] + "..."


def check_output(path: Path, suffix: str) -> None:
    """ValueError if a file could not be written after all the work that goes before, or has another suffix: it would
    take the place of something else."""
    if path.suffix != suffix:
        raise ValueError(f"{path}: expected a name that ends in {suffix}")
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"{str(path)!a}: expected a name in UTF-8") from error
    if path.is_dir():
        raise ValueError(f"{path} is a folder; the name of a file is needed")
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise ValueError(f"{path} cannot be written: {parent} is no folder, or one that may not be written to")


@contextmanager
def results_folder(path: Path) -> Iterator[None]:
    """A folder that can be written to, and that is gone again if nothing was written into it."""
    new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if new and not any(path.iterdir()):
            path.rmdir()


def write_json(path: str | Path, data: Any) -> None:
    """Write ``data`` as indented JSON; NaN and infinity are refused."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    with replacing(path) as temporary:
        temporary.write_text(text)


def read_bytes(path: str | Path, max_bytes: int, links: bool = True) -> bytes:
    """The content of a regular file of at most ``max_bytes``, which may be a link; ValueError for anything else."""
    if not links and Path(path).is_symlink():
        raise ValueError(f"{path} is a link; a regular file is needed")
    # without waiting for a writer, if it is a pipe, and without following a link that has just come
    names = ("O_NONBLOCK", "O_BINARY", *([] if links else ["O_NOFOLLOW"]))
    handle = os.open(path, os.O_RDONLY | sum(getattr(os, name, 0) for name in names))
    try:
        if not stat.S_ISREG((found := os.fstat(handle)).st_mode):
            raise ValueError(f"{path} is no regular file")
        if found.st_size > max_bytes:
            raise ValueError(f"{path} has {found.st_size} bytes; at most {max_bytes} are read")
        with open(handle, "rb", closefd=False) as file:
            return file.read(max_bytes)
    finally:
        os.close(handle)


def read_json(path: str | Path, max_bytes: int = 10_000_000) -> Any:
    """Read a JSON file of at most ``max_bytes``; ValueError says what is wrong with it."""
    data = read_bytes(path, max_bytes)
    try:
        return parsed_json(data)
    except (ValueError, RecursionError) as error:  # text of another encoding, no JSON, a number of too many digits
        raise ValueError(f"{path} is no JSON file: {error}") from error


def parsed_json(data: bytes | str, max_digits: int = 300) -> Any:
    """What JSON says; ValueError for NaN, infinity, longer integers and a name that comes twice in an object."""

    def integer(text: str) -> int:
        if len(text) > max_digits:
            raise ValueError(f"the integer {text[:18]}... is too large; at most {max_digits} digits are read")
        return int(text)

    return json.loads(data, object_pairs_hook=_object, parse_constant=_finite, parse_float=_finite, parse_int=integer)


def _object(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        name, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the name {reprlib.repr(name)} comes twice")
    return found


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text[:80]} is no finite number")
    return number
