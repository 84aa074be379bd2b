"""Short trainings with the libraries that benchmarks/compatibility.py installs, each in an environment of its own.

    python benchmarks/library_programs.py LIBRARY

The last line printed is a JSON object: what ran, and environment steps. All use the cheap model of the trunk.
"""

import argparse
import json
import re
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from gymnasium import wrappers
from gymnasium.wrappers import vector

import soro_bench  # registers the environments

if TYPE_CHECKING:
    import torch

Report = dict[str, Any]  # what ran (did), environment steps, what was left_out, warnings
Wrap = Callable[[Any], Any]  # of one environment, or of a vector
DISCRETE, CONTINUOUS = "TrunkReach-v0", "TrunkReachContinuous-v0"
CHEAP: dict[str, Any] = {"model": "cable"}
STEPS = 256
RANGE: tuple[Any, Any] = (np.float32(0.1), np.float32(0.7))  # of actions; Gymnasium's types know no such scalars


def checkers() -> Report:
    """Gymnasium's and Stable-Baselines3's checkers of all ids; warnings count as errors."""
    from gymnasium.utils.env_checker import check_env as gymnasium_check
    from stable_baselines3.common.env_checker import check_env as sb3_check

    warnings.simplefilter("error")
    ids = [*soro_bench.ENV_IDS, *(env_id.replace("-v0", "Continuous-v0") for env_id in soro_bench.ENV_IDS)]
    for env_id in ids:
        env = gymnasium.make(env_id, render_mode="rgb_array")
        gymnasium_check(env.unwrapped, skip_render_check=True)  # it would open a window
        sb3_check(env)
        env.close()
    return {"did": [f"gymnasium's check_env of {len(ids)} ids", f"Stable-Baselines3's of {len(ids)}"], "steps": 0}


def stable_baselines3() -> Report:
    """PPO, SAC and DQN on what make_vec_env makes; PPO and a video through the adapter."""
    from stable_baselines3 import DQN, PPO, SAC
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize, VecVideoRecorder

    from soro_bench.envs.sb3 import SB3VecEnv
    from soro_bench.envs.vector import SoftRobotVectorEnv

    single = make_vec_env(CONTINUOUS, n_envs=2, env_kwargs=CHEAP)
    PPO("MlpPolicy", single, n_steps=STEPS // 2, device="cpu").learn(STEPS)
    SAC("MlpPolicy", single, learning_starts=50, device="cpu").learn(STEPS)
    processes = make_vec_env(DISCRETE, n_envs=2, env_kwargs=CHEAP, vec_env_cls=SubprocVecEnv)
    DQN("MlpPolicy", processes, learning_starts=50, device="cpu").learn(STEPS)
    processes.close()
    envs = gymnasium.make_vec(DISCRETE, num_envs=4, autoreset_mode="SameStep", render_mode="rgb_array", **CHEAP)
    with tempfile.TemporaryDirectory() as folder:
        seen = VecVideoRecorder(
            SB3VecEnv(cast(SoftRobotVectorEnv, envs)), folder, lambda step: step == 0, video_length=20
        )
        PPO("MlpPolicy", VecNormalize(seen), n_steps=STEPS // 4, device="cpu").learn(STEPS)
        seen.close()
    did = ["PPO and SAC on DummyVecEnv", "DQN on SubprocVecEnv", "PPO, VecNormalize and VecVideoRecorder on SB3VecEnv"]
    return {"did": did, "steps": 4 * STEPS}


def torchrl() -> Report:
    """PPO on GymEnv; rollouts in the vector modes, each after TorchRL's check of its specs."""
    import torch
    from torchrl.collectors import Collector
    from torchrl.data.replay_buffers import LazyTensorStorage, ReplayBuffer
    from torchrl.envs import DoubleToFloat, GymEnv, GymWrapper, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs
    from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    def native(mode: str) -> GymWrapper:
        return GymWrapper(gymnasium.make_vec(CONTINUOUS, num_envs=3, autoreset_mode=mode, flat_info=True, **CHEAP))

    modes = {
        "GymEnv": lambda: GymEnv(CONTINUOUS, **CHEAP),
        "GymEnv of discrete actions": lambda: GymEnv(DISCRETE, **CHEAP),
        "GymEnv(num_envs=3)": lambda: GymEnv(CONTINUOUS, num_envs=3, flat_info=True, **CHEAP),
        "GymWrapper of make_vec, SameStep": lambda: native("SameStep"),
        "GymWrapper of make_vec, Disabled": lambda: native("Disabled"),
        "SerialEnv": lambda: SerialEnv(2, lambda: GymEnv(CONTINUOUS, **CHEAP)),
        "ParallelEnv": lambda: ParallelEnv(2, lambda: GymEnv(CONTINUOUS, **CHEAP)),
        "pixels": lambda: GymEnv(CONTINUOUS, from_pixels=True, pixels_only=False, **CHEAP),
    }
    steps = 0
    for make in modes.values():
        env = make()
        check_env_specs(env)
        steps += env.rollout(110 if "pixels" not in env.observation_spec else 5, break_when_any_done=False).numel()
        env.close()

    env = TransformedEnv(GymEnv(CONTINUOUS, **CHEAP), DoubleToFloat())
    size = env.action_spec.shape[-1]
    network = torch.nn.Sequential(MLP(out_features=2 * size, num_cells=[32]), NormalParamExtractor())
    from tensordict.nn import TensorDictModule

    module = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(
        module, spec=env.action_spec, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True,
        distribution_kwargs={"low": env.action_spec.space.low, "high": env.action_spec.space.high},
    )  # fmt: skip
    critic = ValueOperator(MLP(out_features=1, num_cells=[32]), in_keys=["observation"])
    start = env.reset()
    actor(start), critic(start)
    advantage, loss = GAE(gamma=0.99, lmbda=0.95, value_network=critic), ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), 3e-4)
    memory = ReplayBuffer(storage=LazyTensorStorage(STEPS), batch_size=64)
    collector = Collector(env, actor, frames_per_batch=STEPS, total_frames=2 * STEPS)
    for data in collector:
        advantage(data)
        memory.extend(data.reshape(-1))
        for _ in range(4):
            values = loss(memory.sample())
            optimizer.zero_grad()
            sum(value for name, value in values.items() if name.startswith("loss_")).backward()
            optimizer.step()
    collector.shutdown()
    return {"did": ["PPO on GymEnv", *modes], "steps": steps + 2 * STEPS}


def tianshou() -> Report:
    """PPO on continuous and DQN on discrete actions, by the high-level interface."""
    from tianshou.highlevel.config import OffPolicyTrainingConfig, OnPolicyTrainingConfig
    from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
    from tianshou.highlevel.experiment import DQNExperimentBuilder, ExperimentConfig, PPOExperimentBuilder

    def factory(env_id: str, kind: VectorEnvType) -> EnvFactoryRegistered:
        return EnvFactoryRegistered(task=env_id, venv_type=kind, **CHEAP)

    sizes = {"max_epochs": 1, "epoch_num_steps": STEPS, "num_training_envs": 2, "num_test_envs": 1}
    config = ExperimentConfig(persistence_enabled=False, log_file_enabled=False, watch=False)
    on_policy = OnPolicyTrainingConfig(**sizes, collection_step_num_env_steps=STEPS // 2, batch_size=64)
    with tempfile.TemporaryDirectory() as folder:
        config.persistence_base_dir = folder
        ppo = PPOExperimentBuilder(factory(CONTINUOUS, VectorEnvType.SUBPROC), config, on_policy)
        ppo.with_actor_factory_default((32,)).with_critic_factory_default((32,)).build().run()
        off_policy = OffPolicyTrainingConfig(**sizes, collection_step_num_env_steps=32)
        dqn = DQNExperimentBuilder(factory(DISCRETE, VectorEnvType.DUMMY), config, off_policy)
        dqn.with_model_factory_default((32,)).build().run()
    return {"did": ["PPO on SubprocVectorEnv", "DQN on DummyVectorEnv"], "steps": 2 * STEPS}


def rllib() -> Report:
    """Two iterations of PPO, on an id and on a function that makes environments."""
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    def train(env: str, runners: int) -> int:
        config = PPOConfig().environment(env, env_config=CHEAP).framework("torch")
        config.env_runners(num_env_runners=runners, num_envs_per_env_runner=2, rollout_fragment_length=STEPS // 2)
        config.training(train_batch_size=STEPS, minibatch_size=64, num_epochs=2)
        algorithm = config.build_algo()
        results = [algorithm.train() for _ in range(2)]
        algorithm.stop()
        return int(results[-1]["env_runners"]["num_env_steps_sampled_lifetime"])

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    register_env("trunk", lambda config: gymnasium.make("soro_bench:" + CONTINUOUS, **config))
    steps = train("soro_bench:" + DISCRETE, runners=0) + train("trunk", runners=1)
    ray.shutdown()
    return {"did": ["PPO on an id", "PPO on a function, with an EnvRunner of its own"], "steps": steps}


# --- Gymnasium's wrappers ---

WRAPPED, EPISODE = 60, 25  # steps around which a wrapper is tried, and of an episode
# those that draw, which takes a second a picture on a slow machine without a GPU
DRAWN = {
    "AddRenderObservation", "FilterObservation", "GrayscaleObservation", "HumanRendering", "ObstructView",
    "RecordVideo", "RenderCollection", "ResizeObservation",
}  # fmt: skip
DRAWN_STEPS, DRAWN_EPISODE = 8, 3
BOX = gymnasium.spaces.Box(-1.0, 1.0, (66,), np.float64)
PIXELS = (120, 160)  # to which pictures are shrunk
OTHER = "for environments that are not made of NumPy arrays"
NOT_SINGLE = {"JaxToNumpy": OTHER, "JaxToTorch": OTHER, "AtariPreprocessing": "for Atari games"}
IMAGES = "for observations that are images or dicts; single environments have them by AddRenderObservation"
NOT_VECTOR = {
    "JaxToNumpy": OTHER,
    "JaxToTorch": OTHER,
    "FilterObservation": IMAGES,
    "GrayscaleObservation": IMAGES,
    "ResizeObservation": IMAGES,
}


def numpy_and_torch() -> dict[str, ModuleType]:
    """What ArrayConversion converts between."""
    import array_api_compat.numpy
    import array_api_compat.torch

    return {"env_xp": array_api_compat.numpy, "target_xp": array_api_compat.torch}


def seen(env: gymnasium.Env) -> gymnasium.Env:
    """The environment with pictures as observations."""
    return wrappers.ResizeObservation(wrappers.AddRenderObservation(env), PIXELS)


def single_wrappers(folder: str) -> dict[str, Wrap]:
    """What to wrap an environment in, by the wrapper's name."""
    return {
        "AddRenderObservation": wrappers.AddRenderObservation,
        "AddWhiteNoise": lambda env: wrappers.AddWhiteNoise(env, 0.1),
        "ArrayConversion": lambda env: wrappers.ArrayConversion(env, **numpy_and_torch()),
        "Autoreset": wrappers.Autoreset,
        "ClipAction": wrappers.ClipAction,
        "ClipReward": lambda env: wrappers.ClipReward(env, -1.0, 1.0),
        "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
        "DiscretizeAction": lambda env: wrappers.DiscretizeAction(env, 3, multidiscrete=True),
        "DiscretizeObservation": lambda env: wrappers.DiscretizeObservation(env, 5, multidiscrete=True),
        "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float32),
        "FilterObservation": lambda env: wrappers.FilterObservation(
            wrappers.AddRenderObservation(env, render_only=False), ["state"]
        ),
        "FlattenObservation": wrappers.FlattenObservation,
        "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
        "GrayscaleObservation": lambda env: wrappers.GrayscaleObservation(wrappers.AddRenderObservation(env)),
        "HumanRendering": wrappers.HumanRendering,
        "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(env, 2),
        "NormalizeObservation": wrappers.NormalizeObservation,
        "NormalizeReward": wrappers.NormalizeReward,
        "NumpyToTorch": wrappers.NumpyToTorch,
        "ObstructView": lambda env: wrappers.ObstructView(seen(env), 0.2, 8),
        "OrderEnforcing": wrappers.OrderEnforcing,
        "PassiveEnvChecker": wrappers.PassiveEnvChecker,
        "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
        "RecordVideo": lambda env: wrappers.RecordVideo(env, f"{folder}/single"),
        "RenderCollection": wrappers.RenderCollection,
        "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
        "RescaleAction": lambda env: wrappers.RescaleAction(
            env, np.full(8, 0.1, np.float32), np.full(8, 0.7, np.float32)
        ),
        "RescaleObservation": lambda env: wrappers.RescaleObservation(env, np.float64(0.0), np.float64(2.0)),
        "ReshapeObservation": lambda env: wrappers.ReshapeObservation(env, (22, 3)),
        "ResizeObservation": seen,
        "StickyAction": lambda env: wrappers.StickyAction(env, 0.3),
        "TimeAwareObservation": wrappers.TimeAwareObservation,
        "TimeLimit": lambda env: wrappers.TimeLimit(env, 10),
        "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: -action, env.action_space),
        "TransformObservation": lambda env: wrappers.TransformObservation(env, np.negative, BOX),
        "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: 2 * float(reward)),
    }


def vector_wrappers(folder: str) -> dict[str, Wrap]:
    """The same for vector environments."""
    return {
        "ArrayConversion": lambda envs: vector.ArrayConversion(envs, **numpy_and_torch()),
        "ClipAction": vector.ClipAction,
        "ClipReward": lambda envs: vector.ClipReward(envs, -1.0, 1.0),
        "DictInfoToList": vector.DictInfoToList,
        "DtypeObservation": lambda envs: vector.DtypeObservation(envs, np.float32),
        "FlattenObservation": vector.FlattenObservation,
        "HumanRendering": vector.HumanRendering,
        "NormalizeObservation": vector.NormalizeObservation,
        "NormalizeReward": vector.NormalizeReward,
        "NumpyToTorch": vector.NumpyToTorch,
        "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
        "RecordVideo": lambda envs: vector.RecordVideo(envs, f"{folder}/vector"),
        "RescaleAction": lambda envs: vector.RescaleAction(envs, *RANGE),
        "RescaleObservation": lambda envs: vector.RescaleObservation(envs, np.float64(0.0), np.float64(2.0)),
        "ReshapeObservation": lambda envs: vector.ReshapeObservation(envs, (22, 3)),
        "TransformAction": lambda envs: vector.TransformAction(envs, np.negative),
        "TransformObservation": lambda envs: vector.TransformObservation(envs, np.negative),
        "TransformReward": lambda envs: vector.TransformReward(envs, lambda reward: 2 * reward),
        "VectorizeTransformAction": lambda envs: vector.VectorizeTransformAction(
            envs, wrappers.TransformAction, func=np.negative, action_space=envs.single_action_space
        ),
        "VectorizeTransformObservation": lambda envs: vector.VectorizeTransformObservation(
            envs, wrappers.TransformObservation, func=np.negative, observation_space=BOX
        ),
        "VectorizeTransformReward": lambda envs: vector.VectorizeTransformReward(
            envs, wrappers.TransformReward, func=lambda reward: 2 * reward
        ),
    }


def run_single(wrap: Wrap, steps: int, episode: int) -> None:
    """Some episodes of one environment; ValueError if an observation leaves the space."""
    env = wrap(gymnasium.make(CONTINUOUS, render_mode="rgb_array", max_episode_steps=episode, **CHEAP))
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        action = env.action_space.sample()
        observation, _, terminated, truncated, _ = env.step(as_torch(action) if is_torch(observation) else action)
        check(observation, env.observation_space)
        if (terminated or truncated) and not isinstance(env, wrappers.Autoreset):
            env.reset()
    env.close()


def run_vector(wrap: Wrap, steps: int, episode: int) -> None:
    """Some episodes of two simulations."""
    envs = wrap(gymnasium.make_vec(
        CONTINUOUS, num_envs=2, render_mode="rgb_array", max_episode_steps=episode, **CHEAP
    ))  # fmt: skip
    envs.action_space.seed(0)
    observation, _ = envs.reset(seed=0)
    for _ in range(steps):
        action = envs.action_space.sample()
        observation, *_ = envs.step(as_torch(action) if is_torch(observation) else action)
        check(observation, envs.observation_space)
    envs.close()


def is_torch(observation: object) -> bool:
    """Whether an observation is a tensor."""
    return type(observation).__module__ == "torch"


def as_torch(action: Any) -> "torch.Tensor":
    """An action as such an environment takes it."""
    import torch

    return torch.as_tensor(action)


def check(observation: Any, space: gymnasium.Space) -> None:
    """ValueError if an observation is outside its space."""
    if is_torch(observation):
        observation = observation.numpy()
    if observation not in space:
        raise ValueError(f"an observation of the shape {np.shape(observation)} is not in {space}")


def run_all(
    names: Sequence[str],
    wrap: Mapping[str, Wrap],
    not_applying: Mapping[str, str],
    run: Callable[[Wrap, int, int], None],
) -> tuple[list[str], list[str]]:
    """The names of the wrappers that ran, and warnings that they gave."""
    if unknown := set(names) - set(wrap) - set(not_applying):
        raise NotImplementedError(f"wrappers that are not tried here: {', '.join(sorted(unknown))}")
    ran, warned = [], []
    for name in sorted(set(names) & set(wrap)):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            run(wrap[name], *((DRAWN_STEPS, DRAWN_EPISODE) if name in DRAWN else (WRAPPED, EPISODE)))
        ran.append(name)
        messages = {re.sub(r"\x1b\[\d+m", "", str(each.message)) for each in found}  # without their colours
        warned += [f"{name}: {message}" for message in sorted(messages)]
    return ran, warned


def all_wrappers() -> Report:
    """Every wrapper, single and vector, for some episodes each; NotImplementedError if one is not listed above."""
    with tempfile.TemporaryDirectory() as folder:
        names = [name for name in wrappers.__all__ if name != "vector"]
        ones, warned = run_all(names, single_wrappers(folder), NOT_SINGLE, run_single)
        many, more = run_all(vector.__all__, vector_wrappers(folder), NOT_VECTOR, run_vector)
    did = [f"{len(ones)} wrappers of gymnasium.wrappers", f"{len(many)} of gymnasium.wrappers.vector"]
    left_out = [f"{name}: {why}" for name, why in NOT_SINGLE.items()]
    left_out += [f"vector.{name}: {why}" for name, why in NOT_VECTOR.items()]
    steps = sum(DRAWN_STEPS if name in DRAWN else WRAPPED for name in (*ones, *many, *many))
    return {"did": did, "steps": steps, "left_out": left_out, "warnings": warned + more}


PROGRAMS = {
    "wrappers": all_wrappers,
    "checkers": checkers,
    "stable-baselines3": stable_baselines3,
    "torchrl": torchrl,
    "tianshou": tianshou,
    "rllib": rllib,
}


def main() -> None:
    """Run what is asked for, and print the object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", choices=PROGRAMS)
    program = PROGRAMS[parser.parse_args().library]
    np.random.seed(0)  # noqa: NPY002  # of the libraries
    print(json.dumps(program()))


if __name__ == "__main__":
    main()
