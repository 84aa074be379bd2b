"""What the answers of a diagnosis are worth, and the verdict."""

from types import SimpleNamespace

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.pipeline import Diagnosis, Outliers
from soro_bench.diagnosis.selection import model_probabilities as compare
from soro_bench.diagnosis.selection.forward_selection import Explanation
from soro_bench.effects.effect import Location
from tests.trunk import SIGMA, problem


def test_a_lead_like_those_of_nulls_is_no_detection():
    assert compare.p_value(100.0) > 0.1
    assert compare.p_value(1000.0) < 1e-3


@pytest.mark.parametrize(
    ("answers", "unknown", "verdict"),
    [
        ([(0.8, "none"), (0.1, "payload")], 0.1, "adequate"),
        ([(0.3, "payload"), (0.2, "none")], 0.5, "outside_catalogue"),
        ([(0.35, "payload"), (0.2, "none")], 0.45, "outside_catalogue"),
        ([(0.3, "payload"), (0.3, "payload"), (0.0, "none")], 0.4, "discrepancy"),
        ([(0.6, "sensor_delay"), (0.1, "none")], 0.3, "measurement_fault"),
    ],
)
def test_the_verdict_is_what_is_likeliest(answers, unknown, verdict):
    comparison = compare.Comparison(tuple(_answer(*each) for each in answers), unknown, 0.0)
    found = Diagnosis(None, (), Outliers(0.0, 0.0), None, comparison, (), None, 0.0)
    assert found.verdict == verdict


def test_the_report_is_of_the_likeliest_effect_even_if_nothing_is_the_first_answer():
    """It is likelier than nothing in two answers together, and in neither of them."""
    answers = (_answer(0.35), _answer(0.32, "payload"), _answer(0.3, "payload", "actuator_gain"))
    found = compare.Comparison(answers, 0.03, 0.5)
    assert found.detected
    assert found.best is answers[1]
    assert compare.Comparison(answers[:2], 0.33, 0.5).best is answers[0]


def _answer(chance, *names):
    names = tuple(name for name in names if name != "none")
    ranked_locations = [
        Location("sensor", "keypoints") if name == "sensor_delay" else Location("body", "vertebra4") for name in names
    ]
    terms = tuple(Term(name, location, (0.1,), (True,)) for name, location in zip(names, ranked_locations, strict=True))
    return SimpleNamespace(probability=chance, names=names, hypothesis=SimpleNamespace(terms=terms))


def test_what_nothing_explains_is_unknown_and_what_something_explains_is_not(robot, actions):
    given = problem(robot, actions)
    residual = np.random.default_rng(0).standard_normal(given.weight.size)
    jacobian, error = np.zeros((5, residual.size)), np.zeros((0, residual.size))
    poor, good = (Hypothesis((), np.zeros(5), scale * residual, 0.0, jacobian, error) for scale in (5.0, 1.0))
    assert compare._unknown(given, [poor, poor], 0.0) > 0.95
    assert compare._unknown(given, [poor, good], 0.0) < 0.05
    assert compare._unknown(given, [poor, good], 3000.0) > 0.95  # something else is there, which no law explains
    assert compare._unknown(given, [good], 400.0) == 1.0  # where something is missing, as nothing was tried


def test_what_is_far_beyond_the_sensors_noise_and_not_explained_is_unknown_and_not_nothing(robot, actions):
    """Even if no law promises anything."""
    given = problem(robot, actions).allowing(20 * SIGMA)
    residual = np.random.default_rng(0).standard_normal(given.weight.size)
    jacobian, error = np.zeros((5, residual.size)), np.zeros((0, residual.size))
    nominal = Hypothesis((), np.zeros(5), residual, 0.0, jacobian, error)
    screened_candidate = Hypothesis((Term("actuator_gain", Location("actuator", "L0"), (0.85,), (True,)),), np.zeros(6),
                      0.99 * residual, 0.0, np.zeros((6, residual.size)), error)  # fmt: skip
    found = compare.compared(Explanation(given, nominal, (screened_candidate,), 0.0, 0.0, 0.0, ()), None)
    assert found.p_value is None
    assert found.unknown > 0.9


@pytest.mark.parametrize(
    "left, unknown",
    [
        ("white noise of twice its size", False),
        ("noise that remembers a sample", False),
        ("three outliers", False),
        ("what is as slow as the motion", True),
    ],
)
def test_what_is_left_is_unknown_if_it_is_slower_than_noise_even_if_no_law_promises_to_explain_it(
    robot, actions, left, unknown
):
    given = problem(robot, actions)
    (recording,) = given.recordings
    noise = np.random.default_rng(0).standard_normal(recording.values.shape)
    slow = 2.0 * np.sin(2.0 * np.pi * 0.4 * recording.time)[:, None, None]
    residual = {
        "white noise of twice its size": 2.0 * noise,
        "noise that remembers a sample": (noise + np.roll(noise, 1, axis=0)) / np.sqrt(2.0),
        "three outliers": noise + 40.0 * (np.arange(noise.size).reshape(noise.shape) < 3),
        "what is as slow as the motion": noise + slow,
    }[left].ravel()
    nominal = Hypothesis((), np.zeros(5), residual, 0.0, np.zeros((5, noise.size)), np.zeros((0, noise.size)))
    found = compare.compared(Explanation(given, nominal, (), 0.0, 50.0, 50.0, ()), None)
    assert found.detected == unknown
    assert (found.unknown > 0.9) == unknown


@pytest.mark.parametrize("share, first", [(0.009, "coulomb_friction"), (0.04, "stribeck_friction")])
def test_a_law_with_more_unknowns_has_to_explain_more_than_what_no_law_has_quite_right(robot, actions, share, first):
    """Stribeck friction contains Coulomb friction, so it never explains less."""
    given = problem(robot, actions)
    noise = np.random.default_rng(0).standard_normal(given.weight.size)
    all_of_it = 100_000.0

    def leaving(misfit, *terms):
        residual = noise * np.sqrt((noise.size + 2.0 * misfit) / (noise @ noise))
        size = given.parameters + sum(s.size for s in terms)
        none = np.zeros((size, noise.size))
        return Hypothesis(terms, np.zeros(size), residual, misfit, none, none[:0])

    location = Location("tendon", "L0")
    coulomb = Term("coulomb_friction", location, (1.0, 1e-3), (True, False))
    stribeck = Term("stribeck_friction", location, (1.0, 1.5, 0.01, 1e-3), (True, False, False, False))
    found = (leaving(0.0, stribeck), leaving(share * all_of_it, coulomb))
    compared = compare.compared(Explanation(given, leaving(all_of_it), found, 0.0, all_of_it, 0.0, ()), None)
    assert compared.answers[0].names == (first,)


def test_what_is_compared_has_most_evidence_whatever_round_it_is_of():
    """The right law is of the first round, and in later ones there are more hypotheses than are compared that have one
    effect more: what they gain is no more than what a law with more unknowns always gains."""

    def leaving(misfit, size):
        terms = tuple(SimpleNamespace(size=1) for _ in range(size))
        return SimpleNamespace(terms=terms, residual=misfit, log_evidence=lambda _: -misfit)

    nominal, right = leaving(200_000.0, 0), leaving(2000.0, 1)
    later = [leaving(900.0 + k, 2) for k in range(compare.COMPARED)]
    problem = SimpleNamespace(misfit=float)
    found = Explanation(problem, nominal, (*later, right), 0.0, 0.0, 0.0, ())
    assert compare.shortlist(found) == [nominal, right, *later[:-1]]


def test_the_answer_that_the_report_is_of_comes_first():
    answers = (_answer(0.34, "payload", "backlash"), _answer(0.33, "actuator_lag", "compliance"),
               _answer(0.3, "actuator_lag", "actuator_gain"))  # fmt: skip
    assert compare.Comparison(answers, 0.03, 0.0).ranked == (answers[1], answers[0], answers[2])


def test_answers_are_never_certain(robot, actions):
    """However clear it is: of those that seemed so, a few were wrong."""
    given = problem(robot, actions)
    noise = np.random.default_rng(0).standard_normal(given.weight.size)
    none = np.zeros((5, noise.size))
    for scale in (1.0, 30.0):
        nominal = Hypothesis((), np.zeros(5), scale * noise, 0.0, none, none[:0])
        found = compare.compared(Explanation(given, nominal, (), 0.0, 1e5 * (scale - 1.0), 0.0, ()), None)
        assert compare.BLUNDER <= found.unknown <= 1.0 - compare.BLUNDER
        assert found.unknown + sum(a.probability for a in found.answers) == pytest.approx(1.0)
