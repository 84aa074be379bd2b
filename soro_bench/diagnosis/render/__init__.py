"""Everything that is shown of a result: summary, report.html, comparison.rrd and files for programs.

Renderers read a :class:`~soro_bench.diagnosis.result.Result` and nothing else: they import no robot and simulate
nothing.
"""

from pathlib import Path

from soro_bench.diagnosis.render.files import OPTIONAL, write_files
from soro_bench.diagnosis.render.html import write_html
from soro_bench.diagnosis.render.rerun import write_comparison
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result

FILES = ("report.html", "comparison.rrd", "effects.json", "result.json", *OPTIONAL)


def render(result: Result, folder: str | Path) -> str:
    """Write all files of a result into a folder, and return its summary for a console of 80 columns."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").unlink(missing_ok=True)  # of an earlier diagnosis
    write_html(result, folder / "report.html")
    write_comparison(result, folder / "comparison.rrd")
    write_files(result, folder)
    return summary(result)
