"""Unknown-input estimation: the input at a location that explains most of a residual, without a law.

An input is free in time, or linear in the commands and in the robot's shape (input_models.py). Its values, the
parameters and the discretisation error are estimated together, in rounds of Gauss-Newton. A round replays the robot
with a little more of each value and parameter, then under several inputs on the way to the most probable one, and from
the best of these again with the same responses. Cables go slack and obstacles are hit, so responses are wrong where
inputs are large.

The discretisation error is that under the input, by replays of the refined robots. In one case, a motor of a `flex`
trunk moved another's cable. The error without that input left a misfit of 41,000 nats of the true one. The evidence is
that of the last replay, by Laplace's approximation.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from soro_bench.diagnosis.estimation.fit import Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import Problem, finite
from soro_bench.diagnosis.localisation.input_models import SCALES, Free, Linear
from soro_bench.diagnosis.localisation.test_inputs import Acting, Source, replayed, setpoints
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank

Rows: TypeAlias = np.ndarray | sp.csr_array  # responses, sparse where each value changes few samples

FINALISTS = 8  # locations that go on after the first round, and are replayed side by side
ROUNDS = 8  # of Gauss-Newton steps at most, and steps of a round with the same Jacobian
LEAST_GAIN = 1.0  # nats, of a round or a step that is worth another one
_STEPS = (0.1, 0.4, 1.0)  # shares of a step that are replayed; cables fall slack
_SMALLER = 16.0  # times smaller than predicted inputs are tried too


class Covariance:
    """Of parameters, discretisation error and noise in units of the noise: I + Bᵀ B, of a basis B (F, M)."""

    def __init__(self, basis: np.ndarray):
        self.basis = basis
        self._root = np.linalg.cholesky(np.eye(len(basis)) + basis @ basis.T)

    def white(self, rows: Rows) -> np.ndarray:
        """(C, F) of rows (C, M): products of rows less products of these are products with the inverse."""
        return solve_triangular(self._root, np.asarray(rows @ self.basis.T).T, lower=True).T

    def cost(self, residual: np.ndarray) -> float:
        """Minus the logarithm of the probability of a residual (M,), but for a constant."""
        squares = residual @ residual - (self.white(residual[None]) ** 2).sum()
        return 0.5 * float(squares) + float(np.log(np.diag(self._root)).sum())


@dataclass(frozen=True)
class Estimate:
    """An input at a location, and the robot under it.

    x: (d,) parameters. values: (n, K) of the input model. simulated: (M,) under both.
    jacobian: (d, M) of the residual by the parameters, where they were last replayed.
    error: (F, M) discretisation error under the input, and under those of earlier steps.
    root: Cholesky factor (n K, n K) of the prior covariance of the values; None before the first round.
    occam: log evidence that is lost as the values might have been others.
    gain: log evidence gained over no input [nats].
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
        """Where the input acts."""
        return self.source.location

    @property
    def acting(self) -> Acting:
        """What is replayed."""
        return self.x, self.source, self.input_model.factors(self.values)


class Search:
    """The search for inputs at several locations of a robot that explain the residual of a hypothesis.

    Args:
        robot: on which the inputs act.
        base: the hypothesis.
        refined: the robot simulated more accurately. How much that changes depends on the input.
    """

    def __init__(self, problem: Problem, robot: Robot, base: Hypothesis, refined: Sequence[Robot]):
        self.problem, self.robot, self.base, self.refined = problem, robot, base, refined
        self.d = problem.parameters
        self._settings = problem.settings.localisation
        nothing = [np.zeros((len(recording.values), 0)) for recording in problem.recordings]
        self.linear = Linear(problem, setpoints(problem, robot, base), robot.actuator_names)
        (self._without,) = replayed(problem, robot, base, [(base.x, Source(()), nothing)])
        self._x, self._jacobian = base.x[: self.d], base.jacobian[: self.d]
        covariance = Covariance(np.concatenate([problem.discretisation.basis, self._jacobian]))
        self._cost_without = covariance.cost(base.residual - self._x @ self._jacobian)

    def begin(self, sources: Sequence[Source], linear: bool) -> list[Estimate]:
        """Estimates of no input yet.

        Args:
            linear: whether inputs are linear in commands and shape, or else free in time.
        """
        estimates, none = [], np.zeros((0, self._without.size))
        for source in sources:
            model = self.linear if linear else Free(self.problem, len(source.unit_inputs))
            values = np.zeros((model.size, len(source.unit_inputs)))
            estimates.append(Estimate(source, model, self._x, values, self._without, self._jacobian, none))
        return estimates

    def sized(self, sources: Sequence[Source]) -> tuple[list[Source], list[np.ndarray]]:
        """Test inputs so large that each moves the robot by ``LocalisationSettings.reach`` if it acts all the time.

        Returns:
            The test inputs, and the change (K, M) of the residual by each.
        """
        sized = list(sources)
        for _ in range(2):  # the response to an input that is far too large is no measure of it
            rows = self._constant(sized)
            rms = [np.sqrt((row**2).sum(axis=1).max() / self.problem.weight.sum()) for row in rows]
            factors = [
                self._settings.reach / size if size > 0 and not source.measured else 1.0
                for source, size in zip(sized, rms, strict=True)
            ]
            sized = [source.times(factor) for source, factor in zip(sized, factors, strict=True)]
        return sized, [row * factor for row, factor in zip(rows, factors, strict=True)]

    def _constant(self, sources: Sequence[Source]) -> list[np.ndarray]:
        """(K, M) change of the residual by each constant test input."""
        steps = [len(recording.values) for recording in self.problem.recordings]
        acting: list[Acting] = []
        for source in sources:
            if not source.measured:
                for unit in np.eye(len(source.unit_inputs)):
                    acting.append((self._x, source, [np.tile(unit, (n, 1)) for n in steps]))
        rows = iter(np.nan_to_num(-self._added(replayed(self.problem, self.robot, self.base, acting))))
        return [
            source.rows(self.problem) if source.measured else np.array([next(rows) for _ in source.unit_inputs])
            for source in sources
        ]

    def better(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """The estimates a round further; never worse after their first round, which only sorts out."""
        parts = [estimates[first : first + FINALISTS] for first in range(0, len(estimates), FINALISTS)]
        return [new for part in parts for new in (self._first if part[0].root is None else self._further)(part)]

    def _first(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """The first round: discretisation error is simulated at its end only."""
        return self._with_own_error(self._descended(estimates, list))

    def _further(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """A later round: discretisation error is simulated after every step, as it changes on the way."""
        descended = self._descended(estimates, self._with_own_error)
        return [max(pair, key=lambda estimate: estimate.gain) for pair in zip(estimates, descended, strict=True)]

    def remaining_rms(self, estimate: Estimate) -> float:
        """rms [signal's unit] of the residual that neither parameters, discretisation error nor the input explain."""
        rest = LowRank(self._basis(estimate)).without(self._residual(estimate))
        return self.problem.sigma * float(np.sqrt((rest**2).sum() / self.problem.weight.sum()))

    def _basis(self, estimate: Estimate) -> np.ndarray:
        """(F, M) of the covariance: discretisation error, and what a prior deviation of each parameter changes."""
        return np.concatenate([self.problem.discretisation.basis, estimate.error, estimate.jacobian])

    def _with_own_error(self, estimates: Sequence[Estimate]) -> list[Estimate]:
        """The estimates with the discretisation error under their inputs too, beside that of earlier steps.

        With one alone, the way to the truth looks as if it led away from it.
        """
        asked = [i for i, estimate in enumerate(estimates) if not estimate.source.measured]
        errors: dict[int, list[np.ndarray]] = {i: [] for i in asked}
        for finer in self.refined if asked else ():
            rows = self._simulated(finer, [estimates[i].acting for i in asked])
            for i, row in zip(asked, rows, strict=True):
                if np.isfinite(row).all():  # the refined robot has this location
                    errors[i].append(self.problem.residuals_of(row[None])[0] - self._beside(estimates[i].simulated))
        return [
            self._weighed(replace(estimate, error=np.concatenate([estimate.error, errors[i]])))
            if errors.get(i)
            else estimate
            for i, estimate in enumerate(estimates)
        ]

    def _simulated(self, robot: Robot, asked: Sequence[Acting]) -> np.ndarray:
        """(N, M) signal [signal's unit] under inputs; sensor faults need no replay."""
        problem, simulated = self.problem, np.zeros((len(asked), self._without.size))
        replays = [i for i, (_, source, _) in enumerate(asked) if not source.measured]
        if replays:
            simulated[replays] = replayed(problem, robot, self.base, [asked[i] for i in replays])
        for i, (_, source, factors) in enumerate(asked):
            if source.measured:
                of_samples = np.repeat(np.concatenate(factors), problem.robot.columns, axis=0)
                simulated[i] = self._without - problem.sigma * (of_samples * source.rows(problem).T).sum(axis=1)
        return simulated

    def _added(self, simulated: np.ndarray) -> np.ndarray:
        """(N, M) change that inputs make to the residual, in units of the noise, with its sign turned."""
        return (simulated - self._without) / self.problem.sigma * self.problem.weight

    def _beside(self, simulated: np.ndarray) -> np.ndarray:
        """(M,) the residual with the parameters of the hypothesis."""
        return finite(self.base.residual - self._added(simulated))

    def _residual(self, estimate: Estimate) -> np.ndarray:
        """(M,) the residual with the parameters in the middle of their priors, to first order."""
        return finite(self._beside(estimate.simulated) - estimate.x @ estimate.jacobian)

    def _responses(self, estimate: Estimate) -> tuple[np.ndarray, Rows]:
        """(d, M) and (n K, M) change of the residual by the parameters, and by each value of the input."""
        pulse_size, difference = self._settings.pulse, self.problem.settings.descent.difference
        x, source, factors = estimate.acting
        pulses, size = estimate.input_model.pulses(), estimate.values.shape[1]
        asked: list[Acting] = []
        for unit in np.eye(size):
            for pulse in pulses:
                more = [part + pulse_size * one * unit for part, one in zip(factors, pulse, strict=True)]
                asked.append((x, source, more))
        # the Jacobian of the nominal robot is known, and a sensor fault does not change it
        known = estimate.root is None or source.measured
        shifts = np.zeros((0, self.d)) if known else difference * np.eye(self.d)
        asked += [(x + shift, source, factors) for shift in shifts]
        moved = np.nan_to_num(self._added(estimate.simulated) - self._added(self._simulated(self.robot, asked)))
        rows, jacobian = np.split(moved, [size * len(pulses)])
        by_values = estimate.input_model.parts(rows.reshape(size, len(pulses), -1) / pulse_size)
        return (jacobian / difference if len(jacobian) else estimate.jacobian), by_values

    def _descended(
        self, estimates: Sequence[Estimate], finished: Callable[[list[Estimate]], list[Estimate]]
    ) -> list[Estimate]:
        """Steps towards the most probable inputs, with the same responses as long as that helps.

        Args:
            finished: what is done with the estimates of every step.
        """
        here, rows = [], []
        for estimate in estimates:
            jacobian, response = self._responses(estimate)
            there = replace(estimate, jacobian=jacobian)
            here.append(there if there.root is None else self._weighed(there))
            rows.append(response)
        going = list(range(len(estimates)))
        for _ in range(ROUNDS):
            new = finished(self._stepped([here[i] for i in going], [rows[i] for i in going]))
            ahead = {
                i: estimate
                for i, estimate in zip(going, new, strict=True)
                if here[i].root is None or estimate.gain > here[i].gain + LEAST_GAIN
            }
            here, going = [ahead.get(i, estimate) for i, estimate in enumerate(here)], list(ahead)
        return here

    def _stepped(self, estimates: Sequence[Estimate], rows: Sequence[Rows]) -> list[Estimate]:
        """The best of some trials of each, which are replayed together."""
        trials = [
            self._trials(estimate, _FirstOrder(estimate, own, Covariance(self._basis(estimate))))
            for estimate, own in zip(estimates, rows, strict=True)
        ]
        simulated: Iterator[np.ndarray] = iter(
            self._simulated(self.robot, [trial.acting for own in trials for trial in own])
        )
        weighed = [[self._weighed(replace(trial, simulated=next(simulated))) for trial in own] for own in trials]
        return [max(own, key=lambda trial: trial.gain) for own in weighed]

    def _trials(self, estimate: Estimate, first_order: "_FirstOrder") -> list[Estimate]:
        """Points on the way to where the evidence is largest, to first order; and to smaller inputs."""
        origin = self._residual(estimate) - first_order.changed(estimate.values)  # without an input, to first order
        aims = first_order.aims(origin)
        trials, most = [], max(aims, key=lambda aim: aim.gain).scale
        for smaller in (1.0, _SMALLER):
            limit = max(1.01 * most / smaller, min(SCALES))
            aim = max((aim for aim in aims if aim.scale <= limit), key=lambda aim: aim.gain)
            x = self._parameters(estimate, origin + first_order.changed(aim.values))
            for share in _STEPS:
                values = estimate.values + share * (aim.values - estimate.values)
                there = estimate.x + share * (x - estimate.x)
                trials.append(replace(estimate, x=there, values=values, root=aim.scale * aim.root, occam=aim.occam))
        return trials

    def _parameters(self, estimate: Estimate, residual: np.ndarray) -> np.ndarray:
        """(d,) the most probable ones, from the residual (M,) with parameters in the middle of their priors."""
        if estimate.source.measured:
            return estimate.x
        discretisation = LowRank(np.concatenate([self.problem.discretisation.basis, estimate.error]))
        return -np.linalg.solve(*normal_equations(discretisation, estimate.jacobian, residual, np.zeros(self.d)))

    def _weighed(self, estimate: Estimate) -> Estimate:
        """The estimate with the log evidence that its replay gains."""
        prior = solve_triangular(estimate.root, estimate.values.ravel(), lower=True)
        misfit = Covariance(self._basis(estimate)).cost(self._residual(estimate))
        cost = misfit + 0.5 * float(prior @ prior) + estimate.occam
        return replace(estimate, gain=self._cost_without - cost)


@dataclass(frozen=True)
class _Aim:
    """The most probable values (n, K) to first order under a prior of a scale, and the log evidence they gain."""

    gain: float
    scale: float
    occam: float
    root: np.ndarray
    values: np.ndarray


class _FirstOrder:
    """The residual to first order in the values of an input.

    Args:
        rows: (n K, M) its change by each value.
        covariance: of everything else.
    """

    def __init__(self, estimate: Estimate, rows: Rows, covariance: Covariance):
        self._rows, self._covariance, self._white = rows, covariance, covariance.white(rows)
        self._shape = estimate.values.shape
        products = rows @ rows.T
        dense = products if isinstance(products, np.ndarray) else products.toarray()
        information = dense - self._white @ self._white.T
        components = np.eye(self._shape[1])
        roots = [np.kron(np.linalg.cholesky(prior), components) for prior in estimate.input_model.covariances()]
        self._systems = [(root, *np.linalg.eigh(root.T @ information @ root)) for root in roots]

    def changed(self, values: np.ndarray) -> np.ndarray:
        """(M,) change of the residual by values (n, K)."""
        return self._rows.T @ values.ravel()

    def aims(self, origin: np.ndarray) -> list[_Aim]:
        """The most probable values under every prior, from the residual (M,) without an input."""
        pull = self._rows @ origin - self._white @ self._covariance.white(origin[None])[0]
        aims = []
        for root, eigenvalues, vectors in self._systems:
            size, turned = np.maximum(eigenvalues, 0.0), vectors.T @ (root.T @ pull)
            for scale in SCALES:
                occam = 0.5 * float(np.log1p(scale**2 * size).sum())
                gain = 0.5 * float((turned**2 / (size + scale**-2)).sum()) - occam
                values = -root @ (vectors @ (turned / (size + scale**-2)))
                aims.append(_Aim(gain, scale, occam, root, values.reshape(self._shape)))
        return aims
