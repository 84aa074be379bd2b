"""Recordings from LeRobot datasets of versions 2 and 3."""

import json
import os
import shutil

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.fuzz_recordings import write_lerobot
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.recording import RecordingError
from tests.arm import says


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


JOINTS = ["shoulder_pan.pos", "shoulder_lift.pos", "gripper.pos"]
STATE = 'column = "observation.state"\n'


def write_dataset(folder, version="v3.0", episodes=(4, 6, 5), declared=None, **info):
    """A dataset as lerobot writes it, with counted numbers: rows of an episode may lie in two files of version 3."""
    feature = {"dtype": "float32", "shape": [3], "names": JOINTS}
    features = {
        "action": feature,
        "observation.state": feature,
        "observation.effort": {"dtype": "float32", "shape": [1], "names": None},
        "observation.grid": {"dtype": "float32", "shape": [2, 2], "names": {"axes": ["x", "y"]}},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    said = {"codebase_version": version, "robot_type": "so101_follower", "total_episodes": len(episodes), "fps": 50,
            "features": features, **info}  # fmt: skip
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({key: value for key, value in said.items() if value != "no"}))
    index = np.repeat(np.arange(len(episodes)), episodes)
    frame = np.concatenate([np.arange(length) for length in episodes])
    numbers = np.arange(3 * len(index), dtype=np.float32)
    table = pa.table({
        "action": pa.FixedSizeListArray.from_arrays(-numbers, 3),
        "observation.state": pa.FixedSizeListArray.from_arrays(numbers, 3),
        "observation.effort": numbers[: len(index)],
        "observation.grid": pa.array([[[1.0, 2.0], [3.0, 4.0]]] * len(index), pa.list_(pa.list_(pa.float32()))),
        "timestamp": (frame / 50).astype(np.float32),
        "frame_index": frame,
        "episode_index": index,
    })  # fmt: skip
    lengths = list(declared or episodes)
    if version.startswith("v2"):
        lines = [json.dumps({"episode_index": i, "tasks": ["reach"], "length": n}) for i, n in enumerate(lengths)]
        (folder / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
        parts = {f"chunk-000/episode_{i:06d}": table.filter(index == i) for i in range(len(episodes))}
    else:
        half = [len(index) * (2 * i + 1) // 4 for i in range(2)]  # in the middle of episodes
        cuts = [0, *half, len(index)]
        parts = {f"chunk-000/file-{i:03d}": table.slice(cuts[i], cuts[i + 1] - cuts[i]) for i in range(3)}
        first = [int(np.searchsorted(cuts, np.flatnonzero(index == i)[0], "right")) - 1 for i in range(len(episodes))]
        about = {"episode_index": list(range(len(episodes))), "length": lengths, "data/file_index": first,
                 "data/chunk_index": [0] * len(episodes), "tasks": [["reach"]] * len(episodes)}  # fmt: skip
        (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(pa.table(about), folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    for name, part in parts.items():
        path = folder / "data" / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(part, path, row_group_size=3)
    return folder


def imported(folder, mapping=None, **selection):
    """With a mapping as text."""
    if mapping is not None:
        folder.with_suffix(".toml").write_text(mapping)
    return import_recording(folder, folder.with_suffix(".toml") if mapping else None, **selection)


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
@pytest.mark.parametrize("meta", [True, False])
def test_every_episode_is_read_whole(tmp_path, version, meta):
    """Of each version, also where its rows lie in two files, and where meta/ does not say in which it begins."""
    folder = write_dataset(tmp_path / "set", version)
    if not meta:
        shutil.rmtree(folder / "meta" / "episodes", ignore_errors=True)
        (folder / "meta" / "episodes.jsonl").unlink(missing_ok=True)
    begin = 0
    for episode, length in enumerate((4, 6, 5)):
        signal = imported(folder, episode=episode).signals["state"]
        np.testing.assert_allclose(signal.time, np.arange(length) / 50, atol=1e-6)
        np.testing.assert_array_equal(signal.values.ravel(), 3 * begin + np.arange(3 * length))
        begin += length
    effort, grid = (imported(folder).signals[name].values for name in ("effort", "grid"))
    np.testing.assert_array_equal(effort, np.arange(4))
    np.testing.assert_array_equal(grid, [[[1, 2], [3, 4]]] * 4)


@pytest.mark.parametrize("names", [JOINTS, {"motors": JOINTS}, {name: i for i, name in enumerate(JOINTS)}])
def test_joints_are_chosen_by_name(tmp_path, names):
    features = {"observation.state": {"dtype": "float32", "shape": [3], "names": names}}
    folder = write_dataset(tmp_path / "set", features=features)
    mapping = f'[signals.q]\n{STATE}names = ["gripper.pos", "shoulder_pan.pos"]\nunit = "deg"\n'
    values = imported(folder, mapping).signals["q"].values
    np.testing.assert_allclose(values, np.radians(np.arange(12.0).reshape(4, 3)[:, [2, 0]]))
    with pytest.raises(RecordingError, match=says("signals.q", "'elbow' stands there 0 times", "shoulder_lift.pos")):
        imported(folder, mapping.replace("gripper.pos", "elbow"))


def test_numbers_normalised_to_the_range_of_a_motor_become_angles(tmp_path):
    """As lerobot has degrees: from the middle of the range, 4095 steps a turn; the gripper counts from 0 to 100."""
    folder = write_dataset(tmp_path / "set")
    mapping = f"""
        [signals.q]
        {STATE}
        range_min = [1000, 2000, 2048]
        range_max = [3000, 3000, 3072]
        normalised = [[-100, 100], [-100, 100], [0, 100]]
        sign = [1, -1, 1]
    """
    signal = imported(folder, mapping).signals["q"]
    numbers = np.arange(12.0).reshape(4, 3)
    turn = 2 * np.pi / 4095
    expected = np.stack([numbers[:, 0] * 10, -numbers[:, 1] * 5, (numbers[:, 2] - 50) * 10.24], axis=1)
    np.testing.assert_allclose(signal.values, turn * expected)
    assert signal.unit == "rad"
    one = f"[signals.q]\n{STATE}names = ['shoulder_lift.pos']\nrange_min = 2000\nrange_max = 3000\n"
    np.testing.assert_allclose(imported(folder, one).signals["q"].values, turn * numbers[:, 1] * 5)


RANGES = f"[signals.q]\n{STATE}range_min = [0, 0, 0]\nrange_max = [9, 9, 9]\n"


@pytest.mark.parametrize(
    ("mapping", "parts"),
    [
        (f"[signals.q]\n{STATE}", ("observation.state", 'unit = "deg"', "range_min")),
        (RANGES + 'unit = "rad"\n', ("signals.q", "'rad'", "leave unit out")),
        (RANGES.replace("range_max", "normalised"), ("range_min needs", "range_max")),
        (RANGES.replace("[9, 9, 9]", "[9, 0, 9]"), ("range_max has to exceed range_min",)),
        (RANGES.replace("[9, 9, 9]", "[9, 9]"), ("a number", "each of the 3 numbers")),
        (RANGES + "normalised = [-100, 0, 100]\n", ("[from, to]",)),
        (RANGES + "indices = [0]\nnames = ['gripper.pos']\n", ("both names and indices",)),
        (RANGES.replace("state", "effort") + "names = ['x']\n", ("no names of 'observation.effort'", "indices")),
        (RANGES.replace("state", "speed"), ("no column 'observation.speed'", "observation.effort")),
    ],
)
def test_a_mapping_that_contradicts_itself_or_the_dataset(tmp_path, mapping, parts):
    with pytest.raises(RecordingError, match=says(*parts)) as error:
        imported(write_dataset(tmp_path / "set"), mapping)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("info", "parts"),
    [
        ({"codebase_version": "no"}, ("no codebase_version", '"v3.0"')),
        ({"codebase_version": "v1.6"}, ("codebase_version = 'v1.6'", "convert it with lerobot")),
        ({"codebase_version": 3}, ("codebase_version = 3",)),
        ({"codebase_version": "v2.1"}, ("says version 2", "file-*.parquet", "correct codebase_version")),
        ({"features": "no"}, ("no features by name",)),
        ({"features": {"video": {"dtype": "video"}}}, ("0 commands and signals",)),
        ({"features": {"action": {"dtype": "float32", "shape": [6]}}}, ("shape [6]", "3 numbers")),
        ({"fps": 0}, ("fps = 0", "frames per second")),
        ({"fps": 30}, ("fps = 30", "0.02 s apart", "[time] rate")),
        ({"total_episodes": "all"}, ("total_episodes = 'all'",)),
        ({"total_episodes": 1}, ("no episode 1; there are 1, counted from 0",)),
        ({"declared": (4, 60, 5)}, ("episode 1 has 6 of 60 rows", "download all files")),
    ],
)
def test_missing_or_contradictory_entries_of_a_dataset(tmp_path, info, parts):
    with pytest.raises(RecordingError, match=says("set", *parts)) as error:
        imported(write_dataset(tmp_path / "set", **info), episode=1)
    assert "\n" not in str(error.value)


def test_names_that_do_not_fit_the_shape(tmp_path):
    features = {"observation.state": {"dtype": "float32", "shape": [3], "names": JOINTS[:2]}}
    folder = write_dataset(tmp_path / "set", features=features)
    with pytest.raises(RecordingError, match=says("2 names of 'observation.state', whose shape is [3]")):
        imported(folder, f'[signals.q]\n{STATE}names = ["gripper.pos"]\nunit = "deg"\n')


def test_a_rate_in_the_mapping_comes_before_the_time_stamps(tmp_path):
    folder = write_dataset(tmp_path / "set", fps=25)
    signal = imported(folder, f'[time]\nrate = 25\n[signals.q]\n{STATE}unit = "deg"\n').signals["q"]
    np.testing.assert_allclose(signal.time, np.arange(4) / 25)


def test_a_guess_of_a_dataset_is_a_mapping_that_imports_it(tmp_path):
    folder = write_dataset(tmp_path / "set")
    written = guess_mapping(folder)
    assert json.dumps(JOINTS) in written
    recording = imported(folder, written)
    assert (recording.commands.keys(), recording.signals.keys()) == ({"action"}, {"state", "effort", "grid"})


@pytest.mark.parametrize("info", [[], {"codebase_version": "v3.0"}, "text"])
def test_other_json_is_no_dataset(tmp_path, info):
    write_lerobot(tmp_path / "set")
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(RecordingError, match=r"set.*meta/info\.json"):
        import_recording(tmp_path / "set")


def test_features_that_are_none_are_left_out(tmp_path):
    write_lerobot(tmp_path / "set")
    info = {"codebase_version": "v3.0", "features": {"action": {"dtype": "float32"}, "observation.x": 3}}
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps(info))
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
