"""NumPy archives (.npz): named arrays, of which each row is a sample."""

import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from soro_bench.recording.importers.mapping import FileMapping, Source, load_mapping, texts
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_ROWS, named_errors, read_bytes

_PLACE = ("arrays", "time")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes
_SUFFIX = ".npy"
# RuntimeError: encrypted; the last two: NumPy takes a header for Python
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, SyntaxError, TokenError)


def import_npz(path: str | Path, mapping: str | Path | Mapping | None, max_bytes: int = MAX_BYTES) -> Recording:
    """Read an NPZ file with a mapping file; RecordingError says what is wrong with either."""
    if mapping is None:
        raise RecordingError(f"{path}: an NPZ file needs a mapping file; docs/how_to/import_a_log.md has an example")
    spec = load_mapping(mapping, _PLACE, ("array", "unit", "interval", "rate", "period"))
    data = read_bytes(path, max_bytes)
    with named_errors(path):
        spec.to_seconds()
        try:
            archive = _Archive(data, EXPANSION * max_bytes)
            read = partial(_samples, archive, spec)
            return spec.recording(read, Path(path).name, EXPANSION * max_bytes)
        except _DAMAGED as error:
            raise RecordingError(f"is no NPZ file: {str(error)[:200]}") from error


def _samples(archive: "_Archive", spec: FileMapping, source: Source) -> tuple[np.ndarray, np.ndarray]:
    """(T,) times [s] and (T, k) numbers: rows of the arrays, one after the other."""
    arrays = archive.arrays(texts("arrays", source.place.get("arrays")))
    if len(rows := {len(array) for array in arrays}) > 1:
        raise RecordingError(f"its arrays have {sorted(rows)} rows; all need as many")
    numbers = np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
    name = source.place.get("time", spec.time.get("array"))
    if name is None:
        return spec.counted(len(numbers)), numbers
    time = archive.array(name)
    if time.shape != (len(numbers),):
        raise RecordingError(f"its times {ascii(name)[:80]} have shape {time.shape}; expected ({len(numbers)},)")
    return spec.clock(time), numbers


class _Archive:
    """Arrays of real numbers in an archive, read when asked for; pickled objects are refused.

    Args:
        most: bytes of arrays that are read together.
    """

    def __init__(self, data: bytes, most: int) -> None:
        self._zip, self._most = zipfile.ZipFile(io.BytesIO(data)), most
        self._names = [name.removesuffix(_SUFFIX) for name in self._zip.namelist() if name.endswith(_SUFFIX)]

    def arrays(self, names: list[str]) -> list[np.ndarray]:
        """Several of them."""
        found, size = [], 0
        for name in names:
            found.append(self.array(name))
            size += found[-1].nbytes
            if size > self._most:
                raise RecordingError(f"arrays {ascii(names)[1:80]} have more than {self._most} bytes")
        return found

    def array(self, name: Any) -> np.ndarray:
        """An array of at least one dimension, as floating-point numbers."""
        if not isinstance(name, str) or self._names.count(name) != 1:
            found = ", ".join(ascii(each)[1:-1] for each in self._names)[:200]
            raise RecordingError(f"{self._names.count(name)} arrays are called {ascii(name)[:80]}; there are {found}")
        info = self._zip.getinfo(name + _SUFFIX)
        if info.file_size > self._most or info.compress_type not in _METHODS:
            raise RecordingError(f"{name} has {info.file_size} bytes, or is packed in a way that NumPy does not use")
        with self._zip.open(info) as entry:
            content = entry.read(self._most + 1)
        file = io.BytesIO(content)
        shape, _, dtype = _header(file)
        size = math.prod(shape) * dtype.itemsize
        if dtype.kind not in "fiu" or not shape or len(shape) > 5 or not 0 < shape[0] <= MAX_ROWS:
            raise RecordingError(f"{name} has type {dtype} and shape {shape}; expected rows of real numbers")
        if 8 * math.prod(shape) > self._most:
            raise RecordingError(f"{name} has {math.prod(shape)} numbers; at most {self._most // 8} are read")
        if size != len(content) - file.tell():
            raise RecordingError(f"{name} says that it has {size} bytes, and has {len(content) - file.tell()}")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False).astype(float)


def _header(file: io.BytesIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type of the array in a .npy file, which is read up to its numbers."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    return np.lib.format.read_array_header_2_0(file)
