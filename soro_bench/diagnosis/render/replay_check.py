"""What a replay check shows: a table of errors for the console, and check.html with the errors of every point."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.diagnosis.render import words
from soro_bench.diagnosis.render.figures import WIDTH, image
from soro_bench.diagnosis.render.html import TEMPLATES, Table
from soro_bench.files import replacing, shown, write_json
from soro_bench.plotting import pyplot

if TYPE_CHECKING:
    from soro_bench.diagnosis.replay_check import FileErrors, ReplayCheck

FILES = ("check.html", "check.json")
NAMES = {  # of robots, as short as a console of 80 columns needs them
    "nominal": "as built",
    "fitted": "fitted",
    "patched": "with effects",
    "best": "best hypothesis",
    "accurate": "accurate",
    "model_alone": "model alone",
}
DRAWN = 12  # recordings with a figure; the table has all of them
_HEIGHT = 2.2  # inches of a figure


def write_check(check: "ReplayCheck", folder: str | Path) -> None:
    """Write check.html and check.json into a folder."""
    folder = Path(folder)
    with replacing(folder / FILES[0]) as temporary:
        temporary.write_text(html(check), encoding="utf-8")
    write_json(folder / FILES[1], check.to_json())


def tables(check: "ReplayCheck") -> list[Table]:
    """A table for every signal: a row for every recording, and one for all of a role where there are several."""
    return [_of_signal(check, [each for each in check.files if each.signal == name]) for name in check.signals]


def _of_signal(check: "ReplayCheck", files: "list[FileErrors]") -> Table:
    signal, unit = files[0].signal, files[0].unit
    rows = [(each.name, each.role, *_cells(check, each.rms, unit), _share(each.left_out)) for each in files]
    for role in dict.fromkeys(each.role for each in files):
        if sum(each.role == role for each in files) > 1:
            rows.append(("all", role, *_cells(check, check.pooled(role, signal), unit), ""))
    head = ("recording", "role", *(NAMES[name] for name in check.robots), "left out")
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    name = f"RMSE of {shown(signal)}{'' if unit == '1' else f' [{words.shown_unit(unit)[1]}]'}"
    return Table(f"Plain replays of {shown(check.robot)}: {name}", head, [tuple(map(shown, row)) for row in rows])


def _cells(check: "ReplayCheck", rms: dict[str, float], unit: str) -> list[str]:
    """Errors in the unit that is shown, without it."""
    return [words.error(rms[name], unit).split(words.NO_BREAK)[0] for name in check.robots]


def _share(left_out: float) -> str:
    return f"{100 * left_out:.2g} %" if left_out else ""


def html(check: "ReplayCheck") -> str:
    """The page: the table, and for every recording the errors of its points."""
    points = [_of_points(check, each) for each in check.files if len(_measured(each)) > 1]
    return TEMPLATES.get_template("check.html").render(
        check=check,
        title=f"Plain replays of {shown(check.robot)}, model {shown(check.model)}",
        noise=words.number(check.noise, check.files[0].unit),
        tables=[*tables(check), *points],
        figures=[(_label(each), _figure(check, each)) for each in check.files[:DRAWN]],
    )


def _label(found: "FileErrors") -> str:
    return shown(f"{found.signal}, {found.name}")


def _measured(found: "FileErrors") -> list[int]:
    """Points with samples that count."""
    return np.flatnonzero(np.isfinite(next(iter(found.points.values())))).tolist()


def _of_points(check: "ReplayCheck", found: "FileErrors") -> Table:
    rows = [
        (str(point), *_cells(check, {name: found.points[name][point] for name in check.robots}, found.unit))
        for point in _measured(found)
    ]
    return Table(_label(found), ("point", *(NAMES[name] for name in check.robots)), rows)


def _figure(check: "ReplayCheck", found: "FileErrors") -> str:
    """Errors of every point, or of the only one."""
    scale, unit = words.shown_unit(found.unit)
    figure, axes = pyplot().subplots(figsize=(WIDTH, _HEIGHT), layout="constrained")
    count = len(next(iter(found.points.values())))
    for i, name in enumerate(check.robots):
        values = scale * np.array(found.points[name])
        if count > 1:
            axes.plot(values, marker="o", ms=3, label=NAMES[name])
        else:
            axes.barh(i, values, color=f"C{i}")
    label = f"RMSE [{unit}]"
    if count > 1:
        if found.signal == check.signals[0]:
            axes.axhline(scale * check.noise, color="0.5", lw=1, ls="--", label="noise")
        axes.set(xlabel="point of the signal", ylabel=label, ylim=(0, None))
        axes.xaxis.set_major_locator(pyplot().MaxNLocator(integer=True))
        axes.legend(frameon=False, fontsize="small")
    else:
        axes.set(xlabel=label, yticks=range(len(check.robots)))
        axes.set_yticklabels([NAMES[name] for name in check.robots])
        axes.invert_yaxis()
    return image(figure)
