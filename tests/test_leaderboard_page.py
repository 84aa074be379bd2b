"""The page of the leaderboard: figures, links, and nothing of an entry that a browser would execute."""

import json
import re
import shutil
import subprocess
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("jinja2", reason="needs the board extra")
pytest.importorskip("jsonschema", reason="needs the board extra")
pytest.importorskip("matplotlib", reason="needs the board extra")

from soro_bench.files import write_json
from soro_bench.leaderboard.entry import write_entry
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.page import build
from soro_bench.leaderboard.plots import plot_curves
from soro_bench.leaderboard.statistics import (
    chance_of_difference,
    interquartile_mean,
    interval,
    probability_of_improvement,
)
from soro_bench.leaderboard.verify import verify_control
from tests.results import BOARD, edit, gates, policy, put_policy, scores, shrink_board, true_entry
from tests.test_bad_input import says

SCRIPT = "<script>document.title = 'taken'</script><img src=x onerror=alert(1)>"
CHROMIUM = shutil.which("chromium")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync")  # fmt: skip
DIAGNOSIS = {
    "format": "soro_bench/diagnosis/1", "entry": SCRIPT, "method": "guessing",
    "set": {"seed": 1, "count": 30, "nulls": 10, "commitment": 64 * "a"},
    "gates": gates(0.05),
    "confusion": [{"truth": "friction", "said": "delay", "cases": 1}, {"truth": "payload", "said": "tilt", "cases": 3}],
    "calibration": [{"cases": 5, "stated": 0.9, "right": 0.8}],
    "ablations": [{"variant": "raw BIC", "cases": 9, "false alarms": None}], "versions": {},
}  # fmt: skip


class Table(HTMLParser):
    """The texts of all cells, by row."""

    def __init__(self, page):
        super().__init__()
        self.rows, self._text = [], None
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._text = ""

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.rows[-1].append(" ".join(self._text.split()))
            self._text = None

    def handle_data(self, data):
        if self._text is not None:
            self._text += data


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Three methods: 1 and 2 mm, 2 and 30 mm of two seeds, 100 mm of one; the last's names are hostile."""
    shrink_board(monkeypatch)
    folder, curve = tmp_path / "results", {"curve": {"steps": [100, 200], "final_mm": [30.0, 20.0]}}
    for method, finals in (("oracle", (1.0, 2.0)), ("udr", (2.0, 30.0)), ("mine", (100.0,))):
        for seed, final in enumerate(finals):
            trained = policy(seed, method=method, model=SCRIPT if method == "mine" else "cable")
            write_entry(folder, BOARD, "ours", trained, scores(final, final), None, curve)
    write_json(folder / "diagnosis" / "ours.json", DIAGNOSIS)
    return folder


def test_the_table_has_the_figures_of_every_method_the_best_first(results, tmp_path):
    page = build(results, tmp_path / "site").read_text()
    rows = [row for row in Table(page).rows if len(row) > 7][:4]
    assert [row[0] for row in rows] == ["method", *(f"{name} ours, trained on cable" for name in ("oracle", "udr")),
                                        f"mine ours, trained on {SCRIPT}"]  # fmt: skip
    oracle, udr, mine = rows[1:]
    assert oracle[2:7] == ["1.50 [1.00, 2.00]", "1.50 [1.00, 2.00]", "0 %", "reference", "2"]
    assert udr[3] == "16.00 [2.00, 30.00]"
    assert udr[5].startswith("0.12 [")  # one tie in four pairs
    assert mine[2:7] == ["100.00", "100.00", "0 %", "0.00", "1"]  # one seed: no interval


@pytest.mark.parametrize(("methods", "reference"), [(("oracle", "no_dr"), "oracle"), (("udr", "no_dr"), "no_dr")])
def test_the_reference_is_the_oracle_and_without_one_what_was_trained_without_randomisation(
    methods, reference, monkeypatch, tmp_path
):
    """Also where no_dr is better than the oracle."""
    shrink_board(monkeypatch)
    for method, final in zip(methods, (2.0, 1.0), strict=True):
        write_entry(tmp_path / "results", BOARD, "ours", policy(0, method=method), scores(final, final))
    page = build(tmp_path / "results", tmp_path / "site").read_text()
    assert [row[0].split()[0] for row in Table(page).rows if "reference" in row] == [reference]


@pytest.mark.parametrize(
    ("best", "second", "said"),
    [
        ((1.0, 1.1, 1.2), (2.0, 2.1, 2.2), "which is not sure (p = 0.1, 3 and 3 seeds)"),  # 2 of 20 ways to deal them
        # 4 of 252: the worst of the one and the best of the other may change places, as neither is in the middle half
        ((1.0, 1.1, 1.2, 1.3, 1.4), (2.0, 2.1, 2.2, 2.3, 2.4), "which is sure (p = 0.016, 5 and 5 seeds)"),
        ((1.0,), (2.0,), "which is not sure (p = 1, 1 and 1 seeds)"),
        ((1.0,), (2.0, 2.1, 2.2), "which is not sure (p = 1, 1 and 3 seeds)"),
        ((1.0,), (), "and alone"),
    ],
)
def test_a_board_says_who_is_best_and_whether_that_is_sure(best, second, said, tmp_path, monkeypatch):
    shrink_board(monkeypatch)
    for method, finals in (("udr", second), ("rf_dropo", best)):
        for seed, final in enumerate(finals):
            write_entry(tmp_path / "results", BOARD, "ours", policy(seed, method=method), scores(final, final))
    page = build(tmp_path / "results", tmp_path / "site").read_text()
    assert f"rf_dropo is best ({np.mean(best):.2f} mm), " in page and said in page


def test_the_page_shows_the_gates_and_the_worst_confusions_first(results, tmp_path):
    rows = Table(build(results, tmp_path / "site").read_text()).rows
    assert ["false alarms", "20", "0.05 [0, 0.1]", "≤ 0.03", "missed"] in rows
    assert ["detected", "0", "", "≥ 0.95", "no cases"] in rows
    assert rows.index(["payload", "tilt", "3"]) < rows.index(["friction", "delay", "1"])


def test_diagnoses_are_compared_those_that_meet_most_gates_first(results, tmp_path):
    write_json(results / "diagnosis" / "theirs.json", {**DIAGNOSIS, "entry": "theirs", "gates": gates(0.01)})
    rows = Table(build(results, tmp_path / "site").read_text()).rows
    first = next(i for i, row in enumerate(rows) if row[:3] == ["entry", "criteria met", "false alarms"])
    assert [row[:4] for row in rows[first + 1 : first + 3]] == [
        ["theirs", "1 of 1", "0.01", ""],
        [SCRIPT, "0 of 1", "0.05", ""],
    ]


def test_names_are_escaped_and_nothing_is_loaded(results, tmp_path):
    page = build(results, tmp_path / "site").read_text()
    assert SCRIPT not in page and "&lt;script&gt;document.title" in page
    assert page.count("<script") == 1 and "<img" not in page
    addresses = re.findall(r"(?:src|href)=\"([^\"]+)", page)
    assert addresses and not [a for a in addresses if re.match(r"[a-z]+:|//", a)]
    assert "default-src 'none'" in page


def test_links_lead_to_files_that_verify(results, tmp_path, monkeypatch):
    true_entry(results, "true")
    page = build(results, tmp_path / "site").read_text()
    links = re.findall(r"href=\"([^\"#]+)\"", page)
    assert len(links) == len(set(links)) == 12
    assert all((tmp_path / "site" / link).is_file() for link in links)
    copied = tmp_path / "site" / "results" / BOARD / "true" / "oracle" / "seed0.json"
    assert verify_control(copied, num_threads=1) == {"cable": "same"}


def test_names_in_plots_are_unlike_one_another(results, tmp_path):
    page = build(results, tmp_path / "site").read_text()
    ids = re.findall(r"\bid=\"([^\"]+)", page)
    assert page.count("<svg") == 3 and len(ids) == len(set(ids))
    assert set(re.findall(r"(?:href=\"#|url\(#)([^\")]+)", page)) <= set(ids)


@pytest.mark.parametrize(("final", "alike"), [([0.0, 0.0], True), ([0.0, 5.0], False)])
def test_a_curve_that_is_nothing_but_zeros_is_drawn_without_logarithms(final, alike):
    curve = {"curve": {"steps": [0, 100], "final_mm": final}}
    group = SimpleNamespace(name="ours", entry="udr", entries=[(None, {"training": curve})])
    drawn = [plot_curves([group], "curves", "mm", scale) for scale in ("log", "linear")]
    assert (drawn[0] == drawn[1]) == alike


def test_a_page_among_the_entries_is_refused_and_one_beside_them_is_not(results):
    with pytest.raises(ValueError, match=says("is within", "choose another folder")):
        build(results, results)
    assert build(results, results.parent).parent == results.parent


def test_a_folder_without_entries_gives_a_page_that_says_so(tmp_path):
    (tmp_path / "results").mkdir()
    assert build(tmp_path / "results", tmp_path / "site").read_text().count("No entry yet.") == 2


def _break_score(results):
    edit(results / BOARD / "ours" / "udr" / "seed1.json", lambda entry: entry.update(seed=-1))


def _move(results):
    shutil.move(results / BOARD / "ours" / "udr", results / BOARD / "ours" / "dropo")


def _mix(results):
    edit(results / BOARD / "ours" / "udr" / "seed1.json", lambda entry: entry.update(trained_on="flex"))


def _shorten(results):
    edit(results / BOARD / "ours" / "udr" / "seed1.json", lambda entry: entry.update(steps=5))


def _spoil_policy(results):
    (results / BOARD / "ours" / "udr" / "seed1.safetensors").write_bytes(b"spoilt")


def _spoil_diagnosis(results, **fields):
    edit(results / "diagnosis" / "ours.json", lambda entry: entry["gates"][0].update(fields))


def _invent_gates(results):
    edit(results / "diagnosis" / "ours.json", lambda entry: entry["gates"].extend(entry["gates"]))


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (_break_score, ("udr/seed1.json", "seed is -1")),
        (_move, ("dropo/seed0.json", "belongs to", "udr/seed0.json")),
        (_mix, ("udr/seed1.json", "trained_on is 'flex'", "'cable'", "seed0.json")),
        (_shorten, ("udr/seed1.json", "steps is 5", "seed0.json")),
        (_spoil_policy, ("udr/seed1.safetensors", "SHA-256")),
        (partial(_spoil_diagnosis, cases="many"), ("diagnosis/ours.json", "gates.0.cases is 'many'")),
        (
            partial(_spoil_diagnosis, bar=0.5, met=True),
            ("diagnosis/ours.json", "not those of soro-bench blind", "0.5"),
        ),
        (partial(_spoil_diagnosis, met=True), ("diagnosis/ours.json", "false alarms is 0.05", "cannot be True")),
        (_invent_gates, ("diagnosis/ours.json", "not those of soro-bench blind", "twice")),
        (lambda results: write_json(results / "note.json", {}), ("note.json", "required property")),
    ],
)
def test_one_invalid_entry_stops_the_page_before_anything_is_written(results, tmp_path, spoil, parts):
    spoil(results)
    with pytest.raises(ValueError, match=says(*parts)):
        build(results, tmp_path / "site")
    assert not (tmp_path / "site").exists()


def test_what_an_older_trainer_made_stands_apart_and_is_not_compared(results, tmp_path):
    new = results / BOARD / "ours" / "oracle" / "seed0.json"
    edit(new, lambda entry: entry["training"].update(trainer=2))
    rows = [row for row in Table(build(results, tmp_path / "site").read_text()).rows if "ours" in row[0]]
    compared = {row[0].split(" ours")[0]: row[5] for row in rows}
    assert compared.pop("oracle") == "reference"
    assert compared and all("(old)" in name and not text for name, text in compared.items())


def test_the_best_policy_of_a_method_is_recorded_and_linked(results, tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    from soro_bench.envs.trunk_reach import TrunkReachTask

    monkeypatch.setattr(TrunkReachTask, "accurate", "cable")  # which takes no time
    assert "recording of the best" not in build(results, tmp_path / "site").read_text()
    page = build(results, tmp_path / "site", record=True).read_text()
    recordings = re.findall(r"href=\"(recordings/[^\"]+)", page)
    stems = [re.sub("-[0-9a-f]{8}[.]rrd", "", recording) for recording in sorted(recordings)]
    assert stems == [f"recordings/{BOARD}/ours/{method}-cable" for method in ("mine", "oracle", "udr")]
    assert all((tmp_path / "site" / recording).stat().st_size > 1000 for recording in recordings)
    put_policy(results / BOARD / "ours" / "mine" / "seed0.json", "seed0.safetensors", policy(9).to_bytes())
    page = build(results, tmp_path / "site").read_text()
    assert sorted(re.findall(r"href=\"(recordings/[^\"]+)", page)) == sorted(recordings)[1:]


def browsed(path, folder):
    """The document as a browser has it after its scripts have run."""
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "--dump-dom", path.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_sorts_by_the_headers_and_runs_no_script_from_a_name(results, tmp_path):
    """The first click sorts by what is shown, the second the other way round."""
    path = build(results, tmp_path / "site")
    page = path.read_text()
    shown = browsed(path, tmp_path / "profile")
    assert "<title>soro_bench leaderboard</title>" in shown
    assert shown.count("<button") == shown.count("<th ") - 1  # of links nothing can be sorted
    clicks = {"IQM [mm]": 2, "method": 1}
    for header, number in clicks.items():
        click = f"""for (const b of document.querySelectorAll("table.sortable button"))
            if (b.textContent === {json.dumps(header)}) for (let i = 0; i < {number}; i++) b.click();"""
        changed = re.sub(r"<meta http-equiv=.*>", "", page).replace("</body>", f"<script>{click}</script></body>")
        (tmp_path / "site" / "clicked.html").write_text(changed)
        shown = browsed(tmp_path / "site" / "clicked.html", tmp_path / "profile")
        order = [row[0].split()[0] for row in Table(shown).rows if len(row) > 7][1:4]
        assert order == {"IQM [mm]": ["mine", "udr", "oracle"], "method": ["mine", "oracle", "udr"]}[header]
        assert f'aria-sort="{ {1: "ascending", 2: "descending"}[number] }"' in shown
        assert "taken" not in re.search(r"<title>.*</title>", shown)[0]


def test_the_same_entries_give_the_same_page(results, tmp_path):
    assert build(results, tmp_path / "a").read_bytes() == build(results, tmp_path / "b").read_bytes()


def test_every_entry_of_the_repository_is_valid():
    shipped = Path(__file__).parents[1] / "leaderboard" / "results"
    if not shipped.is_dir():
        pytest.skip("needs a checkout")
    assert "TrunkReach-v0" in gather_control(shipped)


def test_methods_are_told_apart_by_what_they_are_ranked_by():
    """The interquartile mean: two seeds of ten that fail do not count, though by means they decide."""
    best, second = np.array([[1.0]] * 8 + [[100.0]] * 2), np.full((10, 1), 2.0)
    assert interquartile_mean(best) < interquartile_mean(second) and best.mean() > second.mean()
    assert chance_of_difference(best, second) < 0.05


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end():
    assert interquartile_mean(np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 100.0]])) == 4.5
    assert interquartile_mean(np.array([[1.0, 2.0, 9.0]])) == 4.0  # less than four values: their mean


@pytest.mark.parametrize(
    ("values", "reference", "higher", "expected"),
    [
        ([[1.0], [2.0]], [[3.0], [4.0]], False, 1.0),
        ([[1.0], [2.0]], [[3.0], [4.0]], True, 0.0),
        ([[1.0], [2.0]], [[1.0], [2.0]], False, 0.5),
        ([[1.0], [3.0], [3.0]], [[2.0]], True, 2 / 3),
        ([[1.0, 9.0]], [[2.0, 2.0]], False, 0.5),  # better at one start, worse at the other
    ],
)
def test_probability_of_improvement_counts_pairs_and_half_the_ties(values, reference, higher, expected):
    assert probability_of_improvement(np.array(values), np.array(reference), higher) == pytest.approx(expected)


def test_an_interval_is_that_of_the_mean_of_independent_seeds():
    """And not narrower where seeds differ at all their starts together."""
    values = np.random.default_rng(1).normal(size=(400, 1))
    low, high = interval(np.mean, (values,), np.random.default_rng(0))
    assert low == pytest.approx(values.mean() - 1.96 * values.std() / 20, abs=0.02)
    assert high == pytest.approx(values.mean() + 1.96 * values.std() / 20, abs=0.02)
    assert interval(np.mean, (np.repeat(values, 27, axis=1),), np.random.default_rng(0)) == pytest.approx((low, high))


def test_one_seed_has_no_interval():
    rng = np.random.default_rng(0)
    assert interval(np.mean, (np.ones((1, 5)),), rng) is None
    assert interval(lambda a, b: 0.0, (np.ones((3, 5)), np.ones((1, 5))), rng) is None
