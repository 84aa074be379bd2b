"""Where the files of `assets` are; writing files so that nobody sees half of one; reading them whatever they hold."""

import hashlib
import json
import math
import os
import platform
import re
import reprlib
import secrets
import stat
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parent
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
_TEMPORARY = re.compile(r"\..+\.([0-9a-f]{8})-(\d+)-[0-9a-f]{8}\.part")  # host and process of what is being written
_SHOWN = 64  # bytes of a name in that of its temporary file
_WRITING, _FORGOTTEN = 60.0, 86400.0  # s since the last change: a file may be written to, none is any more


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that becomes ``path`` when the block ends, and vanishes if it fails.

    Those of killed processes in the same folder are removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep(path.parent)
    begin = os.fsencode(path.name)[:_SHOWN].decode(errors="ignore")  # the whole one and the rest may be too long
    temporary = path.with_name(f".{begin}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.part")
    temporary.touch(exist_ok=False)  # with the permissions that the user's umask gives, unlike those of tempfile
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """Whether a file is one of :func:`replacing`, by its name: no result."""
    return _TEMPORARY.fullmatch(path.name) is not None


def sweep(folder: Path) -> None:
    """Remove the temporary files of :func:`replacing` that no process writes any more: those of this machine's dead
    processes after a minute, those of other machines after a day."""
    for path in folder.glob(".*.part"):
        if (match := _TEMPORARY.fullmatch(path.name)) is None:
            continue
        with suppress(OSError):  # somebody else has removed it
            age = time.time() - path.stat().st_mtime
            if age > _FORGOTTEN or (age > _WRITING and match[1] == _HOST and not _lives(int(match[2]))):
                path.unlink()


def _lives(process: int) -> bool:
    """Whether a process of this machine runs; True where that cannot be asked without harm."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's
        return True
    return True


def shown(text: str) -> str:
    """One line, in which what cannot be shown is escaped: it may be from a stranger's file."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def brief(value: object) -> str:
    """A value for a message, cut to a sensible length."""
    text = ascii(value)
    return text if len(text) <= 80 else text[:77] + "..."


def toml(value: object) -> str:
    """A text, number, truth value or list as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml, value))}]"
    if not isinstance(value, str):
        return repr(value)
    letters = ("\\t" if c == "\t" else c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
    return f'"{"".join(letters)}"'


def check_output(path: Path, suffix: str) -> None:
    """ValueError if a file could not be written after all the work that goes before, or has another suffix: it would
    take the place of something else."""
    if path.suffix != suffix:
        raise ValueError(f"{path}: expected a name that ends in {suffix}")
    check_folder(path.parent, [path.name])


def check_folder(folder: Path, names: Iterable[str] = ()) -> None:
    """ValueError if files of these names could not be written into a folder, which need not exist, after all the work
    that goes before. Leaves nothing behind."""
    names = tuple(names)
    for path in (folder, *(folder / name for name in names)):
        try:
            str(path).encode()
        except UnicodeEncodeError as error:
            raise ValueError(f"{str(path)!a}: expected a name in UTF-8") from error
    absolute = folder.absolute()
    nearest = next(each for each in (absolute, *absolute.parents) if os.path.lexists(each))
    try:
        if os.name == "posix":
            _check_lengths(nearest, [*absolute.relative_to(nearest).parts, *names])
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        said = f"{nearest} is no folder, or one that may not be written to ({error.strerror})"
        raise ValueError(f"{folder} cannot be written to: {said}") from error
    for name in names:
        if (folder / name).is_dir():
            raise ValueError(f"{folder / name} is a folder; the name of a file is needed")


def _check_lengths(existing: Path, names: Iterable[str]) -> None:
    """ValueError for a name that is longer than the file system of a folder allows."""
    allowed = os.pathconf(existing, "PC_NAME_MAX")
    for name in names:
        if (length := len(os.fsencode(name))) > allowed:
            raise ValueError(f"the name {brief(name)} has {length} bytes; {existing} allows at most {allowed}")


@contextmanager
def results_folder(path: Path, names: Iterable[str] = ()) -> Iterator[None]:
    """A folder that can be written to, as files of these names, and that is gone again if nothing was written into it.

    Raises:
        ValueError: before the block begins, see :func:`check_folder`.
    """
    check_folder(path, names)
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


_KEY_PARTS = 8
_LONG_KEY = re.compile(rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_KEY_PARTS}}}""")


def read_toml(path: str | Path, max_bytes: int = 1_000_000) -> dict[str, Any]:
    """Read a TOML file of at most ``max_bytes``; ValueError says what is wrong with it."""
    data = read_bytes(path, max_bytes)
    try:
        return parsed_toml(data.decode())
    except (ValueError, RecursionError) as error:  # text of another encoding, no TOML, tables in tables without end
        raise ValueError(f"{path} is no TOML file: {error}") from error


def parsed_toml(text: str) -> dict[str, Any]:
    """What TOML says; ValueError for what it is not, and for keys of more than 8 parts, such as a.b.c has three: what
    they take grows with the square of that number."""
    if found := _LONG_KEY.search(text):
        raise ValueError(f"the key {found[0][:18]}... has too many parts; at most {_KEY_PARTS} are read")
    return tomllib.loads(text)


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


def asset_path(name: str) -> Path:
    """Path of ``assets/<name>``: beside the package in a checkout, inside it in a wheel."""
    for root in (_PACKAGE / "assets", _PACKAGE.parent / "assets"):
        if (path := root / name).exists():
            return path
    raise FileNotFoundError(f"no asset {name!r} in soro_bench's assets")


def mjcf_path(name: str) -> Path:
    """Path of ``assets/mjcf/<name>``."""
    return asset_path(f"mjcf/{name}")
