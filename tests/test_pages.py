"""The pages of the documentation: short sentences, short pages, links that lead somewhere, pictures that load fast."""

import importlib.util
import re
import runpy
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
    archive = (DOCS / "archive" / "index.md").read_text()
    assert [path.name for path in (DOCS / "archive").glob("*.md") if f"({path.name})" not in archive] == ["index.md"]


def test_every_environment_has_a_picture_that_loads_fast():
    from soro_bench.registration import ENV_IDS

    for env_id in ENV_IDS:
        assert 0 < (DOCS / "images" / f"{env_id}.gif").stat().st_size <= LARGEST_GIF, env_id


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
