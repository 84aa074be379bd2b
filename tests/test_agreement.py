"""Several recordings of one robot: what each of them says alone, and when that is called a change."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.estimation.agreement import difference, fitted_alone
from soro_bench.diagnosis.estimation.fit import Guess, fitted
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Agreement, Estimate
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import TRUTH, problem, recording
from tests.results import RESULTS

SCALES = (0.3, 0.1, 0.05)


def _together(one, other):
    """A problem of the recordings of two."""
    size = one.weight.size + other.weight.size
    recordings = (*one.recordings, *other.recordings)
    return replace(one, recordings=recordings, weight=np.ones(size), discretisation=LowRank(np.zeros((0, size))))


def test_each_recording_alone_is_fitted_as_if_it_were_the_only_one(paths):
    parts = [problem(paths, seed=seed) for seed in (0, 1)]
    both = _together(*parts)
    (joint,) = fitted(both, [Guess(np.zeros(3))], SCALES, seed=0)
    found = fitted_alone(both, joint, seed=0)
    for part, alone in zip(parts, found, strict=True):
        (only,) = fitted(part, [Guess(np.zeros(3))], SCALES, seed=0)
        deviation = np.sqrt(np.diag(only.covariance(part)))
        assert (np.abs(alone.hypothesis.x - only.x) < 0.5 * deviation).all()
        np.testing.assert_allclose(np.sqrt(np.diag(alone.hypothesis.covariance(alone.problem))), deviation, rtol=0.3)


def test_a_fit_of_one_recording_is_never_worse_than_the_joint_fit(paths):
    both = _together(problem(paths, seed=0), problem(paths, seed=1))
    (joint,) = fitted(both, [Guess(np.zeros(3))], SCALES, seed=0)
    for alone in fitted_alone(both, joint, seed=0):
        (row,) = alone.problem.residuals([(joint.x, ())])
        assert alone.hypothesis.cost <= alone.problem.cost(row, joint.x)


@pytest.mark.parametrize(
    ("values", "spreads", "compared", "p_value", "overlap"),
    [
        ((0.0, 1.0), (1.0, 1.0), 1, 0.4795, True),  # 0.71 standard deviations
        ((0.0, 4.0), (1.0, 1.0), 1, 0.004678, False),
        ((0.0, 4.0), (1.0, 1.0), 5, 5 * 0.004678, False),
        ((0.0, 0.0, 4.0), (1.0, 1.0, 1.0), 5, 15 * 0.004678, False),  # may be chance: three pairs of five unknowns
        ((0.0, 4.0), (3.0, 0.1), 1, 0.1827, True),
    ],
)
def test_chance_counts_every_pair_and_every_unknown(values, spreads, compared, p_value, overlap):
    found = difference(values, spreads, compared)
    assert (found.p_value, found.overlap) == (pytest.approx(p_value, rel=1e-3), overlap)


def test_healthy_values_are_called_a_change_no_oftener_than_allowed():
    rng, runs = np.random.default_rng(0), 4000
    alarms = 0
    for _ in range(runs):
        found = [difference(row.tolist(), [1.0] * 3, 4) for row in rng.standard_normal((4, 3))]
        alarms += any(each.p_value < 0.05 for each in found)
    assert alarms / runs < 0.05 + 3 * np.sqrt(0.05 * 0.95 / runs)


def test_a_change_is_on_the_console_in_the_report_and_in_the_file():
    result = next(found for each in RESULTS.values() if (found := each()).verdict == "adequate")
    estimates = (
        Estimate("young_modulus", 2.8e6, "Pa", 2.2e6, 3.6e6),
        Estimate("young_modulus", 5e6, "Pa", 4.1e6, 6.1e6),
    )
    changed = Agreement("young_modulus", "", None, estimates, 2e-4, False, True)
    same = Agreement("trunk_mass", "", None, (Estimate("trunk_mass", 0.4, "kg", 0.3, 0.5),) * 2, 1.0, True, False)
    result = replace(result, verdict="recordings_disagree", agreement=(changed, same))
    assert Result.from_json(result.to_json()).agreement == result.agreement
    for text in (summary(result).replace("\n" + " " * 15, " "), html(result)):
        assert "Not adequate: parameters change from recording to recording" in text
        assert "the structure of the model is wrong" in text
        assert "2.8 [2.2, 3.6]\u00a0MPa, 5 [4.1, 6.1]\u00a0MPa" in text.replace(" MPa", "\u00a0MPa")
    assert "trunk mass" in html(result) and "trunk mass" not in summary(result)


def test_an_arm_that_became_heavier_between_two_recordings_is_told(paths):
    """Without laws and locations, for which the test would take a minute."""
    quick = replace(
        DEFAULT,
        selection=replace(DEFAULT.selection, most_terms=0),
        report=replace(DEFAULT.report, least_unknown=1.0),
    )
    heavier = recording(paths, [], 1, truth=TRUTH * [[1.1, 1.0, 1.0]])
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, [], 0), heavier], settings=quick)
    assert [each.name for each in result.agreement if each.changes] == ["inertia"]
    first, second = next(each for each in result.agreement if each.name == "inertia").estimates
    assert first.low < TRUTH[0, 0] < first.high < second.low < 1.1 * TRUTH[0, 0] < second.high
    assert "the structure of the model is wrong" in summary(result).replace("\n" + " " * 15, " ")
