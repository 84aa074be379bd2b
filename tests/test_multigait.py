"""MultiGait: Gymnasium's rules, the same bytes single and vector, actions, rewards, noise."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from threadpoolctl import threadpool_info, threadpool_limits

from soro_bench.envs.multigait import INFLATION_NOISE, INFLATION_PER_ACTION, MultiGaitTask
from soro_bench.evaluation import evaluate
from soro_bench.models import walker
from soro_bench.randomization import search_box

INFLATE_CENTRE, INFLATE_REAR, INFLATE_FRONT, DEFLATE_CENTRE, DEFLATE_REAR, DEFLATE_FRONT = range(6)
WALK = [INFLATE_CENTRE, INFLATE_CENTRE, INFLATE_FRONT, DEFLATE_REAR, INFLATE_FRONT, DEFLATE_REAR]


def make(**kwargs):
    return gymnasium.make("MultiGait-v0", **{"mesh": "coarse", **kwargs})


def run(env, actions, seed=0, **reset):
    """Observations, rewards and infos of an episode."""
    env.reset(seed=seed, **reset)
    return [env.step(a) for a in actions]


def test_gymnasium_check_env(action):
    """Gymnasium's checker finds nothing and warns of nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(action=action).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_vector_gives_the_bytes_of_single(num_threads):
    """Simulation i of the vector env, with noise and random parameters, is the single env with seed s + i."""
    actions = np.random.default_rng(0).integers(0, 6, (6, 3))
    envs = gymnasium.make_vec(
        "MultiGait-v0", num_envs=3, num_threads=num_threads, mesh="coarse", observation_noise=True
    )
    envs.unwrapped.task.randomize(search_box(walker.PARAMETERS))
    first, _ = envs.reset(seed=5)
    steps = [envs.step(a) for a in actions]
    single = make(observation_noise=True)
    single.unwrapped.task.randomize(search_box(walker.PARAMETERS))
    for i in range(3):
        observation, _ = single.reset(seed=5 + i)
        assert observation.tobytes() == first[i].tobytes()
        for k in range(6):
            observation, reward, _, truncated, info = single.step(actions[k, i])
            assert observation.tobytes() == steps[k][0][i].tobytes()
            assert reward == steps[k][1][i] and truncated == steps[k][3][i]
            assert info["params"]["robot_mass"] == steps[k][4]["params"]["robot_mass"][i]


def test_inflations_follow_the_actions():
    """An action moves its chambers by 60/74 of the maximum, within 0 and 1."""
    steps = run(make(), [INFLATE_FRONT, INFLATE_FRONT, DEFLATE_CENTRE, INFLATE_CENTRE, DEFLATE_FRONT])
    inflations = np.array([observation[3:] for observation, *_ in steps])
    part = INFLATION_PER_ACTION
    expected = [[0, 0, 0, part, part], [0, 0, 0, 1, 1], [0, 0, 0, 1, 1], [part, 0, 0, 1, 1],
                [part, 0, 0, 1 - part, 1 - part]]  # fmt: skip
    np.testing.assert_allclose(inflations, expected, atol=1e-9)


def test_continuous_actions_equal_discrete_ones():
    """The extreme continuous actions do what the discrete ones do."""
    discrete = run(make(), [INFLATE_CENTRE, INFLATE_FRONT, DEFLATE_CENTRE])
    actions = np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0]], np.float32)
    continuous = run(make(action="continuous"), actions)
    for ours, theirs in zip(continuous, discrete, strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)


def test_rewards_add_up_to_the_displacement():
    """The sum of the rewards [mm] is the displacement of the centre of mass, and the walk goes forward."""
    steps = run(make(), WALK)
    displacement = steps[-1][4]["displacement"]
    assert sum(reward for _, reward, *_ in steps) == pytest.approx(1e3 * displacement)
    assert 0.008 < displacement < 0.03
    assert [truncated for *_, truncated, _ in steps] == [False] * 5 + [True]


def test_mirrored_walk_goes_backward():
    """With front and rear swapped the body moves as far the other way, within 10 %."""
    swap = {INFLATE_REAR: INFLATE_FRONT, INFLATE_FRONT: INFLATE_REAR, DEFLATE_REAR: DEFLATE_FRONT,
            DEFLATE_FRONT: DEFLATE_REAR}  # fmt: skip
    forward = run(make(), WALK)[-1][4]["displacement"]
    backward = run(make(), [swap.get(a, a) for a in WALK])[-1][4]["displacement"]
    assert backward == pytest.approx(-forward, rel=0.1)


def test_noise_has_the_published_size():
    """Noisy observations scatter about the true ones with 0.5 mm and 100 units of 3500 (centre) or 2000 (legs)."""
    count = 400
    tasks = [MultiGaitTask(count, 2, mesh="coarse", observation_noise=noise) for noise in (True, False)]
    ids = np.arange(count)
    noisy, clean = (t.reset(ids, [np.random.default_rng(i) for i in ids], [{}] * count)[0] for t in tasks)
    expected = np.concatenate([np.full(3, 0.0005), INFLATION_NOISE])
    np.testing.assert_allclose((noisy - clean).std(axis=0), expected, rtol=0.15)


def test_fine_mesh_walks_too():
    """The walk goes forward on the fine mesh."""
    assert run(make(mesh="fine"), WALK)[-1][4]["displacement"] > 0.004


@pytest.mark.parametrize(
    ("argument", "error", "message"),
    [
        ({"model": "flex"}, TypeError, "model='flex'.*mesh"),
        ({"mesh": "rough"}, ValueError, "mesh 'rough'.*coarse, fine, finest"),
        ({"action": "torque"}, ValueError, "action mode 'torque'"),
    ],
)
def test_bad_argument(argument, error, message):
    """An unknown argument, mesh or action mode."""
    with pytest.raises(error, match=message):
        gymnasium.make("MultiGait-v0", **argument)


def test_bad_parameter():
    """A parameter out of its bounds."""
    with pytest.raises(ValueError, match=r"robot_mass = 3.0 is outside \[0.005, 0.2\] kg"):
        make().reset(options={"params": {"robot_mass": 3.0}})


def test_evaluation_records_an_episode():
    """An evaluation records the mesh, the inflations and the displacement of an episode of any length."""
    actions = iter([*WALK, *WALK])
    episode = evaluate(lambda o: np.full(len(o), next(actions)), "MultiGait-v0", "coarse", "discrete",
                       max_episode_steps=12)[0]  # fmt: skip
    assert episode.signals["vertices"].shape == (13, 110, 3)
    assert episode.metric_name == "displacement" and episode.metric.shape == (13,)
    assert episode.goal is None and not episode.diverged


def test_an_evaluation_has_one_blas_thread():
    """The last digits of a wide policy's actions would depend on how many there are."""
    found = []

    def act(observations):
        found.extend(each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas")
        return np.zeros(len(observations), int)

    with threadpool_limits(2, user_api="blas"):
        evaluate(act, "MultiGait-v0", "coarse", "discrete", max_episode_steps=1)
    assert set(found) == {1}
