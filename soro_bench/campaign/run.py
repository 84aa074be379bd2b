"""One run of a campaign: a policy is trained, evaluated on the fixed starts, and written down as an entry."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from soro_bench.files import check_output
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.enter import enter
from soro_bench.leaderboard.strict import read_strict
from soro_bench.options import check_name, check_seed
from soro_bench.packed import is_there
from soro_bench.parallel import processors
from soro_bench.randomization import Distribution, alike, holding, told_values
from soro_bench.recording.rerun_stream import require_rerun
from soro_bench.training.configuration import PPOConfig
from soro_bench.training.methods import Method
from soro_bench.training.ppo import TRAINER, train

ENTRY = "ppo"  # whose the results are, on the leaderboard


@dataclass(frozen=True)
class Run:
    """A policy of a board: by which method the training parameters are chosen, and how it is trained.

    Environment, method, length of episodes and memory in ``config`` are replaced by those of board and method.
    """

    board: str
    method: Method
    config: PPOConfig

    def __post_init__(self) -> None:
        check_name("the method", self.method.name)  # before the work, not after it
        check_seed(self.config.seed)
        board = BOARDS[self.board]
        object.__setattr__(
            self,
            "config",
            replace(
                self.config,
                env_id=board.env_id,
                method=self.method.name,
                episode_steps=board.episode_steps,
                frames=self.method.frames,
            ),
        )

    def done(self, results: Path) -> bool:
        """Whether its entry is there, of the present trainer; ValueError if that was trained with other settings."""
        if not is_there(path := self.result(results)):
            return False
        entry, asked = read_strict(path), self.config.settings()
        training = entry.get("training")
        if not isinstance(training, dict) or not isinstance(found := training.get("settings", {}), dict):
            raise ValueError(f"{path} is no entry of a run; remove it, or choose another folder for results")
        if training.get("trainer") != TRAINER:
            return False
        for name in sorted(found | asked):
            if found.get(name) != asked.get(name):
                raise ValueError(f"{path} was trained with {name} {found.get(name)}, not {asked.get(name)}; choose "
                                 "another folder for results")  # fmt: skip
        if self.method.at_once and not self._drew_from(entry.get("distribution")):
            raise ValueError(f"{path} was trained on parameters drawn otherwise than {self.method.name} says; choose "
                             "another name, or another folder for results")  # fmt: skip
        return True

    def _drew_from(self, entered: dict[str, Any] | None) -> bool:
        """Whether what an entry was trained on is what the method gives now."""
        asked = self.distribution(Path())
        return alike(entered, asked and asked.to_dict())

    @property
    def name(self) -> str:
        """board/method/seed<k>, as which it is shown and has a folder."""
        return f"{self.board}/{self.method.name}/seed{self.config.seed}"

    def distribution(self, folder: Path) -> Distribution | None:
        """What the training parameters are drawn from: the method's, with what the board gives; None for the nominal
        ones. ``folder`` is for the method's files."""
        own = self.method.distribution(self.config.env_id, self.config.seed, folder)
        return holding(own, BOARDS[self.board].fixed)

    def told(self, distribution: Distribution | None, folder: Path) -> dict[str, float]:
        """What the policy is told of the robot [SI units], by what the method finds, of the parameters that training
        draws from a distribution; nothing by most methods. See :func:`soro_bench.randomization.told_values`."""
        if self.method.told is None or distribution is None:
            return {}
        return told_values(self.method.told(self.config.env_id, self.config.seed, folder), distribution)

    def result(self, results: Path) -> Path:
        """Where its entry is written."""
        return Path(results) / self.board / ENTRY / self.method.name / f"seed{self.config.seed}.json"


def carry_out(run: Run, work: Path, results: Path) -> None:
    """Train, evaluate and write the entry, going on where that was interrupted; nothing if that is done.

    ``work`` gets <board>/<method>/seed<k>/ with checkpoint, policy, what the method inferred, and a rerun recording of
    every evaluation.
    """
    if run.done(results):
        return
    check_output(run.result(results), ".json")  # before the training, not after it
    require_rerun()
    folder, threads = Path(work) / run.name, processors()
    distribution = run.distribution(folder)
    train(replace(run.config, num_threads=threads), folder, distribution, told=run.told(distribution, folder))
    enter(folder, run.board, ENTRY, results, threads, replace_other=True)
