"""Forward selection and its moves, on recordings of an arm and of the cheap trunk."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import term, terms
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.gauss_newton import descended
from soro_bench.diagnosis.selection.forward_selection import explained
from soro_bench.diagnosis.selection.moves import (
    distinct,
    indistinguishable,
    laws,
    refitted,
    revisit_rivals,
    swap_delays,
    unique,
    without_one,
)
from soro_bench.diagnosis.selection.screening import ScreenedCandidate, evidence, responses
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import EVERY, Effect, Location
from tests import arm
from tests.arm import TRUNK_TRUTH, trunk_problem

HINGE = Location("joint", "hinge")
FRICTION = Effect("coulomb_friction", HINGE, {"friction": 0.05, "presliding": 5e-4})
DELAY = Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.06})


def with_selection(**values):
    """Settings of a diagnosis, but for some of forward selection."""
    return replace(DEFAULT, selection=replace(DEFAULT.selection, **values))


def candidate_terms(given, *effects):
    """The terms of the arm that have these names."""
    everything = {one.name: one for one in reversed(terms(given.robot))}
    return tuple(everything[name] for name in effects)


def fit(given, *names):
    """A hypothesis with these terms, fitted from typical magnitudes."""
    chosen = candidate_terms(given, *names)
    x = np.concatenate([np.zeros(given.parameters), *(one.simulated for one in chosen)])
    return fitted(given, [Guess(x, chosen)], (0.5, 0.1), seed=0)[0]


def test_a_descent_finds_the_parameters_of_the_arm(paths):
    given = arm.problem(paths)
    x = np.zeros(3)
    (residual,) = given.residuals([(x, ())])
    begun = Hypothesis((), x, residual, given.cost(residual, x), np.zeros((3, residual.size)), np.zeros((0, 1)))
    (found,) = descended(given, [begun])
    values = given.robot.parameters(found.x)
    assert list(values.values()) == pytest.approx(arm.TRUTH[0], rel=0.05)
    assert found.cost < 0.1 * begun.cost


def test_without_the_term_that_acts_the_misfit_grows_and_without_an_idle_one_it_does_not(paths):
    given = arm.problem(paths, [FRICTION])
    both = fit(given, "coulomb_friction", "actuator_delay")
    costs = {h.terms[0].name: h.cost for h in without_one(given, both, both, 0)}
    assert costs["actuator_delay"] > both.cost + 100.0
    assert costs["coulomb_friction"] < both.cost + 10.0


def test_a_delay_of_commands_is_swapped_for_as_long_a_delay_of_measurements(paths):
    given = arm.problem(paths, [DELAY])
    commanded = fit(given, "actuator_delay")
    (other,) = swap_delays(given, [commanded], terms(given.robot), set(), 0)
    assert [one.name for one in other.terms] == ["sensor_delay"]
    first, second = (h.effects(3)[0].parameters["delay"] for h in (commanded, other))
    assert first == pytest.approx(0.06, abs=0.01)
    assert second == pytest.approx(first, abs=0.02)
    assert swap_delays(given, [commanded], terms(given.robot), {laws(other)}, 0) == []


def test_a_law_that_contains_another_one_never_explains_less(paths):
    """Stribeck friction contains dry friction; begun far off it would end in a local minimum."""
    given = arm.problem(paths, [FRICTION])
    nominal = fit(given)
    candidates = candidate_terms(given, "coulomb_friction", "stribeck_friction")
    screened = evidence(given, nominal, candidates, responses(given, nominal, candidates, given.robot))
    guesses = [screened.guess(screened.screened_candidate([i])) for i in range(2)]
    guesses[1] = replace(guesses[1], x=guesses[1].x + np.array([0, 0, 0, 0, 1.0, -1.0, 1.0])[: len(guesses[1].x)])
    found = {h.terms[-1].name: h for h in refitted(given, guesses, screened, 0)}
    dry, stribeck = (given.misfit(found[name].residual) for name in ("coulomb_friction", "stribeck_friction"))
    assert stribeck < dry + 20.0
    assert dry < 0.1 * given.misfit(nominal.residual)


def test_a_close_rival_of_an_earlier_round_goes_on_with_the_terms_of_later_rounds(paths):
    given = arm.problem(paths, [FRICTION, DELAY])
    best, taken, rival = (
        fit(given, *names)
        for names in (("coulomb_friction", "actuator_delay"), ("coulomb_friction",), ("viscous_friction",))
    )
    given = replace(given, settings=with_selection(rival_misfit=1e3))  # so that it is close
    continued = revisit_rivals(given, best, [taken, rival], 0)
    assert {tuple(one.name for one in h.terms) for h in continued} == {("viscous_friction", "actuator_delay")}
    assert min(h.cost for h in continued) < rival.cost
    apart = replace(given, settings=with_selection(rival_misfit=1e-3))  # so that none is close
    assert revisit_rivals(apart, best, [taken, rival], 0) == []


@pytest.mark.parametrize("began", ["vertebra4", "vertebra8"])
def test_a_law_begun_at_a_neighbour_ends_at_its_location(robot, actions, began):
    hidden = Effect("payload", Location("body", "vertebra6"), {"mass": 0.04})
    given = trunk_problem(robot, actions, [hidden])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in range(3, 10)]
    screened = evidence(given, base, candidates, responses(given, base, candidates, robot))
    candidate = screened.screened_candidate([[one.location.name for one in candidates].index(began)])
    (payload,) = refitted(given, [screened.guess(candidate)], screened, 1)[0].effects(given.parameters)
    assert payload.location == hidden.location
    assert payload.parameters["mass"] == pytest.approx(0.04, rel=0.1)


def test_coordinates_of_a_term_lead_to_its_effect_and_back(robot):
    for one in terms(robot):
        x = 0.3 * one.simulated + 0.1
        assert one.coordinates(one.effect(x).parameters) == pytest.approx(x), one.name


@pytest.mark.parametrize(("name", "sides"), [("vertebra0", ["vertebra1"]), ("vertebra4", ["vertebra3", "vertebra5"])])
def test_beside_a_segment_are_the_ones_before_and_after(robot, name, sides):
    assert [location.name for location in robot.beside(Location("body", name))] == sides


def test_cables_have_no_order(robot):
    assert robot.beside(Location("tendon", "L2")) == []


def screened_candidates(robot, *given):
    """Candidates at cables, with predicted gains from large to small."""
    found = []
    for i, (name, cable) in enumerate(given):
        one = term(robot, name, Location("tendon", cable))
        found.append(ScreenedCandidate((one,), 1000.0 - i, np.full(one.size, 0.2), (i,)))
    return found


def test_laws_of_one_class_at_one_location_are_indistinguishable(robot):
    dry, stribeck, elsewhere = screened_candidates(
        robot, ("coulomb_friction", "L0"), ("stribeck_friction", "L0"), ("coulomb_friction", "L1")
    )
    assert indistinguishable(robot, dry, stribeck)
    assert not indistinguishable(robot, dry, elsewhere)


def test_delays_of_all_commands_and_of_all_measurements_are_indistinguishable(robot):
    commanded, one = (term(robot, "actuator_delay", Location("actuator", name)) for name in (EVERY, "L0"))
    measured = term(robot, "sensor_delay", Location("sensor", robot.signal))
    late, single, seen = (Guess(np.zeros(0), (each,)) for each in (commanded, one, measured))
    assert indistinguishable(robot, late, seen)
    assert not indistinguishable(robot, single, seen)


def test_of_one_law_only_a_few_locations_are_tried(robot):
    given = [("viscous_friction", f"L{k}") for k in range(4)] + [("coulomb_friction", "L0")]
    found = distinct(screened_candidates(robot, *given), robot, DEFAULT.selection)
    assert [candidate.chosen for candidate in found] == [(0,), (1,), (4,)]
    few = replace(DEFAULT.selection, candidates=1)
    assert len(distinct(screened_candidates(robot, *given), robot, few)) == 1


def test_of_hypotheses_with_the_same_laws_the_first_one_stays(robot):
    first, other, again = (
        Hypothesis((term(robot, "coulomb_friction", Location("tendon", cable)),), np.zeros(2), None, cost, None, None)
        for cable, cost in (("L0", 5.0), ("L1", 4.0), ("L0", 3.0))
    )
    assert unique([first, other, again]) == [first, other]


@pytest.fixture
def local_minimum(robot, actions):
    """A problem, and a fit of the parameters that has ended far from where they are: its Jacobian leads nowhere."""
    given = trunk_problem(robot, actions)
    x = np.where(np.arange(5) == 0, TRUNK_TRUTH - 1.0, TRUNK_TRUTH)  # too light, as if something were carried
    (residual,) = given.residuals([(x, ())])
    none = np.zeros((5, residual.size))
    return given, Hypothesis((), x, residual, given.cost(residual, x), none, none[:0])


def test_a_term_that_only_leads_to_better_parameters_is_dropped(robot, local_minimum):
    given, stuck = local_minimum
    given = replace(given, settings=with_selection(discrepant_misfit=0.0, discrepant_misfit_per_sample=0.0))
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in (6, 8)]
    explanation = explained(given, stuck, robot, [], candidates, 0)
    assert explanation.found == ()
    healthy = DEFAULT.selection.healthy_misfit
    assert given.misfit(explanation.nominal.residual) < healthy < given.misfit(stuck.residual)


def test_the_search_starts_again_as_often_as_the_settings_say(robot, local_minimum):
    given, stuck = local_minimum
    values = {"discrepant_misfit": 0.0, "discrepant_misfit_per_sample": 0.0}
    given = replace(given, settings=with_selection(**values, restarts=0, least_gain_of_misfit=0.5))
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in (6, 8)]
    explanation = explained(given, stuck, robot, [], candidates, 0)
    assert len(explanation.rounds) == 1
    assert explanation.found


def test_settings_of_the_problem_decide_which_terms_are_tried(paths):
    given = arm.problem(paths, [FRICTION], settings=with_selection(least_gain=1e9))
    candidates = candidate_terms(given, "coulomb_friction", "viscous_friction")
    none = explained(given, fit(given), given.robot, [], candidates, 0)
    assert none.found == () and none.remaining_gain > DEFAULT.selection.least_gain
    one = explained(replace(given, settings=DEFAULT), fit(given), given.robot, [], candidates, 0)
    assert [t.name for t in one.found[0].terms] == ["coulomb_friction"]
    assert one.remaining_gain < none.remaining_gain
