"""One recorded episode."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Episode:
    """What one episode did; T steps, so T + 1 states.

    ``signals`` holds what the task's ``signals()`` gives: arrays of T + 1 rows by name, in SI units and the task's
    frame.
    """

    env_id: str
    model: str
    params: dict[str, float]
    goal: np.ndarray | None  # (3,) m
    time: np.ndarray  # (T + 1,) s
    signals: dict[str, np.ndarray]
    actions: np.ndarray  # (T,) or (T, nu)
    rewards: dict[str, np.ndarray]  # reward_<term>: (T,)
    metric_name: str  # distance, displacement or elevation
    metric: np.ndarray  # (T + 1,) m
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
