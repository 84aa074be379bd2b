"""The environments in Gymnasium's registry."""

import gymnasium
from gymnasium.envs.registration import load_env_creator

_MODULES = {"TrunkReach": "trunk_reach", "TrunkPush": "trunk_push", "TrunkLift": "trunk_lift"}
_MAX_EPISODE_STEPS = 100  # published: 5 s
ENV_IDS = tuple(f"{name}-v0" for name in _MODULES)


def task_type(env_id: str):
    """The :class:`soro_bench.envs.task.Task` class of an environment id."""
    return load_env_creator(gymnasium.spec(env_id).entry_point).task_type


def register_envs() -> None:
    """Register every environment, single and vector."""
    for name, module in _MODULES.items():
        gymnasium.register(
            id=f"{name}-v0",
            entry_point=f"soro_bench.envs.{module}:{name}Env",
            vector_entry_point=f"soro_bench.envs.{module}:{name}VectorEnv",
            max_episode_steps=_MAX_EPISODE_STEPS,
        )
