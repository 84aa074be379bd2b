"""Simulated episodes, recorded and replayed."""

import re
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from soro_bench.effects.effect import Effect, Location
from soro_bench.policies.policy import Policy, PolicyCard
from soro_bench.recording import distances as measured_distances
from soro_bench.recording import rerun_runs
from soro_bench.recording.excitation import excitation, shortest, write_actions
from soro_bench.recording.recording import Signal
from soro_bench.recording.simulated import parse_params, record, recorded_actions, replay, replay_begins
from soro_bench.registration import ENV_IDS, make_task, task_type
from tests.arm import assert_same, says

pytest.importorskip("pyarrow.parquet")
from soro_bench.recording.parquet import load, save

CASES = [
    ("TrunkReach-v0", "cable", "continuous", {"trunk_mass": 0.3}),
    ("TrunkPush-v0", "cable", "discrete", {"friction": 0.5}),
    ("TrunkLift-v0", "cable", "continuous", {"wall_offset": 0.02}),
    ("MultiGait-v0", "coarse", "discrete", {"robot_mass": 0.03}),
    ("TrunkPush-v1", "cable", "continuous", {"friction": 0.5}),
]


@pytest.mark.parametrize(("env_id", "model", "action", "params"), CASES)
def test_a_recording_replays_bit_for_bit(tmp_path, env_id, model, action, params):
    """Simulated, saved, read again and simulated after what was read."""
    recording = record(env_id, "random", model, action, params, steps=5, seed=4)
    save(recording, tmp_path / "a.parquet")
    loaded = load(tmp_path / "a.parquet")
    assert_same(loaded, recording)
    assert params.items() <= loaded.parameters.items()
    episode = replay(loaded)
    assert episode.signals.keys() == loaded.signals.keys()
    for name, signal_ in loaded.signals.items():
        np.testing.assert_array_equal(episode.signals[name], signal_.values, err_msg=name)
        np.testing.assert_array_equal(episode.time, signal_.time)


def test_a_trained_policy_is_recorded(tmp_path):
    """As it acts in an evaluation; a policy of another environment is refused."""
    rng = np.random.default_rng(0)
    tensors = {"mean": np.zeros(66), "std": np.ones(66), "w0": rng.normal(size=(8, 66)), "b0": np.zeros(8)}
    tensors = {name: values.astype(np.float32) for name, values in tensors.items()}
    Policy(PolicyCard("TrunkReach-v0", "cable", "continuous", "oracle", 0, 0), tensors).save(tmp_path / "policy")
    recording = record("TrunkReach-v0", str(tmp_path / "policy"), "cable", steps=4)
    assert recording.commands["action"].values.any()
    np.testing.assert_array_equal(replay(recording).signals["keypoints"], recording.signals["keypoints"].values)
    with pytest.raises(ValueError, match=says("TrunkReach-v0 with continuous actions")):
        record("TrunkPush-v0", str(tmp_path / "policy"), "cable")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_signal_has_a_unit(env_id):
    task = make_task(env_id, 1, 1, task_type(env_id).cheap)
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    assert task.signals(np.arange(1)).keys() == task.signal_units.keys()


def test_noise_is_seeded_and_falls_on_positions_and_orientations_only():
    clean, noisy, again, other = (
        record("TrunkReach-v0", model="cable", steps=20, seed=1, noise=noise) for noise in (0.0, 1e-3, 1e-3, 2e-3)
    )
    assert_same(noisy, again)
    for name, values in ((n, s.values) for n, s in clean.signals.items()):
        difference = noisy.signals[name].values - values
        if name in ("keypoints", "link_position"):
            assert np.std(difference) == pytest.approx(1e-3, rel=0.15)
            np.testing.assert_allclose(other.signals[name].values - values, 2 * difference, atol=1e-12)
        elif name == "link_quaternion":  # three of four numbers turn it
            assert np.std(difference) == pytest.approx(1e-3 / 0.025 * np.sqrt(3 / 4), rel=0.15)
            assert np.linalg.norm(noisy.signals[name].values, axis=-1) == pytest.approx(1.0)
        else:
            assert not difference.any()
    assert noisy.metadata["noise"] == "0.001"


def test_a_recording_may_be_longer_than_an_episode_and_goes_on_when_solved(monkeypatch):
    monkeypatch.setattr("soro_bench.envs.trunk.SUCCESS_DISTANCE", 1.0)
    monkeypatch.setattr("soro_bench.envs.trunk.TrunkTask._begin", lambda self, ids: None)
    recording = record("TrunkReach-v0", model="cable", steps=110)
    assert len(recording.commands["action"].time) == 110
    assert len(recording.signals["tension"].time) == 111


def test_actions_of_a_robot_are_held_until_the_next():
    """Commands at their own times, which begin after the signals do."""
    recording = record("TrunkReach-v0", model="cable", steps=4)
    values = np.array([np.full(8, 0.5), np.full(8, -0.5)])
    commands = {"action": Signal([0.06, 0.14], values)}
    episode = replay(replace(recording, commands=commands, metadata={**recording.metadata, "model": "cable"}))
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 0, 0.5, -0.5])


@pytest.mark.parametrize(
    "stamped",
    [
        lambda times: np.array([float(f"{1e3 * t:.3f}") for t in 5.0 + times]) / 1e3,
        lambda times: np.round(1e9 * (1.7e9 + times)) * 1e-9,
        lambda times: times.astype(np.float32).astype(float),
    ],
)
def test_every_action_is_played_once_however_its_time_was_written(stamped):
    recording = record("TrunkReach-v0", model="cable", steps=100, seed=3)
    times = 0.05 * np.arange(101)
    signals = {"keypoints": replace(recording.signals["keypoints"], time=stamped(times))}
    commands = {"action": replace(recording.commands["action"], time=stamped(times)[:100])}
    _, actions = recorded_actions(replace(recording, commands=commands, signals=signals))
    np.testing.assert_array_equal(actions, recording.commands["action"].values)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"metadata": {}}, ("env_id is None", "TrunkReach-v0", "diagnose with --model and --map")),
        ({"metadata": {"env_id": "TrunkReach-v0"}}, ("action is None", "continuous")),
        ({"metadata": {"env_id": "os:Trunk-v0", "action": "discrete"}}, ("'os:Trunk-v0'", "TrunkReach-v0")),
        ({"commands": {}}, ("no command 'action'",)),
        ({"commands": {"action": Signal([0.0, 1e9], np.zeros((2, 8)))}}, ("control steps", "100000")),
        ({"commands": {"action": Signal([0.0], np.full((1, 8), np.nan))}}, ("missing numbers",)),
        ({"commands": {"action": Signal([0.0], np.full((1, 8), 7.0))}}, ("finite numbers from -1.0 to 1.0",)),
        ({"commands": {"action": Signal([0.0], np.zeros((1, 3)))}}, ("expected (1, 8)",)),
        ({"parameters": {"mass": 1.0}}, ("'mass'", "trunk_mass")),
        ({"parameters": {"trunk_mass": 1e9}}, ("trunk_mass = 1000000000.0", "[0.001, 2.0] kg")),
    ],
)
def test_what_cannot_be_replayed(change, parts):
    with pytest.raises(ValueError, match=says(*parts)):
        replay(replace(record("TrunkReach-v0", model="cable", steps=2), **change))


@pytest.mark.parametrize(
    "metadata", [{"goal": "left"}, {"goal": "[" * 5000}, {"goal": "[1e9, 0, 0]"}, {"model": "fem"}]
)
def test_hostile_metadata(metadata):
    recording = record("TrunkReach-v0", model="cable", steps=2)
    with pytest.raises(ValueError, match=r"goal|model"):
        replay(replace(recording, metadata={**recording.metadata, **metadata}))


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"env_id": "Walker-v0"}, ("'Walker-v0'", "TrunkReach-v0")),
        ({"policy": "clever"}, ("'clever'", "random, excitation", "folder")),
        ({"action": "torque"}, ("'torque'", "discrete, continuous")),
        ({"model": "fem"}, ("'fem'", "flex, cable")),
        ({"steps": 0}, ("steps 0",)),
        ({"policy": np.zeros((0, 8))}, ("steps 0",)),
        ({"noise": -1.0}, ("noise -1.0",)),
        ({"policy": "excitation", "action": "discrete"}, ("continuous",)),
        ({"policy": "excitation", "steps": 50}, ("50 steps are too few",)),
        ({"params": {"trunk_mass": 2.0, "young_modulus": 1e6, "damping": 0.02}, "steps": 100}, ("diverged after",)),
    ],
)
def test_what_cannot_be_recorded(arguments, parts):
    with pytest.raises(ValueError, match=says(*parts)):
        record(**{"env_id": "TrunkReach-v0", "model": "cable", "steps": 2, **arguments})


def test_parameters_of_the_command_line():
    assert parse_params(("trunk_mass=0.3", "damping=1e-1")) == {"trunk_mass": 0.3, "damping": 0.1}
    for bad in ("trunk_mass", "trunk_mass=heavy", "=", "a=b=c"):
        with pytest.raises(ValueError, match=re.escape(repr(bad))):
            parse_params((bad,))


@pytest.mark.parametrize(("channels", "timestep", "duration"), [(8, 0.05, 30.0), (8, 0.05, 60.0), (3, 0.6, 180.0)])
def test_excitation(channels, timestep, duration):
    """It fills its duration, keeps within the action space, moves every channel alone and ends where it began."""
    actions = excitation(spaces.Box(-1, 1, (channels,)), timestep, duration)
    assert actions.shape == (round(duration / timestep), channels)
    assert np.abs(actions).max() <= 1
    np.testing.assert_allclose(actions.sum(axis=0), 0, atol=1e-9)
    assert not actions[:10].any()
    assert not actions[-10:].any()
    alone = (actions != 0).sum(axis=1) == 1
    assert ((actions != 0)[alone].sum(axis=0) > 10).all()
    for rate in (1, 1 / 2, 1 / 3):
        assert (np.isclose(actions, rate).any(axis=0)).all()
    np.testing.assert_array_equal(actions, excitation(spaces.Box(-1, 1, (channels,)), timestep, duration))
    assert len(excitation(spaces.Box(-1, 1, (channels,)), 0.05, shortest(channels) * 0.05)) == shortest(channels)


def test_excitation_has_odd_harmonics_of_its_band():
    actions = excitation(spaces.Box(-1, 1, (2,)), 0.05, 60.0)
    quiet = np.flatnonzero(~actions.any(axis=1))
    rich = actions[quiet[quiet < len(actions) - 16][-1] + 1 : -16]
    power = np.abs(np.fft.rfft(rich[:, 0])) ** 2
    frequency = np.fft.rfftfreq(len(rich), 0.05)
    strong = frequency[power > 1e-3 * power.max()]
    assert 0.15 < strong[0] < 0.25
    assert 5.0 < strong[-1] <= 6.05
    np.testing.assert_allclose((strong / strong[0]) % 2, 1, atol=1e-6)


def test_comparison_shows_the_measured_points_at_their_times(tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    recording = record("TrunkReach-v0", model="cable", steps=5, noise=1e-3)
    keypoints = recording.signals["keypoints"]
    keypoints.values[2, 4] = np.nan
    rerun_runs.write_comparison(recording, tmp_path / "a.rrd", "a")
    chunks = RrdReader(tmp_path / "a.rrd").stream().to_chunks()
    (chunk,) = [c for c in chunks if c.entity_path.endswith("measured/keypoints") and not c.is_static]
    batch = chunk.to_record_batch()
    positions = batch.column("Points3D:positions").to_pylist()
    assert [len(row) for row in positions] == [21, 21, 20, 21, 21, 21]
    np.testing.assert_allclose(positions[1], keypoints.values[1], atol=1e-6)
    assert any(c.entity_path == "/replay/world/backbone" for c in chunks)
    assert any(c.entity_path == "/map/keypoints/replay" for c in chunks)
    assert measured_distances.measured_points(recording, 0.0).keys() == {"keypoints", "link_position"}


def test_comparison_says_how_far_a_robot_is_from_what_was_measured():
    """Also where signals have times of their own, of which the first is before the first command."""
    recording, begin = record("TrunkReach-v0", model="cable", steps=5), 7.0
    run, keypoints = replay(recording), recording.signals["keypoints"]
    between = 0.5 * (keypoints.values[1:] + keypoints.values[:-1]) + [0.003, 0.004, 0.0]
    between[3, 2], between[4] = 0.5, np.nan  # m, one point that is far, and none
    times = begin - 0.025 + 0.05 * np.arange(6)
    signals = {"keypoints": replace(keypoints, time=times, values=np.concatenate([keypoints.values[:1], between]))}
    commands = {"action": replace(recording.commands["action"], time=begin + 0.05 * np.arange(5))}
    late = replace(recording, signals=signals, commands=commands)
    points = measured_distances.measured_points(late, replay_begins(late))
    far = replace(run, signals={"keypoints": run.signals["keypoints"] + 1.0})
    of_points = measured_distances.distances({"before": far, "after": run}, points)["keypoints"]
    assert of_points.shape == (6, 21, 2)
    assert of_points[4, 2, 1] > 0.05 > of_points[4, 3, 1]
    found = measured_distances.over_points(of_points)
    assert found[0] == pytest.approx([np.sqrt(3.0), 0.0], abs=1e-6)
    assert found[1:4, 1] == pytest.approx(5e-3, abs=1e-9)
    assert found[4, 1] > 0.01
    assert np.isnan(found[5]).all()
    short = replace(run, time=run.time[:4], signals={"keypoints": run.signals["keypoints"][:4]})
    cut = measured_distances.over_points(measured_distances.distances({"short": short}, points)["keypoints"])[:, 0]
    assert np.isfinite(cut[:4]).all() and np.isnan(cut[4:]).all()


def test_a_map_has_the_largest_distance_that_there_is_and_none_is_of_nothing():
    assert rerun_runs._brightest(np.array([[[3.0], [np.inf], [np.nan]]])) == 3.0
    assert rerun_runs._brightest(np.full((2, 2, 1), np.nan)) > 0


def test_a_recording_without_places_is_written_without_a_map(tmp_path):
    from rerun.chunk import RrdReader

    recording = record("TrunkReach-v0", model="cable", steps=3)
    turned = {"link_quaternion": recording.signals["link_quaternion"]}
    rerun_runs.write_comparison(replace(recording, signals=turned), tmp_path / "a.rrd", "a", {"run": replay(recording)})
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "a.rrd").stream().to_chunks()}
    assert "/run/world/backbone" in paths
    assert not any(path.startswith("/map") for path in paths)


def test_actions_for_a_controller_are_a_table_in_si_units(tmp_path):
    actions = excitation(spaces.Box(-1, 1, (2,), np.float32), 0.05, 20.0)
    write_actions(tmp_path / "a.csv", 0.05, actions)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "time,action.0,action.1"
    table = np.array([line.split(",") for line in lines[1:]], float)
    assert table[:, 0] == pytest.approx(0.05 * np.arange(len(actions)))
    assert table[:, 1:] == pytest.approx(actions, abs=1e-8)


def test_times_of_a_long_table_increase_by_a_time_step_each(tmp_path):
    write_actions(tmp_path / "a.csv", 1e-3, np.zeros((100_003, 1)))
    last = [float(line.split(",")[0]) for line in (tmp_path / "a.csv").read_text().splitlines()[-3:]]
    assert last == [100.0, 100.001, 100.002]


def test_a_robot_with_hidden_physics_is_recorded_and_a_replay_does_not_have_it():
    delay = Effect("actuator_delay", Location("actuator", "*"), {"delay": 0.1})
    plain, hidden = (record("TrunkReach-v0", model="cable", steps=10, effects=some) for some in (None, [delay]))
    points = [one.signals["keypoints"].values for one in (plain, hidden)]
    assert np.abs(points[0] - points[1]).max() > 1e-3
    assert np.array_equal(replay(hidden).signals["keypoints"], points[0])
