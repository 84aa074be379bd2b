"""``soro-bench train`` and ``evaluate``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from soro_bench.options import EnvId, check_name, check_seed
from soro_bench.progress import TrainingBars, console
from soro_bench.registration import task_type


@dataclass
class Train:
    """Train one policy by PPO; goes on where an interrupted training stopped."""

    env: EnvId
    method: Literal["oracle", "udr"] = "oracle"
    """oracle: nominal parameters. udr: a random box of the search space, drawn from the seed."""
    randomization: Path | None = None
    """JSON file of a distribution to train on instead of the method's."""
    effects: Path | None = None
    """JSON file of physics that the model leaves out, such as `soro-bench diagnose` writes."""
    name: str | None = None
    """What the method is called on a leaderboard: by default oracle or udr, and "own" with --randomization or
    --effects."""
    seed: int = 0
    steps: int | None = None
    """Environment steps, rounded up to whole segments (docs/training.md); what the environment needs by default."""
    model: str | None = None
    """The environment's model or mesh to train on; the cheap one by default."""
    action: Literal["discrete", "continuous"] | None = None
    """What the environment is best learned with by default."""
    out: Path = Path("runs/train")

    def run(self) -> None:
        from soro_bench.randomization import load
        from soro_bench.training.methods import METHODS
        from soro_bench.training.ppo import default_config, train

        task_type(self.env)
        given = {"model": self.model, "action": self.action, "effects": self.effects and str(self.effects)}
        changes = {name: value for name, value in given.items() if value is not None}
        name = self.name or ("own" if self.randomization or self.effects else self.method)
        check_name("name", name)
        check_seed(self.seed)
        config = default_config(self.env, self.steps, method=name, seed=self.seed, **changes)
        box = METHODS[self.method].distribution(self.env, self.seed, self.out)
        distribution = load(self.randomization) if self.randomization else box
        with TrainingBars() as bar:
            train(config, self.out, distribution, lambda *progress: bar(f"{name} seed {self.seed}", *progress))
        console.print(f"policy in {self.out}")


@dataclass
class Evaluate:
    """Run a policy on the fixed evaluation episodes and record them."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Folder with policy.json and policy.safetensors, or an entry of the leaderboard, .json."""
    board: str | None = None
    """Which evaluation, such as TrunkLift-v0-50g; by default the first of the policy's environment."""
    on: str | None = None
    """Which of its conditions, such as cable or flex; the accurate model by default."""
    out: Path | None = None
    """Folder for the results; the policy's own by default, which an entry needs to be told."""

    def run(self) -> None:
        from soro_bench.campaign.run import record_evaluations
        from soro_bench.files import read_json, write_json
        from soro_bench.leaderboard.boards import board_of
        from soro_bench.training.policy import Policy

        policy, out = Policy.load(self.policy), self.out or self.policy
        if out.suffix == ".json":
            raise ValueError(f"{out} is an entry: say with --out where its results go")
        name, board = board_of(policy.card.env_id, self.board)
        label = self.on or task_type(board.env_id).accurate
        path = out / f"evaluation_{label}.json"
        before = read_json(path) if path.exists() else {"board": name}
        if not isinstance(before, dict) or before.get("board") != name:
            raise ValueError(f"{path} holds other results: say with --out where those on {name} go")
        scores = record_evaluations(policy, name, (board.labelled(label),), out)
        write_json(path, {"board": name, **scores})
        final = scores[label]["final_mm"]
        mean, solved = sum(final) / len(final), sum(scores[label]["success"])
        said = f"{name} on {label}: final {board.metric} {mean:.2f} mm, mean of {len(final)} episodes; {solved} solved"
        console.print(said, soft_wrap=True)
