"""Counts the words and sentences of every page of the site, tables and code apart.

python docs/count_words.py
"""

import re
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).parent
CHECKOUT = DOCS.parent
LONGEST_PAGE, LONGEST_SENTENCE, ALL_PAGES = 1500, 22, 20_000  # words; of a page's mean sentence; of all pages
OTHERS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "leaderboard/README.md")
NOT_PROSE = (
    r"(?s)<!-- written by docs/generate.py -->.*<!-- end of what docs/generate.py writes -->",
    r"(?s)\A---\n.*?\n---\n",  # metadata
    r"(?s)<!--.*?-->",
    r"(?ms)^[ \t]*(```|~~~).*?^[ \t]*\1[ \t]*$",  # code
    r"(?m)^[ \t]*\|.*$",  # tables
    r"(?s)\$\$.*?\$\$",  # equations of their own
    r"(?m)^#+ .*$",  # headings: counted as no sentence
    r"(?m)^(!!!|\?\?\?).*$",
    r"!\[[^\]]*\]\([^)]*\)(\{[^}]*\})?",  # pictures
    r"</?[a-zA-Z][^>\n]*>",
)
END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_`\[]*[A-Z0-9`])|\n\s*\n|\n(?=[ \t]*(?:[-*+]|\d+\.)[ \t])")
# an abbreviation or a number in front of a full stop ends no sentence
ABBREVIATION = re.compile(r"\b(e\.g|i\.e|et al|cf|Fig|Eq|No|vs|approx)\.\s")


@dataclass(frozen=True)
class Count:
    """Of a page: words of its prose, and sentences."""

    words: int
    sentences: int

    @property
    def mean(self) -> float:
        """Words of a sentence."""
        return self.words / max(self.sentences, 1)


def prose(text: str) -> str:
    """The text of a page without code, tables, headings, pictures and the addresses of links."""
    for pattern in NOT_PROSE:
        text = re.sub(pattern, "\n", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`\n]+`|\$[^$\n]+\$", "x", text)  # a name or a symbol is one word
    return ABBREVIATION.sub(r"\1 ", text)


def count(text: str) -> Count:
    """Words and sentences of a page in Markdown."""
    sentences = [re.sub(r"^\s*(?:[-*+]|\d+\.)\s+", "", part) for part in END.split(prose(text)) if part]
    lengths = [len(re.findall(r"\w[\w'./%-]*", sentence)) for sentence in sentences]
    lengths = [length for length in lengths if length]
    return Count(sum(lengths), len(lengths))


def pages() -> dict[str, Path]:
    """All pages by their paths in the checkout: those of the site, and those that a checkout shows."""
    found = [*(CHECKOUT / name for name in OTHERS), *sorted(DOCS.rglob("*.md"))]
    return {path.relative_to(CHECKOUT).as_posix(): path for path in found if "results" not in path.parts}


def main() -> None:
    counts = {name: count(path.read_text()) for name, path in pages().items()}
    for name, each in counts.items():
        flags = (" LONG" if each.words > LONGEST_PAGE else "") + (" SENTENCES" if each.mean > LONGEST_SENTENCE else "")
        print(f"{each.words:6d} words {each.sentences:5d} sentences {each.mean:5.1f} words each  {name}{flags}")
    print(f"{sum(each.words for each in counts.values()):6d} words in all")


if __name__ == "__main__":
    main()
