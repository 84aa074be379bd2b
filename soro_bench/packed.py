"""A folder of small files as one archive beside it: the files of ``oracle/`` may be in ``oracle.zip`` instead.

A path such as ``ppo/oracle/seed0.json`` then stands for the member ``seed0.json`` of ``ppo/oracle.zip``, or for the
member ``oracle/seed0.json`` of ``ppo.zip``. Files in the folder come before members, and the nearer archive before the
other. Archives may be from strangers: they are one folder deep at most, and their sizes are bounded.
"""

import errno
import io
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from soro_bench.files import brief, is_temporary, read_bytes, replacing

SUFFIX = ".zip"
MAX_BYTES = 20_000_000  # of an archive
_NAME = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]{0,80}/)?[A-Za-z0-9][A-Za-z0-9._-]{0,80}")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_BROKEN = (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, LookupError, OverflowError, ValueError,
           struct.error, zlib.error)  # fmt: skip
_TIME = (1980, 1, 1, 0, 0, 0)  # of all members, so that the same files give the same archive


def archive_of(folder: str | Path) -> Path:
    """The archive that may stand for a folder."""
    folder = Path(folder) if Path(folder).name else Path(folder).absolute()
    return folder.parent / f"{folder.name}{SUFFIX}"


def folder_of(archive: str | Path) -> Path:
    """The folder that an archive stands for."""
    return Path(archive).with_name(Path(archive).name.removesuffix(SUFFIX))


def names(folder: str | Path) -> list[str]:
    """Names of the files in a folder and in archives of it, sorted; ValueError if such an archive is none."""
    folder = Path(folder)
    files = [path for path in folder.iterdir() if not path.is_dir()] if folder.is_dir() else []
    found = {path.name for path in files if not is_temporary(path)}
    for archive, prefix in _archives(folder):
        members = (name.removeprefix(prefix) for name in _members(archive)[1] if name.startswith(prefix))
        found |= {name for name in members if "/" not in name}
    return sorted(found)


def folders(archive: str | Path) -> list[Path]:
    """The folders whose files are in an archive, sorted: the one it stands for, and those in it."""
    folder = folder_of(archive)
    return sorted({(folder / name).parent for name in _members(Path(archive))[1]})


def is_there(path: str | Path) -> bool:
    """Whether a file is in its folder or in an archive of it."""
    path = Path(path)
    return path.exists() or path.name in names(path.parent)


def places(path: str | Path) -> list[Path]:
    """Where the content of a file may be: itself, whether it is there or not, and the archives of its folder."""
    return [Path(path), *(archive for archive, _ in _archives(Path(path).parent))]


def read(path: str | Path, max_bytes: int) -> bytes:
    """The content of a regular file, no link, of at most ``max_bytes``, in its folder or in an archive of it.

    Raises:
        ValueError: the file, or the archive, is not what is allowed.
        FileNotFoundError: it is in neither of them.
    """
    return next(contents(path, max_bytes))


def contents(path: str | Path, max_bytes: int) -> Iterator[bytes]:
    """What a file holds in its folder and in each archive of it; :func:`read` gives the first, and raises the same."""
    path = Path(path)
    archives, missing = _archives(path.parent), True
    if os.path.lexists(path) or not archives:
        missing = False
        yield read_bytes(path, max_bytes, links=False)
    for archive, prefix in archives:
        opened, members = _members(archive)
        if (member := members.get(prefix + path.name)) is not None:
            missing = False
            yield _content(path, archive, opened, member, max_bytes)
    if missing:
        said = " nor in ".join(str(archive) for archive, _ in archives)
        raise FileNotFoundError(errno.ENOENT, f"neither a file nor in {said}", str(path))


def _content(path: Path, archive: Path, opened: zipfile.ZipFile, member: zipfile.ZipInfo, max_bytes: int) -> bytes:
    """The bytes of a member."""
    if member.file_size > max_bytes:
        raise ValueError(f"{path}, in {archive}, has {member.file_size} bytes; at most {max_bytes} are read")
    try:
        with opened.open(member) as file:
            data = file.read(max_bytes + 1)
    except _BROKEN as error:
        raise _broken(archive, error) from error
    if len(data) != member.file_size:
        raise ValueError(f"{path}, in {archive}, has not the {member.file_size} bytes that the archive says")
    return data


def pack(folder: str | Path, chosen: Mapping[str, bytes]) -> Path:
    """Put the chosen names with their content into the archive of a folder, and remove files of these names from the
    folder, or from folders in it; returns the archive.

    Members that the archive has stay there, unless they have a chosen name. Folders go if they are empty then.
    """
    folder, archive = Path(folder), archive_of(folder)
    if archive.is_dir():
        raise ValueError(f"{archive} is a folder; the archive of {folder} cannot be written")
    kept = set(_members(archive)[1]) if archive.is_file() else set()
    with replacing(archive) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
            for name in sorted(kept.union(chosen)):
                member = zipfile.ZipInfo(name, _TIME)
                member.compress_type, member.create_system, member.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
                file.writestr(member, chosen[name] if name in chosen else read(folder / name, MAX_BYTES))
        try:
            _members(temporary)  # refuses what could not be read again
        except ValueError as error:
            raise ValueError(str(error).replace(str(temporary), str(archive))) from error
    for name in chosen:
        (folder / name).unlink(missing_ok=True)
    for emptied in sorted({(folder / name).parent for name in chosen} | {folder}, reverse=True):
        if emptied.is_dir() and not any(emptied.iterdir()):
            emptied.rmdir()
    return archive


def _archives(folder: Path) -> list[tuple[Path, str]]:
    """The archives that may have files of a folder, the nearer first, and how names of its members begin there."""
    folder = folder if folder.name else folder.absolute()
    found = [(archive_of(folder), "")]
    if folder.parent.name or not folder.is_absolute():
        found.append((archive_of(folder.parent), f"{folder.name}/"))
    return [(archive, prefix) for archive, prefix in found if archive.is_file()]


def _members(archive: Path) -> tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]:
    """An archive, and its members by name; ValueError unless they are plain files that come once."""
    data = read_bytes(archive, MAX_BYTES, links=False)
    try:
        opened = zipfile.ZipFile(io.BytesIO(data))
    except _BROKEN as error:
        raise _broken(archive, error) from error
    members = {}
    for member in opened.infolist():
        if not _NAME.fullmatch(member.filename):
            raise ValueError(f"{archive} has the member {brief(member.filename)}; allowed: up to 81 letters, digits "
                             "and ._-, a letter or digit first, in one folder at most")  # fmt: skip
        if member.filename in members:
            raise ValueError(f"{archive} has {member.filename} twice")
        if member.compress_type not in _METHODS or member.flag_bits & 1:
            raise ValueError(f"{archive} has {member.filename} encrypted or compressed otherwise than by deflate")
        members[member.filename] = member
    return opened, members


def _broken(archive: Path, error: Exception) -> ValueError:
    return ValueError(f"{archive} is no valid archive: {brief(str(error))}")
