"""The documentation: sentences, links, pictures, pages made from the code, and what how-to pages say to write."""

import importlib.util
import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
DOCS = CHECKOUT / "docs"
LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)(?:#[^)\s]*)?\)")
CODE = re.compile(r"(?ms)^[ \t]*```.*?^[ \t]*```|`[^`\n]+`")
LARGEST_GIF = 250_000  # bytes


def load_counter():
    spec = importlib.util.spec_from_file_location("count_words", DOCS / "count_words.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where a dataclass looks up its annotations
    spec.loader.exec_module(module)
    return module


counter = load_counter()
PAGES = counter.pages()


@pytest.mark.parametrize(
    ("text", "words", "sentences"),
    [
        ("One two three. Four five.", 5, 2),
        ("A list:\n\n- one two\n- three four five\n", 7, 3),
        ("# A heading\n\nOne two.\n\n| a | table |\n|---|---|\n| of | words |\n", 2, 1),
        ("One two:\n\n```python\nprint(1)\n```\n\nThree.", 3, 2),
        ("See [a page](page.md) with `some code` and 0.5 mm of noise.", 10, 1),
        ("Tiboni et al. Show it. Next.", 6, 2),
    ],
)
def test_words_and_sentences_are_counted(text, words, sentences):
    assert counter.count(text) == counter.Count(words, sentences)


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_short_and_its_sentences_are(name):
    found = counter.count(PAGES[name].read_text())
    assert found.words <= counter.LONGEST_PAGE
    assert found.mean <= counter.LONGEST_SENTENCE


def test_all_pages_together_can_be_read():
    assert sum(counter.count(path.read_text()).words for path in PAGES.values()) <= counter.ALL_PAGES


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_files(name):
    path = PAGES[name]
    links = LINK.findall(CODE.sub("", path.read_text()))
    assert [link for link in links if not (path.parent / link).exists()] == []


def test_the_pages_that_the_code_names_exist():
    """Also those that commands and messages of errors name."""
    folders = (CHECKOUT / name for name in ("soro_bench", "assets", "benchmarks", "baselines", "tests"))
    missing = {
        (path.relative_to(CHECKOUT).as_posix(), page)
        for folder in folders
        for path in folder.rglob("*.*")
        if path.suffix in (".py", ".toml", ".xml", ".html")
        for page in re.findall(r"(?<![\w/])docs/[\w/]+\.md", path.read_text())
        if not (CHECKOUT / page).exists()
    }
    assert missing - OTHERS == set()


OTHERS = {("soro_bench/models/real_robots.py", "docs/" + "mechanical_design.md")}  # of the laboratory's repository


def test_every_page_is_in_the_navigation():
    navigation = (CHECKOUT / "mkdocs.yml").read_text()
    of_site = [name.removeprefix("docs/") for name in PAGES if name.startswith("docs/")]
    assert [name for name in of_site if name not in navigation and not name.startswith("archive/")] == []
    notes = (DOCS / "index.md").read_text()
    assert [path.name for path in (DOCS / "archive").glob("*.md") if f"(archive/{path.name})" not in notes] == []


def test_every_environment_with_a_board_has_a_picture_that_loads_fast():
    from soro_bench.leaderboard.boards import BOARDS

    for env_id in {board.env_id for board in BOARDS.values()}:
        assert 0 < (DOCS / "images" / f"{env_id}.gif").stat().st_size <= LARGEST_GIF, env_id


@pytest.mark.parametrize("env_id", ["TrunkPush-v0", "TrunkLift-v0", "TrunkGrasp-v0"])
def test_pages_say_where_the_pose_of_an_object_is_observed(env_id):
    """Not the eyelets of cables that are at rest in the same place."""
    page = (DOCS / "reference" / "environments" / f"{env_id}.md").read_text()
    pose = [f"{axis} of the object's centre" for axis in "xyz"]
    pose += [f"{axis} of the object's unit quaternion" for axis in "xyzw"]
    assert re.findall(r"(?m)^\| (?:6[6-9]|7[0-2]) \| ([^|]*) \|", page) == pose


def test_the_modules_of_the_python_reference_exist():
    pages = runpy.run_path(str(DOCS / "hooks.py"))["python_pages"]((DOCS / "reference/python/index.md").read_text())
    navigation = (CHECKOUT / "mkdocs.yml").read_text()
    assert pages and [name for name in pages if f"reference/python/{name}.md" not in navigation] == []
    modules = [name for page in pages.values() for name in re.findall(r"(?m)^::: (\S+)$", page)]
    assert len(modules) > 30
    assert [name for name in modules if importlib.util.find_spec(name) is None] == []


@pytest.mark.parametrize(
    "name", ["docs/index.md", "docs/reference/effects.md", "docs/reference/recordings.md", "docs/reference/settings.md"]
)
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"(?ms)^```python\n(.*?)^```", PAGES[name].read_text())
    assert blocks
    exec("\n".join(blocks), {})


if not DOCS.exists():
    pytest.skip("needs a checkout", allow_module_level=True)
spec = importlib.util.spec_from_file_location("tutorials", DOCS / "tutorials.py")
tutorials = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tutorials)
TUTORIALS = [path for path in sorted(tutorials.PAGES.glob("*.md")) if path.name != "index.md"]


def test_the_reference_is_what_the_code_says():
    """If not: python docs/generate.py."""
    pages = runpy.run_path(str(DOCS / "generate.py"))["pages"]()
    environments = {path for path in (DOCS / "reference" / "environments").glob("*-v*.md")}
    assert environments <= pages.keys()
    for path, text in pages.items():
        assert path.read_text() == text, path.name


def test_every_library_of_the_benchmark_has_run():
    """If not: python benchmarks/compatibility.py --venvs FOLDER."""
    results = json.loads((DOCS / "results" / "measured.json").read_text())["compatibility"]
    rows = runpy.run_path(str(DOCS.parent / "benchmarks" / "compatibility.py"))["ROWS"]
    assert [result["name"] for result in results if result["ok"] and result["did"]] == [row.name for row in rows]


def test_the_tables_of_the_reproduction_are_what_the_entries_say():
    """If not: python leaderboard/reproduction.py."""
    script = runpy.run_path(str(DOCS.parent / "leaderboard" / "reproduction.py"))
    texts = [path.read_text() for path in script["PAGES"]]
    assert [script["filled"](text) for text in texts] == texts


def test_what_is_said_of_the_published_study_is_in_its_tables():
    """Every mean with its interval."""
    interval = re.compile(r"-?\d+\.\d\d \[-?\d+\.\d\d, -?\d+\.\d\d\]")
    said = interval.findall((DOCS / "explanation" / "reproduction.md").read_text())
    known = interval.findall((DOCS / "archive" / "training_and_speed.md").read_text())
    assert len(said) > 40 and set(said) <= set(known)


def test_the_pages_have_the_releases_as_they_were_scored():
    """If not: put what python benchmarks/releases.py tables prints there."""
    script = runpy.run_path(str(DOCS.parent / "benchmarks" / "releases.py"))
    files = script["releases"]()
    page = (DOCS / "explanation" / "benchmark.md").read_text()
    assert script["last_release"](files[-1]) in page and script["unseen"](files[-1:]) in page
    page = (DOCS / "archive" / "diagnosis.md").read_text()
    assert script["all_releases"](files) in page and script["unseen"](files) in page


def test_the_page_of_real_robots_has_what_their_studies_have_found():
    """If not: put the second table that python benchmarks/real_robots.py prints there."""
    script = runpy.run_path(str(DOCS.parent / "benchmarks" / "real_robots.py"))
    assert script["every_seed"]() in (DOCS / "archive" / "real_robots.md").read_text()


def test_links_of_pages_outside_the_site_lead_somewhere():
    """Those within it are checked as it is built."""
    root = DOCS.parent
    for page in (*root.glob("*.md"), root / "leaderboard" / "README.md"):
        targets = re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text())
        missing = [target for target in targets if not (page.parent / target).exists()]
        assert targets and not missing, (page.name, missing)


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_notebook_has_the_code_of_its_page_in_the_same_order(path):
    page = path.read_text()
    cells = json.loads(tutorials.notebook(page))["cells"]
    code = ["".join(cell["source"]).removeprefix("%%bash\n") for cell in cells if cell["cell_type"] == "code"]
    assert code == [block.strip("\n") for _, block in tutorials.BLOCK.findall(page)]
    assert "<!-- check" not in json.dumps(cells)


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_begins_with_what_the_reader_can_do_after_it_and_is_checked(path):
    page = path.read_text()
    assert page.split("\n\n")[1].startswith("After this page you can")
    assert tutorials.CHECK.search(page)


def test_every_block_of_a_page_runs_in_one_folder_and_checks_are_hidden():
    page = "```bash\nls\n```\n\n```console\nls\n```\n\n```python\nplt.show()\n```\n<!-- check: a == 1 -->\n"
    text = tutorials.executable(page, "name", "/folder")
    assert text.count('exec="yes"') == text.count('workdir="/folder"') == 3
    assert text.count('source="above"') == 2 and 'html="yes"' in text
    assert "assert a == 1, 'a == 1'" in text


BLOCK = re.compile(r"```(python|diff|xml)\n(.*?)```", re.DOTALL)
FILE = re.compile(r"`((?:soro_bench|assets)/[\w/]+\.(?:py|xml))`")
TRY = """
import gymnasium, soro_bench, numpy as np
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.candidates import terms
env = gymnasium.make("FingerReach-v0", model="coarse")
start, _ = env.reset(seed=0, options={"params": {"finger_mass": 0.025}})
assert env.observation_space.contains(start)
assert env.step(2)[1] < 0
envs = gymnasium.make_vec("FingerReach-v0", num_envs=2, action="continuous")
envs.reset(seed=0)
assert envs.step(np.zeros((2, 1), np.float32))[0].shape == (2, 7)
assert terms(SuiteRobot("FingerReach-v0", threads=1))
print(soro_bench.__file__)
"""


def follow(page: str, root: Path) -> None:
    """Write the files of a page and apply its changes, each to the file that is named last before it."""
    for block in BLOCK.finditer(page):
        named = FILE.findall(page[: block.start()])
        if not named or "tests/" in page[page.rfind("\n\n", 0, block.start() - 2) : block.start()]:
            continue  # what is to be tried, and tests
        path, (kind, text) = root / named[-1], block.groups()
        if kind == "diff":
            old, new = ("".join(f"{line[1:]}\n" for line in text.splitlines() if line[:1] in f" {sign}")
                        for sign in "-+")  # fmt: skip
            assert old in path.read_text(), f"{path} has no longer what the page changes"
            path.write_text(path.read_text().replace(old, new, 1))
        elif not path.exists():
            path.write_text(text)


def test_an_environment_that_is_added_as_the_page_says_is_made_stepped_and_diagnosed(tmp_path):
    page = CHECKOUT / "docs" / "how_to" / "add_an_environment.md"
    if not page.exists():
        pytest.skip("needs a checkout")
    for folder in ("soro_bench", "assets"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    follow(page.read_text(), tmp_path)
    run = subprocess.run([sys.executable, "-c", TRY], cwd=tmp_path, capture_output=True, text=True, timeout=120,
                         env={"PYTHONPATH": str(tmp_path), "MUJOCO_GL": "egl", "PATH": ""})  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert str(tmp_path) in run.stdout
