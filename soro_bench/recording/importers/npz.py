"""NumPy's files: archives of named arrays (.npz), and single arrays (.npy)."""

import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError

import numpy as np

from soro_bench.files import shown
from soro_bench.recording.importers.arrays import array_mapping, import_arrays, written
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors, read_bytes

ONE = "array"  # what the only array of a .npy file is called
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes
_SUFFIX = ".npy"
# RuntimeError: encrypted; the last two: NumPy takes a header for Python
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, SyntaxError, TokenError)


def import_npz(
    path: str | Path, mapping: str | Path | Mapping | None, episode: int | None = None, max_bytes: int = MAX_BYTES
) -> Recording:
    """Read an .npz or .npy file with a mapping file; RecordingError says what is wrong with either."""
    spec = array_mapping(path, mapping, episode)
    with named_errors(path):
        try:
            return import_arrays(path, _opened(path, max_bytes), spec, max_bytes)
        except _DAMAGED as error:
            raise RecordingError(f"is no NumPy file: {shown(str(error)[:200])}") from error


def guess(path: str | Path) -> str:
    """A mapping (TOML) for the arrays of a file, to be corrected."""
    with named_errors(path):
        try:
            return written(_opened(path, MAX_BYTES))
        except _DAMAGED as error:
            raise RecordingError(f"is no NumPy file: {shown(str(error)[:200])}") from error


def _opened(path: str | Path, max_bytes: int) -> "_Archive | _Single":
    data = read_bytes(path, max_bytes)
    kind = _Single if Path(path).suffix.lower() == _SUFFIX else _Archive
    return kind(data, EXPANSION * max_bytes)


class _Archive:
    """Arrays in an archive, read when asked for; pickled objects are refused.

    Args:
        most: bytes of one array.
    """

    kind = "NPZ file"

    def __init__(self, data: bytes, most: int) -> None:
        self._zip, self._most = zipfile.ZipFile(io.BytesIO(data)), most
        self.names = [name.removesuffix(_SUFFIX) for name in self._zip.namelist() if name.endswith(_SUFFIX)]

    def array(self, name: str) -> np.ndarray:
        """One array as it is in the file."""
        info = self._zip.getinfo(name + _SUFFIX)
        if info.file_size > self._most or info.compress_type not in _METHODS:
            raise RecordingError(f"{name} has {info.file_size} bytes, or is packed in a way that NumPy does not use")
        with self._zip.open(info) as entry:
            return _parsed(name, entry.read(self._most + 1), self._most)


class _Single:
    """The array of a .npy file."""

    kind = f'NPY file, whose array is called "{ONE}"'

    def __init__(self, data: bytes, most: int) -> None:
        self._data, self._most, self.names = data, most, [ONE]

    def array(self, name: str) -> np.ndarray:
        """It."""
        return _parsed(name, self._data, self._most)


def _parsed(name: str, content: bytes, most: int) -> np.ndarray:
    """The array in the content of a .npy file."""
    file = io.BytesIO(content)
    shape, _, dtype = _header(file)
    if dtype.hasobject:
        raise RecordingError(f"{ascii(name)[1:-1]} holds Python objects, which are never read: save numbers, such as "
                             f"np.savez(file, {ascii(name)[1:-1]}=np.asarray(values, float))")  # fmt: skip
    size = math.prod(shape) * dtype.itemsize
    if 8 * math.prod(shape) > most:
        raise RecordingError(f"{name} has {math.prod(shape)} numbers; at most {most // 8} are read")
    if size != len(content) - file.tell():
        raise RecordingError(f"{name} says that it has {size} bytes, and has {len(content) - file.tell()}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _header(file: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type of the array in a .npy file, which is read up to its numbers."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)
