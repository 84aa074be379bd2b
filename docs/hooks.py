"""What MkDocs calls while it builds the site: equations become MathML, links to source files become text.

MathML needs no script and no network. Source files are no part of the site, but the same pages are read in a checkout,
where a link to one works. A link to a file that does not exist ends a strict build.
"""

import html
import logging
import re
from pathlib import Path

from latex2mathml.converter import convert

LOG = logging.getLogger("mkdocs.hooks.soro_bench")
EQUATION = re.compile(r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL)
ROLE = re.compile(r":(?:mod|class|func|meth|attr|data|exc):(?=<code>|<a)")  # of docstrings in reStructuredText
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:|#|/)([^)#\s]+)(#[^)\s]*)?\)")


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
