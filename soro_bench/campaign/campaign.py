"""Carry out many runs, by as many processes or machines as there are, and show how far they are."""

import csv
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, TypeVar

from soro_bench.campaign.run import Run, carry_out
from soro_bench.errors import one_line
from soro_bench.files import replacing
from soro_bench.packed import places
from soro_bench.parallel import Workers, each

TRAINING = 0.95  # of a run; the rest is its evaluation
POLL = 2.0  # s between looks at what the runs have written
# Time of an environment step with the policy's share of an update, relative to TrunkReach's on the cheap model
# (docs/archive/tasks_and_models.md); only what is shown of the time left depends on it
_COST = {"TrunkReach-v0": 1.0, "TrunkPush-v0": 1.3, "TrunkLift-v0": 1.5, "MultiGait-v0": 60.0}
_ACCURATE = 10.0

T = TypeVar("T")
CampaignProgress = Callable[[float, list[str]], None]  # the share that is done, a line for each active run


def carry_out_all(
    runs: Sequence[Run],
    work: Path,
    results: Path,
    workers: Workers,
    progress: CampaignProgress = lambda share, rows: None,
) -> list[str]:
    """Carry out the runs that are not done; what a run writes does not depend on the others, nor does whether it fails.

    Returns what failed, a line for each run; error.txt in its folder says more.

    ``progress`` is called every few seconds with the share of the work that is done and a line for each active run.

    Raises:
        ValueError: there is an entry that was trained with other settings than its run has.
        ChildProcessError: a process died (:func:`soro_bench.parallel.each`).
    """
    work, results = Path(work).resolve(), Path(results).resolve()  # the same for the workers of a cluster
    seen = Seen()
    todo = [run for run in runs if not seen.done(run, results)]
    with _watching(runs, work, results, progress, seen):
        said = list(each(attempted, [(run, work, results) for run in todo], workers))
    progress(*state(runs, work, results, seen))
    return [failure for failure in said if failure]


def attempted(run: Run, work: Path, results: Path) -> str | None:
    """Carry out a run; its name and what went wrong, if something did: it is nothing that others have to wait for."""
    log = work / run.name / "error.txt"
    log.unlink(missing_ok=True)
    try:
        carry_out(run, work, results)
    except Exception as error:
        with replacing(log) as temporary:
            temporary.write_text(traceback.format_exc())
        return f"{run.name}: {one_line(error)}"
    return None


class Seen:
    """What was read of runs, kept until their files change: archives of entries have megabytes."""

    def __init__(self) -> None:
        self._kept: dict[Path, tuple[list[tuple[int, int, int]], Any]] = {}

    def done(self, run: Run, results: Path) -> bool:
        """As :meth:`Run.done` says."""
        path = run.result(results)
        return self._read(path, places(path), lambda: run.done(results))

    def reached(self, curve: Path) -> tuple[int, float] | None:
        """Steps and final metric [mm] in the last row of a training's table; None before it has one."""
        return self._read(curve, [curve], lambda: _reached(curve))

    def _read(self, name: Path, files: Sequence[Path], reader: Callable[[], T]) -> T:
        found = [file.stat() for file in files if file.exists()]
        versions = [(each.st_ino, each.st_mtime_ns, each.st_size) for each in found]
        if name not in self._kept or self._kept[name][0] != versions:
            self._kept[name] = versions, reader()
        return self._kept[name][1]


def state(runs: Sequence[Run], work: Path, results: Path, seen: Seen) -> tuple[float, list[str]]:
    """The share of the work that is done, and what the runs are doing that have begun but not ended.

    Read from the files, so that it is the same whoever works on them, but not again from those that have not changed
    since they were ``seen``.
    """
    total = done = 0.0
    active = []
    for run in runs:
        cost = _cost(run)
        total += cost
        if seen.done(run, results):
            done += cost
            continue
        folder = Path(work) / run.name
        reached = seen.reached(folder / "curve.csv")
        if reached is None:
            if folder.exists():
                active.append(f"{run.name}: begins")
            continue
        (trained, final), steps = reached, run.config.num_segments * run.config.segment_steps
        share = min(trained / steps, 1.0)
        done += TRAINING * share * cost
        what = f"{final} mm in training" if share < 1 else "evaluation"
        active.append(f"{run.name}: {trained:,} of {steps:,} steps, {what}")
    return done / total, active


def _cost(run: Run) -> float:
    model = _ACCURATE if run.config.model == "flex" else 1.0
    return run.config.total_steps * _COST.get(run.config.env_id, 1.0) * model


def _reached(path: Path) -> tuple[int, float] | None:
    try:
        with path.open() as file:
            last = list(csv.DictReader(file))[-1]
        (final,) = (value for name, value in last.items() if name and name.startswith("final_"))
        return int(last["steps"]), float(final)
    except (OSError, LookupError, TypeError, ValueError, csv.Error):
        return None  # not begun, or begun anew; of a table that is none the run itself says more


@contextmanager
def _watching(runs: Sequence[Run], work: Path, results: Path, progress: CampaignProgress, seen: Seen) -> Iterator[None]:
    """Looks at the files from a thread, as what runs elsewhere cannot call back."""
    stop = Event()

    def watch() -> None:
        while not stop.wait(POLL):
            with suppress(OSError, ValueError):  # of a file that is not what it should be the run itself will say more
                progress(*state(runs, work, results, seen))

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
