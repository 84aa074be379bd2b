"""``soro-bench blind-benchmark``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from soro_bench.options import Parallel
from soro_bench.parallel import HERE
from soro_bench.progress import StageBars, console


@dataclass
class BlindBenchmark:
    """Test the diagnosis on simulated robots with hidden physics; an interrupted run goes on from its files."""

    out: Path
    """Folder for cases, reports, scorecard, and entry.json, the same for the leaderboard."""
    count: int = 120
    seed: int | None = None
    """Of the cases; drawn by default, and kept with the labels. Small seeds can be guessed from the commands, and
    cases that were used to develop the method say nothing about it."""
    healthy: Annotated[int | None, tyro.conf.arg(aliases=["--nulls"])] = None
    """Healthy (fault-free) cases; by default a fifth of the suite's robots and half of the other simulators'."""
    others: int | None = None
    """Cases of other simulators, half of all by default: healthy robots of four kinds, and laws in PyElastica's rod."""
    sorosim: Path | None = None
    """Folder with releases.csv of SoroSim, whose steel rods are a fifth kind then."""
    ablations: int = 0
    """Of so many cases, what each part of the method is worth: five more diagnoses each."""
    workers: Parallel = HERE

    def run(self) -> None:
        """Simulate, diagnose and score the cases; ValueError for settings that are not allowed."""
        from soro_bench.blind_benchmark.run import run_blind_benchmark
        from soro_bench.files import check_folder, read_json
        from soro_bench.leaderboard.diagnosis_entry import write_entry
        from soro_bench.leaderboard.strict import require_jsonschema

        require_jsonschema()  # before the work, not after it
        check_folder(self.out, ["scorecard.json", "scorecard.md", "entry.json"])
        with StageBars() as bar:
            text = run_blind_benchmark(
                self.out, self.count, self.seed, self.healthy, self.ablations, self.workers, bar, self.others,
                self.sorosim,
            )  # fmt: skip
        card = read_json(self.out / "scorecard.json")
        write_entry(self.out / "entry.json", "soro_bench", "soro-bench diagnose", self.out / "cases", card)
        console.print(text, soft_wrap=True)
