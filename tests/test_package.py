"""The package: its assets, its registration, what importing it does not need; the weight of its repository; old words.

Words with an ordinary meaning (floor, place, bar, gate, excess, lead, rough, twin in data) are matched in phrases only,
or not at all. Names in old formats are allowed as they stand there.
"""

import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import soro_bench
from benchmarks.trunk_models import RECORDED, SEQUENCES, TOLERANCE, copies
from soro_bench.files import mjcf_path, read_json, write_json
from soro_bench.leaderboard.strict import read_strict

ROOT = Path(__file__).parents[1]
MAX_FILES, MAX_BYTES = 510, 30_000_000  # half of it policies, of which all seeds are kept


@pytest.fixture(scope="module")
def tracked():
    """Paths of the tracked files."""
    try:
        run = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs a git checkout")
    if "tests/test_package.py" not in (names := run.stdout.split("\0")):
        pytest.skip("needs a git checkout of this repository")
    return [path for name in names if name and (path := ROOT / name).is_file()]


def test_the_tree_stays_small(tracked):
    """If not: pack results (soro-bench leaderboard pack, benchmarks/releases.py), or leave them to the history."""
    assert len(tracked) <= MAX_FILES
    assert sum(path.stat().st_size for path in tracked) <= MAX_BYTES


def test_every_figure_is_on_a_page(tracked):
    pages = [path.read_text() for path in tracked if path.suffix == ".md"]
    figures = [path for path in tracked if path.parent == ROOT / "docs" / "images" and path.suffix in (".png", ".gif")]
    assert [path.name for path in figures if not any(path.name in page for page in pages)] == []


OLD = (
    r"suspects?", r"twins?", r"akin", r"numerical floor", r"(?:best|screened) leads?", r"suspects and leads",
    r"lead promises", r"still_promised", r"polish(?:ed)?", r"persevered", r"exchanged", r"plainer", r"misled", r"nulls",
    r"by hand", r"audit", r"concealed", r"proofs?", r"prove[ds]?", r"commitment", r"has no name", r"without a name",
    r"ports", r"gates? (?:is |are )?(?:met|missed)", r"kind and name of a port", r"at a port", r"and its place",
    r"what acts", r"static_one_sided", r"dry_loss", r"rate_independent_memory", r"nats left", r"clouds", r"heat",
)  # fmt: skip
FORMATS = re.compile(  # names of files, keys and options of releases
    r'commitment\.txt|"commitment"|set\.commitment|"nulls"|set\.nulls|--nulls|"still_promised"|"audit"'
)
HISTORY = ("CHANGELOG.md", "docs/archive/", "docs/results/", "leaderboard/results/")
READERS = {  # of old formats and names, and of tables that call an absent number null
    "benchmarks/real_robots.py",
    "soro_bench/blind_benchmark/report.py",
    "soro_bench/cli.py",
    "soro_bench/diagnosis/baseline.py",
    "soro_bench/effects/effect.py",
    "soro_bench/recording/parquet.py",
    "tests/test_blind_benchmark_score.py",
    "tests/test_blind_set.py",
    "tests/test_leaderboard_diagnosis.py",
    "tests/test_recording.py",
    "tests/test_package.py",
}


def _files() -> list[str]:
    command = ["git", "ls-files", "*.py", "*.md", "*.html", "*.toml"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("not a checkout")
    return [name for name in found.stdout.split() if not name.startswith(HISTORY) and name not in READERS]


def test_old_words_do_not_come_back():
    pattern, odd = re.compile(rf"\b(?:{'|'.join(OLD)})\b", re.IGNORECASE), []
    for name in _files():
        text = FORMATS.sub("", (ROOT / name).read_text()) if (ROOT / name).exists() else ""
        odd += [f"{name}: {found[0]}" for found in pattern.finditer(text)]
    assert not odd


def test_scripts_that_texts_name_are_there():
    pattern = re.compile(r"(?<![\w/])(?:benchmarks|docs|leaderboard)/\w+\.py\b(?!` of commit)")
    named = {(name, script) for name in _files() for script in pattern.findall((ROOT / name).read_text())}
    assert len(named) > 50 and sorted(each for each in named if not (ROOT / each[1]).exists()) == []


CHECKOUT = Path(soro_bench.__file__).parents[1]
EPISODE_STEPS = {"TrunkReach": 100, "TrunkPush": 100, "TrunkLift": 100, "TrunkGrasp": 100, "MultiGait": 6}
USE = "import gymnasium; env = gymnasium.make('soro_bench:TrunkPush-v0', model='cable'); env.reset(seed=0); env.step(3)"


def run_python(code, cwd):
    """Run ``code`` in a fresh interpreter that finds packages in ``cwd`` first; return what it printed."""
    run = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


@pytest.mark.parametrize("name", ["trunk.xml", "push.xml", "lift.xml"])
def test_assets_are_found(name):
    """Every scene file is found."""
    assert mjcf_path(name).read_text().startswith("<!--")


def test_missing_asset():
    """A file that is not there is named."""
    with pytest.raises(FileNotFoundError, match=r"moon\.xml"):
        mjcf_path("moon.xml")


@pytest.mark.parametrize("env_id", soro_bench.ENV_IDS)
def test_import_registers_environments(env_id):
    """Importing the package registers its environments, single and vector."""
    spec = gymnasium.spec(env_id)
    assert spec.max_episode_steps == EPISODE_STEPS[env_id.split("-")[0]]
    assert spec.vector_entry_point is not None


def test_module_id_in_a_fresh_interpreter():
    """gymnasium.make("soro_bench:TrunkPush-v0") imports the package by itself."""
    assert run_python(f"{USE}; print(env.unwrapped.spec.id)", CHECKOUT) == "TrunkPush-v0"


def test_environments_need_no_extras():
    """Making and stepping an environment imports neither torch, Stable-Baselines3, Rerun, PyArrow nor other extras."""
    extras = ("torch", "stable_baselines3", "rerun", "matplotlib", "scipy", "tyro", "pyarrow", "rosbags")
    assert run_python(f"{USE}; import sys; print([m for m in {extras} if m in sys.modules])", CHECKOUT) == "[]"


def test_assets_inside_the_package(tmp_path):
    """As in an installed wheel, the package works with its assets inside it and no checkout around it."""
    shutil.copytree(CHECKOUT / "soro_bench", tmp_path / "soro_bench", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(CHECKOUT / "assets", tmp_path / "soro_bench" / "assets", dirs_exist_ok=True)
    found = run_python(f"{USE}; from soro_bench.files import mjcf_path; print(mjcf_path('push.xml'))", tmp_path)
    assert Path(found).resolve() == (tmp_path / "soro_bench/assets/mjcf/push.xml").resolve()


@pytest.mark.parametrize(
    "part",
    ["soro_bench/parameters.py", "soro_bench/arrays.py", "assets/mjcf/trunk.xml", "assets/mjcf/real/bam_servo.xml"],
)
def test_another_simulation_is_another_version_of_the_method(part, tmp_path):
    for folder in ("soro_bench", "assets"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from soro_bench.sources import method_version; print(method_version())"
    before = run_python(code, tmp_path)
    (tmp_path / part).write_text((tmp_path / part).read_text() + "\n")
    assert run_python(code, tmp_path) != before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL is asked for on Linux only")
def test_without_egl_the_package_is_imported_all_the_same():
    """With MUJOCO_GL=egl MuJoCo could not be."""
    code = "import ctypes.util, os; ctypes.util.find_library = lambda _: None; import soro_bench; print(os.environ)"
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert "MUJOCO_GL" not in run.stdout


SCRIPTS = [path for folder in ("benchmarks", "baselines", "docs/images") for path in (CHECKOUT / folder).glob("*.py")]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_scripts_import_is_there(script, monkeypatch):
    """Slow scripts are not run by tests; what they take from the package still has to exist."""
    pytest.importorskip("stable_baselines3", reason="needs all extras")
    monkeypatch.syspath_prepend(script.parent)
    runpy.run_path(str(script), run_name="imported")


@pytest.mark.parametrize("script", ["benchmarks/hostile_laws.py", "benchmarks/library_programs.py", "docs/generate.py",
                                    "docs/images/gifs.py"])  # fmt: skip
def test_scripts_with_few_arguments_say_which(script, monkeypatch, capsys):
    """And do nothing else where they are only asked."""
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(CHECKOUT / script), run_name="__main__")
    assert f"python {script}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("part", "folder", "some", "name"),
    [
        ("hidden_effects", "--out", ["--only", "tilt"], "{case}"),
        ("paired_changes", "--work", ["--only", "accurate"], "{robot}_{case}"),
        ("whole_suite", "--out", ["--envs", "MultiGait-v0"], "{env}"),
    ],
)
def test_some_cases_of_a_benchmark_do_not_take_the_place_of_all(part, folder, some, name, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="needs all extras")
    module = importlib.import_module(f"benchmarks.{part}")
    cases = {name.format(**row): row for row in read_json(CHECKOUT / "docs/results/measured.json")[part]}
    for case, row in cases.items():
        if some[1] in case:
            write_json(tmp_path / f"{case}.json", row)
    write_json(results := tmp_path / "results" / "measured.json", {part: "all of them"})
    monkeypatch.setattr(module, "RESULTS", results)
    if part == "hidden_effects":
        monkeypatch.setattr(module, "zoo", lambda _: [SimpleNamespace(name=case.model) for case in module.CASES])
    monkeypatch.setattr(sys, "argv", [part, folder, str(tmp_path), *some])
    module.main()
    assert read_json(results) == {part: "all of them"}


# contacts on `flex` amplify the last bit, so that another processor sees another course
# (docs/archive/tasks_and_models.md)
COPIES = 6


@pytest.mark.parametrize("path", SEQUENCES, ids=lambda path: path.stem)
def test_sequence_holds_the_recorded_elevation(path):
    """Each copy of the object on `cable`, and one of them at least on `flex`."""
    sequence = read_strict(path)
    assert len(sequence["actions"]) == 100
    found, recorded = copies(sequence, COPIES), [sequence[key] for key in RECORDED]
    as_recorded = np.isclose(found, recorded, rtol=0, atol=TOLERANCE).all(axis=1)
    assert as_recorded.all() if sequence["model"] == "cable" else as_recorded.any(), found
