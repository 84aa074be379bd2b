"""Active diagnosis: recordings that are asked for, and who gives them."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.active import DroppedFile, SimulatedAnswer, diagnose_actively
from soro_bench.diagnosis.result_parts import NextRecording
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.simulated import record
from tests.arm import ARM, SIGMA, TRUTH, assert_same, example, says

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
    source = DroppedFile(tmp_path, said.append)
    save(example(), tmp_path / "next_1.parquet")
    assert_same(source(WANTED, 1), example())
    assert not said and (tmp_path / "next_1.csv").read_text().startswith("time,action.0")
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
