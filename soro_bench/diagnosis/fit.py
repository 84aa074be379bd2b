"""Joint fits of parameters and effects to a recording: maximum a posteriori, by Gauss-Newton on clouds.

Unknowns are in standard deviations of their priors. What is left is white noise plus a numerical error of low rank,
``floor``, whose coefficients are unknowns too, with standard normal priors (floor.py).

Slopes are regressions over clouds of points (inference/clouds.py). On TrunkReach 57 replays end closer to the truth
than 120 with finite differences.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.robot import Measured, Robot
from soro_bench.effects.catalogue import QUANTITIES
from soro_bench.effects.effect import Effect, Port
from soro_bench.inference.clouds import LENGTHS, LowRank, cloud, linearised

CLOUD = 16  # replays per linearisation
MAGNITUDE_DEVIATION, SECOND_DEVIATION = 5.0, 0.7  # of effects: in typical magnitudes, in logarithms
LIMIT = 4.0  # standard deviations of the prior


@dataclass(frozen=True)
class Suspect:
    """An effect whose parameters are to be found: a law at a port.

    typical: of its quantities, at this port. magnitudes: which of them are null without the effect.
    """

    name: str
    where: Port
    typical: tuple[float, ...]
    magnitudes: tuple[bool, ...]

    @property
    def size(self) -> int:
        return len(self.typical)

    @property
    def lower(self) -> np.ndarray:
        """(size,) below which a coordinate has no meaning: of magnitudes that cannot be negative."""
        bounds = []
        for q, magnitude in zip(QUANTITIES[self.name], self.magnitudes, strict=True):
            bounds.append(-LIMIT if not magnitude else 0.0 if q.bounds[0] == q.null else -np.inf)
        return np.array(bounds)

    def effect(self, x: np.ndarray) -> Effect:
        """The effect at coordinates x (size,), in standard deviations of their priors."""
        values = {}
        for q, typical, magnitude, one in zip(QUANTITIES[self.name], self.typical, self.magnitudes, x, strict=True):
            if magnitude:
                value = q.null + MAGNITUDE_DEVIATION * one * (typical - q.null)
            else:
                value = typical * np.exp(SECOND_DEVIATION * one)
            values[q.name] = float(np.clip(value, *q.bounds))
        return Effect(self.name, self.where, values)


@dataclass(frozen=True)
class Problem:
    """A recording to be explained.

    sigma: standard deviation of its noise [signal's unit]. weight: (M,) 1 for a good sample and 0 for a missing one or
    an outlier. floor: numerical error in units of sigma.
    """

    robot: Robot
    measured: Measured
    sigma: float
    weight: np.ndarray
    floor: LowRank

    @property
    def parameters(self) -> int:
        """Number of parameters, which come first among the unknowns."""
        return len(self.robot.priors)

    def residuals(self, points: Sequence[tuple[np.ndarray, Sequence[Suspect]]]) -> np.ndarray:
        """(N, M) measured less simulated, in units of sigma, for N points: unknowns, and suspects they belong to."""
        d = self.parameters
        values = np.array([x[:d] for x, _ in points])
        parameters = np.stack([prior.value(values[:, i]) for i, prior in enumerate(self.robot.priors)], axis=1)
        effects = [effects_at(x[d:], suspects) for x, suspects in points]
        simulated = self.robot.simulate(self.measured.actions, parameters, effects)
        residual = (np.nan_to_num(self.measured.values) - simulated).reshape(len(points), -1) / self.sigma
        return np.nan_to_num(residual, nan=1e3, posinf=1e3, neginf=-1e3) * self.weight

    def cost(self, residual: np.ndarray, x: np.ndarray) -> float:
        """Minus the logarithm of likelihood times prior, but for a constant."""
        return 0.5 * float(self.floor.product(residual[None], residual[None])[0, 0] + x @ x)


def effects_at(x: np.ndarray, suspects: Sequence[Suspect]) -> list[Effect]:
    """The suspects with the parameters that the coordinates x stand for."""
    found, first = [], 0
    for suspect in suspects:
        found.append(suspect.effect(x[first : first + suspect.size]))
        first += suspect.size
    return found


@dataclass(frozen=True)
class Hypothesis:
    """Suspects (none: the nominal robot) and the most probable unknowns so far.

    x: (n,) parameters, then those of the suspects. residual: (M,) there. slope: (n, M) of the residual. error: (E, M)
    what the linearisation leaves, a basis of its covariance.
    """

    suspects: tuple[Suspect, ...]
    x: np.ndarray
    residual: np.ndarray
    cost: float
    slope: np.ndarray
    error: np.ndarray

    def floor(self, problem: Problem) -> LowRank:
        """Numerical error together with that of the linearisation."""
        return LowRank(np.concatenate([problem.floor.basis, self.error]))

    def log_evidence(self, problem: Problem) -> float:
        """Logarithm of the probability of the recording, by Laplace's approximation, but for a common constant."""
        return -self.cost - 0.5 * float(np.linalg.slogdet(_hessian(problem.floor, self.slope))[1])

    def covariance(self, problem: Problem) -> np.ndarray:
        """(n, n) of x."""
        return np.linalg.inv(_hessian(self.floor(problem), self.slope))

    def effects(self, parameters: int) -> list[Effect]:
        """The suspects as fitted."""
        return effects_at(self.x[parameters:], self.suspects)


def fitted(problem: Problem, guesses, scales: Sequence[float], seed: int, progress=lambda: None) -> list[Hypothesis]:
    """The most probable unknowns of several hypotheses, whose replays run together.

    Args:
        guesses: a pair for each hypothesis: unknowns (n,) to start from, and its suspects.
        scales: radii of the clouds, in standard deviations of the priors.
    """
    guesses, best = [(np.array(x, float), tuple(s)) for x, s in guesses], [None] * len(guesses)
    for k, scale in enumerate(scales):
        clouds = [_cloud(problem, x, s, scale, [seed, k]) for x, s in guesses]
        asked = [(p, s) for points, (_, s) in zip(clouds, guesses, strict=True) for p in points]
        found = iter(problem.residuals(asked))
        lines = [linearised(x, points, np.stack([next(found) for _ in points]))
                 for (x, _), points in zip(guesses, clouds, strict=True)]  # fmt: skip
        trials = [_trials(problem, x, s, line) for (x, s), line in zip(guesses, lines, strict=True)]
        tried = iter(problem.residuals([(p, s) for each, (_, s) in zip(trials, guesses, strict=True) for p in each]))
        for i, ((_, s), each, line) in enumerate(zip(guesses, trials, lines, strict=True)):
            for x in each:
                residual = next(tried)
                cost = problem.cost(residual, x)
                if best[i] is None or cost < best[i].cost:
                    best[i] = Hypothesis(s, x, residual, cost, line.slope, line.error)
            best[i] = replace(best[i], slope=line.slope, error=line.error)
        guesses = [(h.x, h.suspects) for h in best]
        progress()
    return best


def lower_bounds(problem: Problem, suspects: Sequence[Suspect]) -> np.ndarray:
    """(n,) of the unknowns."""
    return np.concatenate([np.full(problem.parameters, -LIMIT), *[s.lower for s in suspects]])


def _cloud(problem, x, suspects, scale, seed):
    """(N, n) points around x, more of them for more unknowns."""
    count = CLOUD + 2 * (len(x) - problem.parameters)
    return np.maximum(cloud(x, scale, count, seed), lower_bounds(problem, suspects))


def _trials(problem, x, suspects, line):
    """Points along the way to where the linearised cost is least, within the bounds."""
    floor, lower = LowRank(np.concatenate([problem.floor.basis, line.error])), lower_bounds(problem, suspects)
    hessian, free = _hessian(floor, line.slope), np.ones(len(x), bool)
    gradient = floor.product(line.slope, line.residual[None])[:, 0] + x
    for _ in range(len(x)):
        step = np.zeros(len(x))
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        crossing = free & (x + step < lower) & (x <= lower)
        if not crossing.any():
            break
        free &= ~crossing
    return [np.maximum(x + np.clip(length * step, -3, 3), lower) for length in LENGTHS]


def _hessian(floor, slope):
    return floor.product(slope, slope) + np.eye(len(slope))
