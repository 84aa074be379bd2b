"""What a diagnosis explains: recordings, the noise of their samples, and the discretisation error of the simulation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.variants import Variant
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.recording import with_file

Points = Sequence[tuple[Floats, Sequence[Term]]]  # unknowns, and the candidate terms that they belong to

DIVERGED = 1e3  # noise deviations, residual of a sample where the simulation diverged: far above any other


class SimulationError(ValueError):
    """The nominal robot cannot be simulated."""


def finite(residuals: Floats) -> Floats:
    """Residuals of any shape [noise deviations], ``DIVERGED`` far off where they are no finite numbers."""
    return np.nan_to_num(residuals, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)


@dataclass(frozen=True)
class Problem:
    """Recordings to explain together, M samples in all.

    Samples are in the order of time, and of every time the C numbers of all signals. Those of other signals than the
    first are scaled so that their noise is that of the first one: all samples are in the unit of the first signal, and
    the algebra of fits knows one ``sigma``.

    robot: whose replays explain them. sigma: standard deviation of their noise [signal's unit]. weight: (M,) 0 for
    missing samples and outliers, else 1. discretisation: errors of the simulation in units of sigma; its first
    ``of_recordings`` rows are what time stamps and first samples may be off. noise: of the sensor, where the misfit
    dominates and ``sigma`` is larger (``allowing``); else 0. settings: of the diagnosis.
    others: of each other signal what ``sigma`` is of the first, and what ``noise`` is [its unit].
    model_form: largest rms [signal's unit] of a model-form error beside the discretisation error (model_form.py).
    variants: other simulations of the robot, of which nobody knows that they are more accurate.
    correction: (M,) added to what the robot simulates [first signal's unit]; see ``with_longer_steps``.
    """

    robot: Robot
    recordings: tuple[Measured, ...]
    sigma: float
    weight: Floats
    discretisation: LowRank
    noise: float = 0.0
    settings: Settings = DEFAULT
    others: tuple[tuple[float, float], ...] = ()
    model_form: float = 0.0
    variants: tuple[Variant, ...] = ()
    correction: Floats | float = 0.0
    of_recordings: int = 0

    @property
    def sensor(self) -> float:
        """Standard deviation of the sensor's noise [signal's unit]."""
        return self.noise or self.sigma

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Of each signal, what counts as its noise [its unit]."""
        return self.sigma, *(sigma for sigma, _ in self.others)

    @property
    def sensors(self) -> tuple[float, ...]:
        """Standard deviation of the noise of each signal's sensor [its unit]."""
        return self.sensor, *(noise or sigma for sigma, noise in self.others)

    @property
    def scales(self) -> Floats:
        """(C,) by which samples are scaled: units of the first signal for one of their own."""
        return self.of_columns([self.sigma / sigma for sigma in self.sigmas])

    def of_columns(self, values: Sequence[float]) -> Floats:
        """(C,) one value of each signal, for each of its numbers."""
        return np.repeat(np.asarray(values, float), [each.size for each in self.robot.signals])

    def of_samples(self, columns: Floats) -> Floats:
        """(M,) values (C,) of the numbers of a sample, for all samples."""
        return np.tile(columns, self.weight.size // len(columns))

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
        """(N, M) samples [first signal's unit] of replays by a robot at N points, which may be none."""
        if not points:
            return np.empty((0, self.weight.size))
        d, parameters = self.parameters, self.parameter_values([x for x, _ in points])
        effects = [effects_at(x[d:], terms) for x, terms in points]
        return self.scaled(robot.simulate_all([each.drive for each in self.recordings], parameters, effects))

    def scaled(self, parts: Sequence[Floats]) -> Floats:
        """(N, M) samples [first signal's unit] of replays (N, T, C) of each recording [unit of every signal]."""
        scales = self.scales if self.others else 1.0
        return np.concatenate([(part * scales).reshape(len(part), -1) for part in parts], axis=1)

    @property
    def measured(self) -> Floats:
        """(M,) what was measured [first signal's unit]; NaN where nothing was."""
        return self.scaled([each.columns[None] for each in self.recordings])[0]

    def parameter_values(self, points: Sequence[Floats]) -> Floats:
        """(N, d) values of the parameters at N points of unknowns."""
        values = np.array([x[: self.parameters] for x in points]).reshape(len(points), self.parameters)
        columns = [prior.value(values[:, i]) for i, prior in enumerate(self.robot.priors)]
        return np.stack(columns, axis=1) if columns else values  # all may be known

    def check_finite(self, robot: Robot, simulated: Floats) -> None:
        """Refuse replays (N, M) by a robot that all diverge: their residuals would be taken for physics.

        Raises:
            SimulationError: none of them is finite.
        """
        finite = np.isfinite(simulated)
        if finite.all(axis=1).any():
            return
        parts = self.rows(finite[finite.sum(axis=1).argmax()])
        for number, (each, part) in enumerate(zip(self.recordings, parts, strict=True), 1):
            if not (good := part.all(axis=1)).all():
                raise SimulationError(
                    f"the simulation by {robot.model_name} diverges {each.time[good.argmin()]:.3g} s "
                    f"into {with_file(f'recording {number}', each.file)}; a shorter time step may help"
                )

    def rows(self, samples: np.ndarray) -> list[np.ndarray]:
        """(M,) samples as (T, C) of every recording, the numbers of all signals."""
        count = self.robot.columns
        ends = np.cumsum([len(each.values) * count for each in self.recordings])[:-1]
        return [part.reshape(-1, count) for part in np.split(samples, ends)]

    def split(self, samples: np.ndarray, which: int = 0) -> list[np.ndarray]:
        """(M,) samples of one signal, as (T, P, D) of every recording [first signal's unit].

        Args:
            which: the number of the signal.
        """
        signals = self.robot.signals
        first, signal = sum(each.size for each in signals[:which]), signals[which]
        columns = slice(first, first + signal.size)
        return [row[:, columns].reshape(len(row), *signal.shape) for row in self.rows(samples)]

    def joined(self, parts: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
        """(M,) samples, of those of each signal and recording (T, P, D): what ``split`` takes apart."""
        rows = [[part.reshape(len(part), -1) for part in signal] for signal in parts]
        return np.concatenate([np.concatenate(each, axis=1).ravel() for each in zip(*rows, strict=True)])

    def residuals(self, points: Points) -> Floats:
        """(N, M) measured less simulated at N points, in units of sigma."""
        return self.residuals_of(self.simulated(self.robot, points) + self.correction)

    def with_longer_steps(self, robot: Robot, x: Floats, terms: Sequence[Term], residual: Floats) -> "Problem":
        """The same problem, simulated by a robot with longer time steps that agrees with its own one at a point.

        The difference that the time step makes changes little nearby, so fits of many candidates cost less.

        Args:
            x, terms: the point. residual: (M,) there, in units of sigma.
        """
        (there,) = self.residuals_of(self.simulated(robot, [(x, terms)]))
        return replace(self, robot=robot, correction=(there - residual) * self.sigma)

    def residuals_of(self, simulated: Floats) -> Floats:
        """(N, M) measured less simulated (N, M) [signal's unit], in units of sigma."""
        return finite((np.nan_to_num(self.measured) - simulated) / self.sigma) * self.weight

    def first(self, steps: Sequence[int]) -> "Problem":
        """The same problem of the first control steps of each recording."""
        rows = [
            np.arange(len(each.time)).repeat(self.robot.columns) < count
            for each, count in zip(self.recordings, steps, strict=True)
        ]
        kept = np.concatenate(rows)
        parts = tuple(each.first(count) for each, count in zip(self.recordings, steps, strict=True))
        basis = LowRank(self.discretisation.basis[:, kept])
        return replace(self, recordings=parts, weight=self.weight[kept], discretisation=basis)

    def with_discretisation(self, columns: Floats) -> "Problem":
        """The same problem with more discretisation errors: differences (F, M) [signal's unit]."""
        return self._with_basis(np.concatenate([self.discretisation.basis, columns / self.sigma * self.weight]))

    def _with_basis(self, basis: Floats) -> "Problem":
        """The same problem with a basis (F, M) of errors; where the misfit dominates, without the negligible ones."""
        if not self.misfit_dominated:
            return replace(self, discretisation=LowRank(basis))
        kept = (basis**2).sum(axis=1) > self.settings.discretisation.negligible**2 * self.weight.sum()
        first = int(kept[: self.of_recordings].sum())
        return replace(self, discretisation=LowRank(basis[kept]), of_recordings=first)

    def misfit(self, residual: Floats) -> float:
        """Misfit above the noise, (chi2 - M) / 2, of a residual (M,); discretisation errors are marginalised."""
        squares = float(self.discretisation.product(residual[None], residual[None])[0, 0])
        return 0.5 * (squares - float(self.weight.sum()))

    def left(self, residual: Floats) -> float:
        """Standard deviation [first signal's unit] of a residual (M,) without its discretisation error."""
        return self.sigma * float(np.sqrt((self.discretisation.without(residual) ** 2).sum() / self.weight.sum()))

    def left_of_each(self, residual: Floats) -> list[float]:
        """The same of every signal [its unit]; 0 where it has no sample."""
        if not self.others:
            return [self.left(residual)]
        left, found = self.discretisation.without(residual), []
        for which, sigma in enumerate(self.sigmas):
            squares = sum(float((part**2).sum()) for part in self.split(left, which))
            weight = sum(float(part.sum()) for part in self.split(self.weight, which))
            found.append(sigma * float(np.sqrt(squares / max(weight, 1.0))))
        return found

    def within_steps(self, residual: Floats) -> bool:
        """Whether a residual (M,) may be what quantised sensors err by: all but a few samples of every number are off
        by no more than half a step, which is rounding, and the sensor's own error."""
        allowed, share = 0.5 + self.settings.data_quality.sensor_error, self.settings.data_quality.within_steps
        seen, within = np.zeros(self.robot.columns), np.zeros(self.robot.columns)
        parts = zip(self.recordings, self.rows(residual * self.sigma), self.rows(self.weight), strict=True)
        for each, left, weight in parts:
            if each.steps is None:
                return False
            seen += (weight > 0).sum(axis=0)
            within += ((weight > 0) & (np.abs(left) <= allowed * each.steps * self.scales)).sum(axis=0)
        return bool((within >= share * seen).all())

    def allowing(self, *left: float) -> "Problem":
        """The same problem for a simulation whose misfit is ``left`` [each signal's unit].

        If that is many times the sensor's noise, it becomes the noise. No law is right to a thousandth of a real
        robot's motion. With the sensor's noise alone the priors would not count, and small discretisation errors, a
        hundred times enlarged, would explain what physics has to; errors that are far smaller are dropped.
        Of several signals each has its own misfit: one that a model hardly explains does not silence the others.
        """
        limit = self.settings.likelihood.misfit_dominated
        dominated = [each > limit * sensor for each, sensor in zip(left, self.sensors, strict=True)]
        noises = self.sensors if any(dominated) else (0.0,) * len(dominated)
        columns = zip(left, self.sensors, dominated, strict=True)
        sigmas = [each if large else sensor for each, sensor, large in columns]
        same = replace(self, sigma=sigmas[0], noise=noises[0], others=tuple(zip(sigmas[1:], noises[1:], strict=True)))
        return same._with_basis(self.discretisation.basis * self.factor_to(same))

    def with_noise_of(self, other: "Problem") -> "Problem":
        """The same with what counts as noise in another problem of the same sensors."""
        same = replace(self, sigma=other.sigma, noise=other.noise, others=other.others)
        return same._with_basis(self.discretisation.basis * self.factor_to(same))

    def factor_to(self, other: "Problem") -> float | Floats:
        """By which residuals become those of the same problem with other noise: one factor, or (M,)."""
        if not self.others:
            return self.sigma / other.sigma
        ratios = [one / another for one, another in zip(self.sigmas, other.sigmas, strict=True)]
        return self.of_samples(self.of_columns(ratios))

    def larger_than_sensor(self, residual: Floats) -> float:
        """By how much squares of a residual (M,) are larger in units of the sensors' noise than in those of sigma."""
        ratios = [(sigma / sensor) ** 2 for sigma, sensor in zip(self.sigmas, self.sensors, strict=True)]
        if len(ratios) == 1:
            return ratios[0]
        squares = self.discretisation.without(residual) ** 2
        return float((squares * self.of_samples(self.of_columns(ratios))).sum() / max(squares.sum(), 1e-300))

    def cost(self, residual: Floats, x: Floats) -> float:
        """Minus the log posterior of unknowns x (n,) with residual (M,), up to a constant."""
        return 0.5 * float(self.discretisation.product(residual[None], residual[None])[0, 0] + x @ x)
