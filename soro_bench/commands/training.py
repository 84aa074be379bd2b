"""``soro-bench train``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

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
    """Environment steps, rounded up to whole segments (docs/how_to/train_many_policies.md); what the environment needs
    by default."""
    model: str | None = None
    """The environment's model or mesh to train on; the cheap one by default."""
    action: Literal["discrete", "continuous"] | None = None
    """What the environment is best learned with by default."""
    out: Path = Path("runs/train")

    def run(self) -> None:
        """Train, or go on training; ValueError for settings that are not allowed."""
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
