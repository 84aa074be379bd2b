"""Recordings of the same commands before and after a change."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("scipy", reason="needs the infer extra")

from soro_bench.diagnosis.paired.alignment import aligned
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.paired.result import PairedResult
from soro_bench.diagnosis.render.paired import summary
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests import arm

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
        with pytest.raises(SystemExit, match="recording 1 before the change and recording 1 after the change are the"):
            call("diagnose", "--before", before, "--after", same, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    shown = call("diagnose", "--before", before, "--after", after, "--out", tmp_path / "out")
    assert shown.startswith("Changed") or "\nChanged" in shown
    assert "Changed" in call("report", tmp_path / "out/paired.json", "--out", tmp_path / "again")
    assert (tmp_path / "again/report.html").exists()
