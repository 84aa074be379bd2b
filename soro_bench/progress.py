"""What the command line shows of long work."""

import time
from collections.abc import Mapping
from typing import Self

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

console = Console(markup=False, highlight=False, emoji=False)  # names and paths are text, whatever is in them


def table(*names: str, title: str | Text, wraps: str | None = None) -> Table:
    """An empty table for the console, of which nothing is cut where it is narrow: long cells go on in the next line.

    Args:
        names: of the columns.
        wraps: the one column whose cells go on in the next line; by default that of the longest cell, then others.
    """
    lines = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=0)
    for name in names:
        lines.add_column(name, overflow="fold", no_wrap=wraps is not None and name != wraps)
    return lines


LOG_INTERVAL = 600.0  # s
SLOW = 7200.0  # s, over which the speed of slow steps is estimated


class StageBars:
    """Progress bars of stages that follow one another. Where nobody looks, in a log file, a line every ten minutes."""

    def __enter__(self) -> Self:
        # some stages take minutes for each step, so their speed shows over hours only
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                                  TimeElapsedColumn(), TimeRemainingColumn(), console=console,
                                  speed_estimate_period=SLOW)  # fmt: skip
        self._tasks: dict[str, TaskID] = {}
        self._log = _Log()
        if console.is_terminal:
            self._progress.start()
        return self

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that so many steps of a stage are done."""
        if stage not in self._tasks:
            # what was done before the first call counts as no speed
            self._tasks[stage] = self._progress.add_task(stage, total=total, completed=max(done - 1, 0))
        self._progress.update(self._tasks[stage], completed=done)
        if not console.is_terminal:
            left = self._progress.tasks[self._tasks[stage]].time_remaining
            self._log(f"{stage}: {done} of {total}{_hours(left)}", done == total)

    def __exit__(self, *_: object) -> None:
        if console.is_terminal:
            self._progress.stop()


class _Log:
    """Prints one line every ten minutes, and the last one of a stage."""

    def __init__(self) -> None:
        self._told = -LOG_INTERVAL

    def __call__(self, line: str, last: bool) -> None:
        if last or time.monotonic() - self._told > LOG_INTERVAL:
            self._told = time.monotonic()
            console.print(line, soft_wrap=True)


def _hours(left: float | None) -> str:
    """The time that is left [s], if it is known."""
    return "" if left is None else f", {left / 3600:.1f} h left"


class ReadingBar:
    """How much of a file has been read; nothing where nobody looks, in a log file."""

    def __enter__(self) -> Self:
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeElapsedColumn(),
                                  TimeRemainingColumn(), console=console, disable=not console.is_terminal)  # fmt: skip
        self._progress.start()
        self._task: TaskID | None = None
        return self

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that so many bytes of all have been read."""
        if self._task is None:
            self._task = self._progress.add_task(stage, total=total)
        self._progress.update(self._task, description=stage, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


class StageStatus:
    """The name of what is being done, for stages that nobody can count; in a log file, a line for each."""

    def __enter__(self) -> Self:
        self._status, self._start, self._stage = console.status(""), time.monotonic(), ""
        if console.is_terminal:
            self._status.start()
        return self

    def __call__(self, stage: str) -> None:
        """Show the stage that begins."""
        if console.is_terminal:
            self._status.update(f"{stage} ...")
        elif stage != self._stage:
            console.print(f"{time.monotonic() - self._start:6.0f} s  {stage}", soft_wrap=True)
        self._stage = stage

    def __exit__(self, *_: object) -> None:
        if console.is_terminal:
            self._status.stop()


class InferenceBar:
    """A progress bar for an inference."""

    def __init__(self, label: str):
        self._progress = Progress(TextColumn(label), BarColumn(), MofNCompleteColumn(),
                                  TextColumn("{task.fields[note]}"), TimeElapsedColumn(), TimeRemainingColumn(),
                                  console=console)  # fmt: skip

    def __enter__(self) -> Self:
        self._progress.start()
        self._task = self._progress.add_task("", total=None, note="")
        return self

    def __call__(self, done: int, total: int, cost: float) -> None:
        """Show what is done, and the cost so far, which is NaN where there is none."""
        note = "" if cost != cost else f"cost {cost:.4g}"
        self._progress.update(self._task, completed=done, total=total, note=note)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


class TrainingBars:
    """A progress bar per training run."""

    def __enter__(self) -> Self:
        self._progress = Progress(
            TextColumn("{task.description:14}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
        )
        self._progress.start()
        self._tasks: dict[str, TaskID] = {}
        return self

    def __call__(self, label: str, steps: int, total: int, row: Mapping[str, float]) -> None:
        """Show environment steps of a run, and the final metric [mm] in the newest row of its curve."""
        if label not in self._tasks:
            self._tasks[label] = self._progress.add_task(label, total=total, note="")
        note = "{:.1f} mm".format(next(value for key, value in row.items() if key.startswith("final_")))
        self._progress.update(self._tasks[label], completed=steps, note=note)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


class CampaignBar:
    """How much of a campaign is done, the time that is left, and a line for each run that is being worked on.

    Where nobody looks, in a log file, a line every ten minutes.
    """

    def __enter__(self) -> Self:
        # runs report every checkpoint, so their speed shows over many minutes only
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.1f} %"),
                                  TimeElapsedColumn(), TimeRemainingColumn(), speed_estimate_period=1800)  # fmt: skip
        self._task: TaskID | None = None
        self._log = _Log()
        self._live = Live(self._progress, console=console)
        if console.is_terminal:
            self._live.start()
        return self

    def __call__(self, share: float, active: list[str]) -> None:
        """Show the share of the work that is done, from 0 to 1, and a line for each active run."""
        if self._task is None:  # what was done before counts as no speed
            self._task = self._progress.add_task("campaign", total=1.0, completed=share)  # type: ignore[arg-type]  # floats too
        self._progress.update(self._task, completed=share)
        if console.is_terminal:
            self._live.update(Group(self._progress, Text("\n".join(active))))
        else:
            left = _hours(self._progress.tasks[0].time_remaining)
            self._log(f"{100 * share:.1f} %{left}; {'; '.join(active)}", share == 1.0)

    def __exit__(self, *_: object) -> None:
        if console.is_terminal:
            self._live.stop()
