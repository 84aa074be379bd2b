"""Recordings for the rerun viewer."""

import importlib.util
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from soro_bench.arrays import rotate_by_quaternion
from soro_bench.evaluation import evaluate
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.recording import rerun_log
from soro_bench.recording.drawing import Drawing, Mesh
from soro_bench.recording.rerun_log import DRAWINGS, RERUN, viewer_environment, write_recording
from soro_bench.recording.trunk_drawing import draw_trunk, tension_colors
from soro_bench.registration import task_type

rr = pytest.importorskip("rerun")
from rerun.chunk import RrdReader  # noqa: E402

STEPS = 10
STARTS = {
    "TrunkReach-v0": {"goal": [0.02, -0.03, 0.13]},
    "TrunkPush-v0": {},
    "TrunkLift-v0": {"params": {"wall_offset": 0.02}},
}


def run_episode(env_id, action="continuous", seed=0):
    rng = np.random.default_rng(seed)

    def act(observation):
        n = len(observation)
        return rng.integers(16, size=n) if action == "discrete" else rng.uniform(-1, 1, (n, 8))

    (episode,) = evaluate(act, env_id, "cable", action, [STARTS[env_id]], num_threads=1)
    return cut(episode, STEPS)


def cut(episode, steps):
    """The first ``steps`` steps of an episode."""
    return replace(
        episode,
        time=episode.time[: steps + 1],
        signals={name: values[: steps + 1] for name, values in episode.signals.items()},
        actions=episode.actions[:steps],
        rewards={name: values[:steps] for name, values in episode.rewards.items()},
        metric=episode.metric[: steps + 1],
    )


@pytest.fixture(scope="module")
def episodes():
    return {env_id: run_episode(env_id) for env_id in STARTS}


@pytest.fixture(scope="module")
def reach(episodes):
    return episodes["TrunkReach-v0"]


def chunks(path):
    return RrdReader(path).stream().to_chunks()


def rows(path):
    """Number of rows over time of every entity."""
    counts = {}
    for chunk in chunks(path):
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + (0 if chunk.is_static else chunk.num_rows)
    return counts


def content(path):
    """Everything in a recording but rerun's ids."""
    tables = []
    for chunk in chunks(path):
        table = chunk.to_record_batch().to_pydict()
        del table["rerun.controls.RowId"]
        tables.append((chunk.entity_path, str(table)))
    return sorted(tables)


@pytest.mark.parametrize("env_id", STARTS)
def test_file_holds_every_state_of_the_robot_and_its_plots(env_id, episodes, tmp_path):
    write_recording(tmp_path / "a.rrd", [episodes[env_id]], "a")
    counts = rows(tmp_path / "a.rrd")
    moving = ["world/skin/link00", "world/skin/link10", "world/backbone", "world/cables/L0", "world/cables/S3"]
    for name in [*moving, f"plots/{task_type(env_id).metric}", "plots/tension", "plots/commanded"]:
        assert counts[f"/episode_01/{name}"] == STEPS + 1
    for name in ("reward/reward_progress", "reward/reward_time", "action"):
        assert counts[f"/episode_01/plots/{name}"] == STEPS
    assert {"/episode_01/world/goal", "/episode_01/summary", "/episodes"} <= counts.keys()
    assert ("/episode_01/world/floor" in counts) == (env_id != "TrunkReach-v0")
    assert counts.get("/episode_01/world/object") == (None if env_id == "TrunkReach-v0" else STEPS + 1)
    assert ("/episode_01/world/wall" in counts) == (env_id == "TrunkLift-v0")


def test_file_holds_one_recording_and_its_layout(reach, tmp_path):
    write_recording(tmp_path / "a.rrd", [reach], "a")
    reader = RrdReader(tmp_path / "a.rrd")
    assert [entry.application_id for entry in reader.recordings() + reader.blueprints()] == ["soro_bench"] * 2
    views = {chunk.entity_path.split("/")[1] for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks()}
    assert {"viewport", "view", "container", "time_panel"} <= views


def test_times_are_those_of_the_episode(reach, tmp_path):
    write_recording(tmp_path / "a.rrd", [reach], "a")
    (chunk,) = [c for c in chunks(tmp_path / "a.rrd") if c.entity_path.endswith("tension") and not c.is_static]
    assert chunk.timeline_names == ["time"]
    nanoseconds = chunk.to_record_batch().column("time").to_numpy(zero_copy_only=False).astype(int)
    np.testing.assert_array_equal(nanoseconds, 50_000_000 * np.arange(STEPS + 1))


def test_episodes_may_differ_in_length_and_kind_of_action(reach, tmp_path):
    discrete = run_episode("TrunkReach-v0", "discrete")
    write_recording(tmp_path / "a.rrd", [reach, cut(discrete, 4)], "a")
    counts = rows(tmp_path / "a.rrd")
    assert counts["/episode_01/world/backbone"] == STEPS + 1
    assert counts["/episode_02/world/backbone"] == 5
    assert counts["/episode_02/plots/action"] == 4


def test_the_same_episodes_give_the_same_content(episodes, tmp_path):
    for name in ("a.rrd", "b.rrd"):
        write_recording(tmp_path / name, [episodes["TrunkReach-v0"], episodes["TrunkLift-v0"]], "title")
    first, second = (RrdReader(tmp_path / name).recordings()[0].recording_id for name in ("a.rrd", "b.rrd"))
    assert first == second
    assert content(tmp_path / "a.rrd") == content(tmp_path / "b.rrd")


def test_other_episodes_of_the_same_title_are_another_recording(reach, tmp_path):
    write_recording(tmp_path / "a.rrd", [reach], "title")
    write_recording(tmp_path / "b.rrd", [cut(reach, 3)], "title")
    first, second = (RrdReader(tmp_path / name).recordings()[0].recording_id for name in ("a.rrd", "b.rrd"))
    assert first != second


def test_a_failed_write_leaves_the_old_file_and_nothing_else(reach, tmp_path):
    path = tmp_path / "a.rrd"
    write_recording(path, [reach], "a")
    before = path.read_bytes()
    with pytest.raises(ValueError, match="length"):
        write_recording(path, [reach, replace(reach, time=reach.time[:-1])], "b")
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]
    assert path.read_bytes() == before


def test_a_folder_that_cannot_be_written_raises_and_nothing_is_left(reach, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError):
        write_recording(tmp_path / "file" / "a.rrd", [reach], "a")
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_writing_touches_no_other_recording(reach, tmp_path):
    write_recording(tmp_path / "a.rrd", [reach], "a")
    assert rr.get_data_recording() is None


def test_a_diverged_episode_can_be_written(reach, tmp_path):
    signals = {name: values.copy() for name, values in reach.signals.items()}
    distance = reach.metric.copy()
    for values in (distance, *signals.values()):
        values[5:] = np.nan
    write_recording(tmp_path / "a.rrd", [replace(reach, signals=signals, metric=distance, diverged=True)], "a")
    assert rows(tmp_path / "a.rrd")["/episode_01/world/backbone"] == STEPS + 1


def test_no_episodes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one episode"):
        write_recording(tmp_path / "a.rrd", [], "a")


def test_an_environment_without_drawing_is_refused(reach, tmp_path):
    with pytest.raises(ValueError, match="Walker-v0 has no drawing"):
        write_recording(tmp_path / "a.rrd", [replace(reach, env_id="Walker-v0")], "a")


def test_without_rerun_the_error_says_what_to_install(reach, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install soro_bench\[view\]"):
        write_recording(tmp_path / "a.rrd", [reach], "a")


def test_rerun_accepts_the_file_and_collects_no_usage_statistics(reach, tmp_path, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    write_recording(tmp_path / "a.rrd", [reach], "a")
    subprocess.run([*RERUN, "rrd", "verify", str(tmp_path / "a.rrd")], env=viewer_environment(), check=True)
    assert list(home.iterdir()) == []
    (tmp_path / "b.rrd").write_bytes((tmp_path / "a.rrd").read_bytes()[:1000])
    broken = subprocess.run([*RERUN, "rrd", "verify", str(tmp_path / "b.rrd")], env=viewer_environment())
    assert broken.returncode != 0


def test_viewer_opens_the_file_without_usage_statistics_for_this_machine_only(tmp_path, monkeypatch):
    calls, status = [], [0, 1]

    def run(command, env):
        calls.append((command, env))
        return subprocess.CompletedProcess(command, status.pop(0))

    monkeypatch.setattr(subprocess, "run", run)
    (tmp_path / "a.rrd").touch()
    rerun_log.open_viewer(tmp_path / "a.rrd")
    assert calls == [([*RERUN, "--bind", "127.0.0.1", str(tmp_path / "a.rrd")], viewer_environment())]
    with pytest.raises(ValueError, match="needs a display"):
        rerun_log.open_viewer(tmp_path / "a.rrd")


def test_opening_a_missing_file_raises(tmp_path):
    with pytest.raises(FileNotFoundError):
        rerun_log.open_viewer(tmp_path / "a.rrd")


def test_cables_run_through_the_eyelets_of_the_simulation():
    task = task_type("TrunkReach-v0")(1, model="cable")
    ids = np.arange(1)
    task.reset(ids, [np.random.default_rng(0)], [{}])
    for _ in range(STEPS):
        task.step(ids, np.array([1]))
    lines = draw_trunk(replace(run_episode("TrunkReach-v0"), signals=task.signals(ids))).lines  # one state
    for name, count in (("L1", 21), ("S2", 10)):
        sites = [task.model.site(f"{name}_{i}").id for i in range(count)]
        np.testing.assert_allclose(lines[f"cables/{name}"].points[0], task.sim.batch.site_xpos[0, sites], atol=1e-9)
    np.testing.assert_allclose(lines["backbone"].points, task.keypoints(ids))


def test_skin_pieces_stay_within_their_radius_of_the_backbone(reach):
    """A skin piece follows its link: its farthest vertex is 13 mm off the axis, at the clamp."""
    for mesh in draw_trunk(reach).meshes.values():
        quaternion = np.roll(mesh.pose.quaternion, 1, axis=-1)[:, None]
        vertices = mesh.pose.position[:, None] + rotate_by_quaternion(mesh.vertices, quaternion)
        distance = np.linalg.norm(vertices[:, :, None] - reach.signals["keypoints"][:, None], axis=-1).min(axis=-1)
        assert distance.max() < 0.018  # a vertex is at most 12 mm from a keypoint along the axis


def test_a_trunk_is_as_thick_as_its_model(reach):
    """Discs of the mesh's outer radius, and necks of theirs from each disc to the next."""
    drawing, heights = draw_trunk(reach), {}
    for k, name in enumerate(drawing.body):
        rest = drawing.meshes[name].vertices + np.array([0, 0, geo.NECK_MIDDLE[k - 1] if k else 0])
        radii = np.linalg.norm(rest[:, :2], axis=1).round(7)
        outer = geo.outer_radius(rest[:, 2]).round(7)
        assert set(radii - outer * (radii > geo.NECK_RADIUS)) <= {0.0, geo.NECK_RADIUS}
        heights[name] = set(rest[radii == geo.NECK_RADIUS, 2].round(9))
    faces = np.sort(np.concatenate([geo.NECK_START, geo.NECK_END]).round(9))
    assert set(faces) <= set().union(*heights.values()) and len(heights) == geo.NUM_NECKS + 1


def test_objects_and_walls_stand_where_the_simulation_has_them(episodes):
    lift = draw_trunk(episodes["TrunkLift-v0"])
    positions = episodes["TrunkLift-v0"].signals["object_position"]
    np.testing.assert_array_equal(lift.boxes["object"].pose.position, positions)
    np.testing.assert_allclose(2 * lift.boxes["object"].half_size, [0.056, 0.021, 0.035])
    wall = lift.boxes["wall"]
    assert wall.pose.position[0] + wall.half_size[0] == pytest.approx(-0.1 + 0.02)
    floor = draw_trunk(episodes["TrunkPush-v0"]).boxes["floor"]
    up, quaternion = np.array([0, 0, floor.half_size[2]]), np.roll(floor.pose.quaternion, 1)
    top = floor.pose.position + rotate_by_quaternion(up, quaternion)
    np.testing.assert_allclose(top, [0, -0.105319, 0], atol=1e-9)


def test_tension_colours_run_from_dark_to_bright():
    brightness = tension_colors(np.linspace(0, trunk.MAX_TENSION, 7)).astype(int) @ [3, 6, 1]
    assert (np.diff(brightness) > 0).all()


def test_a_robot_may_be_a_deforming_mesh(reach, tmp_path, monkeypatch):
    trunk_drawing = draw_trunk(reach)
    vertices = np.random.default_rng(0).normal(size=(STEPS + 1, 4, 3))
    blob = Mesh(vertices, vertices, np.array([[0, 1, 2], [1, 2, 3]]), np.array([90, 90, 90, 255]))
    drawing = Drawing(**{**vars(trunk_drawing), "meshes": {"blob": blob}})
    monkeypatch.setitem(DRAWINGS, "Trunk", lambda episode: drawing)
    write_recording(tmp_path / "a.rrd", [reach], "a")
    (chunk,) = [c for c in chunks(tmp_path / "a.rrd") if c.entity_path.endswith("blob") and not c.is_static]
    positions = chunk.to_record_batch().column("Mesh3D:vertex_positions").to_pylist()
    np.testing.assert_allclose(positions, vertices.astype(np.float32))
