"""Studies of real robots, with an arm of one joint in their place."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from soro_bench.diagnosis import study as module
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison
from soro_bench.diagnosis.study import STUDIES, Part, Study, errors, load_study, results, run_study
from tests.arm import ARM, MAP, recording


def test_errors_of_known_residuals():
    """3 mm and 4 mm beside, always: no error without the mean; a point that was not seen does not count."""
    residual = np.tile([[0.003, 0.0, 0.004]], (5, 1, 1))
    seen = np.ones((5, 1, 3), bool)
    seen[-1] = False
    residual[-1] = 1.0
    found = errors(residual, seen)
    assert found["mean_absolute"] == pytest.approx(0.007 / 3)
    assert found["rms"] == pytest.approx(0.005)
    assert found["rms_without_mean"] == pytest.approx(0.0, abs=1e-12)


@pytest.fixture
def study(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "map.toml").write_text(MAP)
    files = tmp_path / "arm.xml", tmp_path / "map.toml"
    given, other, third = (recording(files, [], seed) for seed in (0, 1, 2))
    parts = (
        Part("first", "some motion", (given,), (other,), None, (third,)),
        Part("again", "once more", (given,), (), "first"),
    )
    return Study("arm", tmp_path / "arm.xml", tmp_path / "map.toml", parts)


def test_a_study_writes_reports_summaries_and_a_table_and_goes_on_where_it_was(study, tmp_path, monkeypatch, call):
    first = run_study(study, tmp_path / "out", threads=1)
    assert [(s["part"], s["answers"][0]["effects"]) for s in first] == [("first", []), ("again", [])]
    assert first[0]["parameters"]["heldout"]["mean_absolute"] == pytest.approx(4e-4, rel=0.2)
    assert (tmp_path / "out" / "again" / "report.html").exists()
    assert first[0]["answers"][0]["unseen"]["mean_absolute"] == pytest.approx(4e-4, rel=0.2)
    assert results(first).count("\n") == 5
    # the second part begins where the first one ended
    assert first[1]["nominal"]["train"]["mean_absolute"] < 0.3 * first[0]["nominal"]["train"]["mean_absolute"]
    asked = []
    own = module.run_diagnosis
    monkeypatch.setattr(module, "run_diagnosis", lambda *arguments: asked.append(1) or own(*arguments))
    (tmp_path / "out" / "again" / "summary.json").unlink()
    again = run_study(study, tmp_path / "out", threads=1)
    assert len(asked) == 1
    with pytest.raises(ValueError, match="results of seed 0, not 1"):
        run_study(study, tmp_path / "out", seed=1, threads=1)
    with monkeypatch.context() as other, pytest.raises(ValueError, match=r"results of method .*, not newer;"):
        other.setattr(module, "METHOD", "newer")
        run_study(study, tmp_path / "out", threads=1)
    study.map.write_text(MAP + "# another")
    with pytest.raises(ValueError, match=r"results of inputs "):
        run_study(study, tmp_path / "out", threads=1)
    study.map.write_text(MAP)
    monkeypatch.setattr(module, "load_study", lambda name, data: study)
    assert first[1]["verdict"] in call("study", "arm", "--out", tmp_path / "out")  # all is there
    assert (tmp_path / "out" / "results.md").read_text() == results(again) + "\n"
    for summary in (*first, *again):
        summary.pop("seconds")
    assert json.dumps(again) == json.dumps(first)


def test_a_summary_begins_with_the_answer_that_its_report_is_of(study, monkeypatch):
    """Which is not the most probable one where an effect is likelier whatever comes with it."""
    monkeypatch.setattr(module, "errors_of", lambda *_: {})
    monkeypatch.setattr(Hypothesis, "log_evidence", lambda *_: 0.0)
    monkeypatch.setattr(
        Hypothesis, "effects", lambda h, _: [SimpleNamespace(to_json=lambda s=s: s.name) for s in h.terms]
    )
    nominal = Hypothesis((), np.zeros(3), np.zeros(1), 0.0, np.zeros((3, 1)), np.zeros((0, 1)))

    def answer(probability, *names):
        terms = tuple(SimpleNamespace(name=name, location="hinge") for name in names)
        return Answer(replace(nominal, terms=terms), probability, 0.0, None, None, 0.0)

    answers = (answer(0.4, "payload"), answer(0.3, "backlash", "compliance"), answer(0.27, "backlash"))
    robot = SimpleNamespace(measured=lambda _: None, priors=[None] * 3, unit="rad")
    problem = SimpleNamespace(robot=robot, parameters=3, sensor=1e-3)
    explanation = SimpleNamespace(problem=problem, nominal=nominal)
    found = SimpleNamespace(explanation=explanation, comparison=Comparison(answers, 0.03, 0.0), seconds=1.0)
    summary = module._summary(study, study.parts[1], found, "", 0)
    assert [each["effects"] for each in summary["answers"]] == [["backlash", "compliance"], ["payload"], ["backlash"]]


def test_an_unknown_study_and_missing_recordings_are_named(tmp_path):
    with pytest.raises(ValueError, match="unknown study 'moon'; there are opencr_tdcr, "):
        load_study("moon", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no v4_train.csv in .*opencr_tdcr; soro-bench data"):
        load_study("opencr_tdcr", tmp_path)


def test_a_part_has_its_recordings_to_explain_to_hold_out_and_never_to_see(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_recordings", lambda folder, usual, entries: tuple(e["files"] for e in entries))
    (part,) = load_study("bam_servo", tmp_path).parts
    assert [len(files) for files in (part.train, part.heldout, part.unseen)] == [2, 2, 2]
    assert "kp200_sin_sin" in part.unseen[0] and "kp200_lift" in part.heldout[0] and "kp100" in part.train[0]


@pytest.mark.parametrize("name", STUDIES)
def test_files_of_a_study_are_there(name):
    import tomllib

    from soro_bench.assets import asset_path

    table = tomllib.loads(asset_path(f"studies/{name}.toml").read_text())
    assert all(Path(asset_path(f"mjcf/{table[key]}")).is_file() for key in ("model", "map", "import"))


def test_what_has_no_name_comes_first_in_the_table_only_where_no_effect_is_likelier():
    """Whatever comes with it: two answers share an effect here."""
    errors = {"train": {"mean_absolute": 1.0, "rms": 1.0, "rms_without_mean": 1.0}}
    location = {"kind": "joint", "name": "hinge"}
    common, other = ({"name": name, "where": location} for name in ("viscous_friction", "backlash"))
    answers = [{"effects": [common], "probability": 0.3, **errors},
               {"effects": [common, other], "probability": 0.25, **errors}]  # fmt: skip
    summary = {"study": "arm", "part": "first", "answers": answers, "nominal": errors, "parameters": errors,
               "known": [], "noise": 1e-3, "unit": "rad"}  # fmt: skip
    shared, nameless = (results([summary | {"unknown": unknown}]).splitlines()[2] for unknown in (0.4, 0.6))
    assert shared.split(" | ")[5] == "viscous_friction at hinge (0.30)"
    assert nameless.split(" | ")[5] == "outside the catalogue (0.60)"
