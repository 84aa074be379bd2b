"""Results and what is shown of them: JSON both ways, page, viewer file, files and console text."""

import dataclasses
import html as markup
import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun", reason="needs the train extra")

from soro_bench.commands.recording import _describe
from soro_bench.diagnosis.assembly.errors import worse_replays
from soro_bench.diagnosis.render import outside, render, replay_errors, sentences, words
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.rerun import rmse
from soro_bench.diagnosis.render.summary import WIDTH, summary
from soro_bench.diagnosis.result import SCHEMA, Result
from soro_bench.diagnosis.result_parts import ModelForm, NamedLocation, ScreenedTerm, SelectionRound
from soro_bench.effects import catalogue
from soro_bench.effects.effect import Location
from soro_bench.effects.equations import EQUATIONS
from soro_bench.progress import console
from soro_bench.recording.recording import Recording, Signal
from soro_bench.registration import ENV_IDS, task_type
from tests.results import RESULTS


def _same(a: Any, b: Any) -> bool:
    """Equal to seven digits, NaN equal to NaN, of the same types."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(_same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return type(b) is tuple and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float):
        return type(b) is float and (math.isclose(a, b, rel_tol=1e-6) or (math.isnan(a) and math.isnan(b)))
    return a == b


@pytest.mark.parametrize("name", RESULTS)
def test_round_trip(name: str, tmp_path: Path) -> None:
    """What is read is what was written, NaN of missing samples included, and is written the same again."""
    result = RESULTS[name]()
    result.save(tmp_path / "result.json")
    read = Result.load(tmp_path / "result.json")
    assert math.isnan(read.replay.measured[3][0])
    assert _same(result, read)
    assert read.to_json() == result.to_json()


def test_file_is_plain_json_with_its_schema(tmp_path: Path) -> None:
    RESULTS["adequate"]().save(tmp_path / "result.json")
    data = json.loads((tmp_path / "result.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert data["schema"] == SCHEMA and data["replay"]["measured"][3] == [None]


def _changed(path: str, value: object) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(RESULTS["trunk friction"]().to_json()))
    *parents, last = path.split(".")
    inner: Any = data
    for each in parents:
        inner = inner[int(each)] if isinstance(inner, list) else inner[each]
    inner[last] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("schema", "soro-bench/diagnosis/1", SCHEMA),
        ("verdict", 3, "result.verdict"),
        ("train.noise", "small", "result.train.noise"),
        ("findings", {}, "result.findings"),
        ("findings.0.location", "L2", "result.findings[0].location"),
        ("findings.0.estimates.0.value", True, "result.findings[0].estimates[0].value"),
        ("replay.shape", [6], "result.replay.shape"),
        ("hypotheses.0.surprise", 1, "result.hypotheses[0]"),
    ],
)
def test_bad_json_is_named_in_one_line(path: str, value: object, named: str, tmp_path: Path) -> None:
    file = tmp_path / "result.json"
    file.write_text(json.dumps(_changed(path, value)))
    with pytest.raises(ValueError) as error:
        Result.load(file)
    assert named in str(error.value) and str(file) in str(error.value) and "\n" not in str(error.value)


def test_missing_entry_is_named() -> None:
    data = RESULTS["adequate"]().to_json()
    del data["train"]["noise"]
    with pytest.raises(ValueError, match=r"result\.train lacks .*noise"):
        Result.from_json(data)


def test_what_is_no_object_is_no_result() -> None:
    with pytest.raises(ValueError, match=SCHEMA):
        Result.from_json([])


@pytest.mark.parametrize(
    ("part", "change", "said"),
    [
        ("verdict", "great", "verdict is 'great'"),
        ("hypotheses", [], "needs a hypothesis"),
        ("replay.time", [], "time of a replay has 0 stamps"),
        ("replay.shape", [10**9, 10**9], "rows of 1000000000000000000 numbers"),
        ("replay.measured", [[0.0]], "measured of a replay needs"),
        ("shapes", [{"points": [], "radius": 1.0, "locations": []}], "a shape needs points"),
        ("shapes", [{"points": [[0, 0, 0]], "radius": 1e300, "locations": []}], "a shape needs points"),
    ],
)
def test_a_result_that_cannot_be_drawn_is_refused(part: str, change: Any, said: str) -> None:
    """Before anything is written, and before memory is asked for."""
    data = RESULTS["adequate"]().to_json()
    *outer, name = part.split(".")
    (data[outer[0]] if outer else data)[name] = change
    with pytest.raises(ValueError, match=said):
        Result.from_json(data)


SNAPSHOTS = Path(__file__).parent / "snapshots" / "render.txt"
NUMBER = r"[-+]?\d[\d.]*(?:e[-+]?\d+)?"
UNITS = r"(?:%|mm|rad|N|kg|s|nats|kPa|MPa|sd|N m|N s²/m²)"


class _Text(HTMLParser):
    """The words of a page, a line per block, without its style."""

    def __init__(self) -> None:
        super().__init__()
        self.text, self.hidden = "", False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.hidden = self.hidden or tag == "style"
        self.text += " " if tag in ("span", "small", "td", "th") or tag.startswith("m") else "\n"

    def handle_endtag(self, tag: str) -> None:
        self.hidden = self.hidden and tag != "style"

    def handle_data(self, data: str) -> None:
        self.text += "" if self.hidden else data


def text_of(page: str) -> str:
    parser = _Text()
    parser.feed(page)
    return "\n".join(line for each in parser.text.splitlines() if (line := " ".join(each.split())))


def shown() -> str:
    """The summary and the page of every result, as the snapshot has them."""
    parts = []
    for name, result in RESULTS.items():
        parts += [f"== {name}: summary", summary(result()), f"== {name}: report.html", text_of(html(result()))]
    return "\n".join(parts) + "\n"


def test_summary_and_page_are_as_in_the_snapshot() -> None:
    """`PYTHONPATH=tests python tests/test_render.py` writes the snapshot anew; read what changed in it."""
    assert shown() == SNAPSHOTS.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", RESULTS)
def test_summary_fits_a_console(name: str) -> None:
    assert max(map(len, summary(RESULTS[name]()).splitlines())) <= WIDTH


def test_names_of_a_strangers_robot_do_not_break_the_summary_or_the_page() -> None:
    """Neither a name of 200 letters, nor escape sequences, nor markup."""
    data = RESULTS["trunk friction"]().to_json()
    name = "<script>\x1b[31m" + "x" * 200
    for each in (data["findings"][0], data["findings"][1]):
        each["location"]["name"] = name
    result = type(RESULTS["adequate"]()).from_json(data)
    lines = summary(result).splitlines()
    assert max(map(len, lines)) <= WIDTH and "\x1b" not in "".join(lines)
    assert "<script>" not in html(result) and markup.escape("<script>") in html(result)


@pytest.mark.parametrize("name", RESULTS)
def test_no_number_that_nobody_can_use(name: str) -> None:
    """No negative share, no p-value below what can be known, no name of a law with an underscore, no NaN."""
    for text in (summary(RESULTS[name]()), text_of(html(RESULTS[name]()))):
        assert not re.search(r"-\d+ %", text)
        assert not re.search(r"p = \S*e-|\d e-\d{2,}", text)
        assert not re.search(rf"\b({'|'.join(each for each in catalogue.ALL if '_' in each)})\b", text)
        assert not re.search(r"\bnan\b", text)


def test_notes_on_model_and_recordings_are_on_the_console_and_in_the_report() -> None:
    result = replace(RESULTS["adequate"](), notes=("no command drives gripper; held at 0",))
    assert "note         No command drives gripper; held at 0." in summary(result)
    assert "No command drives gripper; held at 0." in text_of(html(result))
    assert Result.from_json(result.to_json()).notes == result.notes


def test_p_value_is_never_smaller_than_can_be_known() -> None:
    assert (words.chance(0.0), words.chance(0.04)) == ("p < 0.001", "p = 0.04")


def test_a_patch_that_makes_it_worse_says_so_with_both_errors() -> None:
    text = " ".join(summary(RESULTS["arm gain"]()).split())
    assert "fitted parameters 0.0165 rad 0.00129 rad best hypothesis 0.0056 rad 0.00358 rad" in text
    assert "The patch is rejected: it makes held-out recordings worse." in text


def test_a_warning_calls_replays_as_the_table_above_it_does() -> None:
    """An error of the best hypothesis was said to be that with the effects, which has another in the table."""
    result = RESULTS["arm gain"]()
    text = summary(replace(result, train=replace(result.train, corrected_after=0.5 * result.train.after)))
    assert "of 0.0056 rad with the best hypothesis on fitted recordings" in " ".join(text.split())


@pytest.mark.parametrize("name", RESULTS)
def test_plain_replay_errors_stand_first(name: str) -> None:
    """On the console and in the report, of every robot whose replays are shown, as they are in the result."""
    result = RESULTS[name]()
    lines, page = summary(result).splitlines(), text_of(html(result))
    assert lines[1].split() == ["plain", "replay", "RMSE", "fitted", "to", *["held", "out"] * bool(result.heldout)]
    assert page.splitlines()[3].startswith("plain replay, RMSE")
    shown = [each for each in result.robots if each.name in replay_errors.ROBOTS]
    for i, each in enumerate(shown):
        errors = [each.train] if each.heldout is None else [each.train, each.heldout]
        row = " ".join([replay_errors.ROBOTS[each.name], *(words.number(error, result.robot.unit) for error in errors)])
        assert row.split() == lines[2 + i].split()
        assert row.replace(words.NO_BREAK, " ") in page


def test_errors_that_discretisation_may_explain_raise_a_warning() -> None:
    """From a ratio of 1.3 on, with the size of what is taken off, which stands beside the errors too."""
    result = RESULTS["outside the catalogue"]()
    off = words.number(math.sqrt(0.0042**2 - 0.003**2), result.robot.unit).replace(words.NO_BREAK, " ")
    warning = f"Discretisation error may be {off} of 4.2 mm with"
    assert warning in " ".join(summary(result).split())
    (row,) = (line for line in summary(result).splitlines() if "  may be discretisation" in line)
    assert off in row
    near = replace(result, train=replace(result.train, corrected_before=0.0040, corrected_after=0.0040))
    assert "Discretisation error may be" not in summary(near)


def test_nothing_that_may_be_discretisation_is_called_none() -> None:
    result = RESULTS["outside the catalogue"]()
    same = replace(result.train, corrected_after=1.01 * result.train.after)
    (row,) = (line for line in summary(replace(result, train=same)).splitlines() if "may be discretisation" in line)
    assert "none" in row.split() and "0" not in row.split()


def test_laws_that_another_simulator_may_look_like_are_named() -> None:
    """Where a robot is adequate within the error of its model's form, the law that explains most of the rest first."""
    result = RESULTS["adequate"]()
    form = ModelForm(0.001, 0.002)
    law = replace(result.best, effects=(NamedLocation("payload", Location("body", "arm")),), misfit_total=75.0)
    less = replace(law, effects=(NamedLocation("backlash", Location("actuator", "motor")),), misfit_total=90.0)
    none = replace(result.best, misfit_total=100.0)
    said = outside.model_form(replace(result, model_form=form, hypotheses=(none, less, law)))
    assert "cannot be told from one" in said
    assert said.index("payload at body arm (25 %)") < said.index("backlash at actuator motor (10 %)")
    assert outside.model_form(replace(result, model_form=replace(form, largest=0.0005))) == ""
    screened = ScreenedTerm(law.effects[0], 5.0), ScreenedTerm(less.effects[0], -1.0)  # nothing was fitted
    unfitted = replace(result, hypotheses=(replace(none, misfit=50.0),), rounds=(SelectionRound((), screened, ()),))
    said = outside.model_form(replace(unfitted, model_form=form))
    assert said.endswith("As predicted, it may be part of what is left: payload at body arm (10 %) of the misfit.")


def test_parameters_that_replay_worse_than_the_model_as_built_raise_a_warning() -> None:
    """With both errors and the recordings, in the verdict of console and report; from 1 % on, and if they diverge."""
    result = RESULTS["adequate"]()
    built, fitted = (replace(each, train=0.004, heldout=0.004) for each in result.robots)
    assert replay_errors.worse(result) == "" and worse_replays(result.robots, 0.01) == ()
    assert worse_replays((built, replace(fitted, train=0.00403)), 0.01) == ()
    fitted = replace(fitted, train=0.0044, heldout=math.nan)
    found = worse_replays((built, fitted, replace(fitted, name="alternative")), 0.01)
    assert [(each.robot, each.recordings) for each in found] == [("fitted", "fitted"), ("fitted", "held-out")]
    assert (found[0].built, found[0].found) == (0.004, 0.0044) and math.isnan(found[1].found)
    told = Result.from_json(json.loads(json.dumps(replace(result, worse_replays=found).to_json())))
    said = ("Plain replays are worse than those of the model as built: fitted parameters 0.004 -> 0.0044 rad on fitted "
            "recordings and 0.004 -> diverges on held-out recordings.")  # fmt: skip
    assert f"warning {said}" in " ".join(summary(told).split())
    assert said.replace("->", "→") in " ".join(text_of(html(told)).replace(words.NO_BREAK, " ").split())


def test_a_replay_that_diverges_has_no_error() -> None:
    """NaN is null in JSON, and a word in the table."""
    result = RESULTS["adequate"]()
    diverging = replace(result, robots=(replace(result.robots[0], train=math.nan), *result.robots[1:]))
    read = Result.from_json(json.loads(json.dumps(diverging.to_json())))
    assert summary(read).splitlines()[2].split() == ["model", "as", "built", "diverges", "0.0009", "rad"]


@pytest.mark.parametrize("name", RESULTS)
def test_every_error_and_magnitude_has_a_unit(name: str) -> None:
    """Errors have the signal's unit, and estimates have theirs unless they are ratios."""
    result = RESULTS[name]()
    unit = words.shown_unit(result.robot.unit)[1]
    text = " ".join(summary(result).split())
    cells = [
        cell for row in replay_errors.replays(result) for cell in row[1:] if cell not in ("", "no effects", "none")
    ]
    assert len(cells) >= 2 and {cell.split(words.NO_BREAK)[1] for cell in cells} == {unit}
    assert re.search(rf"noise {NUMBER} {unit}", text)
    for each in [e for f in result.findings for e in f.estimates if e.unit != "1"]:
        assert words.estimate(each).endswith(words.NO_BREAK + words.shown_unit(each.unit, each.value)[1])
    for each in result.detectable:
        if each.unit != "1":
            assert re.search(rf"{NUMBER} {UNITS}", words.detectable(each).replace(words.NO_BREAK, " ")), each


def test_lengths_are_in_mm_and_pressures_in_kpa_or_mpa() -> None:
    numbers = ((0.00123, "m"), (2e6, "Pa"), (5e4, "Pa"), (0.19, "N s^2/m^2"), (0.9, "1"))
    texts = [words.number(*each).replace(words.NO_BREAK, " ") for each in numbers]
    assert texts == ["1.23 mm", "2 MPa", "50 kPa", "0.19 N s²/m²", "0.9"]


def test_every_law_has_an_equation() -> None:
    assert EQUATIONS.keys() == catalogue.ALL.keys()


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_becomes_all_files(name: str, tmp_path: Path) -> None:
    result = RESULTS[name]()
    assert render(result, tmp_path) == summary(result)
    expected = {"report.html", "comparison.rrd", "effects.json", "result.json"}
    expected |= {"posterior.json"} if result.trainable else set()
    expected |= {"patched_model.xml"} if result.patch.model else set()
    expected |= {"next_actions.csv"} if result.next_recording else set()
    assert {each.name for each in tmp_path.iterdir()} == expected


def test_renderers_import_neither_robots_nor_models_nor_mujoco(tmp_path: Path) -> None:
    """In a fresh process that renders all that there is."""
    RESULTS["trunk friction"]().save(tmp_path / "result.json")
    program = """
import sys
from soro_bench.diagnosis.render import render
from soro_bench.diagnosis.result import Result
render(Result.load(sys.argv[1] + "/result.json"), sys.argv[1] + "/out")
print(*sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    stages = ("robots", "estimation", "selection", "localisation", "assembly", "pipeline")
    forbidden = ("mujoco", "soro_bench.models", "soro_bench.envs", *(f"soro_bench.diagnosis.{each}" for each in stages))
    loaded = done.stdout.split()
    assert not [each for each in loaded if each.startswith(tuple(f"{f}." for f in forbidden)) or each in forbidden]


if __name__ == "__main__":
    SNAPSHOTS.parent.mkdir(exist_ok=True)
    SNAPSHOTS.write_text(shown(), encoding="utf-8")


def test_error_of_a_replay_counts_measured_numbers_only() -> None:
    measured = np.array([[[1.0], [np.nan]], [[np.nan], [np.nan]], [[3.0], [4.0]]])
    found = rmse(measured, np.zeros((3, 2, 1)))
    assert found == pytest.approx([1.0, np.nan, np.sqrt(12.5)], nan_ok=True)


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "width", 80)


def test_a_recording_is_described_without_a_cut_cell(capsys):
    time = np.arange(3.0)
    values = np.array([-0.00012345, 7.891e-05, np.nan])
    plain = {name: Signal(time, values, "m/s^2", "world") for name in ("link_quaternion", "object_quaternion")}
    _describe(Recording({"action": Signal(time, np.zeros((3, 8)))}, plain), Path("a.parquet"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    header = lines[1].split()
    assert header == ["signal", "samples", "per", "s", "shape", "unit", "frame", "least", "largest", "gaps"]
    assert lines[-1].split() == ["object_quaternion", "3", "1", "m/s^2", "world", "-0.0001234", "7.891e-05", "1"]
    assert lines[3].split() == ["action", "3", "1", "8", "1", "0", "0"]


def test_a_long_name_goes_on_in_the_next_line(capsys):
    signals = {"q" * 64: Signal(np.arange(100_000.0), np.full((100_000, 2, 2), -1.234e-5), "y" * 32, "Z" * 32)}
    _describe(Recording({}, signals), Path("a.parquet"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert (text.count("q"), text.count("y"), text.count("Z")) == (64 + text.split("signal")[0].count("q"), 32, 32)
    assert "…" not in text


def test_the_list_of_environments_has_every_cell(call):
    text = call("list")
    assert max(map(len, text.splitlines())) <= 80
    for parameter in (p for env_id in ENV_IDS for p in task_type(env_id).parameters.parameters.values()):
        rows = [line for line in text.splitlines() if line.split()[:1] == [parameter.name]]
        cells = ["{:g} .. {:g}".format(*pair) for pair in (parameter.bounds, parameter.search)]
        assert any(all(cell in row for cell in cells) for row in rows)
        assert set(parameter.meaning.split()) <= set(text.split())


@pytest.mark.parametrize(("left", "said"), [(0.2, "leave 200 mm of the motion."), (math.nan, "diverge.")])
def test_a_replay_that_leaves_most_of_the_motion_leaves_the_verdict_open(left, said):
    result = RESULTS["adequate"]()
    robots = tuple(replace(each, heldout=left) for each in result.robots)
    told = replace(result, verdict="undecided", robots=robots, robot=replace(result.robot, unit="m"))
    assert " ".join(summary(told).split()).startswith(f"Undecided: plain replays {said}")
    assert not told.detected and told.answer == "undecided"
    assert any("short pieces" in each for each in sentences.warnings(told))


@pytest.mark.parametrize("name", ["payload", "coulomb_friction"])
def test_the_mass_of_a_payload_is_said_to_be_at_the_centre_of_its_body(name):
    result = RESULTS["trunk friction"]()
    (found,) = sentences.best_findings(result)
    told = replace(result, findings=(replace(found, name=name, location=Location("body", "hand")),))
    assert any("centre of mass of body hand" in each for each in sentences.warnings(told)) == (name == "payload")
