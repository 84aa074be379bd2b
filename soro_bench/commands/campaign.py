"""``soro-bench run``, and the scripts in baselines/, which are campaigns of one method."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Protocol, TypeVar

import tyro

from soro_bench.options import MAX_NAME, Parallel, check_name
from soro_bench.parallel import Workers
from soro_bench.progress import CampaignBar, console

if TYPE_CHECKING:  # what a command needs is imported when it runs
    from soro_bench.campaign.run import Run
    from soro_bench.training.methods import Method

T = TypeVar("T", contravariant=True)


@dataclass
class RunPreset:
    """Train and evaluate the baselines: the benchmark in small (quick) or the published study (paper)."""

    workers: Parallel
    preset: Literal["quick", "paper"] = "quick"
    """quick: oracle and UDR briefly on TrunkReach, and a diagnosis of a robot with hidden physics.
    paper: all tasks, methods and seeds; about three days of computing."""
    only: tuple[str, ...] = ()
    """Runs whose names (board/method/seed0) hold one of these texts."""
    plan: bool = False
    """Say what there is to do, and end."""
    out: Path = Path("runs")
    """Folder for checkpoints, policies and recordings; an interrupted campaign goes on from here."""
    results: Path | None = None
    """Folder for an entry per run; by default leaderboard/results (paper), or within --out."""

    def run(self) -> None:
        """Carry out the runs that are missing; ValueError if one fails."""
        from soro_bench.campaign.plan import PRESETS, chosen

        results = {"paper": Path("leaderboard", "results")}.get(self.preset, self.out / self.preset / "results")
        runs = chosen(PRESETS[self.preset](), self.only)
        campaign(runs, self.out / self.preset, self.results or results, self.workers, self.plan)
        if self.preset == "quick" and not (self.only or self.plan):
            _diagnose_hidden(self.out / self.preset / "diagnosis")


def _diagnose_hidden(folder: Path) -> None:
    """Record a robot with hidden physics and say what the simulation lacks, unless that is done."""
    from soro_bench.campaign.inputs import ENV_ID, SUMMARY, record_hidden
    from soro_bench.diagnosis.commands import Diagnose

    if (folder / "result.json").exists():  # written last
        return console.print(
            f"{folder / 'report.html'} has the diagnosis of a robot with hidden physics", soft_wrap=True
        )
    console.print(f"Hidden robot: {SUMMARY}. Its diagnosis sees recordings only.", soft_wrap=True)
    recording, heldout = record_hidden(folder)
    Diagnose(recordings=(recording,), heldout=(heldout,), env=ENV_ID, out=folder).run()


@dataclass
class _OfOneMethod:
    """What all scripts in baselines/ take."""

    workers: Parallel
    board: Annotated[str, tyro.conf.Positional]
    """Such as TrunkReach-v0 or TrunkLift-v0-50g; docs/how_to/submit.md lists them."""
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int | None = None
    """Environment steps; what the environment needs by default."""
    model: str | None = None
    """Model or mesh to train on; the cheap one by default."""
    out: Path = Path("runs/baselines")

    def carry_out(self, method: "Method") -> None:
        """Carry out a run for every seed; ValueError if one fails."""
        from soro_bench.campaign.plan import runs_of

        runs = runs_of(self.board, method, self.seeds, self.steps, self.model)
        campaign(runs, self.out, self.out / "results", self.workers)


@dataclass
class Baseline(_OfOneMethod):
    """What the scripts in baselines/ take whose distribution needs no recording."""

    def run(self, method: "Method") -> None:
        """Carry out a run for every seed; ValueError if one fails."""
        self.carry_out(method)


@dataclass
class InferenceBaseline(_OfOneMethod):
    """What the scripts in baselines/ take that infer the distribution from a recording."""

    recording: Path | None = None
    """.parquet; by default the environment's in assets/recordings."""
    known: tuple[str, ...] = ()
    """Parameters that the inference holds fixed, such as young_modulus=3.6e6; training on what it gives does too, and a
    universal policy, which trains on the whole search box, is told these values."""
    replay_model: str | None = None
    """Model to replay the recording on; the recorded one by default."""
    noise: float = 0.0
    """Standard deviation [m] of the recorded positions."""

    def run(self, method: str) -> None:
        """Infer by the method, and carry out a run for every seed; ValueError if one fails."""
        from soro_bench.campaign.inputs import inferred
        from soro_bench.campaign.plan import recording_path
        from soro_bench.leaderboard.boards import BOARDS
        from soro_bench.recording.simulated import parse_params

        if self.board not in BOARDS:
            raise ValueError(f"there is no board {self.board!r}; there are {', '.join(BOARDS)}")
        given = self.recording and self.recording.resolve()  # workers start elsewhere
        recording = given or recording_path(BOARDS[self.board].env_id)
        found = inferred(method, recording, parse_params(self.known), self.replay_model,
                         self.noise)  # fmt: skip
        chosen = self.of(found)
        chosen = replace(chosen, name=self._named(chosen.name))
        check_name("the method", chosen.name)  # before the work, not after it
        self.carry_out(chosen)

    def of(self, found: "Method") -> "Method":
        """What is trained with a method that infers."""
        return found

    def _named(self, method: str) -> str:
        """The method with the options that differ from the defaults: other options are another method."""
        from soro_bench.recording.untrusted import read_bytes

        noise = [f"noise_{self.noise:g}"] if self.noise else []
        recording = [f"{self.recording.stem}_{_digest(read_bytes(self.recording))}"] if self.recording else []
        options = [*self.known, *([self.replay_model] if self.replay_model else []), *noise, *recording]
        name = "_".join([method, *(re.sub(r"[^A-Za-z0-9.+-]+", "_", option) for option in options)])
        if len(name) <= MAX_NAME:
            return name
        return f"{name[: MAX_NAME - 9]}_{_digest(name.encode())}"


@dataclass
class UniversalBaseline(InferenceBaseline):
    """The same for a universal policy, which is told what is inferred."""

    def of(self, found: "Method") -> "Method":
        """A universal policy that is told what a method finds."""
        from soro_bench.training.methods import universal

        return universal(found)


def _digest(data: bytes) -> str:
    """Tells recordings of the same name apart, and long names that begin alike."""
    return hashlib.sha256(data).hexdigest()[:8]


class Script(Protocol[T]):
    """The arguments of a script, and what it does with a method."""

    def run(self, method: T) -> None:
        """Carry out a run for every seed."""


def script(options: type[Script[T]], method: T, description: str | None) -> None:
    """What a script of baselines/ does with its command line."""
    from soro_bench.errors import plain_errors

    with plain_errors("baselines"):
        tyro.cli(options, description=description).run(method)


def campaign(runs: "Sequence[Run]", work: Path, results: Path, workers: Workers, only_plan: bool = False) -> None:
    """Carry out what is missing, and write the page that compares all results in ``results``."""
    from soro_bench.campaign.campaign import carry_out_all
    from soro_bench.errors import SeveralErrors, one_line
    from soro_bench.files import check_folder
    from soro_bench.leaderboard.page import build, gathered
    from soro_bench.leaderboard.statistics import markdown_table
    from soro_bench.recording.rerun_stream import require_rerun

    gathered(results, work)  # before the work, not after it
    missing = [run.name for run in runs if not run.done(results)]
    console.print(f"{len(runs)} runs, {len(missing)} still to be done; results in {results}", soft_wrap=True)
    if only_plan:
        console.print("\n".join(missing), soft_wrap=True)
        return
    require_rerun()
    check_folder(work, ["index.html"])
    check_folder(results)
    with CampaignBar() as bar:
        failures = carry_out_all(runs, work, results, workers, bar)
    failed = [f"{len(failures)} of {len(missing)} runs failed:", *failures] if failures else []
    try:
        build(results, work)
    except (ValueError, OSError, ImportError) as error:
        raise SeveralErrors([*failed, f"no page of results: {one_line(error)}"]) from error
    boards, _ = gathered(results, work)
    console.print(markdown_table([group for groups in boards.values() for group in groups]), soft_wrap=True)
    recording = next(iter(sorted(work.rglob("*.rrd"))), "FILE.rrd")
    console.print(
        f"{work / 'index.html'} shows them; watch what a policy does with: soro-bench view {recording}", soft_wrap=True
    )
    if failed:
        raise SeveralErrors(failed)
