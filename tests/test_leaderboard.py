"""Entries of the leaderboard: written, read, refused, verified."""

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jsonschema", reason="needs the board extra")

import soro_bench
from soro_bench import packed
from soro_bench.commands.leaderboard import Pack, Verify
from soro_bench.evaluation import Episode
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.entry import (
    SCHEMA,
    card_of,
    check_free,
    load_policy,
    policy_of,
    read_curve,
    read_entry,
    thinned_curve,
    write_entry,
)
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.verify import verify_control
from soro_bench.options import FOLDER, MAX_SEED
from soro_bench.policies.policy import Policy
from soro_bench.recording.simulated import record
from tests.results import BOARD, CARD, edit, policy, put_policy, scores, shrink_board, true_entry
from tests.test_bad_input import says


@pytest.fixture(autouse=True)
def small(monkeypatch):
    shrink_board(monkeypatch)


@pytest.fixture
def path(tmp_path):
    return write_entry(tmp_path, BOARD, "ours", policy(), scores(3.0, 4.0))


def test_what_is_written_is_read_again(tmp_path):
    curve = {"steps": [100, 200], "final_mm": [30.0, 20.0]}
    training = {"algorithm": "PPO", "seconds": 3.5, "curve": curve}
    box = {"type": "uniform", "parameters": {"trunk_mass": {"low": 0.1, "high": 0.2}}}
    path = write_entry(tmp_path, BOARD, "ours", policy(), scores(3.0, 4.0), box, training)
    assert path == tmp_path / BOARD / "ours" / "oracle" / "seed0.json"
    entry = read_entry(path)
    assert card_of(entry) == CARD
    assert entry["training"] == training and entry["distribution"] == box
    assert entry["evaluations"] == scores(3.0, 4.0)
    for loaded in (policy_of(path, entry), load_policy(path)):
        assert loaded.card == CARD
        np.testing.assert_array_equal(loaded.tensors["w0"], policy().tensors["w0"])


def test_an_entry_stands_for_its_policy_where_one_is_recorded(path):
    recording = record(BOARD, str(path), "cable", steps=2, load=load_policy)
    first = recording.commands["action"].values[0]
    assert first.shape == (8,) and recording.metadata["policy"] == str(path)
    with pytest.raises(ValueError, match=r"seed0\.json is for TrunkReach-v0"):
        record("TrunkPush-v0", str(path), load=load_policy)


def test_a_long_training_curve_becomes_fifty_means(tmp_path):
    rows = [f"{100 * i},1,4,{0.5 * i},0" for i in range(1, 1001)]
    (tmp_path / "curve.csv").write_text("\n".join(["steps,seconds,episodes,final_distance_mm,return", *rows]))
    curve = thinned_curve(tmp_path / "curve.csv", "distance")
    assert len(curve["steps"]) == len(curve["final_mm"]) == 50
    np.testing.assert_allclose(curve["final_mm"], 0.005 * np.array(curve["steps"]), atol=1.0)


def test_parts_of_a_curve_have_as_many_updates(tmp_path):
    rows = [f"{i},1,4,{i},0" for i in range(1, 201)]
    (tmp_path / "curve.csv").write_text("\n".join(["steps,seconds,episodes,final_distance_mm,return", *rows]))
    _, means = read_curve(tmp_path / "curve.csv", "distance", 50)
    np.testing.assert_allclose(means, 2.5 + 4.0 * np.arange(50))


def test_a_kill_while_an_entry_is_replaced_leaves_no_wrong_one(path, tmp_path, monkeypatch):
    """The entry is missing then, and the next run writes it."""
    other = replace(policy(), tensors={name: 2 * value for name, value in policy().tensors.items()})
    monkeypatch.setattr("soro_bench.leaderboard.entry.write_json", lambda *_: sys.exit("killed"))
    with pytest.raises(SystemExit):
        write_entry(tmp_path, BOARD, "ours", other, scores(3.0, 4.0))
    assert not path.exists()
    monkeypatch.undo()
    shrink_board(monkeypatch)
    write_entry(tmp_path, BOARD, "ours", other, scores(3.0, 4.0))
    assert policy_of(path, read_entry(path)).card == CARD


def _set(*keys, value):
    def change(entry):
        for key in keys[:-1]:
            entry = entry[key]
        entry[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (_set("format", value="soro_bench/control/2"), ("format is 'soro_bench/control/2'", "soro_bench/control/1")),
        (_set("board", value="MoonLanding-v0"), ("board is 'MoonLanding-v0'", "TrunkReach-v0")),
        (_set("seed", value=-1), ("seed is -1", "minimum 0")),
        (_set("seed", value=True), ("seed is True", "integer")),
        (_set("seed", value=0.0), ("seed is 0.0", "an integer, written as one")),
        (_set("steps", value=1000.0), ("steps is 1000.0", "an integer, written as one")),
        (_set("seed", value=1), ("policy.file is 'seed0.safetensors'", "seed1.safetensors")),
        (_set("evaluations", "cable", "diverged", value=3), ("cable.diverged is 3", "2 at most")),
        (_set("entry", value="../../etc"), ("entry is '../../etc'", "pattern")),
        (_set("method", value="<script>"), ("method is '<script>'", "pattern")),
        (_set("trained_on", value=9 * "very long "), ("trained_on is", "maxLength 80")),
        (_set("policy", "file", value="../seed0.safetensors"), ("policy.file is '../seed0.safetensors'", "pattern")),
        (_set("policy", "file", value="seed0.pt"), ("policy.file is 'seed0.pt'", "safetensors|onnx")),
        (_set("policy", "url", value="http://example.org"), ("policy", "'url' was unexpected")),
        (_set("evaluations", "moon", value=scores(1.0, 2.0)["cable"]), ("evaluations has 'moon'", "cable")),
        (_set("evaluations", value=scores(1.0)), ("evaluations.cable.final_mm has 1 values", "2, one a start")),
        (_set("evaluations", "cable", "success", value=[True, 0]), ("evaluations.cable.success.1 is 0", "boolean")),
        (_set("evaluations", "cable", "final_mm", value=["1", 2.0]), ("final_mm.0 is '1'", "number")),
        (_set("evaluations", "cable", "final_mm", value=[1e9, 2.0]), ("final_mm.0 is 1000000000.0", "maximum")),
        (lambda entry: entry.pop("versions"), ("in the entry", "'versions' is a required property")),
        (_set("training", "curve", value={"steps": [1, 2], "final_mm": [1.0]}), ("2 steps and 1 lengths",)),
        (
            _set("evaluations", "cable", "clearance_mm", value=[1.0, 2.0]),
            ("clearance_mm", "allowed on this board: final"),
        ),
        (_set("training", "settings", value={"discount": {}}), ("settings.discount is {}",)),
        (_set("trained_on", value="a\u202eb"), ("characters that cannot be shown",)),
        (_set("training", "effects", value=["a\x1b[2Jb"]), ("characters that cannot be shown",)),
        (_set("evaluations", value={900 * "a": {}}), ("evaluations.aaa",)),
    ],
)
def test_an_entry_that_says_what_is_not_allowed_is_refused(path, change, parts):
    """In one line that names the file, the value and what is allowed."""
    edit(path, change)
    with pytest.raises(ValueError, match=says(str(path), *parts)) as error:
        read_entry(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 700


def nested(depth: int) -> str:
    return depth * "[" + depth * "]"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3.0", "NaN", "NaN is no finite number"),
        ("3.0", "-Infinity", "-Infinity is no finite number"),
        ("3.0", "1e999", "1e999 is no finite number"),
        ("3.0", "1" + 5000 * "0", "is too large"),
        ('"seed": 0', '"seed": 0, "seed": 1', "'seed' comes twice"),
        ('"distribution": null', '"distribution": ' + 100_000 * "[" + 100_000 * "]", "no valid JSON"),
        ('"distribution": null', '"distribution": ' + nested(60), "more than 50 deep"),
        ("{", "", "no valid JSON"),
    ],
)
def test_json_that_says_several_things_or_nothing_is_refused(path, old, new, message):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=says(str(path), message)):
        read_entry(path)


@pytest.mark.parametrize("depth", range(600, 1000, 20))
def test_json_that_is_just_not_too_deep_for_python_is_refused_as_well(path, depth):
    path.write_text(path.read_text().replace('"board": "TrunkReach-v0"', '"board": ' + nested(depth)))
    with pytest.raises(ValueError, match=says(str(path))):
        read_entry(path)


def test_a_huge_entry_is_refused_without_being_read(tmp_path):
    path = tmp_path / "seed0.json"
    with path.open("wb") as file:
        file.truncate(1_000_000_000)
    with pytest.raises(ValueError, match=says(str(path), "1000000000 bytes; at most 1000000")):
        read_entry(path)


class Trap:
    """Unpickling it would leave a trace."""

    def __reduce__(self):
        return os.system, ("touch unpickled",)


@pytest.mark.parametrize("name", ["seed0.safetensors", "seed0.onnx"])
def test_a_pickle_under_another_name_is_never_unpickled(path, name, monkeypatch, tmp_path):
    if name.endswith("onnx"):
        pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    put_policy(path, name, pickle.dumps(Trap()))
    with pytest.raises(ValueError, match=says(str(path.parent / name), "no valid policy")):
        policy_of(path, read_entry(path))
    assert not (tmp_path / "unpickled").exists()


def test_a_policy_file_that_is_not_the_entered_one_is_refused(path):
    file = path.parent / "seed0.safetensors"
    file.write_bytes(policy(seed=5).to_bytes())
    with pytest.raises(ValueError, match=says(str(file), "SHA-256", "says")):
        policy_of(path, read_entry(path))
    file.unlink()
    with pytest.raises(FileNotFoundError, match=r"seed0\.safetensors"):
        policy_of(path, read_entry(path))


def test_a_linked_folder_of_entries_is_refused_by_name(path, tmp_path):
    """Nothing in it would be shown, and nobody told why."""
    shutil.move(path.parent.parent, tmp_path / "elsewhere")
    path.parent.parent.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=r"ours is a link to a folder, in which no entries are read; move or copy"):
        gather_control(tmp_path / BOARD)


def test_a_policy_file_that_is_a_link_or_too_large_is_refused(path, tmp_path):
    file = path.parent / "seed0.safetensors"
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=says(str(file), "is a link")):
        policy_of(path, read_entry(path))
    file.unlink()
    with file.open("wb") as sparse:
        sparse.truncate(1_000_000_000)
    with pytest.raises(ValueError, match=says(str(file), "1000000000 bytes; at most 20000000")):
        policy_of(path, read_entry(path))


def test_nothing_is_written_of_an_entry_that_is_wrong(tmp_path):
    for board, given, found in (
        (BOARD, policy(), scores(1.0)),
        (BOARD, policy(), scores(1.0, float("nan"))),
        (BOARD, policy(method="../udr"), scores(1.0, 2.0)),
        ("TrunkPush-v0", policy(), {"cable": scores(1.0)["cable"]}),
    ):
        with pytest.raises(ValueError):
            write_entry(tmp_path, board, "ours", given, found)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("board", "counted"), [("TrunkLift-v0-50g", 0.0), ("MultiGait-v0-6", 0.0), ("TrunkReach-v0", 0.05)]
)
def test_nothing_is_gained_by_an_episode_that_diverged(board, counted):
    """The engine then puts the scene where it began, an object in the air, or the object is on its way out of it."""
    metric = np.array([0.05, 0.03])
    for diverged, value in ((True, counted), (False, 0.03)):
        episode = Episode(board, "flex", {}, None, np.arange(2.0), {"clearance": metric}, np.zeros((1, 8)), {},
                          "metric", metric, False, diverged)  # fmt: skip
        lengths = [value for name, value in BOARDS[board].score([episode]).items() if name.endswith("_mm")]
        assert len(lengths) == (2 if "Lift" in board else 1)
        assert lengths == len(lengths) * [[pytest.approx(1e3 * value)]]


def test_a_right_entry_is_confirmed_and_an_edited_score_found(tmp_path):
    path = true_entry(tmp_path)
    assert verify_control(path, num_threads=1) == {"cable": "same"}
    final = read_entry(path)["evaluations"]["cable"]["final_mm"]
    edit(path, _set("evaluations", "cable", "final_mm", value=[final[0], final[1] - 0.25]))
    assert verify_control(path, ["cable"], 1) == {"cable": "differs: final_mm by up to 0.25 mm"}
    edit(path, _set("evaluations", "cable", "success", value=[False, True]))
    assert verify_control(path, ["cable"], 1)["cable"].endswith("0.25 mm, success of 1 of 2")
    with pytest.raises(ValueError, match=says(str(path), "'flex' was not entered", "cable")):
        verify_control(path, ["flex"])


def test_packed_entries_are_what_they_were(tmp_path, capsys):
    """Read, gathered, verified and recorded from by the same paths; a new file in the folder counts instead."""
    first = true_entry(tmp_path)
    second = true_entry(tmp_path, given=replace(policy(3), card=replace(CARD, seed=1)))
    entries, before = [read_entry(path) for path in (first, second)], gather_control(tmp_path)
    Pack((first.parent,)).run()
    assert [path.name for path in first.parents[1].iterdir()] == ["oracle.zip"]
    assert [read_entry(path) for path in (first, second)] == entries and gather_control(tmp_path) == before
    np.testing.assert_array_equal(load_policy(second).tensors["w0"], policy(3).tensors["w0"])
    assert record(BOARD, str(second), "cable", steps=2, load=load_policy).metadata["policy"] == str(second)
    capsys.readouterr()
    Verify((first.parent.with_name("oracle.zip"),)).run()
    assert capsys.readouterr().out.splitlines() == [f"{path}: cable: same" for path in (first, second)]
    with pytest.raises(ValueError, match=says(str(first), "is the entry of another policy")):
        check_free(tmp_path, BOARD, "ours", other := replace(policy(5), card=CARD))
    true_entry(tmp_path, given=other)
    assert read_entry(first) != entries[0] and len(gather_control(tmp_path)[BOARD][0].entries) == 2
    Pack((first.parent,)).run()
    np.testing.assert_array_equal(load_policy(first).tensors["w0"], policy(5).tensors["w0"])
    with pytest.raises(ValueError, match="udr has no entries to pack"):
        Pack((first.parents[1] / "udr",)).run()


def test_one_archive_has_all_methods_of_an_entry(tmp_path, capsys):
    """Those in folders and those packed before; paths stay, and what is entered later is packed beside them."""
    first = true_entry(tmp_path)
    second = true_entry(tmp_path, given=replace(policy(3), card=replace(CARD, method="udr")))
    before = gather_control(tmp_path)
    Pack((first.parent,)).run()
    Pack((first.parents[1],)).run()
    assert [path.name for path in (tmp_path / BOARD).iterdir()] == ["ours.zip"] and gather_control(tmp_path) == before
    capsys.readouterr()
    Verify((tmp_path / BOARD / "ours.zip",)).run()
    assert capsys.readouterr().out.splitlines() == [f"{path}: cable: same" for path in (first, second)]
    true_entry(tmp_path, given=replace(policy(5), card=replace(CARD, method="udr", seed=1)))
    assert len(gather_control(tmp_path)[BOARD][1].entries) == 2
    Pack((first.parents[1],)).run()
    assert [path.name for path in (tmp_path / BOARD).iterdir()] == ["ours.zip"]
    assert len(gather_control(tmp_path)[BOARD][1].entries) == 2


def test_an_archive_with_what_is_no_policy_is_refused(tmp_path):
    path = true_entry(tmp_path)
    Pack((path.parent,)).run()
    archive = path.parent.with_name("oracle.zip")
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr("seed1.json", json.dumps({"format": "soro_bench/control/1"}))
    with pytest.raises(ValueError, match=says("oracle/seed1.json", "required property")):
        gather_control(tmp_path)
    archive.rename(archive.with_name("udr.zip"))
    with pytest.raises(ValueError, match=says("udr/seed0.json holds what belongs to", "oracle/seed0.json")):
        gather_control(tmp_path)


def test_a_folder_of_results_with_what_is_no_policy_or_comes_twice_is_refused(tmp_path):
    first = true_entry(tmp_path)
    gather_control(tmp_path)
    second = write_entry(tmp_path, BOARD, "ours", replace(policy(), card=replace(CARD, seed=1)), scores(3.0, 4.0))
    with pytest.raises(ValueError, match=says(str(second), "its policy is that of", str(first))):
        gather_control(tmp_path)
    put_policy(second, "seed1.safetensors", pickle.dumps(Trap()))
    with pytest.raises(ValueError, match=says("seed1.safetensors", "no valid policy")):
        gather_control(tmp_path)
    flat = {**policy().tensors, "std": np.zeros(66)}
    put_policy(second, "seed1.safetensors", Policy(CARD, flat).to_bytes())
    with pytest.raises(ValueError, match=says("seed1.safetensors", "std has 0.0; positive")):
        gather_control(tmp_path)
    whole = {name: value.astype(np.uint8) for name, value in policy().tensors.items()}
    put_policy(second, "seed1.safetensors", Policy(CARD, whole).to_bytes())
    with pytest.raises(ValueError, match=says("seed1.safetensors", "numbers of type uint8, not float32")):
        gather_control(tmp_path)
    named = {**policy().tensors, "\x1b[2J\nsame": np.zeros(1)}
    put_policy(second, "seed1.safetensors", Policy(CARD, named).to_bytes())
    with pytest.raises(ValueError, match=says("seed1.safetensors", r"'\x1b[2J\nsame'")):
        gather_control(tmp_path)


def test_commands_and_entries_allow_the_same_names():
    schema = json.loads((Path(soro_bench.__file__).parent / "leaderboard" / SCHEMA).read_text())
    assert schema["$defs"]["folder"]["pattern"] == FOLDER
    assert schema["properties"]["seed"]["maximum"] == MAX_SEED


def test_a_policy_for_other_observations_is_refused_in_words(tmp_path):
    path = true_entry(tmp_path)
    tensors = {**policy().tensors, "mean": np.zeros(3), "std": np.ones(3), "w0": np.zeros((8, 3))}
    put_policy(path, "seed0.safetensors", Policy(CARD, tensors).to_bytes())
    for read in (verify_control, lambda path: gather_control(tmp_path)):
        with pytest.raises(ValueError, match=r"seed0\.safetensors is no policy .* 3 inputs; .* have 66 numbers"):
            read(path)
    tensors = {**policy().tensors, "w0": np.zeros((1, 66)), "b0": np.zeros(1)}
    put_policy(path, "seed0.safetensors", Policy(CARD, tensors).to_bytes())
    with pytest.raises(ValueError, match=r"seed0\.safetensors is no policy .* actions have shape \(1, 1\)"):
        gather_control(tmp_path)


def test_the_command_fails_where_a_figure_differs(tmp_path):
    """A shipped entry is confirmed; the same with another figure ends with status 1."""
    code = "import sys; from soro_bench.cli import main; sys.argv[0] = 'soro-bench'; main()"
    shipped = Path(__file__).parents[1] / "leaderboard" / "results" / "TrunkPush-v0" / "ppo" / "oracle" / "seed0.json"
    if not packed.is_there(shipped):
        pytest.skip("needs a checkout")
    edited = tmp_path / "seed0.json"
    for file in (shipped, shipped.with_suffix(".safetensors")):
        (tmp_path / file.name).write_bytes(packed.read(file, 1_000_000))
    (true,) = read_entry(shipped)["evaluations"]["cable"]["final_mm"]
    edit(edited, _set("evaluations", "cable", "final_mm", value=[true + 1.25]))
    command = [sys.executable, "-c", code, "leaderboard", "verify", str(shipped), str(edited), "--labels", "cable"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    first, second = run.stdout.strip().splitlines()
    assert first == f"{shipped}: cable: same"
    assert second == f"{edited}: cable: differs: final_mm by up to 1.25 mm"
    assert run.returncode == 1
