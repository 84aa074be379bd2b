"""The environments in Gymnasium's registry."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import gymnasium
from gymnasium.envs.registration import load_env_creator

if TYPE_CHECKING:  # the environments are imported when they are made
    from soro_bench.envs.single import SoftRobotEnv
    from soro_bench.envs.task import Task

# module and published length of an episode [steps]
_ENVS = {
    "TrunkReach-v0": ("trunk_reach", 100),
    "TrunkReach-v1": ("trunk_reach", 100),
    "TrunkPush-v0": ("trunk_push", 100),
    "TrunkPush-v1": ("trunk_push", 100),
    "TrunkLift-v0": ("trunk_lift", 100),
    "TrunkLift-v1": ("trunk_lift", 100),
    "TrunkGrasp-v0": ("trunk_lift", 100),
    "MultiGait-v0": ("multigait", 6),
}
ENV_IDS = tuple(_ENVS)
FIRST_IDS = tuple(env_id for env_id in ENV_IDS if env_id.endswith("-v0"))  # each has a page
# the same with action="continuous", for programs that choose an environment by its id alone
CONTINUOUS_IDS = {env_id: env_id.replace("-", "Continuous-") for env_id in ENV_IDS}


def task_type(env_id: str) -> "type[Task]":
    """The :class:`soro_bench.envs.task.Task` class of an environment id; ValueError if it is none of the suite's."""
    if env_id in CONTINUOUS_IDS.values():
        plain = next(plain for plain, continuous in CONTINUOUS_IDS.items() if continuous == env_id)
        raise ValueError(f"{env_id} is {plain} with continuous actions: write {plain} here, and the actions beside it")
    if env_id not in ENV_IDS:
        raise ValueError(f"there is no environment {env_id!r}; there are {', '.join(ENV_IDS)}")
    env_type = cast("type[SoftRobotEnv]", load_env_creator(cast("str", gymnasium.spec(env_id).entry_point)))
    return env_type.task_type


def make_task(env_id: str, num_envs: int, num_threads: int, model: str, **options: Any) -> "Task":
    """A task of an environment.

    Args:
        env_id: of the suite.
        num_envs: how many simulations it has.
        num_threads: 0 for all processors; results do not depend on it.
        model: for the argument that picks the robot's model ("model", or "mesh").
        options: further arguments of the task.

    Raises:
        ValueError: the environment is none of the suite's, or an argument is not allowed.
    """
    kind = task_type(env_id)
    build: Callable[..., Task] = kind
    return build(num_envs, num_threads, **{kind.variant_name: model}, **options)


def register_envs() -> None:
    """Register every environment, single and vector, also under an id of its own with continuous actions."""
    for env_id, (module, steps) in _ENVS.items():
        name = env_id.removesuffix("-v0").replace("-v", "V")  # of the class, in front of Env and VectorEnv
        for registered, options in ((env_id, {}), (CONTINUOUS_IDS[env_id], {"action": "continuous"})):
            gymnasium.register(
                id=registered,
                entry_point=f"soro_bench.envs.{module}:{name}Env",
                vector_entry_point=f"soro_bench.envs.{module}:{name}VectorEnv",
                max_episode_steps=steps,
                kwargs=options,
            )
