"""The pages that are made from the code."""

import re
import runpy
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_the_reference_is_what_the_code_says():
    """If not: python docs/generate.py."""
    pages = runpy.run_path(str(DOCS / "generate.py"))["pages"]()
    environments = {path for path in (DOCS / "reference" / "environments").glob("*-v*.md")}
    assert environments <= pages.keys()
    for path, text in pages.items():
        assert path.read_text() == text, path.name


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
