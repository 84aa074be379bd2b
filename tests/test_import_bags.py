"""Bags of ROS 2 and ROS 1 and MCAP files: every way to keep one is read, whole or cut."""

import json
import shutil
import sqlite3
import struct
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("rosbags")
import zstandard
from mcap.writer import CompressionType, Writer

from benchmarks.write_bags import (
    HUMBLE,
    JOINTS,
    LATE,
    START,
    STEP,
    TOPIC,
    joint_state,
    mapping,
    states,
    write_json,
    write_mcap,
    write_ros1,
    write_ros2,
)  # fmt: skip
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.recording import RecordingError
from tests.arm import says

NOTES = "import_notes"
LINE = "=" * 80 + "\n"


def pack(path):
    """The file, packed with zstd."""
    packed = path.with_name(path.name + ".zstd")
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()
    return packed


def packed_folder(folder, kind):
    """A bag whose file is packed, as ros2 bag record --compression-mode file leaves it."""
    write_ros2(folder, states(), kind)
    pack(folder / f"{folder.name}.{kind}")
    return folder


def json_states(path):
    """The same messages as JSON."""
    rows = [
        (received, {"header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}, "name": n, "position": p})
        for received, stamp, n, p in states()
    ]
    return write_json(path, rows)


KINDS = {
    "JSON": lambda folder: json_states(folder / "a.mcap"),
    "MCAP": lambda folder: write_mcap(folder / "a.mcap", states()),
    "MCAP, lz4": lambda folder: write_mcap(folder / "a.mcap", states(), compression=CompressionType.LZ4),
    "MCAP, packed": lambda folder: pack(write_mcap(folder / "a.mcap", states())),
    "folder, MCAP": lambda folder: write_ros2(folder / "bag", states()),
    "folder, SQLite": lambda folder: write_ros2(folder / "bag", states(), "db3"),
    "folder, MCAP, messages packed": lambda folder: write_ros2(folder / "bag", states(), "mcap", "MESSAGE"),
    "folder, SQLite, messages packed": lambda folder: write_ros2(folder / "bag", states(), "db3", "MESSAGE"),
    "folder, MCAP, chunks packed": lambda folder: write_ros2(folder / "bag", states(), "mcap", "STORAGE"),
    "folder, SQLite, file packed": lambda folder: packed_folder(folder / "bag", "db3"),
    "SQLite": lambda folder: write_ros2(folder / "bag", states(), "db3") / "bag.db3",
    "ROS 1": lambda folder: write_ros1(folder / "a.bag", states()),
    "ROS 1, bz2": lambda folder: write_ros1(folder / "a.bag", states(), "BZ2"),
    "ROS 1, not finished": lambda folder: write_ros1(folder / "a.bag", states()).rename(folder / "a.bag.active"),
    "ROS 1, lz4": lambda folder: write_ros1(folder / "a.bag", states(), "LZ4"),
}


@pytest.fixture(params=KINDS)
def bag(request, tmp_path):
    """The same messages, kept in each of the ways that there are."""
    return KINDS[request.param](tmp_path)


def test_every_kind_of_bag_is_read(bag):
    recording = import_recording(bag, mapping())
    signal = recording.signals["q"]
    np.testing.assert_array_equal(signal.values, [position for *_, position in states()])
    np.testing.assert_allclose(signal.time, 0.01 * np.arange(200), rtol=0, atol=1e-9)
    assert float(recording.metadata["start_time"]) == pytest.approx(START / 1e9, abs=1e-6)
    assert NOTES not in recording.metadata or bag.suffix == ".active"


def test_the_guess_of_every_kind_of_bag_can_be_imported(bag, tmp_path):
    (tmp_path / "guess.toml").write_text(guess_mapping(bag))
    recording = import_recording(bag, tmp_path / "guess.toml")
    assert recording.names == ["joint_states_position"]
    assert recording.signals["joint_states_position"].unit == "rad"
    np.testing.assert_array_equal(recording.signals["joint_states_position"].values[1], [np.sin(0.03), -1])
    assert float(recording.metadata["start_time"]) == pytest.approx(START / 1e9, abs=1e-6)  # by header.stamp


def test_messages_have_times_of_receipt_too(bag):
    late = import_recording(bag, mapping(time="log_time"))
    assert float(late.metadata["start_time"]) == pytest.approx((START + LATE) / 1e9, abs=1e-6)


def test_publish_times_are_only_in_mcap_files(tmp_path):
    for kind in ("MCAP", "SQLite", "ROS 1"):
        (folder := tmp_path / kind).mkdir()
        path = KINDS[kind](folder)
        if kind == "MCAP":
            assert len(import_recording(path, mapping(time="publish_time")).signals["q"].time) == 200
        else:
            with pytest.raises(RecordingError, match=says("no publish_time", "log_time")):
                import_recording(path, mapping(time="publish_time"))


def split_bag(folder, kind):
    """A bag of eleven parts, of which part 10 comes after part 9."""
    parts = []
    for part in range(11):
        one = write_ros2(folder / "one", states(20 * part, 20), kind)
        parts.append((one / f"one.{kind}").rename(folder / f"bag_{part}.{kind}"))
        text = (one / "metadata.yaml").read_text()
        shutil.rmtree(one)
    names = "".join(f"\n  - {part.name}" for part in parts)
    (folder / "metadata.yaml").write_text(text.replace(f"\n  - one.{kind}", names))
    return parts


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_split_bag_is_read_whole(tmp_path, kind):
    parts = split_bag(tmp_path, kind)
    recording = import_recording(tmp_path, mapping())
    np.testing.assert_array_equal(recording.signals["q"].values[:, 1], -np.arange(220))
    assert NOTES not in recording.metadata
    (tmp_path / "metadata.yaml").rename(tmp_path / "kept")
    recording = import_recording(tmp_path, mapping())
    np.testing.assert_array_equal(recording.signals["q"].values[:, 1], -np.arange(220))
    assert "metadata.yaml is missing or empty (recorder killed?); 11 files are read" in recording.metadata[NOTES]
    (tmp_path / "kept").rename(tmp_path / "metadata.yaml")
    parts[3].unlink()
    with pytest.raises(RecordingError, match=says("not complete", f"bag_3.{kind}")):
        import_recording(tmp_path, mapping())


def test_a_folder_of_several_bags_is_refused(tmp_path):
    for name in ("morning", "evening"):
        write_mcap(tmp_path / f"{name}.mcap", states())
    with pytest.raises(RecordingError, match=says("files of 2 bags", "evening.mcap, morning.mcap", "one of them")):
        import_recording(tmp_path, mapping())


@pytest.mark.parametrize("text", ["a: [", "1", "rosbag2_bagfile_information: {relative_file_paths: [../../etc/passwd]}",
                                  "rosbag2_bagfile_information: {relative_file_paths: [3]}"])  # fmt: skip
def test_a_description_of_a_bag_that_is_wrong_is_refused(tmp_path, text):
    write_mcap(tmp_path / "a.mcap", states())
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match=says("metadata.yaml")) as raised:
        import_recording(tmp_path, mapping())
    assert "\n" not in str(raised.value)


CUT = {
    "MCAP": lambda folder: write_mcap(folder / "a.mcap", states(), chunk_size=1000),
    "MCAP, one chunk": lambda folder: write_mcap(folder / "a.mcap", states(), compression=CompressionType.NONE),
    "MCAP, no chunks": lambda folder: write_mcap(folder / "a.mcap", states(), use_chunking=False),
    "SQLite": KINDS["SQLite"],
    "ROS 1": lambda folder: write_ros1(folder / "a.bag", states(), chunk=1000),
    "ROS 1, one chunk": KINDS["ROS 1"],
}


@pytest.mark.parametrize("kind", CUT)
@pytest.mark.parametrize("tail", [b"", bytes(3000)])
def test_of_a_cut_bag_what_is_there_is_read(tmp_path, kind, tail):
    """A recorder that is killed, or a computer without power, which may leave zeros."""
    path = CUT[kind](tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * (3 if kind == "SQLite" else 2) // 4] + tail)
    recording = import_recording(path, mapping())
    values = recording.signals["q"].values
    assert 20 < len(values) < 190
    np.testing.assert_array_equal(values, [position for *_, position in states(0, len(values))])
    assert "recorder killed?" in recording.metadata[NOTES]


def test_a_database_that_is_cut_anywhere_has_no_wrong_samples(tmp_path):
    """SQLite would read zeros where the last page is not whole."""
    path = KINDS["SQLite"](tmp_path)
    whole = path.read_bytes()
    for share in np.linspace(0.7, 0.98, 6):
        path.write_bytes(whole[: int(share * len(whole))])
        values = import_recording(path, mapping()).signals["q"].values
        np.testing.assert_array_equal(values, [position for *_, position in states(0, len(values))])


def test_a_bag_that_is_cut_in_its_only_chunk_says_so(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", states())
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(RecordingError, match=says("no messages of topic /joint_states", "cut in a chunk")):
        import_recording(path, mapping())


def test_what_a_killed_recorder_left_beside_a_database_is_read(tmp_path):
    """SQLite keeps what is new in a file of its own until the database is closed."""
    path = KINDS["SQLite"](tmp_path)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA journal_mode = WAL")
    data = bytes(HUMBLE.serialize_cdr(joint_state(HUMBLE, START + 200 * STEP, ["a", "b"], [5, 6]), JOINTS))
    database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (START + 200 * STEP, data))
    (copy := tmp_path / "copy").mkdir()
    for file in (path, path.with_name("bag.db3-wal")):
        shutil.copy(file, copy)
    database.close()
    before = sorted(file.read_bytes() for file in copy.iterdir())
    recording = import_recording(copy / "bag.db3", mapping())
    np.testing.assert_array_equal(recording.signals["q"].values[-1], [5, 6])
    assert "bag.db3-wal is read too" in recording.metadata[NOTES]
    assert sorted(file.read_bytes() for file in copy.iterdir()) == before


def test_a_database_without_definitions_is_read_by_those_of_ros_or_of_the_mapping(tmp_path):
    path = KINDS["SQLite"](tmp_path)
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
    assert len(import_recording(path, mapping()).signals["q"].time) == 200
    with sqlite3.connect(path) as database:
        database.execute("UPDATE topics SET type = 'my_robot/msg/State'")
    with pytest.raises(RecordingError, match=says("no definition of the type 'my_robot/msg/State'", "[format.def")):
        import_recording(path, mapping())
    text = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    with_text = {**mapping(), "format": {"definitions": {"my_robot/msg/State": text}}}
    assert len(import_recording(path, with_text).signals["q"].time) == 200
    wrong = {**mapping(), "format": {"definitions": {"my_robot/msg/State": text + "float64 more\n"}}}
    with pytest.raises(RecordingError, match="my_robot/msg/State ends after"):
        import_recording(path, wrong)


def test_progress_is_told_up_to_the_end(bag):
    told = []
    import_recording(bag, mapping(), progress=lambda stage, done, total: told.append((done, total)))
    assert told[-1][0] == told[-1][1]
    assert all(done <= total for done, total in told)


def test_a_topic_that_is_not_there_is_answered_with_those_that_are(bag):
    wrong = mapping()
    wrong["signals"]["q"]["topic"] = "/joints"
    with pytest.raises(RecordingError, match=says("signals.q", "no messages of topic /joints", TOPIC)):
        import_recording(bag, wrong)


def joint_data(names=2, positions=2, end=b""):
    """CDR of a JointState that declares these lengths."""
    head = struct.pack("<4sIII4sI", b"\0\1\0\0", 1, 2, 2, b"a", names) + struct.pack("<I4sI4s", 2, b"a", 2, b"b")
    return head + struct.pack("<Idd", positions, 1.0, 2.0) + struct.pack("<II", 0, 0) + end


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        (joint_data(names=2**32 - 1), ("has a list of 4294967295 entries",)),
        (joint_data(positions=2**32 - 1), ("ends after", "says that it has")),
        (joint_data(end=bytes(9)), ("9 bytes more than its definition",)),
        (b"\0\7\0\0" + joint_data()[4:], ("begins with 0007; only plain CDR",)),
        (b"\0", ("only plain CDR",)),
    ],
)
def test_messages_that_do_not_fit_their_type(tmp_path, data, parts):
    definition = HUMBLE.generate_msgdef(JOINTS, ros_version=2)[0].encode()
    schema = JOINTS, "ros2msg", definition
    good = write_json(tmp_path / "a.mcap", [(0, joint_data())], encoding="cdr", schema=schema)
    np.testing.assert_array_equal(import_recording(good, mapping(time="log_time")).signals["q"].values, [[1, 2]])
    bad = write_json(tmp_path / "a.mcap", [(0, joint_data()), (1, data)], encoding="cdr", schema=schema)
    with pytest.raises(RecordingError, match=says("sensor_msgs/msg/JointState", *parts)):
        import_recording(bad, mapping(time="log_time"))


@pytest.mark.parametrize(
    ("definition", "parts"),
    [
        ("import os\nos.system('x')", ("cannot be read",)),
        (f"A[] inner\n{LINE}MSG: p/A\nint8 x\np/A[1] more", ("nests deeper",)),
        ("B x", ("has the unknown p/msg/B",)),
        (f"A[1000000] a\n{LINE}MSG: p/A\np/B[1000000] b\n{LINE}MSG: p/B\nint8 X=1", ("a list of",)),
        ("#" * 300_000, ("more than 200000 letters",)),
    ],
)
def test_definitions_of_strangers(tmp_path, definition, parts):
    rows = [(0, b"\0\1\0\0" + struct.pack("<I", 1) + bytes(100))]
    path = write_json(tmp_path / "a.mcap", rows, encoding="cdr", schema=("p/msg/T", "ros2msg", definition.encode()))
    with pytest.raises(RecordingError, match=says(*parts)) as raised:
        import_recording(path, mapping(["x"], time="log_time"))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("statement", [
    "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) "
    "SELECT 1 AS topic_id, x AS timestamp, zeroblob(1000000) AS data FROM c",
    "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)))",
    "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
    "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER)",
])  # fmt: skip
def test_databases_of_strangers(tmp_path, statement):
    path = write_ros2(tmp_path / "bag", states(), "db3") / "bag.db3"
    with sqlite3.connect(path) as database:
        database.executescript(f"DROP TABLE messages; {statement};")
    with pytest.raises(RecordingError, match=says("messages")):
        import_recording(path, mapping())


def test_what_is_no_bag(tmp_path):
    for suffix in (".mcap", ".db3", ".bag", ".mcap.zstd"):
        (tmp_path / f"a{suffix}").write_bytes(b"t,q\n0,1\n")
        with pytest.raises(RecordingError, match="is no"):
            import_recording(tmp_path / f"a{suffix}", mapping())


def test_bombs(tmp_path):
    """A small file that unpacks to a large one, as a whole, as a chunk, or as a message."""
    zeros = zstandard.compress(bytes(50_000_000))
    (tmp_path / "a.mcap.zstd").write_bytes(zeros)
    with pytest.raises(RecordingError, match="unpacks to more bytes"):
        import_recording(tmp_path / "a.mcap.zstd", mapping(), max_bytes=10_000)
    path = write_json(tmp_path / "b.mcap", ((k, {"position": [0] * 1000}) for k in range(300)))
    with pytest.raises(RecordingError, match="unpacks to more bytes"):
        import_recording(path, mapping(time="log_time"), max_bytes=path.stat().st_size)
    message = write_json(tmp_path / "c.mcap", [(0, zeros)], encoding="cdr", schema=(JOINTS, "ros2msg", b"int8 a"))
    with pytest.raises(RecordingError, match="at most 5000000"):
        import_recording(message, mapping())
    chunk = struct.pack("<QQQI", 0, 0, 1000, 0) + struct.pack("<I4sQ", 4, b"zstd", len(zeros)) + zeros
    (tmp_path / "d.mcap").write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk)
    with pytest.raises(RecordingError, match="1000 bytes that it declares"):
        import_recording(tmp_path / "d.mcap", mapping())


def test_memory_holds_what_the_mapping_names(tmp_path):
    """And one chunk of the file, however large it is."""
    row = {"position": [1, 2], "image": "0123456789" * 5000}
    path = write_json(tmp_path / "a.mcap", ((k, row) for k in range(400)), compression=CompressionType.NONE)
    tracemalloc.start()
    import_recording(path, mapping(time="log_time"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size > 20_000_000
    assert peak < 6_000_000


def test_a_bag_that_is_too_large_says_what_to_do(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", states())
    with pytest.raises(RecordingError, match=says("at most 1000 are read", "mcap filter")):
        import_recording(path, mapping(), max_bytes=1000)


def test_a_guess_describes_what_it_does_not_take(tmp_path):
    rows = [
        {"image": list(range(2000)), "pose": {"position": {"x": k, "y": 1, "z": 2}}, "mode": "run"} for k in range(5)
    ]
    write_json(tmp_path / "a.mcap", ((START + k * STEP, row) for k, row in enumerate(rows)))
    guess = guess_mapping(tmp_path / "a.mcap")
    assert "#   image: 2000" in guess
    assert "#   mode: text" in guess
    assert json.dumps(["pose.position.x", "pose.position.y", "pose.position.z"]) in guess
    (tmp_path / "a.toml").write_text(guess)
    assert import_recording(tmp_path / "a.mcap", tmp_path / "a.toml").names == ["joint_states_pose_position"]


def test_topics_of_commands_are_guessed(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", states(), topic="/arm_controller/commands")
    (tmp_path / "a.toml").write_text(guess_mapping(path))
    assert list(import_recording(path, tmp_path / "a.toml").commands) == ["arm_controller_commands_position"]


def test_stamps_of_messages_that_came_late_are_guessed_as_times(tmp_path):
    rows = list(states())
    late = [(row[0], *other[1:]) for row, other in zip(rows, [rows[1], rows[0], *rows[2:]], strict=True)]
    path = write_mcap(tmp_path / "a.mcap", late)
    (tmp_path / "a.toml").write_text(guess_mapping(path))
    signal = import_recording(path, tmp_path / "a.toml").signals["joint_states_position"]
    np.testing.assert_array_equal(signal.values, [position for *_, position in rows])


@pytest.mark.parametrize(
    ("ahead", "source", "said"),
    [
        ((0.0, 0.02), "header.stamp", "or log_time"),
        ((-5000.0, -5000.1), "header.stamp", "or log_time"),
        ((0.0, None), "log_time", "as only /a has header.stamp"),
        ((0.0, 3.0), "log_time", "as header.stamp of /b is 3 s ahead of that of /a"),
        ((None, None), "log_time", "or a stamp that all messages have"),
    ],
)
def test_a_guess_takes_one_clock_for_all_topics_and_says_why(tmp_path, ahead, source, said):
    """Stamps that are ahead of the times of receipt [s], or no stamps."""
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        for topic, seconds in zip(("/a", "/b"), ahead, strict=True):
            channel = writer.register_channel(topic, "json", schema)
            for k in range(10):
                time = START + k * STEP
                sec, nanosec = divmod(time + round(1e9 * (seconds or 0.0)), 10**9)
                stamp = {} if seconds is None else {"header": {"stamp": {"sec": sec, "nanosec": nanosec}}}
                writer.add_message(channel, time, json.dumps({**stamp, "x": k}).encode(), time)
        writer.finish()
    guess = guess_mapping(tmp_path / "a.mcap")
    assert f'source = "{source}"  # ' in guess and said in guess
    (tmp_path / "a.toml").write_text(guess)
    assert import_recording(tmp_path / "a.mcap", tmp_path / "a.toml").names == ["a_x", "b_x"]
