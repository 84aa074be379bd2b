"""Recordings of the same commands before and after a change, and recordings that a diagnosis asks for."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("scipy", reason="needs the infer extra")

from soro_bench.diagnosis.active import DroppedFile, SimulatedAnswer, diagnose_actively
from soro_bench.diagnosis.paired.alignment import aligned
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.paired.explanation import probabilities
from soro_bench.diagnosis.paired.problem import PairedProblem, Point
from soro_bench.diagnosis.paired.result import PairedResult
from soro_bench.diagnosis.render.paired import summary
from soro_bench.diagnosis.result_parts import NextRecording
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.known import Known
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.simulated import record
from tests import arm
from tests.arm import ARM, MAP, SIGMA, TRUTH, assert_same, example, says

RATE = 50.0  # Hz
POINTS = 3


def command(time: np.ndarray) -> np.ndarray:
    """Two smooth commands without a period."""
    return np.stack([np.sin(2.1 * time) + 0.5 * np.sin(5.3 * time), np.cos(1.7 * time)], axis=1)


def recording(
    seed: int = 0, late: float = 0.0, clock: float = 0.0, rate: float = RATE, memory: float = 0.0, grown: float = 1.0
) -> Recording:
    """Of a robot without a model, for 20 s: three points follow the commands with a delay ``late`` [s].

    Args:
        clock: s, by which its clock is ahead. memory: of the noise, from one sample to the next. grown: of the motion.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 20.0, 1.0 / rate)
    noise = 1e-3 * rng.standard_normal((len(time), POINTS, 3))
    for k in range(1, len(time)):
        noise[k] = memory * noise[k - 1] + np.sqrt(1.0 - memory**2) * noise[k]
    one, two = grown * command(time - 0.1 - late).T
    values = 0.02 * np.stack([np.stack([p * one, p * two, one * two], axis=1) for p in (1, 2, 3)], axis=1)
    signal = Signal(time + clock, values + noise, "m", "world")
    return Recording({"motors": Signal(time + clock, command(time), "rad")}, {"markers": signal})


def test_clocks_that_are_apart_and_sampled_differently_are_put_on_one() -> None:
    pair = aligned(recording(), recording(clock=0.1373, rate=40.0))
    assert pair.commands.shift == pytest.approx(0.1373, abs=1e-3)
    assert pair.commands.rms < 1e-3
    assert pair.after.commands["motors"].time is pair.before.commands["motors"].time


def without_first_command(given: Recording, share: float = 1.0) -> Recording:
    """A recording whose first number of the command was lost, and whose second one is only a share of what it was."""
    sent = given.commands["motors"]
    values = np.stack([np.full(len(sent.time), np.nan), share * sent.values[:, 1]], axis=1)
    return replace(given, commands={"motors": replace(sent, values=values)})


@pytest.mark.filterwarnings("error")
def test_a_command_that_was_lost_hides_neither_another_one_that_differs_nor_the_clock() -> None:
    for lost in (recording(), without_first_command(recording())):
        with pytest.raises(RecordingError, match=r"'motors' \(number 1\) differs by"):
            compare([lost], [without_first_command(recording(1), share=0.5)])
    pair = aligned(without_first_command(recording()), without_first_command(recording(1, clock=3.2, rate=47.0)))
    assert pair.commands.shift == pytest.approx(3.2, abs=2e-3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("after", [0.0, 1.0])
def test_a_signal_that_stands_still_without_noise_differs_where_it_stands_elsewhere(
    after: float, tmp_path: Path
) -> None:
    def with_gripper(seed: int, value: float) -> Recording:
        whole = recording(seed)
        time = whole.signals["markers"].time
        return replace(whole, signals={**whole.signals, "gripper": Signal(time, np.full(len(time), value))})

    result = compare([with_gripper(0, 0.0)], [with_gripper(1, after)])
    gripper = next(each for each in result.signals if each.name == "gripper")
    assert gripper.verdict == ("changed" if after else "same") and gripper.starts[0].differs == bool(after)
    result.save(tmp_path / "paired.json")
    assert PairedResult.load(tmp_path / "paired.json").to_json() == result.to_json()


def test_other_commands_are_refused_in_one_line() -> None:
    other = recording()
    values = other.commands["motors"].values.copy()
    values[500:, 1] *= -1
    other = replace(other, commands={"motors": Signal(other.commands["motors"].time, values, "rad")})
    with pytest.raises(RecordingError, match=r"the commands are not the same: 'motors' \(number 1\).*after 10 s"):
        compare([recording()], [other])


def test_noise_that_remembers_is_no_change() -> None:
    found = [compare([recording(k, memory=0.8)], [recording(1000 + k, memory=0.8)]).signals[0] for k in range(30)]
    assert sum(each.verdict == "changed" for each in found) <= 1


def test_a_summary_says_what_its_p_value_is_of() -> None:
    """A payload differs far beyond noise, and may be neither offset nor gain nor delay."""
    said = summary(compare([recording()], [recording(1)]))
    assert "an offset, gain or delay: p" in " ".join(said.split())


def test_a_delay_is_measured_without_a_model_and_a_lost_marker_said() -> None:
    after = recording(1, late=0.02)
    values = after.signals["markers"].values.copy()
    values[:, 1] = np.nan
    after = replace(after, signals={"markers": replace(after.signals["markers"], values=values)})
    result = compare([recording()], [after])
    (signal,) = result.signals
    delay = next(each for each in signal.looks_like if each.name == "delay").estimate
    assert signal.verdict == "changed" and signal.p_value < 1e-3
    assert delay.value == pytest.approx(0.02, abs=2e-3)
    assert signal.points[1].present == 0.0 and signal.points[0].present == 1.0
    assert "lost in one recording" in summary(result) and "20" in summary(result)
    assert PairedResult.from_json(result.to_json()).signals[0].points[0].rms == pytest.approx(signal.points[0].rms)


def test_runs_of_the_same_robot_say_what_a_difference_means() -> None:
    found = compare([recording(0), recording(1, grown=1.05)], [recording(2, grown=1.02)]).signals[0]
    assert found.run_to_run is not None and found.run_to_run > found.rms
    assert found.verdict == "differs"
    assert compare([recording(0)], [recording(2, grown=1.05)]).signals[0].verdict == "changed"


def test_a_run_in_another_unit_says_nothing_of_how_far_runs_differ() -> None:
    again = recording(1)
    values = 1e3 * again.signals["markers"].values
    again = replace(again, signals={"markers": replace(again.signals["markers"], values=values, unit="mm")})
    found = compare([recording(0), again], [recording(2, grown=1.05)]).signals[0]
    assert found.run_to_run is None and found.verdict == "changed"


@pytest.mark.parametrize("back", [False, True])
def test_a_payload_is_named_with_its_mass_and_a_lost_one_is_negative(paths: tuple[Path, Path], back: bool) -> None:
    load = Effect("payload", Location("body", "arm"), {"mass": 0.02})
    sides = [_noisy(arm.recording(paths, hidden, 0, 0.0), k) for k, hidden in enumerate([(), (load,)])]
    first, second = sides[::-1] if back else sides
    result = compare([first], [second], ModelRobot(*paths, threads=1))
    explanation = result.explanation
    assert explanation is not None
    (change,) = explanation.changes
    mass = change.estimates[0]
    assert change.kind == "payload" and change.probability > 0.9
    assert mass.value == pytest.approx(-0.02 if back else 0.02, rel=0.2)
    assert mass.low is not None and mass.high is not None and mass.low < mass.value < mass.high
    assert f"{'-' if back else ''}2" in summary(result).splitlines()[0]


def _noisy(found: Recording, seed: int) -> Recording:
    """With noise of a sensor."""
    angle = found.signals["angle"]
    noise = arm.SIGMA * np.random.default_rng(seed).standard_normal(angle.values.shape)
    return replace(found, signals={"angle": replace(angle, values=angle.values + noise)})


PENDULUM = """<body name="bob" pos="0 1 0"><joint name="swing" axis="0 1 0" damping="0.002"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/></body></worldbody>"""
SWING = '[[signals]]\nname = "swing"\njoints = ["swing"]\nunit = "rad"\n'


def test_a_change_that_another_signal_than_the_first_shows_is_named(paths: tuple[Path, Path]) -> None:
    paths[0].write_text(ARM.replace("</worldbody>", PENDULUM))
    paths[1].write_text(MAP.replace("[initial]", SWING + "[initial]"))
    robot, goals = ModelRobot(*paths, threads=1), 0.5 * command(0.02 * np.arange(200))[:, :1]

    def moved(seed: int, hidden: Sequence[Effect]) -> Recording:
        drive = Drive(goals, np.zeros((1, 1)))
        ((values,),) = robot.simulate_all([drive], TRUTH, [hidden])
        noisy = values + SIGMA * np.random.default_rng(seed).standard_normal(values.shape)
        times = 0.02 * np.arange(len(goals) + 1)
        signals = {name: Signal(times[1:], noisy[:, i], "rad") for i, name in enumerate(("angle", "swing"))}
        return Recording({"goal": Signal(times[:-1], goals, "rad")}, signals)

    changed = Effect("viscous_friction", Location("joint", "swing"), {"damping": 0.002})
    result = compare([moved(0, ())], [moved(1, (changed,))], robot)
    explanation = result.explanation
    assert explanation is not None and explanation.signal == "swing" and explanation.nothing < 0.01
    (change,) = explanation.changes
    assert (change.kind, change.location, change.probability > 0.9) == ("damping", changed.location, True)
    assert change.estimates[0].value == pytest.approx(0.002, rel=0.1)
    assert result.signals[0].verdict == "same" and summary(result).startswith("Changed")


def test_the_command_asks_for_both_sides_and_writes_what_report_shows_again(
    call: Callable[..., str], tmp_path: Path
) -> None:
    before, after = tmp_path / "a.parquet", tmp_path / "b.parquet"
    save(recording(), before)
    save(recording(1, late=0.02), after)
    with pytest.raises(SystemExit, match="--after"):
        call("diagnose", "--before", before, "--out", tmp_path / "none")
    for same in (before, tmp_path / "copy.parquet"):
        same.write_bytes(before.read_bytes())
        said = rf"recording 1 before the change \({before}\) and recording 1 after the change \({same}\) are the same"
        with pytest.raises(SystemExit, match=said):
            call("diagnose", "--before", before, "--after", same, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    shown = call("diagnose", "--before", before, "--after", after, "--out", tmp_path / "out")
    assert shown.startswith("Changed") or "\nChanged" in shown
    assert "Changed" in call("report", tmp_path / "out/paired.json", "--out", tmp_path / "again")
    assert (tmp_path / "again/report.html").exists()


LAG = Effect("actuator_lag", Location("actuator", "motor"), {"time_constant": 0.03})
WANTED = NextRecording("slow loops", 0.4, ("a", "b"), (), 1.0, 0.05, tuple(8 * [0.1 * k] for k in range(8)))


def test_a_slow_motion_leaves_delay_and_lag_and_the_one_that_is_asked_for_settles_it(paths):
    """Delay and lag of 0.03 s differ in fast motion, and in slow motion less than the noise."""
    real = ModelRobot(*paths, threads=1, shorter=2)

    def measured(actions, seed, noise=SIGMA):
        start, goals = np.full((1, 1), 0.2), np.asarray(actions, float)
        (values,) = real.simulate(goals, TRUTH, [[LAG]], start)
        values = np.concatenate([start[None], values])[:, 0, 0]
        times = 0.02 * np.arange(len(values))
        noisy = values + noise * np.random.default_rng(seed).standard_normal(len(values))
        return Recording({"goal": Signal(times[:-1], goals)}, {"angle": Signal(times, noisy, "rad")})

    slow = 0.4 * np.sin(0.4 * np.pi * 0.02 * np.arange(60))[:, None]
    known = dict(zip(("inertia", "damping", "zero"), TRUTH[0], strict=True))
    robot, first = ModelRobot(*paths, threads=1), measured(slow, 0, 10 * SIGMA)
    settings = replace(DEFAULT, experiment_design=replace(DEFAULT.experiment_design, duration=3.0, hold=1.0))
    result, rounds = diagnose_actively(
        robot, [first], lambda wanted, k: measured(wanted.actions, k), 3, settings=settings, known=known
    )
    assert rounds[0].probability < 0.9 and rounds[0].proposed.startswith("fast")
    assert [each.recordings for each in rounds] == [1, 2] and rounds[-1].proposed == ""
    assert result.hypotheses[0].names == ("actuator_lag",) and rounds[-1].probability > 0.9


def test_a_file_in_the_folder_answers_at_once_or_when_it_comes(tmp_path):
    said = []
    source = DroppedFile(tmp_path, said.append, ("cable L0",))
    save(example(), tmp_path / "next_1.parquet")
    assert_same(source(WANTED, 1), example())
    assert not said and (tmp_path / "next_1.csv").read_text().startswith("time,cable L0")
    (tmp_path / "next_2.parquet").write_bytes(b"PAR1 cut")
    later = threading.Timer(1.0, save, (example(), tmp_path / "next_2.parquet"))
    later.start()
    assert_same(source(WANTED, 2), load(tmp_path / "next_2.parquet"))
    assert "next_2.parquet" in said[-1] and "write it again" in said[-1]


def test_a_simulated_robot_answers_as_the_first_recording_was_made(tmp_path):
    """Same parameters, model and noise; with effects it moves otherwise."""
    first = record("TrunkReach-v0", "random", "cable", params={"trunk_mass": 0.3}, steps=4, noise=5e-4)
    effects = tmp_path / "effects.json"
    effects.write_text('{"schema": "soro-bench/effects/2", "effects": []}')
    answer = SimulatedAnswer(first, effects)(WANTED, 1)
    assert answer.parameters == first.parameters and answer.metadata["noise"] == "0.0005"
    np.testing.assert_allclose(answer.commands["action"].values, np.array(WANTED.actions), atol=1e-7)


@pytest.mark.parametrize("changed, said", [
    ({"env_id": None}, "no 'env_id'"),
    ({"action": "discrete"}, "discrete"),
    ({"noise": "nan"}, "0 or more is needed"),
])  # fmt: skip
def test_other_recordings_are_refused_in_one_line(tmp_path, changed, said):
    about = {"env_id": "TrunkReach-v0", "model": "cable", "action": "continuous", "noise": "0.0"} | changed
    given = replace(example(), metadata={name: value for name, value in about.items() if value})
    effects = tmp_path / "effects.json"
    effects.write_text('{"schema": "soro-bench/effects/2", "effects": []}')
    with pytest.raises(ValueError, match=says("first recording", said)):
        SimulatedAnswer(given, effects)


def test_effects_that_are_none_are_refused_before_the_first_diagnosis(tmp_path):
    about = {"env_id": "TrunkReach-v0", "model": "cable", "action": "continuous", "noise": "0.0"}
    (tmp_path / "effects.json").write_text('{"effects": ')
    with pytest.raises(ValueError, match=says("effects.json", "no effects file")):
        SimulatedAnswer(replace(example(), metadata=about), tmp_path / "effects.json")


def test_an_excitation_of_a_model_moves_what_is_commanded_within_its_range(paths):
    """An actuator without a range needs a recording that says how far it may go."""
    with pytest.raises(ValueError, match=says("motor has no ctrlrange", "--recording")):
        ModelRobot(*paths, threads=1).excited(duration=10.0)
    paths[0].write_text(ARM.replace('name="motor"', 'name="motor" ctrlrange="-0.5 0.5"'))
    controls = ModelRobot(*paths, threads=1).excited(duration=10.0)
    assert controls.shape == (500, 1) and 0.1 < np.abs(controls).max() <= 0.5


def test_an_excitation_begins_at_the_control_of_the_keyframe(paths):
    model = ARM.replace('name="motor"', 'name="motor" ctrlrange="-1 1"')
    paths[0].write_text(
        model.replace("</mujoco>", '<keyframe><key name="bent" qpos="0.4" ctrl="0.4"/></keyframe></mujoco>')
    )
    paths[1].write_text(MAP.replace("[initial]", '[initial]\nkeyframe = "bent"'))
    controls = ModelRobot(*paths, threads=1).excited(duration=10.0)
    assert (controls[0], controls[-1]) == (pytest.approx(0.4), pytest.approx(0.4))


def test_a_pair_is_replayed_where_every_parameter_is_known(paths):
    nominal = {"inertia": 1.0, "damping": 1.0, "zero": 0.0}
    robot = ModelRobot(*paths, threads=1).knowing(Known(nominal))
    measured = robot.measured(arm.recording(paths, (), 0))
    problem = PairedProblem(robot, (measured,), (measured,), ())
    assert problem.bounds.shape == (2, 0)
    before, change = problem.simulated([Point(np.zeros(0), np.zeros(0), ())])
    (expected,) = robot.simulate_all([measured.drive], np.zeros((1, 0)), [()])
    assert np.array_equal(before[0], expected.ravel()) and not change.any()


def test_a_change_that_explains_a_little_is_chance_where_hundreds_are_possible():
    counts = np.array([0, 1, 2])
    one, many = (probabilities(np.array([0.0, 4.0, 5.0]), counts, possible) for possible in (1, 300))
    assert one.argmax() == 2 and many.argmax() == 0
    assert many.sum() == pytest.approx(1.0)
    assert probabilities(np.array([0.0, 400.0, 402.0]), counts, 300).argmax() == 1
