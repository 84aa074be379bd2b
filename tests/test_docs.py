"""The pages that are made from the code, and the tutorials as notebooks; their code runs as the site is built."""

import importlib.util
import json
import re
import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
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
    results = json.loads((DOCS / "results" / "compatibility.json").read_text())
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
    known = interval.findall((DOCS / "archive" / "reproduction_tables.md").read_text())
    assert len(said) > 40 and set(said) <= set(known)


def test_the_pages_have_the_releases_as_they_were_scored():
    """If not: put what python benchmarks/final_sets.py prints there."""
    script = runpy.run_path(str(DOCS.parent / "benchmarks" / "final_sets.py"))
    files = script["releases"]()
    page = (DOCS / "explanation" / "benchmark.md").read_text()
    assert script["last_release"](files[-1]) in page and script["unseen"](files[-1:]) in page
    page = (DOCS / "archive" / "benchmark_releases.md").read_text()
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
