"""Searches for parameters, likelihoods, logs, what a recording determines, linear models over samples."""

import json

import numpy as np
import pytest
from scipy.stats import multivariate_normal

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.inference import rf_dropo
from soro_bench.inference.continuation import ATTEMPTS, best_track, refine
from soro_bench.inference.methods import uncertainty
from soro_bench.inference.posterior import combinations, fisher
from soro_bench.inference.replay import MISSING
from soro_bench.inference.rf_dropo import horizon, log_likelihood, sample_factor
from soro_bench.inference.search import EvaluationLog, cma_search
from soro_bench.inference.statistical_linearisation import LowRank, linearised, sample_around
from soro_bench.parameters import FRICTION, TRUNK_MASS, WALL_OFFSET, YOUNG_MODULUS


def test_a_search_beside_what_diverges_ends_where_nothing_does():
    def cost(points, share):
        squares = ((points - 0.3) ** 2).sum(axis=1)
        return np.where(points[:, 0] > 0.32, np.nan, squares)

    for seed in range(20):
        assert cma_search(cost, 2, 8, 8, seed)[0] <= 0.32


def test_a_search_in_one_dimension_ends_at_the_edge():
    for seed in range(5):
        assert cma_search(lambda points, share: -points[:, 0], 1, 60, 16, seed) == pytest.approx([1.0], abs=1e-3)


def test_a_search_in_which_everything_diverges_says_so():
    with pytest.raises(ValueError, match="every replay diverged"):
        cma_search(lambda points, share: np.full(len(points), np.nan), 2, 3, 8, 0)


@pytest.mark.parametrize("left", [b"", b'{"titl'])
def test_a_log_whose_writer_was_killed_at_once_begins_anew(tmp_path, left):
    path = tmp_path / "log.jsonl"
    path.write_bytes(left)
    square = EvaluationLog(path, "title")(lambda x: x**2, np.array([2.0]), "square")
    with path.open("ab") as file:
        file.write(b'{"call": "cut o')
    again = EvaluationLog(path, "title")
    assert again.known == 1 and again(None, np.array([2.0]), "square") == square == 4.0
    assert path.read_bytes().endswith(b"}\n")


def test_a_log_of_another_inference_that_never_began_is_replaced(tmp_path):
    path = tmp_path / "log.jsonl"
    EvaluationLog(path, "seed -1")
    assert EvaluationLog(path, "seed 0").known == 0
    assert json.loads(path.read_text()) == {"title": "seed 0"}
    path.write_text('{"mine": 1}\n')
    with pytest.raises(ValueError, match="log of another inference"):
        EvaluationLog(path, "seed 0")


def test_the_likelihood_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(0)
    residual, factor, deviation = rng.normal(size=(4, 6)), rng.normal(size=(4, 6, 2)), rng.uniform(0.1, 1, (4, 6))
    expected = [
        multivariate_normal(np.zeros(6), f @ f.T + np.diag(d**2)).logpdf(r)
        for r, f, d in zip(residual, factor, deviation, strict=True)
    ]
    np.testing.assert_allclose(log_likelihood(residual, factor, deviation), expected)


def test_a_replay_that_diverged_has_no_likelihood():
    residual = np.array([[0.0, 0.0], [np.nan, 0.0]])
    values = log_likelihood(residual, np.zeros((2, 2, 1)), np.ones((2, 2)))
    assert np.isfinite(values[0]) and values[1] == -np.inf


def test_the_factor_of_samples_gives_their_covariance():
    samples = np.random.default_rng(0).normal(size=(50, 3, 4))
    mean, factor = sample_factor(samples)
    np.testing.assert_allclose(mean, samples.mean(axis=0))
    np.testing.assert_allclose(factor[1] @ factor[1].T, np.cov(samples[:, 1].T), rtol=1e-10)


def test_the_horizon_grows_to_the_whole_recording():
    assert [horizon(share, 100) for share in (0.0, 0.5, 1.0)] == [1, 90, 99]


@pytest.mark.parametrize("search", ["linearised", "sampled"])
def test_both_searches_find_the_optimum_of_a_linear_gaussian_model(search):
    # y_t = x with x normal: the best mean is that of the data, the best variance theirs less the sensor's
    rng = np.random.default_rng(1)
    data = 0.6 + 0.05 * rng.standard_normal((100, 1))
    deviation = np.full_like(data, 0.02)

    def residuals(points, steps):
        return data[None, :steps] - points[:, None, :]

    if search == "linearised":
        fit = rf_dropo.linearised(residuals, deviation, [slice(0, 1)], 1, EvaluationLog(None, ""))
    else:
        fit = rf_dropo.sampled(residuals, deviation, 1, EvaluationLog(None, ""), iterations=40, samples=128)
    assert fit.mean[0] == pytest.approx(data.mean(), abs=2e-3)
    expected = np.sqrt(data.var() - 0.02**2)
    # truncation at two standard deviations takes 12 % off the standard deviation of the samples
    assert fit.std[0] == pytest.approx(expected / (1 if search == "linearised" else 0.88), rel=0.05)


def test_a_ratio_is_named_when_only_the_ratio_matters():
    # what is measured depends on the logarithm of mass / E, and a hundred times less on friction
    d_log = np.array([[1.0, -1.0, 0.0], [0.5, -0.5, 0.01]])
    values = np.array([0.4, 4e6, 0.3])
    found = combinations((d_log / values)[None], np.full((1, 2), 1e-3), (TRUNK_MASS, YOUNG_MODULUS, FRICTION), values)
    assert "determined to" in found[0].words and found[0].exponents["friction"] == pytest.approx(0, abs=0.01)
    assert found[0].exponents["trunk_mass"] == pytest.approx(-found[0].exponents["young_modulus"], abs=1e-3)
    assert "trunk_mass * young_modulus is not determined" in found[2].words


def test_what_a_recording_says_nothing_about_is_as_wide_as_its_box():
    jacobian = np.zeros((10, 1, 2))
    jacobian[:, 0, 0] = 1.0
    assert np.sqrt(np.diag(uncertainty(jacobian, np.full((10, 1), 1e-3)))) == pytest.approx(
        [1e-3 / np.sqrt(10), rf_dropo.LARGEST_STD], rel=1e-4
    )


def test_what_diverges_beside_the_estimate_says_nothing():
    jacobian = np.random.default_rng(0).standard_normal((10, 2, 3))
    lost = np.where(np.arange(10)[:, None, None] < 6, jacobian, np.nan)
    assert np.allclose(fisher(lost, np.ones((10, 2))), fisher(jacobian[:6], np.ones((6, 2))))


def edge(points, steps):
    """Residuals (N, steps, 1) of two parameters, NaN where the first one is above 0.5003."""
    time = np.arange(1, steps + 1)[None, :, None]
    rows = np.where(points[:, 0] > 0.5003, np.nan, points[:, 0] - 0.49)[:, None, None] * time
    return rows + (points[:, 1] - 0.3)[:, None, None] * time**2


def test_beside_what_diverges_slopes_are_one_sided():
    slopes = rf_dropo.jacobian_at(edge, np.array([0.5, 0.4]), 3)
    np.testing.assert_allclose(slopes, np.stack([[1, 2, 3], [1, 4, 9]], axis=1)[:, None], rtol=1e-6)


def test_a_fit_goes_on_from_beside_what_diverges():
    deviation = np.full((20, 1), 1e-3)
    found = rf_dropo.refined(edge, deviation, np.array([0.5, 0.4]), EvaluationLog(None, ""))
    np.testing.assert_allclose(found.mean, [0.49, 0.3], atol=1e-3)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_a_recording_that_is_not_explained_is_refined_however_slow_the_sensor_is(every, monkeypatch):
    """Three standard deviations are left, whatever the parameter."""
    deviation, rounds = np.full((80, 1), MISSING), []
    deviation[every - 1 :: every] = 1.0
    left = np.where(deviation < MISSING, 3.0, 0.0)

    def refined(residuals, deviation, groups, point, cost, log, seed):
        rounds.append(seed)
        return point, cost

    monkeypatch.setattr("soro_bench.inference.continuation.refine", refined)
    best_track(lambda points, steps: np.tile(left[:steps], (len(points), 1, 1)), deviation, [slice(0, 1)], 1,
               EvaluationLog(None, ""), 0, 2)  # fmt: skip
    assert len(rounds) == ATTEMPTS


def test_what_may_be_zero_is_determined_in_widths_of_its_box():
    """0.1 mm of a wall somewhere in a box of centimetres are little, wherever the wall is."""
    (found,) = combinations(np.ones((1, 1, 1)), np.full((1, 1), 1e-4), (WALL_OFFSET,), np.array([1e-6]))
    low, high = WALL_OFFSET.search
    assert found.relative_std == pytest.approx(1e-4 / (high - low))
    assert "is determined to" in found.words


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize("rank", [0, 3])
def test_products_are_those_of_the_dense_inverse(rng, rank):
    basis, a, b = rng.normal(size=(rank, 20)), rng.normal(size=(2, 20)), rng.normal(size=(4, 20))
    dense = np.linalg.inv(np.eye(20) + basis.T @ basis)
    assert LowRank(basis).product(a, b) == pytest.approx(a @ dense @ b.T)
    assert LowRank(basis).without(a[0]) == pytest.approx(dense @ a[0])


def test_a_linear_function_is_found_exactly_and_leaves_no_error(rng):
    jacobian, at, x = rng.normal(size=(3, 50)), rng.normal(size=50), rng.normal(size=3)
    points = sample_around(x, 0.1, 12, [0, 1])
    line = linearised(x, points, at + (points - x) @ jacobian)
    assert line.residual == pytest.approx(at)
    assert line.jacobian == pytest.approx(jacobian)
    assert np.abs(line.error).max() < 1e-12


def test_a_rugged_function_has_an_error_of_its_ruggedness(rng):
    points = sample_around(np.zeros(2), 0.1, 64, [0])
    rough = 0.3 * rng.standard_normal((64, 200))
    line = linearised(np.zeros(2), points, points @ rng.normal(size=(2, 200)) + rough)
    assert np.sqrt((line.error**2).sum(axis=0).mean()) == pytest.approx(0.3, rel=0.05)


def test_polishing_leaves_a_local_optimum_of_a_rugged_replay():
    truth, deviation = np.array([0.4, 0.6]), np.full((30, 4), 1e-3)
    basis = np.random.default_rng(1).normal(size=(2, 30, 4))

    def residuals(points, steps):
        offset = points - truth
        ripples = 0.003 * np.sin(400 * offset).sum(axis=1)[:, None, None]
        return (np.tensordot(offset, basis, axes=1) + ripples)[:, :steps]

    start = truth + 0.03
    cost = np.log1p((residuals(start[None], 30)[0] / deviation) ** 2).sum()
    found, lower = refine(residuals, deviation, [slice(0, 4)], start, cost, EvaluationLog(None, ""), [0])
    assert np.abs(found - truth).max() < 0.002
    assert lower < cost


def test_a_basis_explains_no_more_than_it_is_likely_to(rng):
    """Of what it would have to be ten times as large for, three times its size."""
    basis = rng.standard_normal((1, 1000))
    assert LowRank(basis).without(10.0 * basis[0]) == pytest.approx(7.0 * basis[0], rel=1e-3)


def test_more_rows_of_a_basis_never_explain_less(rng):
    """Rows that are almost equal differ by large coefficients, by which all others were scaled once."""
    row, other = 10.0 * rng.standard_normal((2, 50))
    few = row[None]
    more = np.stack([row, row + 0.1 * other])
    residual = 4.0 * row + other
    left = [np.linalg.norm(LowRank(basis).without(residual)) for basis in (few, more)]
    assert left[1] <= left[0]
