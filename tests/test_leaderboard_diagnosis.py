"""Entries of the diagnosis track, scored releases, and archives of entries."""

import hashlib
import json
import lzma
import os
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("jsonschema", reason="needs the board extra")

from soro_bench.blind_benchmark import criteria, score
from soro_bench.commands.blind_benchmark import BlindBenchmark
from soro_bench.files import write_json
from soro_bench.leaderboard import diagnosis_entry
from soro_bench.leaderboard.diagnosis_entry import Release
from soro_bench.leaderboard.entry import pack_entries, policy_of, read_entry, write_entry
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.verify import verify_diagnosis, verify_release
from soro_bench.packed import archive_of, folder_of, is_there, names, pack, read
from tests.results import BOARD, CARD, edit, policy, scores, shrink_board
from tests.test_bad_input import says
from tests.test_blind_benchmark_score import label, report


def _set_of_cases(folder, labels):
    path = folder / "cases" / "sealed" / "labels.json"
    write_json(path, {"seed": 7, "cases": labels})
    (folder / "cases" / "commitment.txt").write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")


def test_a_diagnosis_is_scored_again_and_what_was_edited_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(criteria, "BOOTSTRAP", 50)
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
    monkeypatch.setattr(criteria, "BOOTSTRAP", 50)
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


@pytest.mark.parametrize(("key", "value", "said"), [
    ("reports", [], "its reports is []; expected is an object"),
    ("labels", None, "its labels is None; expected is an object"),
    ("method", 7, "its method is 7; expected is a text"),
    ("reports", {"../case_000": {}}, "'../case_000' is no name of a case"),
])  # fmt: skip
def test_a_file_that_holds_no_release_is_named(tmp_path, key, value, said):
    parts = {"commitment": "0" * 64, "method": "abc", "labels": {}, "reports": {}}
    content = {"format": diagnosis_entry.RELEASE, **parts, key: value}
    (path := tmp_path / "release.json.xz").write_bytes(lzma.compress(json.dumps(content).encode()))
    with pytest.raises(ValueError, match=says("release.json.xz", "is no release", said)):
        Release.load(path)


def test_a_release_without_reports_is_unpacked_without(tmp_path):
    Release("0" * 64, "abc", {"cases": []}, {}).unpack(tmp_path)
    assert (tmp_path / "reports" / "method.txt").read_text() == "abc\n"


def test_the_command_prove_writes_an_entry_that_verifies(tmp_path, monkeypatch):
    monkeypatch.setattr(criteria, "BOOTSTRAP", 50)
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


@pytest.fixture
def folder(tmp_path):
    """Two files, a.json in the archive only and b.json in both."""
    folder = tmp_path / "oracle"
    folder.mkdir()
    for name in ("a.json", "b.json"):
        (folder / name).write_text(f"old {name}")
    both = {name: f"old {name}".encode() for name in ("a.json", "b.json")}
    assert pack(folder, both) == archive_of(folder) == tmp_path / "oracle.zip"
    assert not folder.exists() and folder_of(tmp_path / "oracle.zip") == folder
    folder.mkdir()
    (folder / "b.json").write_text("new b.json")
    return folder


def archive(folder, *members, **how):
    """An archive of members (name, content) for a folder."""
    with zipfile.ZipFile(archive_of(folder), "w", **how) as file:
        for name, content in members:
            file.writestr(name, content)


def test_a_file_is_read_from_its_folder_and_else_from_the_archive(folder):
    assert names(folder) == ["a.json", "b.json"]
    assert read(folder / "a.json", 100) == b"old a.json" and read(folder / "b.json", 100) == b"new b.json"
    assert is_there(folder / "a.json") and not is_there(folder / "c.json")
    for path in (folder / "c.json", folder.parent / "other" / "a.json"):
        with pytest.raises(FileNotFoundError, match=says(str(path))):
            read(path, 100)


def test_paths_without_a_folder_are_read_from_where_one_is(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert read("a.json", 100) == b"old a.json" and not is_there("c.json")
    assert not is_there("/c.json")


def test_what_is_packed_again_takes_the_place_of_what_was_there(folder):
    pack(folder, {"b.json": b"new b.json"})
    assert read(folder / "b.json", 100) == b"new b.json" and read(folder / "a.json", 100) == b"old a.json"
    before = archive_of(folder).read_bytes()
    pack(folder, {"a.json": b"old a.json"})
    assert archive_of(folder).read_bytes() == before, "the same files give the same bytes"


def test_a_file_that_could_not_be_read_again_is_not_packed(folder):
    (folder / "a b.json").write_text("")
    before = archive_of(folder).read_bytes()
    with pytest.raises(ValueError, match=says("oracle.zip", "member 'a b.json'", "allowed")):
        pack(folder, {"a b.json": b""})
    assert archive_of(folder).read_bytes() == before and (folder / "a b.json").exists()


def _killed_after(steps, work):
    """Do some work, of which nothing more happens after so many renamings and removals; whether it came to its end."""
    left = steps

    def counted(done):
        def step(*args, **kwargs):
            nonlocal left
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
            return done(*args, **kwargs)

        return step

    with pytest.MonkeyPatch.context() as patch:
        for name in ("replace", "unlink", "rmdir"):
            patch.setattr(os, name, counted(getattr(os, name)))
        try:
            work()
        except KeyboardInterrupt:
            return False
    return True


@pytest.mark.parametrize("level", [0, 1])
def test_an_archived_entry_is_whole_whenever_its_replacement_or_its_packing_is_killed(tmp_path, level, monkeypatch):
    """It is the old one or the new one, with its own policy, in the archive of its method or of all methods."""
    shrink_board(monkeypatch)
    old, new = policy(), replace(policy(5), card=CARD)

    def entered(results, given):
        path = write_entry(results, BOARD, "ours", given, scores(3.0, 4.0))
        pack_entries(path.parents[level])
        return path

    def held(path):
        found = policy_of(path, read_entry(path)).to_bytes()
        assert found in (old.to_bytes(), new.to_bytes()) and len(gather_control(path.parents[3])[BOARD]) == 1
        return found

    done, steps = False, 0
    while not done:
        path = entered(results := tmp_path / str(steps), old)
        done = _killed_after(steps, partial(entered, results, new))
        before = held(path)
        if any(path.parents[level].rglob("*")):
            pack_entries(path.parents[level])
        assert held(path) == before
        steps += 1
    assert before == new.to_bytes() and steps > 5


@pytest.mark.parametrize("name", ["../outside.json", "/etc/passwd", "a/b/seed0.json", ".hidden", "C:\\seed0.json"])
def test_members_that_are_no_plain_files_of_the_folder_are_refused(tmp_path, name):
    archive(tmp_path / "oracle", (name, "x"))
    with pytest.raises(ValueError, match=says("oracle.zip has the member", "allowed")):
        names(tmp_path / "oracle")


def test_an_archive_that_says_two_things_or_is_too_large_or_none_is_refused(tmp_path):
    folder = tmp_path / "oracle"
    with pytest.warns(UserWarning, match="Duplicate"):
        archive(folder, ("a.json", "1"), ("a.json", "2"))
    with pytest.raises(ValueError, match=says("oracle.zip has a.json twice")):
        read(folder / "a.json", 100)
    archive(folder, ("a.json", 10_000_000 * "0"), compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match=says("a.json", "10000000 bytes; at most 1000")):
        read(folder / "a.json", 1000)
    archive(folder, ("a.json", "1"), compression=zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match=says("oracle.zip has a.json", "deflate")):
        read(folder / "a.json", 1000)
    archive_of(folder).write_bytes(b"no archive")
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive")):
        read(folder / "a.json", 1000)
    os.truncate(archive_of(folder), 1_000_000_000)
    with pytest.raises(ValueError, match=says("oracle.zip has 1000000000 bytes")):
        read(folder / "a.json", 1000)


def test_a_member_that_was_changed_or_is_longer_than_it_says_is_refused(tmp_path):
    folder = tmp_path / "oracle"
    archive(folder, ("a.json", "content"))
    whole = archive_of(folder).read_bytes()
    archive_of(folder).write_bytes(whole.replace(b"content", b"C0ntent", 1))
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive", "CRC")):
        read(folder / "a.json", 1000)
    archive_of(folder).write_bytes(whole.replace(b"PK\x03\x04", b"PK\x03\x05", 1))
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive")):
        read(folder / "a.json", 1000)


def test_a_link_is_no_archive(tmp_path):
    archive(tmp_path / "oracle", ("a.json", "content"))
    archive_of(tmp_path / "linked").symlink_to(archive_of(tmp_path / "oracle"))
    with pytest.raises(ValueError, match=says("linked.zip is a link")):
        read(tmp_path / "linked" / "a.json", 1000)
