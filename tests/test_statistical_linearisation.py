"""Linear models over samples: the answers of linear algebra, and of simulations that are known."""

import numpy as np
import pytest

from soro_bench.inference.continuation import refine
from soro_bench.inference.search import EvaluationLog
from soro_bench.inference.statistical_linearisation import LowRank, linearised, sample_around


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
