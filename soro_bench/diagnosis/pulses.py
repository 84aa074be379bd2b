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
from soro_bench.diagnosis.pushes import Source, replayed, told
from soro_bench.diagnosis.robot import Robot
from soro_bench.effects.effect import Port
from soro_bench.inference.clouds import LowRank

SPACING = 0.1  # s, of the nodes; piecewise constant forces of 0.15 s put a base that rocks at 2 Hz into a vertebra
MEMORY = 0.9  # s, after which a trunk is where it would be without a pulse
UNKNOWNS = 1000  # of a place; in long recordings nodes are farther apart
TIMES = (0.2, 0.6, 2.0)  # s, correlation of a force (Matern 3/2)
SHAPES = 8  # principal components of how the robot is shaped
SCALES = np.geomspace(0.03, 1000.0, 14)  # standard deviations of a force in units of the pushes
LENGTHS, SMALLER = (0.4, 1.0), (1.0, 16.0)  # of a step, tried, and how many times smaller forces than promise most
REACH, PULSE = 4.0, 0.5  # standard deviations of the noise, rms, by which pushes move a robot; of a push, of differences
STEP = 0.05  # standard deviations of the priors of parameters, of differences
_JITTER = 1e-9


class Covariance:
    """Of parameters, numerical error and noise in units of the noise: I + Bᵀ B, of a basis B (F, M)."""

    def __init__(self, basis: np.ndarray):
        self.basis = basis
        self._root = np.linalg.cholesky(np.eye(len(basis)) + basis @ basis.T)

    def white(self, rows) -> np.ndarray:
        """(C, F) of rows (C, M): products of rows less products of these are products with the inverse."""
        return solve_triangular(self._root, np.asarray(rows @ self.basis.T).T, lower=True).T

    def cost(self, residual: np.ndarray) -> float:
        """Minus the logarithm of the probability of a residual (M,), but for a constant."""
        squares = residual @ residual - (self.white(residual[None]) ** 2).sum()
        return 0.5 * float(squares) + float(np.log(np.diag(self._root)).sum())


@dataclass(frozen=True)
class Driven:
    """A robot on which something acts.

    x: (d,) parameters. values: (n, K) at the nodes. simulated: (M,) under both. slope: (d, M) of the residual by the
    parameters, where they were last replayed. error: (F, M) numerical error under what acts. root: Cholesky factor
    (n K, n K) of the prior's covariance. occam: what the evidence loses by what else the values might have been. gain:
    evidence (natural logarithm) against nothing acting.
    """

    source: Source
    form: "Grid | Linear"
    x: np.ndarray
    values: np.ndarray
    simulated: np.ndarray
    slope: np.ndarray
    error: np.ndarray
    root: np.ndarray | None = None
    occam: float = 0.0
    gain: float = 0.0

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

    def values(self, factors: Sequence[np.ndarray]) -> np.ndarray:
        """(n, K) at the nodes, of factors (T, K) in every control step of each recording."""
        nodes = [np.minimum(self.every * np.arange(count), steps - 1) for count, steps in zip(self.counts, self.steps, strict=True)]
        return np.concatenate([part[at] for part, at in zip(factors, nodes, strict=True)])

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

    def kernels(self) -> list[np.ndarray]:
        """(n, n) covariances of the values in one direction."""
        return [self._in_time(correlation) + _JITTER * np.eye(sum(self.counts)) for correlation in TIMES]

    def parts(self, rows: np.ndarray) -> sp.csr_array:
        """(n K, M) response of each value, of replays (K P, M) of the combs."""
        return _pulses(rows.reshape(-1, self.apart, rows.shape[1]), self)

    def _in_time(self, correlation: float) -> np.ndarray:
        """(n, n) Matern 3/2 of each recording, whose correlation falls within so many seconds."""
        blocks = []
        for count in self.counts:
            lag = np.abs(np.subtract.outer(*[self.timestep * self.every * np.arange(count)] * 2)) / correlation
            blocks.append((1.0 + lag) * np.exp(-lag))
        return block_diag(*blocks)


class Linear:
    """What is linear in what the actuators are told and in how the robot is shaped.

    Args:
        told: setpoints of the actuators (T, nu) in the middle of every control step of each recording.
    """

    def __init__(self, problem: Problem, told: Sequence[np.ndarray]):
        steps = []
        for each, row in zip(problem.recordings, told, strict=True):
            values = each.values.reshape(len(each.values), -1)
            steps.append((row, np.where(np.isnan(values), np.nanmean(values, axis=0), values)))
        told, moved = (np.concatenate(part) for part in zip(*steps, strict=True))
        told, moved = told - told.mean(axis=0), moved - moved.mean(axis=0)
        moved = moved @ np.linalg.svd(moved, full_matrices=False)[2][:SHAPES].T
        found = np.concatenate([np.ones((len(told), 1)), told, moved], axis=1)
        found = found / np.maximum(np.sqrt((found**2).mean(axis=0)), 1e-12)
        self.features = found
        self._parts = np.split(found, np.cumsum([len(row) for row, _ in steps])[:-1])
        self.counts = [found.shape[1]]

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording, of weights (F, K)."""
        return [part @ values for part in self._parts]

    def combs(self) -> np.ndarray:
        """(F, F): each weight has a replay of its own."""
        return np.eye(self.counts[0])

    def kernels(self) -> list[np.ndarray]:
        """(F, F): weights are independent."""
        return [np.eye(self.counts[0])]

    def parts(self, rows: np.ndarray) -> np.ndarray:
        """(F K, M) response of each weight, of replays (K F, M)."""
        return rows.reshape(-1, self.counts[0], rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)


class Search:
    """The search for forces at some places on a robot, which leaves what a hypothesis does.

    Args:
        refined: the robot simulated more accurately. What that changes depends on what acts: of a `flex` trunk one
            motor of which moves another's cable, numerical error without that leaves thirteen times as much as with it.
    """

    def __init__(self, problem: Problem, robot: Robot, base: Hypothesis, refined: Sequence[Robot]):
        self.problem, self.robot, self.base, self.refined = problem, robot, base, refined
        self.d = problem.parameters
        nothing = [np.zeros((len(each.values), 0)) for each in problem.recordings]
        self.linear = Linear(problem, told(problem, robot, base))
        (self._free,) = replayed(problem, robot, base, [(base.x, Source(()), nothing)])
        slope = base.slope[: self.d]
        self._nothing = Covariance(np.concatenate([problem.floor.basis, slope])).cost(base.residual - base.x[: self.d] @ slope)

    def begin(self, sources: Sequence[Source], linear: bool) -> list[Driven]:
        """Nothing acts."""
        base, found = self.base, []
        for each in sources:
            form = self.linear if linear else Grid(self.problem, len(each.pushes))
            values = np.zeros((sum(form.counts), len(each.pushes)))
            none = np.zeros((0, self._free.size))
            found.append(Driven(each, form, base.x[: self.d], values, self._free, base.slope[: self.d], none))
        return found

    def sized(self, sources: Sequence[Source]) -> tuple[list[Source], list[np.ndarray]]:
        """The same, of such sizes that each moves the robot by ``REACH`` if it acts all the time, and the changes (K, M)
        of the residual when they do."""
        problem, found, rows = self.problem, [], []
        pushed = [each for each in sources if not each.measured]
        steps = [len(each.values) for each in problem.recordings]
        for _ in range(2):  # what was far too large was no measure of it
            acting = [(self.base.x, each, [np.tile(unit, (n, 1)) for n in steps]) for each in pushed for unit in np.eye(len(each.pushes))]
            changes = iter(np.nan_to_num(-self._moved(replayed(problem, self.robot, self.base, acting))))
            rows = [np.array([next(changes) for _ in each.pushes]) for each in pushed]
            size = [np.sqrt((row**2).sum(axis=1).max() / problem.weight.sum()) for row in rows]
            factors = [REACH / s if s > 0 else 1.0 for s in size]
            pushed = [each.times(factor) for each, factor in zip(pushed, factors, strict=True)]
            rows = [row * factor for row, factor in zip(rows, factors, strict=True)]
        again, moved = iter(pushed), iter(rows)
        return [each if each.measured else next(again) for each in sources], [each.rows(problem) if each.measured else next(moved) for each in sources]

    def better(self, driven: Sequence[Driven]) -> list[Driven]:
        """The same one step of Gauss-Newton further."""
        tried = [trial for one in driven for trial in self._trials(one)]
        simulated = self._simulated(self.robot, tried)
        trials, found = iter([replace(one, simulated=row) for one, row in zip(tried, simulated, strict=True)]), []
        for one in driven:
            some = [self._weighed(each) for each in itertools.islice(trials, len(LENGTHS) * len(SMALLER))]
            found.append(max([*([one] if one.root is not None else []), *some], key=lambda each: each.gain))
        return self._with_own_error(found)

    def left(self, one: Driven) -> float:
        """rms [signal's unit] of what neither parameters, numerical error nor the force explain."""
        rest = LowRank(self._basis(one)).without(self._residual(one))
        return self.problem.sigma * float(np.sqrt((rest**2).sum() / self.problem.weight.sum()))

    def _basis(self, one: Driven) -> np.ndarray:
        """Of the covariance: parameters are numerical error too, what their slopes make of a standard deviation."""
        return np.concatenate([self.problem.floor.basis, one.error, one.slope])

    def _with_own_error(self, driven: Sequence[Driven]) -> list[Driven]:
        """The same with the numerical error under what acts."""
        asked = [one for one in driven if not one.source.measured]
        errors = {id(one): [] for one in asked}
        for finer in self.refined if asked else ():
            simulated = self._simulated(finer, asked)
            for one, row in zip(asked, simulated, strict=True):
                if np.isfinite(row).all():
                    errors[id(one)].append(self.problem.residuals_of(row[None])[0] - self._beside(one.simulated))
        return [self._weighed(replace(one, error=np.array(errors[id(one)]))) if errors.get(id(one)) else one for one in driven]

    def _simulated(self, robot: Robot, asked: Sequence[Driven]) -> np.ndarray:
        """(N, M) replays, but for faults of sensors."""
        problem, found = self.problem, np.zeros((len(asked), self._free.size))
        replays = [i for i, one in enumerate(asked) if not one.source.measured]
        acting = [(asked[i].x, asked[i].source, asked[i].form.factors(asked[i].values)) for i in replays]
        if acting:
            found[replays] = replayed(problem, robot, self.base, acting)
        for i, one in enumerate(asked):
            if one.source.measured:
                factors = np.repeat(np.concatenate(one.form.factors(one.values)), int(np.prod(problem.robot.shape)), axis=0)
                found[i] = self._free - problem.sigma * (factors * one.source.rows(problem).T).sum(axis=1)
        return found

    def _moved(self, simulated: np.ndarray) -> np.ndarray:
        return (simulated - self._free) / self.problem.sigma * self.problem.weight

    def _beside(self, simulated: np.ndarray) -> np.ndarray:
        """(M,) the residual with the parameters of the hypothesis."""
        return _finite(self.base.residual - self._moved(simulated))

    def _residual(self, one: Driven) -> np.ndarray:
        """(M,) the residual with the parameters in the middle of their priors, to first order."""
        return _finite(self._beside(one.simulated) - one.x @ one.slope)

    def _responses(self, one: Driven) -> tuple[np.ndarray, sp.csr_array]:
        """(d, M) and (n K, M) change of the residual by the parameters, and by a pulse at every node in every
        direction."""
        size, combs = one.values.shape[1], one.form.combs()[:, :, None]
        pulsed = [replace(one, values=one.values + PULSE * comb * direction) for direction in np.eye(size) for comb in combs]
        shifted = [replace(one, x=one.x + shift) for shift in STEP * np.eye(self.d)]
        if one.root is None or one.source.measured:  # the slopes are known, or those of nothing acting
            shifted = []
        moved = np.nan_to_num(self._moved(one.simulated) - self._moved(self._simulated(self.robot, [*shifted, *pulsed])))
        slope, rows = moved[: len(shifted)] / STEP, moved[len(shifted) :] / PULSE
        return (slope if len(slope) else one.slope), one.form.parts(rows)

    def _trials(self, one: Driven) -> list[Driven]:
        """Towards where the evidence is largest, to first order, and where forces have to be smaller."""
        z = one.values.ravel()
        slope, rows = self._responses(one)
        here = replace(one, slope=slope)
        covariance = Covariance(self._basis(here))
        origin = self._residual(here) - rows.T @ z  # what the linear model says of no force
        white = covariance.white(rows)
        information = rows @ rows.T
        information = (information.toarray() if sp.issparse(information) else information) - white @ white.T
        pull = rows @ origin - white @ covariance.white(origin[None])[0]
        aims = []
        for kernel in one.form.kernels():
            root = np.kron(np.linalg.cholesky(kernel), np.eye(one.values.shape[1]))
            size, turn = np.linalg.eigh(root.T @ information @ root)
            size, turned = np.maximum(size, 0.0), turn.T @ (root.T @ pull)
            for scale in SCALES:
                occam = 0.5 * float(np.log1p(scale**2 * size).sum())
                gain = 0.5 * float((turned**2 / (size + scale**-2)).sum()) - occam
                aims.append((gain, scale, occam, root, -root @ (turn @ (turned / (size + scale**-2)))))
        most = max(aims, key=lambda aim: aim[0])[1]
        found = []
        for smaller in SMALLER:
            _, scale, occam, root, values = max((a for a in aims if a[1] <= 1.01 * most / smaller), key=lambda a: a[0], default=aims[0])
            x = self._parameters(here, origin + rows.T @ values)
            for length in LENGTHS:
                moved = one.values + length * (values.reshape(one.values.shape) - one.values)
                found.append(replace(here, x=one.x + length * (x - one.x), values=moved, root=scale * root, occam=occam))
        return found

    def _parameters(self, one: Driven, residual: np.ndarray) -> np.ndarray:
        """(d,) the most probable ones, of the residual (M,) that is left in the middle of their priors."""
        floor = LowRank(np.concatenate([self.problem.floor.basis, one.error]))
        if one.source.measured:
            return one.x
        information = floor.product(one.slope, one.slope) + np.eye(self.d)
        return -np.linalg.solve(information, floor.product(one.slope, residual[None])[:, 0])

    def _weighed(self, one: Driven) -> Driven:
        """With the evidence of its replay."""
        prior = solve_triangular(one.root, one.values.ravel(), lower=True)
        cost = Covariance(self._basis(one)).cost(self._residual(one)) + 0.5 * float(prior @ prior) + one.occam
        return replace(one, gain=self._nothing - cost)


def _finite(residual: np.ndarray) -> np.ndarray:
    return np.nan_to_num(residual, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)


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
