"""Statistics of the leaderboard, against known answers."""

import numpy as np
import pytest

from soro_bench.leaderboard.statistics import interquartile_mean, interval, probability_of_improvement


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end():
    assert interquartile_mean(np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 100.0]])) == 4.5
    assert interquartile_mean(np.array([[1.0, 2.0, 9.0]])) == 4.0  # less than four values: their mean


@pytest.mark.parametrize(
    ("values", "reference", "higher", "expected"),
    [
        ([[1.0], [2.0]], [[3.0], [4.0]], False, 1.0),
        ([[1.0], [2.0]], [[3.0], [4.0]], True, 0.0),
        ([[1.0], [2.0]], [[1.0], [2.0]], False, 0.5),
        ([[1.0], [3.0], [3.0]], [[2.0]], True, 2 / 3),
        ([[1.0, 9.0]], [[2.0, 2.0]], False, 0.5),  # better at one start, worse at the other
    ],
)
def test_probability_of_improvement_counts_pairs_and_half_the_ties(values, reference, higher, expected):
    assert probability_of_improvement(np.array(values), np.array(reference), higher) == pytest.approx(expected)


def test_an_interval_is_that_of_the_mean_of_independent_seeds():
    """And not narrower where seeds differ at all their starts together."""
    values = np.random.default_rng(1).normal(size=(400, 1))
    low, high = interval(np.mean, (values,), np.random.default_rng(0))
    assert low == pytest.approx(values.mean() - 1.96 * values.std() / 20, abs=0.02)
    assert high == pytest.approx(values.mean() + 1.96 * values.std() / 20, abs=0.02)
    assert interval(np.mean, (np.repeat(values, 27, axis=1),), np.random.default_rng(0)) == pytest.approx((low, high))


def test_one_seed_has_no_interval():
    rng = np.random.default_rng(0)
    assert interval(np.mean, (np.ones((1, 5)),), rng) is None
    assert interval(lambda a, b: 0.0, (np.ones((3, 5)), np.ones((1, 5))), rng) is None
