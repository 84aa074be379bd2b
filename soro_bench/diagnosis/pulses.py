"""Forces that are free in time: what has to act at a place to explain most of what a hypothesis leaves.

A force at a place is a Gaussian process, given at nodes with straight lines between them. The robot is replayed with a
pulse at every node; pulses that are a memory of the robot apart share a replay. Parameters, numerical error and force
are estimated together. A cable that goes slack, or what is hit, makes these responses wrong where the force is large,
so the robot is replayed under the force, as far as that helps, and the pulses once more about it (Gauss-Newton). The
evidence of a place is that of the last replay, by Laplace's approximation.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag, solve_triangular

from soro_bench.diagnosis.fit import Hypothesis
from soro_bench.diagnosis.problem import DIVERGED, Problem
from soro_bench.diagnosis.pushes import Source, replayed
from soro_bench.diagnosis.robot import Robot
from soro_bench.effects.effect import Port
from soro_bench.inference.clouds import LowRank

SPACING = 0.1  # s, of the nodes; piecewise constant forces of 0.15 s put a base that rocks at 2 Hz into a vertebra
MEMORY = 0.9  # s, after which a trunk is where it would be without a pulse
UNKNOWNS = 1000  # of a place; in long recordings nodes are farther apart
TIMES = (0.2, 0.6, 2.0)  # s, correlation of a force (Matern 3/2)
SCALES = np.geomspace(0.03, 1000.0, 14)  # standard deviations of a force in units of the pushes
LENGTHS = (0.35, 0.7, 1.0)  # of a step, tried
_JITTER = 1e-9


@dataclass(frozen=True)
class Driven:
    """A robot on which something acts.

    values: (n, K) at the nodes. simulated: (M,) under it. gain: evidence (natural logarithm) against nothing acting.
    promise: the same to first order, before the last step.
    """

    source: Source
    values: np.ndarray
    simulated: np.ndarray
    gain: float
    promise: float

    @property
    def where(self) -> Port:
        return self.source.where


class Grid:
    """Nodes in time, of all recordings one after the other.

    Attributes:
        every: control steps between nodes.
        counts: nodes of each recording.
    """

    def __init__(self, problem: Problem, components: int):
        self.timestep = problem.robot.control_timestep
        self.steps = [len(each.values) for each in problem.recordings]
        fewest = components * sum(self.steps) / UNKNOWNS
        self.every = max(1, round(SPACING / self.timestep), math.ceil(fewest))
        self.apart = max(2, math.ceil(MEMORY / (self.every * self.timestep)))  # nodes between pulses of a replay
        self.counts = [(steps - 1) // self.every + 2 for steps in self.steps]
        self.sample = int(np.prod(problem.robot.shape))

    @property
    def time(self) -> np.ndarray:
        """(n,) s of the nodes in their recordings."""
        return np.concatenate([self.timestep * self.every * np.arange(count) for count in self.counts])

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording, of values (n, K) at the nodes."""
        found = []
        for steps, part in zip(self.steps, np.split(values, np.cumsum(self.counts)[:-1]), strict=True):
            at = np.arange(steps) / self.every
            low = at.astype(int)
            found.append(part[low] + (at - low)[:, None] * (part[low + 1] - part[low]))
        return found

    def combs(self) -> np.ndarray:
        """(P, n) 1 at the nodes of each of P replays."""
        comb = np.concatenate([np.arange(count) for count in self.counts]) % self.apart
        return (comb == np.arange(self.apart)[:, None]).astype(float)

    def spans(self) -> list[slice]:
        """The samples in which a pulse at each node shows."""
        found, first = [], 0
        for steps, count in zip(self.steps, self.counts, strict=True):
            begins = np.clip((np.arange(count) - 1) * self.every, 0, steps)
            ends = np.clip((np.arange(count) - 1 + self.apart) * self.every, 0, steps)
            found += [slice(first + b * self.sample, first + e * self.sample)
                      for b, e in zip(begins.tolist(), ends.tolist(), strict=True)]  # fmt: skip
            first += steps * self.sample
        return found

    def root(self, correlation: float, components: int) -> np.ndarray:
        """(n K, n K) Cholesky factor of the prior's correlation."""
        blocks = []
        for count in self.counts:
            lag = np.abs(np.subtract.outer(*[self.timestep * self.every * np.arange(count)] * 2)) / correlation
            blocks.append((1.0 + lag) * np.exp(-lag))
        matrix = np.kron(block_diag(*blocks), np.eye(components))
        return np.linalg.cholesky(matrix + _JITTER * np.eye(len(matrix)))


class Search:
    """The search for forces at some places on a robot, which leaves what a hypothesis does."""

    def __init__(self, problem: Problem, robot: Robot, base: Hypothesis):
        self.problem, self.robot, self.base = problem, robot, base
        # parameters are numerical error too: what their slopes make of a standard normal deviation
        self._basis = np.concatenate([base.floor(problem).basis, base.slope])
        self._root = np.linalg.cholesky(np.eye(len(self._basis)) + self._basis @ self._basis.T)
        self.start = base.residual - base.x @ base.slope
        nothing = [np.zeros((len(each.values), 0)) for each in problem.recordings]
        (self._free,) = replayed(problem, robot, base, [(Source(()), nothing)])

    def begin(self, sources: Sequence[Source]) -> list[Driven]:
        """Nothing acts."""
        counts = [(sum(Grid(self.problem, len(each.pushes)).counts), len(each.pushes)) for each in sources]
        return [
            Driven(each, np.zeros(count), self._free, 0.0, 0.0) for each, count in zip(sources, counts, strict=True)
        ]

    def better(self, driven: Sequence[Driven]) -> list[Driven]:
        """The same one step of Gauss-Newton further."""
        steps = [self._step(one, self._responses(one)) for one in driven]
        tried = [
            (one, one.values + length * (step.values - one.values))
            for one, step in zip(driven, steps, strict=True)
            for length in LENGTHS
        ]
        replays, found = iter(zip(tried, self._simulated(tried), strict=True)), []
        for one, step in zip(driven, steps, strict=True):
            trials = [one]
            for (_, values), simulated in itertools.islice(replays, len(LENGTHS)):
                trials.append(Driven(one.source, values, simulated, self._gain(values, simulated, step), 0.0))
            found.append(replace(max(trials, key=lambda each: each.gain), promise=step.gain))
        return found

    def left(self, one: Driven) -> float:
        """rms [signal's unit] of what neither parameters, numerical error nor the force explain."""
        rest = LowRank(self._basis).without(self._residual(one.simulated))
        return self.problem.sigma * float(np.sqrt((rest**2).sum() / self.problem.weight.sum()))

    def _simulated(self, asked) -> list[np.ndarray]:
        """(M,) each, of (driven, values) pairs: replays, but for faults of sensors."""
        problem, found = self.problem, [np.zeros(0)] * len(asked)
        replays = [i for i, (one, _) in enumerate(asked) if not one.source.measured]
        acting = [(asked[i][0].source, self._grid(asked[i][0]).factors(asked[i][1])) for i in replays]
        for i, row in zip(replays, replayed(problem, self.robot, self.base, acting) if acting else (), strict=True):
            found[i] = row
        for i, (one, values) in enumerate(asked):
            if one.source.measured:
                factors = np.repeat(np.concatenate(self._grid(one).factors(values)), self._grid(one).sample, axis=0)
                found[i] = self._free - problem.sigma * (factors * one.source.rows(problem).T).sum(axis=1)
        return found

    def _grid(self, one: Driven) -> Grid:
        return Grid(self.problem, len(one.source.pushes))

    def _residual(self, simulated: np.ndarray) -> np.ndarray:
        moved = (simulated - self._free) / self.problem.sigma * self.problem.weight
        return np.nan_to_num(self.start - moved, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)

    def _responses(self, one: Driven) -> sp.csr_array:
        """(n K, M) change of the residual by a pulse at every node, in every direction."""
        grid, size = self._grid(one), one.values.shape[1]
        combs = grid.combs()[:, :, None]
        asked = [(one, one.values + comb * direction) for direction in np.eye(size) for comb in combs]
        moved = (one.simulated - np.array(self._simulated(asked))) / self.problem.sigma * self.problem.weight
        return _pulses(np.nan_to_num(moved).reshape(size, grid.apart, -1), grid)

    def _white(self, rows) -> np.ndarray:
        """(C, F) of rows (C, M): their products with each other less those of this are products with the inverse of the
        covariance of parameters, numerical error and noise."""
        return solve_triangular(self._root, np.asarray(rows @ self._basis.T).T, lower=True).T

    def _cost(self, residual: np.ndarray) -> float:
        return 0.5 * float(residual @ residual - (self._white(residual[None]) ** 2).sum())

    def _step(self, one: Driven, rows) -> "_Step":
        """Where the evidence is largest, to first order."""
        z, grid = one.values.ravel(), self._grid(one)
        origin = self._residual(one.simulated) - rows.T @ z  # what the linear model says of no force
        white = self._white(rows)
        information = (rows @ rows.T).toarray() - white @ white.T
        pull = rows @ origin - white @ self._white(origin[None])[0]
        before, best = self._cost(self.start) - self._cost(origin), None
        for correlation in TIMES:
            root = grid.root(correlation, one.values.shape[1])
            size, turn = np.linalg.eigh(root.T @ information @ root)
            size, turned = np.maximum(size, 0.0), turn.T @ (root.T @ pull)
            for scale in SCALES:
                occam = 0.5 * float(np.log1p(scale**2 * size).sum())
                gain = before + 0.5 * float((turned**2 / (size + scale**-2)).sum()) - occam
                if best is None or gain > best.gain:
                    values = -root @ turn @ (turned / (size + scale**-2))
                    best = _Step(values.reshape(one.values.shape), gain, scale * root, occam)
        return best

    def _gain(self, values, simulated, step: "_Step") -> float:
        prior = solve_triangular(step.root, values.ravel(), lower=True)
        return self._cost(self.start) - self._cost(self._residual(simulated)) - 0.5 * float(prior @ prior) - step.occam


@dataclass(frozen=True)
class _Step:
    """Values (n, K) that promise most evidence, ``gain``; the Cholesky factor (n K, n K) of their prior's covariance;
    and what the evidence loses by what else they might have been (Occam's factor)."""

    values: np.ndarray
    gain: float
    root: np.ndarray
    occam: float


def _pulses(rows: np.ndarray, grid: Grid) -> sp.csr_array:
    """Of rows (K, P, M) of the replays, each node's own part: (n K, M)."""
    size, apart, samples = rows.shape
    comb = np.concatenate([np.arange(count) for count in grid.counts]) % apart
    values, columns, ends = [], [], [0]
    for node, span in enumerate(grid.spans()):
        for k in range(size):
            values.append(rows[k, comb[node], span])
            columns.append(np.arange(span.start, span.stop))
            ends.append(ends[-1] + len(columns[-1]))
    return sp.csr_array((np.concatenate(values), np.concatenate(columns), ends), shape=(len(ends) - 1, samples))
