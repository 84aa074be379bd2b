"""Model-form error: how far simulators of one robot are apart, beyond the differences that can be computed.

The discretisation error spans the differences between the simulators at hand (discretisation.py). Another simulator
of the same robot, or the robot, differs from them by more. That error is slow and smooth, and no larger than the
simulators are apart: a model discrepancy of bounded size (Kennedy, O'Hagan, "Bayesian calibration of computer models",
2001). White noise of the sensor is in all frequencies and spatial modes of a residual, so what is above the noise in
some of them is such an error, or physics.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct
from scipy.linalg import orth
from scipy.special import expit, logit

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals, unlike
from soro_bench.diagnosis.estimation.problem import Points, Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings.estimation import DiscretisationSettings

_MODES = 8  # spatial modes that have variances of their own; the rest shares one
_NOTHING = 1e-100  # nats
_LARGEST_SHARE = 0.99  # of what all laws explain; a fit may explain more than first-order predictions of all of them
_WITH_VARIANTS = 2  # hypotheses, the nominal robot and the best one, that other simulations are compared at


@dataclass(frozen=True)
class Spectrum:
    """Mean squares of a residual in blocks of frequencies and spatial modes.

    power: (K,) in variances of the sensor's noise. count: (K,) numbers in each block.
    """

    power: Floats
    count: Floats

    @property
    def excess(self) -> float:
        """Standard deviation above the noise, in its standard deviations."""
        above = np.maximum(self.power - 1.0, 0.0)
        return float(np.sqrt(self.count @ above / self.count.sum()))


def spectrum(problem: Problem, residual: Floats) -> Spectrum:
    """The spectrum of a residual (M,), less its discretisation error, of all recordings."""
    noises = [sigma / sensor for sigma, sensor in zip(problem.sigmas, problem.sensors, strict=True)]
    left = problem.discretisation.without(residual) * problem.of_samples(problem.of_columns(noises))
    powers, counts = [], []
    parts = zip(problem.rows(left), problem.rows(problem.weight), problem.rows(problem.measured), strict=True)
    for part, weight, measured in parts:
        waves = dct(part @ _modes(measured), axis=0, norm="ortho") ** 2
        share = max(float(weight.mean()), 1e-9)  # of the samples; the others are 0
        for low, high in _octaves(len(part)):
            for block in (*waves[low:high, :_MODES].T, waves[low:high, _MODES:]):
                if block.size:
                    powers.append(float(block.mean()) / share)
                    counts.append(block.size * share)
    return Spectrum(np.array(powers), np.array(counts))


@dataclass(frozen=True)
class UnderModelForm:
    """Hypotheses where the rest may be model-form error, the nominal robot first.

    squares: (H,) of what each leaves above the noise, summed over samples, in variances of the noise. count: number of
    samples. bound: largest rms of such an error, in standard deviations of the noise.
    """

    squares: Floats
    count: float
    bound: float

    @classmethod
    def of(cls, problem: Problem, residuals: Iterable[Floats]) -> "UnderModelForm":
        """Of the residuals (M,) of all hypotheses."""
        found = [spectrum(problem, residual) for residual in residuals]
        count = float(found[0].count.sum())
        return cls(count * np.array([each.excess**2 for each in found]), count, problem.model_form / problem.sensor)

    def beside(self, other: "UnderModelForm") -> "UnderModelForm":
        """Of both recordings; how far simulators are apart depends on the motion, so each has a bound of its own."""
        count = self.count + other.count
        bound = np.sqrt((self.count * self.bound**2 + other.count * other.bound**2) / max(count, 1.0))
        return UnderModelForm(self.squares + other.squares, count, float(bound))

    @property
    def left(self) -> Floats:
        """(H,) rms of what each leaves above the noise, in standard deviations of the noise."""
        return np.sqrt(self.squares / max(self.count, 1.0))

    @property
    def possible(self) -> Bools:
        """(H,) whether that may be model-form error."""
        return self.left <= self.bound

    def missing(self, gains: Floats, of_all: float, settings: DiscretisationSettings) -> Floats:
        """(H,) probability of each law that it is missing, where the rest may be model-form error.

        Such an error looks a little like many laws: all of them together explain much of it, and none of them much
        more than the others. One law that is missing explains most of what all do. How often either is so was counted
        on healthy robots of other simulators and on hidden effects (``benchmarks/other_simulators.py``).

        Args:
            gains: (H,) in log evidence, or less misfit, by each law [nats].
            of_all: misfit that all laws explain together [nats].
        """
        gains = np.maximum(gains, _NOTHING)
        share = np.minimum(gains / max(of_all, _NOTHING), _LARGEST_SHARE)
        largest = max(0.5 * self.count * self.bound**2, _NOTHING)
        log_odds = np.log(gains / settings.model_form_gain) - np.log(largest) + logit(share)
        return np.asarray(expit(settings.model_form_power * log_odds), float)


def largest_model_form_error(problem: Problem, slopes: Floats) -> float:
    """How large a model-form error may be, rms [signal's unit]: a share of how far the simulators at hand are apart.

    Args:
        problem: with the discretisation errors of the nominal robot; what a recording's time stamps or first sample may
            be off is no difference between simulators.
        slopes: (d, M) of its residual. What parameters can change is no such difference either.
    """
    basis, directions = problem.discretisation.basis[problem.of_recordings :], orth(slopes.T)
    apart = basis - (basis @ directions) @ directions.T
    size = np.sqrt((apart**2).sum() / max(len(basis), 1) / max(problem.weight.sum(), 1.0))
    return problem.settings.discretisation.model_form_share * problem.sigma * float(size)


def may_be_model_form(problem: Problem, residual: Floats, slopes: Floats) -> bool:
    """Whether what the nominal robot leaves may be model-form error, of the size that the problem has or that its
    discretisation errors give. Without other simulations these are of time steps only, and of chaotic motion large.

    Args:
        residual: (M,) of the nominal robot. slopes: (d, M) of it.
    """
    if not problem.variants:
        return False
    bound = problem.model_form or largest_model_form_error(problem, slopes)
    return bool(UnderModelForm.of(replace(problem, model_form=bound), [residual]).possible[0])


def unfitted_under_model_form(problem: Problem, refined: Sequence[Robot], points: Points) -> tuple[Problem, Floats]:
    """Recordings that nothing was fitted to, with the discretisation and model-form error of their own motion.

    Args:
        refined: more accurate robots, that are replayed at the first of the points.
        points: hypotheses, the nominal robot first, then the best one.

    Returns:
        The problem, and residuals (H, M) at the points.
    """
    (x, terms), d = points[0], problem.parameters
    computed = [*points[:1], *unlike(points[1:])[: problem.settings.selection.discretisations]]
    step = problem.settings.selection.nominal_radius_last * np.eye(d, len(x))
    around: Points = [(x + each, terms) for each in (*step, *-step)]
    compared = [x for x, _ in points[:_WITH_VARIANTS]]
    error, rows = discretisation_and_residuals(problem, refined, computed, [*points, *around], compared)
    problem = problem.with_discretisation(error)
    after, before = np.split(rows[len(points) :], 2)
    return replace(problem, model_form=largest_model_form_error(problem, after - before)), rows[: len(points)]


def _modes(measured: Floats) -> Floats:
    """(C, C) orthonormal directions of the numbers of a sample (T, C), those that move most first."""
    seen = np.isfinite(measured)
    mean = np.where(seen, measured, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    few = len(measured) < measured.shape[1]  # samples span no more directions than there are of them
    return np.asarray(np.linalg.svd(np.where(seen, measured - mean, 0.0), full_matrices=few)[2].T, float)


def _octaves(count: int) -> Iterator[tuple[int, int]]:
    """First and last index, exclusive, of the octaves of so many frequencies."""
    low, high = 0, 1
    while low < count:
        yield low, min(high, count)
        low, high = high, 2 * high
