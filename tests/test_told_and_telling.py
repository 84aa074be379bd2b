"""What a diagnosis is told, and what it tells beside laws: known parameters, recordings that disagree, limits."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tyro

from soro_bench.commands.learning import Infer
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.assembly.limits import limits_of
from soro_bench.diagnosis.commands import Diagnose
from soro_bench.diagnosis.estimation.agreement import difference, fitted_alone
from soro_bench.diagnosis.estimation.fit import Guess, fitted
from soro_bench.diagnosis.render import posterior
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.render.words import parameter
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Agreement, Estimate, ReachedLimit
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.options import joined
from soro_bench.recording.known import Known, known_parameters
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import TRUTH, problem, recording
from tests.results import RESULTS

NEVER = 1e9  # times the misfit: no law is predicted to gain so much
NAMES = ("inertia", "damping", "zero")


def _with(**parameters):
    return Recording({}, {"angle": Signal(np.arange(2.0), np.zeros(2), "rad")}, parameters)


def test_a_known_parameter_of_the_suite_is_simulated_and_not_fitted(robot, actions):
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    heavier = nominal.copy()
    heavier[0, [prior.name for prior in robot.priors].index("trunk_mass")] = 0.6
    told = robot.knowing(Known({"trunk_mass": 0.6}))
    assert "trunk_mass" not in [prior.name for prior in told.priors]
    others = np.array([[prior.nominal for prior in told.priors]])
    for one, other in ((told, robot), (told.shortened(2), robot.shortened(2))):
        np.testing.assert_array_equal(one.simulate(actions, others, [()]), other.simulate(actions, heavier, [()]))


def test_a_known_parameter_of_a_model_is_simulated_and_not_fitted(paths):
    robot, goals, start = ModelRobot(*paths, threads=1), np.full((20, 1), 0.4), np.full((1, 1), 0.2)
    told = robot.knowing(Known({"damping": 0.8, "inertia": 1.2}))
    values = told.simulate(goals, TRUTH[:, 2:], [()], start)
    np.testing.assert_array_equal(values, robot.simulate(goals, TRUTH, [()], start))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"mass": 1.0}, "no parameter 'mass'; this robot has inertia, damping, zero"),
        ({"inertia": 5000.0}, "inertia = 5000 is not possible; allowed is 0.001 to 1000"),
        ({"zero": np.nan}, "zero = nan is not possible; allowed is -2 to 2 N m"),
        (["inertia"], "'inertia' is no NAME=NUMBER; expected something like trunk_mass=0.3"),
    ],
)
def test_what_a_robot_cannot_have_is_refused_in_one_line(paths, told, said):
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        diagnose(ModelRobot(*paths, threads=1), [_with()], known=told)


def test_a_told_value_counts_before_a_recorded_one():
    recordings = [_with(inertia=1.3, damping=0.7, colour=3.0), _with(inertia=1.3)]
    found = known_parameters(["recorded", "damping=0.8"], recordings, NAMES)
    assert found == Known({"damping": 0.8, "inertia": 1.3}, frozenset({"inertia"}))


@pytest.mark.parametrize(
    ("recordings", "said"),
    [
        ([_with(inertia=1.3), _with(inertia=1.2)], "inertia = 1.2 and 1.3"),
        ([_with(colour=3.0)], "which has inertia, damping, zero; they have colour"),
    ],
)
def test_recordings_that_do_not_say_are_refused(recordings, said):
    with pytest.raises(RecordingError, match=said):
        known_parameters("recorded", recordings, NAMES)


def test_a_diagnosis_fits_the_others_and_says_what_it_was_told(paths):
    given = replace(recording(paths, [], 0), parameters={"inertia": 1.2})
    result = diagnose(ModelRobot(*paths, threads=1), [given], known=["recorded", "damping=0.8"])
    found = {each.estimate.name: each for each in result.parameters}
    assert [found[name].known for name in NAMES] == ["recorded", "told", ""]
    assert (found["damping"].estimate.low, found["damping"].estimate.high) == (0.8, 0.8)
    assert found["zero"].estimate.low < TRUTH[0, 2] < found["zero"].estimate.high
    assert "damping 0.8 (as told), inertia 1.2 (as recorded)" in summary(result).replace("\n" + " " * 15, " ")
    assert "inertia 1.2 1" in result.patch.model  # the comment of the patched model


def test_a_diagnosis_of_which_every_parameter_is_known_still_looks_for_laws(paths):
    told = dict(zip(NAMES, TRUTH[0], strict=True))
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, [], 0)], known=told)
    assert result.verdict == "adequate" and {each.name for each in result.detectable} >= {"payload", "backlash"}


def test_a_wrong_value_that_was_told_is_a_discrepancy_at_the_arm(paths):
    """Nothing is fitted, so that all of it is left to be located; no law is looked for, which would take longer."""
    quick = replace(
        DEFAULT,
        selection=replace(DEFAULT.selection, least_gain_of_misfit=NEVER),
        report=replace(DEFAULT.report, least_probability=0.0),
    )
    told = {"inertia": 1.0, "damping": 0.8, "zero": 0.01}
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, [], 0)], settings=quick, known=told)
    assert result.verdict == "outside_catalogue" and result.next_recording is not None
    first = result.locations[0].gain  # which of gravity and a force on the one body may turn the hinge
    assert {"arm", "hinge"} & {each.location.name for each in result.locations if each.gain > 0.999 * first}


def test_a_posterior_holds_what_is_known():

    result = next(found for each in RESULTS.values() if (found := each()).trainable)
    *others, last = result.parameters
    assert parameter(replace(last, known="told")).endswith("(as told)")
    covariance = np.array(result.covariance)
    covariance[-1], covariance[:, -1] = 0.0, 0.0
    rows = tuple(map(tuple, covariance.tolist()))
    held = posterior(replace(result, parameters=(*others, replace(last, known="told")), covariance=rows))
    draws = [held.sample(np.random.default_rng(seed))[last.estimate.name] for seed in range(3)]
    assert draws == [last.estimate.value] * 3


@pytest.mark.parametrize("command", [Diagnose, Infer])
def test_both_commands_take_the_same_spelling(command):
    first = ["r.parquet"] if command is Diagnose else ["sysid", "r.parquet"]
    options = ["--known", "trunk_mass=0.3", "damping=0.2", "--known", "recorded"]
    found = tyro.cli(command, args=[*first, "--out", "x", *options])
    assert joined(found.known) == ["trunk_mass=0.3", "damping=0.2", "recorded"]


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


@pytest.mark.parametrize(("compared", "change"), [(8, True), (15, False)])
def test_values_that_one_in_twenty_diagnoses_has_apart_are_no_change(compared, change):
    """Values that are 2.8 deviations apart, by chance with p = 0.037 of eight and 0.07 of 15 unknowns."""
    assert difference((0.0, 4.0), (1.0, 1.0), compared).is_change(DEFAULT.agreement.alpha) == change


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
        selection=replace(DEFAULT.selection, least_gain_of_misfit=NEVER),
        report=replace(DEFAULT.report, least_probability=1.0),
    )
    heavier = recording(paths, [], 1, truth=TRUTH * [[1.1, 1.0, 1.0]])
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, [], 0), heavier], settings=quick)
    assert [each.name for each in result.agreement if each.changes] == ["inertia"]
    first, second = next(each for each in result.agreement if each.name == "inertia").estimates
    assert first.low < TRUTH[0, 0] < first.high < second.low < 1.1 * TRUTH[0, 0] < second.high
    assert "the structure of the model is wrong" in summary(result).replace("\n" + " " * 15, " ")


STOPPED = """<mujoco><worldbody>
<body name="arm"><joint name="hinge" axis="0 1 0" range="-0.5 0.5" limited="true" damping="0.01"/>
<geom name="rod" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><position name="motor" joint="hinge" kp="5" forcerange="-2 2" ctrlrange="-3 3"/></actuator>
</mujoco>"""
PULLED = """<mujoco><worldbody><site name="top" pos="0 0 0.5"/>
<geom name="floor" type="plane" size="1 1 0.1"/>
<body name="load" pos="0 0 0.05"><joint name="lift" type="slide" axis="0 0 1" damping="1"/>
<geom name="box" type="box" size="0.05 0.05 0.05" mass="0.2"/><site name="hook" pos="0 0 0.05"/></body></worldbody>
<tendon><spatial name="rope"><site site="top"/><site site="hook"/></spatial></tendon>
<actuator><general name="winch" tendon="rope" gear="-1" gainprm="1" forcerange="0 1" forcelimited="true"/></actuator>
</mujoco>"""
MAP = """[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["{actuator}"]
[signal]
name = "position"
joints = ["{joint}"]
unit = "{unit}"
[parameters.inertia]
fields = ["body_mass:{body}", "body_inertia:{body}"]
deviation = 0.2
"""


def _reached(robot: Robot, goals: np.ndarray, *effects: Effect) -> dict[tuple[str, str], ReachedLimit]:
    found = limits_of(robot, [Drive(goals[:, None])], np.ones((1, 1)), effects, DEFAULT.limits)
    return {(each.name, each.element): each for each in found}


def test_an_arm_that_is_driven_into_its_stop_is_there_with_its_largest_force(robot_of):
    mapping = MAP.format(actuator="motor", joint="hinge", unit="rad", body="arm")
    robot = robot_of(mapping, STOPPED)
    found = _reached(robot, np.repeat([0.0, 2.9, 0.0], 100))
    stop, force = found["stop", "joint hinge"], found["force_limit", "actuator motor"]
    assert stop.share == pytest.approx(1 / 3, abs=0.05) and force.share == pytest.approx(1 / 3, abs=0.05)
    assert (force.value, force.unit) == (2.0, "N m")
    assert ("control_limit", "actuator motor") not in found  # 2.9 of 3
    assert found.keys() == {("stop", "joint hinge"), ("force_limit", "actuator motor")}


def test_a_control_at_the_end_of_its_range_is_told(robot_of):
    robot = robot_of(MAP.format(actuator="motor", joint="hinge", unit="rad", body="arm"), STOPPED)
    reached = _reached(robot, np.repeat([0.0, 3.0], [150, 50]))["control_limit", "actuator motor"]
    assert (reached.value, reached.unit) == (3.0, "rad")
    assert reached.share == 0.25  # with the last step


@pytest.mark.parametrize("gain", [0.5, 2.0])
@pytest.mark.parametrize("integrates", [False, True])
def test_a_limit_of_control_is_that_of_commands_whatever_a_law_makes_of_them(robot_of, integrates, gain):
    """Of a servo that is told its goal, or its rate: 1 rad/s for 3 s."""
    model, goals = STOPPED, np.repeat([0.0, 3.0], [150, 50])
    if integrates:
        model = STOPPED.replace("<position", "<intvelocity").replace("ctrlrange", "actrange")
        goals = np.repeat([1.0, 0.0], [150, 50])
    robot = robot_of(MAP.format(actuator="motor", joint="hinge", unit="rad", body="arm"), model)
    law = Effect("actuator_gain", Location("actuator", "motor"), {"gain": gain})
    reached = _reached(robot, goals, law)["control_limit", "actuator motor"]
    assert reached.value == 3.0 and reached.share == pytest.approx(0.25, abs=0.01)


def test_a_rope_is_slack_at_its_limit_or_neither_and_its_load_rests_on_the_floor(robot_of):
    """Of 200 steps it is slack in 100, pulls half as much as it can in 50, and all that it can in 50; all of that is
    less than the load weighs."""
    robot = robot_of(MAP.format(actuator="winch", joint="lift", unit="m", body="load"), PULLED)
    found = _reached(robot, np.repeat([0.0, 0.5, 1.0], [100, 50, 50]))
    assert found["slack", "tendon rope"].share == pytest.approx(0.5, abs=0.02)
    assert found["force_limit", "tendon rope"].share == pytest.approx(0.25, abs=0.02)
    assert (found["force_limit", "tendon rope"].value, found["force_limit", "tendon rope"].unit) == (1.0, "N")
    assert found["contact", "geom box and geom floor"].share == pytest.approx(1.0, abs=0.02)


def test_a_trunk_that_pulls_one_cable_has_others_that_are_slack(robot):
    pull = np.zeros((40, 8), np.float32)
    pull[:, 0] = 1.0
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    found = {(each.name, each.element) for each in limits_of(robot, [Drive(pull)], nominal, [], DEFAULT.limits)}
    assert ("force_limit", "tendon L0") in found and {("slack", "tendon S0"), ("slack", "tendon L1")} <= found
    assert ("slack", "tendon L0") not in found


def test_limits_are_on_the_console_in_the_report_and_in_the_file():
    limits = (
        *(ReachedLimit("force_limit", f"tendon L{i}", round(0.62 - 0.1 * i, 2), 30.0, "N") for i in range(6)),
        ReachedLimit("stop", "joint hinge", 0.1),
    )
    result = replace(next(iter(RESULTS.values()))(), limits=limits)
    assert Result.from_json(result.to_json()).limits == limits
    console, page = (
        text.replace("\u00a0", " ") for text in (summary(result).replace("\n" + " " * 15, " "), html(result))
    )
    for text in (console, page):
        assert "At a limit of force: tendon L0 (30 N) 62 %, tendon L1 (30 N) 52 %" in text
        assert "and 2 more of the time" in text and "At a stop: joint hinge 10 % of the time." in text
    assert "tendon L5" in page and "tendon L5" not in console
