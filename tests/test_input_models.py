"""How an unknown input changes in time."""

import numpy as np
import pytest

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.input_models import Free, Linear
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import SIGMA

STEPS = (120, 90)
MEMORY = 45  # control steps of 0.02 s, after which the arm has forgotten a pulse


@pytest.fixture
def problem(paths):
    """Two recordings of an arm."""
    robot, rng = ModelRobot(*paths, threads=1), np.random.default_rng(0)
    recordings = tuple(
        Measured(np.zeros((n, 1)), 0.02 * np.arange(1, n + 1), rng.standard_normal((n, 1, 1)), "angle", "rad")
        for n in STEPS
    )
    size = sum(STEPS)
    return Problem(robot, recordings, SIGMA, np.ones(size), LowRank(np.zeros((0, size))))


def test_a_free_input_is_straight_between_its_nodes(problem):
    model = Free(problem, 1)
    factors = model.factors(2.0 * model.nodes.time[:, None])
    for part, steps in zip(factors, STEPS, strict=True):
        np.testing.assert_allclose(part[:, 0], 2.0 * 0.02 * np.arange(steps))


def test_values_at_the_nodes_are_those_that_made_the_factors(problem):
    model = Free(problem, 2)
    values = np.random.default_rng(1).standard_normal((model.size, 2))
    back = model.nodes.values(model.factors(values))
    inside = np.concatenate([
        model.nodes.every * np.arange(n) < steps for n, steps in zip(model.nodes.counts, STEPS, strict=True)
    ])
    np.testing.assert_allclose(back[inside], values[inside])


def test_pulses_at_all_nodes_are_a_constant_input_and_so_are_their_responses(problem):
    """Every sample belongs to one node in each replay, so that the parts of all nodes add up to all replays."""
    model = Free(problem, 2)
    pulses = model.pulses()
    np.testing.assert_allclose(sum(np.concatenate(pulse) for pulse in pulses), 1.0)
    rows = np.random.default_rng(1).standard_normal((2, len(pulses), sum(STEPS)))
    parts = model.parts(rows).toarray().reshape(model.size, 2, -1).sum(axis=0)
    assert (np.abs(parts).sum(axis=0) > 0).all()
    late = np.concatenate([np.arange(steps) >= MEMORY for steps in STEPS])
    np.testing.assert_allclose(parts[:, late], rows.sum(axis=1)[:, late])


def test_nodes_of_long_recordings_are_farther_apart(problem):
    """However many components an input has, its values are few."""
    few, many = Free(problem, 3), Free(problem, 60)
    assert few.nodes.every < many.nodes.every
    most = problem.settings.localisation.most_values + 2 * 60 * len(STEPS)  # and two nodes at the ends
    assert many.size * 60 <= most


def test_shares_say_in_what_an_input_is_linear(problem):
    rng = np.random.default_rng(2)
    setpoints = [rng.standard_normal((steps, 2)) for steps in STEPS]
    model = Linear(problem, setpoints, ["A", "B"])
    values = np.zeros((model.size, 3))
    values[model.names.index("setpoint of B"), 0] = 3.0
    values[0, 1] = 1.0
    expected = {"setpoint of B": 0.9, "constant": 0.1, "setpoint of A": 0, "shape": 0}
    assert model.shares(values) == pytest.approx(expected)
    b = np.concatenate(setpoints)[:, 1]
    b = b - b.mean()
    np.testing.assert_allclose(np.concatenate(model.factors(values))[:, 0], 3.0 * b / np.sqrt((b**2).mean()))
