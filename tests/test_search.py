"""Searches for parameters, their likelihoods and logs, and what a recording determines."""

import json

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from soro_bench.inference import rf_dropo
from soro_bench.inference.identifiability import combinations
from soro_bench.inference.likelihood import horizon, log_likelihood, sample_factor
from soro_bench.inference.methods import uncertainty
from soro_bench.inference.search import EvaluationLog, cma_search
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


def test_a_log_whose_writer_was_killed_at_once_begins_anew(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"")
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


def test_what_may_be_zero_is_determined_in_widths_of_its_box():
    """0.1 mm of a wall somewhere in a box of centimetres are little, wherever the wall is."""
    (found,) = combinations(np.ones((1, 1, 1)), np.full((1, 1), 1e-4), (WALL_OFFSET,), np.array([1e-6]))
    low, high = WALL_OFFSET.search
    assert found.relative_std == pytest.approx(1e-4 / (high - low))
    assert "is determined to" in found.words
