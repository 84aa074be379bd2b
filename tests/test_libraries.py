"""What other libraries expect of environments: ids, actions, copies, attributes of each simulation."""

import copy
import json
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction

from soro_bench.effects.effect import SCHEMA
from soro_bench.envs.wrappers import DomainRandomization, VectorDomainRandomization
from soro_bench.randomization import search_box
from soro_bench.registration import CONTINUOUS_IDS, ENV_IDS, task_type

ULP = np.spacing(np.float32(1))
# laws that remember, that read the forces of the last time step, and that scale a field in every time step
EFFECTS = (
    {"name": "backlash", "location": {"kind": "actuator", "name": "L0"}, "parameters": {"width": 0.002}},
    {"name": "load_friction", "location": {"kind": "tendon", "name": "*"},
     "parameters": {"mu": 0.2, "presliding": 1e-4}},
    {"name": "mullins_softening", "location": {"kind": "body", "name": "*"},
     "parameters": {"softening": 0.3, "strain": 0.05}},
)  # fmt: skip


def cheap(env_id, **options):
    """Arguments for the cheap model."""
    kind = task_type(env_id)
    return {kind.variant_name: kind.cheap, **options}


def following(env, actions):
    """Everything that actions give, as text and bytes; single environments are reset when an episode is over."""
    rows = []
    for action in actions:
        observation, *rest = env.step(action)
        rows += [observation.tobytes(), repr(rest)]
        if isinstance(env, gymnasium.Env) and (rest[1] or rest[2]):
            rows.append(env.reset()[0].tobytes())
    return rows


# --- ids ---


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_continuous_id_is_the_environment_with_continuous_actions(make, env_id):
    """Observations and rewards are, to the last bit, those of action="continuous"."""
    actions = np.random.default_rng(0).uniform(-1, 1, (3, len(task_type(env_id).moves))).astype(np.float32)
    rows = []
    for each, options in ((CONTINUOUS_IDS[env_id], {}), (env_id, {"action": "continuous"})):
        env = make(each, **cheap(env_id, **options))
        rows.append([env.reset(seed=1)[0].tobytes(), *following(env, actions)])
        assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, actions[0].shape, np.float32)
    assert rows[0] == rows[1]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_where_actions_coincide_both_ids_simulate_the_same(make, env_id):
    """The first discrete action moves one group of actuators at full rate, as a continuous action of 1 does."""
    discrete, continuous = (make(each, **cheap(env_id)) for each in (env_id, CONTINUOUS_IDS[env_id]))
    assert isinstance(discrete.action_space, gymnasium.spaces.Discrete)
    full = np.eye(1, len(task_type(env_id).moves), dtype=np.float32)[0]
    for env in (discrete, continuous):
        env.reset(seed=0)
    for _ in range(2):
        theirs, ours = discrete.step(0), continuous.step(full)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]


def test_a_continuous_id_makes_vector_environments():
    envs = gymnasium.make_vec("TrunkReachContinuous-v0", num_envs=2, model="cable")
    assert envs.action_space.shape == (2, 8)
    assert gymnasium.make_vec(envs.spec).spec == envs.spec


def test_gymnasium_check_env_of_a_continuous_id(make):
    env = make("TrunkReachContinuous-v1", model="cable").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


def test_commands_that_take_an_environment_and_its_actions_name_the_plain_id():
    with pytest.raises(ValueError, match="TrunkReachContinuous-v0 is TrunkReach-v0 with continuous actions"):
        task_type("TrunkReachContinuous-v0")


# --- actions ---


@pytest.mark.parametrize("sign", [1, -1])
def test_an_action_that_a_rounding_took_beyond_the_bounds_is_the_bound(make, sign):
    env = make("TrunkReach-v0", model="cable", action="continuous")
    results = []
    for size in (np.float32(1), np.float32(1) + ULP):
        env.reset(seed=0)
        results.append(env.step(np.full(8, sign * size, np.float32))[0])
    np.testing.assert_array_equal(*results)


def test_rescaled_actions_are_accepted_at_their_bounds(make):
    """RescaleAction's arithmetic in float32 goes beyond the bounds by up to four roundings."""
    env = RescaleAction(make("TrunkReach-v0", model="cable", action="continuous"), np.float32(0.1), np.float32(0.7))
    env.reset(seed=0)
    for bound in (env.action_space.low, env.action_space.high):
        env.step(bound)


@pytest.mark.parametrize("bad", [1.0001, -1.0001, np.nan])
def test_an_action_clearly_outside_is_refused_in_one_line(bad):
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", action="continuous")
    envs.reset(seed=0)
    actions = np.zeros((2, 8))
    actions[1, 3] = bad
    with pytest.raises(ValueError, match=rf"{bad} at \[1, 3\]; allowed are finite numbers from -1.0 to 1.0") as error:
        envs.step(actions)
    assert "\n" not in str(error.value)


# --- info ---


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_flat_info_has_the_same_numbers_without_a_dict_in_it(mode):
    """For libraries such as TorchRL, whose reader of infos of vector environments knows arrays only."""
    options = {"num_envs": 2, "model": "cable", "max_episode_steps": 2, "autoreset_mode": mode}
    nested, flat = (gymnasium.make_vec("TrunkReach-v0", **options, flat_info=each) for each in (False, True))
    for step in range(4):
        theirs, ours = (envs.step([0, 1]) if step else envs.reset(seed=0) for envs in (nested, flat))
        for expected, found in ((theirs[-1], ours[-1]), *_final_infos(theirs[-1], ours[-1])):
            params = expected.pop("params")
            expected.pop("_params", None)
            for name, values in params.items():
                key = f"_param{name}" if name.startswith("_") else f"param_{name}"
                np.testing.assert_array_equal(found.pop(key), values)
            assert found.keys() == expected.keys()


def _final_infos(theirs, ours):
    return [(theirs.pop("final_info"), ours.pop("final_info"))] if "final_info" in theirs else []


def test_a_flat_info_of_a_single_environment(make):
    info = make("TrunkReach-v0", model="cable", flat_info=True).reset(seed=0)[1]
    assert info["param_trunk_mass"] == 0.42 and "params" not in info
    with pytest.raises(ValueError, match="flat_info = 'yes'; True or False is needed"):
        make("TrunkReach-v0", model="cable", flat_info="yes")


def test_an_unknown_argument_is_refused_in_the_words_of_python(make):
    """TorchRL tries an argument called frameskip, and goes on without it when it reads these words."""
    with pytest.raises(TypeError, match="frameskip=1: unexpected keyword argument 'frameskip'; this"):
        make("TrunkReach-v0", model="cable", frameskip=1)


# --- copies ---


@pytest.mark.parametrize("through", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_copy_of_a_single_environment_goes_on_with_the_same_bytes(make, env_id, through):
    """In mid-episode, with parameters of its own, and into the next two episodes."""
    options = {"observation_noise": True} if env_id == "MultiGait-v0" else {}
    env = make(env_id, **cheap(env_id), **options, max_episode_steps=5)
    env = DomainRandomization(env, search_box(task_type(env_id).randomized))
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(14)]
    env.reset(seed=3)
    following(env, actions[:3])
    copied = through(env)
    ours, theirs = copied.unwrapped.task, env.unwrapped.task
    for name, values in theirs.signals(np.arange(1)).items():
        np.testing.assert_array_equal(ours.signals(np.arange(1))[name], values)
    np.testing.assert_array_equal(ours.sim.batch.warning, theirs.sim.batch.warning)
    assert following(copied, actions[3:]) == following(env, actions[3:])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_copy_of_a_vector_environment_goes_on_with_the_same_bytes(mode):
    envs = gymnasium.make_vec("TrunkLift-v0", num_envs=3, model="cable", max_episode_steps=5, autoreset_mode=mode)
    envs = VectorDomainRandomization(envs, search_box(task_type("TrunkLift-v0").randomized))
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(14)]
    envs.reset(seed=3)
    following(envs, actions[:3])
    copied = pickle.loads(pickle.dumps(envs))
    assert following(copied, actions[3:]) == following(envs, actions[3:])


def test_a_copy_remembers_what_effects_remember(make, model):
    env = make("TrunkReach-v0", model=model, action="continuous", effects=EFFECTS)
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 8)).astype(np.float32)
    env.reset(seed=0)
    following(env, actions[:4])
    copied = copy.deepcopy(env)
    assert following(copied, actions[4:]) == following(env, actions[4:])


@pytest.mark.parametrize("through", [copy.copy, copy.deepcopy])
def test_a_copy_is_independent(make, through):
    """Steps of one leave the other where it was, and its generators too; simulations cannot be shared."""
    env = make("TrunkReach-v0", model="cable").unwrapped
    env.reset(seed=0)
    copied = through(env)
    expected = env.reset()[0]
    copied.step(3)
    np.testing.assert_array_equal(copied.reset()[0], expected)
    assert copied.action_space is copied.task.single_action_space is not env.action_space


def test_a_copy_needs_no_effects_file_any_more(make, tmp_path):
    """The effects are those of the moment when the environment was made."""
    path = tmp_path / "effects.json"
    path.write_text(json.dumps({"schema": SCHEMA, "effects": EFFECTS[:1]}))
    env = make("TrunkReach-v0", model="cable", effects=str(path))
    env.reset(seed=0)
    path.unlink()
    copied = copy.deepcopy(env)
    assert following(copied, [3, 4]) == following(env, [3, 4])


# --- attributes of each simulation ---


def test_attributes_of_each_simulation_are_those_of_a_single_environment():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    single = gymnasium.make("TrunkReach-v0", model="cable")
    envs.reset(seed=4)
    assert envs.get_attr("action_space") == (single.action_space,) * 2
    assert envs.call("observation_space") == (single.observation_space,) * 2
    assert envs.get_attr("np_random_seed") == (4, 5)
    assert envs.get_attr("metadata")[0]["render_fps"] == single.metadata["render_fps"]
    assert envs.call("has_wrapper_attr", "np_random") == (True, True)
    single.close()


def test_attributes_may_be_set_for_all_or_for_each():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    envs.set_attr("difficulty", 3)
    assert envs.get_attr("difficulty") == (3, 3)
    envs.set_attr("difficulty", [1, 2])
    assert envs.call("get_wrapper_attr", "difficulty") == (1, 2)
    with pytest.raises(ValueError, match="3 values of difficulty for 2 environments"):
        envs.set_attr("difficulty", [1, 2, 3])
    with pytest.raises(AttributeError, match="action_space cannot be set"):
        envs.set_attr("action_space", None)
    for name in ("step", "colour"):
        with pytest.raises(AttributeError, match=f"no '{name}'; it has action_space, .*, difficulty"):
            envs.call(name)


def test_a_vector_environment_renders_in_the_mode_that_it_was_made_with():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    envs.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert envs.render() is None
    for mode in ("human", "ansi"):
        with pytest.raises(ValueError, match=f"'{mode}': of vector environments allowed are None and 'rgb_array'"):
            gymnasium.make_vec("TrunkReach-v0", num_envs=1, model="cable", render_mode=mode)
    assert gymnasium.make_vec("MultiGait-v0", mesh="coarse").metadata["render_fps"] == pytest.approx(1 / 0.6)


def test_the_sb3_adapter_shows_single_spaces():
    pytest.importorskip("stable_baselines3", reason="needs the train extra")
    from soro_bench.envs.sb3 import SB3VecEnv

    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=3, model="cable", autoreset_mode="SameStep")
    adapter = SB3VecEnv(gymnasium.vector.VectorWrapper(envs))  # a wrapper hides the task
    assert adapter.get_attr("action_space") == [envs.single_action_space] * 3
    assert adapter.get_attr("observation_space", [0, 2]) == [envs.single_observation_space] * 2
    adapter.set_attr("stage", [1, 2], indices=[1])  # Stable-Baselines3 gives every simulation the same value
    adapter.set_attr("stage", 0, indices=[0, 2])
    assert adapter.get_attr("stage") == [0, [1, 2], 0]
    assert adapter.env_method("get_wrapper_attr", "stage", indices=0) == [0]
    adapter.close()
