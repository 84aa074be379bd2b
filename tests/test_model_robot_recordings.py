"""Which recordings the diagnosis of any model takes, and which it refuses.

Robots with several signals, each in its own unit and with its own noise.
"""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")


from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.assembly.build import _verdict
from soro_bench.diagnosis.assembly.errors import leave_most, motion
from soro_bench.diagnosis.candidates import late, term, terms
from soro_bench.diagnosis.commands import Diagnose
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.data_quality.signals import explaining
from soro_bench.diagnosis.estimation.fit import Guess, fitted
from soro_bench.diagnosis.preparation import check_unit_and_sign, unexplained
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result_parts import Errors
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot_map import read_mapping
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.recording.importers import import_recording
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.simulated import record
from tests.arm import ARM, MAP, SIGMA, TRUTH, recording


def test_what_lies_between_two_samples_is_not_measured(paths):
    """Else every second of the robot's steps would count as another sample, with half of the noise."""
    given = recording(paths, [], 0)
    signal = given.signals["angle"]
    sparse = replace(given, signals={"angle": Signal(signal.time[::2], signal.values[::2], "rad")})
    measured = ModelRobot(*paths, threads=1).measured(sparse)
    assert np.isfinite(measured.values[1::2]).all() and np.isnan(measured.values[::2]).all()
    assert measured.values[1::2].ravel() == pytest.approx(signal.values[2::2])
    assert data_quality(measured) == data_quality(
        replace(measured, values=measured.values[1::2], time=measured.time[1::2])
    )


def test_a_recording_that_does_not_say_where_it_begins_is_refused(paths):
    given = recording(paths, [], 0)
    given.signals["angle"].values[0] = np.nan
    with pytest.raises(RecordingError, match=r"\[initial\] needs"):
        ModelRobot(*paths, threads=1).measured(given)


def test_a_start_that_was_measured_later_than_the_commands_begin_is_refused(paths):
    given = recording(paths, [], 0)
    angle = given.signals["angle"]
    later = replace(given, signals={"angle": replace(angle, time=angle.time[50:], values=angle.values[50:])})
    with pytest.raises(RecordingError, match=r"first sample of angle is 1 s after .* within a control step, 0\.02 s"):
        ModelRobot(*paths, threads=1).measured(later)


def test_motion_is_about_the_mean_of_each_recording(paths):
    robot = ModelRobot(*paths, threads=1)
    measured = [robot.measured(recording(paths, [], seed)) for seed in (0, 1)]
    left = np.concatenate([each.values - each.values.mean() for each in measured])
    assert motion(unexplained(robot, measured, 1e-3)) == pytest.approx(left.std(), rel=1e-6)


@pytest.mark.parametrize(
    ("left", "moved", "most"), [(0.6, 1.0, False), (0.8, 1.0, True), (np.inf, 1.0, True), (0.8, None, False)]
)
def test_replays_leave_most_of_the_motion_if_half_of_its_square_is_left(left, moved, most):
    assert leave_most(Errors(left, left, 0.1, 0.1, 0.1, moved)) == most


@pytest.mark.parametrize(
    ("detected", "changes", "left", "verdict"),
    [
        (False, False, 0.5, "adequate"),
        (False, False, 0.9, "undecided"),
        (False, True, 0.9, "recordings_disagree"),
        (True, True, 0.9, "discrepancy"),
    ],
)
def test_a_verdict_counts_what_replays_leave_where_nothing_was_detected(detected, changes, left, verdict):
    found = SimpleNamespace(detected=detected, verdict="discrepancy" if detected else "adequate")
    alone, errors = [SimpleNamespace(changes=changes)], Errors(left, left, 0.1, 0.1, 0.1, 1.0)
    assert _verdict(found, alone, errors) == verdict


def test_nothing_is_explained_for_a_while_after_a_command_changes(paths):
    given = recording(paths, [], 0)
    goal = given.commands["goal"]
    held = np.where(goal.time < 0.99, 0.0, 0.3)
    told = replace(given, commands={"goal": replace(goal, values=held[:, None])})
    table = read_mapping(paths[1])
    table["commands"]["goal"]["leave_out"] = 0.5
    measured = ModelRobot(paths[0], table, threads=1).measured(told)
    lost = np.isnan(measured.values[:, 0, 0])
    assert (lost == (measured.time > 1.01) & (measured.time < 1.51)).all() and lost.sum() == 25
    assert measured.notes == (
        f"[commands.goal] leave_out = 0.5 s leaves out {2500 / len(lost):.0f} % of the recording",
    )
    always = replace(given, commands={"goal": replace(goal, values=np.arange(len(held))[:, None] * 1e-4)})
    table["commands"]["goal"]["leave_out"] = 1e3
    with pytest.raises(RecordingError, match=r"\[commands.goal\] leave_out = 1000 s leaves nothing"):
        ModelRobot(paths[0], table, threads=1).measured(always)


PULLED = Effect("pretension", Location("actuator", "motor"), {"offset": 0.03})


@pytest.mark.parametrize(("truth", "shift", "hidden"), [("sensor_bias", 0.03, []), ("pretension", 0.0, [PULLED])])
def test_an_offset_is_the_sensors_or_the_commands_though_the_robot_begins_at_its_signal(paths, truth, shift, hidden):
    paths[1].write_text(MAP.split("[parameters.zero]")[0])  # which is an offset of the command
    given = recording(paths, hidden, 0, truth=TRUTH[:, :2])
    angle = given.signals["angle"]
    shifted = replace(given, signals={"angle": replace(angle, values=angle.values + shift)})
    robot = ModelRobot(*paths, threads=1, shorter=2)
    problem = unexplained(robot, (robot.measured(shifted).first(120),), SIGMA)
    laws = term(robot, "sensor_bias", Location("sensor", "angle", 0)), term(robot, "pretension", PULLED.location)
    guesses = [Guess(np.concatenate([np.zeros(2), 0.03 / law.deviations]), (law,)) for law in laws]
    best = max(fitted(problem, guesses, (0.07,), 0), key=lambda h: h.log_evidence(problem))
    (found,) = best.effects(2)
    assert found.name == truth and next(iter(found.parameters.values())) == pytest.approx(0.03, rel=0.05)


def test_a_recording_without_a_command_of_the_mapping_is_refused(paths):
    given = Recording({}, {"angle": Signal(np.arange(5.0), np.zeros(5), "rad")})
    with pytest.raises(RecordingError, match="no command 'goal'"):
        ModelRobot(*paths, threads=1).measured(given)


def test_a_command_is_in_the_unit_that_the_mapping_says(paths):
    given = recording(paths, [], 0)
    paths[1].write_text(MAP.replace('["motor"]', '["motor"]\nunit = "deg"', 1))
    goals = replace(given.commands["goal"], unit="deg")
    measured = ModelRobot(*paths, threads=1).measured(replace(given, commands={"goal": goals}))
    np.testing.assert_array_equal(measured.actions, goals.values)


@pytest.mark.parametrize(("said", "unit", "message"), [("rad", "1", "in '1'; expected is 'rad'"),
                                                       (None, "deg", "in 'deg'; expected is 'rad'")])  # fmt: skip
def test_a_command_in_another_unit_is_refused(paths, said, unit, message):
    given = recording(paths, [], 0)
    goals = replace(given.commands["goal"], unit=unit)
    if said:
        paths[1].write_text(MAP.replace('["motor"]', f'["motor"]\nunit = "{said}"', 1))
    with pytest.raises(RecordingError, match=message):
        ModelRobot(*paths, threads=1).measured(replace(given, commands={"goal": goals}))


def test_a_command_that_mujoco_would_cut_off_is_refused(paths):
    given = recording(paths, [], 0)
    paths[0].write_text(ARM.replace('kp="2"', 'kp="2" ctrllimited="true" ctrlrange="-0.1 0.1"'))
    with pytest.raises(RecordingError, match=r"'goal' is from -0.\d+ to 0.\d+; .* of actuator 'motor', -0.1 to 0.1"):
        ModelRobot(*paths, threads=1).measured(given)


def test_control_steps_that_leave_out_most_of_a_command_are_refused(paths):
    """It changes every 0.01 s, as an excitation in a log does."""
    given, time = recording(paths, [], 0), 0.01 * np.arange(400)
    robot = ModelRobot(*paths, threads=1)
    robot.measured(replace(given, commands={"goal": Signal(time, 0.1 * np.sin(time)[:, None])}))
    paths[1].write_text(MAP.replace("0.02", "0.05", 1))
    with pytest.raises(RecordingError, match=r"'goal' changes every 0.01 s; a control_timestep of 0.05 s leaves most"):
        ModelRobot(*paths, threads=1).measured(
            replace(given, commands={"goal": Signal(time, 0.1 * np.sin(time)[:, None])})
        )


@pytest.mark.parametrize(("scale", "times"), [(180 / np.pi, "57"), (1e-3, "0.001"), (-1.0, "-1")])
def test_a_signal_in_a_wrong_unit_or_the_other_way_round_is_refused(paths, scale, times):
    """It would be explained, as outside the catalogue. Other parameters than the model's are none of that."""
    given, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    angle = given.signals["angle"]
    check_unit_and_sign(unexplained(robot, (robot.measured(given),), 1.0))
    wrong = replace(given, signals={"angle": replace(angle, values=scale * angle.values)})
    with pytest.raises(RecordingError, match=rf"angle moves {times}\S* times as far in the recordings as in the model"):
        check_unit_and_sign(unexplained(robot, (replace(robot.measured(wrong), start=angle.values[:1, None]),), 1.0))


def test_samples_with_points_and_coordinates_exchanged_are_refused(paths):
    """Two points of three coordinates are not three of two."""
    sites = MAP.replace('joints = ["hinge"]\nunit = "rad"', 'sites = ["tip", "base"]\nunit = "m"', 1)
    paths[0].write_text(ARM.replace("</worldbody>", '<site name="base"/></worldbody>'))
    paths[1].write_text(sites.replace('[initial]\njoints = ["hinge"]\n', ""))
    robot, time = ModelRobot(*paths, threads=1), 0.02 * np.arange(10)

    def measured(*shape):
        points = Signal(time, np.ones((10, *shape)), "m")
        return robot.measured(Recording({"goal": Signal(time[:-1], np.zeros((9, 1)))}, {"angle": points}))

    assert measured(2, 3).values.shape == measured(6).values.shape == (9, 2, 3)
    with pytest.raises(RecordingError, match=r"samples of shape \(3, 2\); those of this robot have \(2, 3\)"):
        measured(3, 2)


def test_an_error_says_which_recording_it_is_of(paths, tmp_path):
    good, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    bad = replace(recording(paths, [], 1), commands={"goal": Signal(np.array([0.0, 1.0]), np.array([[0.0], [np.nan]]))})
    with pytest.raises(RecordingError, match=r"^recording 2: the command 'goal' has missing numbers, first at 1 s"):
        diagnose(robot, [good, bad])
    with pytest.raises(RecordingError, match=r"^held-out recording 1: the command 'goal'"):
        diagnose(robot, [good], [bad])
    save(bad, tmp_path / "b.parquet")
    with pytest.raises(RecordingError, match=rf"^recording 2 \({tmp_path / 'b.parquet'}\): the command 'goal'"):
        diagnose(robot, [good, load(tmp_path / "b.parquet")])


def test_an_error_of_two_imported_files_names_both(paths, tmp_path):
    given = recording(paths, [], 0)
    rows = np.column_stack([given.signals["angle"].time[:-1], given.signals["angle"].values[:-1].ravel(),
                            given.commands["goal"].values.ravel()])  # fmt: skip
    for name in ("a.csv", "b.csv"):
        np.savetxt(tmp_path / name, rows, delimiter=",", header="t,angle,goal", comments="")
    mapping = {"time": {"column": "t", "unit": "s"}, "commands": {"goal": {"columns": ["goal"], "unit": "rad"}},
               "signals": {"angle": {"columns": ["angle"], "unit": "rad"}}}  # fmt: skip
    found = [import_recording(tmp_path / name, mapping) for name in ("a.csv", "b.csv")]
    said = r"^recording 1 \(.*a\.csv\) and recording 2 \(.*b\.csv\) are the same"
    with pytest.raises(RecordingError, match=said):
        diagnose(ModelRobot(*paths, threads=1), found)


def test_a_signal_by_another_clock_is_refused(paths):
    given = recording(paths, [], 0)
    later = {name: replace(signal, time=signal.time + 1000.0) for name, signal in given.signals.items()}
    with pytest.raises(RecordingError, match="do they have the same clock"):
        ModelRobot(*paths, threads=1).measured(replace(given, signals=later))


def test_a_command_may_come_only_where_it_changes(paths):
    given = recording(paths, [], 0)
    late = Signal(np.array([0.8 * given.duration]), np.array([[0.1]]))
    measured = ModelRobot(*paths, threads=1).measured(replace(given, commands={"goal": late}))
    assert (measured.actions == 0.1).all()


@pytest.mark.parametrize("first", [0.0, 0.004])
def test_commands_whose_stamps_are_a_little_late_count_from_their_own_steps(paths, first):
    """Each would count from nearly a step later, and a healthy robot would have a delay that comes and goes."""
    given, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    goal = given.commands["goal"]
    late = np.r_[first, np.random.default_rng(0).uniform(0, 0.008, len(goal.time) - 1)]
    logged = replace(given, commands={"goal": replace(goal, time=goal.time + late)})
    assert np.array_equal(robot.measured(logged).actions, robot.measured(given).actions)


def test_a_robot_without_actuators_needs_no_commands(tmp_path):
    model, mapping = tmp_path / "arm.xml", tmp_path / "map.toml"
    model.write_text(re.sub("<actuator>.*</actuator>", "", ARM))
    mapping.write_text(re.sub(r"\[commands.goal\]\n.*\n", "", MAP).partition("[parameters.zero]")[0])
    falling = Recording({}, {"angle": Signal(0.02 * np.arange(20), np.linspace(0.0, 0.3, 20), "rad")})
    assert ModelRobot(model, mapping, threads=1).measured(falling).actions.shape == (19, 0)


def test_recordings_are_explained_once_and_held_out_ones_are_others(paths):
    given, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    for recordings, heldout in (([given, given], []), ([given], [given])):
        with pytest.raises(RecordingError, match=r"recording 1 and (recording 2|held-out recording 1) are the same"):
            diagnose(robot, recordings, heldout)
    with pytest.raises(RecordingError, match="no recording"):
        diagnose(robot, [])


GAIN = """
[settings.gain]
SOURCE
reference = 2
fields = ["actuator_gainprm[0]:motor"]
"""


def with_gain(paths, source):
    model, mapping = paths
    mapping.write_text(MAP + GAIN.replace("SOURCE", source))
    return ModelRobot(model, mapping, threads=1)


def test_settings_of_a_recording_scale_fields(paths):
    """Half the gain of a recording is half the gain of the model; one that changes with time does so from then on."""
    goals = np.full((40, 1), 0.4)
    given = recording(paths, [], 0)
    times, steps = given.commands["goal"].time, len(goals)
    one = with_gain(paths, 'metadata = "gain"')
    half = one.settings(replace(given, metadata={"gain": "1"}), steps)
    assert half.tolist() == [[0.5]] * steps
    changing = {**given.commands, "gain": Signal(times, np.where(times < 0.4 - 1e-6, 2.0, 1.0))}
    later = with_gain(paths, 'command = "gain"').settings(replace(given, commands=changing), steps)
    assert later.ravel().tolist() == [1.0] * 20 + [0.5] * 20
    nominal = np.array([[1.0, 1.0, 0.0]])
    plain, at_half, changed = (
        one.simulate(goals, nominal, [()], settings=s) for s in (np.ones_like(half), half, later)
    )
    assert np.array_equal(plain[:, :20], changed[:, :20])
    assert (plain[:, -1] > at_half[:, -1]).all()
    assert changed[0, -1, 0, 0] == pytest.approx(at_half[0, -1, 0, 0], rel=0.1)


@pytest.mark.parametrize("metadata", [{}, *({"gain": text} for text in ("large", "nan", "inf", "-1"))])
def test_a_recording_without_a_setting_is_refused(paths, metadata):
    given = recording(paths, [], 0)
    with pytest.raises(RecordingError, match=r"'gain' of the recording is .*; a number is needed"):
        with_gain(paths, 'metadata = "gain"').measured(replace(given, metadata=metadata))


def test_a_setting_that_is_negative_at_times_is_refused(paths):
    given = recording(paths, [], 0)
    times = given.commands["goal"].time
    changing = {**given.commands, "gain": Signal(times, np.where(times < 0.4, 1.0, -1.0))}
    with pytest.raises(RecordingError, match="'gain' is a setting"):
        with_gain(paths, 'command = "gain"').measured(replace(given, commands=changing))


ANGLE, TORQUE = 5e-4, 1e-2  # rad and N m, of the noise


FRICTION = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05})


SERVO = ARM.replace('kp="2" kv="0.05" forcerange="-1 1"', 'kp="200" kv="1"').replace('"0.005"', '"0.002"')


STIFF = SERVO.replace("</mujoco>", '<sensor><actuatorfrc name="gauge" actuator="motor"/></sensor></mujoco>')


BOTH = MAP + '[[signals]]\nname = "torque"\nsensors = ["gauge"]\nunit = "N m"\n'


@pytest.fixture
def robot_of(tmp_path):
    """Robots with a stiff servo, by their maps."""

    def robot(mapping: str = BOTH, shorter: int = 1) -> ModelRobot:
        (tmp_path / "arm.xml").write_text(STIFF)
        (tmp_path / "arm.toml").write_text(mapping)
        return ModelRobot(tmp_path / "arm.xml", tmp_path / "arm.toml", threads=1, shorter=shorter)

    return robot


def of_both(robot: ModelRobot, hidden: list[Effect], seed: int = 0, steps: int = 150) -> Recording:
    """Of a robot with other parameters, whose friction shows in the torque only: it moves the angle by 0.25 mrad."""
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(steps + 1)
    goals = sum(0.2 * np.sin(w * time[:-1] + p) for w, p in zip((0.9, 1.7, 2.3), rng.uniform(0, 6, 3), strict=True))
    (values,) = robot.simulate_all([drive(robot, goals[:, None])], TRUTH, [hidden])
    noise = rng.standard_normal((steps, 2)) * (ANGLE, TORQUE)
    angle, torque = (values[0] + noise).T
    angle = np.concatenate([goals[:1], angle])
    signals = {"angle": Signal(time, angle, "rad"), "torque": Signal(time[1:], torque, "N m")}
    return Recording({"goal": Signal(time[:-1], goals[:, None])}, signals)


def drive(robot: ModelRobot, goals: np.ndarray):
    """The drive of a robot that begins where its first goal is."""
    still = Signal(0.02 * np.arange(len(goals) + 1), np.full(len(goals) + 1, goals[0, 0]), "rad")
    return robot.measured(Recording({"goal": Signal(0.02 * np.arange(len(goals)), goals)}, {"angle": still})).drive


def test_what_shows_in_the_second_signal_only_is_named(robot_of):
    given = of_both(robot_of(shorter=2), [FRICTION])
    result = diagnose(robot_of(), [given])
    assert [(each.name, str(each.location)) for each in result.findings if each.is_best] == [
        ("coulomb_friction", "joint hinge")
    ]
    (friction,) = (each for each in result.findings[0].estimates if each.name == "friction")
    assert friction.value == pytest.approx(0.05, rel=0.1)
    angle, torque = result.signals
    assert (angle.noise, torque.noise) == pytest.approx((ANGLE, TORQUE), rel=0.2)
    assert torque.unit == "N m" and TORQUE < torque.after < 0.6 * torque.before
    assert "torque: RMSE" in summary(result)


def test_a_signal_that_no_recording_has_changes_nothing_and_is_said(robot_of):
    given = of_both(robot_of(), [])
    alone = Recording(given.commands, {"angle": given.signals["angle"]})
    plain, both = (
        explaining(each, ((inspected(alone, 0, each),), ()), DEFAULT)[0] for each in (robot_of(MAP), robot_of())
    )
    assert both.signals == plain.signals and both.shortened(2).signals == plain.signals
    assert [note for note in both.notes if note.startswith("torque is not explained")]
    points = [(np.array([0.3, -0.2, 0.1]), ()), (np.zeros(3), ())]
    rows = [unexplained(robot, (robot.measured(alone),), ANGLE).residuals(points) for robot in (plain, both)]
    assert np.array_equal(*rows)


def test_every_signal_has_its_own_noise_and_its_own_misfit(robot_of):
    robot = robot_of()
    problem = unexplained(robot, (robot.measured(of_both(robot, [])),), ANGLE, others=(TORQUE,))
    residual = problem.residuals([(np.zeros(3), ())])[0]
    angle, torque = (problem.split(residual, which)[0] for which in (0, 1))
    assert np.array_equal(problem.joined([[angle], [torque]]), residual)
    off = problem.split(problem.measured - problem.simulated(robot, [(np.zeros(3), ())])[0], 1)[0]
    assert torque == pytest.approx(off / ANGLE)  # scaled, so that one noise is that of all
    # but for what the noise of the sample that it begins at explains
    assert problem.left_of_each(residual)[1] == pytest.approx(TORQUE * np.sqrt(np.mean(torque**2)), rel=1e-3)
    dominated = problem.allowing(2 * ANGLE, 50 * TORQUE)
    assert dominated.misfit_dominated
    assert dominated.sigmas == (ANGLE, 50 * TORQUE) and dominated.sensors == (ANGLE, TORQUE)
    angle_then, torque_then = (dominated.split(residual * problem.factor_to(dominated), which)[0] for which in (0, 1))
    assert np.array_equal(angle_then, angle) and torque_then == pytest.approx(torque / 50)


def test_sensors_have_faults_of_their_own(robot_of):
    robot = robot_of()
    found = terms(robot)
    at = {(one.name, one.location) for one in found if one.location.kind == "sensor"}
    delays = [location for name, location in at if name == "sensor_delay"]
    assert {each.name for each in delays} == {"angle", "torque", EVERY}
    assert [each.name for each in delays if late(robot, "sensor_delay", each)] == [EVERY]
    bias = Effect("sensor_bias", Location("sensor", "torque", 0), {"x": 0.1, "y": 0.0, "z": 0.0})
    goals = 0.3 * np.ones((20, 1))
    (values,) = robot.simulate_all([drive(robot, goals)], TRUTH.repeat(2, axis=0), [[], [bias]])
    assert np.allclose(values[1] - values[0], [0.0, 0.1])
    assert robot.unit_at("signal", bias.location) == "N m"


def test_bad_signals_are_refused(robot_of):
    twice = '[[signals]]\nname = "angle"\njoints = ["hinge"]\nunit = "rad"\n'
    with pytest.raises(ModelError, match=r"\[\[signals\]\] has 'angle' twice"):
        robot_of(MAP + twice)
    with pytest.raises(ModelError, match=r"\[signals\] needs a name, a unit"):
        robot_of(MAP + '[[signals]]\nname = "torque"\n')
    robot = robot_of()
    given = of_both(robot, [])
    torque = given.signals["torque"]
    wrong = Recording(given.commands, {**given.signals, "torque": Signal(torque.time, torque.values, "N")})
    with pytest.raises(RecordingError, match="torque is in 'N', frame ''; expected are 'N m'"):
        diagnose(robot, [wrong])
    with pytest.raises(ValueError, match="TrunkReach-v0 has no signal 'warmth'; it has keypoints"):
        SuiteRobot("TrunkReach-v0", threads=1, signals=["warmth"])
    command = Diagnose((), Path("out"), model="arm.xml", map=Path("arm.toml"), signals=("torque",))
    with pytest.raises(ValueError, match="--signals is for --env"):
        command._robot()


def test_tensions_are_explained_where_they_are_asked_for():
    given = record("TrunkReach-v0", model="cable", steps=20, seed=1)
    alone, both = (SuiteRobot("TrunkReach-v0", threads=1, signals=names) for names in (None, ["tension"]))
    assert [(each.name, each.unit, each.shape) for each in both.others] == [("tension", "N", (8, 1))]
    assert both.shortened(2).others == both.accurate().others == both.others and alone.others == ()
    measured = both.measured(given)
    assert np.array_equal(measured.others[0][:, :, 0], given.signals["tension"].values[1:])
    nominal = np.array([[prior.nominal for prior in both.priors]])
    values, columns = (robot.simulate_all([measured.drive], nominal, [[]])[0] for robot in (alone, both))
    assert np.array_equal(columns[:, :, :63], values)
    assert np.allclose(columns[0, :, 63:], given.signals["tension"].values[1:], atol=0.05)


def test_of_a_walker_only_the_beginning_is_explained_and_that_is_said():
    """Its replays are slow: of 60 control steps, and not of all that an excitation needs."""
    robot = SuiteRobot("MultiGait-v0", threads=1)
    time, values = 0.6 * np.arange(201), np.zeros((201, 110, 3))
    commands = {"action": Signal(time[:-1], np.zeros((200, 3)))}
    about = {"env_id": "MultiGait-v0", "action": "continuous"}
    whole = Recording(commands, {"vertices": Signal(time, values, "m", "world")}, metadata=about)
    found = robot.measured(whole)
    assert found.values.shape == (60, 110, 3) and found.time[-1] == pytest.approx(36.0)
    assert found.notes == ("explained are the first 36 s of 120 s: replays of more take hours",)


def test_a_pushed_cube_is_explained_beside_the_trunk():
    """The same simulation leaves nothing of its pose, and a heavier cube shows in its own numbers."""
    robot = SuiteRobot("TrunkPush-v0", threads=1)
    given = record("TrunkPush-v0", "excitation", model="cable", steps=400, seed=1)
    problem = unexplained(robot, (robot.measured(given),), 5e-4, others=(5e-4, 5e-3))
    assert [each.name for each in robot.signals] == ["keypoints", "object_position", "object_quaternion"]
    heavy = Effect("payload", Location("body", "object"), {"mass": 0.2})
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    (values,) = robot.simulate_all([problem.recordings[0].drive], nominal.repeat(2, axis=0), [[], [heavy]])
    residual = problem.residuals([(np.zeros(len(robot.priors)), ())])[0]
    assert np.abs(residual).max() < 0.2
    change = np.abs(values[1] - values[0]).max(axis=0)
    assert change[63:66].max() > change[:63].max() and change[66:].max() > 1e-3
