"""The pages that are made from the code."""

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
    page = (DOCS / "reproduction.md").read_text()
    assert runpy.run_path(str(DOCS.parent / "leaderboard" / "reproduction.py"))["filled"](page) == page


def test_the_pages_have_the_releases_as_they_were_scored():
    """If not: put what python benchmarks/final_sets.py prints there."""
    script = runpy.run_path(str(DOCS.parent / "benchmarks" / "final_sets.py"))
    files = script["releases"]()
    assert script["gates"](files[-1:]) in (DOCS / "diagnosis.md").read_text()
    for name in ("gates", "unseen"):
        assert script[name](files) in (DOCS / "proof.md").read_text(), name


def test_the_page_of_real_robots_has_what_their_studies_have_found():
    """If not: put the two tables that python benchmarks/real_robots.py prints there."""
    script = runpy.run_path(str(DOCS.parent / "benchmarks" / "real_robots.py"))
    page = (DOCS / "real_robots.md").read_text()
    assert script["first_seed"]() in page and script["every_seed"]() in page
