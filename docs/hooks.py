"""What MkDocs calls while it builds the site: the Python reference is made from its list of modules, equations become
MathML, links to source files become text.

MathML needs no script and no network. Source files are no part of the site, but the same pages are read in a checkout,
where a link to one works. A link to a file that does not exist ends a strict build.
"""

import html
import logging
import re
from pathlib import Path

from latex2mathml.converter import convert

PYTHON = "reference/python"  # the page that lists the modules, and the folder of those made from it
GROUP = re.compile(r"(?m)^## (.+)\n\n((?:- `[\w.]+`\n)+)")
LOG = logging.getLogger("mkdocs.hooks.soro_bench")
EQUATION = re.compile(r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL)
ROLE = re.compile(r":(?:mod|class|func|meth|attr|data|exc):(?=<code>|<a)")  # of docstrings in reStructuredText
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:|#|/)([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files, config):
    """With a page for each group of modules, in which mkdocstrings puts their docstrings."""
    from mkdocs.structure.files import File

    for name, content in python_pages((Path(config.docs_dir) / PYTHON / "index.md").read_text()).items():
        files.append(File.generated(config, f"{PYTHON}/{name}.md", content=content))
    return files


def python_pages(listed: str) -> dict[str, str]:
    """The pages that a list of modules under headings stands for, by the first words of these headings."""
    return {
        title.split()[0].lower(): f"# Python: {title.lower()}\n\n" + re.sub(r"- `(.+)`\n", r"::: \1\n\n", modules)
        for title, modules in GROUP.findall(listed)
    }


def on_page_markdown(markdown: str, page, config, files) -> str:
    """A page with links out of docs/ as their text; in the archive, which is not kept up to date, dead ones too."""
    archived = page.file.src_uri.startswith("archive/")
    folder, root = Path(page.file.abs_src_path or config.docs_dir).parent, Path(config.docs_dir).resolve()

    def text_or_link(match: re.Match) -> str:
        target = (folder / match[2]).resolve()
        if target.is_relative_to(root) and (target.exists() or not archived):
            return match[0]
        if not target.exists() and not archived:
            LOG.warning("%s links to %s, which does not exist", page.file.src_uri, match[2])
        return match[1]

    return LINK.sub(text_or_link, markdown)


def on_page_content(content: str, page, config, files) -> str:
    """A page with its equations, LaTeX between dollar signs, as MathML, and without the roles of cross references."""
    return ROLE.sub("", EQUATION.sub(_mathml, content))


def _mathml(match: re.Match) -> str:
    inline, block = match[2], match[3]
    latex = html.unescape(block if inline is None else inline).strip()
    return convert(latex, display="inline" if block is None else "block")
