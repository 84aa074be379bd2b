"""Rebuild the leaderboard's table from the entries.

    python leaderboard/update.py

An entry is a folder leaderboard/entries/<entry>/<environment>/<method>/seed<k>/ with the evaluation_<model>.json files
that ``soro-bench run``, ``soro-bench evaluate`` and the scripts in baselines/ write. Entries are data: nothing in them
is executed.
"""

from pathlib import Path

from soro_bench.files import read_json, replacing
from soro_bench.report import markdown_table, table_rows

HERE = Path(__file__).parent
HEADER = """# Leaderboard

Final distance on the fixed evaluation episodes, mean over seeds and episodes with a 95 % bootstrap interval. Add a
folder under entries/ and run `python leaderboard/update.py`, which writes this page.
"""


def main() -> None:
    sections = [HEADER]
    for entry in sorted((HERE / "entries").iterdir()):
        results = [read_json(path) for path in sorted(entry.glob("*/*/seed*/evaluation_*.json"))]
        sections.append(f"## {entry.name}\n\n{markdown_table(table_rows(results))}\n")
    with replacing(HERE / "README.md") as temporary:
        temporary.write_text("\n".join(sections))


if __name__ == "__main__":
    main()
