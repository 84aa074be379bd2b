"""Everything that is shown of a result: summary, report.html, comparison.rrd and files for programs.

Renderers read a :class:`~soro_bench.diagnosis.result.Result` and nothing else: they import no robot and simulate
nothing.
"""

from pathlib import Path

import numpy as np

from soro_bench.diagnosis.render.html import write_html
from soro_bench.diagnosis.render.rerun import write_comparison
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result
from soro_bench.effects.effect import SCHEMA
from soro_bench.files import replacing, write_json
from soro_bench.plotting import pyplot
from soro_bench.randomization import Gaussian
from soro_bench.recording.excitation import write_actions
from soro_bench.recording.rerun_stream import require_rerun

MODEL, REMAINING, NEXT = "patched_model.xml", "remaining_effects.json", "next_actions.csv"
OPTIONAL = ("posterior.json", MODEL, REMAINING, NEXT)
FILES = ("report.html", "comparison.rrd", "effects.json", "result.json", *OPTIONAL)


def require_packages() -> None:
    """Raise ImportError or ValueError if a package that reports need is not installed or switched off: before the
    work, not after it."""
    require_rerun()
    pyplot()


def render(result: Result, folder: str | Path) -> str:
    """Write all files of a result into a folder, and return its summary for a console of 80 columns."""
    require_packages()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").unlink(missing_ok=True)  # of an earlier diagnosis
    write_html(result, folder / "report.html")
    write_comparison(result, folder / "comparison.rrd")
    write_files(result, folder)
    return summary(result)


def write_files(result: Result, folder: str | Path) -> None:
    """Write the files for programs: effects, posterior, patched model, actions to record next, and the result itself.

    result.json comes last, so that it stands for a complete folder. Files of an earlier diagnosis vanish.
    """
    folder = Path(folder)
    for name in OPTIONAL:
        (folder / name).unlink(missing_ok=True)
    write_json(folder / "effects.json", {"schema": SCHEMA, "effects": list(result.patch.effects)})
    if result.trainable:
        write_json(folder / "posterior.json", posterior(result).to_dict())
    if result.patch.model is not None:
        with replacing(folder / MODEL) as temporary:
            temporary.write_text(result.patch.model, encoding="utf-8")
        if result.patch.remaining and result.patch.model_state != "refitted":  # whose parameters are for itself alone
            write_json(folder / REMAINING, {"schema": SCHEMA, "effects": list(result.patch.remaining)})
    if (found := result.next_recording) is not None:
        write_actions(folder / NEXT, found.control_timestep, np.array(found.actions), result.robot.channels)
    result.save(folder / "result.json")


def posterior(result: Result) -> Gaussian:
    """The parameters of the patched robot, as a distribution to train on."""
    names = tuple(each.estimate.name for each in result.parameters)
    mean = np.array([each.estimate.value for each in result.parameters])
    return Gaussian(names, mean, np.array(result.covariance))
