"""Joint fits of parameters and effects to a recording: maximum a posteriori, by Gauss-Newton on clouds.

Unknowns are in standard deviations of their priors. What is left is white noise plus a numerical error of low rank,
``floor``, whose coefficients are unknowns too, with standard normal priors (floor.py).

Slopes are regressions over clouds of points (inference/statistical_linearisation.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.estimation.discretisation import Points, discretisation_and_residuals
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect
from soro_bench.inference.statistical_linearisation import LENGTHS, LowRank, linearised, sample_around

CLOUD, CLOUD_WITH_SLOPE = 16, 6  # replays per linearisation at least, and where slopes are known from elsewhere


@dataclass(frozen=True)
class Hypothesis:
    """Suspects (none: the nominal robot) and the most probable unknowns so far.

    x: (n,) parameters, then those of the suspects. residual: (M,) there. slope: (n, M) of the residual. error: (E, M)
    what the linearisation leaves, a basis of its covariance. known: (n, n) covariance of x, where that is not what
    slope and error say (widths.py).
    """

    terms: tuple[Term, ...]
    x: np.ndarray
    residual: np.ndarray
    cost: float
    jacobian: np.ndarray
    error: np.ndarray
    known: np.ndarray | None = None

    def discretisation(self, problem: Problem) -> LowRank:
        """Numerical error together with that of the linearisation."""
        return LowRank(np.concatenate([problem.discretisation.basis, self.error]))

    def log_evidence(self, problem: Problem) -> float:
        """Logarithm of the probability of the recording, by Laplace's approximation, but for a common constant."""
        return -self.cost - 0.5 * float(np.linalg.slogdet(_hessian(problem.discretisation, self.jacobian))[1])

    def covariance(self, problem: Problem) -> np.ndarray:
        """(n, n) of x."""
        if self.known is not None:
            return self.known
        return np.linalg.inv(_hessian(self.discretisation(problem), self.jacobian))

    def scaled(self, problem: Problem, factor: float | np.ndarray) -> "Hypothesis":
        """The same about a problem whose residuals are a factor times those of this one, or a factor (M,) each."""
        parts = {name: getattr(self, name) * factor for name in ("residual", "jacobian", "error")}
        return replace(self, **parts, cost=problem.cost(parts["residual"], self.x))

    def effects(self, parameters: int) -> list[Effect]:
        """The suspects as fitted."""
        return effects_at(self.x[parameters:], self.terms)


def allowing(problem: Problem, best: Hypothesis, others: Sequence[Hypothesis]) -> tuple[Problem, list[Hypothesis]]:
    """The problem where the best hypothesis leaves much (``Problem.allowing``), and other hypotheses about it."""
    same = problem.allowing(problem.left(best.residual))
    return same, [each.scaled(same, problem.sigma / same.sigma) for each in others]


@dataclass(frozen=True)
class Guess:
    """Where a fit begins: unknowns (n,), the suspects they belong to, and slopes (n, M) if there are any."""

    x: np.ndarray
    terms: tuple[Term, ...] = ()
    jacobian: np.ndarray | None = None


def fitted(
    problem: Problem,
    guesses: Sequence[Guess],
    scales: Sequence[float],
    seed: int,
    first: Sequence[np.ndarray] | None = None,
) -> list[Hypothesis]:
    """The most probable unknowns of several hypotheses, whose replays run together.

    Args:
        scales: radii of the clouds, in standard deviations of the priors.
        first: residuals (N, M) of the first cloud of each guess, where it has been replayed.
    """
    best: list[Hypothesis] = []
    guesses = _within(problem, guesses)
    for k, scale in enumerate(scales):
        statistical_linearisation = _samples_around(problem, guesses, scale, [seed, k])
        found = first if k == 0 and first is not None else replayed(problem, guesses, statistical_linearisation)
        lines = [
            linearised(g.x, points, rows, g.jacobian)
            for g, points, rows in zip(guesses, statistical_linearisation, found, strict=True)
        ]
        trials = [_trials(problem, guess, line) for guess, line in zip(guesses, lines, strict=True)]
        found = replayed(problem, guesses, trials)
        news = []
        for i, (guess, line, points, rows) in enumerate(zip(guesses, lines, trials, found, strict=True)):
            kept = [replace(best[i], jacobian=line.jacobian, error=line.error)] if best else []
            news.append(min([*_hypotheses(problem, guess, points, rows, line), *kept], key=lambda h: h.cost))
        best = news
        guesses = [replace(g, x=h.x, jacobian=g.jacobian if g.jacobian is None else h.jacobian)
                   for g, h in zip(guesses, best, strict=True)]  # fmt: skip
    return best


def fitted_under_discretisation(
    problem: Problem, refined: Sequence[Robot], points: Points, guesses: Sequence[Guess], scales: Sequence[float],
    seed: int,
) -> tuple[Problem, list[Hypothesis]]:  # fmt: skip
    """The problem with the numerical floor at points too, and fits under it, whose first clouds need no floor and are
    replayed beside it."""
    guesses = _within(problem, guesses)
    statistical_linearisation = _samples_around(problem, guesses, scales[0], [seed, 0])
    discretisation, found = discretisation_and_residuals(
        problem, refined, points, _asked(guesses, statistical_linearisation)
    )
    problem = problem.with_discretisation(discretisation)
    return problem, fitted(problem, guesses, scales, seed, _split(found, statistical_linearisation))


def _hypotheses(problem, guess, points, residuals, line):
    return [
        Hypothesis(guess.terms, x, row, problem.cost(row, x), line.jacobian, line.error)
        for x, row in zip(points, residuals, strict=True)
    ]


def replayed(
    problem: Problem, guesses: Sequence[Guess | Hypothesis], groups: Sequence[Sequence[np.ndarray]]
) -> list[np.ndarray]:
    """Residuals (N, M) at the points (N, n) of each guess, replayed together."""
    return _split(problem.residuals(_asked(guesses, groups)), groups)


def _asked(guesses, groups):
    return [(x, guess.terms) for guess, points in zip(guesses, groups, strict=True) for x in points]


def _split(rows, groups):
    return np.split(rows, np.cumsum([len(points) for points in groups])[:-1])


def _within(problem, guesses):
    return [replace(g, x=np.clip(g.x, *bounds(problem, g.terms))) for g in guesses]


def _samples_around(problem, guesses, scale, seed):
    return [_sample_around(problem, guess, scale, seed) for guess in guesses]


def bounds(problem: Problem, terms: Sequence[Term]) -> np.ndarray:
    """(2, n) of the unknowns."""
    return np.hstack([*[prior.reach[:, None] for prior in problem.robot.priors], *[s.bounds for s in terms]])


def _sample_around(problem, guess, scale, seed):
    """(N, n) points around a guess, more of them for more unknowns."""
    more, known = len(guess.x) - problem.parameters, guess.jacobian is not None
    count = CLOUD_WITH_SLOPE + more if known else max(CLOUD, CLOUD_WITH_SLOPE + 2 * len(guess.x))
    return np.clip(sample_around(guess.x, scale, count, seed), *bounds(problem, guess.terms))


def _trials(problem, guess, line):
    """Points along the way to where the linearised cost is least, within the bounds."""
    x, terms = guess.x, guess.terms
    discretisation = LowRank(np.concatenate([problem.discretisation.basis, line.error]))
    lower, upper = bounds(problem, terms)
    hessian, gradient = normal_equations(discretisation, line.jacobian, line.residual, x)
    free = np.ones(len(x), bool)
    for _ in range(len(x)):
        step = np.zeros(len(x))
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        crossing = free & (((x + step < lower) & (x <= lower)) | ((x + step > upper) & (x >= upper)))
        if not crossing.any():
            break
        free &= ~crossing
    return [np.clip(x + np.clip(length * step, -3, 3), lower, upper) for length in LENGTHS]


def normal_equations(discretisation: LowRank, jacobian: np.ndarray, residual: np.ndarray, x: np.ndarray):
    """Hessian (n, n) and gradient (n,), at x (n,), of the cost of a residual (M,) with slopes (n, M) and of standard
    normal priors of x."""
    return _hessian(discretisation, jacobian), discretisation.product(jacobian, residual[None])[:, 0] + x


def _hessian(discretisation, jacobian):
    return discretisation.product(jacobian, jacobian) + np.eye(len(jacobian))
