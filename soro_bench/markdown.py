"""Tables in Markdown, for the console, documents and rerun's summaries."""

from collections.abc import Iterable, Sequence


def row(cells: Iterable[str | float]) -> str:
    """One line of a table. A vertical bar in a cell is escaped, as it would begin the next cell."""
    return "| " + " | ".join(str(cell).replace("|", r"\|") for cell in cells) + " |"


def header(names: Sequence[str]) -> str:
    """The first two lines of a table, for those that print the others as they come."""
    return f"{row(names)}\n{'|---' * len(names)}|"


def table(names: Sequence[str], rows: Iterable[Iterable[str | float]]) -> str:
    """A table with the names of its columns."""
    return "\n".join([header(names), *map(row, rows)])
