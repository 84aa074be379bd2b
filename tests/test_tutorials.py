"""The tutorials as notebooks; their code runs when the documentation site is built."""

import importlib.util
import json
from pathlib import Path

import pytest

PATH = Path(__file__).parents[1] / "docs" / "tutorials.py"
if not PATH.exists():
    pytest.skip("needs a checkout", allow_module_level=True)
spec = importlib.util.spec_from_file_location("tutorials", PATH)
tutorials = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tutorials)
PAGES = [path for path in sorted(tutorials.PAGES.glob("*.md")) if path.name != "index.md"]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_notebook_has_the_code_of_its_page_in_the_same_order(path):
    page = path.read_text()
    cells = json.loads(tutorials.notebook(page))["cells"]
    code = ["".join(cell["source"]).removeprefix("%%bash\n") for cell in cells if cell["cell_type"] == "code"]
    assert code == [block.strip("\n") for _, block in tutorials.BLOCK.findall(page)]
    assert "<!-- check" not in json.dumps(cells)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
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
