"""PPO (stable-baselines3) on the vector environments, in segments that make it resumable.

Training is a row of segments. At the start of each, every random generator is reseeded from (seed, segment) and all
episodes start anew; at its end a checkpoint is written. So a run that was killed goes on from its last checkpoint, and
its policy has the same bytes as that of one that was not; its curve has other seconds.
"""

import csv
import io
import time
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from soro_bench.envs.sb3 import ParametersTold, SB3VecEnv
from soro_bench.envs.task import effects_of
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.errors import missing, one_line
from soro_bench.files import brief, read_bytes, read_json, replacing, write_json
from soro_bench.models.simulation import quiet
from soro_bench.policies.policy import OBSERVATION_CLIP, Policy
from soro_bench.randomization import Distribution, alike
from soro_bench.registration import task_type
from soro_bench.sources import metric_key
from soro_bench.training.configuration import PPOConfig, card, episode_steps, exploration

TrainingProgress = Callable[[int, int, dict[str, float]], None]  # steps done, steps in total, a row of the curve
# version of how a configuration becomes a policy; 1 let the learning rate fall in every segment anew, for 1 and 2
# nothing that came after success counted, and 1 to 3 let observations that hardly vary be blown up
TRAINER = 4
_WRITTEN = ("checkpoint.pt", "curve.csv", "policy.json", "policy.safetensors")  # by a training
_CHECKPOINT_BYTES = 1_000_000_000  # that are read; those of the suite have some 100 KB


@quiet()
def train(
    config: PPOConfig,
    folder: str | Path,
    distribution: Distribution | None = None,
    progress: TrainingProgress = lambda steps, total, row: None,
    told: Mapping[str, float] | None = None,
) -> Policy:
    """Train, or go on training, into ``folder`` and return the policy.

    Args:
        config: what to train; a folder that holds another configuration's run is refused.
        folder: gets config.json, checkpoint.pt (after every segment), curve.csv and policy.*.
        distribution: what the parameters of every episode are drawn from; nominal if None.
        progress: called after every rollout in which an episode ended, with steps done, steps in total and the newest
            row of the curve.
        told: parameters of its episode that the policy is told in training, and what it is told afterwards of the
            robot [SI units]: a universal policy (Yu et al., "Preparing for the unknown", RSS 2017). Other values of the
            same parameters need no other training.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums would depend on the number; networks this small gain nothing from more
    try:
        return _train(config, Path(folder), distribution, progress, dict(told or {}))
    finally:
        torch.set_num_threads(threads)


def _train(
    config: PPOConfig,
    folder: Path,
    distribution: Distribution | None,
    progress: TrainingProgress,
    told: Mapping[str, float],
) -> Policy:
    described, old = claim(folder, config, distribution, told=told)
    told = described.get("told", {})
    env = make_env(config, distribution, tuple(told))
    episode_steps(config)
    agent = make_agent(config, env)
    for path in old:  # only now: what cannot be trained claims no folder
        path.unlink(missing_ok=True)
    write_json(folder / "config.json", described)
    curve = Curve()
    kept = CheckpointFolder(folder, config, curve)
    for segment in range(kept.load(lambda found: _restore(found, agent, env)), config.num_segments):
        _run_segment(config, segment, agent, env, curve, progress)
        kept.save(segment + 1, _state(agent, env))
    env.close()
    policy = _export(config, agent, env)
    if told:
        policy = policy.told(np.array(list(told.values())))
    policy.save(folder)
    return policy


def claim(
    folder: Path,
    config: PPOConfig,
    distribution: Distribution | None,
    learner: str | None = None,
    told: Mapping[str, float] | None = None,
) -> tuple[dict[str, Any], list[Path]]:
    """What is trained into a folder, and files of an older trainer, whose run is trained anew; ValueError if the folder
    has another run.

    Args:
        learner: the library whose PPO it is, if it is not Stable-Baselines3's.
        told: see :func:`train`; other values are no other run, and it keeps the order in which it was told them.
    """
    described = config.settings() | {"distribution": distribution.to_dict() if distribution else None}
    if config.effects:
        described["effects"] = [effect.to_json() for effect in effects_of(config.effects) or ()]
    described["trainer"] = TRAINER
    if learner:
        described["learner"] = learner
    if told:
        described["told"] = dict(told)
    path, written = folder / "config.json", [folder / name for name in _WRITTEN]
    if not path.exists():
        if left := [each.name for each in written if each.exists()]:
            raise ValueError(
                f"{folder} has {', '.join(left)}, and no config.json that says of which run; choose another folder"
            )
        return described, []
    found = read_json(path)
    drawn = isinstance(found, dict) and alike(found.get("distribution"), described["distribution"])
    if drawn and _but_for_values(found, described):
        return found | {"told": {name: described["told"][name] for name in found["told"]}}, []
    if drawn and found == described:
        return described, []
    if not isinstance(found, dict) or type(trainer := found.get("trainer", 0)) is not int:
        raise ValueError(f"{path} describes no training: it is {brief(found)}")
    if trainer > TRAINER:
        raise ValueError(f"{folder} holds a run of a newer trainer ({trainer}; this one is {TRAINER})")
    # an older one may not have had some of the settings, but what the robot is like it said
    keys = found.keys() & described.keys() - {"trainer"} | {"effects", "distribution"}
    if different := sorted(k for k in (keys if trainer < TRAINER else found | described)
                           if found.get(k) != described.get(k) or (k == "distribution" and not drawn)):  # fmt: skip
        raise ValueError(f"{folder} holds a run with another {', '.join(different)}; choose another folder")
    return described, written


def _but_for_values(found: dict[str, Any], described: dict[str, Any]) -> bool:
    """Whether a run is the same but for what its policy is told afterwards."""
    told = described.get("told", {})
    if not isinstance(values := found.get("told"), dict) or values.keys() != told.keys():
        return False
    return found | {"told": told} == described


def make_env(config: PPOConfig, distribution: Distribution | None = None, told: Sequence[str] = ()) -> VecNormalize:
    """The environments of a training, as Stable-Baselines3 takes them; ``told`` are parameters that the policy sees."""
    options: dict[str, Any] = {task_type(config.env_id).variant_name: config.model}
    if config.episode_steps is not None:
        options["max_episode_steps"] = config.episode_steps
    if config.effects is not None:
        options["effects"] = config.effects
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the boards are of version 0
        envs = gymnasium.make_vec(
            config.env_id,
            num_envs=config.num_envs,
            num_threads=config.num_threads,
            action=config.action,
            autoreset_mode="SameStep",
            **options,
        ).unwrapped
    if not isinstance(envs, SoftRobotVectorEnv):
        raise TypeError(f"{config.env_id} is no environment of the suite")
    if distribution is not None:
        envs.task.randomize(distribution)
    seen: VecEnv = SB3VecEnv(envs, config.finite_horizon)
    if config.frames > 1:
        seen = VecFrameStack(seen, config.frames)
    if told:
        seen = ParametersTold(seen, envs.task, told)
    return VecNormalize(seen, norm_reward=False, clip_obs=OBSERVATION_CLIP, epsilon=config.observation_floor**2)


def make_agent(config: PPOConfig, env: VecNormalize, device: str = "cpu") -> PPO:
    """PPO as configured. Networks this small gain nothing from a GPU (docs/how_to/make_it_fast.md), and on the CPU a
    policy has the same bytes with and without one."""
    agent = PPO(
        "MlpPolicy",
        env,
        learning_rate=config.learning_rate,
        n_steps=config.rollout_steps,
        batch_size=config.batch_size,
        n_epochs=config.epochs,
        gamma=config.discount,
        gae_lambda=config.gae_lambda,
        ent_coef=config.entropy_coefficient,
        policy_kwargs={"net_arch": list(config.hidden), "log_std_init": config.initial_log_std},
        seed=config.seed,
        device=device,
    )
    agent.set_logger(Logger(folder=None, output_formats=[]))  # the default leaves a folder in /tmp per segment
    return agent


def _run_segment(
    config: PPOConfig, segment: int, agent: PPO, env: VecNormalize, curve: "Curve", progress: TrainingProgress
) -> None:
    """Train for one segment, from episodes and generators that begin anew."""
    seed = int(np.random.SeedSequence([config.seed, segment]).generate_state(1)[0])
    set_random_seed(seed)
    env.seed(seed)
    agent._last_obs = None  # makes learn() reset the environments
    if config.final_log_std is not None and config.action == "continuous":
        agent.policy.log_std.requires_grad_(False).fill_(exploration(config, segment))
    agent.num_timesteps = segment * config.segment_steps
    total = config.num_segments * config.segment_steps
    # what SB3 takes for the progress is that of this segment only
    agent.lr_schedule = lambda _: config.learning_rate * (1.0 - agent.num_timesteps / total)
    callback = _Watch(curve, progress, total, task_type(config.env_id).metric)
    agent.learn(config.segment_steps, callback=callback, reset_num_timesteps=False)


class Curve:
    """Rows of the training curve, one per rollout."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    @property
    def seconds(self) -> float:
        """s, of training so far."""
        return self.rows[-1]["seconds"] if self.rows else 0.0


class _Watch(BaseCallback):
    """Gathers finished episodes and adds a row to the curve after every rollout."""

    def __init__(self, curve: Curve, progress: TrainingProgress, total: int, metric: str):
        super().__init__()
        self._metric_key = metric_key(metric)
        self._curve, self._progress, self._total = curve, progress, total
        self._finished: list[dict[str, Any]] = []
        self._start = time.monotonic() - curve.seconds

    def _on_step(self) -> bool:
        self._finished += [info for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        if not self._finished:
            return
        row = {
            "steps": self.num_timesteps,
            "seconds": round(time.monotonic() - self._start, 1),
            "episodes": len(self._finished),
            self._metric_key: round(1e3 * float(np.mean([info["metric"] for info in self._finished])), 3),
            "return": round(float(np.mean([info["episode"]["r"] for info in self._finished])), 3),
        }
        self._curve.rows.append(row)
        self._finished = []
        self._progress(self.num_timesteps, self._total, row)


def _observed(env: VecNormalize) -> RunningMeanStd:
    """Mean and variance of the observations so far."""
    if not isinstance(env.obs_rms, RunningMeanStd):
        raise TypeError("observations that are no dict are needed")
    return env.obs_rms


class CheckpointFolder:
    """Where a training keeps its curve and its last checkpoint.

    Args:
        folder: of the run. config: what is trained. curve: its rows so far, which loading replaces.
    """

    def __init__(self, folder: Path, config: PPOConfig, curve: Curve):
        self._folder, self._path, self._config, self._curve = folder, folder / "checkpoint.pt", config, curve

    def save(self, segment: int, state: dict[str, Any]) -> None:
        """Write that ``segment`` comes next, and the state of networks and observations; OSError that says how to go
        on if the folder takes no more."""
        torch.save({"segment": segment, **state, "curve": self._curve.rows}, buffer := io.BytesIO())
        try:
            # the curve first: with a later checkpoint than its rows it would stay short
            with replacing(self._folder / "curve.csv") as temporary, temporary.open("w", newline="") as file:
                writer = csv.DictWriter(file, self._curve.rows[0])
                writer.writeheader()
                writer.writerows(self._curve.rows)
            with replacing(self._path) as temporary:
                temporary.write_bytes(buffer.getvalue())
        except OSError as error:
            raise OSError(
                f"{self._path} cannot be written: {one_line(error)}; make room, and repeat the command: it goes on "
                "from the checkpoint before"
            ) from error

    def load(self, restore: Callable[[dict[str, Any]], None]) -> int:
        """The segment that comes next, 0 without a checkpoint, once ``restore`` has taken the state over. Tensors and
        plain values are read, never pickled objects; ValueError for anything else."""
        if not self._path.exists():
            return 0
        try:
            data = io.BytesIO(read_bytes(self._path, _CHECKPOINT_BYTES))
            if not zipfile.is_zipfile(data):
                raise ValueError("it is cut off, or another program has written it")
            data.seek(0)
            return self._take(torch.load(data, map_location="cpu", weights_only=True), restore)
        except Exception as error:  # torch raises errors of nearly any type for bytes that it has not written
            if missing(error):  # which says nothing about the file
                raise
            raise ValueError(
                f"{self._path} is no checkpoint of this training: {one_line(error)[:200]}; remove checkpoint.pt to "
                "train from the beginning"
            ) from error

    def _take(self, checkpoint: Any, restore: Callable[[dict[str, Any]], None]) -> int:
        keys = {"segment", "updates", "policy", "optimizer", "mean", "var", "count", "curve"}
        if not isinstance(checkpoint, dict) or checkpoint.keys() != keys:
            raise ValueError(f"it has not just {', '.join(sorted(keys))}")
        segment, most = checkpoint["segment"], self._config.num_segments
        if type(segment) is not int or not 1 <= segment <= most:
            raise ValueError(f"segment {brief(segment)}; 1 to {most} are those of this training")
        restore(checkpoint)
        if not (isinstance(rows := checkpoint["curve"], list) and all(isinstance(row, dict) for row in rows)):
            raise ValueError(f"its curve is {brief(rows)}")
        self._curve.rows = rows
        return segment


def _state(agent: PPO, env: VecNormalize) -> dict[str, Any]:
    """What a checkpoint holds of networks and observations."""
    return {
        "updates": agent._n_updates,
        "policy": agent.policy.state_dict(),
        "optimizer": agent.policy.optimizer.state_dict(),
        "mean": torch.from_numpy(_observed(env).mean.copy()),
        "var": torch.from_numpy(_observed(env).var.copy()),
        "count": float(_observed(env).count),
    }


def _restore(checkpoint: dict[str, Any], agent: PPO, env: VecNormalize) -> None:
    observed = _observed(env)
    agent.policy.load_state_dict(checkpoint["policy"])
    agent.policy.optimizer.load_state_dict(checkpoint["optimizer"])
    agent._n_updates = checkpoint["updates"]
    mean, var = checkpoint["mean"].numpy(), checkpoint["var"].numpy()
    if mean.shape != observed.mean.shape or var.shape != observed.var.shape:
        raise ValueError(f"observations of shapes {mean.shape} and {var.shape}; {observed.mean.shape} is needed")
    observed.mean, observed.var, observed.count = mean, var, checkpoint["count"]


def _export(config: PPOConfig, agent: PPO, env: VecNormalize) -> Policy:
    policy = agent.policy
    layers = [m for m in policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)]
    tensors = {"mean": _observed(env).mean, "std": np.sqrt(_observed(env).var + env.epsilon)}
    for i, layer in enumerate([*layers, cast("torch.nn.Linear", policy.action_net)]):
        tensors[f"w{i}"] = layer.weight.detach().numpy()
        tensors[f"b{i}"] = layer.bias.detach().numpy()
    return Policy(card(config), tensors)
