"""Which recordings the diagnosis of any model takes, and which it refuses."""

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.estimation.unit_check import check_unit_and_sign
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import ARM, MAP, recording


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


def test_an_error_says_which_recording_it_is_of(paths):
    good, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    bad = replace(recording(paths, [], 1), commands={"goal": Signal(np.array([0.0, 1.0]), np.array([[0.0], [np.nan]]))})
    with pytest.raises(RecordingError, match=r"^recording 2: the command 'goal' has missing numbers, first at 1 s"):
        diagnose(robot, [good, bad])
    with pytest.raises(RecordingError, match=r"^held-out recording 1: the command 'goal'"):
        diagnose(robot, [good], [bad])


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


def test_a_robot_without_actuators_needs_no_commands(tmp_path):
    model, mapping = tmp_path / "arm.xml", tmp_path / "map.toml"
    model.write_text(re.sub("<actuator>.*</actuator>", "", ARM))
    mapping.write_text(re.sub(r"\[commands.goal\]\n.*\n", "", MAP).partition("[parameters.zero]")[0])
    falling = Recording({}, {"angle": Signal(0.02 * np.arange(20), np.linspace(0.0, 0.3, 20), "rad")})
    assert ModelRobot(model, mapping, threads=1).measured(falling).actions.shape == (19, 0)


def test_recordings_are_explained_once_and_held_out_ones_are_others(paths):
    given, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    for recordings, heldout in (([given, given], []), ([given], [given])):
        with pytest.raises(RecordingError, match="two of the recordings are the same"):
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
