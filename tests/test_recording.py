"""Recordings: their file, and what is refused."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from soro_bench.recording.recording import SCHEMA, Recording, RecordingError, Signal, resampled
from tests.arm import assert_same, example, says

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
from soro_bench.recording.parquet import load, save  # noqa: E402

KEY = b"soro_bench"
ONE = Signal([0.0, 0.1], [1.0, 2.0], "N")
CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def test_round_trip_is_exact(tmp_path):
    save(example(), tmp_path / "a.parquet")
    assert_same(load(tmp_path / "a.parquet"), example())


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    first = example()
    other_order = Recording(
        dict(reversed(first.commands.items())), dict(reversed(first.signals.items())), first.parameters, first.metadata
    )
    save(first, tmp_path / "a.parquet")
    save(other_order, tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_file_is_a_table_for_any_reader(tmp_path):
    """Columns as in LeRobot's datasets, null where a signal has no sample; units are in the columns' metadata."""
    save(example(), tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.schema.names == [
        "timestamp", "action", "action.pump", "observation.force", "observation.once", "observation.points",
    ]  # fmt: skip
    assert len(table) - table.column("observation.force").null_count == 3
    assert table.schema.field("observation.points").metadata == {b"unit": b"m", b"frame": b"world", b"shape": b"[4, 3]"}
    assert json.loads(table.schema.metadata[KEY])["schema"] == SCHEMA


def test_a_file_of_another_writer_is_read(tmp_path):
    """Lists of any length in place of lists of fixed length, several row groups, another compression."""
    save(example(), tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    lists = table.column("observation.points").cast(pa.list_(pa.float64()))
    i = table.schema.get_field_index("observation.points")
    table = table.set_column(i, table.schema.field(i).with_type(lists.type), lists)
    pq.write_table(table, tmp_path / "b.parquet", row_group_size=7, compression="snappy")
    assert_same(load(tmp_path / "b.parquet"), example())


def test_duration_and_names():
    assert example().duration == pytest.approx(example().signals["points"].time[-1])
    assert example().names == ["force", "once", "points"]


def test_resampling_bridges_no_gap():
    """Outside, beside missing samples and in a long gap there is nothing; samples themselves stay."""
    times = [0, 0.5, 1, 1.5, 3, 4, 10.5, 11, 12]
    irregular = Signal([0, 1, 2, 3, 10, 11], [0, 1, np.nan, 3, 4, 5.0], "m")
    got = resampled(irregular, times)
    np.testing.assert_array_equal(got.values, [0, 0.5, 1, np.nan, 3, np.nan, 4.5, 5, np.nan])
    assert got.unit == "m"
    np.testing.assert_allclose(resampled(irregular, [6.5], max_gap=7).values, [3.5])
    assert resampled(Signal([0, 1], np.ones((2, 3, 2))), [0.25, 0.5, 2.0]).values.shape == (3, 3, 2)


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: Signal([], []), ("time has shape (0,)",)),
        (lambda: Signal([[0.0]], [1]), ("time has shape (1, 1)",)),
        (lambda: Signal([0, 0], [1, 2]), ("increase strictly", "row 1")),
        (lambda: Signal([1, 0.5], [1, 2]), ("increase strictly", "0.5 s follows 1.0 s")),
        (lambda: Signal([-0.1, 0], [1, 2]), ("begins at -0.1",)),
        (lambda: Signal([0, np.nan], [1, 2]), ("time is not finite",)),
        (lambda: Signal([0, 1], [1]), ("values have shape (1,)", "2 rows")),
        (lambda: Signal([0, 1], [1, np.inf]), ("infinite",)),
        (lambda: Signal([0, 1], ["a", "b"]), ("type <U1", "real numbers")),
        (lambda: Signal([0, 1], [1, 2j]), ("complex", "real numbers")),
        (lambda: Signal([0], np.zeros((1, 0))), ("shape (0,)", "positive integers")),
        (lambda: Signal([0], [1], unit=""), ('"1"',)),
        (lambda: Signal([0], [1], unit="m\n"), ("unit 'm\\n'", "printable")),
        (lambda: Signal([0], [1], frame=3), ("frame 3", "printable")),
        (lambda: Recording(), ("0 commands and signals",)),
        (lambda: Recording(signals={"../../etc": ONE}), ("'../../etc'", "A-Z a-z")),
        (lambda: Recording(signals={"": ONE}), ("name ''",)),
        (lambda: Recording(signals={"a" * 65: ONE}), ("aaa", "63")),
        (lambda: Recording(signals={"f": ONE}, parameters={"m": np.nan}), ("parameter m is nan", "finite")),
        (lambda: Recording(signals={"f": ONE}, parameters={"m": "1"}), ("parameter m is '1'", "finite")),
        (lambda: Recording(signals={"f": ONE}, metadata={"robot": 3}), ("metadata robot is 3", "text")),
        (lambda: Recording(signals={"f": ONE}, metadata={"a": "x" * 10_001}), ("metadata a is", "10000")),
    ],
)
def test_invalid_content(make, parts):
    """What is no signal or recording is refused before it gets into a file."""
    with pytest.raises(RecordingError, match=says(*parts)):
        make()


def table_of(columns, head=None):
    """A table as in a native file; columns are arrays and their metadata by name."""
    head = {"schema": SCHEMA, "parameters": {}, "metadata": {}} if head is None else head
    fields = [pa.field(name, array.type, metadata=about) for name, (array, about) in columns.items()]
    metadata = {KEY: head if isinstance(head, bytes) else json.dumps(head)}
    return pa.Table.from_arrays([array for array, _ in columns.values()], schema=pa.schema(fields, metadata=metadata))


TIME = (pa.array([0.0, 0.1]), None)
FORCE = (pa.array([1.0, 2.0]), {"unit": "N", "frame": "", "shape": "[]"})
HEAD = {"schema": SCHEMA, "parameters": {}, "metadata": {}}


def lists(*rows, shape="[2]", kind=None):
    return pa.array(rows, kind or pa.list_(pa.float64())), {"unit": "N", "frame": "", "shape": shape}


BAD_TABLES = [
    ({"timestamp": TIME, "f": FORCE}, None, ("unknown column 'f'", "observation.<name>")),
    ({"timestamp": TIME, "observation": FORCE}, None, ("unknown column 'observation'",)),
    ({"timestamp": TIME, "action.action": FORCE}, None, ("unknown column 'action.action'",)),
    ({"timestamp": TIME, "observation.../../x": FORCE}, None, ("'../../x'", "A-Z a-z")),
    ({"timestamp": TIME, "observation.a\x00b": FORCE}, None, ("a\\x00b",)),
    ({"observation.f": FORCE}, None, ("first column", "timestamp")),
    ({"timestamp": TIME}, None, ("0 commands and signals",)),
    ({"timestamp": (pa.array([0, 1]), None), "observation.f": FORCE}, None, ("timestamp, float64",)),
    ({"timestamp": (pa.array([0.0, None]), None), "observation.f": FORCE}, None, ("nulls",)),
    ({"timestamp": (pa.array([0.0, np.nan]), None), "observation.f": FORCE}, None, ("not finite",)),
    ({"timestamp": (pa.array([-1.0, 0.0]), None), "observation.f": FORCE}, None, ("begins at -1.0",)),
    ({"timestamp": (pa.array([0.0, 0.0]), None), "observation.f": FORCE}, None, ("increase strictly",)),
    ({"timestamp": TIME, "observation.f": (FORCE[0], None)}, None, ("observation.f", "shape", "missing")),
    ({"timestamp": TIME, "observation.f": (pa.array([1, 2]), FORCE[1])}, None, ("int64", "float64")),
    ({"timestamp": TIME, "observation.f": (pa.array(["a", "b"]), FORCE[1])}, None, ("string", "numbers")),
    ({"timestamp": TIME, "observation.f": (pa.array([None, None], pa.float64()), FORCE[1])}, None, ("shape (0,)",)),
    ({"timestamp": TIME, "observation.f": lists([1.0, 2.0], [3.0])}, None, ("2 numbers",)),
    ({"timestamp": TIME, "observation.f": lists([1.0, 2.0], [3.0, None])}, None, ("nulls inside",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[]")}, None, ("shape []", "float64")),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[-1]")}, None, ("shape [-1]", "positive")),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[1e9]")}, None, ("positive",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[100000000]")}, None, ("100000",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[" * 100_000)}, None, ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "schema": "other/9"}, ("'other/9'", SCHEMA)),
    ({"timestamp": TIME, "observation.f": FORCE}, [1], ("schema none", SCHEMA)),
    ({"timestamp": TIME, "observation.f": FORCE}, {"schema": SCHEMA}, ("metadata, parameters, schema",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "parameters": {"m": "x"}}, ("m is 'x'",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "parameters": [1]}, ("parameters [1]",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "metadata": {"a": {"b": 1}}}, ("metadata a",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b'{"schema": NaN', ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b"[" * 100_000, ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b"\xff", ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b" " * 2_000_000, ("footer",)),
]


@pytest.mark.parametrize(("columns", "head", "parts"), BAD_TABLES)
def test_invalid_file(tmp_path, columns, head, parts):
    """A Parquet file with the wrong content; the file is named."""
    path = tmp_path / "bad.parquet"
    pq.write_table(table_of(columns, head), path)
    with pytest.raises(RecordingError, match=says(str(path), *parts)):
        load(path)


def test_another_table_is_no_recording(tmp_path):
    pq.write_table(pa.table({"timestamp": [0.0]}), tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match="importer"):
        load(tmp_path / "a.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" * 3, b"PAR1\xff\xff\xff\xffPAR1", b"\x80\x04pickle" * 9])
def test_no_parquet_file(tmp_path, content):
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.parquet"):
        load(tmp_path / "a.parquet")


def test_truncated_and_altered_files(tmp_path):
    """Every length but the whole one, and a flipped bit in every byte of the data: refused, or without effect."""
    path = tmp_path / "a.parquet"
    recording, refused = Recording(signals={"f": ONE}), 0
    save(recording, path)
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(RecordingError):
            load(path)
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    for i in range(4, footer):
        path.write_bytes(data[:i] + bytes([data[i] ^ 16]) + data[i + 1 :])
        try:
            assert_same(load(path), recording)
        except RecordingError:
            refused += 1
    assert refused > 0.9 * (footer - 4)


@pytest.mark.parametrize("compression", ["zstd", "gzip", "none"])
@pytest.mark.parametrize("dictionary", [True, False])
def test_a_decompression_bomb_is_refused_before_it_is_decompressed(tmp_path, compression, dictionary):
    """A small file that says it has few bytes to a row but is many times as large in memory."""
    zeros = pa.array(np.zeros(200_000))
    columns = {"timestamp": (pa.array(np.arange(200_000.0)), None), "observation.f": (zeros, FORCE[1])}
    path = tmp_path / "bomb.parquet"
    pq.write_table(table_of(columns), path, compression=compression, use_dictionary=dictionary)
    with pytest.raises(RecordingError, match=r"memory|bytes"):
        load(path, max_bytes=700_000)


def test_a_list_of_millions_in_a_few_bytes_is_refused(tmp_path):
    """A run of equal numbers takes no space in the file, whatever the footer says of sizes."""
    zeros = pa.array([np.zeros(5_000_000)], pa.list_(pa.float64()))
    columns = {"timestamp": (pa.array([0.0]), None), "observation.f": (zeros, {**FORCE[1], "shape": "[5000000]"})}
    path = tmp_path / "bomb.parquet"
    pq.write_table(table_of(columns), path, compression="zstd", use_dictionary=True)
    assert path.stat().st_size < 10_000
    with pytest.raises(RecordingError, match="memory"):
        load(path, max_bytes=10_000_000)


def test_columns_without_rows_are_counted_too(tmp_path):
    path = tmp_path / "wide.parquet"
    pq.ParquetWriter(path, pa.schema([pa.field(f"c{i}", pa.float64()) for i in range(5001)])).close()
    with pytest.raises(RecordingError, match="5001 columns; at most 5000"):
        load(path)


def test_file_size_is_bounded(tmp_path):
    save(example(), tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match="bytes; at most 100 are read"):
        load(tmp_path / "a.parquet", max_bytes=100)


def test_what_is_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "missing.parquet")
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes among the files of this system")
    os.mkfifo(tmp_path / "pipe.parquet")
    with pytest.raises(RecordingError, match="no regular file"):
        load(tmp_path / "pipe.parquet")
    with pytest.raises((RecordingError, OSError)):
        load(tmp_path)


WRITER = """
import signal, sys, time
import pyarrow.parquet as pq
from soro_bench.recording.parquet import save
from tests.arm import example

signal.signal(signal.SIGINT, signal.default_int_handler)  # which who starts the tests may have ignored

def slow(table, path, **options):
    path.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)

pq.write_table = slow
save(example(), sys.argv[1])
"""


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    texts = {f"text_{i}": "x" * 10_000 for i in range(60)}
    with pytest.raises(RecordingError, match=r"names, units and metadata take \d+ bytes of the file; at most 1000000"):
        save(Recording(signals={"f": ONE}, metadata=texts), tmp_path / "a.parquet")
    assert not list(tmp_path.iterdir())


def test_signals_with_too_many_times_of_their_own_are_not_written(tmp_path):
    """In the file every signal has a place at the times of all others."""
    signals = {f"f{i}": Signal(np.arange(200_000) + i / 50, np.zeros(200_000), "N") for i in range(20)}
    with pytest.raises(RecordingError, match="give signals common times"):
        save(Recording(signals=signals), tmp_path / "a.parquet")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_killed_writer_leaves_no_half_file(tmp_path, how):
    """The old file stays; interrupted, the writer cleans up as well."""
    path = tmp_path / "a.parquet"
    save(example(), path)
    before = path.read_bytes()
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=CHECKOUT
    )
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(how)
    process.wait(30)
    process.stdout.close()
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.glob("*.parquet")] == ["a.parquet"]
    if how == signal.SIGINT:
        assert len(list(tmp_path.iterdir())) == 1
