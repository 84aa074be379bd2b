"""Inference of physical parameters from recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from soro_bench.campaign.inputs import inferred
from soro_bench.effects.effect import Effect, Location
from soro_bench.inference import rf_dropo
from soro_bench.inference.guard import guarded, independent, rms
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import Replay
from soro_bench.inference.report import rounded, warnings
from soro_bench.randomization import load
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import RecordingError, Signal
from soro_bench.recording.simulated import record

STEPS = 15


@pytest.fixture(scope="module")
def reach():
    """A short recording of the cheap trunk with parameters that nothing here knows of."""
    truth = {"trunk_mass": 0.31, "poisson_ratio": 0.43, "young_modulus": 3.9e6}
    return record("TrunkReach-v0", model="cable", params=truth, steps=STEPS, full_state=True), truth


def test_rf_dropo_recovers_the_parameters_of_a_simulation(reach):
    recording, truth = reach
    posterior = infer("rf-dropo", Replay(recording, threads=1))
    for name, value in truth.items():
        assert posterior.estimate[name] == pytest.approx(value, rel=1e-3)


def test_the_recordings_own_parameters_are_not_looked_at(reach):
    recording, _ = reach
    lying = replace(recording, parameters={"trunk_mass": 1.0})
    points = np.array([[0.3, 0.45, 4e6]])
    np.testing.assert_array_equal(
        Replay(recording, threads=1).simulate(points), Replay(lying, threads=1).simulate(points)
    )


def test_an_inference_that_was_killed_ends_with_the_same_bytes(reach, tmp_path):
    """Half-way, in the last of many results, and when all of them were there."""
    replay = Replay(reach[0], noise=5e-4, threads=1)
    infer("rf-dropo", replay, tmp_path / "whole.log", starts=1).save(tmp_path / "whole.json")
    log = (tmp_path / "whole.log").read_bytes()
    for kept in (len(log) // 2, len(log) - 9, len(log)):
        (tmp_path / "cut.log").write_bytes(log[:kept])
        infer("rf-dropo", replay, tmp_path / "cut.log", starts=1).save(tmp_path / "cut.json")
        assert (tmp_path / "cut.json").read_bytes() == (tmp_path / "whole.json").read_bytes()
        assert (tmp_path / "cut.log").read_bytes() == log


def test_simulations_of_a_bayes_sim_that_was_killed_are_not_repeated(reach, tmp_path):
    replay = Replay(reach[0], names=("trunk_mass",), threads=1)
    infer("bayes-sim", replay, tmp_path / "whole.log", simulations=70).save(tmp_path / "whole.json")
    title, first, *_ = (tmp_path / "whole.log").read_bytes().splitlines(keepends=True)
    (tmp_path / "cut.log").write_bytes(title + first)
    infer("bayes-sim", replay, tmp_path / "cut.log", simulations=70).save(tmp_path / "cut.json")
    for suffix in ("json", "log"):
        assert (tmp_path / f"cut.{suffix}").read_bytes() == (tmp_path / f"whole.{suffix}").read_bytes()


def test_simulations_of_bayes_sim_are_as_noisy_as_the_recording(reach, tmp_path):
    summaries = []
    for noise in (0.0, 5e-4):
        replay = Replay(reach[0], names=("trunk_mass",), noise=noise, threads=1)
        infer("bayes-sim", replay, tmp_path / f"{noise}.log", simulations=64)
        entry = json.loads((tmp_path / f"{noise}.log").read_text().splitlines()[1])
        summaries.append(np.reshape(entry["values"], entry["shape"]))
    signals = replay.measured.shape[1]
    means = (summaries[1] - summaries[0])[:, -2 * signals : -signals]  # over time, of what noise adds
    assert (means / replay.sensor_noise).std() == pytest.approx(1 / np.sqrt(replay.steps), rel=0.2)


def test_the_log_of_another_inference_is_refused(reach, tmp_path):
    found = infer("sysid", Replay(reach[0], threads=1), tmp_path / "log", max_iterations=1, starts=1)
    again = infer("sysid", Replay(reach[0], threads=1), tmp_path / "log", starts=1, max_iterations=1)
    assert again.estimate == found.estimate  # in another order the settings are the same
    with pytest.raises(ValueError, match="log of another inference"):
        infer("sysid", Replay(reach[0], threads=1), tmp_path / "log", seed=1)


def test_training_reads_a_posterior_as_a_distribution(reach, tmp_path):
    names = ("trunk_mass", "poisson_ratio")
    infer("sysid", Replay(reach[0], names, threads=1), max_iterations=3, starts=1).save(tmp_path / "posterior.json")
    assert load(tmp_path / "posterior.json").names == names


def test_least_squares_recovers_parameters_near_the_nominal_ones():
    # from farther away it can end where a cable falls slack at the wrong moment (docs/explanation/inference.md)
    truth = {"trunk_mass": 0.41, "poisson_ratio": 0.448, "young_modulus": 4.45e6}
    recording = record("TrunkReach-v0", model="cable", params=truth, steps=STEPS)
    posterior = infer("sysid", Replay(recording, threads=1))
    assert posterior.estimate == pytest.approx(truth, rel=1e-3)


def test_least_squares_are_as_unsure_as_the_search_box_of_what_a_recording_says_nothing_about():
    """Friction, before anything is touched."""
    recording = record("TrunkPush-v0", model="cable", steps=3)
    replay = Replay(recording, ("trunk_mass", "friction"), noise=5e-4, threads=1)
    distribution = infer("sysid", replay, max_iterations=3, starts=1).distribution
    low, high = replay.parameters[1].search
    assert np.sqrt(distribution.cov[1, 1]) == pytest.approx(rf_dropo.LARGEST_STD * (high - low), rel=0.05)


def test_droid_recovers_the_only_parameter(reach):
    recording, truth = reach
    known = {name: value for name, value in truth.items() if name != "trunk_mass"}
    posterior = infer("droid", Replay(recording, known=known, threads=1))
    assert posterior.estimate["trunk_mass"] == pytest.approx(truth["trunk_mass"], rel=1e-3)


def test_dropo_restarts_every_step_from_the_recorded_state(reach):
    recording, truth = reach
    replay = Replay(recording, restart=True, threads=1)
    at_truth = replay.residuals(np.array([list(truth.values())]))
    assert np.abs(at_truth).max() < 1e-9
    # a step from the recorded state goes less astray than all steps from the first
    wrong = np.array([[0.2, 0.43, 3.9e6]])
    assert np.abs(replay.residuals(wrong)[0, -1]).max() < np.abs(Replay(recording).residuals(wrong)[0, -1]).max()


def test_a_known_parameter_is_not_inferred(reach):
    recording, truth = reach
    posterior = infer("rf-dropo", Replay(recording, known={"young_modulus": truth["young_modulus"]}, threads=1))
    assert set(posterior.estimate) == {"trunk_mass", "poisson_ratio"}
    assert posterior.estimate["trunk_mass"] == pytest.approx(truth["trunk_mass"], rel=1e-3)


def test_a_missing_sample_says_nothing(reach):
    recording, _ = reach
    signal = recording.signals["keypoints"]
    values = signal.values.copy()
    values[5, 3] = np.nan
    patchy = replace(recording, signals={**recording.signals, "keypoints": Signal(signal.time, values, "m", "world")})
    residual = Replay(patchy, threads=1).residuals(np.array([[0.3, 0.45, 4e6]]))[0]
    assert (residual[4, 9:12] == 0).all() and (residual[4, 12:] != 0).any()


def test_the_fit_is_over_what_was_measured(reach):
    recording, _ = reach
    signal = recording.signals["keypoints"]
    values = signal.values.copy()
    values[1::2] = np.nan
    patchy = replace(recording, signals={"keypoints": Signal(signal.time, values, "m", "world")})
    replay = Replay(patchy, known={"young_modulus": 8e6, "poisson_ratio": 0.45}, threads=1)
    posterior = infer("sysid", replay, starts=1)
    residual = replay.residuals(np.array([[posterior.estimate["trunk_mass"]]]))[0]
    left = residual[~np.isnan(replay.measured)]
    assert posterior.fit["keypoints"] == pytest.approx(np.sqrt((left**2).mean()), rel=1e-6)


def test_what_lies_between_two_samples_is_no_measurement(reach):
    recording, _ = reach
    given = recording.signals["keypoints"]
    half = Signal(given.time[1::2], given.values[1::2], "m", "world")
    replay = Replay(replace(recording, signals={"keypoints": half}), threads=1)
    assert np.isnan(replay.measured).all(axis=1).sum() == STEPS // 2


@pytest.mark.parametrize("name", ["object_quaternion", "link_quaternion"])
def test_a_quaternion_and_its_negative_are_the_same_orientation(name):
    recording = record("TrunkPush-v0", model="cable", steps=4)
    turned = recording.signals[name]
    signs = np.array([1, -1, -1, 1, -1]).reshape(5, *[1] * (turned.values.ndim - 1))
    jumping = replace(turned, values=turned.values * signs)
    same = replace(recording, signals={**recording.signals, name: jumping})
    given = (Replay(one, threads=1, also=(name,)).measured for one in (recording, same))
    assert np.array_equal(*given)


def test_what_a_fit_leaves_widens_what_is_said_to_be_determined(reach):
    recording, _ = reach
    far = Replay(recording, known={"young_modulus": 8e6, "poisson_ratio": 0.45}, threads=1)
    near = Replay(recording, known={"young_modulus": 3.9e6, "poisson_ratio": 0.43}, threads=1)
    widths = [infer("sysid", replay, starts=1).combinations[0].relative_std for replay in (far, near)]
    assert widths[0] > 10 * widths[1]


@pytest.fixture(scope="module")
def weak():
    """The cheap trunk with a cable that moves half as far as it is told, measured with noise."""
    gain = Effect("actuator_gain", Location("actuator", "L1"), {"gain": 0.5})
    return record("TrunkReach-v0", model="cable", steps=STEPS, noise=5e-4, effects=[gain])


@pytest.mark.parametrize(
    ("method", "settings"),
    [("rf-dropo", {"starts": 2}), ("sysid", {"max_iterations": 5, "starts": 2}), ("bayes-sim", {"simulations": 64})],
)
def test_a_model_that_does_not_explain_a_recording_is_said_and_widens_intervals(weak, method, settings):
    replay = Replay(weak, ("trunk_mass",), noise=5e-4, threads=1)
    posterior = infer(method, replay, **settings)
    assert posterior.guard.unexplained == ("keypoints",)
    assert posterior.guard.widening > posterior.fit["keypoints"] / 5e-4 > 3
    assert posterior.guard.nominal["keypoints"] == pytest.approx(rms(replay, replay.nominal_residual)["keypoints"])
    (said,) = [text for text in warnings(posterior, replay) if "does not explain" in text]
    assert "mm of keypoints" in said and "soro-bench diagnose" in said


def test_of_a_model_that_explains_a_recording_nothing_is_said(reach):
    recording, truth = reach
    replay = Replay(recording, ("trunk_mass",), {name: truth[name] for name in tuple(truth)[1:]}, threads=1)
    posterior = infer("sysid", replay, starts=1)
    assert (posterior.guard.unexplained, posterior.guard.widening, warnings(posterior, replay)) == ((), 1.0, [])


def test_an_estimate_that_is_worse_than_nominal_parameters_or_at_a_bound_is_said():
    recording = record("TrunkReach-v0", model="cable", steps=STEPS)  # with nominal parameters
    replay = Replay(recording, ("trunk_mass",), threads=1)
    point = np.array([[1.0]])
    found = guarded(replay, replay.residuals(point)[0], np.zeros((STEPS, 63, 1)), point[0])
    assert (found.worse, found.at_bounds) == (("keypoints",), {"trunk_mass": "upper"})


@pytest.mark.parametrize(("alike", "expected"), [("nothing", 40 * 6), ("columns", 40), ("steps", 1), ("all", 1)])
def test_samples_that_are_alike_count_once(alike, expected):
    shape = {"nothing": (40, 6), "columns": (40, 1), "steps": (1, 6), "all": (1, 1)}[alike]
    rng = np.random.default_rng(0)
    seen = np.ones((40, 6), bool)
    found = [independent(np.broadcast_to(rng.standard_normal(shape), (40, 6)), seen) for _ in range(50)]
    assert np.mean(found) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("every", [2, 4])
def test_a_slow_sensor_sees_as_many_independent_samples_of_slow_motion(every):
    slow = np.sin(2 * np.pi * np.arange(400) / 80)[:, None]
    seen = (np.arange(400) % every == 0)[:, None]
    whole = independent(slow, np.ones_like(seen))
    assert independent(np.where(seen, slow, 0.0), seen) == pytest.approx(whole, rel=0.1)


def test_of_a_diverging_fit_the_file_says_no_error(reach, tmp_path):
    posterior = infer("sysid", Replay(reach[0], ("trunk_mass",), threads=1), starts=1, max_iterations=1)
    replace(posterior, fit={"keypoints": np.nan}).save(tmp_path / "posterior.json")
    assert json.loads((tmp_path / "posterior.json").read_text())["fit"] == {"keypoints": None}


def test_variances_are_widened_once(weak):
    """By the misfit over the noise, and by the samples that are alike; not by the misfit alone besides."""
    replay = Replay(weak, ("trunk_mass",), noise=5e-4, threads=1)
    posterior = infer("sysid", replay, max_iterations=5, starts=2)
    (low, high), spread = replay.parameters[0].search, float(np.sqrt(posterior.distribution.cov[0, 0]))
    assert spread <= rf_dropo.LARGEST_STD * (high - low)


@pytest.mark.parametrize(
    ("value", "deviation", "text"),
    [(0.4187654, 0.0054, "0.4188"), (6.998e6, 1.1e6, "7e+06"), (4.5e6, 12.0, "4.5e+06"), (0.4187654, 0.0, "0.4188")],
)
def test_an_estimate_has_the_digits_that_are_known(value, deviation, text):
    assert rounded(value, deviation) == text


def test_least_squares_start_again_where_they_end_above_the_noise():
    recording = record("TrunkReach-v0", model="cable", steps=STEPS, noise=5e-4, seed=1)
    replay = Replay(recording, ("trunk_mass", "poisson_ratio"), noise=5e-4, threads=1)
    once, often = (infer("sysid", replay, start=0.99, max_iterations=1, starts=count) for count in (1, 2))
    assert often.fit["keypoints"] < once.fit["keypoints"]
    assert often.replays > once.replays


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise": -1.0}, "noise -1.0: a standard"),
        ({"noise": np.nan}, "noise nan"),
        ({"seed": -1}, "seed -1: 0 or more"),
        ({"simulations": 3}, "3 simulations; at least 50"),
        ({"method": "rf-dropo", "optimizer": "sample"}, "optimizer 'sample'; allowed are linearised and sampled"),
        ({"method": "rf-dropo", "starts": 0}, "0 starts; at least 1"),
        ({"method": "rf-dropo", "optimizer": "sampled", "samples": 1}, "1 samples; at least 2"),
        ({"method": "droid", "iterations": 0}, "0 iterations; at least 1"),
        ({"method": "droid", "popsize": 1}, "1 popsize; at least 2"),
        ({"method": "sysid", "start": 3.0}, "start 3.0: a share"),
    ],
)
def test_settings_without_sense_are_named(reach, settings, message):
    with pytest.raises(ValueError, match=message):
        infer(settings.pop("method", "bayes-sim"), Replay(reach[0], noise=settings.pop("noise", 0.0)), **settings)


def test_actions_that_the_environment_refuses_are_not_replayed(reach):
    commands = {name: Signal(s.time, s.values + 50) for name, s in reach[0].commands.items()}
    with pytest.raises(RecordingError, match=r"finite numbers from -1\.0 to 1\.0"):
        Replay(replace(reach[0], commands=commands), threads=1)


def test_another_environment_is_another_replay():
    """Whose parameters that are not inferred have other nominal values."""
    recording = record("TrunkPush-v0", model="cable", steps=2)
    lift = replace(recording, metadata={**recording.metadata, "env_id": "TrunkLift-v0"})
    found = [Replay(one, ["trunk_mass"], threads=1).fingerprint() for one in (recording, lift)]
    assert found[0] != found[1]


@pytest.mark.parametrize(("method", "restart"), [("dropo", False), ("rf-dropo", True)])
def test_dropo_restarts_and_no_other_method_does(reach, method, restart):
    with pytest.raises(ValueError, match="dropo needs a replay that restarts"):
        infer(method, Replay(reach[0], restart=restart, threads=1))


def test_bayes_sim_says_that_one_step_is_too_short():
    with pytest.raises(ValueError, match="a recording of 1 step"):
        infer("bayes-sim", Replay(record("TrunkReach-v0", model="cable", steps=1), threads=1))


def test_bayes_sim_says_when_too_many_simulations_diverge(reach, monkeypatch):
    replay = Replay(reach[0], threads=1)
    monkeypatch.setattr(replay, "_measure", lambda ids: np.full((len(ids), replay.measured.shape[1]), np.nan))
    with pytest.raises(ValueError, match="64 of 64 simulations diverged; bayes-sim needs 50"):
        infer("bayes-sim", replay, simulations=64)


def test_the_posterior_of_bayes_sim_narrows_around_the_truth():
    from soro_bench.inference import bayes_sim

    rng = np.random.default_rng(0)
    points = rng.random((300, 1))
    summaries = np.concatenate([points + 0.02 * rng.standard_normal((300, 1)), rng.random((300, 2))], axis=1)
    for features in bayes_sim.FEATURES:
        drawn = bayes_sim.train(points, summaries, features).sample(np.array([0.7, 0.5, 0.5]), 500, 0)
        assert drawn.mean() == pytest.approx(0.7, abs=0.1) and drawn.std() < 0.15


def test_a_network_with_nothing_in_the_search_box_is_an_error_and_no_endless_search():
    import torch

    from soro_bench.inference import bayes_sim

    class Outside:
        def sample(self, shape, **_):
            return torch.full((*shape, 2), 1.5)

    estimator = bayes_sim.Estimator(Outside(), 2, np.zeros(3), np.ones(3))
    with pytest.raises(ValueError, match=r"0 of 10000 samples .* more simulations"):
        estimator.sample(np.zeros(3), 10, 0)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"names": ("mass",)}, "unknown parameter 'mass'"),
        ({"names": ("trunk_mass",), "known": {"trunk_mass": 0.4}}, "trunk_mass cannot be both known and inferred"),
        ({"known": {"trunk_mass": 9.0}}, "trunk_mass = 9.0 is outside"),
        ({"known": {"trunk_mass": 0.4, "young_modulus": 4e6, "poisson_ratio": 0.45}}, "nothing to infer"),
        ({"model": "steel"}, "unknown model 'steel'"),
        ({"names": ("trunk_mass", "trunk_mass")}, "trunk_mass cannot be inferred twice"),
    ],
)
def test_bad_requests_are_named(reach, change, message):
    with pytest.raises(ValueError, match=message):
        Replay(reach[0], **change)


def test_tensions_tell_masses_and_stiffness_apart():
    """Scaled together they leave the motion of a cable robot nearly as it is."""
    recording = record("TrunkReach-v0", model="cable", steps=8)
    names, spread = ("trunk_mass", "young_modulus"), []
    for also in (), ("tension",):
        replay = Replay(recording, names, noise=5e-4, threads=1, also=also)
        spread.append(infer("sysid", replay).combinations[-1].relative_std)
    assert spread[1] < 0.5 * spread[0]
    with pytest.raises(ValueError, match="cannot infer from 'colour'; TrunkReach-v0 has keypoints"):
        Replay(recording, names, also=("colour",))


def test_a_recording_without_what_is_needed_is_refused(reach):
    recording, _ = reach
    with pytest.raises(RecordingError, match=r"no keypoints; it has tension"):
        Replay(replace(recording, signals={"tension": recording.signals["tension"]}))
    given = recording.signals["keypoints"]
    for wrong in (replace(given, frame="camera"), replace(given, values=given.values[:, :20])):
        with pytest.raises(
            RecordingError, match=r"keypoints is in 'm', frame .*; expected are 'm', 'world', \(21, 3\)"
        ):
            Replay(replace(recording, signals={"keypoints": wrong}))
    without = {name: signal for name, signal in recording.signals.items() if not name.startswith("state.")}
    with pytest.raises(RecordingError, match="--full-state"):
        Replay(replace(recording, signals=without), restart=True)
    with pytest.raises(RecordingError, match="keypoints has no sample at the end of any control step"):
        Replay(replace(recording, signals={"keypoints": replace(given, values=np.full_like(given.values, np.nan))}))
    with pytest.raises(ValueError, match=r"unknown method .magic.*rf-dropo"):
        infer("magic", Replay(recording))


def test_a_recorded_state_that_cannot_be_gone_on_from_is_refused(reach):
    recording, _ = reach
    given = recording.signals["state.qvel"]
    gap = given.values.copy()
    gap[3] = np.nan
    without = {name: signal for name, signal in recording.signals.items() if name != "state.qvel"}
    for signals, said in (
        (without, "no state.qvel"),
        ({**without, "state.qvel": replace(given, values=given.values[:, :-1])}, "was it another model"),
        ({**without, "state.qvel": replace(given, values=gap)}, "no value before some of the actions"),
    ):
        with pytest.raises(RecordingError, match=said):
            Replay(replace(recording, signals=signals), restart=True, threads=1)


def test_a_posterior_holds_what_was_known(reach, tmp_path):
    known = {"poisson_ratio": 0.44, "young_modulus": 4e6}
    for method in ("rf-dropo", "sysid"):
        infer(method, Replay(reach[0], known=known, threads=1), starts=1).save(tmp_path / "posterior.json")
        sample = load(tmp_path / "posterior.json").sample(np.random.default_rng(0))
        assert sample.keys() == {"trunk_mass", *known} and sample["young_modulus"] == pytest.approx(4e6)


def test_a_baseline_infers_once_and_refuses_another_recording(reach, tmp_path, monkeypatch):
    save(reach[0], tmp_path / "reach.parquet")
    known = {"poisson_ratio": 0.43, "young_modulus": 3.9e6}
    method = inferred("rf-dropo", tmp_path / "reach.parquet", known)
    first = method.distribution("TrunkReach-v0", 0, tmp_path)
    monkeypatch.setattr("soro_bench.campaign.inputs.infer", None)
    assert method.distribution("TrunkReach-v0", 0, tmp_path).to_dict() == first.to_dict()
    with pytest.raises(ValueError, match="inferred from another recording, model or known values"):
        inferred("rf-dropo", tmp_path / "reach.parquet").distribution("TrunkReach-v0", 0, tmp_path)
    with pytest.raises(ValueError, match="a recording of TrunkReach-v0, not of TrunkPush-v0"):
        method.distribution("TrunkPush-v0", 0, tmp_path / "push")
