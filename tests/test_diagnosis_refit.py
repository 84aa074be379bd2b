"""Which laws are tried where, on short recordings of the cheap trunk."""

from types import SimpleNamespace

import numpy as np
import pytest

from soro_bench.diagnosis.candidates import effects_at, term, terms
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.gauss_newton import descended
from soro_bench.diagnosis.selection import forward_selection as explain
from soro_bench.diagnosis.selection import moves as refit
from soro_bench.diagnosis.selection.screening import ScreenedCandidate, evidence, responses
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from tests.trunk import TRUTH, problem


def test_a_descent_finds_the_frequency_and_the_decay_of_an_oscillation():
    """Of twenty swings, from where the last of them is a third of a period off."""
    time, truth = np.arange(0.0, 20.0, 0.05), np.array([0.17, -0.5])

    def swings(x):
        return 1e3 * np.exp(-0.1 * (1 + x[1]) * time) * np.sin(2 * np.pi * (1 + 0.1 * x[0]) * time)

    class Swinging:
        robot = SimpleNamespace(priors=[SimpleNamespace(reach=np.array([-3.0, 3.0]))] * 2)
        discretisation = LowRank(np.zeros((0, len(time))))

        def residuals(self, points):
            return np.array([swings(truth) - swings(x) for x, _ in points])

        def cost(self, residual, x):
            return 0.5 * float(residual @ residual + x @ x)

    problem, begun = Swinging(), np.zeros(2)
    (residual,) = problem.residuals([(begun, ())])
    one = Hypothesis((), begun, residual, problem.cost(residual, begun), np.zeros((2, len(time))), np.zeros((0, 1)))
    (found,) = descended(problem, [one])
    assert found.x == pytest.approx(truth, abs=1e-4)


class Line:
    """A problem of two parameters and one effect, whose residual is the unknowns less (1, 2, 3)."""

    parameters = 2

    def __init__(self, misfit_dominated):
        self.misfit_dominated = misfit_dominated

    def residuals(self, points):
        return np.array([x - np.array([1.0, 2.0, 3.0])[: len(x)] for x, _ in points])

    def cost(self, residual, x):
        return float(residual @ residual)


@pytest.mark.parametrize(
    ("misfit_dominated", "nominal", "begun"),
    [
        (False, [1.0, 2.0], [9.0, 9.0, 3.0]),
        (True, [1.0, 2.0], [1.0, 2.0, 3.0]),  # nearer
        (True, [20.0, 20.0], [9.0, 9.0, 3.0]),
    ],
)
def test_what_is_left_without_an_effect_is_led_down_from_what_is_nearest(misfit_dominated, nominal, begun, monkeypatch):
    led = []
    monkeypatch.setattr(refit, "fitted", lambda problem, guesses, *_: guesses)
    monkeypatch.setattr(refit, "descended", lambda problem, some: led.extend(some) or some)
    terms, x = (SimpleNamespace(size=1), SimpleNamespace(size=1)), np.array([9.0, 9.0, 5.0, 3.0])
    both = SimpleNamespace(terms=terms, x=x, jacobian=np.zeros((4, 3)))
    first, _ = refit.without_one(Line(misfit_dominated), both, SimpleNamespace(x=np.array(nominal)), 0)
    assert first.x.tolist() == begun
    assert len(led) == 2 * misfit_dominated


@pytest.mark.parametrize("misfit_dominated", [False, True])
def test_a_delay_is_exchanged_for_its_twin_and_led_down_where_fits_are_misfit_dominated(
    robot, misfit_dominated, monkeypatch
):
    """As late, and from the same parameters."""
    led = []
    monkeypatch.setattr(refit, "fitted", lambda problem, guesses, *_: guesses)
    monkeypatch.setattr(refit, "descended", lambda problem, some: led.extend(some) or some)
    commanded = term(robot, "actuator_delay", Location("actuator", "*"))
    measured = term(robot, "sensor_delay", Location("sensor", robot.signal))
    late = np.array([0.1, 0.2, 0.3])
    one = SimpleNamespace(terms=(commanded,), x=late, jacobian=np.ones((3, 4)))
    given = SimpleNamespace(robot=robot, parameters=2, misfit_dominated=misfit_dominated)
    (other,) = refit.swap_delays(given, [one], [commanded, measured], set(), 0)
    assert other.terms == (measured,)
    assert other.x[:2].tolist() == [0.1, 0.2]
    delays = [s.effect(x[2:]).parameters["delay"] for s, x in ((commanded, late), (measured, other.x))]
    assert delays[0] == pytest.approx(delays[1])
    assert led == ([other] if misfit_dominated else [])


def test_laws_of_the_class_and_place_of_the_best_lead_are_tried_whatever_they_promise(robot):
    predicted_gain = [("stribeck_friction", "L0", 1000.0), ("viscous_friction", "L1", 500.0),
                ("viscous_friction", "L0", 200.0), ("coulomb_friction", "L0", 20.0),
                ("coulomb_friction", "L1", 10.0)]  # fmt: skip
    offered = []
    for name, cable, gain in predicted_gain:
        one = term(robot, name, Location("tendon", cable))
        offered.append(ScreenedCandidate((one,), gain, np.full(one.size, 0.2), (len(offered),)))
    screened = SimpleNamespace(guess=lambda screened_candidate: screened_candidate)
    tried = explain._screened_candidates(SimpleNamespace(robot=robot), screened, offered)
    assert [screened_candidate.chosen for screened_candidate in tried] == [(0,), (1,), (3,)]


def test_coordinates_of_a_suspect_lead_to_its_effect_and_back(robot):
    for one in terms(robot):
        x = 0.3 * one.simulated + 0.1
        assert one.coordinates(one.effect(x).parameters) == pytest.approx(x), one.name


@pytest.mark.parametrize(("better", "worse"), [("coulomb", "stribeck"), ("stribeck", "coulomb")])
def test_the_worse_of_two_laws_of_which_one_contains_the_other_is_begun_where_the_better_ended(
    robot, better, worse, monkeypatch
):
    """But not at another place."""

    def ended(name, cable, cost):
        one = term(robot, f"{name}_friction", Location("tendon", cable))
        x = np.full(2 + one.size, 0.2)
        return SimpleNamespace(terms=(one,), x=x, cost=cost, effects=lambda d: effects_at(x[d:], (one,)))

    begun = []
    monkeypatch.setattr(refit, "fitted", lambda problem, guesses, *_: begun.extend(guesses) or guesses)
    monkeypatch.setattr(Guess, "cost", 2.0, raising=False)
    given = SimpleNamespace(parameters=2, residuals=lambda points: [x for x, _ in points], cost=lambda row, x: x @ x)
    best, lagging, elsewhere = (ended(*each) for each in ((better, "L0", 1.0), (worse, "L0", 3.0), (worse, "L1", 4.0)))
    assert refit._warm_start_nested(given, [best, lagging, elsewhere], 0) == [best, *begun, elsewhere]
    (guess,) = begun
    (law,), (known,) = (effects_at(each.x[2:], each.terms) for each in (guess, best))
    assert law.name == f"{worse}_friction"
    shared = law.parameters.keys() & known.parameters
    assert {name: law.parameters[name] for name in shared} == pytest.approx({n: known.parameters[n] for n in shared})


def test_close_rivals_of_an_earlier_round_go_on_with_what_the_best_has_got_since(robot, monkeypatch):
    """But not what was far behind then, nor what was at another place."""

    def ended(left, at, *laws):
        found = tuple(term(robot, name, location) for name, location in laws)
        x = np.full(2 + sum(one.size for one in found), at)
        return Hypothesis(found, x, np.array([left]), left, np.zeros((len(x), 1)), np.zeros((0, 1)))

    here, there, delay = (
        Location("tendon", "L0"),
        Location("tendon", "L1"),
        ("actuator_delay", Location("actuator", "*")),
    )
    taken, rival = ended(3000.0, 0.1, ("coulomb_friction", here)), ended(5000.0, 0.2, ("viscous_friction", here))
    behind, elsewhere = ended(7000.0, 0.2, ("load_friction", here)), ended(4000.0, 0.2, ("viscous_friction", there))
    best = ended(1000.0, 0.3, ("coulomb_friction", here), delay)
    monkeypatch.setattr(refit, "fitted", lambda problem, guesses, *_: guesses)
    given = SimpleNamespace(parameters=2, robot=robot, misfit=lambda residual: float(residual[0]))
    found = refit.revisit_rivals(given, best, [taken, rival, behind, elsewhere], 0)
    assert {guess.terms for guess in found} == {(*rival.terms, best.terms[1])}
    # the delay of the best, the friction of the rival, and the robot of either
    assert [guess.x.tolist() for guess in found] == [[0.3, 0.3, 0.2, 0.3], [0.2, 0.2, 0.2, 0.3]]


@pytest.mark.parametrize("began", ["vertebra4", "vertebra8"])
def test_a_law_begun_at_a_neighbour_ends_at_its_place(robot, actions, began):
    hidden = Effect("payload", Location("body", "vertebra6"), {"mass": 0.04})
    given = problem(robot, actions, [hidden])
    (base,) = fitted(given, [Guess(np.zeros(5))], (0.7, 0.4, 0.2, 0.1), seed=0)
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in range(3, 10)]
    found = evidence(given, base, candidates, responses(given, base, candidates, robot))
    screened_candidate = found.screened_candidate([[one.location.name for one in candidates].index(began)])
    (payload,) = refit.refitted(given, [found.guess(screened_candidate)], found, 1)[0].effects(given.parameters)
    assert payload.location == hidden.location
    assert payload.parameters["mass"] == pytest.approx(0.04, rel=0.1)


def test_what_is_far_behind_the_best_is_not_tried_at_other_places(monkeypatch):
    asked = []
    monkeypatch.setattr(refit, "_beside", lambda problem, h, responses: asked.append(h) or [])
    problem, screened = SimpleNamespace(misfit=float), SimpleNamespace(candidates=(), responses=())
    best, rival, behind = (SimpleNamespace(residual=left, terms=()) for left in (3000.0, 5000.0, 7000.0))
    assert refit._shift_location(problem, [best, rival, behind], screened, 0) == [best, rival, behind]
    assert asked == [best, rival]


@pytest.mark.parametrize(("name", "sides"), [("vertebra0", ["vertebra1"]), ("vertebra4", ["vertebra3", "vertebra5"])])
def test_beside_a_segment_are_the_ones_before_and_after(robot, name, sides):
    assert [location.name for location in robot.beside(Location("body", name))] == sides


def test_cables_have_no_order(robot):
    assert robot.beside(Location("tendon", "L2")) == []


def test_other_laws_are_kept_before_other_places_of_one(robot):
    given = [("viscous_friction", "L0"), ("viscous_friction", "L1"), ("viscous_friction", "L2"), ("compliance", "L1"),
             ("stribeck_friction", "L1"), ("stribeck_friction", "L0")]  # fmt: skip
    ranked = [SimpleNamespace(terms=[term(robot, name, Location("tendon", cable))]) for name, cable in given]
    assert refit._diversify(robot, ranked, range(6), 2) == [ranked[0], ranked[1], ranked[3]]


def test_of_fits_of_the_same_laws_the_best_one_stays_in_the_place_of_the_first(robot):
    one, other = (term(robot, "coulomb_friction", Location("tendon", cable)) for cable in ("L0", "L1"))
    given = [SimpleNamespace(terms=s, cost=c) for s, c in (((one,), 5.0), ((other,), 4.0), ((one,), 3.0))]
    assert explain._cheapest(given) == [given[2], given[1]]


def test_an_effect_that_only_leads_to_better_parameters_is_dropped(robot, actions):
    """A fit of the parameters has ended far from where they are, and its slopes lead nowhere."""
    given = problem(robot, actions)
    x = np.where(np.arange(5) == 0, TRUTH - 1.0, TRUTH)  # too light, as if something were carried
    (residual,) = given.residuals([(x, ())])
    none = np.zeros((5, residual.size))
    stuck = Hypothesis((), x, residual, given.cost(residual, x), none, none[:0])
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in (6, 8)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(explain, "LACKING", (0.0, 0.0))
        found = explain.explained(given, stuck, robot, [], candidates, 0)
    assert found.found == ()
    assert given.misfit(found.nominal.residual) < explain.CLEAN < given.misfit(residual)
