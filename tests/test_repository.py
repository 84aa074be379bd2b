"""The weight of the repository: what a clone has to carry. And words that the field does not use.

Words with an ordinary meaning (floor, place, bar, gate, excess, lead, rough, twin in data) are matched in phrases only,
or not at all. Names in old formats are allowed as they stand there.
"""

import re
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


OLD = (
    r"suspects?", r"twins?", r"akin", r"numerical floor", r"(?:best|screened) leads?", r"suspects and leads",
    r"lead promises", r"still_promised", r"polish(?:ed)?", r"persevered", r"exchanged", r"plainer", r"misled", r"nulls",
    r"by hand", r"audit", r"concealed", r"proofs?", r"prove[ds]?", r"commitment", r"has no name", r"without a name",
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
    "tests/test_leaderboard_diagnosis.py",
    "tests/test_recording.py",
    "tests/test_repository.py",
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
