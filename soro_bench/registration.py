"""The environments in Gymnasium's registry."""

import gymnasium
from gymnasium.envs.registration import load_env_creator

# module and published length of an episode [steps]
_ENVS = {
    "TrunkReach": ("trunk_reach", 100),
    "TrunkPush": ("trunk_push", 100),
    "TrunkLift": ("trunk_lift", 100),
    "MultiGait": ("multigait", 6),
}
ENV_IDS = tuple(f"{name}-v0" for name in _ENVS)


def task_type(env_id: str):
    """The :class:`soro_bench.envs.task.Task` class of an environment id; ValueError if it is none of the suite's."""
    if env_id not in ENV_IDS:
        raise ValueError(f"there is no environment {env_id!r}; there are {', '.join(ENV_IDS)}")
    return load_env_creator(gymnasium.spec(env_id).entry_point).task_type


def make_task(env_id: str, num_envs: int, num_threads: int, model: str, **options):
    """A task with ``model`` for the argument that picks its robot's model ("model", or "mesh")."""
    task = task_type(env_id)
    return task(num_envs, num_threads, **{task.variant_name: model}, **options)


def register_envs() -> None:
    """Register every environment, single and vector."""
    for name, (module, steps) in _ENVS.items():
        gymnasium.register(
            id=f"{name}-v0",
            entry_point=f"soro_bench.envs.{module}:{name}Env",
            vector_entry_point=f"soro_bench.envs.{module}:{name}VectorEnv",
            max_episode_steps=steps,
        )
