"""PPO on a GPU: environments, policy and updates on one device (needs the ``gpu`` extra).

The update is that of rsl_rl (Schwarke et al., "RSL-RL: A Learning Library for Robotics Research", 2025), with the
settings that Stable-Baselines3 has on the CPU (ppo.py). Configuration, segments, checkpoints, curve and policy are
those of the CPU's training.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from soro_bench.envs.torch_vector import TorchVectorEnv
from soro_bench.files import write_json
from soro_bench.policies.policy import OBSERVATION_CLIP, Policy
from soro_bench.randomization import Distribution
from soro_bench.registration import task_type
from soro_bench.sources import metric_key
from soro_bench.training.configuration import PPOConfig, card, episode_steps, exploration
from soro_bench.training.ppo import CheckpointFolder, Curve, TrainingProgress, claim

try:
    from rsl_rl.algorithms import PPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage
    from tensordict import TensorDict
except ImportError as error:
    raise ImportError(f"training on a GPU needs the gpu extra: pip install 'soro_bench[gpu]' ({error})") from error

_GROUPS = {"actor": ["policy"], "critic": ["policy"]}  # what networks see, in rsl_rl's terms


class Normaliser:
    """Mean and variance of all observations so far, on the device (Chan et al. 1979: merged over batches).

    Args:
        size: numbers of an observation. floor: standard deviation under which one is not blown up.
    """

    def __init__(self, size: int, floor: float, device: str):
        self.mean = torch.zeros(size, dtype=torch.float64, device=device)
        self.var = torch.ones(size, dtype=torch.float64, device=device)
        self.count, self._floor = 1e-4, floor

    @property
    def std(self) -> torch.Tensor:
        """(k,) what observations are divided by."""
        return (self.var + self._floor**2).sqrt()

    def update(self, observations: torch.Tensor) -> None:
        """Take observations (N, k) into account."""
        batch, count = observations.double(), len(observations)
        apart, total = batch.mean(dim=0) - self.mean, self.count + count
        squares = self.var * self.count + batch.var(dim=0, correction=0) * count
        self.var = (squares + apart**2 * self.count * count / total) / total
        self.mean, self.count = self.mean + apart * count / total, total

    def __call__(self, observations: torch.Tensor) -> TensorDict:
        """Observations (N, k) as networks see them."""
        seen = ((observations.double() - self.mean) / self.std).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        return TensorDict({"policy": seen.float()}, batch_size=[len(observations)])


class DeviceTrainer:
    """One training on a device.

    Args:
        config: what to train; continuous actions only.
        distribution: what the parameters of every episode are drawn from; nominal if None.
        device: of environments and networks.
        room: for contacts; see :class:`soro_bench.envs.torch_vector.TorchVectorEnv`.
    """

    def __init__(
        self,
        config: PPOConfig,
        distribution: Distribution | None,
        device: str,
        room: Mapping[str, int] | None = None,
    ):
        if config.action != "continuous":
            raise ValueError(f"action={config.action}: training on a device has continuous actions; use --device cpu")
        if config.frames > 1:
            raise ValueError(f"frames={config.frames}: training on a device has no memory; use --device cpu")
        self.config, self.device = config, device
        self.envs = TorchVectorEnv(
            config.env_id, config.num_envs, device, config.model, config.action, distribution, config.effects,
            episode_steps(config), on_nan="truncate", room=room,
        )  # fmt: skip
        size = self.envs.single_observation_space.shape[0]
        actions = (self.envs.single_action_space.shape or (0,))[0]
        self.normaliser = Normaliser(size, config.observation_floor, device)
        torch.manual_seed(config.seed)
        seen = self.normaliser(torch.zeros(config.num_envs, size, device=device))
        learned = config.final_log_std is None
        spread = {"class_name": "GaussianDistribution", "init_std": float(np.exp(config.initial_log_std)),
                  "std_type": "log", "learn_std": learned}  # fmt: skip
        networks = {"hidden_dims": config.hidden, "activation": "tanh"}
        self.agent = PPO(
            MLPModel(seen, _GROUPS, "actor", actions, distribution_cfg=spread, **networks),
            MLPModel(seen, _GROUPS, "critic", 1, **networks),
            RolloutStorage("rl", config.num_envs, config.rollout_steps, seen, [actions], device),
            num_learning_epochs=config.epochs,
            num_mini_batches=max(1, config.num_envs * config.rollout_steps // config.batch_size),
            gamma=config.discount,
            lam=config.gae_lambda,
            value_loss_coef=0.5,
            entropy_coef=config.entropy_coefficient,
            learning_rate=config.learning_rate,
            max_grad_norm=0.5,
            use_clipped_value_loss=False,
            schedule="fixed",
            normalize_advantage_per_mini_batch=True,
            device=device,
        )
        self.metric = task_type(config.env_id).metric
        self.updates = 0

    def run_segment(self, segment: int, curve: Curve, progress: TrainingProgress) -> None:
        """Train for one segment, from episodes and generators that begin anew."""
        config = self.config
        seed = int(np.random.SeedSequence([config.seed, segment]).generate_state(1)[0])
        torch.manual_seed(seed)
        if config.final_log_std is not None:
            self.agent.actor.distribution.log_std_param.data.fill_(exploration(config, segment))
        observation, _ = self.envs.reset(seed=seed % 2**31)
        self.normaliser.update(observation)
        returns = torch.zeros(config.num_envs, device=self.device)
        start = time.monotonic() - curve.seconds
        per_rollout = config.num_envs * config.rollout_steps
        total = config.num_segments * config.segment_steps
        for rollout in range(config.rollouts_per_segment):
            steps = segment * config.segment_steps + rollout * per_rollout
            for group in self.agent.optimizer.param_groups:
                group["lr"] = config.learning_rate * (1.0 - steps / total)
            finished: list[torch.Tensor] = []
            for _ in range(config.rollout_steps):
                observation = self._step(observation, returns, finished)
            with torch.inference_mode():
                self.agent.compute_returns(self.normaliser(observation))
            self.agent.update()
            self.updates += 1
            if not all(bool(each.isfinite().all()) for each in self.agent.actor.parameters()):
                raise ValueError(f"training diverged after {steps + per_rollout} steps; the last checkpoint is kept")
            if finished:
                ended = torch.cat(finished).cpu().numpy()
                row = {"steps": steps + per_rollout, "seconds": round(time.monotonic() - start, 1),
                       "episodes": len(ended), metric_key(self.metric): round(1e3 * float(ended[:, 0].mean()), 3),
                       "return": round(float(ended[:, 1].mean()), 3)}  # fmt: skip
                curve.rows.append(row)
                progress(steps + per_rollout, total, row)

    def _step(self, observation: torch.Tensor, returns: torch.Tensor, finished: list[torch.Tensor]) -> torch.Tensor:
        """One step of all environments; adds metric and return of the episodes that end to ``finished``."""
        with torch.inference_mode():
            actions = self.agent.act(self.normaliser(observation))
            following, reward, _, _, info = self.envs.step(actions)
            returns += reward
            done = info["done"]
            if not self.config.finite_horizon and bool(done.any()):
                # what comes after the last step counts as the critic expects it to; after success too, or the policy
                # would rather wait beside the goal
                last = self.agent.critic(self.normaliser(info["final_obs"]))[:, 0]
                reward = reward + self.config.discount * last * done
            self.agent.process_env_step(self.normaliser(following), reward, done, {})
            if bool(done.any()):
                finished.append(torch.stack([info[self.metric][done], returns[done]], dim=1))
                returns[done] = 0.0
            self.normaliser.update(following)
        return following

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds of networks and observations."""
        return {
            "updates": self.updates,
            "policy": {"actor": self.agent.actor.state_dict(), "critic": self.agent.critic.state_dict()},
            "optimizer": self.agent.optimizer.state_dict(),
            "mean": self.normaliser.mean.cpu(),
            "var": self.normaliser.var.cpu(),
            "count": float(self.normaliser.count),
        }

    def restore(self, checkpoint: dict[str, Any]) -> None:
        """Go on from what a checkpoint holds."""
        self.agent.actor.load_state_dict(checkpoint["policy"]["actor"])
        self.agent.critic.load_state_dict(checkpoint["policy"]["critic"])
        self.agent.optimizer.load_state_dict(checkpoint["optimizer"])
        self.updates = checkpoint["updates"]
        if checkpoint["mean"].shape != self.normaliser.mean.shape:
            raise ValueError(
                f"observations of {len(checkpoint['mean'])} numbers; {len(self.normaliser.mean)} are needed"
            )
        self.normaliser.mean = checkpoint["mean"].to(self.device)
        self.normaliser.var = checkpoint["var"].to(self.device)
        self.normaliser.count = checkpoint["count"]

    def policy(self) -> Policy:
        """The policy as it is now, which is evaluated on the CPU as all are."""
        tensors = {"mean": self.normaliser.mean, "std": self.normaliser.std}
        layers = [each for each in self.agent.actor.mlp if isinstance(each, torch.nn.Linear)]
        for i, layer in enumerate(layers):
            tensors |= {f"w{i}": layer.weight.detach(), f"b{i}": layer.bias.detach()}
        return Policy(card(self.config), {name: each.cpu().numpy() for name, each in tensors.items()})


def train_on_device(
    config: PPOConfig,
    folder: str | Path,
    distribution: Distribution | None = None,
    progress: TrainingProgress = lambda steps, total, row: None,
    device: str = "cuda:0",
    room: Mapping[str, int] | None = None,
) -> Policy:
    """As :func:`soro_bench.training.ppo.train`, on a device; an interrupted training goes on from its checkpoint.

    Args:
        device, room: see :class:`DeviceTrainer`; room changes nothing but memory.
    """
    folder = Path(folder)
    described, old = claim(folder, config, distribution, learner="rsl_rl")
    trainer = DeviceTrainer(config, distribution, device, room)
    trainer.envs.reset(seed=config.seed)  # what the device refuses is refused before anything is deleted
    for path in old:
        path.unlink(missing_ok=True)
    write_json(folder / "config.json", described)
    curve = Curve()
    kept = CheckpointFolder(folder, config, curve)
    first = kept.load(trainer.restore)
    for segment in range(first, config.num_segments):
        trainer.run_segment(segment, curve, progress)
        kept.save(segment + 1, trainer.state())
    policy = trainer.policy()
    policy.save(folder)
    return policy
