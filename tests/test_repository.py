"""The weight of the repository: what a clone has to carry."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_FILES, MAX_BYTES = 500, 20_000_000


@pytest.fixture(scope="module")
def tracked():
    """Paths of the tracked files."""
    try:
        run = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs a git checkout")
    if "tests/test_repository.py" not in (names := run.stdout.split("\0")):
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
