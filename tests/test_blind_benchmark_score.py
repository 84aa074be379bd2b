"""Scores of diagnoses, on labels and reports written for the test; and what the diagnosis is compared with.

Calibration of stated probabilities by benchmarks/calibration.py.
"""

import hashlib

import numpy as np
import pytest

from benchmarks import calibration
from soro_bench.blind_benchmark import run as module
from soro_bench.blind_benchmark.ablations import Calibrated, Unrefined
from soro_bench.blind_benchmark.score import magnitude_errors, opened_labels, scored
from soro_bench.blind_benchmark.scorecard import ablation_rows, by_bic, markdown
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import write_json


def label(number, group="one", name="payload", category="inertia", kind="body", site="vertebra4", index=None):
    location = {"kind": kind, "name": site, **({} if index is None else {"index": index})}
    mass = {"mass": {"value": 0.1, "unit": "kg"}}
    effects = [] if group == "none" else [{"name": name, "class": category, "where": location, "parameters": mass}]
    change = {"train": 0.0 if group == "none" else 2.0, "task": 0.0 if group == "none" else 1.0}
    return {"id": f"case_{number:03d}", "group": group, "robot": "fine", "effects": effects, "change_mm": change,
            "noise": {"value": 5e-4, "unit": "m"}}  # fmt: skip


def hypothesis(names, location, misfit, unknowns):
    return {"names": names, "where": [location] * len(names), "excess": misfit, "unknowns": unknowns, "samples": 1000}


def report(name="payload", category="inertia", kind="body", site="vertebra4", chance=0.9, verdict="missing_physics"):
    location = None if name == "none" else {"kind": kind, "name": site}
    mass = {"mass": {"value": 0.11, "unit": "kg", "ci90": [0.09, 0.13]}}
    first = {"name": name, "class": category, "probability": chance, "where": location, "parameters": mass}
    rest = {"name": "unknown", "class": "unknown", "probability": 1 - chance, "where": None}
    fit = {"rmse_before": 6e-4, "rmse_after": 5e-4, "noise_floor": 5e-4}
    return {"effects": [first, rest], "verdict": verdict, "credible_set": [name],
            "classes": [{"class": category, "probability": chance}, {"class": "unknown", "probability": 1 - chance}],
            "hypotheses": [hypothesis([name] if location else [], location, 10.0, 6), hypothesis([], None, 100.0, 5)],
            "fit": {"train": fit, "parameters_only": 6e-4}, "unseen": fit | {"fve": 0.95}, "seconds": 50.0}  # fmt: skip


def values(labels, reports):
    card = scored(labels, {one["id"]: found for one, found in zip(labels, reports, strict=True)})
    return {gate["gate"]: gate["value"] for gate in card["gates"]}, card


def test_what_is_right_is_counted_and_what_is_wrong_is_listed():
    labels = [label(0), label(1), label(2), label(3, "none"), label(4, "none")]
    wrong = report("base_tilt", "static_one_sided", "model", "gravity")
    nothing = report("none", "none", verdict="none_detected")
    found, card = values(labels, [report(), report(), wrong, nothing, report()])
    assert found["first answer right"] == pytest.approx(2 / 3)
    assert found["false alarms"] == 0.5
    assert found["class right"] == pytest.approx(2 / 3)
    assert {"truth": "payload", "said": "base_tilt", "cases": 1} in card["confusion"]
    met = {gate["gate"]: gate["met"] for gate in card["gates"]}
    assert (met["detected"], met["false alarms"], met["first answer right"]) == (True, False, False)
    text = markdown(card)
    assert "MISSED" in text
    assert "| payload | 3 | 2 | 2 | 0 | 0 |" in text


@pytest.mark.parametrize(
    ("truth", "said", "right"),
    [
        ({"site": "vertebra4"}, {"site": "vertebra5"}, True),
        ({"site": "vertebra4"}, {"site": "vertebra6"}, False),
        ({"site": "left_finger_9"}, {"site": "left_finger_10"}, True),
        ({"site": "left_finger_2"}, {"site": "right_finger_2"}, False),
        ({"site": "elbow"}, {"site": "elbow"}, True),
        ({"site": "elbow"}, {"site": "wrist"}, False),
        ({"kind": "tendon", "site": "L2"}, {"kind": "actuator", "site": "L2"}, True),
        ({"kind": "tendon", "site": "L2"}, {"kind": "tendon", "site": "L1"}, False),
        ({"site": "*"}, {"site": "*"}, True),
        ({"site": "*"}, {"site": "vertebra4"}, False),
    ],
)
def test_places(truth, said, right):
    found, _ = values([label(0, **truth)], [report(**said)])
    assert found["of right names: place right"] == float(right)


def test_the_answer_of_a_report_that_detects_nothing_is_nothing():
    """Even where it takes another answer for more probable."""
    hidden = [label(0, "unknown", "unknown", "unknown"), label(1, "none")]
    unsure = report("unknown", "unknown", verdict="none_detected")
    _, card = values(hidden, [unsure, unsure])
    assert [row["first"] for row in card["cases"]] == [False, True]
    assert card["confusion"] == [{"truth": "unknown", "said": "none", "cases": 1}]


def test_places_of_cables_and_segments_are_counted_apart_from_those_that_cannot_be_wrong():
    labels = [label(0), label(1, name="actuator_saturation", kind="actuator", site="L2"),
              label(2, name="base_tilt", kind="model", site="gravity")]  # fmt: skip
    reports = [report(), report("actuator_saturation", kind="actuator", site="L1"),
               report("base_tilt", kind="model", site="gravity")]  # fmt: skip
    found, card = values(labels, reports)
    assert found["of right names: segment or keypoint within one"] == 1.0
    assert found["of right names: cable right"] == 0.0
    assert [gate["cases"] for gate in card["gates"] if gate["gate"].startswith("of right names: ")] == [3, 1, 1]


def test_a_fault_of_measurement_that_is_taken_for_physics_is_confused_and_not_covered():
    labels = [label(0), label(1, "measurement", "sensor_delay", "measurement", "sensor", "keypoints")]
    found, _ = values(labels, [report(), report()])
    assert found["physics and measurement confused"] == 0.5
    assert found["of those with a name for it: physics and measurement confused"] == 0.5
    assert found["truth in the 90 % set, at least"] == 0.5
    missed = values(labels, [report(), report("none", "none", verdict="none_detected")])[0]
    assert missed["physics and measurement confused"] == 0.5
    assert missed["of those with a name for it: physics and measurement confused"] == 0.0


def test_a_name_for_what_has_none_is_no_abstention():
    hidden = label(0, "unknown", "unknown", "unknown")
    assert values([hidden], [report()])[0]["unknown called unknown"] == 0.0
    assert (
        values([hidden], [report("unknown", "unknown", verdict="unknown_physics")])[0]["unknown called unknown"] == 1.0
    )


@pytest.mark.parametrize(("name", "own", "exact", "other", "found"), [
    ("stiffness_drift", "rate", 0.01, "rate", 0.6),  # 1/s and 1/min
    ("clock_skew", "skew", 0.002, "rate", -0.002),
    ("viscous_friction", "drag", 12.0, "damping", 12.0),
])  # fmt: skip
def test_magnitudes_are_compared_in_one_unit(name, own, exact, other, found):
    truth = {"name": name, "parameters": {own: {"value": exact}}}
    said = {"name": name, "parameters": {other: {"value": found, "ci90": sorted([0.9 * found, 1.1 * found])}}}
    assert magnitude_errors(truth, said) == (pytest.approx(0.0, abs=1e-12), True)


def test_no_alarm_of_forty_is_not_certain():
    """The exact upper end is 1 - 0.025 ** (1 / 40)."""
    labels = [label(i, "none") for i in range(40)]
    _, card = values(labels, [report("none", "none", verdict="none_detected")] * 40)
    (alarms,) = (gate for gate in card["gates"] if gate["gate"] == "false alarms")
    assert alarms["interval"] == pytest.approx([0.0, 1 - 0.025 ** (1 / 40)])


def test_a_gain_that_is_taken_for_none_is_all_wrong():
    truth = {"name": "actuator_gain", "parameters": {"gain": {"value": 0.85}}}
    said = {"name": "actuator_gain", "parameters": {"gain": {"value": 1.0, "ci90": [0.98, 1.02]}}}
    assert magnitude_errors(truth, said) == (pytest.approx(1.0), False)


def test_what_comes_after_nothing_is_not_among_the_first_three_if_it_is_the_fourth():
    late = report("none", "none", verdict="none_detected")
    late["effects"][1:] = [{**late["effects"][0], "name": name} for name in ("base_tilt", "backlash", "payload")]
    assert values([label(0)], [late])[0]["right among the first three"] == 0.0


def test_what_has_no_name_is_placed_only_where_it_is_called_unknown():
    hidden = label(0, "unknown", "unknown", "unknown", "body", "vertebra4")
    named, unnamed = report(), report("unknown", "unknown", verdict="unknown_physics")
    assert values([hidden], [named])[0]["unknown called so, at the right place"] == 0.0
    assert values([hidden], [unnamed])[0]["unknown called so, at the right place"] == 1.0


def test_a_probability_beyond_one_is_refused():
    with pytest.raises(ValueError, match="0 to 1"):
        values([label(0)], [report(chance=1.5)])


def test_magnitudes_are_compared():
    found, _ = values([label(0)], [report()])
    assert found["magnitude of what is named rightly: error, median"] == pytest.approx(0.1)
    assert found["magnitude of what is named rightly: in its 90 % interval"] == 1.0


def test_calibration_compares_what_is_stated_with_what_is_right():
    labels = [label(i) for i in range(4)]
    reports = [report(chance=0.75)] * 2 + [report("base_tilt", "static_one_sided", "model", "gravity", 0.75)] * 2
    assert values(labels, reports)[0]["expected calibration error"] == pytest.approx(0.25)


def test_probabilities_that_are_right_have_an_error_of_calibration_by_chance():
    """Of four cases at one half: none, one quarter or one half off with chances of 6, 8 and 2 in 16."""
    found = values([label(i) for i in range(4)], [report(chance=0.5)] * 4)[0]
    assert found["the same of probabilities that are right, by chance"] == pytest.approx(8 / 64 + 2 / 32, abs=0.03)


def test_parameters_that_hide_an_effect_are_seen():
    _, card = values([label(0)], [report()])
    assert card["cases"][0]["absorbed"] == pytest.approx(1 - 3 * (0.6**2 - 0.5**2) / 2.0**2)


def test_errors_are_compared_apart_for_the_two_kinds_of_robots():
    labels = [label(0), label(1) | {"robot": "flex"}, label(2, "none") | {"robot": "flex"}]
    same = report()
    same["unseen"] = same["unseen"] | {"rmse_after": 6e-4}
    found, _ = values(labels, [report(), same, report("none", "none", verdict="none_detected")])
    errors = [value for gate, value in found.items() if "error after over before" in gate]
    assert errors == pytest.approx([5 / 6, 1.0])


def test_labels_that_were_changed_after_the_commitment_are_refused(tmp_path):
    path = tmp_path / "sealed" / "labels.json"
    write_json(path, {"cases": [label(0)]})
    (tmp_path / "commitment.txt").write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")
    assert opened_labels(tmp_path) == [label(0)]
    write_json(path, {"cases": [label(1)]})
    with pytest.raises(ValueError, match="digest"):
        opened_labels(tmp_path)


def test_labels_are_opened_only_when_every_case_has_its_report(tmp_path, monkeypatch):
    """And a case that has one is not diagnosed again."""
    done = []

    def write_cases(folder, *_, **__):
        for i in (0, 1):
            (folder / f"case_{i:03d}").mkdir(parents=True, exist_ok=True)

    monkeypatch.setattr(module, "write_cases", write_cases)
    monkeypatch.setattr(module, "SuiteRobot", lambda env_id, threads: None)
    monkeypatch.setattr(module, "load", lambda path: path)
    monkeypatch.setattr(module, "run_diagnosis", lambda robot, train, heldout: done.append(train[0].parent.name))
    monkeypatch.setattr(module, "report_of", lambda found: report())
    monkeypatch.setattr(module, "build_result", lambda found: found)
    monkeypatch.setattr(module, "unseen", lambda found, recording: report()["unseen"])
    monkeypatch.setattr(module, "opened_labels", lambda folder: [label(i) for i in range(len(done))])
    (tmp_path / "reports").mkdir()
    text = module.run_blind_benchmark(tmp_path, 2, 0, others=0)
    assert done == ["case_000", "case_001"]
    assert "| first answer right | 2 | 1 |" in text
    (tmp_path / "reports" / "case_000.json").unlink()
    module.run_blind_benchmark(tmp_path, 2, 0, others=0)
    assert done == ["case_000", "case_001", "case_000"]
    (tmp_path / "reports" / "method.txt").write_text("of another version\n")
    with pytest.raises(ValueError, match="another version"):
        module.run_blind_benchmark(tmp_path, 2, 0, others=0)


def test_ablations_are_scored_on_the_cases_that_all_have():
    labels = [label(0), label(1), label(2, "none")]
    whole = {"case_000": report(), "case_001": report(), "case_002": report("none", "none", verdict="none_detected")}
    wrong = report("base_tilt", "static_one_sided", "model", "gravity")
    fit = {"unseen": {"rmse_before": 9e-4, "rmse_after": 8e-4, "noise_floor": 5e-4}}
    others = {"no_floor": {**whole, "case_000": wrong}, "network_only": dict.fromkeys(whole, fit)}
    rows = {row["variant"]: row for row in ablation_rows(labels, whole, others)}
    assert rows["the whole method"]["first answer right"] == 1.0
    assert rows["no_floor"]["first answer right"] == 0.5
    assert rows["network_only"]["first answer right"] is None
    assert rows["network_only"]["rms on unseen motion [mm]"] == pytest.approx(0.8)
    assert rows["the whole method"]["variance of unseen motion explained"] == pytest.approx(0.95)


def test_the_information_criterion_takes_what_fits_better_for_its_unknowns():
    assert by_bic(report())["verdict"] == "missing_physics"  # 90 nats for one more unknown
    small = report()
    small["hypotheses"][1]["excess"] = 11.0
    assert by_bic(small)["verdict"] == "none_detected"
    assert by_bic(report())["effects"][0]["probability"] == pytest.approx(1.0)


ENV_ID = "TrunkReach-v0"


class Still:
    """A robot whose simulation never moves."""

    priors = ()

    def simulate(self, actions, parameters, effects, start):
        return np.zeros((1, len(actions), 1, 1))


def measured(seed):
    """What follows from the commands: their sum, and the one of three steps before."""
    actions = np.repeat(np.random.default_rng(seed).uniform(-1, 1, (100, 2)), 4, axis=0)
    way = 0.1 * np.cumsum(actions[:, 0]) + np.roll(actions[:, 1], 3)
    return Measured(actions, 0.05 * np.arange(1, len(way) + 1), way[:, None, None], "angle", "rad")


def test_a_network_learns_what_follows_from_the_commands():
    pytest.importorskip("torch")
    from soro_bench.blind_benchmark.ablations import residual_rms

    before, after = residual_rms(Still(), np.zeros(0), measured(0), measured(1))
    assert before == pytest.approx(float(np.sqrt((measured(1).values ** 2).mean())))
    assert after < 0.6 * before
    assert residual_rms(Still(), np.zeros(0), measured(0), measured(1)) == (before, after)


def test_a_calibrated_robot_stays_where_it_was_fitted():
    x = np.array([0.5, -0.4, 0.2, 0.3, 0.1])
    free, fixed = SuiteRobot(ENV_ID, threads=1), Calibrated(ENV_ID, x, threads=1)
    assert list(fixed.parameters(np.full(5, 4.0)).values()) == pytest.approx(
        list(free.parameters(x).values()), rel=1e-5
    )
    assert all(finer.priors == fixed.priors for finer in fixed.refined())


def test_a_robot_without_more_accurate_models_has_no_numerical_floor():
    assert Unrefined(ENV_ID, threads=1).refined() == []


def answers(right, stated, margin=0.0, kind=1):
    count = len(right)
    parts = (np.full(count, value) if np.isscalar(value) else np.array(value) for value in (stated, kind, margin))
    stated, kind, margin = parts
    return calibration.Answers(np.arange(count) % 2, stated, np.array(right, bool), kind, margin)


def test_scores_of_probabilities_have_known_values():
    right = np.array([True, True, True, False])
    error, brier, log, miscalibration, resolution = calibration.figures(np.full(4, 0.5), right)
    assert (error, brier, log) == pytest.approx((0.25, 0.25, np.log(2)))
    assert (miscalibration, resolution) == pytest.approx((0.25 - 3 / 16, 0.0))
    assert calibration.figures(np.where(right, 0.9, 0.1), right)[4] == pytest.approx(3 / 16)  # all that there is


def test_a_map_pools_what_violates_its_order():
    steps = calibration.Steps.of(np.array([1.0, 2.0, 3.0, 4.0]), np.array([False, True, False, True]))
    assert steps.start.tolist() == [1, 2, 4] and steps.count.tolist() == [1, 2, 1]
    assert steps(np.array([0.0, 1.5, 2.5, 9.0])) == pytest.approx([1 / 3, 1 / 3, 1 / 2, 2 / 3])


def test_the_margin_is_to_the_best_hypothesis_without_the_law():
    hypotheses = [(["a", "b"], 900.0, 1000.0), (["a"], 800.0, 2000.0), (["c"], 500.0, 3000.0), ([], 1e9, 9e9)]
    assert calibration.margin("a", hypotheses) == pytest.approx(400.0 / 200.0)  # 100 nats and a tenth of the misfit
    assert calibration.margin("none", hypotheses) == 0.0 == calibration.margin("a", hypotheses[:2])


@pytest.mark.parametrize("name", ["isotonic", "temperature", "answer", "answer and margin", "logistic"])
def test_every_map_corrects_answers_that_are_too_sure(name):
    """Of cases that it has not seen; 70 % of answers with 0.97 were right."""
    given = answers([i // 2 % 10 < 7 for i in range(200)], 0.97)
    found = calibration.left_out(calibration.MAPS[name], given, given.source)
    assert calibration.calibration_error(given.stated, given.right) == pytest.approx(0.27)
    assert calibration.calibration_error(found, given.right) < 0.03


@pytest.mark.parametrize("name", ["answer and margin", "logistic"])
def test_the_margin_tells_answers_of_one_probability_apart(name):
    """Answers far ahead of others are right, and half of those that are not."""
    right = [i < 100 or i // 2 % 2 == 0 for i in range(200)]
    given = answers(right, 0.97, [200.0 if i < 100 else 1.0 for i in range(200)])
    found = calibration.left_out(calibration.MAPS[name], given, given.source)
    assert calibration.figures(found, given.right)[4] > 0.05 > calibration.figures(given.stated, given.right)[4]
    assert calibration.needed(found, given.stated, given.right) < 200


def test_answers_about_other_simulators_are_read_and_those_of_test_seeds_are_not(tmp_path):
    said = {"verdict": "discrepancy", "name": "payload", "probability": 0.8, "hypotheses": []}
    hidden = {"seed": 1000, "effects": [{"names": ["payload"]}]}
    for i, truth in enumerate((hidden, hidden | {"effects": []})):
        write_json(tmp_path / f"case_{i}" / "label.json", truth)
        write_json(tmp_path / f"case_{i}" / "answer.json", said)
    found = calibration.read_answers([tmp_path])
    assert found.right.tolist() == [True, False] and found.stated.tolist() == [0.8, 0.8]
    write_json(tmp_path / "case_1" / "label.json", hidden | {"seed": calibration.TEST_SEEDS})
    with pytest.raises(ValueError, match="case_1 has the seed 500000; seeds from 500000 on are for tests"):
        calibration.read_answers([tmp_path])
