"""Open-loop plans: piecewise linear cable displacements, in the environments' own dynamics.

A plan is given by knots, the displacements [m] of the eight cables at some steps; between them the command moves
linearly, as far as the cables' rate and limits let it. Two equal knots are a move that is then held.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.trunk import TrunkTask
from soro_bench.models import trunk_geometry as geo

NUM_CABLES = len(geo.CABLE_NAMES)


def actions_from_knots(knots: ArrayLike, due: Sequence[int]) -> NDArray[np.float32]:
    """Continuous actions that follow the knots from rest.

    Args:
        knots: (n, k, 8) cable displacements [m].
        due: k increasing steps at which they are due.

    Returns:
        (n, due[-1], 8) float32 rates in units of 0.1 m/s, within +-1.
    """
    knots = np.asarray(knots, float)
    n, steps = len(knots), np.arange(1, due[-1] + 1)
    start = np.concatenate([np.zeros((n, 1, NUM_CABLES)), knots], axis=1)
    times = np.array([0, *due])
    k = np.searchsorted(times, steps) - 1  # the knot before each step
    share = ((steps - times[k]) / (times[k + 1] - times[k]))[:, None]
    wanted = np.clip((1 - share) * start[:, k] + share * start[:, k + 1], -geo.CABLE_LIMITS, geo.CABLE_LIMITS)
    reach = geo.CABLE_RATE * TrunkTask.control_timestep  # m per step
    actions, commanded = np.zeros_like(wanted), np.zeros((n, NUM_CABLES))
    for t in range(len(steps)):
        actions[:, t] = np.clip((wanted[:, t] - commanded) / reach, -1, 1)
        commanded += reach * actions[:, t]
    return actions.astype(np.float32)


def antagonistic(bends: ArrayLike, tightening: Floats | float = 0.0) -> Floats:
    """(..., 8) displacements [m] that pull one cable of each opposing pair as far as they release the other.

    Args:
        bends: (..., 4) towards +y and +x by the long cables, then by the short ones [m].
        tightening: what every cable is pulled in addition [m].
    """
    y_long, x_long, y_short, x_short = np.moveaxis(np.asarray(bends), -1, 0)
    pulls = (y_long, -x_long, -y_long, x_long, y_short, -x_short, -y_short, x_short)
    return np.stack(pulls, axis=-1) + tightening


def roll_out(
    task: TrunkTask, actions: NDArray[Any], options: Mapping[str, Any], measure: Callable[[Ints], Floats]
) -> Floats:
    """Play action sequences from reset.

    Args:
        task: its simulations are used in turns if there are more sequences.
        actions: (n, t, ...) valid actions.
        options: reset options of all sequences.
        measure: takes simulation ids (m,) and returns (m, ...).

    Returns:
        (n, t, ...) what ``measure`` gave after every step; NaN once a simulation diverged.
    """
    parts = []
    for first in range(0, len(actions), task.num_envs):
        part = actions[first : first + task.num_envs]
        ids = np.arange(len(part))
        task.reset(ids, [np.random.default_rng(0) for _ in ids], [options] * len(ids))
        lost, rows = np.zeros(len(ids), bool), []
        for t in range(part.shape[1]):
            lost |= task.step(ids, part[:, t]).diverged
            row = np.array(measure(ids), float)
            row[lost] = np.nan
            rows.append(row)
        parts.append(np.stack(rows, axis=1))
    return np.concatenate(parts)
