"""Forms of forces that have no law."""

from types import SimpleNamespace

import numpy as np
import pytest

from soro_bench.diagnosis.localisation.input_models import Free, Linear

TIMESTEP, STEPS = 0.05, (60, 41)


@pytest.fixture
def problem():
    """Two recordings of one point in the plane."""
    rng = np.random.default_rng(0)
    recordings = [SimpleNamespace(values=rng.standard_normal((steps, 1, 2))) for steps in STEPS]
    return SimpleNamespace(robot=SimpleNamespace(control_timestep=TIMESTEP, shape=(1, 2)), recordings=recordings)


def test_a_free_force_is_straight_between_its_nodes(problem):
    input_model = Free(problem, 1)
    found = input_model.factors(2.0 * input_model.nodes.time[:, None])
    for part, steps in zip(found, STEPS, strict=True):
        np.testing.assert_allclose(part[:, 0], 2.0 * TIMESTEP * np.arange(steps))


def test_pulses_at_all_nodes_are_a_constant_force_and_so_are_their_parts(problem):
    """Every sample is of one node in each replay, so that parts of all nodes add up to all replays."""
    input_model = Free(problem, 2)
    pulses = input_model.pulses()
    np.testing.assert_allclose(sum(np.concatenate(pulse) for pulse in pulses), 1.0)
    rows = np.random.default_rng(1).standard_normal((2, len(pulses), 2 * sum(STEPS)))
    parts = input_model.parts(rows).toarray().reshape(input_model.size, 2, -1).sum(axis=0)
    seen = np.abs(parts).sum(axis=0) > 0
    late = np.concatenate([np.arange(steps) >= 18 for steps in STEPS]).repeat(2)  # a memory after the beginning
    assert seen.all()
    np.testing.assert_allclose(parts[:, late], rows.sum(axis=1)[:, late])


def test_shares_say_in_what_a_force_is_linear(problem):
    rng = np.random.default_rng(2)
    told = [rng.standard_normal((steps, 2)) for steps in STEPS]
    input_model = Linear(problem, told, ["A", "B"])
    values = np.zeros((input_model.size, 3))
    values[input_model.names.index("setpoint of B"), 0] = 3.0
    values[0, 1] = 1.0
    assert input_model.shares(values) == pytest.approx({
        "setpoint of B": 0.9,
        "constant": 0.1,
        "setpoint of A": 0,
        "shape": 0,
    })
    b = np.concatenate(told)[:, 1]
    b = b - b.mean()
    np.testing.assert_allclose(np.concatenate(input_model.factors(values))[:, 0], 3.0 * b / np.sqrt((b**2).mean()))
