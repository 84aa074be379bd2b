"""Recordings from motion capture: .trc, .c3d, and the exports of Motive, Vicon Nexus and Qualisys."""

import tomllib

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("c3d")
import c3d

from benchmarks.fuzz_recordings import write_c3d
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.recording import RecordingError
from tests.arm import says

TRC = """PathFileType\t4\t(X/Y/Z)\ttrial.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100\t100\t3\t2\tmm\t100\t1\t3
Frame#\tTime\ttip\t\t\tbase\t\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2\t

1\t0.0000\t1.5\t0.0\t132.0\t0.0\t0.0\t0.1\t
2\t0.0100\t2.5\t0.0\t132.0\t\t\t\t
3\t0.0200\t\t\t\t\t\t\t
"""
MOTIVE = """Format Version,1.24,Take Name,Take 7,Capture Frame Rate,100.000000,Rotation Type,Quaternion,Length Units,Millimeters

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Marker,Marker,Marker
,Name,base,base,base,base,base,base,base,base,base:m1,base:m1,base:m1,base:m1,base:m1,base:m1
,ID,"AB","AB","AB","AB","AB","AB","AB","AB","CD","CD","CD","CD","CD","CD"
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,X,Y,Z
0,0.000000,0,0,0.6,0.8,10,20,30,0.1,1,2,3,1.5,2.5,3.5
1,0.010000,0,0,-0.6,-0.8,11,20,30,0.1,1,2,3,,,
2,0.020000,,,,,,,,,1,2,3,1.7,2.5,3.5
"""  # noqa: E501
VICON = """Devices
200
,,Plate - Force,,,Pump
Frame,Sub Frame,Fx,Fy,Fz,V
,,N,N,N,furlong
5,0,1,2,3,7
5,1,4,5,6,8
6,0,7,8,9,9
6,1,1,2,3,4

Trajectories
100
,,Arm:tip,,,Arm:base,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
5,0,1,2,3,10,20,30
6,0,,,,11,20,30
"""
QUALISYS = """NO_OF_FRAMES\t3
NO_OF_CAMERAS\t8
NO_OF_MARKERS\t2
FREQUENCY\t100
NO_OF_ANALOG\t0
DESCRIPTION\t--
TIME_STAMP\t2024-06-27, 10:11:12.123\t17.5
DATA_INCLUDED\t3D
EVENT\tstart\t1\t0.0
MARKER_NAMES\ttip\tbase
1.5\t0.000\t132.0\t0.000\t0.000\t0.100
2.5\t0.000\t132.0\t0.000\t0.000\t0.000
3,5\t0.000\t132.0\t0.000\t0.000\t0.100
"""
BOTH = '[signals.points]\nmarkers = ["tip", "base"]\nframe = "world"\n'
TIP = '[signals.tip]\nmarkers = ["tip"]\n'


@pytest.fixture
def read(tmp_path):
    """Reads a text as a file of that name, with a mapping."""

    def read(name, text, mapping):
        (tmp_path / name).write_text(text)
        (tmp_path / "a.toml").write_text(mapping)
        return import_recording(tmp_path / name, tmp_path / "a.toml")

    return read


def test_trc(read):
    """Two header rows, mm, a blank where a marker is hidden, and a frame in which nothing is seen."""
    points = read("a.trc", TRC, BOTH).signals["points"]
    assert (points.unit, points.frame, points.values.shape) == ("m", "world", (2, 2, 3))
    np.testing.assert_allclose(points.time, [0.0, 0.01])
    np.testing.assert_allclose(points.values[0], [[0.0015, 0, 0.132], [0, 0, 0.0001]])
    assert np.isnan(points.values[1, 1]).all()


def test_motive(read):
    """Rigid bodies with quaternions that keep their sign; a measured marker comes before what the body has of it."""
    mapping = """
        [signals.marker]
        markers = ["m1"]
        [signals.base]
        bodies = ["base"]
        [signals.turn]
        rotations = ["base"]
    """
    recording = read("a.csv", MOTIVE, mapping)
    marker, base, turn = (recording.signals[name] for name in ("marker", "base", "turn"))
    np.testing.assert_allclose(marker.time, [0.0, 0.02])
    np.testing.assert_allclose(marker.values[:, 0], [0.0015, 0.0017])
    np.testing.assert_allclose(base.values, [[0.010, 0.020, 0.030], [0.011, 0.020, 0.030]])
    np.testing.assert_allclose(turn.values, [[0.8, 0, 0, 0.6]] * 2)
    assert (base.unit, turn.unit) == ("m", "1")


def test_vicon(read):
    """Two sections at two rates on one clock; frames count from where the capture began."""
    mapping = BOTH + '[commands.pump]\nchannels = ["Pump.V"]\nunit = "V"\n'
    mapping += '[signals.force]\nchannels = ["Plate - Force.Fz", "Plate - Force.Fx"]\n'
    recording = read("a.csv", VICON, mapping)
    points, force = recording.signals["points"], recording.signals["force"]
    np.testing.assert_allclose(points.time, [0.0, 0.01], atol=1e-12)
    np.testing.assert_allclose(points.values[1, 1], [0.011, 0.02, 0.03])
    assert np.isnan(points.values[1, 0]).all()
    np.testing.assert_allclose(force.time, [0.0, 0.005, 0.01, 0.015], atol=1e-12)
    np.testing.assert_allclose(force.values, [[3, 1], [6, 4], [9, 7], [3, 1]])
    assert (force.unit, recording.commands["pump"].unit) == ("N", "V")
    assert float(recording.metadata["start_time"]) == 0.05
    with pytest.raises(RecordingError, match="needs unit"):
        read("a.csv", VICON, BOTH + '[commands.pump]\nchannels = ["Pump.V"]\n')


def test_vicon_objects(read):
    """As Vicon Tracker writes them: a quaternion and a position."""
    text = """Objects
        100
        ,,Global Angle (Quaternion) drone:drone,,,,,,
        Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ
        ,,,,,,mm,mm,mm
        1,0,0,0,0.6,0.8,1,2,3
    """.replace("        ", "")
    recording = read("a.csv", text, '[signals.p]\nbodies = ["drone"]\n[signals.q]\nrotations = ["drone"]\n')
    np.testing.assert_allclose(recording.signals["p"].values, [[0.001, 0.002, 0.003]])
    np.testing.assert_allclose(recording.signals["q"].values, [[0.8, 0, 0, 0.6]])


@pytest.mark.parametrize("counted", [False, True])
def test_qualisys(read, counted):
    """With columns of frames and times or without; 0 0 0 is a marker that is not seen."""
    text = QUALISYS
    if counted:
        head, *rows = text.split("base\n")[0] + "base\n", *text.split("base\n")[1].splitlines()
        rows = [f"{i + 1}\t{0.01 * i:.5f}\t{row}" for i, row in enumerate(rows)]
        text = head + "\n".join(["Frame\tTime\ttip X\ttip Y\ttip Z\tbase X\tbase Y\tbase Z", *rows]) + "\n"
    points = read("a.tsv", text, BOTH).signals["points"]
    np.testing.assert_allclose(points.time, [0.0, 0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(points.values[:, 0, 0], [0.0015, 0.0025, 0.0035])
    assert np.isnan(points.values[1, 1]).all()
    assert not np.isnan(points.values[2]).any()


def test_qualisys_bodies(read):
    """Roll, pitch and yaw about the body's own axes, one after the other, become a quaternion."""
    row = ["10", "20", "30", "0.000", "90.000", "90.000", "0.1", *["0"] * 9]
    head = QUALISYS.split("EVENT")[0].replace("3D", "6D").replace("NO_OF_MARKERS\t2", "NO_OF_BODIES\t1")
    recording = read("a.tsv", head + "BODY_NAMES\tbase\n" + "\t".join(row) + "\n",
                     '[signals.p]\nbodies = ["base"]\n[signals.q]\nrotations = ["base"]\n')  # fmt: skip
    np.testing.assert_allclose(recording.signals["p"].values, [[0.01, 0.02, 0.03]])
    # R = Ry(90) Rz(90): x goes to y, y to z, z to x
    np.testing.assert_allclose(recording.signals["q"].values, [[0.5, 0.5, 0.5, 0.5]], atol=1e-12)


def test_qualisys_without_a_rate(read):
    """An external time base has none: the mapping says it, and only then."""
    text = QUALISYS.replace("FREQUENCY\t100", "FREQUENCY\tEXT")
    recording = read("a.tsv", text, "[time]\ninterval = 0.02\n" + TIP)
    np.testing.assert_allclose(recording.signals["tip"].time, [0.0, 0.02, 0.04])
    with pytest.raises(RecordingError, match=says("a.tsv", "interval")):
        read("a.tsv", text, TIP)
    with pytest.raises(RecordingError, match="times of its own"):
        read("a.tsv", QUALISYS, "[time]\ninterval = 0.02\n" + TIP)


def test_c3d(tmp_path):
    """Markers in the unit of the file, a residual of -1, and channels at their own rate."""
    points = np.arange(18.0).reshape(3, 2, 3)
    points[1, 0] = np.nan
    channels = np.arange(6.0)[None]
    path = write_c3d(tmp_path / "a.c3d", points, channels=channels)
    (tmp_path / "a.toml").write_text(BOTH + '[commands.pump]\nchannels = ["pump"]\n')
    recording = import_recording(path, tmp_path / "a.toml")
    found = recording.signals["points"]
    np.testing.assert_allclose(found.values, 1e-3 * points, atol=1e-9)
    np.testing.assert_allclose(found.time, [0.0, 0.01, 0.02], atol=1e-9)
    pump = recording.commands["pump"]
    np.testing.assert_allclose(pump.time, 0.005 * np.arange(6), atol=1e-9)
    np.testing.assert_allclose(pump.values, channels[0])
    assert (found.unit, pump.unit) == ("m", "V")


def test_c3d_without_channels_and_with_frames_that_count_on(tmp_path):
    """As other systems write them: no analogue part, and the trial begins at a later frame."""
    writer = c3d.Writer(point_rate=50.0, analog_rate=0.0, point_scale=-1.0)
    for i in range(3):
        writer.add_frames([(np.full((1, 5), float(i), np.float32), np.zeros((0, 0), np.float32))])
    writer.set_point_labels(["tip\0"])
    writer.point_group.set_str("UNITS", "", "mm", 2)
    writer.set_start_frame(41)
    with open(tmp_path / "a.c3d", "wb") as file:
        writer.write(file)
    recording = import_recording(tmp_path / "a.c3d", {"signals": {"tip": {"markers": ["tip"]}}})
    np.testing.assert_allclose(recording.signals["tip"].values[:, 0], [0, 0.001, 0.002], atol=1e-9)
    assert float(recording.metadata["start_time"]) == pytest.approx(41 / 50)


def test_trc_with_commas(read):
    """As some exporters write it; text behind the header's own cells does no harm."""
    text = "\n".join(line.replace("\t", ",") for line in TRC.splitlines()) + "\n"
    np.testing.assert_array_equal(
        read("a.trc", text, BOTH).signals["points"].values, read("b.trc", TRC, BOTH).signals["points"].values
    )


@pytest.mark.parametrize(("name", "text"), [("a.trc", TRC), ("a.csv", MOTIVE), ("b.csv", VICON), ("a.tsv", QUALISYS)])
def test_a_guess_is_a_mapping_that_imports_the_file(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    written = guess_mapping(tmp_path / name)
    names = tomllib.loads(written)["signals"].keys()
    (tmp_path / "a.toml").write_text(written)
    assert import_recording(tmp_path / name, tmp_path / "a.toml").signals.keys() == names
    with pytest.raises(RecordingError, match="--guess"):
        import_recording(tmp_path / name)


def test_a_guess_of_a_c3d_file(tmp_path):
    path = write_c3d(tmp_path / "a.c3d", np.zeros((2, 2, 3)))
    recording = import_recording(path, tomllib.loads(guess_mapping(path)))
    assert recording.signals.keys() == {"tip", "base", "pump"}


@pytest.mark.parametrize(
    ("name", "text", "mapping", "parts"),
    [
        ("a.trc", TRC, TIP.replace("tip", "tp"), ("signals.tp", "called 'tp'", "tip, base")),
        ("a.trc", TRC, TIP + 'unit = "m"\n', ("signals.tip", "'mm'", "leave unit out")),
        ("a.trc", TRC, TIP + 'bodies = ["base"]\n', ("signals.tip", "one of markers")),
        ("a.trc", TRC, TIP + 'columns = ["X1"]\n', ("'columns'", "markers")),
        ("a.trc", TRC.replace("\t2\tmm", "\t3\tmm"), TIP, ("a.trc", "NumMarkers '3' and names 2")),
        ("a.trc", TRC.replace("\tmm\t", "\tells\t"), TIP, ("Units 'ells'", "m, cm or mm")),
        ("a.trc", TRC.replace("2.5", "two"), TIP, ("line 8", "'two'", "leave missing ones empty")),
        ("a.trc", TRC.replace("\tbase", "\ttip"), TIP, ("two are called 'tip'",)),
        ("a.trc", TRC.split("1\t0.0000")[0], TIP, ("no rows of numbers",)),
        ("a.trc", TRC[:60], TIP, ("a.trc", "ends before")),
        ("a.trc", "t,x\n0,1\n", TIP, ("begins with 't'",)),
        ("a.csv", MOTIVE.replace("Millimeters", "Parsecs"), TIP, ("'Parsecs'", "Meters")),
        ("a.csv", MOTIVE.replace(",Name,", ",Names,"), TIP, ("Type and Name",)),
        ("a.csv", MOTIVE.split("Frame,Time")[0], TIP, ('begins with "Frame"',)),
        ("a.csv", MOTIVE, TIP, ("none of the markers is called 'tip'", "base:m1")),
        ("a.csv", VICON.replace("\n100\n", "\nfast\n"), TIP, ("rate of Trajectories", "'fast'")),
        ("a.csv", VICON.replace("Trajectories", "Tracks"), TIP, ("'Tracks' is no section", "Trajectories")),
        ("a.tsv", QUALISYS.replace("100", "0"), TIP, ("FREQUENCY is '0'",)),
        ("a.tsv", QUALISYS.replace("3D", "2D"), TIP, ("'2D'", "3D or 6D")),
        ("a.tsv", QUALISYS + "1\t2\t3\t4\t5\t6\t7\n", TIP, ("line 14 has 7 cells; the header has 6",)),
    ],
)  # fmt: skip
def test_bad_export_or_mapping(read, name, text, mapping, parts):
    with pytest.raises(RecordingError, match=says(*parts)) as error:
        read(name, text, mapping)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("cell", ["2_5", "inf"])
@pytest.mark.parametrize("end", ["\n", ""])
def test_a_cell_is_no_number_whatever_row_follows_it(read, cell, end):
    rest = "\t0.0\t132.0\t0.0\t0.0\t0.1"
    rows = f"2\t0.0100\t{cell}{rest}\n3\t0.0200\t1.5{rest}{end}"
    with pytest.raises(RecordingError, match=says("line 8", ascii(cell), "no finite number")):
        read("a.trc", TRC.split("2\t0.0100")[0] + rows, TIP)


def test_a_last_number_that_was_cut_is_left_out(read):
    """Its line has all cells."""
    recording = read("a.tsv", QUALISYS[:-3], BOTH)
    assert len(recording.signals["points"].time) == 2
    assert "the file: its last line, 13, was cut" in recording.metadata["import_notes"]


def test_a_last_line_that_was_cut_is_left_out(read):
    recording = read("a.trc", TRC.replace("3\t0.0200\t\t\t\t\t\t\t\n", "3\t0.0200\t12"), BOTH)
    assert len(recording.signals["points"].time) == 2
    assert "last line, 9, was cut" in recording.metadata["import_notes"]


def test_c3d_that_says_more_than_it_has(tmp_path):
    """Damaged files are refused, and none takes memory for what it only claims."""
    data = write_c3d(tmp_path / "a.c3d", np.ones((3, 2, 3))).read_bytes()
    for damaged in (data[:300], data[:600], b"\x02\x50" + bytes(600), data[:2] + b"\xff\xff" + data[4:]):
        (tmp_path / "a.c3d").write_bytes(damaged)
        with pytest.raises(RecordingError, match=r"a\.c3d"):
            import_recording(tmp_path / "a.c3d", {"signals": {"tip": {"markers": ["tip"]}}})


def test_a_table_that_is_mapped_by_columns_is_read_as_a_table(read):
    """Such mappings were written before exports were recognised."""
    mapping = '[format]\nskip_rows = 12\n[time]\ninterval = 0.01\n[signals.z]\ncolumns = ["Z"]\nunit = "mm"\n'
    table = VICON.split("Trajectories")[0] + "Trajectories\n100\nFrame,Z\n5,3\n6,4\n"
    assert read("a.csv", table, mapping).signals["z"].values.tolist() == [0.003, 0.004]
