"""The leaderboard as one page, index.html, that loads nothing; beside it the entries' files and recordings."""

import base64
import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import check_folder, replacing
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.entry import policy_bytes, policy_of
from soro_bench.leaderboard.gather import Group, gather_control, gather_diagnosis
from soro_bench.leaderboard.plots import color_of, curves_of, plot_calibration, plot_curves, plot_scores, title_of
from soro_bench.leaderboard.statistics import (
    chance_of_difference,
    interquartile_mean,
    interval,
    probability_of_improvement,
)
from soro_bench.leaderboard.strict import ENTRY_BYTES
from soro_bench.packed import read
from soro_bench.recording.rerun_log import write_recording
from soro_bench.recording.rerun_stream import require_rerun
from soro_bench.registration import task_type

REFERENCES = ("oracle", "no_dr")  # methods that others are compared with: the first one that a board has
HEADLINES = {  # criteria by which diagnoses are compared at a glance, and what they are called there
    "false alarms": "false alarms",
    "first answer right": "first right",
    "class right": "class right",
    "expected calibration error": "calibration error",
    "unseen motion: variance explained, median, numerical error off": "unseen explained",
    "unknown called unknown": "unknown found",
    "unknown called so, at the right place": "and located",
    "seconds, median": "seconds",
}
SURE = 0.05  # largest chance of a difference that is called sure
_HERE = Path(__file__).parent


def build(
    results: str | Path, out: str | Path, record: bool = False, progress: Callable[[str], None] = lambda _: None
) -> Path:
    """Write the page of all entries under ``results`` into the folder ``out``; returns its file.

    Every entry is read before anything is written: an invalid one is a ValueError that says what is wrong.

    Args:
        record: whether to write rerun recordings too, of the best policy of every method in every condition.
        progress: is told what is being done.
    """
    if record:
        require_rerun()
    out = Path(out)
    boards, diagnoses = gathered(results, out)
    check_folder(out, ["index.html"])
    groups = [group for members in boards.values() for group in members]
    for group in groups if record else ():
        progress(f"recording {title_of(group)} on {group.board}")
        for label in group.labels:
            _record(group, label, out / _recording(group, label))
    progress("statistics")
    sections = [_board_section(board, members, out) for board, members in boards.items()]
    scored = sorted((_diagnosis_section(i, entry) for i, entry in enumerate(diagnoses)), key=_rank)
    text = _render(boards=sections, diagnoses=scored, headlines=HEADLINES)
    for path, entry in (member for group in groups for member in group.entries):
        _copy(read(path, ENTRY_BYTES), out / "results" / path.relative_to(results))
        file = path.with_name(entry["policy"]["file"])
        _copy(policy_bytes(path, entry), out / "results" / file.relative_to(results))
    _copy(text.encode(), out / "index.html")
    return out / "index.html"


def gathered(results: str | Path, out: str | Path) -> tuple[dict[str, list[Group]], list[dict]]:
    """What a page in the folder ``out`` would show: entries of the control track by board, and of the diagnosis;
    ValueError if it could not be built."""
    own, copies = Path(results).resolve(), (Path(out) / "results").resolve()
    if copies != own and copies.is_relative_to(own):  # they would be taken for entries of another board
        raise ValueError(f"{out} is within {results}; choose another folder for the page")
    return gather_control(results), gather_diagnosis(results)


def _copy(data: bytes, path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _recording(group: Group, label: str) -> str:
    """Where the recording of a group in a condition is: another best policy has another one."""
    _, entry = _best(group, label)
    return f"recordings/{group.board}/{group.entry}/{group.method}-{label}-{entry['policy']['sha256'][:8]}.rrd"


def _best(group: Group, label: str) -> tuple[Path, dict]:
    """The entry whose policy is best in a condition."""
    means = group.scores(label).mean(axis=1)
    return group.entries[int(means.argmax() if BOARDS[group.board].higher else means.argmin())]


def _record(group: Group, label: str, path: Path) -> None:
    board, best = BOARDS[group.board], _best(group, label)
    title = f"{group.board}: {title_of(group)}, seed {best[1]['seed']}, on {label}"
    write_recording(path, board.play(policy_of(*best), label), title)


def _board_section(name: str, groups: Sequence[Group], out: Path) -> dict:
    """What the template shows of a board."""
    board, rows = BOARDS[name], {}
    accurate = task_type(board.env_id).accurate
    for label in sorted(board.conditions, key=lambda label: board.conditions[label].model != accurate):
        if found := [(i, group) for i, group in enumerate(groups) if label in group.labels]:
            rows[label] = [_row(group, label, color_of(i), out) for i, group in found]
            rows[label].sort(key=lambda row: row["iqm"], reverse=board.higher)
            _compare(rows[label], board.higher)
    direction = "higher" if board.higher else "lower"
    figures = []
    if rows:  # none where the seeds of every method were evaluated on different models
        alt = f"Interquartile mean of the final {board.metric}, with 95 % interval, of every row of the table"
        figures.append((alt, plot_scores(rows, f"{name}-scores", f"final {board.metric} [mm], {direction} is better")))
    if any(curves_of(group) for group in groups):
        alt = f"Final {board.metric} in training, exploration included: runs, and the median of each method"
        label, scale = f"final {board.metric} in training [mm]", "linear" if board.higher else "log"
        figures.append((alt, plot_curves(groups, f"{name}-curves", label, scale)))
    every = [row for members in rows.values() for row in members]
    return {
        "name": name,
        "metric": board.metric,
        "direction": direction,
        "verdict": " ".join(_verdict(label, members) for label, members in rows.items()),
        "rows": every,
        "figures": figures,
    }


def _row(group: Group, label: str, color: str, out: Path) -> dict:
    values, rng = group.scores(label), np.random.default_rng(0)
    recording = _recording(group, label)
    return {
        "group": group,
        "evaluated_on": label,
        "color": color,
        "values": values,
        "mean": float(values.mean()),
        "mean_interval": interval(np.mean, (values,), rng),
        "iqm": interquartile_mean(values),
        "interval": interval(interquartile_mean, (values,), rng),
        "solved": float(group.scores(label, "success").mean()),
        "diverged": sum(entry["evaluations"][label]["diverged"] for _, entry in group.entries),
        "files": [_links(group, path, entry) for path, entry in group.entries],
        "recording": recording if (out / recording).is_file() else None,
    }


def _verdict(label: str, rows: Sequence[dict]) -> str:
    """Which method is best in a condition, whose rows are the best first, and whether that is sure."""
    current = [row for row in rows if not row["group"].old]
    if not current:
        return f"On {label}, no method of the present trainer has run."
    first, *others = current
    said = f"On {label}, {first['group'].name} is best ({first['iqm']:.2f} mm)"
    if not others:
        return f"{said}, and alone."
    second = others[0]
    seeds = " and ".join(str(len(row["values"])) for row in (first, second))
    chance = chance_of_difference(first["values"], second["values"])
    sure = "sure" if chance <= SURE else "not sure"
    return (
        f"{said}, ahead of {second['group'].name} ({second['iqm']:.2f} mm), "
        f"which is {sure} (p = {chance:.2g}, {seeds} seeds)."
    )


def _links(group: Group, path: Path, entry: dict) -> dict:
    folder = f"results/{group.board}/{group.entry}/{group.method}"
    policy = f"{folder}/{entry['policy']['file']}"
    return {"seed": entry["seed"], "policy": policy, "entry": f"{folder}/{path.name}"}


def _compare(rows: list[dict], higher: bool) -> None:
    """Add to rows of one condition, the best first, how probably each is better than the best reference method."""
    current = [row for row in rows if not row["group"].old]
    reference = next((row for method in REFERENCES for row in current if row["group"].method == method), None)
    for row in rows:
        row["improvement"] = row["improvement_interval"] = None
        row["is_reference"] = row is reference
        if reference and not row["group"].old and row is not reference:
            statistic, both = partial(probability_of_improvement, higher=higher), (row["values"], reference["values"])
            row["improvement"] = statistic(*both)
            row["improvement_interval"] = interval(statistic, both, np.random.default_rng(0))


def _diagnosis_section(number: int, entry: dict) -> dict:
    """What the template shows of a diagnosis."""
    figures = []
    if entry["calibration"]:
        alt = "How often the first answer was right, against the probability that was stated; larger dots, more cases"
        figures = [(alt, plot_calibration(entry["calibration"], f"diagnosis-{number}"))]
    worst = sorted(entry["confusion"], key=lambda pair: -pair["cases"])
    columns = [name for name in (entry["ablations"] or [{}])[0] if name != "variant"]
    judged = [criterion["met"] for criterion in entry["gates"] if criterion["met"] is not None]
    by_name = {criterion["gate"]: criterion for criterion in entry["gates"]}
    return entry | {
        "id": f"diagnosis-entry-{number}",
        "met": sum(judged),
        "judged": len(judged),
        "by_name": by_name,
        "figures": figures,
        "worst": worst,
        "columns": columns,
    }


def _rank(section: dict) -> tuple[float, float]:
    """The more criteria are met the better; then, the more often the first answer is right."""
    first = section["by_name"].get("first answer right", {}).get("value")
    return -section["met"], -(first or 0.0)


def _render(**content: Any) -> str:
    try:
        import jinja2
    except ImportError as error:
        raise ImportError("the leaderboard's page needs jinja2: pip install soro_bench[board]") from error
    script = (_HERE / "page.js").read_text()
    # the browser runs this script and no other, whatever the entries hold
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("page.html").render(script=script, allowed=allowed, **content)
