"""What the diagnosis is compared with."""

import numpy as np
import pytest

from soro_bench.blind_benchmark.ablations import Calibrated, Unrefined
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot

ENV_ID = "TrunkReach-v0"


class Still:
    """A robot whose simulation never moves."""

    priors = ()

    def simulate(self, actions, parameters, effects, start):
        return np.zeros((1, len(actions), 1, 1))


def measured(seed):
    """What follows from the commands: their sum, and the one of three steps before."""
    actions = np.repeat(np.random.default_rng(seed).uniform(-1, 1, (100, 2)), 4, axis=0)
    way = 0.1 * np.cumsum(actions[:, 0]) + np.roll(actions[:, 1], 3)
    return Measured(actions, 0.05 * np.arange(1, len(way) + 1), way[:, None, None], "angle", "rad")


def test_a_network_learns_what_follows_from_the_commands():
    pytest.importorskip("torch")
    from soro_bench.blind_benchmark.residual_network import residual_rms

    before, after = residual_rms(Still(), np.zeros(0), measured(0), measured(1))
    assert before == pytest.approx(float(np.sqrt((measured(1).values ** 2).mean())))
    assert after < 0.6 * before
    assert residual_rms(Still(), np.zeros(0), measured(0), measured(1)) == (before, after)


def test_a_calibrated_robot_stays_where_it_was_fitted():
    x = np.array([0.5, -0.4, 0.2, 0.3, 0.1])
    free, fixed = SuiteRobot(ENV_ID, threads=1), Calibrated(ENV_ID, x, threads=1)
    assert list(fixed.parameters(np.full(5, 4.0)).values()) == pytest.approx(
        list(free.parameters(x).values()), rel=1e-5
    )
    assert all(finer.priors == fixed.priors for finer in fixed.refined())


def test_a_robot_without_more_accurate_models_has_no_numerical_floor():
    assert Unrefined(ENV_ID, threads=1).refined() == []
