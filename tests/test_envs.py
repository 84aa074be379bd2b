"""The single environments: Gymnasium's rules, the published rewards, actions, starts and ends."""

import math
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from soro_bench.envs.trunk import potential
from soro_bench.envs.trunk_reach import EVALUATION_GOALS, GOAL_HIGH, GOAL_LOW

OBSERVATION_SIZE = {"TrunkReach": 66, "TrunkPush": 73, "TrunkLift": 73, "TrunkGrasp": 73}
TIP, GOAL, OBJECT = slice(60, 63), slice(63, 66), slice(66, 69)
STEP_INFO = {"params", "distance", "is_success", "diverged", "reward_progress", "reward_time"}


def task_of(env_id):
    """Its name without its version."""
    return env_id.split("-")[0]


def commanded(env):
    """(8,) commanded cable displacements [m]."""
    return env.unwrapped.task.signals(np.arange(1))["commanded"][0]


def idle_action(cable=None, rate=0.0):
    """A continuous action: nothing moves but ``cable``."""
    action = np.zeros(8, np.float32)
    if cable is not None:
        action[cable] = rate
    return action


def published_reward(distance, initial):
    """Reward of a distance [m] in the published formula, which takes mm."""
    p, p0 = (-0.006 * d**2 - 500 * math.log(d**2 + 0.001) for d in (1000 * distance, 1000 * initial))
    return (p0 - p) / p0 - 0.05


def test_gymnasium_check_env(make, env_id, model, action):
    """Gymnasium's checker finds nothing and warns of nothing."""
    env = make(env_id, model=model, action=action)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no exception to this is needed
        check_env(env.unwrapped, skip_render_check=True)


def test_sb3_check_env(make, env_id, model, action):
    """Stable-Baselines3's checker finds nothing and warns of nothing."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the train extra")
    env = make(env_id, model=model, action=action)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no exception to this is needed
        checker.check_env(env, skip_render_check=True)


def test_spaces(make, env_id, model, action):
    """Observations are the published 66 or 73 numbers, actions 16 choices or 8 rates; both stay in their spaces."""
    env = make(env_id, model=model, action=action)
    assert env.observation_space == gymnasium.spaces.Box(-1.0, 1.0, (OBSERVATION_SIZE[task_of(env_id)],), np.float64)
    if action == "discrete":
        assert env.action_space == gymnasium.spaces.Discrete(16)
    else:
        assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (8,), np.float32)
    env.action_space.seed(0)
    assert env.reset(seed=0)[0] in env.observation_space
    for _ in range(5):
        assert env.step(env.action_space.sample())[0] in env.observation_space


def test_spec_survives_json_and_pickle(make, env_id):
    """An environment can be made again from its spec, through JSON or pickle."""
    spec = make(env_id, model="cable", action="continuous").spec
    for copy in (EnvSpec.from_json(spec.to_json()), pickle.loads(pickle.dumps(spec))):
        again = make(copy)
        assert again.spec == spec
        assert again.action_space.shape == (8,)


def test_close_twice(make, env_id):
    """An environment may be closed twice."""
    env = make(env_id, model="cable")
    env.reset(seed=0)
    env.close()
    env.close()


def test_initial_observation(make, env_id, model):
    """Every episode starts with a straight trunk, the goal behind its keypoints and the object behind the goal."""
    observation, _ = make(env_id, model=model).reset(seed=0)
    keypoints = observation[:63].reshape(21, 3)
    np.testing.assert_allclose(keypoints[:, :2], 0, atol=1e-9)
    assert keypoints[0, 2] == pytest.approx(0)
    assert keypoints[20, 2] == pytest.approx(0.184368, abs=1e-5)
    if task_of(env_id) == "TrunkReach":
        assert (observation[GOAL] >= GOAL_LOW).all() and (observation[GOAL] <= GOAL_HIGH).all()
    if env_id == "TrunkPush-v0":
        np.testing.assert_allclose(observation[63:], [0.1, -0.1, 0.05, 0, -0.06, 0.1, 0, 0, 0, 1])
    if task_of(env_id) == "TrunkLift":
        np.testing.assert_allclose(observation[63:], [-0.1, -0.025, 0.12, -0.03, -0.06, 0.12, 0, 0, 0, 1])


def test_observation_is_the_present_state(make, env_id, model):
    """The keypoints and the object in an observation are those of a forward pass at the state after the step."""
    env = make(env_id, model=model)
    env.reset(seed=0)
    for _ in range(3):
        observation = env.step(3)[0]
    task = env.unwrapped.task
    task.sim.batch.forward()
    np.testing.assert_allclose(observation[:63], task.keypoints([0])[0].ravel(), atol=1e-12)
    if task_of(env_id) != "TrunkReach":
        np.testing.assert_allclose(observation[OBJECT], task.object_position([0])[0], atol=1e-12)


@pytest.mark.parametrize(
    ("initial", "distance", "reward"),
    [
        (65.7, 50, 0.017), (65.7, 20, 0.238), (65.7, 10, 0.403), (65.7, 5, 0.568), (65.7, 2, 0.785), (65.7, 1, 0.950),
        (111.8, 50, 0.131), (111.8, 20, 0.324), (111.8, 10, 0.469), (111.8, 5, 0.614), (111.8, 2, 0.806),
        (111.8, 1, 0.950), (111.8, 111.8, -0.05),
    ],
)  # fmt: skip
def test_potential_gives_published_rewards(initial, distance, reward):
    """The potential gives the rewards computed from the published formula, within 0.001."""
    start, end = potential(initial / 1000), potential(distance / 1000)
    assert (start - end) / start - 0.05 == pytest.approx(reward, abs=1e-3)


def test_reward_of_a_step(make, published_id, model):
    """The reward is the published formula of the distance, measured from the distance at reset, and its terms' sum."""
    env = make(published_id, model=model)
    initial = env.reset(seed=1)[1]["distance"]
    for action in (0, 7, 10):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(published_reward(info["distance"], initial), rel=1e-9)
        assert reward == pytest.approx(info["reward_progress"] + info["reward_time"])
        assert info["reward_time"] == -0.05


def test_distance(make, published_id, model):
    """The distance is that from tip to goal (Reach), of the object in the plane (Push), or the lifting cost (Lift)."""
    env = make(published_id, model=model)
    env.reset(seed=1)
    for action in (2, 3):
        observation, *_, info = env.step(action)
    tip, goal, thing = observation[TIP], observation[GOAL], observation[OBJECT]
    expected = {
        "TrunkReach": lambda: math.dist(tip, goal),
        "TrunkPush": lambda: math.hypot(thing[0] - goal[0], thing[2] - goal[2]),
        "TrunkLift": lambda: 0.75 * abs(thing[1] + 0.025) + 0.25 * math.dist(tip, thing),
    }[task_of(published_id)]()
    assert info["distance"] == pytest.approx(expected, rel=1e-9)


def test_evaluation_goals():
    """The 27 evaluation goals are the published grid in the published order."""
    assert EVALUATION_GOALS.shape == (27, 3)
    mm = 1e3 * EVALUATION_GOALS
    published = [(-20, 5, 120), (-20, 5, 132.5), (-20, -15, 120), (0, 5, 120), (20, -35, 145)]
    np.testing.assert_allclose(mm[[0, 1, 3, 9, 26]], published)
    assert len(np.unique(mm, axis=0)) == 27


def test_training_goals_fill_the_box(make):
    """Goals drawn at reset lie in the published box and reach into its corners."""
    env = make("TrunkReach-v0", model="cable")
    goals = np.array([env.reset(seed=seed)[0][GOAL] for seed in range(100)])
    unit = (1e3 * goals - [-30, -50, 115]) / [60, 70, 35]
    assert (unit >= 0).all() and (unit <= 1).all()
    assert (unit.min(axis=0) < 0.1).all() and (unit.max(axis=0) > 0.9).all()


@pytest.mark.parametrize("action", range(16))
def test_discrete_actions(make, env_id, action):
    """Action a pulls cable a by 5 mm, action a + 8 releases it by 5 mm, and no other cable is commanded."""
    env = make(env_id, model="cable")
    env.reset(seed=0)
    env.step(action)
    expected = np.zeros(8)
    expected[action % 8] = 0.005 if action < 8 else -0.005
    np.testing.assert_allclose(commanded(env), expected, atol=1e-12)


def test_pulled_cable_bends_the_tip_towards_it(make, model):
    """Pulling the cables at +y, -x, -y and +x moves the tip that way, relative to an idle trunk."""
    env = make("TrunkReach-v0", model=model, action="continuous")

    def tip(action):
        env.reset(seed=0)
        return [env.step(action)[0][TIP] for _ in range(2)][-1]

    idle = tip(idle_action())
    for cable in range(8):
        direction = np.array([(0, 1), (-1, 0), (0, -1), (1, 0)][cable % 4])
        assert direction @ (tip(idle_action(cable, 1.0)) - idle)[:2] > 0.005, cable


def test_continuous_actions_are_rates(make, model):
    """A continuous action of 1 on a cable is the discrete pull, and 0.5 commands half as much."""
    continuous, discrete = make("TrunkReach-v0", model=model, action="continuous"), make("TrunkReach-v0", model=model)
    for env in (continuous, discrete):
        env.reset(seed=0)
    np.testing.assert_array_equal(continuous.step(idle_action(6, 1.0))[0], discrete.step(6)[0])
    continuous.reset(seed=0)
    continuous.step(idle_action(6, -0.5))
    assert commanded(continuous)[6] == pytest.approx(-0.0025)


@pytest.mark.parametrize("sign", [1, -1])
def test_commands_stop_at_the_limits(make, model, sign):
    """Commanded displacements accumulate to 70 mm (long) and 40 mm (short), either way, and return without wind-up."""
    env = make("TrunkReach-v0", model=model, action="continuous")
    env.reset(seed=0)
    for _ in range(16):
        env.step(np.full(8, sign, np.float32))
    np.testing.assert_allclose(commanded(env), sign * np.repeat([0.070, 0.040], 4), atol=1e-9)
    env.step(np.full(8, -sign, np.float32))
    np.testing.assert_allclose(commanded(env), sign * np.repeat([0.065, 0.035], 4), atol=1e-9)


@pytest.mark.parametrize(("offset", "success"), [(0.0009, True), (0.0011, False)])
def test_reach_succeeds_within_one_millimetre(make, model, offset, success):
    """TrunkReach terminates when the tip is within 1 mm of the goal, and not just outside."""
    env = make("TrunkReach-v0", model=model)
    env.reset(seed=0)
    x, y, z = env.step(4)[0][TIP]
    env.reset(seed=0, options={"goal": [x, y + offset, z]})
    _, _, terminated, truncated, info = env.step(4)
    assert (terminated, truncated, info["is_success"]) == (success, False, success)


@pytest.mark.parametrize(("offset", "success"), [(0.0009, True), (0.0011, False)])
def test_push_succeeds_within_one_millimetre(make, offset, success):
    """TrunkPush terminates when the cube is within 1 mm of the goal in the plane, whatever the height."""
    env = make("TrunkPush-v0", model="cable")
    env.reset(seed=0)
    actions = [2] * 12 + [1] * 14  # press down, then sweep aside
    path = np.array([env.step(action)[0][OBJECT] for action in actions])
    pushed = (path[-1] - path[0]) * [1, 0, 1]
    assert np.linalg.norm(pushed) > 0.005
    # the goal lies ahead of the furthest place that the cube reaches in the direction in which it is pushed
    ahead = pushed / np.linalg.norm(pushed)
    env.reset(seed=0, options={"goal": path[np.argmax(path @ ahead)] + offset * ahead + [0, 0.05, 0]})
    assert any(env.step(action)[2] for action in actions) == success


def test_truncation_after_100_steps(make, published_id):
    """An episode that does not succeed is truncated at its 100th step, not before."""
    env = make(published_id, model="cable")
    env.action_space.seed(0)
    # the goal is out of reach
    env.reset(seed=0, options={"goal": [0.0, 0.3, 0.0]})
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(100)]
    assert ends == [(False, False)] * 99 + [(False, True)]


def test_info(make, env_id, model):
    """Reset and step report parameters and distance, steps also success, divergence and reward terms."""
    env = make(env_id, model=model)
    _, info = env.reset(seed=0)
    lifts = task_of(env_id) in ("TrunkLift", "TrunkGrasp")
    extra = {"elevation", "clearance"} if lifts else set()
    assert set(info) == {"params", "distance"} | extra
    *_, info = env.step(0)
    assert set(info) == STEP_INFO | extra | ({"reward_held"} if task_of(env_id) == "TrunkGrasp" else set())
    assert type(info["distance"]) is float and type(info["is_success"]) is bool
    params = {"trunk_mass": 0.42, "poisson_ratio": 0.45, "young_modulus": 4.5e6, "damping": 0.1, "cable_stiffness": 1e4}
    if task_of(env_id) == "TrunkPush":
        params |= {"cube_mass": 0.05, "friction": 0.3}
    if lifts:
        params |= {"cube_mass": 0.05, "friction": 0.9, "wall_offset": 0.0}
    assert info["params"] == params


def test_reset_options(make, published_id, model):
    """A goal and parameters given at reset are the episode's, and the next reset goes back to the defaults."""
    env = make(published_id, model=model)
    goal = [0.02, -0.03, 0.1]
    observation, info = env.reset(seed=0, options={"goal": goal, "params": {"young_modulus": 3e6}})
    np.testing.assert_array_equal(observation[GOAL], goal)
    assert info["params"]["young_modulus"] == 3e6
    observation, info = env.reset(seed=0)
    assert info["params"]["young_modulus"] == 4.5e6
    assert not np.array_equal(observation[GOAL], goal)


def test_diverged_state_ends_the_episode(make, env_id, model):
    """A state that left the reals is reported, the episode is truncated, and the next reset is a normal one."""
    env = make(env_id, model=model)
    start, _ = env.reset(seed=0)
    env.unwrapped.task.sim.batch.qvel[0, 0] = np.nan
    observation, reward, terminated, truncated, info = env.step(0)
    assert (terminated, truncated, info["diverged"]) == (False, True, True)
    assert np.isfinite(observation).all() and np.isfinite(reward)
    env.unwrapped.task.sim.batch.qvel[0, 0] = np.nan  # whoever goes on is told again
    assert env.step(0)[-1]["diverged"]
    np.testing.assert_array_equal(env.reset(seed=0)[0], start)
    *_, truncated, info = env.step(0)
    assert not truncated and not info["diverged"]


def test_an_observation_that_is_no_number_ends_the_episode(make, monkeypatch):
    env = make("TrunkReach-v0", model="cable")
    env.reset(seed=0)
    task, size = env.unwrapped.task, env.observation_space.shape[0]
    monkeypatch.setattr(task, "_observe", lambda ids: np.full((len(ids), size), np.nan))
    *_, truncated, info = env.step(0)
    assert truncated and info["diverged"]


def test_render_without_a_mode_warns(make):
    """render() without a render_mode returns None and says how to get pictures."""
    env = make("TrunkReach-v0", model="cable").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.render() is None
