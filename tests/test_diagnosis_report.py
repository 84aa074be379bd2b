"""A whole diagnosis, on a short recording and a few suspects: what it says and what it writes."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("rerun")
pytest.importorskip("matplotlib")

from soro_bench.blind_benchmark.unseen import unseen
from soro_bench.diagnosis import page, pipeline
from soro_bench.diagnosis.assembly.findings import NINETY, Finding, _condition, _lacking, findings
from soro_bench.diagnosis.candidates import term, terms
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.diagnosis.localisation.residual_maps import Regime, left_over, residual_map
from soro_bench.diagnosis.page import write_reports
from soro_bench.diagnosis.report import report_of, write_json_report
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.experiment_design import Proposal, motions
from soro_bench.diagnosis.verdict import _indistinguishable, verdict
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import Effect, Location, load_effects
from soro_bench.randomization import load
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.simulated import replay

STEPS = 60
FEW = ("payload", "backlash", "sensor_bias", "actuator_delay")
KEYS = {
    "schema",
    "verdict",
    "p_value",
    "alpha",
    "effects",
    "credible_set",
    "fit",
    "parameters",
    "detectable",
    "next_recording",
    "seconds",
}


@pytest.fixture(scope="module")
def robot():
    return SuiteRobot("TrunkReach-v0", threads=1)


def recording(robot, hidden, seed, strength=1.0):
    """What a robot with other parameters and hidden effects does under random actions, with noise."""
    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1, 1, (STEPS // 5, 8)), 5, axis=0)
    parameters = np.array([[prior.value(x) for prior, x in zip(robot.priors, (0.3, -0.4, 0.2, 0.3, 0.1), strict=True)]])
    (values,) = robot.simulate(actions.astype(np.float32), parameters, [hidden])
    values = values + 5e-4 * rng.standard_normal(values.shape)
    times = 0.05 * np.arange(STEPS + 1)
    return Recording(
        {"action": Signal(times[:-1], actions)},
        {"keypoints": Signal(times[1:], values, "m", "world")},
        {},
        {"env_id": "TrunkReach-v0", "action": "continuous", "note": "<script>alert(1)</script>"},
    )


def diagnosed(robot, monkeypatch, hidden):
    few = [one for one in terms(robot) if one.name in FEW]
    monkeypatch.setattr(pipeline, "suspects", lambda *_: few)
    finer = robot.refined()[:1]
    monkeypatch.setattr(robot, "refined", lambda: finer)
    monkeypatch.setattr("soro_bench.diagnosis.estimation.data_quality.noise", lambda values: 5e-4)
    return pipeline.diagnose(robot, [recording(robot, hidden, 0)], [recording(robot, hidden, 1)])


@pytest.fixture(scope="module")
def payload(robot):
    """A diagnosis of a trunk that carries something, and its recording."""
    hidden = [Effect("payload", Location("body", "vertebra7"), {"mass": 0.04})]
    with pytest.MonkeyPatch.context() as patch:
        return diagnosed(robot, patch, hidden), [recording(robot, hidden, 0)]


def test_a_hidden_payload_is_named_with_its_place_and_mass_and_the_held_out_fit_improves(robot, payload, tmp_path):
    found, given = payload
    text = write_reports(found, given, tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    first = report["effects"][0]
    assert report.keys() >= set(KEYS)
    assert (report["verdict"], first["name"], first["where"]["name"]) == ("missing_physics", "payload", "vertebra7")
    assert first["parameters"]["mass"]["value"] == pytest.approx(0.04, rel=0.2)
    assert report["fit"]["train"]["rmse_after"] < 0.7 * report["fit"]["train"]["rmse_before"]
    assert report["fit"]["heldout"]["rmse_after"] < report["fit"]["heldout"]["rmse_before"]
    assert sum(e["probability"] for e in report["effects"]) >= 1 - 1e-9
    assert "payload at body vertebra7" in text
    assert found.explanation.minimum  # of what could come beside it, which another one there could not
    assert not any(one.name == "payload" and one.location.name == "vertebra7" for one, _ in found.explanation.minimum)
    low, high = first["parameters"]["mass"]["ci90"]
    assert 0.5 * 0.04 < low < 0.04 < high < 2 * 0.04
    (effect,) = load_effects(tmp_path / "effects.json", ALL)
    assert effect.name == "payload"
    assert (report["model_patch"], report["model_patch_effects"]) == ("patched_model.xml", ["payload"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "patched_model.xml"))
    assert model.body("vertebra7").mass[0] > 1.5 * model.body("vertebra6").mass[0]
    posterior = load(tmp_path / "posterior.json")
    assert posterior.names == tuple(prior.name for prior in robot.priors)
    spread, found_of = np.sqrt(np.diag(posterior.cov)), report["parameters"]
    widths = [np.diff(found_of[name]["ci90"])[0] for name in posterior.names]
    np.testing.assert_allclose(2 * NINETY * spread, widths, rtol=0.02)  # of logarithms, in the report
    tells_together = posterior.cov / np.outer(spread, spread)  # E and nu make a neck as stiff as it is
    assert tells_together[posterior.names.index("poisson_ratio"), posterior.names.index("young_modulus")] < -0.8
    (only,) = report["rounds"]
    assert (only["on_top_of"], only["promised"][0]["name"]) == ([], "payload")
    assert only["fitted"][0]["effects"] == [{"name": "payload", "where": first["where"]}]
    page = (tmp_path / "report.html").read_text()
    assert "<script" not in page
    assert "payload vertebra7" in page
    assert "vertebra7" in page
    assert (tmp_path / "comparison.rrd").stat().st_size > 1000
    # three seconds do not tell the body from the next one for sure
    assert report["next_recording"]["separates"] == [["payload at body vertebra7", "payload at body vertebra8"]]
    assert (tmp_path / "next_actions.csv").exists()


def test_the_comparison_is_by_the_closer_model_and_both_its_robots_have_what_is_known(payload, tmp_path, monkeypatch):
    """The recording is one of cable, with little of the delay."""
    found, given = payload
    known, shown = Effect("actuator_delay", Location("actuator", "*"), {"delay": 1e-4}), []
    monkeypatch.setattr(found.robot, "known", (known,))

    def replayed(*of, effects):
        shown.append([e.name for e in effects])
        return replay(*of, effects=effects)

    monkeypatch.setattr(page, "replay", replayed)
    monkeypatch.setattr(
        page, "write_comparison", lambda *given: shown.append({k: r.model for k, r in given[3].items()})
    )
    page._write_comparison(found, given[0], tmp_path / "comparison.rrd")
    assert shown == 2 * [["actuator_delay"], ["actuator_delay", "payload"]] + [{"before": "cable", "after": "cable"}]


def test_the_comparison_takes_samples_as_they_come_and_asks_for_no_goal(payload, tmp_path, monkeypatch):
    found, (given,) = payload
    ranked_locations, shown = given.signals["keypoints"], []
    flat = replace(ranked_locations, values=ranked_locations.values.reshape(len(ranked_locations.time), -1))
    metadata = {**given.metadata, "goal": "the one on the left"}
    monkeypatch.setattr(page, "write_comparison", lambda *of: shown.append(of[0].signals["keypoints"].values))
    for each in (given, replace(given, signals={"keypoints": flat}, metadata=metadata)):
        page._write_comparison(found, each, tmp_path / "comparison.rrd")
    assert np.array_equal(*shown)


def test_what_is_left_has_gaps_where_nothing_was_measured(payload):
    problem, residual = payload[0].explanation.problem, payload[0].explanation.nominal.residual
    weight = problem.weight.reshape(STEPS, 21, 3).copy()
    weight[:20, 4], weight[20:25, 5] = 0.0, 0.0
    gaps = replace(problem, weight=weight.ravel())
    before, after = (residual_map(one, residual) for one in (problem, gaps))
    assert np.isnan(after[0, 4])
    assert np.isfinite(np.delete(after, 4, axis=1)).all()
    seen = left_over(problem, residual)[25:40, 5]
    assert after[1, 5] == pytest.approx(np.sqrt((seen**2).mean()))
    np.testing.assert_array_equal(before[:, :4], after[:, :4])


def test_parameters_far_from_their_nominal_values_are_pointed_out(payload):
    found, _ = payload
    assert "standard deviations of their priors" not in verdict(found)
    best = found.comparison.answers[0]
    far = replace(
        best, hypothesis=replace(best.hypothesis, x=np.where(np.arange(len(best.hypothesis.x)) == 1, -4.0, 0.1))
    )
    text = verdict(replace(found, comparison=replace(found.comparison, answers=(far,))))
    prior = found.robot.priors[1]
    assert f"of their priors: {prior.name} from {prior.nominal:.3g} to {prior.value(-4.0):.3g} (-4.0);" in text


@pytest.mark.parametrize("name, location, said", [
    ("sensor_delay", Location("sensor", "keypoints"), "tells it from actuator_delay at every actuator; clocks do"),
    ("actuator_delay", Location("actuator", "*"), "tells it from sensor_delay; clocks do"),
    ("actuator_delay", Location("actuator", "L0"), ""),
    ("payload", Location("body", "vertebra7"), ""),
])  # fmt: skip
def test_a_delay_of_everything_measured_is_no_other_than_one_of_everything_commanded(robot, name, location, said):
    found = _indistinguishable(robot, Effect(name, location, {}))
    assert said in found
    assert bool(said) == bool(found)


def test_what_has_no_name_gets_a_place_and_a_force_over_time(robot, payload, tmp_path):
    found, given = payload
    explanation = found.explanation
    probed = tuple(ranked_locations(explanation.problem, robot, explanation.nominal))
    comparison = replace(found.comparison, unknown=0.9)
    text = write_reports(replace(found, comparison=comparison, ranked_locations=probed), given, tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    force = report["residual_force"]
    assert report["verdict"] == "unknown_physics"
    assert force["where"] == report["places"][0]["where"]
    assert np.shape(force["values"]) == (len(force["start_s"]), len(force["components"]))
    assert force["rmse_after"] < report["fit"]["train"]["rmse_before"]
    assert "Without a law: what acts there is" in text
    assert "What has no name" in (tmp_path / "report.html").read_text()


def test_places_that_explain_nearly_as_much_are_told_too(robot, payload):
    found, _ = payload
    first, *_ = ranked_locations(found.explanation.problem, robot, found.explanation.nominal)
    others = [replace(first, location=Location("body", f"vertebra{k}"), gain=share * first.gain)
              for k, share in enumerate((0.99, 0.98, 0.97, 0.96, 0.5))]  # fmt: skip
    unknown = replace(found, comparison=replace(found.comparison, unknown=0.9), ranked_locations=(first, *others))
    named = "body vertebra0, body vertebra1, body vertebra2, 1 other place"
    assert f"So it may be elsewhere: forces at {named} explain nearly as much." in verdict(unknown)
    assert "elsewhere" not in verdict(replace(unknown, ranked_locations=(first, others[-1])))


def test_what_acts_at_no_single_place_is_still_called_unknown(payload):
    found, _ = payload
    text = verdict(replace(found, comparison=replace(found.comparison, unknown=0.9), ranked_locations=()))
    assert "Something acts that has no name in the catalogue" in text
    assert "No force at a single place explains any of it" in text
    assert "Without a law" not in text


def test_what_to_record_next_is_in_every_report_and_in_a_file_for_the_controller(robot, payload, tmp_path):
    motion = motions((2,), robot.channels, robot.control_timestep)[1]
    proposal = Proposal(motion, ("payload", "backlash"), (("payload", "backlash"),), 500.0)
    found, given = payload
    text = write_reports(replace(found, proposal=proposal), given, tmp_path)
    assert json.loads((tmp_path / "report.json").read_text())["next_recording"] == {
        "file": "next_actions.csv",
        "motion": "slow triangles of cable L2",
        "duration_s": 10.0,
        "separates": [["payload", "backlash"]],
        "evidence_nats": 500.0,
    }
    table = np.loadtxt(tmp_path / "next_actions.csv", delimiter=",", skiprows=1)
    assert table[:, 1:] == pytest.approx(motion.actions)
    assert table[:, 0] == pytest.approx(0.05 * np.arange(200))
    assert "record next_actions.csv (slow triangles of cable L2) to separate them" in text
    assert "slow triangles of cable L2" in (tmp_path / "report.html").read_text().split("What to record next")[1]
    write_json_report(replace(found, proposal=None), tmp_path)
    assert not (tmp_path / "next_actions.csv").exists()


def test_where_nothing_is_missing_it_says_so_and_what_would_have_shown(robot, monkeypatch):
    found = diagnosed(robot, monkeypatch, [])
    report = report_of(found)
    assert report["verdict"] == "none_detected"
    assert report["effects"][0]["name"] == "none"
    assert 0 < report["detectable"]["payload"]["minimum"] < 0.1
    assert report["invisible"] == []
    assert report["fit"]["patch"] == "none"
    assert "pressure_leak" in report["not_looked_for"] and "payload" not in report["not_looked_for"]
    minimum = tuple((one, 50.0 if one.name == "backlash" else x) for one, x in found.explanation.minimum)
    blind = replace(found, explanation=replace(found.explanation, minimum=minimum))
    assert report_of(blind)["invisible"] == ["backlash"]
    assert "backlash" not in report_of(blind)["detectable"]
    assert "It could hardly have shown: backlash." in verdict(blind)


def test_recordings_that_are_too_long_are_refused(robot, monkeypatch):
    monkeypatch.setattr(pipeline, "MOST_NUMBERS", 1000)
    with pytest.raises(RecordingError, match="at most 1000"):
        pipeline.diagnose(robot, [recording(robot, [], 0)])


def test_motion_that_was_not_seen_is_explained_by_the_patch(robot, payload):
    found, _ = payload
    hidden = [Effect("payload", Location("body", "vertebra7"), {"mass": 0.04})]
    after = unseen(found, recording(robot, hidden, 2))
    assert after["rmse_after"] < 0.8 * after["rmse_before"]  # numerical error and all
    assert after["fve"] > 0.5  # 3 s leave the parameters open


def test_names_of_a_strangers_model_are_shown_and_not_executed():
    location = {"kind": "body", "name": "<script>alert(1)</script>"}
    effect = {
        "probability": 1.0,
        "name": "payload",
        "where": location,
        "parameters": {},
        "evidence": ["<b>"],
        "against": [],
    }
    parameters = {"<i>": {"value": 1.0, "ci90": [0.0, 2.0], "unit": "<u>", "prior_tension_sd": 0.0}}
    text = page._effects_table({"effects": [effect]}) + page._parameters_table({"parameters": parameters})
    assert not any(tag in text for tag in ("<script", "<b>", "<i>", "<u>"))
    assert "&lt;script&gt;alert(1)" in text


def test_outliers_alone_are_a_fault_of_the_measurement(robot, monkeypatch):
    def with_outliers(robot, hidden, seed, own=recording):
        given = own(robot, hidden, seed)
        given.signals["keypoints"].values[[10, 30, 50], [3, 12, 20]] += 0.05
        return given

    monkeypatch.setattr(f"{__name__}.recording", with_outliers)
    found = diagnosed(robot, monkeypatch, [])
    report = report_of(found)
    assert report["verdict"] == "measurement_fault"
    assert report["effects"][0]["name"] == "outliers"
    assert report["effects"][0]["parameters"]["share"]["value"] == pytest.approx(3 / (60 * 21))
    assert "a fault of the measurement, not of the robot" in verdict(found)


def test_the_same_seed_gives_the_same_report_with_one_thread_or_two(robot, monkeypatch):
    hidden = [term(robot, "backlash", Location("actuator", "L2")).effect(np.array([0.3]))]
    robots = (robot, SuiteRobot("TrunkReach-v0", threads=2))
    first, second = (report_of(diagnosed(each, monkeypatch, hidden)) for each in robots)
    assert {**first, "seconds": 0} == {**second, "seconds": 0}


def test_a_condition_that_fills_nearly_all_the_time_is_not_given_as_when_an_effect_acts():
    effect = Effect("coulomb_friction", Location("tendon", "L0"), {"force": 1.0})
    told = [Regime("just after reversals", 0.2, 0.9), Regime("while it moves on, fast", 0.8, 0.1)]
    assert (
        _condition(effect, told, True)
        == "90 % of what it explains is just after reversals of tendon L0, 20 % of the time"
    )
    silent = [Regime("just after reversals", 0.99, 1.0), Regime("while it rests", 0.01, 0.0)]
    assert _condition(effect, silent, True) == "neither commands nor the clock tell when it acts"
    late = [*silent, Regime("early", 0.5, 0.1), Regime("late", 0.5, 0.9)]
    assert _condition(effect, late, True).startswith("90 % of what it explains is in the second half")


def test_when_an_effect_of_several_acts_is_what_its_answer_loses_without_it(robot, payload):
    found, _ = payload
    problem, best = found.explanation.problem, found.best.hypothesis
    other = term(robot, "backlash", Location("actuator", "L2"))
    x, both = np.append(best.x, other.simulated), (*best.terms, other)
    whole = replace(best, x=x, terms=both, residual=problem.residuals([(x, both)])[0])
    answer = replace(found.best, hypothesis=whole)
    lacking = _lacking(found, Finding(other, other.effect(other.simulated), answer, 1.0))
    np.testing.assert_array_equal(lacking.residual, best.residual)
    assert _lacking(found, findings(found)[0]) is found.explanation.nominal


def test_a_patch_that_no_recording_was_held_out_for_is_untested(payload):
    found, _ = payload
    answers = tuple(replace(answer, heldout=None) for answer in found.comparison.answers)
    alone = replace(found, comparison=replace(found.comparison, answers=answers))
    assert report_of(found)["fit"]["patch"] == "accepted"
    assert report_of(alone)["fit"]["patch"] == "untested"
    assert "No recording was held out" in verdict(alone)
