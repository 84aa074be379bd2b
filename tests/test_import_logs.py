"""Recordings from logs: LeRobot datasets."""

import json
import os

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
from benchmarks.fuzz_recordings import write_lerobot
from soro_bench.recording.importers import import_recording
from soro_bench.recording.recording import RecordingError
from tests.recordings import says


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
