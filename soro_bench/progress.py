"""What the command line shows of long work."""

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console()


class StageBars:
    """Progress bars of stages that follow one another."""

    def __enter__(self):
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                                  TimeElapsedColumn(), TimeRemainingColumn(), console=console)  # fmt: skip
        self._progress.start()
        self._tasks: dict[str, int] = {}
        return self

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(self._tasks[stage], completed=done)

    def __exit__(self, *_):
        self._progress.stop()


class InferenceBar:
    """A progress bar for an inference."""

    def __init__(self, label: str):
        self._progress = Progress(TextColumn(label), BarColumn(), MofNCompleteColumn(),
                                  TextColumn("{task.fields[note]}"), TimeElapsedColumn(), TimeRemainingColumn(),
                                  console=console)  # fmt: skip

    def __enter__(self):
        self._progress.start()
        self._task = self._progress.add_task("", total=None, note="")
        return self

    def __call__(self, done: int, total: int, cost: float) -> None:
        note = "" if cost != cost else f"cost {cost:.4g}"
        self._progress.update(self._task, completed=done, total=total, note=note)

    def __exit__(self, *_):
        self._progress.stop()


class TrainingBars:
    """A progress bar per training run."""

    def __enter__(self):
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
        self._tasks: dict[str, int] = {}
        return self

    def __call__(self, label: str, steps: int, total: int, row: dict) -> None:
        if label not in self._tasks:
            self._tasks[label] = self._progress.add_task(label, total=total, note="")
        note = "{:.1f} mm".format(next(value for key, value in row.items() if key.startswith("final_")))
        self._progress.update(self._tasks[label], completed=steps, note=note)

    def __exit__(self, *_):
        self._progress.stop()
