"""One simulation of a vector environment, seen as a single environment."""

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

if TYPE_CHECKING:
    from soro_bench.envs.rendering import Picture
    from soro_bench.envs.vector import SoftRobotVectorEnv


class OneOfMany:
    """Simulation ``row`` of a vector environment, for ``get_attr``, ``set_attr`` and ``call``.

    It has what a single environment has, but for ``reset`` and ``step``, which take all simulations at once.

    Args:
        envs: the vector environment.
        row: number of the simulation.
        added: other attributes, which may be set.
    """

    def __init__(self, envs: "SoftRobotVectorEnv", row: int, added: dict[str, Any]):
        self._envs, self._row, self._added = envs, row, added

    @property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Of one simulation."""
        return self._envs.task.single_observation_space

    @property
    def action_space(self) -> gymnasium.spaces.Discrete | gymnasium.spaces.Box:
        """Of one simulation."""
        return self._envs.task.single_action_space

    @property
    def spec(self) -> Any:
        """The vector environment's."""
        return self._envs.spec

    @property
    def metadata(self) -> dict[str, Any]:
        """The vector environment's."""
        return self._envs.metadata

    @property
    def render_mode(self) -> str | None:
        """The vector environment's."""
        return self._envs.render_mode

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of this simulation."""
        return self._envs.np_random[self._row]

    @property
    def np_random_seed(self) -> int:
        """What it was seeded with."""
        return self._envs.np_random_seed[self._row]

    @property
    def unwrapped(self) -> "OneOfMany":
        """Itself."""
        return self

    def render(self) -> "Picture | None":
        """(480, 640, 3) pixels of this simulation; None without a render_mode."""
        return self._envs.picture(self._row)

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether it has an attribute."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """An attribute."""
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any) -> None:
        """Set an attribute; AttributeError for one that every simulation has."""
        if hasattr(type(self), name):
            raise AttributeError(f"{name} cannot be set for one simulation of a vector environment")
        self._added[name] = value

    def __getattr__(self, name: str) -> Any:
        if name in self._added:
            return self._added[name]
        names = [*(own for own in dir(type(self)) if not own.startswith("_")), *self._added]
        raise AttributeError(f"one simulation of a vector environment has no {name!r}; it has {', '.join(names)}")
