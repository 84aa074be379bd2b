"""What a diagnosis explains: recordings, the noise of their samples, and the discretisation error of the simulation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank

Points = Sequence[tuple[Floats, Sequence[Term]]]  # unknowns, and the candidate terms that they belong to


class SimulationError(ValueError):
    """The nominal robot cannot be simulated."""


@dataclass(frozen=True)
class Problem:
    """Recordings to explain together, M samples in all.

    robot: whose replays explain them. sigma: standard deviation of their noise [signal's unit]. weight: (M,) 0 for
    missing samples and outliers, else 1. discretisation: errors of the simulation in units of sigma. noise: of the
    sensor, where the misfit dominates and ``sigma`` is larger (``allowing``); else 0. settings: of the diagnosis.
    """

    robot: Robot
    recordings: tuple[Measured, ...]
    sigma: float
    weight: Floats
    discretisation: LowRank
    noise: float = 0.0
    settings: Settings = DEFAULT

    @property
    def sensor(self) -> float:
        """Standard deviation of the sensor's noise [signal's unit]."""
        return self.noise or self.sigma

    @property
    def misfit_dominated(self) -> bool:
        """Whether model error is larger than the sensor's noise and is taken for noise."""
        return self.noise > 0.0

    @property
    def parameters(self) -> int:
        """Number of parameters, which come first among the unknowns."""
        return len(self.robot.priors)

    @property
    def recorded(self) -> Floats:
        """(S, ...) actions of all recordings."""
        return np.concatenate([each.actions for each in self.recordings])

    def simulated(self, robot: Robot, points: Points) -> Floats:
        """(N, M) samples [signal's unit] of replays by a robot at N points."""
        d = self.parameters
        values = np.array([x[:d] for x, _ in points])
        columns = [prior.value(values[:, i]) for i, prior in enumerate(self.robot.priors)]
        parameters = np.stack(columns, axis=1) if columns else values  # all may be known
        effects = [effects_at(x[d:], terms) for x, terms in points]
        parts = robot.simulate_all([each.drive for each in self.recordings], parameters, effects)
        return np.concatenate([part.reshape(len(points), -1) for part in parts], axis=1)

    def check_finite(self, robot: Robot, simulated: Floats) -> None:
        """Refuse replays (N, M) by a robot that all diverge: their residuals would be taken for physics.

        Raises:
            SimulationError: none of them is finite.
        """
        finite = np.isfinite(simulated)
        if finite.all(axis=1).any():
            return
        parts = self.split(finite[finite.sum(axis=1).argmax()])
        for number, (each, part) in enumerate(zip(self.recordings, parts, strict=True), 1):
            if not (good := part.all(axis=(1, 2))).all():
                raise SimulationError(
                    f"the simulation by {robot.model_name} diverges {each.time[good.argmin()]:.3g} s "
                    f"into recording {number}; a shorter time step may help"
                )

    def split(self, samples: np.ndarray) -> list[np.ndarray]:
        """(M,) samples as (T, P, D) of every recording."""
        ends = np.cumsum([each.values.size for each in self.recordings])[:-1]
        parts = zip(np.split(samples, ends), self.recordings, strict=True)
        return [part.reshape(each.values.shape) for part, each in parts]

    def residuals(self, points: Points) -> Floats:
        """(N, M) measured less simulated at N points, in units of sigma."""
        return self.residuals_of(self.simulated(self.robot, points))

    def residuals_of(self, simulated: Floats) -> Floats:
        """(N, M) measured less simulated (N, M) [signal's unit], in units of sigma."""
        measured = np.concatenate([each.values.ravel() for each in self.recordings])
        residual = (np.nan_to_num(measured) - simulated) / self.sigma
        diverged = self.settings.likelihood.diverged
        return np.nan_to_num(residual, nan=diverged, posinf=diverged, neginf=-diverged) * self.weight

    def with_discretisation(self, columns: Floats) -> "Problem":
        """The same problem with more discretisation errors: differences (F, M) [signal's unit]."""
        return self._with_basis(np.concatenate([self.discretisation.basis, columns / self.sigma * self.weight]))

    def _with_basis(self, basis: Floats) -> "Problem":
        """The same problem with a basis (F, M) of errors; where the misfit dominates, without the negligible ones."""
        if self.misfit_dominated:
            negligible = self.settings.discretisation.negligible
            basis = basis[(basis**2).sum(axis=1) > negligible**2 * self.weight.sum()]
        return replace(self, discretisation=LowRank(basis))

    def misfit(self, residual: Floats) -> float:
        """Misfit above the noise, (chi2 - M) / 2, of a residual (M,); discretisation errors are marginalised."""
        squares = float(self.discretisation.product(residual[None], residual[None])[0, 0])
        return 0.5 * (squares - float(self.weight.sum()))

    def left(self, residual: Floats) -> float:
        """Standard deviation [signal's unit] of a residual (M,) without its discretisation error."""
        return self.sigma * float(np.sqrt((self.discretisation.without(residual) ** 2).sum() / self.weight.sum()))

    def allowing(self, left: float) -> "Problem":
        """The same problem for a simulation whose misfit is ``left`` [signal's unit].

        If that is many times the sensor's noise, it becomes the noise. No law is right to a thousandth of a real
        robot's motion. With the sensor's noise alone the priors would not count, and small discretisation errors, a
        hundred times enlarged, would explain what physics has to; errors that are far smaller are dropped.
        """
        misfit_dominated = left > self.settings.likelihood.misfit_dominated * self.sensor
        sigma = left if misfit_dominated else self.sensor
        same = replace(self, sigma=sigma, noise=self.sensor if misfit_dominated else 0.0)
        return same._with_basis(self.discretisation.basis * (self.sigma / sigma))

    def cost(self, residual: Floats, x: Floats) -> float:
        """Minus the log posterior of unknowns x (n,) with residual (M,), up to a constant."""
        return 0.5 * float(self.discretisation.product(residual[None], residual[None])[0, 0] + x @ x)
