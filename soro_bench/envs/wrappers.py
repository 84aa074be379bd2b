"""Domain randomisation as Gymnasium wrappers."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, SupportsFloat, cast

import gymnasium
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from soro_bench.envs.gymnasium_vector import VectorEnv, VectorWrapper
from soro_bench.randomization import Distribution, from_dict


class DomainRandomization(gymnasium.Wrapper, RecordConstructorArgs):
    """Draw the physical parameters of every episode from a distribution.

    ``reset(options={"params": {...}})`` still fixes the parameters it names. The draws come from the environment's own
    generator, after the goal's, so a seeded reset gives the same goal with and without randomisation. Only episodes
    that begin through the wrapper are randomised.

    Args:
        env: an environment of the suite, perhaps wrapped.
        distribution: or its ``to_dict()``, as which it stands in ``env.spec``.
    """

    def __init__(self, env: gymnasium.Env, distribution: Distribution | Mapping[str, Any]):
        self._distribution = _fitting(env, distribution)
        RecordConstructorArgs.__init__(self, distribution=self._distribution.to_dict())
        super().__init__(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As Gymnasium's."""
        with _randomized(self.env, self._distribution):
            return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """As Gymnasium's."""
        with _randomized(self.env, self._distribution):  # gymnasium.wrappers.Autoreset begins episodes here
            return super().step(action)


class VectorDomainRandomization(VectorWrapper):
    """:class:`DomainRandomization` for vector environments: every simulation draws its own parameters."""

    def __init__(self, env: VectorEnv, distribution: Distribution | Mapping[str, Any]):
        self._distribution = _fitting(env, distribution)
        super().__init__(env)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As Gymnasium's."""
        with _randomized(self.env, self._distribution):
            # Gymnasium's wrappers pass lists on too
            return super().reset(seed=cast("int | None", seed), options=options)

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """As Gymnasium's."""
        with _randomized(self.env, self._distribution):  # episodes begin here too
            return super().step(actions)


def _fitting(env: gymnasium.Env | VectorEnv, distribution: Distribution | Mapping[str, Any]) -> Distribution:
    """The distribution; ValueError if the environment has not its parameters, or another distribution already."""
    if isinstance(distribution, Mapping):
        distribution = from_dict(distribution)
    with _randomized(env, distribution):
        pass
    while isinstance(env, gymnasium.Wrapper | VectorWrapper):
        if isinstance(env, DomainRandomization | VectorDomainRandomization):
            raise ValueError("the environment is randomised already; give one distribution over all parameters")
        env = env.env
    return distribution


@contextmanager
def _randomized(env: gymnasium.Env | VectorEnv, distribution: Distribution) -> Iterator[None]:
    """Meanwhile the environment's parameters are drawn from the distribution."""
    if not hasattr(env.unwrapped, "task"):
        raise ValueError(f"{env.unwrapped} is no environment of soro_bench, made with the default vectorization_mode")
    task = env.unwrapped.task
    before = task.distribution
    task.randomize(distribution)
    try:
        yield
    finally:
        task.randomize(before)
