"""Domain randomisation as Gymnasium wrappers."""

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from soro_bench.randomization import Distribution


class DomainRandomization(gymnasium.Wrapper, RecordConstructorArgs):
    """Draw the physical parameters of every episode from a distribution.

    ``reset(options={"params": {...}})`` still fixes the parameters it names. The draws come from the environment's own
    generator, after the goal's, so a seeded reset gives the same goal with and without randomisation.
    """

    def __init__(self, env: gymnasium.Env, distribution: Distribution):
        RecordConstructorArgs.__init__(self, distribution=distribution)
        super().__init__(env)
        _task(env).randomize(distribution)


class VectorDomainRandomization(VectorWrapper):
    """:class:`DomainRandomization` for vector environments: every simulation draws its own parameters."""

    def __init__(self, env: VectorEnv, distribution: Distribution):
        super().__init__(env)
        _task(env).randomize(distribution)


def _task(env):
    if not hasattr(env.unwrapped, "task"):
        raise ValueError(f"{env.unwrapped} is no environment of soro_bench, made with the default vectorization_mode")
    return env.unwrapped.task
