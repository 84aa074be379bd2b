"""MultiGait: its robot against known answers, and its episodes."""

import warnings
from fractions import Fraction

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from threadpoolctl import threadpool_info, threadpool_limits

from soro_bench import parameters as prm
from soro_bench.envs.multigait import INFLATION_NOISE, INFLATION_PER_ACTION, MultiGaitTask
from soro_bench.evaluation import evaluate
from soro_bench.models import walker, walker_mesh
from soro_bench.models.simulation import Simulation
from soro_bench.models.walker_mesh import CHAMBERS, RESOLUTIONS, build_mesh
from soro_bench.parameters import ParameterSet
from soro_bench.randomization import search_box

SCENE = "multigait.xml"
NODES = {"coarse": 110, "fine": 340, "finest": 708}
# m^2, the published outline's area: four quadrants, each a rectangle-like centre and a leg (shoelace formula)
OUTLINE = np.array([[0, 0], [0.02952, 0], [0.06785, 0.01782], [0.0637, 0.02925], [0.01479, 0.01612], [0, 0.01612]])


@pytest.fixture(params=RESOLUTIONS)
def mesh(request):
    return request.param


def simulation(mesh, **params):
    model = walker.build_spec(SCENE, mesh).compile()
    sim = Simulation(model, ParameterSet(*walker.PARAMETERS), [walker.WalkerParameters(model, SCENE, mesh)], 1)
    sim.set_params(np.arange(1), sim.parameters.to_array(params)[None])
    return sim


def volumes(body):
    edges = body.nodes[body.tetrahedra[:, 1:]] - body.nodes[body.tetrahedra[:, :1]]
    return np.linalg.det(edges) / 6


def test_mesh_fills_the_outline(mesh):
    """Tetrahedra are positive and fill the outline, the bottom triangles cover it, and the number of nodes is known."""
    body = build_mesh(RESOLUTIONS[mesh])
    x, y = OUTLINE.T
    area = 4 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    assert len(body.nodes) == NODES[mesh]
    assert volumes(body).min() > 0
    assert volumes(body).sum() == pytest.approx(area * walker_mesh.HEIGHT)
    edges = body.nodes[body.bottom[:, 1:]] - body.nodes[body.bottom[:, :1]]
    assert np.cross(edges[:, 0], edges[:, 1])[:, 2].sum() / 2 == pytest.approx(area)


def test_mesh_is_symmetric(mesh):
    """Mirrored front to rear or left to right, nodes and elements are the same, and chambers swap."""
    body = build_mesh(RESOLUTIONS[mesh])
    for flip, swap in (([-1, 1, 1], [0, 3, 4, 1, 2]), ([1, -1, 1], [0, 2, 1, 4, 3])):
        key = {tuple(np.round(node, 9) + 0.0): i for i, node in enumerate(body.nodes)}
        image = np.array([key[tuple(np.round(node * flip, 9) + 0.0)] for node in body.nodes])
        chamber_of = {tuple(sorted(e)): c for e, c in zip(body.tetrahedra.tolist(), body.chamber, strict=True)}
        for element, chamber in chamber_of.items():
            assert chamber_of[tuple(sorted(image[list(element)]))] == (chamber if chamber < 0 else swap[chamber])


def test_parameters_act_as_in_the_compiler(mesh):
    """The stiffness written at run time is the one that MuJoCo compiles, and the mass is the one asked for."""
    params = {"robot_mass": 0.03, "ecoflex_young_modulus": 9e4, "ecoflex_poisson_ratio": 0.08,
              "pdms_young_modulus": 3e6, "pdms_poisson_ratio": 0.47}  # fmt: skip
    model = simulation(mesh, **params).batch.get_model(0)
    spec = walker.build_spec(SCENE, mesh)
    for flex in spec.flexes:
        flex.young, flex.poisson = params[f"{flex.name}_young_modulus"], params[f"{flex.name}_poisson_ratio"]
    compiled = spec.compile().flex_stiffness
    np.testing.assert_allclose(model.flex_stiffness, compiled, rtol=1e-9, atol=1e-9 * np.abs(compiled).max())
    assert model.body_mass.sum() == pytest.approx(0.03)


def test_no_inflation_changes_nothing(mesh):
    """Without inflation the rest lengths are those of the mesh."""
    model = walker.build_spec(SCENE, mesh).compile()
    assert not walker.Inflation(model, mesh).plastic(np.zeros((1, 5))).any()


def test_growth_sets_the_rest_lengths(mesh):
    """The offset of a chamber's edges is the difference of the squared lengths of grown and original edges."""
    model = walker.build_spec(SCENE, mesh).compile()
    body = build_mesh(RESOLUTIONS[mesh])
    growth = 0.3
    plastic = walker.Inflation(model, mesh, (growth, growth)).plastic(np.ones((1, 5)))[0].reshape(-1, 6)
    axes = walker_mesh.chamber_axes()
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    for row, element in zip(plastic, np.flatnonzero(body.chamber >= 0), strict=True):
        axis = axes[body.chamber[element]]
        grow = np.eye(3) + growth * (np.outer(axis, axis) + walker.UPWARD_GROWTH * np.diag([0, 0, 1]))
        corners = body.nodes[body.tetrahedra[element]]
        edges = np.array([corners[b] - corners[a] for a, b in pairs])
        np.testing.assert_allclose(
            np.sort(row), np.sort(((edges @ grow) ** 2).sum(axis=1) - (edges**2).sum(axis=1)), atol=1e-15
        )


@pytest.mark.parametrize("chamber", range(len(CHAMBERS)))
def test_inflation_bends_downwards(chamber):
    """An inflated leg, or the inflated centre, arches up off the floor."""
    sim, body = simulation("coarse"), build_mesh(RESOLUTIONS["coarse"])
    inflation = walker.Inflation(sim.model, "coarse")
    now = np.zeros((1, len(CHAMBERS)))
    for step in range(60):
        now[0, chamber] = min(1.0, step / 30)
        sim.batch.plastic[:, inflation.columns] = inflation.plastic(now)
        sim.batch.step(np.arange(1))
    height = body.nodes[:, 2] + sim.batch.qpos[0].reshape(-1, 3)[:, 2]
    assert height[body.tetrahedra[body.chamber == chamber]].max() > 2 * walker_mesh.HEIGHT


def test_beam_bends_as_the_analytic_cantilever():
    """A slender beam of the walker's silicone sags under its weight by rho g A L^4 / (8 E I) within 10 %."""
    length, width, height, density, gravity = 0.06, 0.004, 0.006, 1000.0, 0.05
    young = prm.ECOFLEX_YOUNG_MODULUS.nominal
    body = beam(length, width, height)
    mass = density * length * width * height
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.timestep = 1.0  # s, large steps damp the motion
    spec.option.gravity = [0, 0, -gravity]
    spec.option.iterations, spec.option.tolerance = 3000, 1e-10
    names = walker._add_vertices(spec, body)
    for name in np.array(names)[body.nodes[:, 0] < 1e-9]:  # clamped
        for axis in "xyz":
            spec.delete(spec.joint(f"{name}_{axis}"))
    walker._add_flex(spec, "beam", body, body.tetrahedra, names, prm.ECOFLEX_POISSON_RATIO.nominal)
    spec.flexes[0].young = young
    spec.flexes[0].material = ""
    model = spec.compile()
    model.body_mass[1:] *= mass / model.body_mass.sum()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 25)
    tip = np.isclose(body.nodes[:, 0], length)
    sag = (body.nodes[tip, 2] - data.xpos[1:][tip, 2]).mean()
    inertia = width * height**3 / 12
    expected = density * gravity * width * height * length**4 / (8 * young * inertia)
    assert np.abs(data.qvel).max() < 1e-3 * sag
    assert sag == pytest.approx(expected, rel=0.1)


def beam(length, width, height):
    """A clamped-free bar along x, cut finely enough for linear elements to bend."""
    corners = [(0, 0), (length, 0), (0, width), (length, width)]
    plan, triangles = walker_mesh._block(corners, 60, 1)
    levels = np.linspace(0, height, 11)
    nodes = np.concatenate([np.column_stack([plan, np.full(len(plan), z)]) for z in levels])
    tetrahedra, chamber = walker_mesh._prisms(triangles, np.zeros(len(triangles), int), len(plan), levels)
    return walker_mesh.Mesh(nodes, walker_mesh._oriented(nodes, tetrahedra), triangles, chamber)


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


@pytest.mark.parametrize("factor", [Fraction(1, 2), 1])
def test_a_control_step_has_as_long_whatever_the_number_of_time_steps(factor):
    """The last update of the rest lengths may be for one time step alone, and what is observed is of the last state."""
    task = MultiGaitTask(1, 1, mesh="coarse", action="discrete")
    task.refine(factor)
    everyone, count = np.arange(1), 2
    task.reset(everyone, [np.random.default_rng(0)], [{}])
    for _ in range(count):
        task.step(everyone, np.zeros(1, int))
    assert task.sim.batch.bind("time")[0] == pytest.approx(count * task.control_timestep)
    observed = task.center_of_mass(everyone)
    task.sim.batch.forward(everyone)
    np.testing.assert_allclose(observed, task.center_of_mass(everyone), atol=1e-12)


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


def test_recorded_actions_stay_if_what_acts_fills_the_same_array_again():
    actions = np.zeros((1, 3))

    def act(observations):
        actions[...] += 0.1
        return actions

    (episode,) = evaluate(act, "MultiGait-v0", "coarse", "continuous", max_episode_steps=3)
    np.testing.assert_allclose(episode.actions[:, 0], [0.1, 0.2, 0.3])


def test_an_evaluation_has_one_blas_thread():
    """The last digits of a wide policy's actions would depend on how many there are."""
    found = []

    def act(observations):
        found.extend(each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas")
        return np.zeros(len(observations), int)

    with threadpool_limits(2, user_api="blas"):
        evaluate(act, "MultiGait-v0", "coarse", "discrete", max_episode_steps=1)
    assert set(found) == {1}
