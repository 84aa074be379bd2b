"""The mapping that is guessed for a table: what it says, and that the table can be imported with it.

Robots of other discretisations and simulators: known answers of their statics, and what is recorded of them.
"""

import sys
import tomllib

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow")


from soro_bench.blind_benchmark import healthy, sorosim
from soro_bench.blind_benchmark.robot import Engine, simulate
from soro_bench.cli import main
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.files import toml
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.trunk_chain import simulate_chain
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.importers.mapping import NO_COMMAND
from soro_bench.recording.importers.units import split_unit
from soro_bench.recording.recording import Recording, RecordingError
from tests.arm import says

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
        (table("t,q,u\nticks,deg,V", "{t},{i},1"), {"unit_row": "take"}),
        (table("t,q,u", '"1{i:02d},5","\u2212{i},5",1'), {"decimal": ","}),
        (table("%  t q u\n% s deg V", "  {t}  {i} 1"), {"delimiter": "blank", "unit_row": "take"}),
        (table("t,q,status,mode,u\n0.0,ERR,OK,on,1", "{t}1,{i},OK,off,1"), None),
        (table("t,q,u", "{t},{i},1", "\r\n")[:-5], None),
        (table("x-axis,1,2\nsecond,deg,V\nt,q,u", "{t},{i},1"), {"skip_rows": 2}),
        (table("Channel,q,u\nRate,100,100\n\nt,q,u", "{t},{i},1"), {"skip_rows": 3}),
        (
            table("Samples\t50\t50\nUnit\tdeg\tV\nX0\t0.0\t0.0\n***End***\t\t\nX_Value\tq\tu", "{t}\t{i}\t1"),
            {"delimiter": "\t", "skip_rows": 4},
        ),
    ],
)
def test_the_layout_of_rows(guessed, text, options):
    mapping, recording = guessed(text)
    assert mapping.get("format") == options
    assert recording.signals["q"].values.shape[0] >= 48
    assert mapping["commands"]["u"]["columns"] == ["u"]


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("t,q,u\ns,deg,V\nfloat,float,int", "{t},{i},1"),
        ("origin,C:/log.idf,,\ndisplayname,t,q,u\nunit,s,deg,V\ntrace_values", ",{t},{i},1"),
        (",arm,arm\n,q [deg],u\nt,,", "{t},{i},1"),
        ("| t | q / deg | u |\n|---|---|---|", "| {t} | {i} | 1 |"),
    ],
)
def test_names_further_up_are_those_of_the_signals(guessed, head, row):
    """Above types, a word, an index or a line."""
    mapping, recording = guessed(table(head, row))
    assert mapping["format"]["header"] is False
    assert (list(recording.signals), list(recording.commands)) == (["q"], ["u"])
    assert recording.signals["q"].unit == "rad" and len(recording.signals["q"].time) == 50


def test_channels_that_are_numbers_are_names(guessed):
    mapping, recording = guessed(table("x-axis,1,2\nsecond,deg,V", "{t},{i},1"))
    assert (mapping["format"], mapping["time"]) == ({"unit_row": "take"}, {"column": "x-axis"})
    assert [len(signal.time) for signal in recording.signals.values()] == [50, 50]


def test_the_least_one_is_no_minute(guessed):
    mapping, _ = guessed(table("t,q [min],q [max],dose [min]", "{t},{i},1,2"))
    assert [entry["unit"] for entry in mapping["signals"].values()] == ["1", "1", "1"]


@pytest.mark.parametrize("pull, told", [("pull", True), ("u", False)])
def test_a_guess_tells_that_nothing_is_called_like_a_command(tmp_path, pull, told):
    """Of tables and of arrays."""
    (tmp_path / "a.csv").write_text(table(f"t,{pull},x", "{t},{i}.5,{i}"))
    np.savez(tmp_path / "a.npz", **{"t": T, pull: T, "x": T})
    said = [guess_mapping(tmp_path / name) for name in ("a.csv", "a.npz")]
    assert [f"[commands.{'NAME' if told else 'u'}]" in text for text in said] == [True, True]
    assert [NO_COMMAND in text for text in said] == [told, told]


@pytest.mark.parametrize(("header", "row"), [("0,1,2", "{t},{i},1.0"), (",0,1,2", "{i},{t},{i},1.0")])
def test_a_header_that_counts_columns(guessed, header, row):
    mapping, recording = guessed(table(header, row))
    assert ("format" in mapping, mapping["time"]["column"]) == (False, "0")
    assert {"s_1", "s_2"} <= recording.signals.keys()


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
        ("elapsed ms", "{i}0.5", "ms"),
        ("t \u00b5s", "{i}0.5", "us"),
        ("t", "429{i:03d}0000", "us"),
        ("t", "42949660{i:02d}", None),
        ("t_ms", "{i}0.5", "ms"),
        ("Date", "45989.58{i:03d}1", "d"),
        ("Time", "45989.0000{i:03d}", "d"),
        ("datenum", "739947.0000{i:03d}", "d"),
        ("Time", "0.6250{i:03d}", "d"),
        ("Time", "0.00000{i:03d}1", "d"),
        ("Time", "0.{i:03d}", None),
        ("timestamp", "1337700000{i:03d}00000", "100ns"),
        ("Ticks", "6387000000{i:03d}00000", "100ns"),
        ("epoch", "1719433753.{i:03d}", None),
        ("rostime", "{t}", None),
        ("stamp", "2024-06-27 10:11:02.{i:03d}", None),
    ],
)
def test_the_unit_of_time(guessed, header, row, unit):
    mapping, _ = guessed(table(f"{header},x", row + ",{t}"))
    assert mapping["time"]["column"] == header
    assert mapping["time"].get("unit") == unit


@pytest.mark.parametrize(
    ("day", "said"), [("28/11/2025", "day/month/year"), ("11/28/2025", "month/day/year"), ("06/07/2025", None)]
)
def test_a_day_after_the_twelfth_says_the_order_of_dates(tmp_path, day, said):
    for header, row in (
        ("stamp,x", f"{day} 10:11:02.{{i:03d}},{{i}}"),
        ("day,hour,x", f"{day},10:11:02.{{i:03d}},{{i}}"),
    ):
        (tmp_path / "log.csv").write_text(table(header, row))
        text = guess_mapping(tmp_path / "log.csv")
        assert tomllib.loads(text)["time"].get("date") == said
        assert ("month or day first?" in text) == (said is None)


def test_dates_of_digits_only_are_times(guessed):
    """As are 17 digits, of which a number would lose the last ones."""
    mapping, recording = guessed(table("stamp,x", "20251128140305{i:03},{i}"))
    assert mapping["time"] == {"column": "stamp"}
    np.testing.assert_allclose(recording.signals["x"].time, np.arange(50) / 1000, atol=1e-9)


@pytest.mark.parametrize("second", ["elapsed", "t_ms"])
def test_stamps_of_whole_seconds_are_no_times_beside_a_finer_clock(guessed, second):
    mapping, _ = guessed(table(f"stamp,{second},x", "2025-11-28 10:11:02,{i}.5,{i}"))
    assert mapping["time"]["column"] == second


def test_without_a_column_of_time_the_rate_is_asked_for(tmp_path):
    """And no number is made up, nor is a column taken that cannot be used."""
    rows = {"x,y": "{i}.5,{t}", "time,x": "10:11:02:{i:03d},{i}", "time,x,y": "1.71943e9,{i},0"}
    for header, row in rows.items():
        (tmp_path / "log.csv").write_text(table(header, row))
        text = guess_mapping(tmp_path / "log.csv")
        mapping = tomllib.loads(text)
        assert mapping["time"] == {}
        assert ('# column "time" may be the time' in text) == ("time" in header)
        with pytest.raises(RecordingError, match=says("no times", "rate")):
            import_recording(tmp_path / "log.csv", mapping)
        mapping["time"]["rate"] = 50
        assert import_recording(tmp_path / "log.csv", mapping).duration == pytest.approx(0.98)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("Sample rate: 100 Hz", {"rate": 100}),
        ("# fs=2.5kHz", {"rate": 2500}),
        ("Sampling frequency [Hz];100;100", {"rate": 100}),
        ("Abtastrate;100,5", {"rate": 100.5}),
        ("Delta_X 0.010", {"interval": 0.01}),
        ("dt = 5 ms", {"interval": 0.005}),
        ("Baud rate: 115200", {}),
        ("Flow rate: 5 ml/min", {}),
        ("Sample rate: 1,000 Hz", {}),
        ("Rate: 100\nRate: 200", {}),
    ],
)
def test_the_rate_above_a_table_without_times(tmp_path, line, said):
    (tmp_path / "log.csv").write_text(f"Take 7\n{line}\n" + table("q;u", "{i}.5;1"))
    assert tomllib.loads(guess_mapping(tmp_path / "log.csv"))["time"] == said


@pytest.mark.parametrize(
    "name", ["Temps [s]", "Messzeit_s", "Tiempo", "\u6642\u523b [s]", "\u7d4c\u904e(\u79d2)", "Elapsed"]
)
def test_times_are_known_by_their_unit_or_in_other_languages(guessed, name):
    mapping, _ = guessed(table(f"n,{name},x", "{i},{t},1"))
    assert mapping["time"] == {"column": name}


@pytest.mark.parametrize(("header", "row"), [("t,x", "{t},{i},,,"), ("t,x,,,", "{t},{i}"), ("t,x,y,z,w", "{t},{i},,,")])
def test_delimiters_at_the_ends_of_header_or_rows_do_not_count(guessed, header, row):
    mapping, _ = guessed(table(header, row))
    assert mapping["time"] == {"column": "t"}
    assert mapping["signals"]["x"]["columns"] == ["x"]


def test_japanese_headers_of_windows_are_known(guessed):
    text = table("\u6642\u9593 [s],\u89d2\u5ea6 [deg]", "{t},{i}")
    mapping, _ = guessed(text.encode("shift_jis"))
    assert mapping["format"] == {"encoding": "shift_jis"}
    assert mapping["time"] == {"column": "\u6642\u9593 [s]"}
    western = table("t,L\u00e4nge \u201ex\u201c,Gr\u00f6\u00dfe [\u00b0]", "{t},{i},1")
    assert guessed(western.encode("cp1252"))[0]["format"] == {"encoding": "cp1252"}


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
    (tmp_path / "log.csv").write_text("t,angle,x,valve\n" + "\n".join(rows).replace("lost", "<0.1") + "\n")
    text = guess_mapping(tmp_path / "log.csv")
    assert "# not read: <0.1; are they numbers, or missing = [...]?" in text
    assert "missing" not in tomllib.loads(text)["signals"]["x"]


def test_lost_numbers_and_wraps_of_other_periods_are_seen(guessed):
    rows = [f"{t},{9999 if i % 9 == 4 else i},{(390 + 0.9 * i) % 400:.2f},{i}" for i, t in enumerate(T)]
    mapping, recording = guessed("t,x,gon,u\n" + "\n".join(rows) + "\n")
    assert (mapping["signals"]["x"]["missing"], recording.signals["x"].values.max()) == ([9999.0], 48)
    assert (mapping["signals"]["gon"]["unwrap"], mapping["signals"]["gon"]["period"]) == (True, 400)


@pytest.mark.parametrize(("header", "row", "cell"), [
    ("t,q,u", '{t},"1,0{i:02d}.5",1', "1,000.5"), ("t,q,u", '{t},"1,0{i:02d}",1.0', "1,000"),
    ("t;q;u", "{t};1 0{i:02d}.5;1", "1 000.5"), ("t;q;u", "{i};1.0{i:02d},5;1,5", "1.000,5"),
    ("t_ms\tq\tu", "1'0{i:02d}.5\t{i}\t1", "1'000.5"), ("t,q", '{t},"1,0{i:02d}.5"', "1,000.5"),
])  # fmt: skip
def test_separators_of_thousands_are_said(tmp_path, header, row, cell):
    """With the first cell that has them, also where no number is left and the guess is refused."""
    (tmp_path / "log.csv").write_text(table(header, row))
    try:
        said = guess_mapping(tmp_path / "log.csv")
    except RecordingError as error:
        said = str(error)
    assert f"{cell} has separators of thousands, which are not read" in said


def test_numbers_that_may_be_thousands_are_asked_about(tmp_path):
    (tmp_path / "log.csv").write_text("t;q\n" + "\n".join(f"{i};{991 + 2 * i:,}" for i in range(30)) + "\n")
    assert '# column "q": 1.001 follows 999; if these are thousands' in guess_mapping(tmp_path / "log.csv")


def test_stamps_that_go_back_are_said(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,x\n0,1\n1,2\n2,3\n3,3\n4,5\n5,5\n5,6\n6,7\n7,7\n")
    text = guess_mapping(path)
    assert "stamps that repeat: 1, that go back: 0" in text
    assert "# An import with this mapping says: " in text
    recording = import_recording(path, tomllib.loads(text.replace("# order", "order")))
    assert recording.signals["x"].values.tolist() == [1, 2, 3, 3, 5, 5, 7, 7]


def test_of_the_newest_row_first_the_times_are_sorted(guessed):
    mapping, recording = guessed("t,x\n" + "\n".join(f"{3 - 0.1 * i:.1f},{i}" for i in range(30)))
    assert mapping["time"] == {"column": "t", "order": "sort"}
    assert recording.signals["x"].values.tolist() == list(range(29, -1, -1))


@pytest.mark.parametrize(("names", "unit"), [
    ("sec,usec", "us"), ("secs,nsecs", "ns"), ("tv_sec,tv_usec", "us"), ("time,time_us", "us"), ("t(s),t(ms)", "ms"),
])  # fmt: skip
def test_a_clock_in_two_columns_is_one_time(guessed, names, unit):
    """A sample every 0.07 s from 1.9 s on."""
    hundredth = {"ms": 10, "us": 10_000, "ns": 10_000_000}[unit]
    times = [(whole, part * hundredth) for whole, part in (divmod(190 + 7 * i, 100) for i in range(40))]
    mapping, recording = guessed("\n".join([f"{names},q,u", *(f"{s},{p},{s},1" for s, p in times)]) + "\n")
    assert mapping["time"] == {"columns": names.split(","), "units": ["s", unit]}
    assert recording.signals["q"].time == pytest.approx(0.07 * np.arange(40), abs=1e-9)


@pytest.mark.parametrize(("names", "units"), [
    ("Hour,Minute,Second", ["h", "min", "s"]), ("h,min,s", ["h", "min", "s"]), ("t_min,t_s", ["min", "s"]),
    ("year,HH,MM,SS,ms", ["h", "min", "s", "ms"]),
])  # fmt: skip
def test_parts_of_a_day_in_columns_are_one_time(guessed, names, units):
    """A sample every 0.25 s from 59.5 s after 23:58 on, over midnight where there are hours."""
    rows = [",".join(names.split(",")) + ",q"]
    for i in range(300 if "h" in units else 240):
        ms = (23 * 60 + 58) * 60_000 + 500 + 250 * i
        whole, part = ms // 1000, ms % 1000
        day = {
            "h": whole // 3600 % 24,
            "min": whole // 60 % 60,
            "s": whole % 60 + (0 if "ms" in units else part / 1000),
        }
        cells = [f"{(day | {'ms': part})[unit]}" for unit in units]
        rows.append(",".join([*(["2024"] if "year" in names else []), *cells, f"{i}"]))
    mapping, recording = guessed("\n".join(rows) + "\n")
    assert mapping["time"] == {"columns": names.split(",")[-len(units) :], "units": units}
    np.testing.assert_allclose(recording.signals["q"].time, 0.25 * np.arange(len(rows) - 1), atol=1e-9)


@pytest.mark.parametrize("names", ["time_s,latency_ms", "time_s,time_ms", "load,ms"])
def test_milliseconds_beside_whole_seconds_need_not_be_parts_of_them(guessed, names):
    """A delay at each second; the same clock again; a clock beside a number."""
    rows = {"time_s,latency_ms": "{i},{j}", "time_s,time_ms": "{i},{k}", "load,ms": "{j},{k}"}[names]
    lines = [rows.format(i=i, j=3 + i % 7, k=1000 * i) for i in range(40)]
    mapping, recording = guessed("\n".join([f"{names},q,u", *(f"{line},{i},1" for i, line in enumerate(lines))]) + "\n")
    assert mapping["time"]["column"] == {"load,ms": "ms"}.get(names, "time_s")
    assert recording.signals["q"].time == pytest.approx(np.arange(40.0))


def test_microseconds_and_a_number_of_frames_are_no_seconds_and_nanoseconds(guessed):
    mapping, recording = guessed("t_us,frame_id,x\n" + "\n".join(f"{1251 * i},{i},0.{i:02d}" for i in range(40)))
    assert mapping["time"] == {"column": "t_us", "unit": "us"}
    assert recording.duration == pytest.approx(39 * 1251e-6, rel=0.1)


def test_decimal_commas_between_commas_are_refused(tmp_path):
    (tmp_path / "log.csv").write_text("t,x,u\n" + "\n".join(f"0,{i:02d},1,{i},0,5" for i in range(30)))
    with pytest.raises(RecordingError, match="3 names stand above 6 cells; are these decimal commas"):
        guess_mapping(tmp_path / "log.csv")


def test_pairs_above_a_table_are_no_rows_of_it(guessed):
    _, recording = guessed("Device,XY\nRate,100\n\n" + table("t,u", "{t},{i}"))
    assert list({**recording.signals, **recording.commands}) == ["u"]


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
        ("stiffness_Nm_rad", ("stiffness", "Nm/rad")),
        ("k_Nm_per_deg", ("k", "Nm/deg")),
        ("compliance_mm_N", ("compliance_mm_N", None)),
        ("leg_A_deg", ("leg_A", "deg")),
        ("pos_in_mm", ("pos_in", "mm")),
        ("n_count_per_s", ("n_count_per_s", None)),
        ("load [kp]", ("load", None)),
        ("m_in", ("m_in", None)),
        ("t", ("t", None)),
        ("F / N", ("F", "N")),
        ("x / \u00b5m", ("x", "um")),
        ("angle/deg", ("angle", "deg")),
        ("v in mm/s", ("v", "mm/s")),
        ("omega deg/s", ("omega", "deg/s")),
        ("arm.pos.mm", ("arm.pos", "mm")),
        ("q_degrees", ("q", "deg")),
        ("angleDeg", ("angle", "deg")),
        ("phi\u00b0", ("phi", "deg")),
        ("stiffness N/mm", ("stiffness N/mm", None)),
        ("steps/s", ("steps/s", None)),
        ("Marker A", ("Marker A", None)),
        ("jointA", ("jointA", None)),
        ("flow_meter", ("flow_meter", None)),
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


NOMINAL = {p.name: p.nominal for p in trunk.PARAMETERS}


DAMPED = NOMINAL | {"damping": 0.2}  # comes to rest within 2 s


TIP = {"L0": 41.6, "S0": 24.2}  # mm/N, per force on a cable without gravity, finite elements on the reference mesh


SHORT = {"train": 18.5, "heldout": 1.0}


def bent(points):
    """Distance [mm] of the last keypoint from where it begins, at the end."""
    return 1e3 * np.linalg.norm(points[-1, -1] - points[0, -1])


def test_chain_of_many_links_hangs_like_the_suite_chain():
    """With slack cables, under its own weight."""
    suite = simulate(Engine("cable", 0.0025), DAMPED, [], np.r_[np.full((6, 8), -1.0), np.zeros((34, 8))])
    assert bent(simulate_chain(30, 0.0025, DAMPED, np.full((800, 8), -0.03))) == pytest.approx(
        bent(suite.points), rel=0.03
    )


def test_keypoints_of_some_steps_are_those_of_all():
    pulls = np.linspace(0.0, -0.03, 40)[:, None].repeat(8, axis=1)
    every, fourth = simulate_chain(5, 0.005, DAMPED, pulls), simulate_chain(5, 0.005, DAMPED, pulls, 4)
    assert np.array_equal(fourth, every[::4])


@pytest.mark.parametrize("cable", TIP)
def test_rod_bends_as_finite_elements_do(cable):
    pytest.importorskip("elastica")
    from soro_bench.blind_benchmark.cosserat import Arm, ArmLaw

    class Pulled(ArmLaw):
        """0.02 N on one cable, the others slack, no gravity."""

        def install(self, arm):
            arm.gravity[:] = 0

        def command(self, arm, pull):
            return pull - 0.01

        def cables(self, arm):
            return [(geo.CABLE_NAMES.index(cable), 0.02, 0.0, 0.02, 0.02)]

    points = Arm(DAMPED, [Pulled()], timestep=2e-4).run(np.zeros((10000, 8)), 10000)
    assert bent(points) / 0.02 == pytest.approx(TIP[cable], rel=0.02)


def test_recordings_are_the_same_for_a_seed_and_differ_for_others():
    once, again, other = (healthy.build("cable", seed, SHORT) for seed in (7, 7, 8))
    assert once[1] == again[1] and once[1]["robot"] in healthy.ROBOTS["cable"]
    keypoints = [recordings["train"].signals["keypoints"].values for recordings, _ in (once, again, other)]
    assert np.array_equal(keypoints[0], keypoints[1]) and not np.array_equal(keypoints[0], keypoints[2])
    assert once[1]["parameters"] != other[1]["parameters"]


def test_every_robot_without_further_packages_moves_within_a_few_millimetres_of_the_accurate_one():
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.uniform(-0.5, 0.5, (4, 8)), 5, axis=0)
    accurate = healthy.keypoints(Engine("flex", 0.005), NOMINAL, actions)
    for kind in ("cable", "flex", "links"):
        for robot in healthy.ROBOTS[kind].values():
            points = healthy.keypoints(robot, NOMINAL, actions)
            assert np.abs(points - accurate).max() > 0.0 and np.sqrt(np.square(points - accurate).mean()) < 0.008


def test_hidden_physics_in_a_rod_changes_its_motion_and_is_labelled():
    pytest.importorskip("elastica")
    from soro_bench.blind_benchmark.cosserat import Arm
    from soro_bench.blind_benchmark.cosserat_laws import HIDDEN

    pulls = np.outer(np.linspace(0, 0.005, 600), [1.0, 0.5, 0.4, 0.6] * 2)
    healthy_points = Arm(NOMINAL).run(pulls, 600)
    for name, draw in HIDDEN.items():
        hidden = draw(np.random.default_rng(0))
        assert not np.array_equal(Arm(NOMINAL, hidden.laws()).run(pulls, 600) + hidden.offset, healthy_points), name
        assert {"kind", "name"} <= hidden.location.keys() and hidden.parameters


def test_release_of_a_sorosim_rod_is_a_recording_of_its_model(tmp_path):
    """The model with the rod's own constants is at rest where the forces hold it; the map fits the recording."""
    columns = ["mid_force_x", "mid_force_y", "mid_force_z", "tip_force_x", "tip_force_y", "tip_force_z"]
    head = ["take", "material", "gravity_x", "gravity_y", "gravity_z", *columns, "true_damping_s"]
    values = ["release_steel_01", "steel", 0, 0, -9.81, 0, 0, 0, 0, 0.1, 0, 0.004]
    (tmp_path / "releases.csv").write_text(",".join(head) + "\n" + ",".join(map(str, values)) + "\n")
    names = ["t_s", *(f"{point}_{axis}_m" for point in ("mid", "tip") for axis in "xyz")]
    rows = [[0.005 * i, 0.3, 0, -0.01, 0.59, 0, -0.04] for i in range(1100)]
    text = "\n".join(",".join(map(str, row)) for row in [names, *rows])
    (tmp_path / "release_steel_01.csv").write_text(text + "\n")
    files, recording, label = sorosim.build(tmp_path, 3)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    measured = ModelRobot(tmp_path / "model.xml", tmp_path / "map.toml", threads=1).measured(recording)
    assert measured.actions[0].tolist() == [0, 0, 0, 0, 0.1, 0] and not measured.actions[1:].any()
    assert label["effects"] == [] and set(label["parameters"]) == {"stiffness", "mass", "damping"}
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(compiled)
    mujoco.mj_resetDataKeyframe(compiled, data, 0)
    data.ctrl[:] = measured.actions[0]
    start = data.qpos.copy()
    mujoco.mj_step(compiled, data, 100)
    assert np.abs(data.qpos - start).max() < 0.01
