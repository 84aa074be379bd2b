"""Recordings from logs: MCAP files and LeRobot datasets."""

import json
import os

import lz4.frame
import numpy as np
import pytest
import zstandard

pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from benchmarks.fuzz_recordings import write_lerobot, write_mcap
from soro_bench.recording.importers import import_recording, mcap_file
from soro_bench.recording.recording import RecordingError
from tests.recordings import says


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap(tmp_path, compression):
    """Two topics, one with the time of the log and one with a time stamp in its messages."""
    recording = import_recording(write_mcap(tmp_path, compression), tmp_path / "map.toml")
    force, action = recording.signals["force"], recording.commands["action"]
    np.testing.assert_array_equal(force.values, np.outer(np.arange(20), [1, -1]))
    np.testing.assert_allclose(force.time, 0.01 * np.arange(20), atol=1e-15)
    np.testing.assert_allclose(action.time, 0.01 * np.arange(20), atol=1e-6)  # the stamp is a float of 1.7e9 s
    assert recording.metadata["start_time"].startswith("1700000000")


def write_messages(path, *messages, encoding="json"):
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/a", encoding, writer.register_schema("s", "jsonschema", b"{}"))
        for i, data in enumerate(messages):
            writer.add_message(channel, i, data if isinstance(data, bytes) else json.dumps(data).encode(), i)
        writer.finish()


TOPIC = '[signals.f]\ntopic = "/a"\nfields = ["pose.x", "v[1]"]\nunit = "N"\n'


@pytest.mark.parametrize(
    ("messages", "mapping", "parts"),
    [
        ([{"pose": {"x": 1}, "v": [1]}], TOPIC, ("no field v.1",)),
        ([{"pose": 3, "v": [1, 2]}], TOPIC, ("no field pose.x",)),
        ([{"pose": {"x": "left"}, "v": [1, 2]}], TOPIC, ("'left' is no number",)),
        ([{"pose": {"x": 1}, "v": [1, [2, 3]]}, {"pose": {"x": 1}, "v": [1, 2]}], TOPIC, ("2 numbers follow 3",)),
        ([b'{"pose": {"x": 1e999}, "v": [1, 2]}'], TOPIC, ("infinite",)),
        ([b'{"pose": {"x": ' + b"9" * 5000 + b'}, "v": [1, 2]}'], TOPIC, ("cannot be read",)),
        ([b"[" * 100_000], TOPIC, ("cannot be read",)),
        ([b"\x80\x04"], TOPIC, ("cannot be read",)),
        ([], TOPIC, ("no messages of topic /a",)),
        ([{}], TOPIC.replace("/a", "/b"), ("no messages of topic /b",)),
        ([{}], TOPIC.replace('"/a"', "3"), ("topic is 3",)),
        ([{}], TOPIC.replace('["pose.x", "v[1]"]', '"x"'), ("fields is 'x'",)),
        ([{}], TOPIC.replace("pose.x", "pose[x"), ("'pose[x'", "no path")),
        ([{"pose": {"x": 1}, "v": [1, 2]}], TOPIC + 'time = "v"\n', ("time [1, 2] is no number",)),
        ([{"pose": {"x": 1}, "v": [1, 2], "t": {"sec": 0.25}}], TOPIC + 'time = "t"\n', ("0.25", "whole numbers")),
    ],
)
def test_bad_messages(tmp_path, messages, mapping, parts):
    write_messages(tmp_path / "a.mcap", *messages)
    (tmp_path / "a.toml").write_text(mapping)
    with pytest.raises(RecordingError, match=says(*parts)):
        import_recording(tmp_path / "a.mcap", tmp_path / "a.toml")


def test_other_encodings_are_refused(tmp_path):
    write_messages(tmp_path / "a.mcap", b"\x00\x01", encoding="cdr")
    (tmp_path / "a.toml").write_text(TOPIC)
    with pytest.raises(RecordingError, match="'cdr'; only json"):
        import_recording(tmp_path / "a.mcap", tmp_path / "a.toml")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_is_not_decompressed_beyond_what_it_declares(compression):
    zeros = bytes(50_000_000)
    data = zstandard.compress(zeros) if compression == "zstd" else lz4.frame.compress(zeros)
    chunk = Chunk(
        compression=compression, data=data, message_end_time=0, message_start_time=0, uncompressed_crc=0,
        uncompressed_size=1000,
    )  # fmt: skip
    with pytest.raises(RecordingError, match="1000 bytes that it declares"):
        mcap_file._decompress(chunk)


def test_chunks_that_declare_too_much_are_refused(tmp_path):
    write_messages(tmp_path / "a.mcap", *[{"pose": {"x": 0}, "v": [0] * 1000}] * 300)
    (tmp_path / "a.toml").write_text(TOPIC)
    with pytest.raises(RecordingError, match=r"memory|more than"):
        import_recording(tmp_path / "a.mcap", tmp_path / "a.toml", max_bytes=(tmp_path / "a.mcap").stat().st_size)


def test_lerobot(tmp_path):
    """The second episode; images and other columns are left out."""
    write_lerobot(tmp_path / "set")
    recording = import_recording(tmp_path / "set", episode=1)
    assert recording.commands.keys() == {"action"}
    assert recording.signals.keys() == {"state"}
    assert recording.signals["state"].values.shape == (10, 3)
    np.testing.assert_allclose(recording.signals["state"].time, np.arange(10) / 20, atol=1e-7)
    assert recording.metadata == {"episode": "1", "robot": "trunk", "source": "set", "start_time": "0.0"}


def test_lerobot_with_mapping(tmp_path):
    write_lerobot(tmp_path / "set")
    mapping = '[signals.joints]\ncolumn = "observation.state"\nindices = [2, 0]\nunit = "deg"\n'
    (tmp_path / "a.toml").write_text(mapping)
    plain, mapped = import_recording(tmp_path / "set"), import_recording(tmp_path / "set", tmp_path / "a.toml")
    expected = np.radians(plain.signals["state"].values[:, [2, 0]])
    np.testing.assert_allclose(mapped.signals["joints"].values, expected)
    for bad in ("[3]", "[-1]", "[]", "[true]", '"all"'):
        (tmp_path / "a.toml").write_text(mapping.replace("[2, 0]", bad))
        with pytest.raises(RecordingError, match="0 to 2"):
            import_recording(tmp_path / "set", tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text(mapping.replace("observation.state", "task"))
    with pytest.raises(RecordingError, match="'task' has type string"):
        import_recording(tmp_path / "set", tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("info", "parts"),
    [
        ({"codebase_version": "v2.1", "features": {}}, ("version 3",)),
        ({"codebase_version": "v3.0"}, ("version 3",)),
        ([], ("version 3",)),
        ({"codebase_version": "v3.0", "features": {"video": {"dtype": "video"}}}, ("0 commands and signals",)),
        ({"codebase_version": "v3.0", "features": {"action": {"dtype": "float32"}, "observation.x": 3}}, ()),
    ],
)
def test_other_datasets_are_refused(tmp_path, info, parts):
    write_lerobot(tmp_path / "set")
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
    if parts:
        with pytest.raises(RecordingError, match=says(*parts)):
            import_recording(tmp_path / "set")
    else:
        assert import_recording(tmp_path / "set").commands.keys() == {"action"}


def test_a_dataset_in_the_cache_of_hugging_face_is_read(tmp_path):
    """Its files are links into a folder of blobs beside that of the snapshots."""
    snapshot = tmp_path / "datasets--someone--set" / "snapshots" / "0123abc"
    data = write_lerobot(snapshot)
    blobs = snapshot.parents[1] / "blobs"
    blobs.mkdir()
    for i, file in enumerate((data, snapshot / "meta" / "info.json")):
        file.rename(blobs / str(i))
        os.symlink(blobs / str(i), file)
    assert import_recording(snapshot).commands.keys() == {"action"}


def test_a_dataset_stays_in_its_folder(tmp_path):
    """Neither a pattern in its description nor a link makes it read another file."""
    data = write_lerobot(tmp_path / "set")
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    info["data_path"] = "../../{chunk_index.__class__}/etc/passwd"
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
    import_recording(tmp_path / "set")
    data.rename(tmp_path / "outside.parquet")
    os.symlink(tmp_path / "outside.parquet", data)
    with pytest.raises(RecordingError, match="leads out of the dataset"):
        import_recording(tmp_path / "set")
