"""What is to be explained: recordings, the noise of their samples, and the numerical error of the simulation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank

MISFIT_DOMINATED = (
    10.0  # standard deviations of the sensor's noise, rms, beyond which what a fit leaves is no noise of a sensor
)
NEGLIGIBLE = 0.1  # of what is taken for noise then, numerical error that explains nothing of it
DIVERGED = 1e3  # standard deviations of the noise, a residual where the simulation diverged


class SimulationError(ValueError):
    """The nominal robot cannot be simulated."""


@dataclass(frozen=True)
class Problem:
    """Recordings to be explained together, M samples in all.

    sigma: standard deviation of their noise [signal's unit]. weight: (M,) 0 for what is missing or an outlier, else 1.
    floor: numerical error in units of sigma. noise: of the sensor, where ``sigma`` is larger (``allowing``); else 0.
    settings: of the diagnosis.
    """

    robot: Robot
    recordings: tuple[Measured, ...]
    sigma: float
    weight: np.ndarray
    discretisation: LowRank
    noise: float = 0.0
    settings: Settings = DEFAULT

    @property
    def sensor(self) -> float:
        """Standard deviation of the sensor's noise [signal's unit]."""
        return self.noise or self.sigma

    @property
    def misfit_dominated(self) -> bool:
        """Whether more is taken for noise than the sensor's."""
        return self.noise > 0.0

    @property
    def parameters(self) -> int:
        """Number of parameters, which come first among the unknowns."""
        return len(self.robot.priors)

    @property
    def recorded(self) -> np.ndarray:
        """(S, ...) the actions of all recordings."""
        return np.concatenate([each.actions for each in self.recordings])

    def simulated(self, robot: Robot, points: Sequence[tuple[np.ndarray, Sequence[Term]]]) -> np.ndarray:
        """(N, M) [signal's unit] by a robot, for N points: unknowns, and suspects they belong to."""
        d = self.parameters
        values = np.array([x[:d] for x, _ in points])
        parameters = np.stack([prior.value(values[:, i]) for i, prior in enumerate(self.robot.priors)], axis=1)
        effects = [effects_at(x[d:], terms) for x, terms in points]
        parts = robot.simulate_all([each.drive for each in self.recordings], parameters, effects)
        return np.concatenate([part.reshape(len(points), -1) for part in parts], axis=1)

    def check_finite(self, robot: Robot, simulated: np.ndarray) -> None:
        """Raise SimulationError if every one of the replays (N, M) by a robot diverges: that would be taken for
        physics."""
        finite = np.isfinite(simulated)
        if finite.all(axis=1).any():
            return
        parts = self.split(finite[finite.sum(axis=1).argmax()])
        for number, (each, part) in enumerate(zip(self.recordings, parts, strict=True), 1):
            if not (good := part.all(axis=(1, 2))).all():
                raise SimulationError(f"the simulation by {robot.model_name} diverges {each.time[good.argmin()]:.3g} s "
                                      f"into recording {number}; a shorter time step may help")  # fmt: skip

    def split(self, samples: np.ndarray) -> list[np.ndarray]:
        """(M,) samples as those of every recording, (T, P, D)."""
        ends = np.cumsum([each.values.size for each in self.recordings])[:-1]
        parts = zip(np.split(samples, ends), self.recordings, strict=True)
        return [part.reshape(each.values.shape) for part, each in parts]

    def residuals(self, points: Sequence[tuple[np.ndarray, Sequence[Term]]]) -> np.ndarray:
        """(N, M) measured less simulated, in units of sigma, of N points."""
        return self.residuals_of(self.simulated(self.robot, points))

    def residuals_of(self, simulated: np.ndarray) -> np.ndarray:
        """The same of what has been simulated (N, M) [signal's unit]."""
        measured = np.concatenate([each.values.ravel() for each in self.recordings])
        residual = (np.nan_to_num(measured) - simulated) / self.sigma
        return np.nan_to_num(residual, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED) * self.weight

    def with_discretisation(self, columns: np.ndarray) -> "Problem":
        """The same with more numerical error: differences (F, M) [signal's unit]."""
        return self._with_basis(np.concatenate([self.discretisation.basis, columns / self.sigma * self.weight]))

    def _with_basis(self, basis: np.ndarray) -> "Problem":
        if self.misfit_dominated:
            basis = basis[(basis**2).sum(axis=1) > NEGLIGIBLE**2 * self.weight.sum()]
        return replace(self, discretisation=LowRank(basis))

    def misfit(self, residual: np.ndarray) -> float:
        """How much less probable than white noise the residual (M,) is, as a logarithm; floor marginalised."""
        squares = float(self.discretisation.product(residual[None], residual[None])[0, 0])
        return 0.5 * (squares - float(self.weight.sum()))

    def left(self, residual: np.ndarray) -> float:
        """Standard deviation [signal's unit] of what numerical error does not explain of a residual (M,)."""
        return self.sigma * float(np.sqrt((self.discretisation.without(residual) ** 2).sum() / self.weight.sum()))

    def allowing(self, left: float) -> "Problem":
        """The same where a simulation leaves ``left`` [signal's unit]: if that is many times the sensor's noise, it is
        the noise.

        No law is right to a thousandth of a real robot's motion. With the sensor's noise alone, the priors would not
        count, and small numerical errors, a hundred times enlarged, would explain what physics has to; so the floor
        loses those that are far smaller.
        """
        misfit_dominated = left > MISFIT_DOMINATED * self.sensor
        sigma = left if misfit_dominated else self.sensor
        same = replace(self, sigma=sigma, noise=self.sensor if misfit_dominated else 0.0)
        return same._with_basis(self.discretisation.basis * (self.sigma / sigma))

    def cost(self, residual: np.ndarray, x: np.ndarray) -> float:
        """Minus the logarithm of likelihood times prior, but for a constant."""
        return 0.5 * float(self.discretisation.product(residual[None], residual[None])[0, 0] + x @ x)
