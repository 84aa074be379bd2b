"""Domain randomisation as Gymnasium wrappers."""

import gymnasium
from gymnasium.vector import VectorEnv, VectorWrapper

from soro_bench.randomization import Distribution


class DomainRandomization(gymnasium.Wrapper):
    """Draw the physical parameters of every episode from a distribution.

    ``reset(options={"params": {...}})`` still fixes the parameters it names. The draws come from the environment's own
    generator, after the goal's, so a seeded reset gives the same goal with and without randomisation.
    """

    def __init__(self, env: gymnasium.Env, distribution: Distribution):
        super().__init__(env)
        env.unwrapped.task.randomize(distribution)


class VectorDomainRandomization(VectorWrapper):
    """:class:`DomainRandomization` for vector environments: every simulation draws its own parameters."""

    def __init__(self, env: VectorEnv, distribution: Distribution):
        super().__init__(env)
        env.unwrapped.task.randomize(distribution)
