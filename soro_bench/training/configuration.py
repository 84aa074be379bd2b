"""The configuration of a training by PPO, and what was found best for each environment."""

from dataclasses import asdict, dataclass
from typing import Any

import gymnasium

from soro_bench.policies.policy import MAX_FRAMES, PolicyCard
from soro_bench.registration import task_type


@dataclass(frozen=True)
class PPOConfig:
    """How to train; docs/archive/training_and_speed.md says how the defaults were found."""

    env_id: str
    method: str = "oracle"
    seed: int = 0
    total_steps: int = 320_000
    model: str = "cable"  # what to train on: the environment's "model" or "mesh"
    episode_steps: int | None = None  # the registered number by default
    action: str = "continuous"
    num_envs: int = 32
    rollout_steps: int = 50  # per environment and update: half an episode
    rollouts_per_segment: int = 20
    batch_size: int = 400
    epochs: int = 10
    learning_rate: float = 7e-4  # at first; falls linearly to zero
    discount: float = 0.95
    gae_lambda: float = 0.9
    entropy_coefficient: float = 0.0
    initial_log_std: float = -1.0  # of continuous actions
    final_log_std: float | None = None  # approached linearly; None lets PPO learn it
    finite_horizon: bool = False  # what comes after the last step does not count
    observation_floor: float = 1e-4  # standard deviation under which an observation is not blown up
    hidden: tuple[int, ...] = (128, 128)
    num_threads: int = 0
    effects: str | None = None  # an effects file: physics that the model leaves out
    frames: int = 1  # observations that the policy sees, the newest last: more are its memory

    def __post_init__(self) -> None:
        counts = ("total_steps", "num_envs", "rollout_steps", "rollouts_per_segment", "batch_size", "epochs", "frames")
        for name in counts:
            if (count := getattr(self, name)) < 1:
                raise ValueError(f"{name} = {count}; at least 1 is needed")
        if self.frames > MAX_FRAMES:
            raise ValueError(f"frames = {self.frames}; at most {MAX_FRAMES} are remembered")

    @property
    def segment_steps(self) -> int:
        """Environment steps between checkpoints."""
        return self.num_envs * self.rollout_steps * self.rollouts_per_segment

    @property
    def num_segments(self) -> int:
        """Segments of the whole training, rounded up."""
        return -(-self.total_steps // self.segment_steps)

    def settings(self) -> dict[str, Any]:
        """What changes the result, as JSON; what earlier trainings could not have is there only where it is used."""
        described = asdict(self) | {"hidden": list(self.hidden)}
        del described["num_threads"], described["effects"]  # the file may be elsewhere tomorrow
        if self.frames == 1:
            del described["frames"]
        return described


# What differs from PPOConfig's defaults, which were found on TrunkReach (docs/archive/training_and_speed.md)
_TASK_DEFAULTS: dict[str, dict[str, Any]] = {
    "TrunkPush": {"initial_log_std": -0.5, "final_log_std": -2.0, "total_steps": 1_000_000},
    # A lift costs reward for three seconds before it pays: discounted by 0.95 a step it is worth less than tipping the
    # object over at once
    "TrunkLift": {
        "discount": 0.99,
        "gae_lambda": 0.95,
        "rollout_steps": 100,
        "rollouts_per_segment": 10,
        "batch_size": 800,
        "initial_log_std": -0.5,
        "final_log_std": -2.0,
        "total_steps": 1_000_000,
    },
    # Episodes of 6 or 12 steps that cost 50 times what the trunk's do: few steps, used thoroughly. What counts is where
    # the walker is after the last one; discounted, and bootstrapped beyond it, PPO settles on gaits 20 % short of it.
    "MultiGait": {
        "action": "discrete",
        "total_steps": 11_520,
        "num_envs": 24,
        "rollout_steps": 12,
        "rollouts_per_segment": 10,
        "batch_size": 96,
        "learning_rate": 1e-3,
        "discount": 1.0,
        "finite_horizon": True,
        # four times the noise that it may be observed with: the symmetric walker is not trained to move sideways
        "observation_floor": 2e-3,
        "gae_lambda": 0.95,
        "entropy_coefficient": 0.01,
        "hidden": (64, 64),
    },
}


# What differs on a GPU, where thousands of worlds cost as much as one: many short rollouts, and larger batches
_DEVICE_DEFAULTS: dict[str, Any] = {
    "action": "continuous",
    "num_envs": 4096,
    "rollout_steps": 25,
    "rollouts_per_segment": 8,
    "batch_size": 25_600,
    "epochs": 5,
    "total_steps": 16_384_000,
}


def default_config(env_id: str, steps: int | None = None, device: str = "cpu", **changes: Any) -> PPOConfig:
    """The configuration found best for an environment, with ``changes``; ``steps`` replaces its number of steps.

    Later versions have that of version 0, and TrunkGrasp has TrunkLift's: nothing was searched for them.

    Args:
        device: "cpu", or another, on which there are more environments side by side.
    """
    if steps is not None:
        changes["total_steps"] = steps
    found = _TASK_DEFAULTS.get(env_id.rpartition("-v")[0].replace("TrunkGrasp", "TrunkLift"), {})
    many = {} if device == "cpu" else _DEVICE_DEFAULTS
    return PPOConfig(env_id, **{"model": task_type(env_id).cheap, **found, **many, **changes})


def episode_steps(config: PPOConfig) -> int:
    """Steps of an episode; ValueError if none ends in a segment."""
    registered = gymnasium.spec(config.env_id).max_episode_steps
    steps = registered if config.episode_steps is None else config.episode_steps
    if steps is None or not 1 <= steps <= config.rollout_steps * config.rollouts_per_segment:
        raise ValueError(f"no episode of {steps} steps ends in a segment; raise rollout_steps or rollouts_per_segment")
    return steps


def exploration(config: PPOConfig, segment: int) -> float:
    """The logarithm of the standard deviation of continuous actions in a segment, where PPO does not learn it."""
    last = config.initial_log_std if config.final_log_std is None else config.final_log_std
    done = segment / max(1, config.num_segments - 1)
    return (1 - done) * config.initial_log_std + done * last


def card(config: PPOConfig) -> PolicyCard:
    """What the policy of a whole training is."""
    steps = config.num_segments * config.segment_steps
    return PolicyCard(config.env_id, config.model, config.action, config.method, config.seed, steps)
