"""Domain randomisation as Gymnasium wrappers."""

from contextlib import contextmanager

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from soro_bench.randomization import Distribution


class DomainRandomization(gymnasium.Wrapper, RecordConstructorArgs):
    """Draw the physical parameters of every episode from a distribution.

    ``reset(options={"params": {...}})`` still fixes the parameters it names. The draws come from the environment's own
    generator, after the goal's, so a seeded reset gives the same goal with and without randomisation. Only episodes
    that begin through the wrapper are randomised.
    """

    def __init__(self, env: gymnasium.Env, distribution: Distribution):
        RecordConstructorArgs.__init__(self, distribution=distribution)
        super().__init__(env)
        self._distribution = distribution
        with _randomized(env, distribution):
            pass  # a distribution that does not fit is refused here

    def reset(self, *, seed=None, options=None):
        with _randomized(self.env, self._distribution):
            return super().reset(seed=seed, options=options)


class VectorDomainRandomization(VectorWrapper):
    """:class:`DomainRandomization` for vector environments: every simulation draws its own parameters."""

    def __init__(self, env: VectorEnv, distribution: Distribution):
        super().__init__(env)
        self._distribution = distribution
        with _randomized(env, distribution):
            pass

    def reset(self, *, seed=None, options=None):
        with _randomized(self.env, self._distribution):
            return super().reset(seed=seed, options=options)

    def step(self, actions):
        with _randomized(self.env, self._distribution):  # episodes begin here too
            return super().step(actions)


@contextmanager
def _randomized(env, distribution):
    if not hasattr(env.unwrapped, "task"):
        raise ValueError(f"{env.unwrapped} is no environment of soro_bench, made with the default vectorization_mode")
    task = env.unwrapped.task
    before = task.distribution
    task.randomize(distribution)
    try:
        yield
    finally:
        task.randomize(before)
