"""Studies of real robots, and published recordings: fetched, converted, checked; nothing here needs a network."""

import hashlib
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from soro_bench.cli import Data
from soro_bench.diagnosis import study as module
from soro_bench.diagnosis import study_runs
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.priors import Baseline
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.diagnosis.study import STUDIES, Part, Study, commands_of_take, load_study
from soro_bench.diagnosis.study_runs import errors, results, run_study
from soro_bench.files import asset_path, read_toml
from soro_bench.recording import published
from soro_bench.recording.published import PublishedFile, Source, bam_table, fetch, sources, summary
from soro_bench.recording.recording import RecordingError
from tests.arm import ARM, MAP, damaged, recording


def test_errors_of_known_residuals():
    """3 mm and 4 mm beside, always: no error without the mean; a point that was not seen does not count."""
    residual = np.tile([[0.003, 0.0, 0.004]], (5, 1, 1))
    seen = np.ones((5, 1, 3), bool)
    seen[-1] = False
    residual[-1] = 1.0
    found = errors(residual, seen)
    assert found["mean_absolute"] == pytest.approx(0.007 / 3)
    assert found["rms"] == pytest.approx(0.005) == found["rms_of_points"]
    assert found["rms_without_mean"] == pytest.approx(0.0, abs=1e-12)


def test_errors_of_points_without_samples_are_none():
    residual, seen = np.full((5, 2, 1), 0.003), np.ones((5, 2, 1), bool)
    seen[:, 1] = False
    found = errors(residual, seen)
    assert found["mean_absolute"] == pytest.approx(0.003) == found["rms_of_points"]
    assert found["rms"] is found["rms_without_mean"] is None
    assert set(errors(residual, ~seen & seen).values()) == {None}
    known, sets = {"study": "arm", "part": "first", "known": [], "noise": 1e-3, "unit": "rad"}, {"train": found}
    answer = {"effects": [], "probability": 1.0, **sets}
    summary = known | {"answers": [answer], "nominal": sets, "parameters": sets, "unknown": 0.0}
    assert results([summary]).splitlines()[2].split(" | ")[2] == "0.003 / - / -"


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
    own = study_runs.run_diagnosis
    monkeypatch.setattr(study_runs, "run_diagnosis", lambda *arguments: asked.append(1) or own(*arguments))
    (tmp_path / "out" / "again" / "summary.json").unlink()
    again = run_study(study, tmp_path / "out", threads=1)
    assert len(asked) == 1
    with pytest.raises(ValueError, match="results of seed 0, not 1"):
        run_study(study, tmp_path / "out", seed=1, threads=1)
    with monkeypatch.context() as other, pytest.raises(ValueError, match=r"results of method .*, not newer;"):
        other.setattr(study_runs, "METHOD", "newer")
        run_study(study, tmp_path / "out", threads=1)
    study.map.write_text(MAP + "# another")
    with pytest.raises(ValueError, match=r"results of inputs "):
        run_study(study, tmp_path / "out", threads=1)
    study.map.write_text(MAP)
    monkeypatch.setattr(module, "load_study", lambda *_: study)
    assert first[1]["verdict"] in call("study", "arm", "--out", tmp_path / "out")  # all is there
    assert (tmp_path / "out" / "results.md").read_text() == results(again) + "\n"
    for each in (*first, *again):
        each.pop("seconds")
    assert json.dumps(again) == json.dumps(first)


def test_a_summary_begins_with_the_answer_that_its_report_is_of(study, monkeypatch):
    """Which is not the most probable one where an effect is likelier whatever comes with it."""
    monkeypatch.setattr(study_runs, "errors_of", lambda *_: {})
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
    summary = study_runs._summary(study, study.parts[1], found, "", 0)
    assert [each["effects"] for each in summary["answers"]] == [["backlash", "compliance"], ["payload"], ["backlash"]]


def test_an_unknown_study_and_missing_recordings_are_named(tmp_path):
    with pytest.raises(ValueError, match="unknown study 'moon'; there are opencr_tdcr, "):
        load_study("moon", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no v4_train.csv in .*opencr_tdcr; --data names another folder"):
        load_study("opencr_tdcr", tmp_path)


def test_a_part_has_its_recordings_to_explain_to_hold_out_and_never_to_see(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_recordings", lambda folder, name, entries: tuple(e["files"] for e in entries))
    (part,) = load_study("bam_servo", tmp_path).parts
    assert [len(files) for files in (part.train, part.heldout, part.unseen)] == [2, 2, 2]
    assert "kp200_sin_sin" in part.unseen[0] and "kp200_lift" in part.heldout[0] and "kp100" in part.train[0]


@pytest.mark.parametrize(
    ("name", "part", "kind", "file", "changes"),
    [
        ("asl_trunk", "random", "train", "servo_random1_0g.npz", {"time": {"until": 30.0}}),
        ("asl_trunk", "random", "train", "servo_random2_0g.npz", {}),  # which is held out elsewhere, in a window
        ("opencr_tdcr", "patterns", "train", "v5.csv", {}),  # whose patterns are others
    ],
)
def test_other_files_are_imported_as_those_of_their_kind_or_as_all(
    name, part, kind, file, changes, tmp_path, monkeypatch
):
    """From a folder in the study's own."""
    seen, data = [], {"silicone_beam": "silicone_beam_arm"}.get(name, name)
    monkeypatch.setattr(module, "_recordings", lambda folder, study, entries: seen.extend(entries) or ())
    (folder := tmp_path / data / "hidden").mkdir(parents=True)
    (folder / file).touch()
    found = load_study(name, folder, {kind: [file]}, part)
    assert [{k: v for k, v in entry.items() if k != "files"} for entry in seen] == [changes]
    assert found.parts[0].question == f"other files: {kind} {file}"


@pytest.mark.parametrize(
    ("file", "load"), [("beam_gravity_V3_a.csv", {}), ("beam_load101_V2_a.csv", {"load": "101", "load_mass": "101"})]
)
def test_what_hangs_on_the_beam_is_told_by_the_name_of_its_file(file, load, tmp_path):
    study = read_toml(asset_path("studies.toml"))["silicone_beam"]
    assert module._from_name(tmp_path / file, study) == load


def test_a_file_whose_name_looks_like_a_pattern_is_found(tmp_path):
    (folder := tmp_path / "run[1]").mkdir()
    (folder / "piece[a].csv").touch()
    for pattern in ("piece[[]a].csv", "piece[a].csv", "piece*", str(folder / "piece[a].csv")):
        assert module._paths(folder, {}, pattern) == [folder / "piece[a].csv"]


def test_the_gain_of_a_servo_is_that_in_the_name_of_its_file(tmp_path):
    study = read_toml(asset_path("studies.toml"))["bam_servo"]
    assert module._from_name(tmp_path / "xl330_processed_kp400_new.csv", study) == {"firmware_gain": "400"}
    with pytest.raises(RecordingError, match=r"names like .*, a regular expression; is it of another robot or kind"):
        module._from_name(tmp_path / "other.csv", study)


def test_parameters_that_are_anew_are_as_unknown_as_before_the_part_that_was_first(study, tmp_path):
    """The others are known from it."""
    first, again = study.parts
    names = [prior.name for prior in ModelRobot(study.model, study.map, threads=1).priors]
    given = replace(study, parts=(first, replace(again, anew=(names[0],))))
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_runs, "run_diagnosis", lambda robot, *_: seen.append(robot) or stop())
        patch.setattr(
            study_runs, "baseline", lambda _: Baseline(dict.fromkeys(names, 1.0), dict.fromkeys(names, 1e-3), ())
        )
        (tmp_path / "first").mkdir()
        with pytest.raises(RuntimeError):
            run_study(replace(given, parts=given.parts[1:]), tmp_path, threads=1)
    own = ModelRobot(study.model, study.map, threads=1).priors
    assert [a.deviation == b.deviation for a, b in zip(seen[0].priors, own, strict=True)] == [True, False, False]


def stop():
    raise RuntimeError


def test_a_part_that_comes_after_another_one_needs_its_result(tmp_path):
    part = module.Part("hung", "", (), (), "alone")
    with pytest.raises(ValueError, match=r"part hung comes after alone, of which .* has no result; run it first"):
        study_runs.run_study(module.Study("hung_beam", tmp_path, {}, (part,)), tmp_path / "out")


def test_a_study_reads_a_folder_of_pieces_and_asks_which_part_files_are_for(tmp_path):
    folder = tmp_path / "multiarm_pendulum" / "single"
    folder.mkdir(parents=True)
    for i in (1, 2, 7):
        (folder / f"piece_{i:02}.csv").write_text("t_s,angle_rad,angle_rate_rad_s\n0,3.1,0\n0.001,3.1,0.01\n")
    files = {"train": ["single/piece_0[12].csv"], "heldout": ["single/piece_07.csv"]}
    for data in (tmp_path, folder.parent):
        (part,) = load_study("pendulum", data, files).parts
        assert [len(some) for some in (part.train, part.heldout, part.unseen)] == [2, 1, 0]
    with pytest.raises(
        ValueError, match=r"which part of asl_trunk are these files for\? Write --part and one of random"
    ):
        load_study("asl_trunk", tmp_path, files)
    with pytest.raises(ValueError, match="unknown part 'moon' of pendulum; there are pieces"):
        load_study("pendulum", tmp_path, part="moon")


def test_a_table_of_takes_gives_each_recording_its_constant_commands(tmp_path):
    (tmp_path / "takes.csv").write_text("take,load_g,far\na1,52,x\na12,101,x\n")
    takes = {"file": "takes.csv", "key": "take", "commands": {"load": {"columns": ["load_g"], "unit": "g"}}}
    found = commands_of_take(tmp_path / "a1.csv", takes)["load"]
    assert found.values.ravel() == pytest.approx([0.052]) and (found.unit, found.time.tolist()) == ("kg", [0.0])
    with pytest.raises(FileNotFoundError, match=r"no takes\.csv beside .*a1; it has a row for each recording"):
        commands_of_take(tmp_path / "elsewhere" / "a1", takes)
    with pytest.raises(RecordingError, match="0 rows with take 'a2'; expected one"):
        commands_of_take(tmp_path / "a2.csv", takes)
    takes["commands"]["load"]["columns"] = ["far"]
    with pytest.raises(RecordingError, match=r"commands\.load: 'x' in far is no finite number"):
        commands_of_take(tmp_path / "a1.csv", takes)
    takes["commands"]["load"]["columns"] = ["load_g"]
    (tmp_path / "takes.csv").write_bytes(b"take,load_g\ra1,52\ra2,nan\r")
    assert commands_of_take(tmp_path / "a1.csv", takes)["load"].values.ravel() == pytest.approx([0.052])
    with pytest.raises(RecordingError, match=r"takes\.csv: commands\.load: 'nan' in load_g is no finite number"):
        commands_of_take(tmp_path / "a2.csv", takes)
    (tmp_path / "takes.csv").write_text("take,load_g\na1,52\n", encoding="utf-16")
    with pytest.raises(RecordingError, match=r"takes\.csv: is no text in UTF-8 \(line 1\); save it as UTF-8"):
        commands_of_take(tmp_path / "a1.csv", takes)


def test_a_damaged_table_of_takes_is_refused_in_a_line_or_gives_numbers(tmp_path):
    takes = {"file": "takes.csv", "key": "take", "commands": {"load": {"columns": ["load_g"], "unit": "g"}}}
    whole, rng = b'take,load_g\na1,52\na2,"101"\n', np.random.default_rng(0)
    for _ in range(200):
        (tmp_path / "takes.csv").write_bytes(damaged(whole, rng))
        try:
            found = commands_of_take(tmp_path / "a1.csv", takes)["load"]
        except RecordingError as error:
            assert "\n" not in str(error) and str(error).startswith(str(tmp_path / "takes.csv"))
        else:
            assert found.values.shape == (1,) and np.isfinite(found.values).all()


@pytest.mark.parametrize("name", STUDIES)
def test_files_of_a_study_are_there(name):
    import tomllib

    from soro_bench.files import asset_path

    table = tomllib.loads(asset_path("studies.toml").read_text())[name]
    files = [table[key] for key in ("model", "map", "import") if isinstance(table[key], str)]
    assert all(Path(asset_path(f"mjcf/{name}")).is_file() for name in files)
    robot_map = table["map"] if isinstance(table["map"], dict) else asset_path(f"mjcf/{table['map']}")
    robot = ModelRobot(asset_path(f"mjcf/{table['model']}"), robot_map, threads=1)
    kept = table["import"].get("time", {}).get("until", np.inf) if isinstance(table["import"], dict) else np.inf
    assert kept / robot.control_timestep >= DEFAULT.data_quality.least_samples  # of each recording
    anew = {name for part in table["parts"].values() for name in part.get("anew", ())}
    assert anew <= {prior.name for prior in robot.priors}


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


ENTRY = {
    "position": -0.0123456789, "speed": 0.5, "load": 65535.12345, "input_volts": 7.35049, "temp": 28.96,
    "goal_position": -1e-7, "torque_enable": False, "timestamp": 0.17500000000000002,
}  # fmt: skip
HEADER = b"t_s,goal_rad,pos_rad,speed_rad_s,load,volts,temp_C,torque_enable\r\n"
TABLE = HEADER + b"0.175,-0.0,-0.012346,0.5,65535.123,7.35,29.0,0\r\n"
LOG = json.dumps({"kp": 100, "entries": [ENTRY], "dt": 0.005}).encode()
FETCHED = [("a.csv", "dir/take 1.csv", b"t,x\n0,1\n", b"t,x\n0,1\n"), ("b.csv", "dir/take.json", LOG, TABLE)]


def source_of(name="a.csv", original="dir/take 1.csv", content=b"t,x\n0,1\n"):
    """A source of one file."""
    file = PublishedFile(name, hashlib.sha256(content).hexdigest(), original)
    return Source("arm", "https://github.com/lab/arm", "0123abc", "MIT", (file,), "Columns: t, x.")


@pytest.fixture
def web(monkeypatch):
    """What is published: content or error by address; and the addresses that were asked for."""
    contents, asked = {}, []

    def urlopen(address, timeout):
        asked.append(address)
        content = contents[address]
        if isinstance(content, Exception):
            raise content
        response = io.BytesIO(content)
        response.url = contents.get("redirect", address)
        return response

    monkeypatch.setattr(published, "urlopen", urlopen)
    return contents, asked


def files_in(folder):
    """All files below a folder, hidden ones too."""
    return [path.name for path in folder.rglob("*") if path.is_file()]


def test_known_sources():
    """Every robot has a licence, a page and checksums; what cannot be fetched has a text about it."""
    assert list(sources()) == ["opencr_tdcr", "bam_servo", "asl_trunk", "silicone_beam_arm"]
    for source in sources().values():
        assert re.fullmatch(r"https://github\.com/[\w.-]+/[\w.-]+", source.repository)
        assert source.licence in ("MIT", "Apache-2.0")
        assert all(re.fullmatch("[0-9a-f]{64}", file.sha256) for file in source.files)
        fetched = [file.conversion is not None for file in source.files]
        assert bool(source.by_hand) != all(fetched)
        assert not any(fetched) or re.fullmatch("[0-9a-f]{40}", source.commit)


def test_bam_table():
    """Numbers are rounded, booleans are 0 and 1."""
    assert bam_table(LOG) == TABLE


@pytest.mark.parametrize("log", [b"", b"404", b"[]", b"{}", b'{"entries": [{}]}', b'{"entries": 3}', b"\xff" * 9])
def test_no_bam_log(log):
    """Something else is refused."""
    with pytest.raises(ValueError, match="no log of a servo"):
        bam_table(log)


@pytest.mark.parametrize(("name", "original", "sent", "content"), FETCHED)
def test_fetch(web, tmp_path, name, original, sent, content):
    """A file is fetched from the commit and converted if need be; a second time it is not fetched."""
    contents, asked = web
    source = source_of(name, original, content)
    address = f"https://raw.githubusercontent.com/lab/arm/0123abc/{original.replace(' ', '%20')}"
    contents[address] = sent
    for _ in range(2):
        fetch(source, tmp_path / "arm")
        assert (tmp_path / "arm" / name).read_bytes() == content
        assert asked == [address]
    assert summary("arm", source, tmp_path / "arm").splitlines() == [
        "arm: arm; MIT", "    https://github.com/lab/arm/tree/0123abc", f"    {tmp_path / 'arm'}: 1 of 1 files",
    ]  # fmt: skip


REFUSED = [
    (b"t,x\n0,2\n", ValueError, ("a.csv", hashlib.sha256(b"t,x\n0,2\n").hexdigest(), "expected", "take%201.csv")),
    (b" " * 101, ValueError, ("take%201.csv", "more than 100 bytes")),
    (OSError("no route"), OSError, ("take%201.csv", "no route")),
]


@pytest.mark.parametrize(("content", "error", "parts"), REFUSED)
def test_refused(web, tmp_path, monkeypatch, content, error, parts):
    """Wrong content, too much, or none: the error names the file, and nothing is kept."""
    monkeypatch.setattr(published, "MAX_BYTES", 100)
    web[0]["https://raw.githubusercontent.com/lab/arm/0123abc/dir/take%201.csv"] = content
    with pytest.raises(error, match="(?s)" + ".*".join(map(re.escape, parts))):
        fetch(source_of(), tmp_path)
    assert files_in(tmp_path) == []


def test_no_https(web, tmp_path):
    """A redirection to plain http is refused."""
    contents, _ = web
    contents["https://raw.githubusercontent.com/lab/arm/0123abc/dir/take%201.csv"] = b"t,x\n0,1\n"
    contents["redirect"] = "http://elsewhere/take.csv"
    with pytest.raises(OSError, match="not https"):
        fetch(source_of(), tmp_path)
    assert files_in(tmp_path) == []


def test_other_file_is_left(web, tmp_path):
    """A file that is there with another checksum is neither fetched nor overwritten."""
    (tmp_path / "a.csv").write_bytes(b"mine")
    found = hashlib.sha256(b"mine").hexdigest()
    with pytest.raises(ValueError, match=rf"a\.csv: SHA-256 is {found}, expected {source_of().files[0].sha256}"):
        fetch(source_of(), tmp_path)
    assert (tmp_path / "a.csv").read_bytes() == b"mine"
    assert web[1] == []
    assert "0 of 1 files\n    a.csv has another checksum" in summary("arm", source_of(), tmp_path)


@pytest.mark.parametrize("original", ["", "dir/take.c3d"])
def test_by_hand(web, tmp_path, original):
    """A file without a known conversion is not fetched: its page and columns are named. Once there, it is checked."""
    source = source_of(original=original)
    with pytest.raises(ValueError, match=r"(?s)tree/0123abc.*Columns: t, x.*a\.csv.*" + re.escape(original)):
        fetch(source, tmp_path)
    assert "0 of 1 files; 1 not fetched" in summary("arm", source, tmp_path)
    (tmp_path / "a.csv").write_bytes(b"t,x\n0,1\n")
    fetch(source, tmp_path)
    assert web[1] == []


def test_command(web, tmp_path, capsys):
    """Without a robot all are listed; an unknown one is an error; nothing is fetched."""
    Data(out=tmp_path).run()
    listed = capsys.readouterr().out
    assert all(part in listed for name, source in sources().items() for part in (name, source.page, source.licence))
    with pytest.raises(ValueError, match="'moon' is unknown; there are opencr_tdcr, bam_servo"):
        Data(("moon",), tmp_path).run()
    assert web[1] == [] and files_in(tmp_path) == []
