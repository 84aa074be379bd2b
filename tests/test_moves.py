"""Forward selection and its moves, on recordings of an arm and of the cheap trunk.

Signals that stand still, and commands that nothing follows: told from physics by replays of the nominal robot.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.candidates import term, terms
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, descended, fitted, linearised_at, settled
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.forward_selection import explained
from soro_bench.diagnosis.selection.moves import (
    begun_best,
    distinct,
    indistinguishable,
    laws,
    refitted,
    revisit_rivals,
    swap_delays,
    unique,
    without_one,
)
from soro_bench.diagnosis.selection.rounds import (
    fitted_from_priors,
    fitted_in_growing_parts,
    from_base_if_worse,
    may_imitate,
    replayed_anew,
)
from soro_bench.diagnosis.selection.screening import ScreenedCandidate, evidence, responses
from soro_bench.diagnosis.settings import DEFAULT, ScreeningSettings
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.recording.recording import NOTES, Recording, RecordingError, Signal
from tests import arm
from tests.arm import ARM, MAP, TRUNK_TRUTH, recording, trunk_problem

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


RATIOS = (
    MAP.split("[parameters.zero]")[0]
    + """[parameters.motor]
fields = ["actuator_gainprm[0]:motor", "actuator_biasprm[1]:motor", "actuator_biasprm[2]:motor"]
deviation = 0.1
"""
)


def test_along_a_direction_that_no_recording_shows_priors_decide(paths):
    """Of mass, damping and the motor's stiffness only ratios matter."""
    paths[0].write_text(ARM.replace(' forcerange="-1 1"', ""))
    recorded = recording(paths, [], 0)
    paths[1].write_text(RATIOS)
    robot = ModelRobot(*paths, threads=1)
    measured = robot.measured(recorded)
    (values,) = robot.simulate(measured.actions, np.array([[1.1, 0.9, 1.0]]), [()], measured.start)
    noise = 5e-4 * np.random.default_rng(0).standard_normal(values.shape)
    problem = unexplained(robot, (replace(measured, values=values + noise),), 5e-4)
    (best,) = descended(problem, [linearised_at(problem, Guess(np.zeros(3)), 0.01, 0)])
    deviations = np.array([each.deviation for each in robot.priors])
    x = best.x + 0.3 / deviations  # of all logarithms
    (row,) = problem.residuals([(x, ())])
    assert problem.misfit(row) == pytest.approx(problem.misfit(best.residual), abs=0.1)
    apart = replace(best, x=x, residual=row, cost=problem.cost(row, x))
    candidates = [one for one in terms(robot) if one.name == "coulomb_friction"]
    for found in (settled(problem, apart), explained(problem, apart, robot, (), candidates, 0).nominal):
        assert found.x @ (1.0 / deviations) == pytest.approx(0.0, abs=0.5)  # where the sum of squares is least
        assert found.cost <= best.cost + 0.1


def test_fits_that_all_end_above_what_they_contain_begin_there_again(paths):
    given = arm.problem(paths, [FRICTION])
    base = descended(given, [fit(given)])[0]
    apart = [replace(fit(given, name), cost=base.cost + 10.0) for name in ("coulomb_friction", "actuator_delay")]
    again = from_base_if_worse(given, base, apart)
    assert again[0].terms[0].name == "coulomb_friction"
    assert again[0].cost < 0.2 * base.cost and all(h.cost <= base.cost for h in again)
    good = [replace(apart[0], cost=base.cost - 1.0), apart[1]]
    assert from_base_if_worse(given, base, good) == good


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


def test_what_parameters_have_moved_far_to_imitate_is_found_from_their_priors(robot, actions):
    hidden = Effect("payload", Location("body", "vertebra6"), {"mass": 0.04})
    given = trunk_problem(robot, actions, [hidden])
    base = linearised_at(given, Guess(np.array([3.0, 0.0, -2.0, 0.0, 0.0])), 0.05, 0)
    assert may_imitate(given, base)
    assert not may_imitate(given, replace(base, x=0.2 * base.x))
    locations = [Location("body", f"vertebra{k}") for k in (3, 6, 9)]
    candidates = [term(robot, name, each) for name in ("local_stiffness", "payload") for each in locations]
    beside = evidence(given, base, candidates, responses(given, base, candidates, robot))
    _, fits = fitted_from_priors(given, robot, base, beside, candidates, 0)
    best = min(fits, key=lambda h: h.cost)
    (payload,) = best.effects(given.parameters)
    assert best.cost < 0.5 * base.cost
    assert (payload.name, payload.location) == (hidden.name, hidden.location)
    assert payload.parameters["mass"] == pytest.approx(0.04, rel=0.3)


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
    given = replace(given, settings=with_selection(**values, turns=0, least_gain_of_misfit=0.5))
    candidates = [term(robot, "payload", Location("body", f"vertebra{k}")) for k in (6, 8)]
    explanation = explained(given, stuck, robot, [], candidates, 0)
    assert len(explanation.rounds) == 1
    assert explanation.found


def test_of_no_guesses_there_are_no_fits(paths):
    given = arm.problem(paths)
    assert begun_best(given, []) == fitted(given, [], (1.0,), 0) == replayed_anew(given, []) == []
    assert given.parameter_values([]).shape == (0, given.parameters)


def test_settings_of_the_problem_decide_which_terms_are_tried(paths):
    given = arm.problem(paths, [FRICTION], settings=with_selection(least_gain=1e9))
    candidates = candidate_terms(given, "coulomb_friction", "viscous_friction")
    none = explained(given, fit(given), given.robot, [], candidates, 0)
    assert none.found == () and none.remaining_gain > DEFAULT.selection.least_gain
    one = explained(replace(given, settings=DEFAULT), fit(given), given.robot, [], candidates, 0)
    assert [t.name for t in one.found[0].terms] == ["coulomb_friction"]
    assert one.remaining_gain < none.remaining_gain


def test_settings_leave_at_least_one_term_to_fit(paths):
    """A round that is worth a fit begins with the best candidate."""
    given = arm.problem(paths, [FRICTION], settings=replace(DEFAULT, screening=ScreeningSettings(least_share=1.0)))
    candidates = candidate_terms(given, "coulomb_friction", "viscous_friction")
    found = explained(given, fit(given), given.robot, [], candidates, 0).found
    assert [t.name for t in found[0].terms] == ["coulomb_friction"]
    for name in ("candidates", "candidates_per_law"):
        with pytest.raises(ValueError, match=f"{name} = 0; at least 1 is needed"):
            with_selection(**{name: 0})
    with pytest.raises(ValueError, match=r"least_share = 1\.5; at most 1 is allowed"):
        ScreeningSettings(least_share=1.5)


LINK = """<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0" damping="0.05"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/>{2}</body>"""


TWO = f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
{LINK.format("upper", 0, LINK.format("fore", 0.2, ""))}</worldbody><actuator>
<position name="first" joint="upper" kp="4"/><position name="second" joint="fore" kp="2"/></actuator></mujoco>"""


OF_TWO = """[robot]
control_timestep = 0.02
[commands.goals]
actuators = ["first", "second"]
[signal]
name = "angles"
joints = ["upper", "fore"]
unit = "rad"
[parameters.damping]
fields = ["dof_damping:*"]
deviation = 0.3
"""


NOISE = 5e-4  # rad


@pytest.fixture
def two_links(tmp_path):
    for name, text in (("two.xml", TWO), ("two.toml", OF_TWO)):
        (tmp_path / name).write_text(text)
    return ModelRobot(tmp_path / "two.xml", tmp_path / "two.toml", threads=1)


def measured(two_links, arrived=lambda goals: goals, goals=None, truth=(1.3,)):
    """Noisy angles of a robot with more damping, whose motors get what arrives of the recorded goals."""
    rng = np.random.default_rng(1)
    goals = np.repeat(rng.uniform(-0.5, 0.5, (12, 2)), 12, axis=0) if goals is None else goals
    (values,) = two_links.simulate(arrived(goals), np.array([truth]), [()])
    values = np.concatenate([np.zeros((1, 2, 1)), values]) + NOISE * rng.standard_normal((len(goals) + 1, 2, 1))
    times = 0.02 * np.arange(len(values))
    signals = {"angles": Signal(times, values, "rad")}
    return two_links.measured(Recording({"goals": Signal(times[:-1], goals)}, signals))


def test_a_healthy_robot_answers_to_every_command(two_links):
    whole = measured(two_links)
    found = answered(whole, 0, two_links)
    assert found.findings == ()
    assert np.array_equal(found.measured.values, whole.values)


@pytest.mark.parametrize("noise", [0.0, NOISE, 0.06])
def test_a_sensor_that_stands_still_is_left_out(two_links, noise):
    """The other joint moves as if this one did too, so its command has arrived. Noise of a fifth of the motion is no
    motion."""
    whole = measured(two_links)
    still = 0.1 + noise * np.random.default_rng(2).standard_normal(len(whole.time))
    values = np.stack([whole.values[:, 0], still[:, None]], axis=1)
    found = answered(replace(whole, values=values), 3, two_links)
    (finding,) = found.findings
    assert (finding.name, finding.recording, finding.samples) == ("unmoved", 3, len(still))
    assert finding.share == 0.5
    assert "angles, point 1" in finding.text
    assert np.isnan(found.measured.values[:, 1]).all()
    assert np.array_equal(found.measured.values[:, 0], whole.values[:, 0])


def test_a_command_that_never_arrives_is_held(two_links):
    found = answered(measured(two_links, lambda goals: goals * [0.0, 1.0]), 0, two_links)
    (finding,) = found.findings
    assert (finding.name, finding.signal) == ("unanswered_command", "actuator first")
    assert not found.measured.actions[:, 0].any()
    assert np.ptp(found.measured.actions[:, 1]) > 0


@pytest.mark.parametrize("arrived", [lambda goals: goals * [0.6, 1.0], lambda goals: goals[:, ::-1]])
def test_a_weak_motor_or_swapped_commands_are_none_that_never_arrive(two_links, arrived):
    assert answered(measured(two_links, arrived), 0, two_links).findings == ()


def swinging(folder, seed, first, second):
    """Loose links with motors that are strong enough to swing them through, a recording, and its two parameters."""
    text = TWO.replace('damping="0.05"', 'damping="0.005"').replace("position", "motor")
    (folder / "two.xml").write_text(text.replace('kp="4"', f'gear="{first}"').replace('kp="2"', f'gear="{second}"'))
    masses = '[parameters.mass]\nfields = ["body_mass:*", "body_inertia:*"]\ndeviation = 0.2\n'
    (folder / "two.toml").write_text(OF_TWO + masses)
    robot, rng = ModelRobot(folder / "two.xml", folder / "two.toml", threads=1), np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-1, 1, (12, 2)), 12, axis=0)
    truth = np.exp([0.3, 0.2] * rng.uniform(-1, 1, 2))
    return robot, measured(robot, goals=goals, truth=truth), truth


@pytest.mark.parametrize("seed", [8, 37, 48])
def test_loose_links_that_swing_through_answer_to_every_command(tmp_path, seed):
    """A replay of other parameters swings elsewhere, whatever its slopes say; fitted ones follow the robot."""
    robot, whole, _ = swinging(tmp_path, seed, 0.4, 0.12)
    assert answered(whole, 0, robot).findings == ()


def test_parameters_of_chaotic_motion_are_found_from_its_beginning_on(tmp_path):
    """Along the whole recording the misfit has a local minimum everywhere."""
    robot, whole, truth = swinging(tmp_path, 17, 0.7, 0.25)
    problem, fit = nominal_fit(unexplained(robot, (whole,), NOISE), [], 0)
    assert problem.left(fit.residual) < 1.2 * NOISE
    assert list(robot.parameters(fit.x).values()) == pytest.approx(truth, rel=1e-3)


def test_parameters_that_do_not_explain_a_part_are_not_taken_further(paths):
    healthy, rubbing = arm.problem(paths), arm.problem(paths, [FRICTION])
    (_, fit) = fitted_in_growing_parts(healthy, [], 0)
    assert list(healthy.robot.parameters(fit.x).values()) == pytest.approx(arm.TRUTH[0], rel=0.05)
    assert fitted_in_growing_parts(rubbing, [], 0) is None


def test_a_point_that_stands_still_like_its_command_tells_nothing(tmp_path):
    """Nothing else moves with it. So its sensor may have failed, and stands elsewhere than the robot does."""
    apart = LINK.format("upper", 0, "") + LINK.format("fore", 0.5, "")
    (tmp_path / "two.xml").write_text(re.sub("<body.*</body>", apart, TWO, flags=re.DOTALL))
    (tmp_path / "two.toml").write_text(OF_TWO)
    robot = ModelRobot(tmp_path / "two.xml", tmp_path / "two.toml", threads=1)
    whole = measured(robot)
    still = whole.values.copy()
    still[:, 1, 0] = 2 * NOISE + NOISE * np.random.default_rng(2).standard_normal(len(still))
    found = answered(replace(whole, values=still), 0, robot)
    assert {each.name for each in found.findings} == {"unanswered_command", "unmoved"}
    assert np.isnan(found.measured.values[:, 1]).all()
    assert np.array_equal(found.measured.values[:, 0], whole.values[:, 0])


def test_a_command_that_never_changes_is_said(two_links):
    whole = measured(two_links, lambda goals: goals * [1.0, 0.0])
    constant = replace(whole, actions=whole.actions * [1.0, 0.0])
    (finding,) = answered(constant, 0, two_links).findings
    assert (finding.name, finding.signal, finding.share) == ("constant_command", "actuator second", 0.5)


@pytest.fixture
def arm_files(tmp_path):
    paths = tmp_path / "arm.xml", tmp_path / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    return paths


def test_a_whole_signal_that_stands_still_is_refused_in_one_sentence(arm_files):
    whole = recording(arm_files, (), 0)
    angle = whole.signals["angle"]
    still = replace(whole, signals={"angle": replace(angle, values=np.full(len(angle.time), 0.2))})
    with pytest.raises(RecordingError, match="recording 1: angle: all of the samples stay within 0 rad although"):
        diagnose(ModelRobot(*arm_files, threads=1), [still])


def test_what_an_import_has_changed_is_told_with_the_data(arm_files):
    whole = recording(arm_files, (), 0)
    noted = replace(whole, metadata={NOTES: "signals.angle: 3 cells were empty\nlast line, 9, was cut"})
    plain, result = (diagnose(ModelRobot(*arm_files, threads=1), [each]) for each in (whole, noted))
    assert [(f.name, f.signal, f.recording) for f in result.data] == [("import", "angle", 0), ("import", "", 0)]
    assert result.verdict == plain.verdict
    assert result.train == plain.train
