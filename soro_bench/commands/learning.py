"""``soro-bench infer`` and ``train``."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from soro_bench.files import check_folder, check_output
from soro_bench.options import EnvId, KnownParameters, Parallel, check_name, check_seed, joined
from soro_bench.parallel import HERE
from soro_bench.progress import InferenceBar, TrainingBars, console
from soro_bench.registration import task_type

if TYPE_CHECKING:
    from soro_bench.randomization import Distribution


@dataclass
class Infer:
    """Infer a distribution over physical parameters from one recording."""

    method: Annotated[Literal["rf-dropo", "bayes-sim", "dropo", "droid", "sysid"], tyro.conf.Positional]
    recording: Annotated[Path, tyro.conf.Positional]
    """.parquet, of one of the environments from its reset on."""
    out: Path
    """The posterior, .json; train takes it for a distribution. A picture of it is written beside it."""
    env: str | None = None
    """Environment of the recording, where its metadata do not say so."""
    infer: tuple[str, ...] = ()
    """Names of the parameters to infer; by default those that the published study randomises in the environment."""
    known: KnownParameters = ()
    """Parameters that are known, such as trunk_mass=0.42; `recorded` takes those that the recording has. Others that
    are not inferred are nominal."""
    also: tuple[str, ...] = ()
    """Signals to infer from beside those that the environment observes, such as tension."""
    model: str | None = None
    """Model or mesh to replay the recording on; the recorded one by default."""
    noise: float = 0.0
    """Standard deviation [m] of the recorded positions."""
    seed: int = 0
    published: bool = False
    """rf-dropo: the published search, CMA-ES with 100 replays per candidate; a thousand times slower."""
    features: Literal["mdn", "mdrff"] | None = None
    """bayes-sim: what its network sees; mdn by default."""
    simulations: int | None = None
    """bayes-sim: how many; 1000 by default."""
    workers: Parallel = HERE

    def run(self) -> None:
        """Write the posterior and its report; ValueError for settings that are not allowed."""
        import matplotlib  # noqa: F401  before the work, not after it

        from soro_bench.inference.methods import infer
        from soro_bench.inference.replay import Replay
        from soro_bench.inference.report import nominal_words, write_report
        from soro_bench.recording.known import known_parameters
        from soro_bench.recording.parquet import load
        from soro_bench.registration import ENV_IDS, task_type

        check_output(self.out, ".json")
        check_folder(self.out.parent, [self.out.with_suffix(suffix).name for suffix in (".png", ".log.jsonl")])
        settings = self._settings()
        restart = self.method == "dropo"
        recording = load(self.recording)
        metadata = {"env_id": self.env, **recording.metadata} if self.env else recording.metadata
        if self.env not in (None, metadata.get("env_id")):
            raise ValueError(f"{self.recording} is of {metadata['env_id']}, not of {self.env}")
        recording = replace(recording, metadata=metadata)
        env_id = metadata.get("env_id")
        names = task_type(env_id).parameters.names if env_id in ENV_IDS else ()  # Replay refuses others
        known = known_parameters(joined(self.known), [recording], [name for name in names if name not in self.infer])
        replay = Replay(recording, self.infer or None, known.values, self.model, self.noise, restart, also=self.also)
        console.print(nominal_words(replay), soft_wrap=True)
        work = self.out.with_suffix(".log.jsonl")
        with InferenceBar(self.method) as steps:
            posterior = infer(self.method, replay, work, self.seed, steps, self.workers, **settings)
        posterior.save(self.out)
        work.unlink(missing_ok=True)  # up to 180 MB, and only an interrupted inference needs it
        console.print(write_report(posterior, replay, self.out), soft_wrap=True)

    def _settings(self) -> dict:
        """Of the method; ValueError for what it does not have."""
        if self.published and self.method != "rf-dropo":
            raise ValueError(f"--published is a search of rf-dropo; {self.method} has none")
        if self.method == "bayes-sim":
            simulations = 1000 if self.simulations is None else self.simulations
            return {"features": self.features or "mdn", "simulations": simulations}
        for name in ("features", "simulations"):
            if getattr(self, name) is not None:
                raise ValueError(f"--{name} is a setting of bayes-sim; {self.method} has none")
        return {"optimizer": "sampled"} if self.published else {}


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
    frames: int = 1
    """Observations that the policy sees, the newest last; 5 are a memory of a quarter of a second of the trunk."""
    told: Path | None = None
    """JSON file of a distribution, such as `soro-bench infer` and `diagnose` write. The policy is told the parameters
    of each episode in training, and afterwards the means of this file. Repeated with another file, the command tells
    the same policy those, without training."""
    device: str = "cpu"
    """cpu, or a GPU such as cuda, by MuJoCo Warp and rsl_rl (docs/how_to/gpu.md)."""
    room: dict[str, int] | None = None
    """On a GPU: room for contacts and rows of constraints, such as `nconmax 64 njmax 256`, where a world overflows."""
    out: Path = Path("runs/train")

    def run(self) -> None:
        """Train, or go on training; ValueError for settings that are not allowed."""
        from soro_bench.randomization import load
        from soro_bench.training.configuration import default_config
        from soro_bench.training.methods import METHODS
        from soro_bench.training.ppo import train

        task_type(self.env)
        if self.device == "cpu" and self.room:
            raise ValueError(f"--room {self.room} is for a GPU; on the CPU contacts need none")
        given = {"model": self.model, "action": self.action, "effects": self.effects and str(self.effects)}
        changes = {name: value for name, value in given.items() if value is not None}
        name = self.name or ("own" if self.randomization or self.effects else self.method)
        check_name("name", name)
        check_seed(self.seed)
        own = {"method": name, "seed": self.seed, "frames": self.frames}
        config = default_config(self.env, self.steps, self.device, **own, **changes)
        box = METHODS[self.method].distribution(self.env, self.seed, self.out)
        distribution = load(self.randomization) if self.randomization else box
        told = self._told(distribution)
        with TrainingBars() as bar:
            shown = partial(bar, f"{name} seed {self.seed}")
            if self.device == "cpu":
                train(config, self.out, distribution, shown, told)
            else:
                from soro_bench.training.device import train_on_device

                train_on_device(config, self.out, distribution, shown, self.device, self.room)
        console.print(f"policy in {self.out}")

    def _told(self, distribution: "Distribution | None") -> dict[str, float]:
        """What the policy is told, by name [SI units]; ValueError where it would learn nothing from that."""
        from soro_bench.randomization import load, told_values

        if self.told is None:
            return {}
        if distribution is None or self.device != "cpu":
            raise ValueError("--told needs parameters that vary, by --method udr or --randomization, and --device cpu")
        return told_values(load(self.told), distribution)
