"""The mapping that is guessed for a table: what it says, and that the table can be imported with it."""

import sys
import tomllib

import numpy as np
import pytest

pytest.importorskip("pyarrow")
from soro_bench.cli import main
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.importers.guess_table import split_unit, toml
from soro_bench.recording.recording import Recording, RecordingError
from tests.recordings import says

T = np.arange(50) / 100


@pytest.fixture
def guessed(tmp_path):
    """The guess for a table, as it is read, and the recording that it gives."""

    def guessed(table: str | bytes, name: str = "log.csv") -> tuple[dict, Recording]:
        (tmp_path / name).write_bytes(table if isinstance(table, bytes) else table.encode())
        mapping = tomllib.loads(guess_mapping(tmp_path / name))
        return mapping, import_recording(tmp_path / name, mapping)

    return guessed


def table(header: str, row: str, separator: str = "\n") -> str:
    """A header and rows of T, for which ``row`` has places t and i."""
    return separator.join([header, *(row.format(t=t, i=i) for i, t in enumerate(T))]) + separator


def test_encoding_delimiter_decimal_and_units_of_the_header(guessed):
    text = table("Zeit [ms];Winkel [°];Soll [°]", "{t:.3f};{i},5;1,0").replace("0.", "0,")
    for encoding in ("cp1252", "utf-16"):
        mapping, recording = guessed(text.encode(encoding))
        assert mapping["format"] == {"encoding": encoding, "delimiter": ";", "decimal": ","}
        assert mapping["time"] == {"column": "Zeit [ms]", "unit": "ms"}
        assert mapping["signals"]["Winkel"]["unit"] == mapping["commands"]["Soll"]["unit"] == "deg"
        assert recording.signals["Winkel"].values[1] == pytest.approx(np.radians(1.5))


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (table("t,q,u", "{t},{i},1,"), None),
        (table("sep=;\nt;q;u", "{t};{i};1"), None),
        (table("# t  q u", "{t}   {i}  1 "), {"delimiter": "blank"}),
        (table("Take 7\nat noon, in the hall\nt\tq\tu", "{t}\t{i}\t1"), {"delimiter": "\t", "skip_rows": 2}),
        (table("t,q,u\ns,deg,V", "{t},{i},1"), {"unit_row": "take"}),
        (table("%  t q u\n% s deg V", "  {t}  {i} 1"), {"delimiter": "blank", "unit_row": "take"}),
        (table("t,q,status,mode,u\n0.0,ERR,OK,on,1", "{t}1,{i},OK,off,1"), None),
        (table("t,q,u", "{t},{i},1", "\r\n")[:-5], None),
    ],
)
def test_the_layout_of_rows(guessed, text, options):
    mapping, recording = guessed(text)
    assert mapping.get("format") == options
    assert recording.signals["q"].values.shape[0] >= 48
    assert mapping["commands"]["u"]["columns"] == ["u"]


def test_a_table_without_a_header(guessed):
    """Seconds and nanoseconds of ROS, a frame, numbers."""
    rows = [f"1719433753,{10_000_000 * i},base,{i}.5" for i in range(50)]
    mapping, recording = guessed("\n".join(rows) + "\n")
    assert mapping["format"] == {"header": False}
    assert mapping["time"] == {"columns": ["1", "2"], "units": ["s", "ns"]}
    np.testing.assert_allclose(recording.signals["s_4"].time, T, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "row", "unit"),
    [
        ("time", "1719433753.{i:03d}", None),
        ("time", "1719433753{i:03d}", "ms"),
        ("time", "1719433753{i:03d}000000", "ns"),
        ("micros", "{i}0000", "us"),
        ("time", "{i}0000", "us"),
        ("time", "{i}0", "ms"),
        ("t_ms", "{i}0.5", "ms"),
        ("stamp", "2024-06-27 10:11:02.{i:03d}", None),
    ],
)
def test_the_unit_of_time(guessed, header, row, unit):
    mapping, _ = guessed(table(f"{header},x", row + ",{t}"))
    assert mapping["time"]["column"] == header
    assert mapping["time"].get("unit") == unit


def test_without_a_column_of_time_rows_are_counted(guessed):
    mapping, recording = guessed(table("x,y", "{i}.5,{t}"))
    assert mapping["time"] == {"rate": 100.0}
    assert recording.signals.keys() == {"x", "y"}


def test_numbered_columns_and_points_become_one_signal(guessed):
    header = "t,q1,q2,M1 x,M1 y,M1 z,M2 x,M2 y,M2 z,qx,qy,qz,qw,u_cmd1,u_cmd2"
    mapping, recording = guessed(table(header, "{t}" + ",{i}" * 14))
    assert {n: s.values.shape[1:] for n, s in recording.signals.items()} == {"q": (2,), "M": (2, 3), "q_": (4,)}
    assert list(mapping["commands"]) == ["u_cmd"]


def test_a_second_clock_is_that_of_the_columns_after_it(guessed):
    mapping, recording = guessed(table("Time,Force,Time,Angle", "{t},{i},{t:.2f}5,{i}"))
    assert (mapping["time"]["column"], mapping["signals"]["Angle"]["time"]) == (1, 3)
    assert "time" not in mapping["signals"]["Force"]
    assert recording.signals["Angle"].time[0] == pytest.approx(0.005)


def test_a_row_for_each_joint(guessed):
    rows = "".join(f"{t},elbow,{i},0.5\n{t},wrist,{-i},0.5\n" for i, t in enumerate(T))
    mapping, recording = guessed("time,joint,pos_rad,goal\n" + rows)
    assert mapping["signals"]["pos_rad"]["names"] == ["elbow", "wrist"]
    assert recording.signals["pos_rad"].values[3].tolist() == [3, -3]
    assert recording.commands["goal"].values.shape == (50, 2)


def test_wraps_words_and_held_columns_are_seen(guessed, tmp_path):
    rows = [f"{t},{(10 * i) % 360},{'lost' if i == 7 else i},{i // 10}" for i, t in enumerate(T)]
    mapping, _ = guessed("t,angle,x,valve\n" + "\n".join(rows) + "\n")
    assert (mapping["signals"]["angle"]["unit"], mapping["signals"]["angle"]["unwrap"]) == ("deg", True)
    assert mapping["signals"]["x"]["missing"] == ["lost"]
    assert "[commands.valve]?" in guess_mapping(tmp_path / "log.csv")


def test_stamps_that_go_back_are_said(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,x\n0,1\n1,2\n2,3\n3,3\n4,5\n5,5\n5,6\n6,7\n7,7\n")
    text = guess_mapping(path)
    assert "stamps that repeat: 1, that go back: 0" in text
    assert "# An import with this mapping says: " in text
    recording = import_recording(path, tomllib.loads(text.replace("# order", "order")))
    assert recording.signals["x"].values.tolist() == [1, 2, 3, 3, 5, 5, 7, 7]


def test_long_rows(guessed):
    mapping, recording = guessed(table("t,note,q", "{t}," + "a" * 30_000 + ",{i}"))
    assert recording.signals["q"].values.shape == (50,)
    assert mapping["time"] == {"column": "t"}


@pytest.mark.parametrize(
    "data", [b"", b"\n\n", b"hello\nthere is\nno table\n", b"t\n1\n2\n3\n", b"\xff\xfe\x00", b"\x00" * 50]
)
def test_what_is_no_table(tmp_path, data):
    (tmp_path / "a.csv").write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.csv"):
        guess_mapping(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("q [deg]", ("q", "deg")),
        ("Weg (µm)", ("Weg", "um")),
        ("pos_mm", ("pos", "mm")),
        ("speed_rad_s", ("speed", "rad/s")),
        ("a_m_s2", ("a", "m/s^2")),
        ("w_deg_per_s", ("w", "deg/s")),
        ("n_count_per_s", ("n_count_per_s", None)),
        ("load [kp]", ("load", None)),
        ("m_in", ("m_in", None)),
        ("t", ("t", None)),
        ("/joint/pos[3]", ("/joint/pos3", None)),
    ],
)
def test_units_in_names(name, expected):
    assert split_unit(name) == expected


def test_texts_are_written_as_toml_reads_them():
    for text in ('a "b" \\ c', "\u00e9\n\t\x7f", "\U0001f600", ""):
        assert tomllib.loads(f"x = {toml([text, text + '!'])}")["x"] == [text, text + "!"]


def test_the_command_writes_a_mapping_and_replaces_none(tmp_path, monkeypatch, capsys):
    def run(*words):
        monkeypatch.setattr(sys, "argv", ["soro-bench", "import", *map(str, words)])
        main()

    log = tmp_path / "log.csv"
    log.write_text(table("t,q_deg,u", "{t},{i},1"))
    run(log, "--guess")
    assert says("log.toml", "--mapping") and "log.toml" in capsys.readouterr().out
    run(log, "--mapping", tmp_path / "log.toml", "--out", tmp_path / "log.parquet")
    assert "read and checked in" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=says("log.toml", "there already")):
        run(log, "--guess")
    with pytest.raises(SystemExit, match="--guess for a mapping"):
        run(log)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        (table("Zeit [s];Winkel [°];Soll", "{t};{i},5;1").replace("0.", "0,"), "cp1252"),
        (table("t,q,u\ns,deg,V", '"{t}",{i},1,'), "utf-16"),
        (table("stamp joint q", "2024-06-27T10:11:{i:02d}  elbow   {i}"), "utf-8"),
    ],
)
def test_damaged_tables(tmp_path, text, encoding):
    """Only a RecordingError of one line comes of one, from the guess and from an import with the guess for it whole."""
    mutated = pytest.importorskip("benchmarks.fuzz_recordings").mutated
    path, rng, data = tmp_path / "log.csv", np.random.default_rng(0), text.encode(encoding)
    path.write_bytes(data)
    whole = tomllib.loads(guess_mapping(path))
    for _ in range(60):
        path.write_bytes(mutated(data, rng))
        for read in (guess_mapping, lambda path: import_recording(path, whole)):
            try:
                read(path)
            except RecordingError as error:
                assert "\n" not in str(error)
