"""Entries of the diagnosis track."""

import hashlib
from pathlib import Path

import pytest

pytest.importorskip("jsonschema", reason="needs the board extra")

from soro_bench.blind_benchmark import score
from soro_bench.commands.blind_benchmark import BlindBenchmark
from soro_bench.files import write_json
from soro_bench.leaderboard import diagnosis_entry
from soro_bench.leaderboard.diagnosis_entry import Release
from soro_bench.leaderboard.verify import verify_diagnosis, verify_release
from tests.entries import edit
from tests.test_bad_input import says
from tests.test_blind_benchmark_score import label, report


def _set_of_cases(folder, labels):
    path = folder / "cases" / "sealed" / "labels.json"
    write_json(path, {"seed": 7, "cases": labels})
    (folder / "cases" / "commitment.txt").write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")


def test_a_diagnosis_is_scored_again_and_what_was_edited_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(score, "BOOTSTRAP", 50)
    labels = [label(0), label(1), label(2, "none")]
    wrong = report("base_tilt", "static_one_sided", "model", "gravity")
    reports = {"case_000": report(), "case_001": wrong, "case_002": report("none", "none", verdict="none_detected")}
    _set_of_cases(tmp_path, labels)
    for name, content in reports.items():
        write_json(tmp_path / "reports" / f"{name}.json", content)
    path, cases = tmp_path / "entry.json", tmp_path / "cases"
    diagnosis_entry.write_entry(path, "ours", "guessing", cases, {**score.scored(labels, reports), "ablations": []})
    assert diagnosis_entry.read_entry(path)["set"] | {"commitment": ""} == {
        "seed": 7, "count": 3, "nulls": 1, "commitment": ""
    }  # fmt: skip
    assert set(verify_diagnosis(path, cases, tmp_path / "reports").values()) == {"same"}
    edit(path, lambda entry: entry["gates"][2].update(value=1.0, met=True))
    found = verify_diagnosis(path, cases, tmp_path / "reports")
    assert found["gates"].startswith("differs") and found["confusion"] == "same"
    write_json(tmp_path / "reports" / "case_001.json", wrong | {"unseen": None})
    with pytest.raises(ValueError, match=says("case_001.json", "no errors on it")):
        verify_diagnosis(path, cases, tmp_path / "reports")
    (tmp_path / "reports" / "case_001.json").write_text('{"effects": []}')
    with pytest.raises(ValueError, match=says("case_001.json", "cannot be scored")):
        verify_diagnosis(path, cases, tmp_path / "reports")
    edit(path, lambda entry: entry["ablations"].append({"variant": "invented", "cases": 3}))
    write_json(tmp_path / "reports" / "case_001.json", wrong)
    assert verify_diagnosis(path, cases, tmp_path / "reports")["ablations"].startswith("not verified")
    (tmp_path / "reports" / "case_001.json").unlink()
    with pytest.raises(ValueError, match=says("case_001.json", "missing; every case needs its report")):
        verify_diagnosis(path, cases, tmp_path / "reports")


def test_a_release_in_one_file_is_scored_as_its_reports_are(tmp_path, monkeypatch):
    monkeypatch.setattr(score, "BOOTSTRAP", 50)
    labels = [label(0), label(1)]
    reports = {found["id"]: report() | {"detectable": {"backlash": 1.0}} for found in labels}
    _set_of_cases(tmp_path, labels)
    for name, content in reports.items():
        write_json(tmp_path / "reports" / f"{name}.json", content)
    (tmp_path / "reports" / "method.txt").write_text("abc\n")
    entry, packed = tmp_path / "entry.json", tmp_path / "release.json.xz"
    card = score.scored(labels, reports) | {"ablations": []}
    diagnosis_entry.write_entry(entry, "ours", "guessing", tmp_path / "cases", card)
    Release.gather(tmp_path).pack(packed)
    assert set(verify_release(entry, packed).values()) == {"same"}
    assert "detectable" not in Release.load(packed).reports["case_000"]
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(ValueError, match=says("release.json.xz", "no release", "cut off")):
        Release.load(packed)


@pytest.mark.parametrize("number", range(1, 7))
def test_a_release_has_the_labels_that_were_committed_to(number, tmp_path):
    root = Path(__file__).parents[1]
    Release.load(root / "docs" / "results" / "releases" / f"release_{number}.json.xz").unpack(tmp_path)
    entry = root / "leaderboard" / "results" / "diagnosis" / f"soro_bench_{number}.json"
    assert diagnosis_entry.opened(tmp_path / "cases") == diagnosis_entry.read_entry(entry)["set"]


def test_the_command_prove_writes_an_entry_that_verifies(tmp_path, monkeypatch):
    monkeypatch.setattr(score, "BOOTSTRAP", 50)
    labels = [label(0), label(1)]

    def run(folder, *_):
        _set_of_cases(folder, labels)
        reports = {found["id"]: report() for found in labels}
        for name, content in reports.items():
            write_json(folder / "reports" / f"{name}.json", content)
        write_json(folder / "scorecard.json", score.scored(labels, reports) | {"ablations": []})
        return "scorecard"

    monkeypatch.setattr("soro_bench.blind_benchmark.run.run_blind_benchmark", run)
    BlindBenchmark(tmp_path).run()
    found = verify_diagnosis(tmp_path / "entry.json", tmp_path / "cases", tmp_path / "reports")
    assert set(found.values()) == {"same"}


@pytest.mark.parametrize("labels", [
    {"seed": 1}, {"cases": [{}]}, {"cases": [1]}, {"cases": [label(0)]}, {"seed": 1, "cases": 2 * [label(0)]},
    *({"seed": 1, "cases": [label(0) | {"id": name}]} for name in ("../outside", "/etc/os-release", "case_000/..", 1)),
])  # fmt: skip
def test_labels_that_say_too_little_are_named(tmp_path, labels):
    path = tmp_path / "cases" / "sealed" / "labels.json"
    write_json(path, labels)
    (tmp_path / "cases" / "commitment.txt").write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")
    with pytest.raises(ValueError, match=says("labels.json", "cannot be scored")):
        diagnosis_entry.opened(tmp_path / "cases")


def test_labels_are_read_from_a_file_of_bounded_size_and_a_commitment_is_a_hash(tmp_path):
    _set_of_cases(tmp_path, [label(0)])
    commitment = tmp_path / "cases" / "commitment.txt"
    commitment.write_text("what somebody keeps to himself")
    with pytest.raises(ValueError, match="holds no SHA-256") as raised:
        diagnosis_entry.opened(tmp_path / "cases")
    assert "somebody" not in str(raised.value)
    path = tmp_path / "cases" / "sealed" / "labels.json"
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"labels\.json is a link"):
        diagnosis_entry.opened(tmp_path / "cases")
