"""Recordings from tables: CSV and NPZ files."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fuzz_recordings import write_npz
from soro_bench.recording.importers import import_recording
from soro_bench.recording.importers.units import UNITS, si
from soro_bench.recording.recording import RecordingError
from tests.arm import says

TABLE = """Motion capture, take 7
exported 2026-03-01
t;M1 x;M1 y;M1 z;M2 x;M2 y;M2 z;F;t pump;p
5000;1,5;2;3;4;5;6;;0;1,2
5010;1,6;;3;4;5;lost;250;;
5025;;;;;;;300;20;1,4
"""
MAPPING = """
[format]
delimiter = ";"
decimal = ","
skip_rows = 2
missing = ["lost"]
[time]
column = "t"
unit = "ms"
[commands.pump]
columns = ["p"]
time = "t pump"
unit = "bar"
[signals.markers]
first = "M1 x"
last = "M2 z"
shape = [2, 3]
unit = "mm"
frame = "world"
offset = [0, 0, 0.1]
[signals.force]
columns = ["F"]
unit = "mN"
scale = -1
[parameters]
trunk_mass = 0.4
[metadata]
robot = "trunk no. 3"
"""


@pytest.fixture
def csv(tmp_path):
    """Reads a table with a mapping, both given as text."""

    def read(table, mapping):
        (tmp_path / "a.csv").write_text(table)
        (tmp_path / "a.toml").write_text(mapping)
        return import_recording(tmp_path / "a.csv", tmp_path / "a.toml")

    return read


def test_csv(csv):
    """Units, a scale, an offset, a decimal comma, two clocks, missing numbers; time counts from the first sample."""
    recording = csv(TABLE.replace(";0;1,2", ";5000;1,2").replace(";20;1,4", ";5020;1,4"), MAPPING)
    markers, force, pump = recording.signals["markers"], recording.signals["force"], recording.commands["pump"]
    np.testing.assert_allclose(markers.time, [0, 0.01])
    np.testing.assert_allclose(markers.values[0], [[0.0015, 0.002, 0.103], [0.004, 0.005, 0.106]])
    assert np.isnan(markers.values[1]).sum() == 2
    assert (markers.unit, markers.frame) == ("m", "world")
    np.testing.assert_allclose(force.values, [-0.25, -0.3])
    np.testing.assert_allclose(force.time, [0.01, 0.025])
    np.testing.assert_allclose(pump.values, [1.2e5, 1.4e5])
    np.testing.assert_allclose(pump.time, [0, 0.02])
    assert recording.parameters == {"trunk_mass": 0.4}
    assert recording.metadata == {"robot": "trunk no. 3", "source": "a.csv", "start_time": "5.0"}


def test_csv_without_header(csv):
    """Columns by their number, from 1."""
    mapping = '[format]\nheader = false\n[time]\ncolumn = "1"\n[signals.f]\ncolumns = ["3"]\nunit = "N"\n'
    recording = csv("0,9,1\n0.5,9,2\n", mapping)
    np.testing.assert_array_equal(recording.signals["f"].values, [1, 2])


def test_a_command_is_one_until_its_numbers_leave_where_they_were(csv):
    """The moment lies between two samples, and is shifted; the other signals keep their times."""
    places = [*["5,1"] * 5, "5,1.3", *["2,5"] * 3, "5,1"]
    table = "\n".join(["t,x,y", *(f"{t},{place}" for t, place in enumerate(places)), ""])
    held = '[commands.held]\ncolumns = ["x", "y"]\nunit = "mm"\nleaves = 0.0026\nshift = -0.25\n'
    mapping = f'[time]\ncolumn = "t"\n{held}[signals.x]\ncolumns = ["x"]\nunit = "mm"\n'
    recording = csv(table, mapping)
    command, (before, after) = recording.commands["held"], (0.0003, 0.005)
    share = (0.0026 - before) / (after - before)
    np.testing.assert_allclose(command.time, [0, 5 + share - 0.25])
    assert command.values.tolist() == [1, 0]
    np.testing.assert_array_equal(recording.signals["x"].time, range(10))
    lost = csv(table.replace("1,5,1\n", "1,0,0\n"), mapping)  # a marker, in one sample
    np.testing.assert_array_equal(lost.commands["held"].time, command.time)
    kept = csv(table, mapping.replace("0.0026", "0.01")).commands["held"]
    assert kept.values.tolist() == [1]
    with pytest.raises(RecordingError, match="first samples have gaps"):
        csv(table.replace("5,1\n", "5,\n"), mapping)


def test_a_recording_can_begin_later_than_its_file(csv):
    mapping = """
        [time]
        column = "t"
        begin = 0.3
        until = 0.2
        [signals.f]
        columns = ["f"]
        unit = "N"
    """
    recording = csv("t,f\n5.0,1\n5.1,2\n5.2,3\n5.3,4\n5.4,5\n5.5,6\n", mapping)
    assert recording.signals["f"].values.tolist() == [4, 5]
    np.testing.assert_allclose(recording.signals["f"].time, [0.0, 0.1], atol=1e-12)
    assert float(recording.metadata["start_time"]) == 5.3
    for until, kept in (("0.1", [4]), ("0.15", [4, 5])):  # up to there, however 5.4 - 5.3 is rounded
        other = csv("t,f\n5.3,4\n5.4,5\n5.5,6\n", mapping.replace("begin = 0.3", "").replace("0.2", until))
        assert other.signals["f"].values.tolist() == kept
    with pytest.raises(RecordingError, match=r"signals.f has nothing from \[time\] begin = 9"):
        csv("t,f\n0,1\n1,2\n", mapping.replace("0.3", "9.0"))


@pytest.mark.parametrize(
    ("table", "begin", "time", "said"),
    [
        ("0,1,1 0.1,2,1 0.2,,1 0.5,3,1 0.6,,1", 0.15, [0.0, 0.35], [2, 3]),
        ("0,1,1 0.1,2,1 0.2,,1 0.5,3,1 0.6,,1", 0.1, [0.0, 0.4], [2, 3]),
        ("0,1,1 0.1,2,1 0.2,,1 0.5,3,1 0.6,,1", 0.55, [0.0], [3]),
        ("0,1,1 0.1,2,1 0.2,3,1", 0.15, [0.05], [3]),  # control steps begin with commands that come at intervals
    ],
)
def test_a_recording_that_begins_later_has_the_command_in_force(csv, table, begin, time, said):
    mapping = f"""
        [time]
        column = "t"
        begin = {begin}
        [commands.goal]
        columns = ["goal"]
        unit = "1"
        [signals.f]
        columns = ["f"]
        unit = "N"
    """
    goal = csv("t,goal,f\n" + table.replace(" ", "\n") + "\n", mapping).commands["goal"]
    np.testing.assert_allclose(goal.time, time, atol=1e-12)
    assert goal.values.tolist() == said


def test_a_column_that_a_signal_names_twice_is_refused(csv):
    mapping = '[time]\ninterval = 1.0\n[signals.f]\ncolumns = ["f", "f"]\nunit = "N"\n'
    with pytest.raises(RecordingError, match="expected each once"):
        csv("f,g\n0,0\n1,1\n", mapping)


def test_a_row_of_empty_cells_counts_and_an_empty_line_does_not(csv):
    mapping = '[time]\ninterval = 1.0\n[signals.f]\ncolumns = ["f"]\nunit = "N"\n'
    signal = csv("f,g\n0,0\n1,1\n,\n\n3,3\n", mapping).signals["f"]
    assert (signal.time.tolist(), signal.values.tolist()) == ([0, 1, 3], [0, 1, 3])


def test_csv_of_counted_rows_of_some_trials(csv):
    """Rows are counted where there are no times, and a signal shows the end of the interval."""
    mapping = """
        [format]
        label = "trial"
        only = ["pull", "circle"]
        [time]
        interval = 0.5
        until = 1.4
        [commands.u]
        columns = ["u"]
        unit = "mm"
        [signals.f]
        columns = ["f"]
        unit = "N"
        shift = 0.5
    """
    table = "trial,u,f\npull 1,1,10\nhold,2,20\npull 2,3,30\ncircle,4,40\ncircle,5,50\n"
    recording = csv(table, mapping)
    u, f = recording.commands["u"], recording.signals["f"]
    np.testing.assert_allclose(u.time, [0, 0.5, 1.0])
    np.testing.assert_allclose(u.values, [1e-3, 3e-3, 4e-3])
    np.testing.assert_allclose(f.time, [0.5, 1.0])
    np.testing.assert_allclose(f.values, [10, 30])


COMMA = '[format]\ndelimiter = ";"\ndecimal = ","\n'
SIMPLE = '[time]\ncolumn = "t"\n[signals.f]\ncolumns = ["f"]\nunit = "N"\n'


@pytest.mark.parametrize(
    ("table", "mapping", "parts"),
    [
        ("t,f\n0,1\n", SIMPLE.replace('"N"', '"lbs"'), ("a.toml", "signals.f", "'lbs'", "mm", "kPa")),
        ("t,f\n0,1\n", SIMPLE.replace('unit = "N"', ""), ("signals.f", "no unit")),
        ("t,f\n0,1\n", SIMPLE.replace("unit", "units"), ("'units'", "columns", "unit")),
        ("t,f\n0,1\n", SIMPLE.replace("[signals.f]", '[signals."../f"]'), ("'../f'", "A-Z")),
        ("t,f\n0,1\n", SIMPLE + "[sensors.x]\n", ("'sensors'", "signals")),
        ("t,f\n0,1\n", SIMPLE + "shape = [3]\n", ("signals.f", "[3]", "1 numbers")),
        ("t,f\n0,1\n", SIMPLE + "[format]\nskip_rows = -5\n", ("skip_rows = -5", "expected 0 to")),
        ("t;f\n0;1.234\n", SIMPLE + COMMA, ("line 2", "'1.234' is no finite number")),
        ("t,f\n0,1\n", SIMPLE + "shape = [0]\n", ("signals.f", "positive")),
        ("t,f\n0,1\n", SIMPLE + "scale = inf\n", ("scale", "finite")),
        ("t,f\n0,1\n", SIMPLE + "offset = [1, 2]\n", ("offset", "shape")),
        ("t,f\n0,1\n", SIMPLE + 'scale = "x"\n', ("scale", "finite numbers")),
        ("t,f\n0,1\n", SIMPLE.replace('"t"\n', '"t"\nunit = "mm"\n'), ("'mm'", "unit of time")),
        ("t,f\n0,1\n", '[time]\ncolumn = "t"\n', ("neither", "[signals.<name>]")),
        ("t,f\n0,1\n", "signals = 3\n", ("signals", "section")),
        ("t,f\n0,1\n", "[[[", ("a.toml", "cannot be read")),
        ("t,f\n0,1\n", "a = " + "[" * 50_000, ("a.toml", "cannot be read")),
        ("t,f\n0,1\n", SIMPLE.replace('["f"]', '["g"]'), ("a.csv", "no column is called 'g'", "t, f")),
        ("t;f\n0;1\n", SIMPLE, ("no column is called 't'", "there is t;f", "delimiter")),
        ('t,f\n0,"1,5"\n', SIMPLE, ("line 2", "'1,5' is no finite number", 'decimal = ","')),
        ("t,f,f\n0,1,2\n", SIMPLE, ("2 columns are called 'f'",)),
        ("t,f\n0,one\n", SIMPLE, ("line 2", "'one'", "finite number")),
        ("t,f\n0,1\n1,1e999\n", SIMPLE, ("line 3", "'1e999'")),
        ("t,f\n0,1_000\n", SIMPLE, ("'1_000'",)),
        ("t,f\n0,1\n1\n", SIMPLE, ("line 3 has 1 cells", "2")),
        ("t,f\n0,1\n0,2\n", SIMPLE, ("signals.f", "time does not increase in line 3")),
        ("t,f\n0,\n", SIMPLE, ("no row",)),
        ("t,f\n", SIMPLE, ("no row",)),
        ("", SIMPLE, ("there are no rows",)),
        ("PK\x03\x04", SIMPLE, ("packed (zip, such as an Excel workbook)", "save it as CSV")),
        ("t,f\n0,1\n1,\x00\n", SIMPLE, ("zero bytes in line 3", "the file is damaged there")),
        ('t,f\n0,"1\n', SIMPLE, ("a.csv",)),
        ("t,f\n0," + "1" * 200_000 + "\n", SIMPLE, ("a.csv",)),
        ("t,f\n0" + ",1" * 600_000 + "\n", SIMPLE, ("the row in line 2 has more than 1000000 letters",)),
        ("t,f\n" + ('0,"\n",' + "1," * 100_000) * 6, SIMPLE, ("has more than 1000000 letters",)),
        ("t,f\n0,1\n", "[format]\ndelimiter = ','\ndecimal = ',,'\n" + SIMPLE, ("delimiter ','", "decimal ',,'")),
        ("t,f\n0,1\n", "[format]\nskip_rows = '2'\n" + SIMPLE, ("skip_rows", "'2'")),
        ("t,f\n0,1\n", "[format]\nlabel = 't'\n" + SIMPLE, ("label", "only", "together")),
        ("t,f\n0,1\n", "[format]\nlabel = 'x'\nonly = ['1']\n" + SIMPLE, ("no column is called 'x'",)),
        ("t,f\n0,1\n", "[format]\nlabel = 't'\nonly = ['1']\n" + SIMPLE, ("no row",)),
        ("t,f\n0,1\n", SIMPLE.replace('column = "t"', ""), ("neither", "interval")),
        ("t,f\n0,1\n", SIMPLE.replace('column = "t"', "interval = -1"), ("[time] interval = -1", "positive")),
        ("t,f\n0,1\n", SIMPLE.replace('"t"', '"t"\nuntil = "1"'), ("[time] until = '1'", "positive")),
        ("t,f\n0,1\n", SIMPLE + "shift = [1]\n", ("shift = [1.0]", "one number")),
        ("t,f\n0,1\n", SIMPLE + "leaves = -1\n", ("leaves = -1", "positive number")),
    ],
)
def test_bad_table_or_mapping(csv, table, mapping, parts):
    """The message names the file, the place in it, and what is allowed."""
    with pytest.raises(RecordingError, match=says(*parts)):
        csv(table, mapping)


def test_text_that_is_no_unicode_and_a_file_that_is_too_large(csv, tmp_path):
    csv("t,f\n0,1\n", SIMPLE)
    with pytest.raises(RecordingError, match="bytes; at most 5 are read"):
        import_recording(tmp_path / "a.csv", tmp_path / "a.toml", max_bytes=5)
    (tmp_path / "a.csv").write_bytes(b"t,f\n0,\xff\n")
    with pytest.raises(RecordingError, match="cannot be read"):
        import_recording(tmp_path / "a.csv", tmp_path / "a.toml")


def test_units():
    assert si("deg") == ("rad", pytest.approx(0.0174532925))
    assert si("bar") == ("Pa", 1e5)
    assert all(si(unit) == (unit, 1.0) for unit in {unit for unit, _ in UNITS.values()} & UNITS.keys())


def test_npz(tmp_path):
    """Rows of two arrays side by side, of several types, on two clocks."""
    recording = import_recording(write_npz(tmp_path), tmp_path / "map.toml")
    markers, action = recording.signals["markers"], recording.commands["action"]
    arrays = np.load(tmp_path / "log.npz")
    np.testing.assert_allclose(markers.values, 1e-3 * np.concatenate([arrays["a"], arrays["b"]], axis=1))
    np.testing.assert_array_equal(markers.time, np.arange(20) / 20)
    np.testing.assert_array_equal(action.values, np.arange(19))
    np.testing.assert_array_equal(action.time, np.arange(19) / 20)


ARRAYS = '[time]\ninterval = 0.1\n[signals.f]\narrays = ["f"]\nunit = "N"\n'


@pytest.mark.parametrize(
    ("arrays", "mapping", "parts"),
    [
        ({"g": [1.0]}, ARRAYS, ("signals.f", "no array is called 'f'", "g")),
        ({"f": ["a"]}, ARRAYS, ("f has type <U1",)),
        ({"f": np.array([{}], object)}, ARRAYS, ("f holds Python objects", "np.asarray(values, float)")),
        ({"f": 1.0}, ARRAYS, ("f has type float64 and shape ()",)),
        ({"f": [1.0], "g": [1.0, 2.0]}, ARRAYS.replace('["f"]', '["f", "g"]'), ("arrays have [1, 2] rows",)),
        ({"f": [1.0]}, ARRAYS.replace('["f"]', '"f"'), ("arrays is 'f'", "list of texts")),
        ({"f": [1.0]}, ARRAYS.replace('["f"]', '["f", "f"]'), ("['f', 'f']", "each once")),
        ({"f": [1.0, 2.0]}, ARRAYS + 'time = "f"\nshape = [2]\n', ("shape [2] does not fit",)),
        ({"f": [1.0, 2.0], "t": [1.0]}, ARRAYS + 'time = "t"\n', ("times 't' have shape (1,)", "(2,)")),
        ({"f": np.eye(3), "m": np.eye(3)}, ARRAYS + 'time = "m"\n', ("shape (3, 3)", "[time] indices = [0]")),
        ({"f": [1.0, 2.0, 3.0], "t": [5.0, 3.0, 6.0]}, ARRAYS + 'time = "t"\n', ("signals.f", "3.0 follows 5.0")),
        ({"f": [1.0, 2.0], "t": [0.0, np.inf]}, ARRAYS + 'time = "t"\n', ("signals.f", "time is not finite")),
        ({"f": [1.0]}, ARRAYS.replace("interval = 0.1", 'unit = "mm"'), ("'mm'", "unit of time")),
        ({"f": [1.0]}, ARRAYS.replace("interval = 0.1", ""), ("neither", "interval")),
    ],
)
def test_bad_npz_or_mapping(tmp_path, arrays, mapping, parts):
    np.savez(tmp_path / "a.npz", **{name: np.asarray(values) for name, values in arrays.items()})
    (tmp_path / "a.toml").write_text(mapping)
    with pytest.raises(RecordingError, match=says("a.npz", *parts)):
        import_recording(tmp_path / "a.npz", tmp_path / "a.toml")


def test_damaged_npz(tmp_path):
    """A file that is none, one that says that it has more than it has, and one that would take too much memory."""
    path, mapping = tmp_path / "a.npz", tmp_path / "a.toml"
    mapping.write_text(ARRAYS)
    path.write_bytes(b"PK")
    with pytest.raises(RecordingError, match="no NumPy file"):
        import_recording(path, mapping)
    np.savez_compressed(path, f=np.zeros(1_000_000))
    with pytest.raises(RecordingError, match=r"f has 8000128 bytes"):
        import_recording(path, mapping, max_bytes=20_000)
    np.savez_compressed(path, f=np.zeros(70_000, np.uint8))  # eight times as many bytes as numbers of double precision
    with pytest.raises(RecordingError, match=r"f has 70000 numbers; at most 10000"):
        import_recording(path, mapping, max_bytes=20_000)
    np.save(tmp_path / "f.npy", np.zeros(10))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("f.npy", (tmp_path / "f.npy").read_bytes().replace(b"(10,)", b"(99,)"))
    with pytest.raises(RecordingError, match="f says that it has 792 bytes, and has 80"):
        import_recording(path, mapping)
    for header in (b"{'descr': ('<f8'", b"  a\n b\n"):  # which NumPy takes for Python
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("f.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
        with pytest.raises(RecordingError, match="is no NumPy file"):
            import_recording(path, mapping)
    with pytest.raises(RecordingError, match="needs a mapping"):
        import_recording(path)


def test_the_mapping_of_the_documentation_imports_its_table(tmp_path):
    page = (Path(__file__).parents[1] / "docs" / "how_to" / "import_a_log.md").read_text()
    (tmp_path / "take7.csv").write_text("Take 7" + page.split("```\nTake 7")[1].split("```")[0])
    (tmp_path / "take7.toml").write_text(page.split("```toml")[1].split("```")[0])
    recording = import_recording(tmp_path / "take7.csv", tmp_path / "take7.toml")
    assert recording.commands["action"].values.tolist() == [[0.0] * 8, [0.5, -0.5, *[0.0] * 6]]
    assert recording.signals["markers"].values[0, 0] == pytest.approx([0.0015, 0.002, 0.1002])
    assert recording.signals["force"].values == pytest.approx([0.250, 0.251, 0.253])


def test_a_mapping_that_asks_for_one_array_again_and_again_is_refused(tmp_path):
    """A file of a few bytes would take gigabytes of memory."""
    np.savez_compressed(tmp_path / "a.npz", f=np.zeros(200_000))
    signal = '[signals.f{}]\narrays = ["f"]\nunit = "N"\n'
    for count, parts in ((10, "more numbers than"), (1001, "1001 commands and signals")):
        (tmp_path / "a.toml").write_text("[time]\ninterval = 0.1\n" + "".join(map(signal.format, range(count))))
        with pytest.raises(RecordingError, match=parts):
            import_recording(tmp_path / "a.npz", tmp_path / "a.toml", max_bytes=1_000_000)
