"""Model-form error: what a residual may be where simulators of a robot are apart."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.model_form import largest_model_form_error, spectrum
from soro_bench.diagnosis.robots.variants import trunk_chains
from soro_bench.diagnosis.selection.forward_selection import Explanation
from soro_bench.diagnosis.selection.model_probabilities import compared
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.arm import SIGMA, trunk_problem

ERROR = 3.0  # standard deviations of the noise, rms of a slow error
LAW = Term("payload", Location("body", "vertebra4"), (0.1,), (True,))


@pytest.fixture(scope="module")
def given(robot, actions):
    """A recording of the trunk."""
    return trunk_problem(robot, actions)


@pytest.fixture(scope="module")
def white(given):
    """(M,) of the sensor's noise."""
    return np.random.default_rng(0).standard_normal(given.weight.size)


@pytest.fixture(scope="module")
def slow(given):
    """(M,) an error in the directions in which the trunk moves most, of rms ``ERROR``."""
    moved = given.measured.reshape(len(given.recordings[0].values), -1)
    modes = np.linalg.svd(moved - moved.mean(axis=0), full_matrices=False)[2][:8]
    error = (np.random.default_rng(1).standard_normal((len(moved), len(modes))) @ modes).ravel()
    return ERROR * error / np.sqrt((error**2).mean())


def hypothesis(given, residual, *terms):
    size = given.parameters + sum(term.size for term in terms)
    none = np.zeros((size, residual.size))
    return Hypothesis(terms, np.zeros(size), residual, given.cost(residual, np.zeros(size)), none, none[:0])


def healthy(given, bound, *residuals):
    """The probability that nothing is missing, by residuals of the nominal robot and of a law."""
    given = replace(given, model_form=bound * SIGMA)
    nominal, law = (hypothesis(given, row, *terms) for row, terms in zip(residuals, ((), (LAW,)), strict=True))
    predicted = float(nominal.cost - law.cost)
    return compared(Explanation(given, nominal, (law,), 0.0, predicted, 0.0, ()), None).nothing


def test_noise_has_no_excess_and_an_error_has_its_own(given, white, slow):
    assert spectrum(given, white).excess < 0.25
    assert spectrum(given, white + slow).excess == pytest.approx(ERROR, rel=0.05)


def test_a_law_that_explains_a_part_of_a_possible_error_is_no_discrepancy(given, white, slow):
    left, less = white + slow, white + 0.9 * slow
    assert healthy(given, 2.0 * ERROR, left, less) > 0.9
    assert healthy(given, 0.0, left, less) < 0.1


def test_a_law_that_explains_all_of_a_possible_error_is_a_discrepancy(given, white, slow):
    assert healthy(given, 2.0 * ERROR, white + slow, white) < 0.1


def test_an_error_that_is_larger_than_possible_is_a_discrepancy(given, white, slow):
    assert healthy(given, 0.5 * ERROR, white + slow, white + 0.9 * slow) < 0.1


def test_the_bound_is_what_parameters_cannot_change(given, slow):
    share = given.settings.discretisation.model_form_share
    apart = replace(given, discretisation=LowRank(slow[None]))
    free = hypothesis(apart, np.zeros(slow.size))
    assert largest_model_form_error(apart, free) == pytest.approx(share * ERROR * SIGMA)
    slopes = np.zeros((given.parameters, slow.size))
    slopes[0] = slow
    bound = largest_model_form_error(apart, replace(free, jacobian=slopes))
    assert bound == pytest.approx(0.0, abs=1e-3 * ERROR * SIGMA)


def test_chains_of_links_move_as_the_trunk_does(robot, given):
    drives = [each.drive for each in given.recordings]
    values = given.parameter_values([np.zeros(given.parameters)])
    (plain,) = robot.simulate_all(drives, values, [()])
    for chain in trunk_chains([prior.name for prior in robot.priors], robot.control_timestep):
        (found,) = chain(drives, values)
        assert found.shape == plain.shape
        apart = np.sqrt(((found - plain) ** 2).mean())
        assert 1e-5 < apart < 0.3 * np.sqrt(((plain - plain[:, :1]) ** 2).mean())
