"""Probes: where on the robot something acts, whatever it is.

A constant force is let act at one place after the other, and the robot replayed: along every tendon, in three
directions on every body, on the joints of every body, and in three directions on all bodies by their mass, as gravity.
The setpoint of every actuator is moved as well, since a servo gives way to no force. Cut into short windows, of which
each may be scaled freely, these responses stand for anything at a place that changes slowly within a window; a free
offset of each measured point stands for a fault there. No law is assumed. That says where to look: at the places at
which they explain most of what parameters and numerical error do not, forces that are free in time are found by replays
(pulses.py), and the one that is more probable than all others says where something acts.

A body is pushed in three directions where a tendon or an actuator pulls in one, so the windows of those are a third as
long: every place has as many free numbers. With the same windows for all, a force at the tip explained more of what the
motor of one cable did to another than that cable.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.localise import windows
from soro_bench.diagnosis.problem import Problem
from soro_bench.diagnosis.pulses import UNKNOWNS, Driven, Grid, Search
from soro_bench.diagnosis.pushes import Source, replayed, sources
from soro_bench.diagnosis.robot import Robot
from soro_bench.effects.effect import Port

WINDOW = 0.15  # s, times the number of directions
FIRST, AGAIN, OF_A_KIND = 9, 6, 3  # places that are looked at once, and again; at least, of every kind
ROUNDS = 2
_SCALES = np.geomspace(0.03, 30.0, 13)  # of a force in a window, standard deviations of the prior in those units


@dataclass(frozen=True)
class Force:
    """What explains most of what a hypothesis leaves if anything may act at a place.

    components: K names, such as "x" (of the world) or "pull". units: of each. start: (n,) s, nodes with straight lines
    between them, of all recordings one after the other; recording: (n,) their numbers. values: (n, K). left: rms
    [signal's unit] of what it does not explain.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    recording: np.ndarray
    values: np.ndarray
    left: float


@dataclass(frozen=True)
class Place:
    """A place, the evidence (natural logarithm) that any force there gains, and that force."""

    where: Port
    gain: float
    force: Force


def places(problem: Problem, robot: Robot, base: Hypothesis, refined: Sequence[Robot] = ()) -> list[Place]:
    """Where forces would explain most of what a hypothesis leaves, the best place first.

    Args:
        robot: that is pushed, with the time steps of its model.
        refined: the same simulated more accurately.
    """
    search, everything = Search(problem, robot, base, refined), sources(problem, robot, base)
    gains = _constant(problem, robot, base, everything)
    driven = search.begin(_leads(everything, gains))
    looked_at: dict[int, Driven] = {}
    for _ in range(ROUNDS):
        driven = search.better(driven)
        looked_at |= {id(one.source): one for one in driven}
        driven = sorted(driven, key=lambda one: -one.gain)[:AGAIN]
    best: dict[Port, Driven] = {}
    for one in sorted(looked_at.values(), key=lambda one: -one.gain):
        best.setdefault(one.where, one)
    return [Place(one.where, one.gain, _force(problem, search, one)) for one in best.values()]


def _leads(everything: Sequence[Source], gains: Sequence[float]) -> list[Source]:
    """What gains most, and of every kind but faults of measured points a few."""
    order, kinds, chosen = np.argsort(-np.asarray(gains), kind="stable"), Counter(), []
    for rank, i in enumerate(order.tolist()):
        kind = everything[i].pushes[0].kind, everything[i].where.kind
        kinds[kind] += 1
        if rank < FIRST or (not everything[i].measured and kinds[kind] <= OF_A_KIND):
            chosen.append(everything[i])
    return chosen


def _force(problem, search, one: Driven) -> Force:
    pushes, grid = one.source.pushes, Grid(problem, len(one.source.pushes))
    return Force(
        tuple(push.component for push in pushes),
        tuple(push.unit for push in pushes),
        grid.time,
        np.repeat(np.arange(len(grid.counts)), grid.counts),
        one.values * [push.amount for push in pushes],
        search.left(one),
    )


def _constant(problem, robot, base, everything: Sequence[Source]) -> list[float]:
    """Evidence that constant forces gain if they may be scaled freely in every window."""
    steps, acting = [len(each.values) for each in problem.recordings], []
    for source in everything:
        if not source.measured:
            acting += [(source, [np.tile(unit, (n, 1)) for n in steps]) for unit in np.eye(len(source.pushes))]
    nothing = (Source(()), [np.zeros((n, 0)) for n in steps])
    free, *rows = replayed(problem, robot, base, [nothing, *acting])
    rows = iter(np.nan_to_num((free - np.array(rows)) / problem.sigma * problem.weight))
    return [
        _gain(problem, base, each.rows(problem) if each.measured else np.array([next(rows) for _ in each.pushes]))
        for each in everything
    ]


def _gain(problem, base, rows) -> float:
    """Of free combinations of rows (K, M) in every window, the best of several sizes."""
    duration = sum(each.time[-1] for each in problem.recordings)
    free = _Windowed(rows, windows(problem, max(WINDOW * len(rows), duration * len(rows) / UNKNOWNS)))
    floor = base.floor(problem)
    hessian = floor.product(base.slope, base.slope) + np.eye(len(base.x))
    explained, inner = free.times(floor.basis), np.eye(len(floor.basis)) + floor.basis @ floor.basis.T

    def product(other):
        """Of the free combinations with rows (C, M), the floor marginalised."""
        return free.times(other) - explained @ np.linalg.solve(inner, floor.basis @ other.T)

    cross = product(base.slope)
    reduced = np.linalg.solve(hessian, cross.T)
    information = free.squares() - explained @ np.linalg.solve(inner, explained.T) - cross @ reduced
    gradient = floor.product(base.slope, base.residual[None])[:, 0] + base.x
    pull = product(base.residual[None])[:, 0] - reduced.T @ gradient
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values, turned = np.maximum(values, 0.0), vectors.T @ pull
    return max(
        0.5 * float((turned**2 / (values + scale**-2)).sum() - np.log1p(scale**2 * values).sum()) for scale in _SCALES
    )


class _Windowed:
    """Rows (K, M), each free in every of W windows: W times K rows, a window after the other, zero outside theirs."""

    def __init__(self, rows: np.ndarray, window: np.ndarray):
        first = np.unique(window, return_index=True)[1]  # windows rise
        self._cuts, self._parts = first[1:], np.split(rows, first[1:], axis=1)

    def times(self, other: np.ndarray) -> np.ndarray:
        """(W K, C) products with rows (C, M)."""
        parts = np.split(other, self._cuts, axis=1)
        return np.concatenate([own @ part.T for own, part in zip(self._parts, parts, strict=True)])

    def squares(self) -> np.ndarray:
        """(W K, W K) products with themselves."""
        return block_diag(*[part @ part.T for part in self._parts])
