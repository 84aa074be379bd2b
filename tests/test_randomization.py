"""Distributions over parameters against known moments, their JSON form, and the wrappers that draw from them."""

import json
import math

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from soro_bench.effects.effect import Effect, Location
from soro_bench.envs.wrappers import DomainRandomization, VectorDomainRandomization
from soro_bench.parameters import ALL_PARAMETERS, FRICTION, POISSON_RATIO, TRUNK_MASS, YOUNG_MODULUS
from soro_bench.randomization import (
    Gaussian,
    TruncatedNormal,
    Uniform,
    from_dict,
    holding,
    load,
    random_box,
    search_box,
    told_values,
)

NAMES = ("trunk_mass", "poisson_ratio", "young_modulus")
SEARCH = search_box((TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS))
STD = np.array([0.02, 0.005, 2e5])
CORRELATION = np.array([[1, 0.8, 0], [0.8, 1, -0.3], [0, -0.3, 1]])
DISTRIBUTIONS = {
    "uniform": Uniform(NAMES, np.array([0.1, 0.41, 2e6]), np.array([0.9, 0.49, 6e6])),
    "truncated_normal": TruncatedNormal(NAMES, np.array([0.42, 0.45, 4.5e6]), np.array([0.05, 0.01, 5e5])),
    "gaussian": Gaussian(NAMES, np.array([0.42, 0.45, 4.5e6]), CORRELATION * np.outer(STD, STD)),
}


@pytest.fixture(params=DISTRIBUTIONS)
def distribution(request):
    return DISTRIBUTIONS[request.param]


def draw(distribution, n, seed=0):
    """(n, d) samples in the order of the distribution's names."""
    rng = np.random.default_rng(seed)
    return np.array([list(distribution.sample(rng).values()) for _ in range(n)])


def truncated_moments(low, high):
    """Mean and standard deviation of a standard normal truncated to [low, high], in closed form."""

    def density(x):
        return math.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)

    mass = (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2))) / 2
    mean = (density(low) - density(high)) / mass
    return mean, math.sqrt(1 + (low * density(low) - high * density(high)) / mass - mean**2)


def test_search_boxes_are_published():
    """The search boxes are those of the published study, with Poisson's ratio kept off its singular value 0.5."""
    boxes = {name: parameter.search for name, parameter in ALL_PARAMETERS.items()}
    assert boxes["trunk_mass"] == boxes["cube_mass"] == (0.005, 1.0)
    assert boxes["friction"] == (0.01, 1.0)
    assert boxes["poisson_ratio"] == (0.4, 0.495)
    assert boxes["young_modulus"] == (2e6, 7e6)
    assert boxes["wall_offset"] == (-0.03, 0.03)


@pytest.mark.parametrize("name", ALL_PARAMETERS)
def test_nominal_in_search_box_in_bounds(name):
    """A parameter's search box lies in its bounds and holds its nominal value."""
    parameter = ALL_PARAMETERS[name]
    (least, most), (low, high) = parameter.bounds, parameter.search
    assert least <= low <= parameter.nominal <= high <= most


@pytest.mark.parametrize("kind", ["truncated_normal", "gaussian"])
@pytest.mark.parametrize("name", ALL_PARAMETERS)
def test_samples_stay_in_bounds(kind, name):
    """Normals that reach far outside a parameter's bounds still give values inside."""
    low, high = ALL_PARAMETERS[name].bounds
    wide = high - low
    mean, spread = np.array([low]), np.array([wide])
    distribution = (
        TruncatedNormal((name,), mean, spread) if kind == "truncated_normal" else Gaussian((name,), mean, [spread**2])
    )
    samples = draw(distribution, 200)
    assert samples.min() >= low and samples.max() <= high
    assert samples.max() - samples.min() > wide / 2


def test_same_generator_same_samples(distribution):
    """The same seed gives the same samples, another seed others."""
    np.testing.assert_array_equal(draw(distribution, 5), draw(distribution, 5))
    assert not np.array_equal(draw(distribution, 5), draw(distribution, 5, seed=1))


def test_json_round_trip(distribution, tmp_path):
    """Written to JSON and read back, a distribution gives the same samples to the last bit."""
    path = tmp_path / "distribution.json"
    path.write_text(json.dumps(distribution.to_dict()))
    for again in (from_dict(json.loads(path.read_text())), load(path), load(str(path))):
        assert type(again) is type(distribution)
        assert again.names == distribution.names
        np.testing.assert_array_equal(draw(again, 20), draw(distribution, 20))


def test_uniform_moments():
    """Uniform samples fill their box: mean in the middle, standard deviation width / sqrt(12)."""
    box = DISTRIBUTIONS["uniform"]
    samples = draw(box, 4000)
    width = box.high - box.low
    assert (samples >= box.low).all() and (samples <= box.high).all()
    np.testing.assert_allclose((samples.mean(axis=0) - box.low) / width, 0.5, atol=0.02)
    np.testing.assert_allclose(samples.std(axis=0) / width, 12**-0.5, atol=0.01)


def test_truncated_normal_moments():
    """Truncated at two standard deviations, a normal keeps its mean and 0.8796 of its standard deviation."""
    normal = DISTRIBUTIONS["truncated_normal"]
    standard = (draw(normal, 4000) - normal.mean) / normal.std
    assert np.abs(standard).max() <= 2 + 1e-9
    assert truncated_moments(-2, 2) == pytest.approx((0, 0.87963), abs=1e-5)
    np.testing.assert_allclose(standard.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(standard.std(axis=0), 0.87963, atol=0.02)


def test_truncated_normal_at_a_bound():
    """Where a parameter's bound cuts the normal, the samples have the moments of the doubly truncated normal."""
    low, _ = POISSON_RATIO.bounds
    normal = TruncatedNormal(("poisson_ratio",), np.array([low + 0.01]), np.array([0.02]))  # cut at -0.5 sd
    standard = (draw(normal, 4000) - normal.mean) / normal.std
    mean, std = truncated_moments(-0.5, 2)
    assert standard.mean() == pytest.approx(mean, abs=0.03)
    assert standard.std() == pytest.approx(std, abs=0.03)


def test_truncated_normal_without_spread():
    """A standard deviation of zero fixes the parameter."""
    normal = TruncatedNormal(("friction",), np.array([0.7]), np.array([0.0]))
    np.testing.assert_array_equal(draw(normal, 3), 0.7)


def test_gaussian_covariance():
    """Samples of the full Gaussian have its mean, standard deviations and correlations."""
    gaussian = DISTRIBUTIONS["gaussian"]
    samples = draw(gaussian, 3000)
    standard = (samples - gaussian.mean) / STD
    np.testing.assert_allclose(standard.mean(axis=0), 0, atol=0.07)
    np.testing.assert_allclose(np.cov(standard.T), CORRELATION, atol=0.07)


def test_gaussian_with_a_fixed_parameter():
    """A Gaussian may be degenerate: a parameter of zero variance is fixed, one of full correlation follows another."""
    cov = np.array([[1e-4, 1e4, 0], [1e4, 1e12, 0], [0, 0, 0]])
    gaussian = Gaussian(("trunk_mass", "young_modulus", "friction"), np.array([0.42, 4.5e6, 0.3]), cov)
    mass, modulus, friction = draw(gaussian, 200).T
    np.testing.assert_array_equal(friction, 0.3)
    inside = (modulus > 1e6) & (modulus < 1e7)  # the others were clipped to the bounds
    np.testing.assert_allclose((mass - 0.42)[inside] / 0.01, (modulus - 4.5e6)[inside] / 1e6, atol=1e-6)
    assert mass.std() > 0.005
    assert holding(gaussian, {"friction": 0.3}) is gaussian
    with pytest.raises(ValueError, match="trunk_mass cannot be held in a Gaussian"):
        holding(gaussian, {"trunk_mass": 0.42, "friction": 0.3})


def test_a_distribution_of_nothing_is_refused():
    for nothing in ({"type": "uniform", "parameters": {}}, {"type": "gaussian", "names": [], "mean": [], "cov": []}):
        with pytest.raises(ValueError, match="at least one parameter"):
            from_dict(nothing)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"type": "uniform", "parameters": {"friction": {"low": False, "high": True}}}, "not all numbers"),
        ({"type": "uniform", "parameters": {"friction": {"low": "0.1", "high": 0.2}}}, "not all numbers"),
        ({"type": "gaussian", "names": ["friction", "damping"], "mean": [0.3, 0.1], "cov": [[0, 10], [10, 0]]},
         "correlations of"),
        ({"type": "gaussian", "names": ["friction", "damping"], "mean": [0.3, 0.1], "cov": [[0, 1e-3], [1e-3, 1]]},
         "correlations of"),
    ],
)  # fmt: skip
def test_what_is_no_number_or_no_covariance_is_refused(data, said):
    with pytest.raises(ValueError, match=said):
        from_dict(data)


def test_random_boxes():
    """Random boxes are ordered, lie in the search box and take a third of each side on average."""
    rng = np.random.default_rng(0)
    boxes = [random_box((TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS, FRICTION), rng) for _ in range(1000)]
    assert boxes[0].names == ("trunk_mass", "poisson_ratio", "young_modulus", "friction")
    low, high = np.array([box.low for box in boxes]), np.array([box.high for box in boxes])
    search = search_box((TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS, FRICTION))
    assert (search.low <= low).all() and (low <= high).all() and (high <= search.high).all()
    np.testing.assert_allclose((high - low).mean(axis=0) / (search.high - search.low), 1 / 3, atol=0.03)


def test_wrapper_draws_every_episode(model):
    """Every reset of a randomised environment draws new parameters in the box and leaves the others nominal."""
    env = DomainRandomization(gymnasium.make("TrunkReach-v0", model=model), SEARCH)
    draws = [env.reset(seed=0 if i == 0 else None)[1]["params"] for i in range(30)]
    values = np.array([[params[name] for name in NAMES] for params in draws])
    assert (values >= SEARCH.low).all() and (values <= SEARCH.high).all()
    assert len(np.unique(values[:, 0])) == 30
    spread = (values.max(axis=0) - values.min(axis=0)) / (SEARCH.high - SEARCH.low)
    assert (spread > 0.5).all()
    assert {params["damping"] for params in draws} == {0.1}
    assert env.reset(seed=0)[1]["params"] == draws[0]


def test_drawn_parameters_act(model):
    """The drawn parameters are those of the simulation: the same ones given by options give the same motion."""
    random, plain = (gymnasium.make("TrunkReach-v0", model=model) for _ in range(2))
    random = DomainRandomization(random, SEARCH)
    _, info = random.reset(seed=5)
    plain.reset(seed=5, options={"params": info["params"]})
    for action in (1, 6, 9):
        np.testing.assert_array_equal(random.step(action)[0], plain.step(action)[0])


def test_only_episodes_that_begin_through_the_wrapper_are_randomised():
    """The environment inside goes on with what it had; that of the vector is randomised when it resets itself, too."""
    plain = gymnasium.make("TrunkReach-v0", model="cable")
    DomainRandomization(plain, SEARCH).reset(seed=0)
    assert plain.reset(seed=0)[1]["params"]["trunk_mass"] == 0.42
    inside = gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable", max_episode_steps=1)
    vector = VectorDomainRandomization(inside, SEARCH)
    first = vector.reset(seed=0)[1]["params"]["trunk_mass"]
    actions = np.zeros(2, int)
    vector.step(actions)
    second = vector.step(actions)[4]["params"]["trunk_mass"]
    assert (first != second).all() and (second != 0.42).all()
    np.testing.assert_array_equal(inside.reset(seed=0)[1]["params"]["trunk_mass"], 0.42)


def test_episodes_that_begin_by_themselves_are_randomised():
    """Also those of Gymnasium's wrapper for a single environment."""
    inside = gymnasium.make("TrunkReach-v0", model="cable", max_episode_steps=1)
    env = DomainRandomization(gymnasium.wrappers.Autoreset(inside), SEARCH)
    env.reset(seed=0)
    masses = [env.step(0)[4]["params"]["trunk_mass"] for _ in range(4)]
    assert len(set(masses)) == 3  # the first step is of the episode that reset began
    assert 0.42 not in masses


def test_an_environment_is_randomised_by_one_distribution():
    """The inner one would win, and the outer one do nothing."""
    env = DomainRandomization(gymnasium.make("TrunkReach-v0", model="cable"), SEARCH)
    with pytest.raises(ValueError, match="randomised already"):
        DomainRandomization(gymnasium.wrappers.FlattenObservation(env), SEARCH)


def test_a_randomised_environment_is_made_again_from_the_json_of_its_spec():
    """With the same draws, and an equal spec."""
    effect = Effect("actuator_gain", Location("actuator", "L2"), {"gain": 0.7})
    env = DomainRandomization(gymnasium.make("TrunkReach-v0", model="cable", effects=[effect]), SEARCH)
    spec = EnvSpec.from_json(env.spec.to_json())
    again = gymnasium.make(spec)
    assert again.spec == spec
    np.testing.assert_array_equal(again.reset(seed=3)[0], env.reset(seed=3)[0])
    assert again.reset()[1]["params"] == env.reset()[1]["params"]
    np.testing.assert_array_equal(again.step(2)[0], env.step(2)[0])


def test_options_override_the_draw():
    """Parameters given at reset win over the distribution, in the single and the vector wrapper."""
    single = DomainRandomization(gymnasium.make("TrunkReach-v0", model="cable"), SEARCH)
    vector = VectorDomainRandomization(gymnasium.make_vec("TrunkReach-v0", num_envs=2, model="cable"), SEARCH)
    options = {"params": {"young_modulus": 3e6}}
    alone = single.reset(seed=0, options=options)[1]["params"]
    together = vector.reset(seed=0, options=options)[1]["params"]
    assert alone["young_modulus"] == 3e6
    np.testing.assert_array_equal(together["young_modulus"], 3e6)
    assert alone["trunk_mass"] != 0.42
    assert together["trunk_mass"][0] == alone["trunk_mass"]
    assert together["trunk_mass"][1] != alone["trunk_mass"]


@pytest.mark.parametrize("seed", range(3))
def test_goals_do_not_depend_on_randomisation(distribution, seed):
    """The same seed gives the same goal with and without randomisation, whatever the distribution."""
    plain = gymnasium.make("TrunkReach-v0", model="cable")
    random = DomainRandomization(gymnasium.make("TrunkReach-v0", model="cable"), distribution)
    np.testing.assert_array_equal(random.reset(seed=seed)[0][63:], plain.reset(seed=seed)[0][63:])


def test_what_a_policy_is_told_is_within_the_bounds_and_constant_where_training_is():
    """A normal distribution is cut off at the bounds; its peak may be beyond them."""
    found = TruncatedNormal(("friction", "trunk_mass"), np.array([-0.1, 0.5]), np.array([0.2, 0.1]))
    box = search_box((FRICTION, TRUNK_MASS, POISSON_RATIO))
    expected = {"friction": 0.0, "trunk_mass": 0.5, "poisson_ratio": POISSON_RATIO.nominal}
    assert told_values(found, box) == expected
    assert told_values(None, box) == {name: ALL_PARAMETERS[name].nominal for name in box.names}
    narrow = TruncatedNormal(box.names, np.array([0.3, 0.4, 0.45]), np.array([0.1, 0.0, 0.01]))
    correlated = Gaussian(box.names, narrow.mean, np.diag(narrow.std) ** 2)
    for held in (holding(box, {"trunk_mass": 0.4}), narrow, correlated):
        assert told_values(found, held) == {**expected, "trunk_mass": 0.4}


def test_wrapper_refuses_foreign_parameters():
    """A distribution over a parameter that the environment does not have is refused by name."""
    env = gymnasium.make("TrunkReach-v0", model="cable")
    with pytest.raises(ValueError, match=r"friction.*trunk_mass"):
        DomainRandomization(env, search_box((FRICTION,)))
