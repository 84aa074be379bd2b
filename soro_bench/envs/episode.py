"""One recorded episode."""

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from soro_bench.arrays import Floats


@dataclass(frozen=True)
class Episode:
    """What one episode did; T steps, so T + 1 states.

    ``signals`` holds what the task's ``signals()`` gives: arrays of T + 1 rows by name, in SI units and the task's
    frame.
    """

    env_id: str
    model: str
    params: dict[str, float]
    goal: Floats | None  # (3,) m
    time: Floats  # (T + 1,) s
    signals: dict[str, Floats]
    actions: NDArray[Any]  # (T,) or (T, nu)
    rewards: dict[str, Floats]  # reward_<term>: (T,)
    metric_name: str  # distance, displacement or elevation
    metric: Floats  # (T + 1,) m
    is_success: bool
    diverged: bool

    @property
    def final_metric(self) -> float:
        """The published metric [m]: what ``metric_name`` says, at the end."""
        return float(self.metric[-1])

    @property
    def total_reward(self) -> float:
        """Sum of all reward terms."""
        return float(sum(term.sum() for term in self.rewards.values()))
