"""Forces that have no law: what has to act at a place to explain most of what a hypothesis leaves.

A force is free in time or linear in what the robot is told and in how it is shaped (forms.py). Its values, the
parameters and the numerical error are estimated together, in rounds of Gauss-Newton: the robot is replayed with a
little more of each value and parameter, then under several forces on the way to the most probable one, and from the
best of these again, with the same responses. A cable that goes slack, or what is hit, makes responses wrong where
forces are large. Numerical error is that under the force, by replays of the refined robots; of a `flex` trunk one motor
of which also moves another's cable, that of the robot without it leaves 41,000 nats of the truth unexplained. The
evidence is that of the last replay, by Laplace's approximation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from soro_bench.diagnosis.estimation.fit import Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import DIVERGED, Problem
from soro_bench.diagnosis.localisation.input_models import Free, Linear
from soro_bench.diagnosis.localisation.test_inputs import Acting, Source, replayed, setpoints
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank

SCALES = np.geomspace(0.03, 1000.0, 14)  # standard deviations of a force in units of the pushes
LENGTHS, SMALLER = (0.1, 0.4, 1.0), (1.0, 16.0)  # of a step, tried, and how many times smaller forces than promise most
REACH = 4.0  # standard deviations of the noise, rms, by which a push moves a robot
PULSE = 0.5  # of a push, of differences
STEPS = 4  # of a round, at most
TOGETHER = 8  # are replayed side by side
SETTLED = 1.0  # natural logarithm of the evidence, what is no longer worth one more
STEP = 0.05  # standard deviations of the priors of parameters, of differences


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
    parameters, where they were last replayed. error: (F, M) numerical error under what acts, and what has acted in
    earlier steps. root: Cholesky factor (n K, n K) of the prior's covariance. occam: what the evidence loses by what
    else the values might have been. gain: evidence (natural logarithm) against nothing acting.
    """

    source: Source
    input_model: Free | Linear
    x: np.ndarray
    values: np.ndarray
    simulated: np.ndarray
    jacobian: np.ndarray
    error: np.ndarray
    root: np.ndarray | None = None
    occam: float = 0.0
    gain: float = 0.0

    @property
    def location(self) -> Location:
        return self.source.location

    @property
    def acting(self) -> Acting:
        return self.x, self.source, self.input_model.factors(self.values)


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
        self.linear = Linear(problem, setpoints(problem, robot, base), robot.actuator_names)
        (self._free,) = replayed(problem, robot, base, [(base.x, Source(()), nothing)])
        self._x, self._jacobian = base.x[: self.d], base.jacobian[: self.d]
        covariance = Covariance(np.concatenate([problem.discretisation.basis, self._jacobian]))
        self._nothing = covariance.cost(base.residual - self._x @ self._jacobian)

    def begin(self, sources: Sequence[Source], linear: bool) -> list[Driven]:
        """Nothing acts yet."""
        found, none = [], np.zeros((0, self._free.size))
        for each in sources:
            input_model = self.linear if linear else Free(self.problem, len(each.unit_inputs))
            values = np.zeros((input_model.size, len(each.unit_inputs)))
            found.append(Driven(each, input_model, self._x, values, self._free, self._jacobian, none))
        return found

    def sized(self, sources: Sequence[Source]) -> tuple[list[Source], list[np.ndarray]]:
        """The same, of such sizes that each moves the robot by ``REACH`` if it acts all the time; and what each then
        changes of the residual, (K, M)."""
        for _ in range(2):  # what was far too large was no measure of it
            rows = self._constant(sources)
            rms = [np.sqrt((row**2).sum(axis=1).max() / self.problem.weight.sum()) for row in rows]
            factors = [REACH / size if size > 0 and not each.measured else 1.0
                       for each, size in zip(sources, rms, strict=True)]  # fmt: skip
            sources = [each.times(factor) for each, factor in zip(sources, factors, strict=True)]
        return sources, [row * factor for row, factor in zip(rows, factors, strict=True)]

    def _constant(self, sources: Sequence[Source]) -> list[np.ndarray]:
        """(K, M) each, change of the residual by constant pushes."""
        steps, acting = [len(each.values) for each in self.problem.recordings], []
        for each in sources:
            if not each.measured:
                acting += [
                    (self._x, each, [np.tile(unit, (n, 1)) for n in steps]) for unit in np.eye(len(each.unit_inputs))
                ]
        rows = iter(np.nan_to_num(-self._added(replayed(self.problem, self.robot, self.base, acting))))
        return [
            each.rows(self.problem) if each.measured else np.array([next(rows) for _ in each.unit_inputs])
            for each in sources
        ]

    def better(self, driven: Sequence[Driven]) -> list[Driven]:
        """The same a round further. The first one, in which nothing acts on any of them yet, only sorts out."""
        parts = [driven[first : first + TOGETHER] for first in range(0, len(driven), TOGETHER)]
        return [one for part in parts for one in (self._first if part[0].root is None else self._further)(part)]

    def _first(self, driven: Sequence[Driven]) -> list[Driven]:
        """Numerical error is simulated at the end only."""
        return self._with_own_error(self._descended(driven, lambda some: some))

    def _further(self, driven: Sequence[Driven]) -> list[Driven]:
        """Numerical error is simulated after every step, as it changes on the way."""
        found = self._descended(driven, self._with_own_error)
        return [max(pair, key=lambda one: one.gain) for pair in zip(driven, found, strict=True)]

    def left(self, one: Driven) -> float:
        """rms [signal's unit] of what neither parameters, numerical error nor the force explain."""
        rest = LowRank(self._basis(one)).without(self._residual(one))
        return self.problem.sigma * float(np.sqrt((rest**2).sum() / self.problem.weight.sum()))

    def _basis(self, one: Driven) -> np.ndarray:
        """Of the covariance: parameters are numerical error too, what their slopes make of a standard deviation."""
        return np.concatenate([self.problem.discretisation.basis, one.error, one.jacobian])

    def _with_own_error(self, driven: Sequence[Driven]) -> list[Driven]:
        """The same with the numerical error under what acts too, beside that of earlier steps: with one alone the way
        to the truth looks as if it led away from it."""
        asked = [i for i, one in enumerate(driven) if not one.source.measured]
        errors: dict[int, list] = {i: [] for i in asked}
        for finer in self.refined if asked else ():
            for i, row in zip(asked, self._simulated(finer, [driven[i].acting for i in asked]), strict=True):
                if np.isfinite(row).all():  # it has this place
                    errors[i].append(self.problem.residuals_of(row[None])[0] - self._beside(driven[i].simulated))
        return [
            self._weighed(replace(one, error=np.concatenate([one.error, errors[i]]))) if errors.get(i) else one
            for i, one in enumerate(driven)
        ]

    def _simulated(self, robot: Robot, asked: Sequence[Acting]) -> np.ndarray:
        """(N, M) replays, but for faults of sensors."""
        problem, found = self.problem, np.zeros((len(asked), self._free.size))
        replays = [i for i, (_, source, _) in enumerate(asked) if not source.measured]
        if replays:
            found[replays] = replayed(problem, robot, self.base, [asked[i] for i in replays])
        for i, (_, source, factors) in enumerate(asked):
            if source.measured:
                all_factors = np.repeat(np.concatenate(factors), int(np.prod(problem.robot.shape)), axis=0)
                found[i] = self._free - problem.sigma * (all_factors * source.rows(problem).T).sum(axis=1)
        return found

    def _added(self, simulated: np.ndarray) -> np.ndarray:
        """(N, M) change that inputs make to the residual, in units of the noise, with its sign turned."""
        return (simulated - self._free) / self.problem.sigma * self.problem.weight

    def _beside(self, simulated: np.ndarray) -> np.ndarray:
        """(M,) the residual with the parameters of the hypothesis."""
        return _finite(self.base.residual - self._added(simulated))

    def _residual(self, one: Driven) -> np.ndarray:
        """(M,) the residual with the parameters in the middle of their priors, to first order."""
        return _finite(self._beside(one.simulated) - one.x @ one.jacobian)

    def _responses(self, one: Driven) -> tuple[np.ndarray, np.ndarray | sp.csr_array]:
        """(d, M) and (n K, M) change of the residual by the parameters, and by each value of the force."""
        x, source, factors = one.acting
        pulses, size = one.input_model.pulses(), one.values.shape[1]
        asked = [(x, source, [part + PULSE * more * unit for part, more in zip(factors, pulse, strict=True)])
                 for unit in np.eye(size) for pulse in pulses]  # fmt: skip
        # of the nominal robot the slopes are known, and what a sensor says does not change them
        shifts = np.zeros((0, self.d)) if one.root is None or source.measured else STEP * np.eye(self.d)
        asked += [(x + shift, source, factors) for shift in shifts]
        moved = np.nan_to_num(self._added(one.simulated) - self._added(self._simulated(self.robot, asked)))
        rows, jacobian = np.split(moved, [size * len(pulses)])
        rows = one.input_model.parts(rows.reshape(size, len(pulses), -1) / PULSE)
        return (jacobian / STEP if len(jacobian) else one.jacobian), rows

    def _descended(self, driven: Sequence[Driven], finished: Callable) -> list[Driven]:
        """Steps towards the most probable forces, with the same responses as long as that helps."""
        here, rows = [], []
        for one in driven:
            jacobian, response = self._responses(one)
            here.append(
                replace(one, jacobian=jacobian) if one.root is None else self._weighed(replace(one, jacobian=jacobian))
            )
            rows.append(response)
        going = list(range(len(driven)))
        for _ in range(STEPS):
            new = finished(self._stepped([here[i] for i in going], [rows[i] for i in going]))
            ahead = {i: one for i, one in zip(going, new, strict=True)
                     if here[i].root is None or one.gain > here[i].gain + SETTLED}  # fmt: skip
            here, going = [ahead.get(i, one) for i, one in enumerate(here)], list(ahead)
        return here

    def _stepped(self, driven: Sequence[Driven], rows: Sequence) -> list[Driven]:
        """The best of some trials of each."""
        tried = [self._trials(one, _FirstOrder(one, some, Covariance(self._basis(one))))
                 for one, some in zip(driven, rows, strict=True)]  # fmt: skip
        simulated = iter(self._simulated(self.robot, [trial.acting for some in tried for trial in some]))
        weighed = [[self._weighed(replace(trial, simulated=next(simulated))) for trial in some] for some in tried]
        return [max(some, key=lambda one: one.gain) for some in weighed]

    def _trials(self, one: Driven, first_order: "_FirstOrder") -> list[Driven]:
        """Towards where the evidence is largest, to first order, and where forces have to be smaller."""
        origin = self._residual(one) - first_order.changed(one.values)  # what the linear model says of no force
        aims = first_order.aims(origin)
        found, most = [], max(aims, key=lambda aim: aim.gain).scale
        for smaller in SMALLER:
            possible = [aim for aim in aims if aim.scale <= max(1.01 * most / smaller, SCALES[0])]
            aim = max(possible, key=lambda aim: aim.gain)
            x = self._parameters(one, origin + first_order.changed(aim.values))
            for length in LENGTHS:
                values, at = one.values + length * (aim.values - one.values), one.x + length * (x - one.x)
                found.append(replace(one, x=at, values=values, root=aim.scale * aim.root, occam=aim.occam))
        return found

    def _parameters(self, one: Driven, residual: np.ndarray) -> np.ndarray:
        """(d,) the most probable ones, of the residual (M,) that is left in the middle of their priors."""
        if one.source.measured:
            return one.x
        discretisation = LowRank(np.concatenate([self.problem.discretisation.basis, one.error]))
        return -np.linalg.solve(*normal_equations(discretisation, one.jacobian, residual, np.zeros(self.d)))

    def _weighed(self, one: Driven) -> Driven:
        """With the evidence of its replay."""
        prior = solve_triangular(one.root, one.values.ravel(), lower=True)
        cost = Covariance(self._basis(one)).cost(self._residual(one)) + 0.5 * float(prior @ prior) + one.occam
        return replace(one, gain=self._nothing - cost)


@dataclass(frozen=True)
class _Aim:
    """Values (n, K) that are most probable to first order if the prior has that scale, and the evidence they gain."""

    gain: float
    scale: float
    occam: float
    root: np.ndarray
    values: np.ndarray


class _FirstOrder:
    """What the residual is to first order in the values of a force.

    Args:
        rows: (n K, M) its change by each value.
        covariance: of everything else.
    """

    def __init__(self, one: Driven, rows: np.ndarray | sp.csr_array, covariance: Covariance):
        self._rows, self._covariance, self._white = rows, covariance, covariance.white(rows)
        self._shape = one.values.shape
        information = rows @ rows.T
        information = (information.toarray() if sp.issparse(information) else information) - self._white @ self._white.T
        roots = [np.kron(np.linalg.cholesky(each), np.eye(self._shape[1])) for each in one.input_model.covariances()]
        self._systems = [(root, *np.linalg.eigh(root.T @ information @ root)) for root in roots]

    def changed(self, values: np.ndarray) -> np.ndarray:
        """(M,) change of the residual by values (n, K)."""
        return self._rows.T @ values.ravel()

    def aims(self, origin: np.ndarray) -> list[_Aim]:
        """The most probable values under every prior, of what is left (M,) without a force."""
        pull, found = self._rows @ origin - self._white @ self._covariance.white(origin[None])[0], []
        for root, size, turn in self._systems:
            size, turned = np.maximum(size, 0.0), turn.T @ (root.T @ pull)
            for scale in SCALES:
                occam = 0.5 * float(np.log1p(scale**2 * size).sum())
                gain = 0.5 * float((turned**2 / (size + scale**-2)).sum()) - occam
                values = -root @ (turn @ (turned / (size + scale**-2)))
                found.append(_Aim(gain, scale, occam, root, values.reshape(self._shape)))
        return found


def _finite(residual: np.ndarray) -> np.ndarray:
    return np.nan_to_num(residual, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
