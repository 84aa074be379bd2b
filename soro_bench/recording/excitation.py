"""A sequence of actions that shows what a robot does: the input of an identification experiment.

The parts, one after the other: rest; each channel alone in triangles at three speeds; each channel in nested loops, the
first half of them alone and the others with all pulled a little; pairs of channels pulled, held and released, the
first pair for seconds; all channels at once in sums of odd harmonics; rest. An action is a rate, and each part ends
where it began.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from gymnasium import spaces

from soro_bench.files import replacing

_DURATION = 30.0  # s
SLOWNESS = (1, 2, 3)  # of the triangles: full rate, half of it, a third of it
FREQUENCIES = (0.2, 6.0)  # Hz, of the harmonics
_SHARE_OF_TRIANGLES = 0.35
_LOOPS = (3, -1, 1, -2, 2, -3)  # strokes of full rate
_REST, _STEP, _HOLD = 16, 3, 4  # time steps
_LONG_HOLD, _LONG_REST = 40, 20  # time steps
_MULTISINE = 16  # time steps at least
_HIGHEST = 0.4  # of a sampled frequency, in cycles per time step


def shortest(channels: int) -> int:
    """Number of time steps below which a sequence does not fit."""
    return _fixed(channels) + _triangles_length(1, channels) + _MULTISINE


def excitation(
    space: spaces.Discrete | spaces.Box, timestep: float, duration: float | None = None, seed: int = 0
) -> np.ndarray:
    """(T, nu) actions in [-1, 1], as many as fit into the duration.

    Args:
        space: the action space, ``Box(-1, 1, (nu,))``.
        timestep: s between actions.
        duration: s; by default 30, or what it takes.
        seed: of the phases of the harmonics.

    Raises:
        ValueError: the actions are discrete, or the sequence does not fit into the duration.
    """
    if not isinstance(space, spaces.Box):
        raise ValueError("an excitation needs continuous actions")
    if duration is not None and not 0.0 < duration < math.inf:
        raise ValueError(f"a duration of {duration} s; a positive number is needed")
    channels, least = space.shape[0], shortest(space.shape[0])
    steps = max(round(_DURATION / timestep), least) if duration is None else int(duration / timestep + 1e-9)
    if steps < least:
        raise ValueError(f"{steps} steps are too few for an excitation; it needs {least}, {least * timestep:g} s")
    room = min(_SHARE_OF_TRIANGLES * steps, steps - _fixed(channels) - _MULTISINE)
    stroke = max(1, int(room / _triangles_length(1, channels)))
    parts = [
        np.zeros((_REST, channels)),
        in_turn(triangles(stroke), np.eye(channels)),
        _loops_of_all(channels),
        in_turn(step_and_hold(_LONG_HOLD, _LONG_REST), _pairs(channels)[:1]),
        in_turn(step_and_hold(_HOLD), _pairs(channels)),
    ]
    remaining = steps - sum(map(len, parts)) - _REST
    parts += [multisine(remaining, channels, timestep, seed), np.zeros((_REST, channels))]
    return np.concatenate(parts)


def write_actions(path: str | Path, timestep: float, actions: np.ndarray, channels: Sequence[str] = ()) -> None:
    """A table for a robot's controller: a row per control step with its time [s] and the action of every channel.

    Args:
        channels: names of the columns; action.0, action.1 and so on by default.
    """
    with replacing(path) as temporary, open(temporary, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", *(channels or (f"action.{i}" for i in range(actions.shape[1])))])
        table.writerows([f"{step * timestep:.12g}", *(f"{a:.9g}" for a in row)] for step, row in enumerate(actions))


def triangles(stroke: int, slowness: Sequence[int] = SLOWNESS) -> np.ndarray:
    """(n,) rates of one channel: out and back by the same way, ``stroke`` time steps of full rate, at every speed."""
    return np.concatenate([np.repeat([1 / slow, -1 / slow], stroke * slow) for slow in slowness])


def loops() -> np.ndarray:
    """(n,) rates of one channel: loops within loops."""
    return np.concatenate([np.full(abs(stroke), np.sign(stroke)) for stroke in _LOOPS])


def step_and_hold(hold: int, rest: int | None = None) -> np.ndarray:
    """(n,) rates of one channel: a step, a hold, a release and a rest; ``hold`` and ``rest`` are time steps."""
    return np.concatenate([np.ones(_STEP), np.zeros(hold), -np.ones(_STEP), np.zeros(hold if rest is None else rest)])


def in_turn(rates: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """(K * n, nu) the same rates (n,) for one group of channels after the other; groups (K, nu) are ones and zeros."""
    return np.kron(groups, rates[:, None])


def multisine(steps: int, channels: int, timestep: float, seed: int) -> np.ndarray:
    """(steps, channels) rates in two time steps or more: odd harmonics of equal displacement and random phases.

    They are whole periods, so that it ends where it began.
    """
    periods = max(1, min(round(FREQUENCIES[0] * steps * timestep), int(_HIGHEST * steps)))
    base = periods / steps  # cycles per time step
    highest = min(FREQUENCIES[1] * timestep, _HIGHEST)
    harmonics = np.arange(1, max(2, int(highest / base) + 1), 2)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, (len(harmonics), channels))
    angle = 2 * np.pi * base * np.arange(steps)[:, None, None] * harmonics[:, None]
    rates = (harmonics[:, None] * np.cos(angle + phases)).sum(axis=1)
    return rates / np.maximum(np.abs(rates).max(axis=0), 1e-9)


def _loops_of_all(channels: int) -> np.ndarray:
    """(n, channels) loops of one channel after the other, of the second half with all of them pulled a little."""
    alone, pulled = np.array_split(np.eye(channels), 2)
    little = np.ones((1, channels))
    return np.concatenate([in_turn(loops(), alone), little, in_turn(loops(), pulled), -little])


def _pairs(channels: int) -> np.ndarray:
    """(K, channels) neighbouring channels together."""
    return np.minimum((np.eye(channels) + np.roll(np.eye(channels), 1, axis=1))[::2], 1)


def _triangles_length(stroke: int, channels: int) -> int:
    return channels * len(triangles(stroke))


def _fixed(channels: int) -> int:
    holds = len(_pairs(channels)) * len(step_and_hold(_HOLD)) + len(step_and_hold(_LONG_HOLD, _LONG_REST))
    return 2 * _REST + len(_loops_of_all(channels)) + holds
