"""MATLAB's files (.mat): arrays of numbers, and structs of them by dotted names; nothing else is read.

Versions 4 to 7 by scipy, 7.3 (HDF5) by h5py. Objects, functions, and cells that hold anything but numbers are refused
when a mapping asks for them.
"""

import importlib.util
import io
import itertools
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import shown
from soro_bench.recording.importers.arrays import ArrayFile, array_mapping, import_arrays, written
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, bounded_memory, named_errors, read_bytes

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HDF5_STARTS = (0, 512)  # behind MATLAB's own header
_NUMBERS = ("double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "logical")
_FILTERS = (1, 2, 3)  # deflate, shuffle and check sums: those that MATLAB writes
_MAX_DEPTH = 8  # of structs in structs
_MAX_NAMES = 10_000
_SECONDS = 300
_REFUSED = 3  # exit status: the file is at fault, not the process
_NO_NUMBERS = np.empty(0, "V1")
_ADVICE = (
    "save arrays or structs of them (of a table: table2struct(t, 'ToScalar', true); of a timeseries: Time and Data)"
)


def import_mat(
    path: str | Path, mapping: str | Path | Mapping | None, episode: int | None = None, max_bytes: int = MAX_BYTES
) -> Recording:
    """Read a .mat file with a mapping file; RecordingError says what is wrong with either."""
    spec = array_mapping(path, mapping, episode)
    with named_errors(path):
        return import_arrays(path, _opened(path, max_bytes), spec, max_bytes)


def guess(path: str | Path) -> str:
    """A mapping (TOML) for the arrays of a file, to be corrected."""
    with named_errors(path):
        return written(_opened(path, MAX_BYTES))


def _opened(path: str | Path, max_bytes: int) -> ArrayFile:
    data, most = read_bytes(path, max_bytes), EXPANSION * max_bytes
    if any(data[start : start + len(_HDF5)] == _HDF5 for start in _HDF5_STARTS):
        return _Hdf5(data, most)
    return _Classic(data, most)


class _Classic:
    """A file of version 4 to 7, read as a whole by a process of its own, which a damaged one may end (scipy 1.17)."""

    kind = "MAT file"

    def __init__(self, data: bytes, most: int) -> None:
        if importlib.util.find_spec("scipy") is None:
            raise ImportError(".mat files need scipy: pip install soro_bench[logs]")
        words = [sys.executable, "-c", f"from {__name__} import convert; convert()", str(most)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        try:
            done = subprocess.run(words, input=data, capture_output=True, env=environment, timeout=_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise RecordingError(f"takes more than {_SECONDS} s to be read; save it again with -v7") from error
        if done.returncode:
            said = done.stderr.decode("utf-8", "replace").strip().split("\n")[-1][:200]
            reason = said if done.returncode == _REFUSED else "it is damaged"
            raise RecordingError(f"is no MAT file that can be read ({shown(reason)}); save it again with -v7")
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
            self.names = found["names"].tolist()
            self._arrays = {name: found[str(i)] for i, name in enumerate(self.names)}

    def array(self, name: str) -> np.ndarray:
        """One array of numbers or texts."""
        return _checked(name, self._arrays[name])


def convert() -> None:
    """Turn a .mat file of version 4 to 7 on the standard input into an .npz file on the standard output.

    What is no array of numbers or texts becomes one of no bytes.
    """
    from scipy.io import loadmat

    data = sys.stdin.buffer.read()
    found: dict[str, np.ndarray] = {}
    try:
        with bounded_memory(int(sys.argv[1])), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of names that come twice
            for name, value in loadmat(io.BytesIO(data), struct_as_record=True).items():
                if not name.startswith("__"):
                    found.update(itertools.islice(_flat(name, value, 0), _MAX_NAMES))
            names = list(found)[:_MAX_NAMES]
            numbers: dict[str, Any] = {str(i): found[name] for i, name in enumerate(names)}
            np.savez(sys.stdout.buffer, names=np.array(names, np.str_), **numbers)
    except Exception as error:  # whatever a stranger's bytes make of the reader
        sys.stderr.write("\n" + str(error).split("\n")[0])
        sys.exit(_REFUSED)


def _flat(name: str, value: Any, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays in a value, named as in MATLAB: ``log.q``, of several structs ``log(2).q``, of a cell ``log{2}``."""
    if type(value) is not np.ndarray or depth > _MAX_DEPTH:  # an object, a function, a sparse matrix
        yield name, _NO_NUMBERS
    elif value.dtype.names:
        for i, entry in enumerate(value.ravel()[:_MAX_NAMES]):
            label = name if value.size == 1 else f"{name}({i + 1})"
            for part in value.dtype.names:
                yield from _flat(f"{label}.{part}", entry[part], depth + 1)
    elif value.dtype == object and value.size:
        for i, entry in enumerate(value.ravel()[:_MAX_NAMES]):
            yield from _flat(f"{name}{{{i + 1}}}", entry, depth + 1)
    else:
        yield name, _NO_NUMBERS if value.dtype.hasobject else value


def _checked(name: str, array: np.ndarray) -> np.ndarray:
    """The array if it holds numbers or texts; a row or column of MATLAB has one dimension."""
    if array.dtype.kind == "c":
        raise RecordingError(f"{name} is complex; save real(x) and imag(x) as arrays of their own")
    if array.dtype.kind not in "fiubUS":
        raise RecordingError(f"{name} is no array of numbers but an object, a function or a table; {_ADVICE}")
    return array.reshape(-1) if array.ndim == 2 and 1 in array.shape and array.dtype.kind not in "US" else array


class _Hdf5:
    """A file of version 7.3. MATLAB stores arrays by columns, so that their axes are reversed."""

    kind = "MAT file of version 7.3"

    def __init__(self, data: bytes, most: int) -> None:
        try:
            import h5py
        except ImportError as error:
            hint = "pip install soro_bench[logs], or save with -v7"
            raise ImportError(f".mat files of version 7.3 need h5py: {hint}") from error
        self._h5py, self._most = h5py, most
        with bounded_memory(most):
            try:
                self._file = h5py.File(io.BytesIO(data), "r")
                self.names = list(itertools.islice(self._below(self._file, "", {h5py.h5o.get_info(self._file.id).addr}),
                                                   _MAX_NAMES))  # fmt: skip
            except MemoryError:
                raise
            except Exception as error:  # whatever a stranger's bytes make of the library
                raise RecordingError("is no MAT file of version 7.3 that can be read; save it with -v7") from error

    def _below(self, group: Any, prefix: str, visited: set[int]) -> Iterator[str]:
        """Dotted names of the datasets in a group, of which no link leads out of the file or around."""
        for name in group:
            if name.startswith("#") or not isinstance(group.get(name, getlink=True), self._h5py.HardLink):
                continue
            entry = group[name]
            if isinstance(entry, self._h5py.Dataset):
                yield prefix + name
            elif (address := self._h5py.h5o.get_info(entry.id).addr) not in visited:
                visited.add(address)
                yield from self._below(entry, f"{prefix}{name}.", visited)

    def array(self, name: str) -> np.ndarray:
        """One array of numbers or a text."""
        with bounded_memory(self._most):
            try:
                return _checked(name, self._read(name))
            except (RecordingError, MemoryError):
                raise
            except Exception as error:  # whatever a stranger's bytes make of the library
                raise RecordingError(f"{name} is damaged ({str(error)[:80]}); save it again with -v7") from error

    def _read(self, name: str) -> np.ndarray:
        entry = self._file[name.replace(".", "/")]
        kind = entry.attrs.get("MATLAB_class", b"double")
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if entry.dtype.kind == "O":
            raise RecordingError(f"{name} is a cell or an array of structs; save it with -v7, of which both are read")
        if kind not in (*_NUMBERS, "char") or "MATLAB_object_decode" in entry.attrs or entry.dtype.kind not in "fiub":
            raise RecordingError(f"{name} is no array of numbers but of the class {kind[:40]}; {_ADVICE}")
        steps = entry.id.get_create_plist()
        used = {steps.get_filter(i)[0] for i in range(steps.get_nfilters())}
        if entry.external or entry.is_virtual or not used <= set(_FILTERS):
            raise RecordingError(f"{name} lies in another file, or is packed in a way that MATLAB does not use")
        if entry.size * max(entry.dtype.itemsize, 8) > self._most:
            raise RecordingError(f"{name} has {entry.size} numbers; at most {self._most // 8} are read")
        if "MATLAB_empty" in entry.attrs:
            return np.zeros(0)
        array = np.asarray(entry[()]).T
        return np.array("".join(map(chr, array.ravel(order="F")))) if kind == "char" else array
