"""The native file of a recording: Parquet, one row per time stamp.

A column ``timestamp`` [s]; a column ``action`` for a command of that name, ``action.<name>`` for any other;
``observation.<name>`` for a signal. A row is null where a signal has no sample at its time. Samples that are arrays are
lists of fixed length. A column's unit, frame and shape are in its metadata; parameters, metadata and the version of the
schema are JSON in the table's, under "soro_bench". docs/reference/recordings.md describes it for readers.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ImportError as error:
    raise ImportError("recordings need pyarrow: pip install soro_bench[record]") from error

from soro_bench.files import replacing
from soro_bench.recording.bounded_parquet import BYTES_PER_VALUE, MAX_FOOTER, BoundedParquet
from soro_bench.recording.recording import SCHEMA, Recording, RecordingError, Signal, check_shape
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, MAX_ROWS, named_errors, read_bytes

_KEY = b"soro_bench"
_TIME = "timestamp"
_COMMAND, _SIGNAL = "action", "observation"
_ENTRIES = {"schema", "parameters", "metadata"}


def save(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file appears complete or not at all. The same recording gives the same bytes."""
    columns = [(_command_column(name), signal) for name, signal in sorted(recording.commands.items())]
    columns += [(f"{_SIGNAL}.{name}", recording.signals[name]) for name in recording.names]
    times = np.unique(np.concatenate([signal.time for _, signal in columns]))
    if len(times) > MAX_ROWS:
        raise RecordingError(f"{len(times)} time stamps; a recording has at most {MAX_ROWS}")
    places = len(times) * sum(math.prod(signal.values.shape[1:]) for _, signal in columns)
    numbers = sum(signal.values.size for _, signal in columns)
    if BYTES_PER_VALUE * places + 8 * numbers > EXPANSION * MAX_BYTES:  # it could not be read again
        raise RecordingError(f"{numbers} numbers take {places} places, as every signal has one at each of {len(times)} "
                             "times; that is too much: give signals common times, or cut the recording")  # fmt: skip
    fields, arrays = [pa.field(_TIME, pa.float64(), metadata={"unit": "s"})], [pa.array(times)]
    for name, signal in columns:
        arrays.append(_array(signal, times))
        shape = json.dumps(signal.values.shape[1:])
        metadata = {"frame": signal.frame, "shape": shape, "unit": signal.unit}
        fields.append(pa.field(name, arrays[-1].type, metadata=metadata))
    head = {"schema": SCHEMA, "parameters": recording.parameters, "metadata": recording.metadata}
    schema = pa.schema(fields, metadata={_KEY: json.dumps(head, sort_keys=True)})
    with replacing(path) as temporary:
        pq.write_table(
            pa.Table.from_arrays(arrays, schema=schema),
            temporary,
            compression="zstd",
            use_dictionary=False,
            use_byte_stream_split=True,
            write_statistics=False,
            write_page_checksum=True,
        )
        if (size := pq.read_metadata(temporary).serialized_size) > MAX_FOOTER:  # it could not be read again
            raise RecordingError(f"names, units and metadata take {size} bytes of the file; at most {MAX_FOOTER} may")
        if (size := temporary.stat().st_size) > MAX_BYTES:
            raise RecordingError(f"{numbers} numbers take {size} bytes; {MAX_BYTES} are read: cut the recording")


def load(path: str | Path, max_bytes: int = MAX_BYTES) -> Recording:
    """Read a recording, from whomever it comes.

    Args:
        max_bytes: largest size of the file; its content may take four times as much memory.

    Raises:
        FileNotFoundError, PermissionError: there is nothing to read.
        RecordingError: the file is no valid recording; says why.
    """
    data = read_bytes(path, max_bytes)
    with named_errors(path):
        file = BoundedParquet(data, max_bytes)
        head = _head(file.schema.metadata or {})
        table = file.read(file.schema.names)
        return replace(_recording(table, file.schema, head), file=str(path))


def _array(signal: Signal, times: np.ndarray) -> pa.Array:
    """One entry per time, null where the signal has none."""
    rows = np.searchsorted(times, signal.time)
    missing = np.ones(len(times), bool)
    missing[rows] = False
    shape = signal.values.shape[1:]
    values = np.zeros((len(times), *shape))
    values[rows] = signal.values
    if not shape:
        return pa.array(values, mask=missing)
    flat = pa.array(values.ravel())
    return pa.FixedSizeListArray.from_arrays(flat, int(np.prod(shape)), mask=pa.array(missing))


def _command_column(name: str) -> str:
    return name if name == _COMMAND else f"{_COMMAND}.{name}"


def _head(metadata: Mapping[bytes, bytes]) -> dict:
    if _KEY not in metadata:
        raise RecordingError("no recording of soro_bench; other tables need an importer")
    head = json.loads(metadata[_KEY])
    if not isinstance(head, dict) or head.get("schema") != SCHEMA:
        found = ascii(head.get("schema"))[:80] if isinstance(head, dict) else "none"
        raise RecordingError(f"schema {found} is unknown; this version reads {SCHEMA!r}")
    if set(head) != _ENTRIES:
        raise RecordingError(f"the metadata need {', '.join(sorted(_ENTRIES))}")
    return head


def _recording(table: pa.Table, schema: pa.Schema, head: Mapping[str, Any]) -> Recording:
    if schema.names[:1] != [_TIME] or schema.field(0).type != pa.float64():
        raise RecordingError(f"the first column has to be {_TIME}, float64")
    times = table.column(_TIME)
    if times.null_count:
        raise RecordingError(f"{_TIME} has nulls")
    times = times.to_numpy()
    Signal(times, times)  # checks them
    commands: dict[str, Signal] = {}
    signals: dict[str, Signal] = {}
    for field in list(schema)[1:]:
        kind, _, name = field.name.partition(".")
        group = {_COMMAND: commands, _SIGNAL: signals}.get(kind)
        # "action" and "action.action" would be the same command
        if group is None or (name == "" and kind != _COMMAND) or (kind, name) == (_COMMAND, _COMMAND):
            raise RecordingError(f"unknown column {ascii(field.name)[:80]}; expected action and observation.<name>")
        group[name or _COMMAND] = _signal(field, table.column(field.name), times)
    return Recording(commands, signals, head["parameters"], head["metadata"])


def _signal(field: pa.Field, column: pa.ChunkedArray, times: np.ndarray) -> Signal:
    try:
        metadata = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        shape = check_shape(json.loads(metadata["shape"]))
        unit, frame = metadata["unit"], metadata["frame"]
        present = column.is_valid().to_numpy()
        return Signal(times[present], _values(column.drop_null(), shape), unit, frame)
    except KeyError as error:
        raise RecordingError(f"column {field.name}: {error} is missing in its metadata") from error
    except RecordingError as error:
        raise RecordingError(f"column {ascii(field.name)[:80]}: {error}") from error


def _values(column: pa.ChunkedArray, shape: tuple[int, ...]) -> np.ndarray:
    """(T, *shape) the entries of a column without nulls."""
    kind, size = column.type, int(np.prod(shape))
    is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
    if (kind.value_type if is_list else kind) != pa.float64() or is_list != bool(shape):
        raise RecordingError(f"type {str(kind)[:80]} and shape {list(shape)}; expected float64, lists of it for arrays")
    if is_list:
        if not pc.all(pc.equal(pc.list_value_length(column), size), min_count=0).as_py():
            raise RecordingError(f"an entry has not the {size} numbers that its shape {list(shape)} asks for")
        column = pa.chunked_array([chunk.flatten() for chunk in column.chunks], pa.float64())
    if column.null_count:
        raise RecordingError("a list has nulls inside; a missing number is NaN")
    return column.to_numpy().reshape(-1, *shape)
