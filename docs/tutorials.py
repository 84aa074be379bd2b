"""Tutorials: their code runs while MkDocs builds the site, and each page is a notebook too.

A page is plain Markdown. Its blocks of bash and python run in order, in a folder of their own, and what they print
stands below them; blocks of any other kind are only shown. A picture is what ``plt.show()`` would show. A comment
``<!-- check: EXPRESSION -->`` is not shown: the expression has to be true in what the page's Python has come to. A
block that fails, or a check, ends a strict build.

    python docs/tutorials.py --out notebooks     # the pages as .ipynb files, not executed
    make docs                                    # the site; mkdocs alone builds it without running them
"""

import argparse
import base64
import inspect
import io
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import jupytext

PAGES = Path(__file__).parent / "tutorials"
BLOCK = re.compile(r"^```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NOTHING = re.compile(r'<div class="[^"]*highlight"><pre><span></span><code>\s*</code></pre></div>')
CHECK = re.compile(r"^<!-- check: (.+?) -->\n", re.MULTILINE)


# as at the top of a page that Jupytext reads: bash blocks become cells that begin with %%bash
PYTHON = "---\njupyter:\n  kernelspec: {name: python3, display_name: Python 3, language: python}\n---\n\n"


def notebook(page: str) -> str:
    """A page as the text of an .ipynb file."""
    return jupytext.writes(jupytext.reads(PYTHON + CHECK.sub("", page), fmt="md"), fmt="ipynb")


def executable(page: str, session: str, folder: str) -> str:
    """A page with the options of markdown-exec at its blocks, which run in ``folder``."""

    def with_options(match: re.Match) -> str:
        language, code = match.groups()
        result = 'html="yes"' if "plt.show()" in code else 'result="text"'
        return (f'```{language} exec="yes" source="above" {result} session="{session}" workdir="{folder}" width="80"\n'
                f"{code}```")  # fmt: skip

    def hidden(match: re.Match) -> str:
        return f'```python exec="yes" session="{session}" workdir="{folder}"\nassert {match[1]}, {match[1]!r}\n```\n'

    return CHECK.sub(hidden, BLOCK.sub(with_options, page))


def show(*_args, **_options) -> None:
    """Print the open figures as HTML, by the ``print`` of the page's code that asks for them."""
    import matplotlib.pyplot as plt

    frame = inspect.currentframe()
    while not frame.f_code.co_filename.startswith("<code block"):
        frame = frame.f_back
    for number in plt.get_fignums():
        figure, picture = plt.figure(number), io.BytesIO()
        figure.savefig(picture, format="svg", metadata={"Date": None})
        said = figure.get_suptitle() or " and ".join(filter(None, (axes.get_title() for axes in figure.axes)))
        data = base64.b64encode(picture.getvalue()).decode()
        frame.f_globals["print"](f'<img alt="{said}" src="data:image/svg+xml;base64,{data}">')
    plt.close("all")


# ---- what MkDocs calls -----------------------------------------------------------------------------------------------


def on_config(config):
    """Commands of this interpreter's environment are found, and figures are shown in the page."""
    if _wanted():
        import matplotlib

        matplotlib.use("agg")
        import matplotlib.pyplot as plt

        plt.show = show
        os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def on_files(files, config):
    """Every tutorial has a notebook beside it."""
    from mkdocs.structure.files import File

    for path in _paths():
        name = f"{PAGES.name}/{path.stem}.ipynb"
        files.append(File.generated(config, name, content=notebook(path.read_text(encoding="utf-8"))))
    return files


def on_page_markdown(markdown, page, config, files):
    """A tutorial runs as it is rendered."""
    path = Path(page.file.abs_src_path or "")
    if path not in _paths():
        return None
    markdown += f"\n\n[This page as a notebook]({path.stem}.ipynb)\n"
    if not _wanted():
        return markdown
    page.meta["folder"] = folder = tempfile.mkdtemp(prefix="soro_bench_tutorial_")
    return executable(markdown, path.stem, folder)


def on_page_content(html, page, config, files):
    """Its files are removed after that, and boxes for what a block has not printed."""
    if not (folder := page.meta.pop("folder", None)):
        return None
    shutil.rmtree(folder)
    return NOTHING.sub("", html)


def _wanted() -> bool:
    return os.environ.get("SORO_BENCH_TUTORIALS") == "run"


def _paths() -> list[Path]:
    return sorted(path for path in PAGES.glob("*.md") if path.name != "index.md")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to write the notebooks into")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for path in _paths():
        (out / f"{path.stem}.ipynb").write_text(notebook(path.read_text(encoding="utf-8")), encoding="utf-8")
        print(out / f"{path.stem}.ipynb")
