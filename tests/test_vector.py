"""The vector environment: the same bytes as single environments, Gymnasium's autoreset modes, the SB3 adapter."""

import copy
import functools

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.envs.wrappers import DomainRandomization, VectorDomainRandomization
from soro_bench.parameters import POISSON_RATIO, TRUNK_MASS, YOUNG_MODULUS
from soro_bench.randomization import search_box

RANDOM_TRUNK = search_box((TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS))


def make_randomized(env_id, **kwargs):
    return DomainRandomization(gymnasium.make(env_id, **kwargs), RANDOM_TRUNK)


def make_vector(env_id, num_envs, **kwargs):
    return VectorDomainRandomization(gymnasium.make_vec(env_id, num_envs=num_envs, **kwargs), RANDOM_TRUNK)


def random_actions(space, steps, seed=0):
    space.seed(seed)
    return [space.sample() for _ in range(steps)]


def episode(env, actions, seed=3, **reset):
    """Everything an episode of a single environment gave, as bytes."""
    observation, info = env.reset(seed=seed, **reset)
    rows = [observation.tobytes(), repr(info)]
    for action in actions:
        observation, *rest = env.step(action)
        rows += [observation.tobytes(), repr(rest)]
    return rows


def assert_same(ours, theirs):
    """Two results of a vector environment's reset or step are equal to the last bit."""
    for a, b in zip(ours[:-1], theirs[:-1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert_same_info(ours[-1], theirs[-1])


def assert_same_info(ours, theirs):
    """Every entry that Gymnasium's ``info`` marks as present is present in ours and equal, and no others are."""
    for key in {key for key in (*ours, *theirs) if not key.startswith("_")}:
        if key not in theirs:
            assert not ours[f"_{key}"].any(), key
            continue
        present = theirs[f"_{key}"]
        np.testing.assert_array_equal(ours[f"_{key}"], present, err_msg=key)
        if isinstance(theirs[key], dict):
            assert_same_info(ours[key], theirs[key])
        else:
            assert (ours[key].dtype == object) == (theirs[key].dtype == object), key
            for i in np.flatnonzero(present):
                np.testing.assert_array_equal(ours[key][i], theirs[key][i], err_msg=key)


def test_same_seed_same_bytes(env_id, model, action):
    """Two environments with one seed and the same actions give the same bytes, with domain randomisation."""
    first, second = (make_randomized(env_id, model=model, action=action) for _ in range(2))
    actions = random_actions(first.action_space, 100 if model == "cable" else 10)
    expected = episode(first, actions)
    assert episode(second, actions) == expected
    assert episode(second, actions, seed=4) != expected


def test_reset_leaves_no_trace(env_id, model):
    """An episode gives the same bytes in a fresh environment and after another episode with other parameters."""
    env = gymnasium.make(env_id, model=model)
    actions = random_actions(env.action_space, 8)
    fresh = episode(env, actions)
    episode(env, random_actions(env.action_space, 8, seed=1), seed=5, options={"params": {"trunk_mass": 1.0}})
    assert episode(env, actions) == fresh


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_vector_env_equals_single_envs(env_id, model, mode):
    """Over several randomised episodes the vector env gives the bytes of Gymnasium's SyncVectorEnv of single envs."""
    limit, steps = (12, 40) if model == "cable" else (3, 8)
    kwargs = {"model": model, "max_episode_steps": limit}
    ours = make_vector(env_id, 3, autoreset_mode=mode, num_threads=2, **kwargs)
    theirs = SyncVectorEnv([lambda: make_randomized(env_id, **kwargs)] * 3, autoreset_mode=mode)
    assert_same(ours.reset(seed=7), theirs.reset(seed=7))
    ends = 0
    for action in random_actions(ours.action_space, steps):
        result = ours.step(action)
        assert_same(result, theirs.step(action))
        ends += result[3].sum()
    assert ends >= 6


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_one_of_three_succeeds(mode):
    """When one simulation succeeds early, it alone restarts, as in Gymnasium's SyncVectorEnv."""
    kwargs = {"model": "cable", "max_episode_steps": 10}
    ours = make_vector("TrunkReach-v0", 3, autoreset_mode=mode, num_threads=1, **kwargs)
    theirs = SyncVectorEnv([lambda: make_randomized("TrunkReach-v0", **kwargs)] * 3, autoreset_mode=mode)
    actions = random_actions(ours.action_space, 15)
    ours.reset(seed=7, options={"goal": [0, 0.2, 0]})  # a rehearsal, out of reach
    tips = [ours.step(action)[0][1, 60:63] for action in actions[:4]]
    options = {"goal": tips[-1]}
    assert_same(ours.reset(seed=7, options=options), theirs.reset(seed=7, options=options))
    terminations = []
    for action in actions:
        result = ours.step(action)
        assert_same(result, theirs.step(action))
        terminations.append(result[2].tolist())
    assert terminations[:4] == [[False] * 3] * 3 + [[False, True, False]]


def test_after_a_reset_that_was_refused_another_one_is_needed():
    envs = make_vector("TrunkReach-v0", 2)
    tip = envs.reset(seed=0)[0][1, 60:63]
    with pytest.raises(ValueError, match="is reached at reset"):
        envs.reset(options={"goal": tip})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1\]"):
        envs.step(envs.action_space.sample())
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())


def test_full_episode_equals_single_env(model):
    """Environment i of a vector env is the single env reset with seed + i, over 100 steps and into the next episode."""
    envs = make_vector("TrunkReach-v0", 2, model=model, num_threads=2)
    actions = random_actions(envs.action_space, 103)
    start, _ = envs.reset(seed=11)
    steps = [envs.step(action) for action in actions]
    single = make_randomized("TrunkReach-v0", model=model)
    i = 1
    np.testing.assert_array_equal(single.reset(seed=11 + i)[0], start[i])
    done = False
    for action, (observation, reward, terminated, truncated, _) in zip(actions, steps, strict=True):
        if done:
            expected = (single.reset()[0], 0.0, False, False)
        else:
            expected = single.step(action[i])[:4]
        done = expected[2] or expected[3]
        np.testing.assert_array_equal(observation[i], expected[0])
        assert (reward[i], terminated[i], truncated[i]) == expected[1:]
    assert steps[99][3].all()


def test_disabled_autoreset():
    """With autoreset disabled, done simulations wait for a reset by mask, which leaves the others alone."""
    kwargs = {"model": "cable", "max_episode_steps": 6}
    ours = make_vector("TrunkPush-v0", 2, autoreset_mode="Disabled", num_threads=1, **kwargs)
    theirs = SyncVectorEnv([lambda: make_randomized("TrunkPush-v0", **kwargs)] * 2, autoreset_mode="Disabled")
    actions = random_actions(ours.action_space, 12)
    for envs in (ours, theirs):
        envs.reset(seed=0)
    for action in actions[:3]:
        assert_same(ours.step(action), theirs.step(action))
    first = np.array([True, False])
    # Gymnasium's takes the mask out of the dict that it is given
    assert_same(ours.reset(options={"reset_mask": first}), theirs.reset(options={"reset_mask": first}))
    for action in actions[3:6]:
        assert_same(ours.step(action), theirs.step(action))
    with pytest.raises(ValueError, match=r"\[1\] are done"):
        ours.step(actions[6])
    second = {"reset_mask": ~first}
    assert_same(ours.reset(options=dict(second)), theirs.reset(options=dict(second)))
    assert_same(ours.step(actions[6]), theirs.step(actions[6]))


def test_number_of_threads_does_not_matter(env_id, model):
    """One thread and two give the same bytes."""

    def rollout(num_threads):
        envs = make_vector(env_id, 5, model=model, num_threads=num_threads, max_episode_steps=6)
        actions = random_actions(envs.action_space, 30 if model == "cable" else 4)
        rows = [envs.reset(seed=0)[0].tobytes()]
        return rows + [b"".join(part.tobytes() for part in envs.step(action)[:4]) for action in actions]

    assert rollout(1) == rollout(2)


def test_reset_of_some_leaves_the_others_alone(env_id, model):
    """Resetting some simulations in mid-episode does not change a bit of the others' observations, then or later."""
    envs = gymnasium.make_vec(env_id, num_envs=3, model=model)
    actions = random_actions(envs.action_space, 6)

    def rollout(interrupted):
        envs.reset(seed=2)
        for action in actions[:3]:
            before = envs.step(action)[0]
        if interrupted:
            options = {"reset_mask": np.array([False, True, False]), "params": {"trunk_mass": 1.0}}
            after, info = envs.reset(seed=9, options=options)
            np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
            assert not np.array_equal(after[1], before[1])
            np.testing.assert_array_equal(info["_distance"], [False, True, False])
        return np.array([envs.step(action)[0] for action in actions[3:]])

    alone, interrupted = rollout(False), rollout(True)
    np.testing.assert_array_equal(interrupted[:, [0, 2]], alone[:, [0, 2]])
    assert not np.array_equal(interrupted[:, 1], alone[:, 1])


def test_options_per_simulation(model):
    """Goals and parameters given as rows go to their simulations; single values go to all."""
    masses, modulus, goals = [0.2, 0.42, 0.6], 3e6, np.array([[0, 0, 0.1], [0.01, 0, 0.1], [0.02, 0, 0.1]])
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=3, model=model)
    options = {"goal": goals, "params": {"trunk_mass": masses, "young_modulus": modulus}}
    observation, info = envs.reset(seed=0, options=options)
    np.testing.assert_array_equal(observation[:, 63:], goals)
    np.testing.assert_array_equal(info["params"]["trunk_mass"], masses)
    np.testing.assert_array_equal(info["params"]["young_modulus"], [modulus] * 3)
    observation, reward, *_ = envs.step(np.array([5, 5, 5]))
    single = gymnasium.make("TrunkReach-v0", model=model)
    for i in range(3):
        params = {"trunk_mass": masses[i], "young_modulus": modulus}
        single.reset(seed=i, options={"goal": goals[i], "params": params})
        expected = single.step(5)
        np.testing.assert_array_equal(observation[i], expected[0])
        assert reward[i] == expected[1]


def test_each_simulation_begins_in_a_state_of_its_own():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", action="continuous")
    envs.reset(seed=0)
    for action in random_actions(envs.action_space, 3):
        before = envs.step(action)[0]
    state = envs.unwrapped.task.state(np.arange(2))
    after, _ = envs.reset(seed=1, options={"state": state, "goal": before[:, 63:66]})
    np.testing.assert_array_equal(after, before)
    after, _ = envs.reset(seed=1, options={"state": {name: rows[1] for name, rows in state.items()}})
    np.testing.assert_array_equal(after[:, :63], before[[1, 1], :63])
    envs.close()


def test_one_simulation_of_many_can_be_copied():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    one = copy.copy(envs.unwrapped.get_attr("unwrapped")[0])
    assert one.action_space == envs.single_action_space
    envs.close()


def test_seeds_may_be_listed():
    """A seed s stands for s, s + 1, ...; a list or array gives every simulation its own."""
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=3, model="cable")
    expected, _ = envs.reset(seed=4)
    for seed in ([4, 5, 6], np.array([4, 5, 6]), np.int64(4)):
        np.testing.assert_array_equal(envs.reset(seed=seed)[0], expected)


def test_results_are_fresh_arrays():
    """What reset and step return is not overwritten by later steps."""
    envs = gymnasium.make_vec("TrunkPush-v0", num_envs=2, model="cable")
    results = [envs.reset(seed=0), *(envs.step(action)[:2] for action in random_actions(envs.action_space, 3))]
    copies = [np.copy(result[0]) for result in results]
    infos = [envs.step(action)[4]["distance"] for action in random_actions(envs.action_space, 2)]
    assert infos[0] is not infos[1]
    for result, kept in zip(results, copies, strict=True):
        np.testing.assert_array_equal(result[0], kept)


def test_make_vec_conventions(env_id, action):
    """make_vec gives the native vector env with batched spaces, a remakeable spec and the 100-step limit."""
    envs = gymnasium.make_vec(env_id, num_envs=4, model="cable", action=action)
    assert isinstance(envs, SoftRobotVectorEnv)
    assert envs.num_envs == 4
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.observation_space.shape == (4, *envs.single_observation_space.shape)
    assert envs.single_action_space == gymnasium.make(env_id, model="cable", action=action).action_space
    again = gymnasium.make_vec(envs.spec)
    assert again.num_envs == 4 and again.spec == envs.spec
    observation, _ = again.reset(seed=0)
    assert observation in again.observation_space
    actions = random_actions(again.action_space, 100)
    truncated = [again.step(action)[3].all() for action in actions]
    assert truncated == [False] * 99 + [True]
    envs.close()
    again.close()
    assert again.closed


@pytest.mark.parametrize("late", [False, True])
def test_infos_of_simulations_that_end_and_begin_in_one_step_are_those_of_gymnasium(late):
    """What was of the old episode is in final_info and nowhere else, whether both end at once or one is late."""
    kwargs = {"model": "cable", "max_episode_steps": 3}
    make = functools.partial(gymnasium.make, "TrunkReach-v0", **kwargs)
    theirs = SyncVectorEnv([make, make], autoreset_mode=AutoresetMode.SAME_STEP)
    ours = gymnasium.make_vec("TrunkReach-v0", num_envs=2, autoreset_mode="SameStep", **kwargs)
    for envs in (ours, theirs):
        envs.reset(seed=0)
    for t, action in enumerate(random_actions(ours.action_space, 8)):
        found, expected = (envs.step(action)[4] for envs in (ours, theirs))
        _assert_same_info(found, expected)
        if late and t == 0:
            for envs in (ours, theirs):
                envs.reset(seed=[1, None], options={"reset_mask": np.array([True, False])})


def _assert_same_info(found, expected):
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        if isinstance(value, dict):
            _assert_same_info(found[key], value)
        elif key != "final_obs":  # observations and None
            np.testing.assert_array_equal(found[key], value, err_msg=key)


def test_sb3_adapter():
    """The SB3 adapter gives a SameStep vector env's results, with terminal observations and episode statistics."""
    pytest.importorskip("stable_baselines3", reason="needs the train extra")
    from soro_bench.envs.sb3 import SB3VecEnv

    def make():
        return make_vector("TrunkReach-v0", 3, model="cable", max_episode_steps=5, autoreset_mode="SameStep").unwrapped

    adapter, envs = SB3VecEnv(gymnasium.vector.VectorWrapper(make())), make()  # a wrapper hides the task
    adapter.seed(3)
    np.testing.assert_array_equal(adapter.reset(), envs.reset(seed=3)[0])
    returns = np.zeros(3)
    for t, action in enumerate(random_actions(envs.action_space, 12), start=1):
        observation, reward, terminated, truncated, info = envs.step(action)
        ours, our_reward, done, infos = adapter.step(action)
        np.testing.assert_array_equal(ours, observation)
        np.testing.assert_array_equal(our_reward, reward)
        np.testing.assert_array_equal(done, terminated | truncated)
        returns += reward
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert not np.array_equal(infos[i]["terminal_observation"], ours[i])
            assert infos[i]["TimeLimit.truncated"]
            assert infos[i]["is_success"] is bool(info["final_info"]["is_success"][i])
            assert infos[i]["metric"] == info["final_info"]["distance"][i]
            assert infos[i]["episode"]["r"] == pytest.approx(returns[i])
            assert infos[i]["episode"]["l"] == 5
            returns[i] = 0
        assert all("terminal_observation" not in infos[i] for i in np.flatnonzero(~done))
        assert done.all() == (t % 5 == 0)
    adapter.close()


def test_sb3_adapter_refuses_what_it_would_lose():
    """An autoreset mode without terminal observations, and options for the reset."""
    pytest.importorskip("stable_baselines3", reason="needs the train extra")
    from soro_bench.envs.sb3 import SB3VecEnv

    with pytest.raises(ValueError, match="SameStep"):
        SB3VecEnv(gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable"))
    with pytest.raises(TypeError, match="TrunkReachEnv: a vector environment of the suite is needed"):
        SB3VecEnv(gymnasium.make("TrunkReach-v0", model="cable").unwrapped)
    envs = SB3VecEnv(gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", autoreset_mode="SameStep"))
    envs.set_options({"goal": [0.0, 0.0, 0.18]})
    with pytest.raises(ValueError, match="reset options are not passed on"):
        envs.reset()


def test_a_simulation_that_was_never_reset_is_not_stepped():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0, 1\]"):
        envs.step([1, 2])
    envs.reset(seed=0, options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[1\]"):
        envs.step([1, 2])


def test_a_single_environment_that_was_not_reset_is_not_stepped():
    """Nor is one whose reset was refused."""
    env = gymnasium.make("TrunkReach-v0", model="cable").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    env.step(0)
    with pytest.raises(ValueError, match="goal"):
        env.reset(options={"goal": [10**400, 0, 0]})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)


def test_generators_and_seeds_are_those_of_synchronous_environments():
    ours = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    theirs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", vectorization_mode="sync")
    for envs in (ours, theirs):
        envs.reset(seed=5)
    assert ours.np_random_seed == theirs.np_random_seed == (5, 6)
    assert [rng.random() for rng in ours.np_random] == [rng.random() for rng in theirs.np_random]


def test_minus_one_step_is_no_limit():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=1, model="cable", max_episode_steps=-1)
    envs.reset(seed=0)
    assert not any(envs.step([1])[3][0] for _ in range(3))


def test_a_randomised_environment_is_made_again_from_its_spec():
    env = make_randomized("TrunkReach-v0", model="cable")
    again = gymnasium.make(env.spec)
    assert env.reset(seed=0)[1] == again.reset(seed=0)[1]
