"""Searches for parameters, and their logs."""

import json

import numpy as np
import pytest

from soro_bench.inference.search import EvaluationLog, cma_search


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
