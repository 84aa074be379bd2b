"""What is to be explained: recordings, the noise of their samples, and the numerical error of the simulation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.robot import Measured, Robot
from soro_bench.diagnosis.suspects import Suspect, effects_at
from soro_bench.inference.clouds import LowRank

DIVERGED = 1e3  # standard deviations of the noise, a residual where the simulation diverged


@dataclass(frozen=True)
class Problem:
    """Recordings to be explained together, M samples in all.

    sigma: standard deviation of their noise [signal's unit]. weight: (M,) 0 for what is missing or an outlier, else 1.
    floor: numerical error in units of sigma.
    """

    robot: Robot
    recordings: tuple[Measured, ...]
    sigma: float
    weight: np.ndarray
    floor: LowRank

    @property
    def parameters(self) -> int:
        """Number of parameters, which come first among the unknowns."""
        return len(self.robot.priors)

    def simulated(self, robot: Robot, points: Sequence[tuple[np.ndarray, Sequence[Suspect]]]) -> np.ndarray:
        """(N, M) [signal's unit] by a robot, for N points: unknowns, and suspects they belong to."""
        d = self.parameters
        values = np.array([x[:d] for x, _ in points])
        parameters = np.stack([prior.value(values[:, i]) for i, prior in enumerate(self.robot.priors)], axis=1)
        effects = [effects_at(x[d:], suspects) for x, suspects in points]
        parts = [robot.simulate(each.actions, parameters, effects, each.start) for each in self.recordings]
        return np.concatenate([part.reshape(len(points), -1) for part in parts], axis=1)

    def residuals(self, points: Sequence[tuple[np.ndarray, Sequence[Suspect]]]) -> np.ndarray:
        """(N, M) measured less simulated, in units of sigma, of N points."""
        measured = np.concatenate([each.values.ravel() for each in self.recordings])
        residual = (np.nan_to_num(measured) - self.simulated(self.robot, points)) / self.sigma
        return np.nan_to_num(residual, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED) * self.weight

    def with_floor(self, columns: np.ndarray) -> "Problem":
        """The same with more numerical error: differences (F, M) [signal's unit]."""
        return replace(self, floor=LowRank(np.concatenate([self.floor.basis, columns / self.sigma * self.weight])))

    def excess(self, residual: np.ndarray) -> float:
        """How much less probable than white noise the residual (M,) is, as a logarithm; floor marginalised."""
        squares = float(self.floor.product(residual[None], residual[None])[0, 0])
        return 0.5 * (squares - float(self.weight.sum()))

    def cost(self, residual: np.ndarray, x: np.ndarray) -> float:
        """Minus the logarithm of likelihood times prior, but for a constant."""
        return 0.5 * float(self.floor.product(residual[None], residual[None])[0, 0] + x @ x)
