"""Later versions of the tasks, TrunkGrasp, and episodes that begin where another one was."""

from dataclasses import replace

import numpy as np
import pytest

import soro_bench
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.envs.trunk_lift import REST_HEIGHT
from soro_bench.inference.replay import Replay
from soro_bench.recording.recording import RecordingError, Signal
from soro_bench.recording.simulated import record
from tests.test_envs import GOAL, TIP, commanded, task_of


@pytest.fixture(params=[env_id for env_id in soro_bench.ENV_IDS if env_id.endswith("-v1")] + ["TrunkGrasp-v0"])
def later_id(request):
    return request.param


def test_cables_of_version_1_pull_with_up_to_50_newtons(make, later_id, model):
    """All are shortened against each other, as fast as in version 0."""
    env = make(later_id, model=model, action="continuous")
    env.reset(seed=0)
    for _ in range(8):
        env.step(np.ones(8, np.float32))
    assert commanded(env) == pytest.approx(np.full(8, 0.04))
    tension = env.unwrapped.task.signals(np.arange(1))["tension"]
    assert tension.max() == pytest.approx(50.0)


@pytest.mark.parametrize("env_id", ["TrunkPush-v1", "TrunkLift-v1"])
def test_an_object_out_of_sight_does_not_cut_an_episode_of_version_1(make, env_id):
    """It is observed at the edge of the space, and rewards stay small."""
    env = make(env_id, model="cable")
    env.reset(seed=0)
    task = env.unwrapped.task
    task.sim.batch.qpos[0, task._object_qpos : task._object_qpos + 3] = [1.5, 0.3, -3.0]
    observation, reward, terminated, truncated, info = env.step(0)
    assert (terminated, truncated, info["diverged"]) == (False, False, False)
    np.testing.assert_allclose(observation[[66, 68]], [1.0, -1.0])
    assert -5.0 < reward < 0.0


@pytest.mark.parametrize(
    "corner", [{"trunk_mass": 0.005, "young_modulus": 7e6}, {"trunk_mass": 1.0, "young_modulus": 2e6}]
)
def test_version_1_stays_stable_where_cables_pull_against_each_other(make, later_id, model, corner):
    """At corners of the search box where version 0 diverges."""
    env, rng = make(later_id, model=model, action="continuous"), np.random.default_rng(0)
    env.reset(seed=0, options={"params": corner})
    for _ in range(15):
        action = rng.choice([-1.0, 1.0], 8).astype(np.float32)
        assert not any(env.step(action)[-1]["diverged"] for _ in range(4))


def _hold_object(env, height):
    """Put the object so far above its rest [m], level and at rest; the step that follows moves it by 0.1 s of falling
    at most."""
    task = env.unwrapped.task
    task.sim.batch.qpos[0, task._object_qpos + 1] = REST_HEIGHT + height
    task.sim.batch.qvel[0, -6:] = 0.0


def test_an_object_that_is_held_up_for_half_a_second_is_grasped(make):
    """Not one that is let go in between; rewards are what the object has gained, and those of holding it."""
    env = make("TrunkGrasp-v0", model="cable")
    env.reset(seed=0)
    ends = []
    for step in range(15):
        _hold_object(env, 0.0 if step == 4 else 0.04)
        _, reward, terminated, _, info = env.step(0)
        assert reward == pytest.approx(sum(info[f"reward_{name}"] for name in ("progress", "held", "time")))
        ends.append(terminated)
    assert ends == [False] * 14 + [True]
    assert info["is_success"] and info["reward_held"] == pytest.approx(5.1)


def test_a_tipped_object_is_not_grasped(make):
    """Its centre is higher, and a corner still on the floor."""
    env = make("TrunkGrasp-v0", model="cable")
    env.reset(seed=0)
    task, half = env.unwrapped.task, np.sqrt(0.5)
    task.sim.batch.qpos[0, task._object_qpos + 1] = REST_HEIGHT - 0.0105 + 0.028  # on its narrow side, 56 mm high
    task.sim.batch.qpos[0, task._object_qpos + 3 : task._object_qpos + 7] = [half, 0.0, 0.0, half]
    *_, info = env.step(0)
    assert info["elevation"] == pytest.approx(0.0175, abs=1e-3) and info["clearance"] == pytest.approx(0.0, abs=1e-3)
    assert info["reward_held"] == 0.0 and not info["is_success"]


def test_an_episode_begins_where_another_one_was(make, env_id):
    """And goes on with the same bytes."""
    env = make(env_id, model="cable", action="continuous")
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 8)).astype(np.float32)
    before = [env.step(action)[0] for action in actions[:3]][-1]
    state = {name: rows[0] for name, rows in env.unwrapped.task.state(np.arange(1)).items()}
    after = [env.step(action)[0] for action in actions[3:]]
    goal = {} if task_of(env_id) == "TrunkGrasp" else {"goal": before[GOAL]}
    other = make(env_id, model="cable", action="continuous")
    np.testing.assert_array_equal(other.reset(seed=1, options={"state": state, **goal})[0], before)
    np.testing.assert_array_equal([other.step(action)[0] for action in actions[3:]], after)


def test_a_goal_where_the_straight_trunk_ends_is_allowed_from_elsewhere(make):
    env = make("TrunkReach-v0", model="cable", action="continuous")
    tip = env.reset(seed=0)[0][TIP]
    for _ in range(5):
        env.step(np.array([1, 0, -1, 0, 0, 0, 0, 0], np.float32))
    state = {name: rows[0] for name, rows in env.unwrapped.task.state(np.arange(1)).items()}
    *_, info = env.reset(options={"state": state, "goal": tip})
    assert info["distance"] > 0.01


def test_a_state_of_something_else_is_refused(make):
    env = make("TrunkReach-v0", model="cable")
    state = {name: rows[0] for name, rows in env.unwrapped.task.state(np.arange(1)).items()}
    with pytest.raises(ValueError, match="has to be a dict with qpos, qvel, act, qacc_warmstart"):
        env.reset(options={"state": {"qpos": state["qpos"]}})
    for wrong in (state["qpos"][1:], 1e12 * np.ones(30), np.full(30, np.nan)):
        with pytest.raises(ValueError, match=r"state qpos .* has to be 30 finite numbers up to 1e\+10"):
            env.reset(options={"state": {**state, "qpos": wrong}})


def test_what_is_observed_where_an_episode_begins_is_in_the_space(make):
    """Also where the state has an object that has left it, as may be in version 1."""
    env = make("TrunkPush-v1", model="cable")
    env.reset(seed=0)
    task = env.unwrapped.task
    state = {name: rows[0].copy() for name, rows in task.state(np.arange(1)).items()}
    state["qpos"][task._object_qpos : task._object_qpos + 3] = [1.5, 0.3, -3.0]
    observation, _ = env.reset(options={"state": state})
    assert observation in env.observation_space and observation[66:69].tolist() == [1.0, 0.3, -1.0]


@pytest.mark.parametrize("told", [True, False])
def test_replays_begin_where_the_cube_of_the_recording_did(told):
    """As the metadata say, or the first sample; the same in all simulations."""
    recording = record("TrunkPush-v1", model="cable", steps=3, seed=3)
    if not told:
        recording = replace(recording, metadata={k: v for k, v in recording.metadata.items() if k != "object"})
    replay = Replay(recording, ("cube_mass",), threads=1)
    assert not replay.residuals(np.array([[recording.parameters["cube_mass"]]] * 3)).any()
    robot = SuiteRobot("TrunkPush-v1", "cable", threads=1)
    seen, nominal = robot.measured(recording), np.array([[prior.nominal for prior in robot.priors]] * 2)
    (found,) = robot.simulate_all([seen.drive], nominal, [(), ()])
    np.testing.assert_allclose(found, np.broadcast_to(seen.columns, found.shape), atol=1e-3)


def test_a_recording_that_says_nowhere_where_the_cube_was_is_refused():
    recording = record("TrunkPush-v1", model="cable", steps=3)
    signals = {"keypoints": recording.signals["keypoints"]}
    metadata = {name: text for name, text in recording.metadata.items() if name != "object"}
    for values in (np.zeros(4), np.full((4, 3), np.nan), np.full((4, 3), 1e300)):
        odd = {**signals, "object_position": Signal(np.arange(4.0), values, "m", "world")}
        with pytest.raises(RecordingError, match="object"):
            SuiteRobot("TrunkPush-v1", "cable", threads=1).measured(replace(recording, signals=odd, metadata=metadata))
    with pytest.raises(RecordingError, match="says nowhere where the object begins"):
        SuiteRobot("TrunkPush-v1", "cable", threads=1).measured(replace(recording, signals=signals, metadata=metadata))


def test_places_of_the_cube_in_version_1_of_push(make):
    """They are drawn, or given, and those of evaluation lie among them."""
    env = make("TrunkPush-v1", model="cable")
    drawn = np.array([env.reset(seed=seed)[0][63:69] for seed in range(40)])
    assert (np.abs(drawn[:, 3]) <= 0.02).all() and (np.abs(drawn[:, 5] - 0.1) <= 0.01).all()
    assert 5 < (drawn[:, 0] > 0).sum() < 35
    given = {"object": [0.015, 0.095], "goal": [-0.1, -0.1, 0.05]}
    np.testing.assert_allclose(env.reset(seed=0, options=given)[0][63:69], [-0.1, -0.1, 0.05, 0.015, -0.06, 0.095])
    assert len(env.unwrapped.task.evaluation) == 6
    with pytest.raises(ValueError, match=r"object \[0.1\] has to be 2 coordinates"):
        env.reset(seed=0, options={"object": [0.1]})
