"""What messages of bags hold: numbers by path and by name, stamps of every form, and what nobody may trust."""

import struct

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("rosbags")
from mcap.writer import CompressionType
from rosbags.interfaces import Nodetype

from benchmarks.fuzz_recordings import write_mcap as write_two_topics
from benchmarks.write_bags import (
    HUMBLE,
    JOINTS,
    NOETIC,
    START,
    STEP,
    mapping,
    states,
    write_json,
    write_mcap,
    write_ros2,
)
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.importers.bags.fields import Run, Slot
from soro_bench.recording.importers.bags.layout import Walk, types_of
from soro_bench.recording.recording import RecordingError
from tests.arm import says

NOTES = "import_notes"


def read(path, contents, *arguments, **options):
    """The signal q of JSON messages 10 ms apart, and what the import says."""
    write_json(path / "a.mcap", ((START + k * STEP, content) for k, content in enumerate(contents)))
    recording = import_recording(path / "a.mcap", mapping(*arguments, **{"time": "log_time", **options}))
    return recording.signals["q"], recording.metadata.get(NOTES, "")


@pytest.mark.parametrize("compression", list(CompressionType))
def test_two_topics_one_with_times_of_receipt_and_one_with_stamps(tmp_path, compression):
    recording = import_recording(write_two_topics(tmp_path, compression), tmp_path / "map.toml")
    force, action = recording.signals["force"], recording.commands["action"]
    np.testing.assert_array_equal(force.values, np.outer(np.arange(20), [1, -1]))
    np.testing.assert_allclose(force.time, 0.01 * np.arange(20), atol=1e-15)
    np.testing.assert_allclose(action.time, 0.01 * np.arange(20), atol=1e-6)  # the stamp is a float of 1.7e9 s
    assert recording.metadata["start_time"].startswith("1700000000")


def random_message(store, name, rng):
    """A message of a type with random numbers, texts and lengths."""

    def value(description):
        kind, detail = description
        if kind == Nodetype.NAME:
            return random_message(store, detail, rng)
        if kind == Nodetype.BASE:
            whole = detail[0].startswith(("int", "uint", "byte", "char"))
            texts = "".join(rng.choice(list("abc/ü"), rng.integers(6)))
            return texts if detail[0] == "string" else int(rng.integers(100)) if whole else bool(rng.integers(2)) if (
                detail[0] == "bool") else float(np.float32(rng.normal()))  # fmt: skip
        inner, length = detail
        count = length if kind == Nodetype.ARRAY else rng.integers(4)
        entries = [value(inner) for _ in range(count)]
        is_number = inner[0] == Nodetype.BASE and inner[1][0] != "string"
        return np.array(entries, {"bool": "bool_"}.get(inner[1][0], inner[1][0])) if is_number else entries

    return store.types[name](*(value(description) for _, description in store.fielddefs[name][1]))


def plain(node, store):
    """What a walk found, or a message of rosbags, as lists, dicts, texts and numbers."""
    if isinstance(node, Slot):
        return node.value
    if isinstance(node, (list, Run, np.ndarray)):
        return [plain(entry, store) for entry in node]
    if hasattr(node, "__msgtype__"):
        return {name: plain(getattr(node, name), store) for name, _ in store.fielddefs[node.__msgtype__][1]}
    if isinstance(node, dict):
        return {name: plain(value, store) for name, value in node.items()}
    return str(node) if isinstance(node, str) else node


@pytest.mark.parametrize("kind", ["CDR", "CDR, big-endian", "ROS 1"])
@pytest.mark.parametrize("name", [
    JOINTS, "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "visualization_msgs/msg/MarkerArray",
    "std_msgs/msg/Float64MultiArray", "trajectory_msgs/msg/JointTrajectory", "diagnostic_msgs/msg/DiagnosticArray",
    "sensor_msgs/msg/BatteryState",
])  # fmt: skip
def test_every_field_of_a_message_is_where_rosbags_wrote_it(kind, name):
    """Two implementations agree: the library that wrote the message, and ours that reads it."""
    rng, store = np.random.default_rng(0), NOETIC if kind == "ROS 1" else HUMBLE
    text = store.generate_msgdef(name, ros_version=1 if kind == "ROS 1" else 2)[0]
    types = types_of(name, text, "")
    for _ in range(20):
        message = random_message(store, name, rng)
        if kind == "ROS 1":
            data = store.serialize_ros1(message, name)
        else:
            data = store.serialize_cdr(message, name, little_endian=kind == "CDR")
        walk = Walk(bytes(data), name, types, kind != "ROS 1")
        assert plain(walk.content, store) == plain(message, store)


def test_definitions_in_idl_are_read_too(tmp_path):
    idl = "module my_robot { module msg { struct State { double angles[2]; sequence<float> load; }; }; };"
    schema = "my_robot/msg/State", "ros2idl", ("=" * 80 + "\nIDL: my_robot/msg/State\n" + idl).encode()
    rows = [(START + k * STEP, b"\0\1\0\0" + struct.pack("<ddIf", k, -k, 1, 0.5)) for k in range(5)]
    path = write_json(tmp_path / "a.mcap", rows, encoding="cdr", schema=schema)
    values = import_recording(path, mapping(["angles", "load[0]"], "log_time")).signals["q"].values
    np.testing.assert_array_equal(values, [[k, -k, 0.5] for k in range(5)])


ORDERS = (["a", "b"], ["b", "a"], ["c", "b", "a"])


def turning(names=ORDERS, count=60):
    """Rows whose names change from message to message; a is always 1, b 2 and c 3."""
    for k in range(count):
        chosen = names[k % len(names)]
        yield START + k * STEP, START + k * STEP, chosen, [ord(name) - ord("a") + 1 for name in chosen]


@pytest.mark.parametrize("kind", ["mcap", "db3"])
@pytest.mark.parametrize("choice", [{"names": ["b", "a"]}, {"fields": ["position[name=b]", "position[name=a]"]},
                                    {"names": ["b", "a"], "names_from": "name"}])  # fmt: skip
def test_joints_are_chosen_by_name_whatever_their_order(tmp_path, kind, choice):
    path = write_ros2(tmp_path / "bag", turning(), kind)
    np.testing.assert_array_equal(import_recording(path, mapping(**choice)).signals["q"].values, [[2, 1]] * 60)


def test_joints_in_changing_order_are_not_read_by_place(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", turning())
    for field in ("position", "position[0]"):
        with pytest.raises(RecordingError, match=says("names beside the values change", "a", "to", "b", "names = [")):
            import_recording(path, mapping([field]))


def test_two_publishers_of_one_topic_become_two_signals(tmp_path):
    """Each with times of its own; together they have missing samples, which is said."""
    path = write_mcap(tmp_path / "a.mcap", turning((["a", "b"], ["c"])))
    for names, first in ((["a", "b"], 0), (["c"], 1)):
        signal = import_recording(path, mapping(names=names)).signals["q"]
        assert len(signal.time) == 30
        assert not np.isnan(signal.values).any()
        assert float(import_recording(path, mapping(names=names)).metadata["start_time"]) == pytest.approx(
            (START + first * STEP) / 1e9, abs=1e-6
        )
    recording = import_recording(path, mapping(names=["a", "c"]))
    np.testing.assert_array_equal(recording.signals["q"].values[:2], [[1, np.nan], [np.nan, 3]])
    assert "position[a], position[c] missing in up to 50 % of the samples" in recording.metadata[NOTES]
    guess = guess_mapping(path)
    assert 'names = ["a", "b"]' in guess
    assert 'names = ["c"]' in guess


def test_messages_of_one_time_are_one_sample(tmp_path):
    """Of two publishers with one clock."""
    rows = [(START + (k // 2) * STEP + k % 2, START + (k // 2) * STEP, *([["a"], [1]] if k % 2 else [["c"], [3]]))
            for k in range(20)]  # fmt: skip
    signal = import_recording(write_mcap(tmp_path / "a.mcap", rows), mapping(names=["a", "c"])).signals["q"]
    np.testing.assert_array_equal(signal.values, [[1, 3]] * 10)


def test_a_message_with_an_empty_list_is_no_sample(tmp_path):
    """Such as one of a robot that has not started yet; nor is one with fewer values than names."""
    rows = [(START + k * STEP, START + k * STEP, *((["a", "b"], [1, 2]) if k > 2 else ([], []))) for k in range(9)]
    for choice in ({}, {"names": ["a", "b"]}):
        signal = import_recording(write_mcap(tmp_path / "a.mcap", rows), mapping(**choice)).signals["q"]
        np.testing.assert_array_equal(signal.values, [[1, 2]] * 6)
    rows[5] = (*rows[5][:3], [1])
    recording = import_recording(write_mcap(tmp_path / "a.mcap", rows), mapping(names=["b"]))
    np.testing.assert_array_equal(recording.signals["q"].values, [2] * 5)
    assert "position[b]: 1 values stand beside 2 names" in recording.metadata[NOTES]


def test_a_message_without_names_or_a_stamp_is_no_sample(tmp_path):
    whole = {"name": ["a"], "position": [1.0]}
    signal, notes = read(tmp_path, [{**whole, "name": [] if k == 3 else ["a"]} for k in range(9)], names=["a"])
    assert len(signal.time) == 8 and "no list of as many names stands beside" in notes
    stamped = [{**whole, **({} if k == 3 else {"stamp": 5.0 + k})} for k in range(9)]
    signal, notes = read(tmp_path, stamped, time="stamp")
    assert len(signal.time) == 8 and "a message has no field stamp" in notes


def test_a_message_without_a_field_is_no_sample(tmp_path):
    """Which is said; that none has it is refused."""
    rows = [{"position": {"a": k}} if k % 2 else {"velocity": {"a": k}} for k in range(10)]
    signal, notes = read(tmp_path, rows, ["position.a"])
    np.testing.assert_array_equal(signal.values, [1, 3, 5, 7, 9])
    assert "5 of 10 messages are left out: a message has no field position.a; there is velocity" in notes
    short = [{"values": [k, 2] if k % 2 else [k]} for k in range(10)]
    signal, notes = read(tmp_path, short, ["values[1]"])
    np.testing.assert_array_equal(signal.values, [2] * 5)
    assert "has no field values[1]; there are 1 entries" in notes


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"time": {"unit": "ms"}, "signals": {"q": {"time": "log_time"}}}, ("[time] unit has no effect",)),
        ({"time": {"source": "log_time"}}, ("[time] source has no effect",)),
        ({"format": {"definitions": {"a/msg/B": "int8 x"}}}, ("'a/msg/B' has no effect",)),
        ({"format": {"definitions": {"a/msg/B": 3}}}, ("has texts of .msg files",)),
    ],
)
def test_entries_that_do_nothing_are_refused(tmp_path, change, parts):
    path = write_mcap(tmp_path / "a.mcap", states())
    asked = {**mapping(), **change}
    asked["signals"] = {"q": {**mapping()["signals"]["q"], **change.get("signals", {}).get("q", {})}}
    with pytest.raises(RecordingError, match=says(*parts)):
        import_recording(path, asked)


def test_names_of_entries_and_names_that_stand_alone(tmp_path):
    pairs = [(("base", 9), ("tool", k))[:: 1 - 2 * (k % 2)] for k in range(10)]
    tools = [{"transforms": [{"child_frame_id": name, "p": {"x": x}} for name, x in pair]} for pair in pairs]
    signal, _ = read(tmp_path, tools, ["transforms[child_frame_id=tool].p.x"])
    np.testing.assert_array_equal(signal.values, np.arange(10))
    with pytest.raises(RecordingError, match="names beside the values change"):
        read(tmp_path, tools, ["transforms[0].p.x"])
    tags = [{"detections": [{"id": 3 + k % 2, "x": 1}, {"id": 4 - k % 2, "x": 2}]} for k in range(10)]
    signal, _ = read(tmp_path, tags, ["detections[id=3].x"])
    np.testing.assert_array_equal(signal.values, [1, 2] * 5)
    motors = [{"name": f"m{k % 2}", "angle": k} for k in range(10)]
    signal, _ = read(tmp_path, motors, ["angle"], names=["m1"])
    np.testing.assert_array_equal(signal.values, [1, 3, 5, 7, 9])
    with pytest.raises(RecordingError, match="names beside the values change"):
        read(tmp_path, motors, ["angle"])


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"names": ["x"]}, ("has a name that is asked for", "there are a, b")),
        ({"names": ["a"], "fields": ["position[name=b]"]}, ("names and a name in the path",)),
        ({"names_from": "name"}, ("names_from has no effect",)),
        ({"names": ["a"], "fields": ["header.stamp.sec"]}, ("has a name that is asked for", "there are base")),
        ({"fields": ["header"]}, ("holds stamp, frame_id",)),
        ({"fields": ["positions"]}, ("no field positions", "there are header, name, position")),
        ({"fields": ["position[2]"]}, ("no field position[2]", "there are 2 entries")),
        ({"fields": ["name"]}, ("'a' is a text, no number",)),
        ({"time": "header"}, ("time holds stamp, frame_id",)),
        ({"time": "name"}, ("is no number",)),
    ],
)
def test_what_a_mapping_asks_for_and_messages_have_not(tmp_path, options, parts):
    with pytest.raises(RecordingError, match=says(*parts)):
        import_recording(write_mcap(tmp_path / "a.mcap", states()), mapping(**options))


TEXT = '[signals.f]\ntopic = "/joint_states"\nfields = ["pose.x", "v[1]"]\nunit = "N"\n'


@pytest.mark.parametrize(
    ("messages", "text", "parts"),
    [
        ([{"pose": {"x": 1}, "v": [1]}], TEXT, ("no field v[1]",)),
        ([{"pose": 3, "v": [1, 2]}], TEXT, ("no field pose.x",)),
        ([{"pose": {"x": "left"}, "v": [1, 2]}], TEXT, ("'left' is no number",)),
        (
            [{"pose": {"x": 1}, "v": [1, [2, 3]]}, {"pose": {"x": 1}, "v": [1, 2]}],
            TEXT,
            ("2 numbers follow 3", "names"),
        ),
        ([b'{"pose": {"x": ' + b"9" * 5000 + b'}, "v": [1, 2]}'], TEXT, ("cannot be read",)),
        ([b"[" * 100_000], TEXT, ("cannot be read",)),
        ([b"\x80\x04"], TEXT, ("cannot be read",)),
        ([b" " * 6_000_000], TEXT, ("a message of 6000000 bytes",)),
        ([], TEXT, ("no messages of topic /joint_states",)),
        ([{}], TEXT.replace('"/joint_states"', "3"), ("topic is 3",)),
        ([{}], TEXT.replace('["pose.x", "v[1]"]', '"x"'), ("fields is 'x'",)),
        ([{}], TEXT.replace("pose.x", "pose[x"), ("'pose[x'", "no path")),
        ([{"pose": {"x": 1}, "v": [1, 2]}], TEXT + 'time = "v"\n', ("time [1, 2] is no number",)),
        ([{"pose": {"x": 1}, "v": [1, 2], "t": {"sec": 0.25}}], TEXT + 'time = "t"\n', ("0.25", "whole numbers")),
        ([{"pose": {"x": 1}, "v": [1, 2], "t": 1e30}], TEXT + 'time = "t"\n', ("out of range", "unit")),
    ],
)
def test_bad_messages(tmp_path, messages, text, parts):
    write_json(tmp_path / "a.mcap", enumerate(messages))
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(RecordingError, match=says(*parts)):
        import_recording(tmp_path / "a.mcap", tmp_path / "a.toml")


def test_other_encodings_are_refused(tmp_path):
    write_json(tmp_path / "a.mcap", [(0, b"\x00\x01")], encoding="protobuf")
    with pytest.raises(RecordingError, match=says("protobuf", "only json, cdr and ros1")):
        import_recording(tmp_path / "a.mcap", mapping(time="log_time"))
    assert "not read: encoded as protobuf" in guess_mapping(tmp_path / "a.mcap")


def test_missing_numbers(tmp_path):
    """Null, NaN as a text, and what is infinite, which is said."""
    written = ["NaN", "nan", None, 1e999, "-Infinity", "n/a", "", "null", 7, "8.5"]
    signal, notes = read(tmp_path, [{"position": [value, 1]} for value in written])
    np.testing.assert_array_equal(signal.values[:, 0], [np.nan] * 8 + [7, 8.5])
    assert "2 infinite numbers are taken as missing" in notes
    assert not read(tmp_path, [{"position": ["NaN", 1]}, {"position": [1, 1]}])[1]
    signal, _ = read(tmp_path, [{"position": [value]} for value in (1, None, "NaN", 4)])
    assert (signal.values.tolist(), np.round(signal.time, 9).tolist()) == ([1, 4], [0, 0.03])
    with pytest.raises(RecordingError, match="no message has a number"):
        read(tmp_path, [{"position": [None]}])


STAMPS = {
    "ROS 2": lambda ns: {"sec": ns // 10**9, "nanosec": ns % 10**9},
    "ROS 1": lambda ns: {"secs": ns // 10**9, "nsecs": ns % 10**9},
    "protobuf": lambda ns: {"seconds": str(ns // 10**9), "nanos": ns % 10**9},
    "RFC 3339": lambda ns: f"2024-06-26T20:29:{ns // 10**9 % 60:02d}.{ns % 10**9:09d}Z",
    "RFC 3339 in another zone": lambda ns: f"2024-06-26 22:29:{ns // 10**9 % 60:02d}.{ns % 10**9:09d}+02:00",
    "text": lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}",
    "ns": lambda ns: ns,
    "ns as text": lambda ns: str(ns),
    "whole floats": lambda ns: {"sec": float(ns // 10**9), "nanosec": float(ns % 10**9)},
}


@pytest.mark.parametrize("form", STAMPS)
def test_stamps_of_every_form(tmp_path, form):
    rows = [{"t": STAMPS[form](START + k * k * STEP), "position": [k]} for k in range(10)]
    write_json(tmp_path / "a.mcap", ((k, row) for k, row in enumerate(rows)))
    unit = {"time": {"unit": "ns"}} if form.startswith("ns") else {}
    recording = import_recording(tmp_path / "a.mcap", {**mapping(time="t"), **unit})
    exact = 1e-6 if form == "text" else 1e-9  # it is a number of 1.7e9 s
    np.testing.assert_allclose(recording.signals["q"].time, 0.01 * np.arange(10) ** 2, rtol=0, atol=exact)
    assert float(recording.metadata["start_time"]) == pytest.approx(START / 1e9, abs=1e-6)


@pytest.mark.parametrize(("unit", "bits", "tick"), [("us", 32, STEP // 1000), ("ms", 32, 10), ("ms", 16, 10)])
def test_a_stamp_of_a_counter_that_overflows_is_unwrapped_and_said(tmp_path, unit, bits, tick):
    contents = [{"t": (2**bits - 20 * tick + k * tick) % 2**bits, "position": [k]} for k in range(40)]
    write_json(tmp_path / "a.mcap", ((START + k * STEP, content) for k, content in enumerate(contents)))
    recording = import_recording(tmp_path / "a.mcap", {**mapping(time="t"), "time": {"unit": unit}})
    np.testing.assert_allclose(recording.signals["q"].time, 0.01 * np.arange(40), atol=1e-9)
    assert f"a clock of {bits} bits that are unwrapped: 1" in recording.metadata[NOTES]


def test_the_unit_in_the_name_of_a_stamp_is_asked_for(tmp_path):
    with pytest.raises(RecordingError, match=says("'t_ms' says ms", 'unit = "ms"')):
        read(tmp_path, [{"t_ms": 10 * k, "position": [k]} for k in range(9)], time="t_ms")
    stamps = [{"stamp_us": {"sec": 0, "nanosec": k * STEP}, "position": [k]} for k in range(9)]
    np.testing.assert_allclose(read(tmp_path, stamps, time="stamp_us")[0].time, 0.01 * np.arange(9), atol=1e-9)


@pytest.mark.parametrize("odd", [b"", b'{"t": 1, "position": [1', b'{"t": null, "position": [1]}', b"\xff{}"])
def test_a_message_that_is_damaged_or_has_no_stamp_is_left_out(tmp_path, odd):
    write_json(tmp_path / "a.mcap", ((k, odd if k == 3 else {"t": k, "position": [k]}) for k in range(9)))
    recording = import_recording(tmp_path / "a.mcap", mapping(time="t"))
    assert recording.signals["q"].values.tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    assert "1 of 9 messages are left out" in recording.metadata[NOTES]
    assert "position" in guess_mapping(tmp_path / "a.mcap")
    write_json(tmp_path / "a.mcap", [(0, odd)])
    with pytest.raises(RecordingError, match=says("joint_states", "a message")):
        import_recording(tmp_path / "a.mcap", mapping(time="t"))


def stamped(stamps):
    """Messages whose stamps are these [ns]."""
    return [(START + k * STEP, stamp, ["a"], [k]) for k, stamp in enumerate(stamps)]


def test_stamps_that_are_not_set_are_left_out(tmp_path):
    """Zeros, and the clock of a computer that was not set yet."""
    true = [START + k * STEP for k in range(50)]
    for early in ([0, 1, 2], [35 * 10**9 + k for k in range(3)]):
        recording = import_recording(write_mcap(tmp_path / "a.mcap", stamped(early + true[3:])), mapping())
        np.testing.assert_array_equal(recording.signals["q"].values, np.arange(3, 50))
        np.testing.assert_allclose(recording.signals["q"].time, 0.01 * np.arange(47), atol=1e-9)
        assert "3 of 50 stamps in header.stamp are not set" in recording.metadata[NOTES]
    for still in ([0] * 50, list(range(50))):
        with pytest.raises(RecordingError, match=says("stand still", 'time = "log_time"')):
            import_recording(write_mcap(tmp_path / "a.mcap", stamped(still)), mapping())
    simulated = import_recording(write_mcap(tmp_path / "a.mcap", stamped(range(0, 25 * STEP, STEP // 2))), mapping())
    np.testing.assert_allclose(simulated.signals["q"].time, 0.005 * np.arange(50), atol=1e-9)  # a clock of its own
    assert NOTES not in simulated.metadata
    slow = import_recording(write_mcap(tmp_path / "a.mcap", stamped(range(0, 200 * STEP, STEP // 2))), mapping())
    assert "header.stamp and the times of receipt drift apart by -1.8 s" in slow.metadata[NOTES]


def test_messages_out_of_order(tmp_path):
    """Sorted if they came late; a clock that was set back is for the mapping to decide."""
    swapped = [START + (k + (1, -1)[k % 2]) * STEP for k in range(50)]
    recording = import_recording(write_mcap(tmp_path / "a.mcap", stamped(swapped)), mapping())
    np.testing.assert_array_equal(recording.signals["q"].values[:4], [1, 0, 3, 2])
    assert "25 messages came up to 0.01 s later" in recording.metadata[NOTES]
    for back in (16 * STEP, 10**11):  # a clock that is set by NTP, as header.stamp and as log_time
        times = [START + k * STEP - back * (k > 24) for k in range(50)]
        log = write_mcap(tmp_path / "a.mcap", [(t, t, ["a"], [k]) for k, t in enumerate(times)])
        for time in ("header.stamp", "log_time"):
            with pytest.raises(RecordingError, match=says("time does not increase", "order", '"continue"')):
                import_recording(log, mapping(time=time))
            signal = import_recording(log, {**mapping(time=time), "time": {"order": "continue"}}).signals["q"]
            np.testing.assert_array_equal(signal.values, np.arange(50))
            np.testing.assert_allclose(signal.time, 0.01 * np.arange(50), atol=1e-9)
    again = [START + (k % 25) * 10 * STEP for k in range(50)]  # as a simulation that is started again
    path = write_mcap(tmp_path / "a.mcap", stamped(again))
    with pytest.raises(RecordingError, match=says("time does not increase", "order")):
        import_recording(path, mapping())
    recording = import_recording(path, {**mapping(), "time": {"order": "keep_first"}})
    np.testing.assert_array_equal(recording.signals["q"].values, np.arange(25))
    rows = list(reversed(list(states())))
    recording = import_recording(write_mcap(tmp_path / "a.mcap", rows), mapping())  # only in the file
    np.testing.assert_array_equal(recording.signals["q"].values, [position for *_, position in states()])
    assert "199 messages lie in the file behind later ones" in recording.metadata[NOTES]


def test_stamps_that_repeat(tmp_path):
    held = [START + k // 2 * 2 * STEP for k in range(50)]
    with pytest.raises(RecordingError, match=says("25 of 50 stamps in header.stamp repeat", 'time = "log_time"')):
        import_recording(write_mcap(tmp_path / "a.mcap", stamped(held)), mapping())
    twice = [(START + k, START + k // 2 * STEP, ["a"], [k // 2]) for k in range(50)]
    signal = import_recording(write_mcap(tmp_path / "a.mcap", twice), mapping()).signals["q"]
    np.testing.assert_array_equal(signal.values, np.arange(25))


def test_a_pause_is_said(tmp_path):
    """Such as a recorder that stalled, or one message that was kept from long before."""
    for rows, after in ((stamped([START + (k + 500 * (k > 19)) * STEP for k in range(50)]), "0.19 s after"),
                        (stamped([START - 10**10, *range(START, START + 20 * STEP, STEP)]), "0 s after")):  # fmt: skip
        notes = import_recording(write_mcap(tmp_path / "a.mcap", rows), mapping()).metadata[NOTES]
        assert "nothing came for" in notes
        assert after in notes


def test_signals_of_two_clocks_are_refused(tmp_path):
    both = mapping()
    both["signals"]["p"] = {**both["signals"]["q"], "time": "log_time"}
    path = write_mcap(tmp_path / "a.mcap", stamped(range(0, 50 * STEP, STEP)))
    with pytest.raises(RecordingError, match=says("signals.p begins", "their clocks differ", "log_time")):
        import_recording(path, both)


def test_seconds_and_microseconds_are_refused_by_name(tmp_path):
    """Only whole seconds of them would be left."""
    rows = [(START + k * STEP, {"stamp": {"sec": k, "usec": 5}, "position": [k]}) for k in range(5)]
    with pytest.raises(RecordingError, match=says("sec, usec", "usec is not read", "log_time")):
        import_recording(write_json(tmp_path / "a.mcap", rows), mapping(time="stamp"))
