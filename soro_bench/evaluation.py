"""Deterministic episodes from the fixed evaluation starts of an environment, and what is recorded of one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.task import Task
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.policies.policy import MAX_FRAMES
from soro_bench.registration import make_task, task_type


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


@quiet()
@one_blas_thread
def evaluate(
    act: Callable[[Floats], NDArray[Any]],
    env_id: str,
    model: str,
    action: str,
    starts: Sequence[Mapping[str, Any]] | None = None,
    num_threads: int = 0,
    max_episode_steps: int | None = None,
    seed: int = 0,
    stop_when_solved: bool = True,
    full_state: bool = False,
    inputs: int | None = None,
    **options: Any,
) -> list[Episode]:
    """Run one episode from every start and record it.

    Args:
        act: (n, inputs) observations -> n actions, row by row.
        env_id, model, action: the environment; the model is its ``model`` or ``mesh`` argument.
        starts: reset options, one mapping per episode; by default the environment's fixed evaluation starts.
        num_threads: threads, 0 for all processors; results do not depend on it.
        max_episode_steps: the registered number by default.
        seed: of what the starts leave to chance; episode i takes seed + i.
        stop_when_solved: whether an episode ends when its task is solved.
        full_state: whether the episodes' signals hold the simulations' whole state, as state.qpos and so on.
        inputs: numbers that ``act`` sees; those of one observation by default. A multiple of it is a memory of the last
            ones, the newest last, with zeros for those before the first.
        options: further arguments of the environment.

    Returns:
        An episode for every start, in their order.

    Raises:
        ValueError: there is no such environment or model, a number of steps is below 1, or ``inputs`` is no multiple.
    """
    if max_episode_steps is None:
        max_episode_steps = gymnasium.spec(env_id).max_episode_steps
    if max_episode_steps is None or max_episode_steps < 1:
        raise ValueError(f"max_episode_steps {max_episode_steps}: 1 or more are needed")
    starts = task_type(env_id).evaluation if starts is None else starts
    task = make_task(env_id, len(starts), num_threads, model, action=action, **options)
    # evaluation starts fix all but the noise of observations; others may leave more open
    rngs = [np.random.default_rng(seed + i) for i in range(len(starts))]
    everyone = np.arange(len(starts))
    observation, info = task.reset(everyone, rngs, starts)
    seen = np.zeros((len(starts), frames_of(task, inputs), observation.shape[1]))
    seen[:, -1] = observation
    recorders = [_Recorder(full_state) for _ in starts]
    _record(recorders, everyone, task, info)
    running = everyone
    for _ in range(max_episode_steps):
        actions = task.check_actions(act(seen[running].reshape(len(running), -1)), len(running))
        step = task.step(running, actions)
        seen[running, :-1], seen[running, -1] = seen[running, 1:], step.observation
        _record(recorders, running, task, step.info, actions)
        running = running[~(step.diverged | (step.terminated & stop_when_solved))]
        if len(running) == 0:
            break
    return [recorder.episode(env_id, model, task, i) for i, recorder in enumerate(recorders)]


def frames_of(task: Task, inputs: int | None) -> int:
    """How many observations are so many numbers; one by default. ValueError if they are none, or too many."""
    (size,) = task.single_observation_space.shape or (0,)
    inputs = size if inputs is None else inputs
    if inputs < size or inputs % size:
        raise ValueError(f"{inputs} inputs; observations have {size} numbers, so a multiple of it is needed")
    if inputs > MAX_FRAMES * size:
        raise ValueError(f"{inputs} inputs are {inputs // size} observations; at most {MAX_FRAMES} are remembered")
    return inputs // size


class _Recorder:
    """Rows of one episode."""

    def __init__(self, full_state: bool):
        self.full_state = full_state
        self.signals: dict[str, list[Floats]] = {}
        self.metric: list[float] = []
        self.actions: list[NDArray[Any]] = []
        self.rewards: dict[str, list[float]] = {}
        self.is_success = self.diverged = False

    def episode(self, env_id: str, model: str, task: Task, i: int) -> Episode:
        """What simulation i of the task has done."""
        return Episode(
            env_id=env_id,
            model=model,
            params=task.parameters.to_dict(task.sim.params[i]),
            goal=None if task.goal is None else task.goal[i].copy(),
            time=task.control_timestep * np.arange(len(self.metric), dtype=float),
            signals={name: np.array(rows) for name, rows in self.signals.items()},
            actions=np.array(self.actions),
            rewards={name: np.array(rows) for name, rows in self.rewards.items()},
            metric_name=task.metric,
            metric=np.array(self.metric),
            is_success=bool(self.is_success),
            diverged=bool(self.diverged),
        )


def _record(
    recorders: Sequence[_Recorder], ids: Ints, task: Task, info: Mapping[str, Any], actions: NDArray[Any] | None = None
) -> None:
    """Add the present state of simulations ``ids`` to their episodes, and what led to it."""
    signals = task.signals(ids)
    if recorders[0].full_state:
        signals |= {f"state.{name}": values for name, values in task.state(ids).items()}
    for row, i in enumerate(ids):
        recorder = recorders[i]
        recorder.metric.append(info[task.metric][row])
        for name, values in signals.items():
            recorder.signals.setdefault(name, []).append(values[row])
        if actions is not None:
            recorder.actions.append(np.array(actions[row]))  # the caller may fill its array again
            recorder.is_success, recorder.diverged = info["is_success"][row], info["diverged"][row]
            for name in info:
                if name.startswith("reward_"):
                    recorder.rewards.setdefault(name, []).append(info[name][row])
