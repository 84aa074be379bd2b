"""What is compared: fixed evaluations that every policy of a board goes through.

A board is a task with its published starts; its conditions are the models that it is evaluated on, the cheap and the
accurate one. What a policy was trained on is up to its authors.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soro_bench.evaluation import Episode, evaluate
from soro_bench.policies.policy import TrainedPolicy
from soro_bench.registration import task_type

# the largest length [m] and return that an entry may have; what has diverged may be farther off
_FAR, _MOST = 1000.0, 1e6
NOISY_ROLLOUTS = 5  # of the walker, with observation noise; as in the paper's figure 6


@dataclass(frozen=True)
class Condition:
    """One evaluation of a policy: the robot's model, reset options of every episode, arguments of the environment."""

    model: str
    starts: tuple[Mapping[str, Any], ...]
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Board:
    """A task with fixed evaluations.

    Args:
        env_id: environment, whose metric [m] is compared at the end of an episode.
        higher: whether more of it is better.
        conditions: evaluations by label.
        episode_steps: length of an episode; the registered one if None.
        fixed: parameters that the task gives, in training too.
        beside: signals (n,) [m] that are entered beside the metric, at the end of an episode too.
    """

    env_id: str
    higher: bool
    conditions: Mapping[str, Condition]
    episode_steps: int | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    beside: tuple[str, ...] = ()

    @property
    def metric(self) -> str:
        """What is compared."""
        return task_type(self.env_id).metric

    def labelled(self, label: str) -> str:
        """The label, if there is such a condition."""
        if label not in self.conditions:
            raise ValueError(f"there is no condition {label!r}; there are {', '.join(self.conditions)}")
        return label

    def play(self, policy: TrainedPolicy, label: str, num_threads: int = 0) -> list[Episode]:
        """The episodes of a policy under the condition with that label."""
        condition = self.conditions[label]
        return evaluate(
            policy.act, self.env_id, condition.model, policy.card.action, condition.starts, num_threads,
            self.episode_steps, inputs=policy.inputs, **condition.options,
        )  # fmt: skip

    def score(self, episodes: list[Episode]) -> dict:
        """What a condition's episodes amount to: a list of values per episode, lengths in mm.

        Where the simulation diverged, the last state is an accident: such an episode counts no better than zero or, of
        a distance, than the one at its start.
        """
        return {
            "final_mm": [round(1e3 * self._final(e.metric, e.diverged), 4) for e in episodes],
            **{
                f"{name}_mm": [round(1e3 * self._final(e.signals[name], e.diverged), 4) for e in episodes]
                for name in self.beside
            },
            "return": [round(min(max(e.total_reward, -_MOST), _MOST), 4) for e in episodes],
            "success": [e.is_success and not e.diverged for e in episodes],
            "diverged": sum(e.diverged for e in episodes),
        }

    def _final(self, lengths: np.ndarray, diverged: bool) -> float:
        first, last = float(lengths[0]), float(lengths[-1])
        if not diverged:
            return last
        return max(min(0.0, last), -_FAR) if self.higher else min(max(first, last), _FAR)


def _trunk(env_id: str) -> Board:
    return Board(env_id, False, _on_both_models(env_id, task_type(env_id).evaluation))


def _lift(mass: float) -> Board:
    fixed = {"cube_mass": mass}
    conditions = _on_both_models("TrunkLift-v0", ({"params": fixed},))
    # an object that is tipped has its centre higher, too
    return Board("TrunkLift-v0", True, conditions, fixed=fixed, beside=("clearance",))


def _on_both_models(env_id: str, starts: Iterable[Mapping[str, Any]]) -> dict[str, Condition]:
    task = task_type(env_id)
    return {model: Condition(model, tuple(starts)) for model in (task.cheap, task.accurate)}


def _walker(steps: int) -> Board:
    conditions = {}
    for mesh in ("coarse", "fine"):
        conditions[mesh] = Condition(mesh, ({},))
        conditions[f"{mesh}_noise"] = Condition(mesh, ({},) * NOISY_ROLLOUTS, {"observation_noise": True})
    return Board("MultiGait-v0", True, conditions, episode_steps=steps)


BOARDS = {
    "TrunkReach-v0": _trunk("TrunkReach-v0"),
    "TrunkPush-v0": _trunk("TrunkPush-v0"),
    "TrunkLift-v0-50g": _lift(0.05),
    "TrunkLift-v0-100g": _lift(0.1),
    "MultiGait-v0-6": _walker(6),
    "MultiGait-v0-12": _walker(12),
}


def board_of(env_id: str, name: str | None = None) -> tuple[str, Board]:
    """The board with that name, or the first of an environment; ValueError if it is not the environment's."""
    names = [each for each, board in BOARDS.items() if board.env_id == env_id]
    if not names:
        raise ValueError(f"{env_id} has no board; there are {', '.join(BOARDS)}")
    if name is not None and name not in names:
        raise ValueError(f"{env_id} has no board {name!r}; it has {', '.join(names)}")
    return name or names[0], BOARDS[name or names[0]]
