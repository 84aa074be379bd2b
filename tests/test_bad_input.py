"""Bad input is refused with an error that names the value and what is allowed."""

import json

import gymnasium
import numpy as np
import pytest

from soro_bench.envs.wrappers import DomainRandomization
from soro_bench.randomization import Gaussian, TruncatedNormal, Uniform, from_dict, load
from soro_bench.registration import make_task
from tests.arm import says


@pytest.mark.parametrize(
    ("argument", "error", "parts"),
    [
        ({"wibble": 3}, TypeError, ("wibble=3", "model", "action")),
        ({"model": "fem"}, ValueError, ("model 'fem'", "flex, cable")),
        ({"action": "torque"}, ValueError, ("action mode 'torque'", "discrete, continuous")),
    ],
)
@pytest.mark.parametrize("maker", [gymnasium.make, gymnasium.make_vec])
def test_argument(env_id, maker, argument, error, parts):
    """An unknown argument, model or action mode."""
    with pytest.raises(error, match=says(*parts)):
        maker(env_id, **argument)


@pytest.mark.filterwarnings("ignore:.*The environment is being initialised with render_mode")
def test_render_mode(env_id):
    """An unknown render mode."""
    with pytest.raises(ValueError, match=says("render_mode 'ascii'", "human", "rgb_array")):
        gymnasium.make(env_id, render_mode="ascii")


@pytest.mark.parametrize(
    ("argument", "parts"),
    [
        ({"num_envs": 0}, ("num_envs = 0", "1 or more")),
        ({"num_envs": -1}, ("num_envs = -1", "1 or more")),
        ({"num_envs": 1.5}, ("num_envs = 1.5", "an integer")),
        ({"num_threads": -1}, ("num_threads = -1", "0 or more")),
        ({"autoreset_mode": "samestep"}, ("autoreset_mode 'samestep'", "NextStep, SameStep, Disabled")),
        ({"max_episode_steps": 0}, ("max_episode_steps 0", "1 or more, or -1")),
        ({"max_episode_steps": None}, ("max_episode_steps None", "registered number")),
        ({"max_episode_steps": "a"}, ("max_episode_steps 'a'", "an integer")),
        ({"model": ["flex"]}, ("model ['flex']", "flex, cable")),
        ({"effects": [5]}, ("effects [5]", "a list of Effect")),
        ({"effects": [{"name": "payload"}]}, ("name, location and parameters", "payload")),
    ],
)
def test_arguments_of_a_vector_environment(argument, parts):
    """Numbers that are none, or too small; things of another kind."""
    with pytest.raises(ValueError, match=says(*parts)):
        gymnasium.make_vec("TrunkReach-v0", **argument)


@pytest.mark.parametrize("argument", ["num_envs", "num_threads"])
def test_arguments_of_vector_environments_for_a_single_one(argument):
    with pytest.raises(TypeError, match=says(argument, "make_vec")):
        gymnasium.make("TrunkReach-v0", **{argument: 2})


def test_noise_that_is_neither_on_nor_off():
    with pytest.raises(ValueError, match=says("observation_noise = 'no'", "True or False")):
        gymnasium.make("MultiGait-v0", mesh="coarse", observation_noise="no")


def test_a_distribution_that_is_none_and_an_environment_of_others():
    env = gymnasium.make("TrunkReach-v0", model="cable")
    with pytest.raises(ValueError, match=says("unknown distribution type None", "uniform")):
        DomainRandomization(env, {"trunk_mass": (0, 1)})
    with pytest.raises(ValueError, match=says("CartPole", "no environment of soro_bench")):
        DomainRandomization(gymnasium.make("CartPole-v1"), Uniform(("trunk_mass",), [0.1], [0.2]))


OPTIONS = [
    ({"gaol": [0, 0, 0.1]}, ("option 'gaol'", "has params, state")),
    ({"gaol": "text"}, ("option 'gaol'", "has params, state")),
    ({"goal": [0, 0]}, ("[0, 0]", "3 coordinates from -0.3 to 0.3 m")),
    ({"goal": [0, 0, 120]}, ("[0, 0, 120]", "3 coordinates from -0.3 to 0.3 m")),
    ({"goal": [0, float("nan"), 0.1]}, ("nan", "3 coordinates from -0.3 to 0.3 m")),
    ({"goal": ["0", "0", "0.1"]}, ("['0', '0', '0.1']", "3 coordinates from -0.3 to 0.3 m")),
    ({"goal": "left"}, ("left", "3 coordinates from -0.3 to 0.3 m")),
    ({"goal": [[0, 0], [0]]}, ("[[0, 0], [0]]", "3 coordinates from -0.3 to 0.3 m")),
    ({"params": {"young": 4e6}}, ("parameter 'young'", "young_modulus")),
    ({"params": {"young_modulus": 4500}}, ("young_modulus = 4500", "[1000000.0, 10000000.0] Pa")),
    ({"params": {"trunk_mass": "1"}}, ("trunk_mass = '1'", "one number")),
    ({"params": {"trunk_mass": True}}, ("trunk_mass = True", "one number")),
    ({"params": {"poisson_ratio": 0.5}}, ("poisson_ratio = 0.5", "[0.4, 0.495]")),
    ({"params": {"trunk_mass": -0.1}}, ("trunk_mass = -0.1", "[0.001, 2.0] kg")),
    ({"params": {"trunk_mass": float("nan")}}, ("trunk_mass = nan", "[0.001, 2.0] kg")),
    ({"params": {"trunk_mass": "heavy"}}, ("trunk_mass = 'heavy'", "one number")),
    ({"params": {"trunk_mass": None}}, ("trunk_mass = None", "one number")),
    ({"params": {"trunk_mass": [0.3, 0.4, 0.5]}}, ("trunk_mass = [0.3, 0.4, 0.5]", "one number")),
    ({"params": 0.42}, ("params 0.42", "dict", "trunk_mass")),
    (5, ("reset options 5", "a dict")),
]


@pytest.mark.parametrize(("options", "parts"), OPTIONS)
@pytest.mark.parametrize("num_envs", [None, 2])
def test_reset_options(env_id, num_envs, options, parts):
    """An unknown option or parameter, a parameter outside its bounds, or no goal; the environment stays usable."""
    if env_id.startswith("TrunkGrasp") and isinstance(options, dict) and "goal" in options:
        parts = ("unknown reset option 'goal'",)
    if num_envs is None:
        env = gymnasium.make(env_id, model="cable")
    else:
        env = gymnasium.make_vec(env_id, num_envs=num_envs, model="cable")
    start, _ = env.reset(seed=0)
    with pytest.raises(ValueError, match=says(*parts)):
        env.reset(seed=0, options=options)
    np.testing.assert_array_equal(env.reset(seed=0)[0], start)


def test_seeds_of_vector_environments():
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    with pytest.raises(ValueError, match=says("seed 1.0", "an integer, or one for each of 2")):
        envs.reset(seed=1.0)
    with pytest.raises(ValueError, match="3 seeds for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    envs.reset(seed=3)
    for seed in ("ab", [1.5, 2]):
        with pytest.raises(ValueError, match=says(f"seed {seed!r}", "an integer, or one for each of 2")):
            envs.reset(seed=seed)
    with pytest.raises(gymnasium.error.Error, match="-5"):
        envs.reset(seed=[1, -5])
    assert envs.unwrapped.np_random_seed == (3, 4)  # and none of them is seeded anew


def test_one_bad_action_of_many_is_named_in_few_words():
    task = make_task("TrunkReach-v0", 600, 1, "cable", action="continuous")
    actions = np.zeros((600, 8))
    actions[300, 2] = 1.2
    with pytest.raises(ValueError, match=says("1.2 at [300, 2]", "from -1.0 to 1.0")) as error:
        task.check_actions(actions, 600)
    assert len(str(error.value)) < 250


def test_parameter_of_another_task():
    """A parameter that only other tasks have."""
    env = gymnasium.make("TrunkReach-v0", model="cable")
    with pytest.raises(ValueError, match=says("'friction'", "trunk_mass")):
        env.reset(options={"params": {"friction": 0.3}})


def test_goal_that_is_reached_already():
    """A goal at the tip's start, from which no reward can be measured."""
    env = gymnasium.make("TrunkReach-v0", model="cable")
    with pytest.raises(ValueError, match=says("goal [0.0, 0.0, 0.184]", "reached at reset")):
        env.reset(options={"goal": [0, 0, 0.184]})


@pytest.mark.parametrize("action", [16, -1, 3.0, np.float64(3), float("nan"), None, "3", True])
def test_discrete_action(env_id, action):
    """An action that is no integer from 0 to 15."""
    env = gymnasium.make(env_id, model="cable", disable_env_checker=True)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=says(str(action), "integers from 0 to 15")):
        env.step(action)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1.01, -2.0])
def test_continuous_action(env_id, bad):
    """A rate that is not finite or outside [-1, 1], before it reaches the simulation."""
    env = gymnasium.make(env_id, model="cable", action="continuous", disable_env_checker=True)
    start, _ = env.reset(seed=0)
    action = np.zeros(8)
    action[3] = bad
    with pytest.raises(ValueError, match=says(str(bad), "finite numbers from -1.0 to 1.0")):
        env.step(action)
    np.testing.assert_array_equal(env.unwrapped.task.keypoints([0]).ravel(), start[:63])


@pytest.mark.parametrize(
    ("mode", "action", "found"),
    [
        ("discrete", [1, 2], "(2,)"),
        ("discrete", [3], "(1,)"),
        ("continuous", np.zeros(7), "(7,)"),
        ("continuous", 0.5, "()"),
    ],
)
def test_action_shape(env_id, mode, action, found):
    """An action of the wrong shape."""
    env = gymnasium.make(env_id, model="cable", action=mode, disable_env_checker=True)
    env.reset(seed=0)
    expected = "()" if mode == "discrete" else "(8,)"
    with pytest.raises(ValueError, match=says(found, f"expected {expected}")):
        env.step(action)


@pytest.mark.parametrize(
    ("mode", "actions", "parts"),
    [
        ("discrete", np.zeros(3, int), ("(3,)", "(2,)")),
        ("discrete", np.array([0, 16]), ("[0, 16]", "integers from 0 to 15")),
        ("discrete", np.array([0.0, 1.0]), ("[0.0, 1.0]", "integers from 0 to 15")),
        ("continuous", np.zeros(8), ("(8,)", "(2, 8)")),
        ("continuous", np.full((2, 8), np.nan), ("nan", "finite numbers from -1.0 to 1.0")),
    ],
)
def test_vector_actions(mode, actions, parts):
    """Actions of a vector environment that are too few, too many or out of range."""
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", action=mode)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=says(*parts)):
        envs.step(actions)


@pytest.mark.parametrize("mask", [np.ones(3, bool), np.array([1, 0]), [True]])
def test_reset_mask(mask):
    """A reset mask that is not one boolean per simulation."""
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=says("reset_mask", "2 booleans")):
        envs.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("seed", [[1], [1, 2, 3], []])
def test_number_of_seeds(seed):
    """A list of seeds that is not one per simulation."""
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable")
    with pytest.raises(ValueError, match=says(f"{len(seed)} seeds", "2 environments")):
        envs.reset(seed=seed)


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: Uniform(("mass",), [0.1], [0.2]), ("parameter 'mass'", "trunk_mass")),
        (lambda: Uniform(("trunk_mass",), [0.2], [0.1]), ("trunk_mass: [0.2, 0.1]", "[0.001, 2.0]")),
        (lambda: Uniform(("trunk_mass",), [0.1], [5.0]), ("trunk_mass: [0.1, 5.0]", "[0.001, 2.0]")),
        (lambda: Uniform(("trunk_mass",), [np.nan], [1.0]), ("low of trunk_mass is [nan]", "finite")),
        (lambda: Uniform(("trunk_mass", "friction"), [0.1], [0.2]), ("low of trunk_mass, friction", "(2,) is needed")),
        (lambda: Uniform(("friction", "friction"), [0.1, 0.2], [0.2, 0.3]), ("parameter 'friction' comes twice",)),
        (lambda: TruncatedNormal(("trunk_mass",), [0.4], [-0.1]), ("trunk_mass", "-0.1", "negative")),
        (lambda: TruncatedNormal(("trunk_mass",), [np.inf], [0.1]), ("trunk_mass", "inf", "finite")),
        (lambda: TruncatedNormal(("trunk_mass",), [9.0], [0.1]), ("trunk_mass: 9.0 +- 2 * 0.1", "[0.001, 2.0]")),
        (lambda: Gaussian(("trunk_mass",), [0.4], [[1, 0], [0, 1]]), ("covariance of trunk_mass", "(1, 1) is needed")),
        (lambda: Gaussian(("trunk_mass",), [0.4, 0.3], [[1]]), ("mean of trunk_mass", "(1,) is needed")),
        (lambda: Gaussian(("trunk_mass", "friction"), [0.4, 0.3], [[1, 2], [0, 1]]), ("symmetric 2 x 2",)),
        (
            lambda: Gaussian(("trunk_mass", "friction"), [0.4, 0.3], [[1e-8, 4e-9], [-4e-9, 1e-8]]),
            ("symmetric 2 x 2",),
        ),
        (
            lambda: Gaussian(("trunk_mass", "friction"), [0.4, 0.3], [[1, 2], [2, 1]]),
            ("positive semi-definite", "correlations of 2"),
        ),
        (
            lambda: Gaussian(
                ("trunk_mass", "friction", "damping"), [0.4, 0.3, 0.1], [[1, 0.9, 0.9], [0.9, 1, -0.9], [0.9, -0.9, 1]]
            ),
            ("positive semi-definite", "eigenvalue -0.8"),
        ),
        (lambda: Gaussian(("trunk_mass",), [0.4], [[np.nan]]), ("covariance of trunk_mass", "finite")),
        (lambda: Gaussian(("trunk_mass",), [9.0], [[0.01]]), ("trunk_mass: 9.0 +- 2 * 0.1", "[0.001, 2.0]")),
    ],
)
def test_distribution(make, parts):
    """A distribution over an unknown parameter, outside the bounds, or without a meaning."""
    with pytest.raises(ValueError, match=says(*parts)):
        make()


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        ({"type": "beta"}, ("'beta'", "uniform, truncated_normal, gaussian")),
        ({}, ("None", "uniform, truncated_normal, gaussian")),
        ({"type": "uniform"}, ("uniform", "parameters")),
        ({"type": "uniform", "parameters": {"trunk_mass": {"low": 0.1}}}, ("uniform", "high")),
        ({"type": "uniform", "parameters": {"trunk_mass": {"low": 0.1, "high": "x"}}}, ("x",)),
        ({"type": "gaussian", "names": ["trunk_mass"], "mean": [0.4]}, ("gaussian", "cov")),
        ([1, 2], ()),
    ],
)
def test_distribution_file(tmp_path, data, parts):
    """A JSON file that describes no distribution; the file is named."""
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=says(str(path), *parts)):
        load(path)
    if isinstance(data, dict):
        with pytest.raises(ValueError, match=says(*parts)):
            from_dict(data)


def test_malformed_json(tmp_path):
    """A file that is no JSON, and one that is not there."""
    path = tmp_path / "broken.json"
    path.write_text('{"type": "uniform", ')
    with pytest.raises(ValueError, match=says(str(path))):
        load(path)
    with pytest.raises(FileNotFoundError, match=says("missing.json")):
        load(tmp_path / "missing.json")
