"""Reset-Free DROPO: a distribution over dynamics parameters from one recording, replayed open loop.

Tiboni, Protopapa, Tommasi, Averta, "Domain Randomization for Robust, Affordable and Effective Closed-loop Control of
Soft Robots", IROS 2023. The parameters are independent normals, truncated at two standard deviations; their means and
the logarithms of their standard deviations maximise the likelihood of the recording.

Two ways to find them (docs/explanation/inference.md compares), with the same objective but for the truncation, which
the second one does not see: parameters that are drawn from what it finds vary by 12 % less than it took them to:

* :func:`sampled`, the published one: CMA-ES over all 2 d numbers, each candidate judged by K replays.
* :func:`linearised`: as long as the standard deviations are small, each step's covariance is that of the linearised
  simulation, J diag(std²) Jᵀ, which takes 2 d replays instead of K for each of many candidates. A point nearby is found
  first (continuation.py); from there means and standard deviations are improved together on linearisations that are
  renewed until nothing improves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from soro_bench.arrays import Floats
from soro_bench.inference.continuation import DIFFERENCE, best_track
from soro_bench.inference.search import EvaluationLog, Residuals, SearchProgress, cma_search

SMALLEST_STD, LARGEST_STD = 1e-5, 0.25  # of the search box; the upper one as published
ROUNDS = 12


@dataclass(frozen=True)
class Fit:
    """A distribution on the unit cube of the search box.

    mean, std: (d,). jacobian: (T, k, d) there, of measured less simulated with respect to the cube.
    """

    mean: Floats
    std: Floats
    jacobian: Floats


def sampled(
    residuals: Residuals,
    deviation: Floats,
    dimension: int,
    log: EvaluationLog,
    seed: int = 0,
    iterations: int = 500,
    samples: int = 100,
    popsize: int | None = None,
    progress: SearchProgress = lambda *_: None,
) -> Fit:
    """The published search.

    Args:
        residuals: takes points (N, d) of the unit cube and a number of steps, gives measured less simulated (N, T, k).
        deviation: (T, k), of the measurement.
        dimension: d.
        log: of the costs.
        seed: of the samples and CMA-ES.
        iterations: of CMA-ES.
        samples: K replays per candidate, a quasi-random sample that is the same for all candidates.
        popsize: candidates per iteration; CMA-ES's own choice by default.
        progress: see :func:`cma_search`.
    """
    steps = len(deviation)
    quantiles = qmc.Sobol(dimension, rng=seed).random_base2((samples - 1).bit_length())[:samples]
    normal = _truncated_normal(quantiles)
    popsize = popsize or 4 + int(3 * np.log(2 * dimension))

    def cost(points: Floats, share: float) -> Floats:
        until = horizon(share, steps) if share < 1 else steps

        def costs(points: Floats) -> Floats:
            mean, std = _unpack(points)
            cloud = np.clip(mean[:, None] + std[:, None] * normal, 0, 1)
            found = residuals(cloud.reshape(-1, dimension), until).reshape(len(points), samples, until, -1)
            return np.array([-_sampled_log_likelihood(one, deviation[:until]) for one in found])

        return log(costs, points, f"{until}")

    best = cma_search(cost, 2 * dimension, iterations, popsize, seed, progress)
    mean, std = (row[0] for row in _unpack(best[None]))
    return Fit(mean, std, logged_jacobian(residuals, mean, steps, log))


def linearised(
    residuals: Residuals,
    deviation: Floats,
    groups: Sequence[slice],
    dimension: int,
    log: EvaluationLog,
    seed: int = 0,
    starts: int = 8,
    progress: SearchProgress = lambda *_: None,
) -> Fit:
    """The fast search; arguments as in :func:`sampled`.

    Args:
        groups: slices of the k measured numbers that are comparable, one per signal.
        starts: points of the search box to start from; the worse half is given up thrice on the way.
    """
    mean = best_track(residuals, deviation, groups, dimension, log, seed, starts, progress)
    return refined(residuals, deviation, mean, log)


def refined(residuals: Residuals, deviation: Floats, mean: Floats, log: EvaluationLog) -> Fit:
    """Means and standard deviations that maximise the likelihood, from a mean nearby: one linearisation after another.

    A round's new mean is accepted if the likelihood around it, linearised with the old Jacobian, is higher; otherwise
    the next one may go a quarter as far.
    """
    steps, reach, std = len(deviation), 0.1, np.full(len(mean), 1e-3)
    residual = log(lambda m: residuals(m[None], steps)[0], mean, "residual")

    def slopes(mean: Floats) -> Floats:
        """The Jacobian; 0 where it is not known."""
        found = logged_jacobian(residuals, mean, steps, log)
        return np.where(np.isfinite(found), found, 0.0)

    jacobian = slopes(mean)
    for _ in range(ROUNDS):
        shift, std = _best_gaussian(residual, jacobian, deviation, mean, std, reach)
        now = _linear_log_likelihood(residual, jacobian, std, deviation)
        candidate = np.clip(mean + shift, 0, 1)
        moved = log(lambda m: residuals(m[None], steps)[0], candidate, "residual")
        if _linear_log_likelihood(moved, jacobian, std, deviation) <= now:
            reach /= 4
            if reach < 1e-6:
                break
            continue
        mean, residual = candidate, moved
        jacobian = slopes(mean)
        if np.abs(shift).max() < 1e-7:
            break
    _, std = _best_gaussian(residual, jacobian, deviation, mean, std, 0.0)
    return Fit(mean, std, jacobian)


def _best_gaussian(
    residual: Floats, jacobian: Floats, deviation: Floats, mean: Floats, std: Floats, reach: float
) -> tuple[Floats, Floats]:
    """Shift of the mean, at most ``reach`` in each direction and inside the cube, and standard deviations."""
    free = reach > 0
    scale = max(reach, 1e-12)

    def cost(x: Floats) -> float:
        shift, log_std = scale * x[: len(mean)] * free, x[len(mean) :]
        left = residual + jacobian @ shift  # the Jacobian is that of measured less simulated
        return -_linear_log_likelihood(left, jacobian, np.exp(log_std), deviation)

    within = [(max(-1.0, -m / scale), min(1.0, (1 - m) / scale)) for m in mean]
    spread = [(np.log(SMALLEST_STD), np.log(LARGEST_STD))] * len(mean)
    # from narrow and from wide: a wide one may explain what no mean does
    starts = [np.concatenate([np.zeros(len(mean)), np.log(s)]) for s in (std, np.full(len(mean), 0.03))]
    fits = [minimize(cost, start, method="L-BFGS-B", bounds=within + spread) for start in starts]
    best = min(fits, key=lambda fit: fit.fun).x
    return scale * best[: len(mean)] * free, np.exp(best[len(mean) :])


def _linear_log_likelihood(residual: Floats, jacobian: Floats, std: Floats, deviation: Floats) -> float:
    return float(log_likelihood(residual, jacobian * std, deviation).sum())


def _sampled_log_likelihood(residuals: Floats, deviation: Floats) -> float:
    mean, factor = sample_factor(residuals)
    return float(log_likelihood(mean, factor, deviation).sum())


def jacobian_at(residuals: Residuals, mean: Floats, steps: int) -> Floats:
    """(T, k, d) derivative of the residuals, by central differences inside the unit cube; one-sided where the other end
    diverges, NaN where both do."""
    offsets = DIFFERENCE * np.eye(len(mean))
    ends = np.clip(np.concatenate([mean + offsets, mean - offsets]), 0, 1)
    found, reach = residuals(ends, steps), (ends - mean).sum(axis=1)[:, None, None]
    if not (there := np.isfinite(found)).all():
        found = np.where(there, found, residuals(mean[None], steps))
    (up, down), (right, left) = np.split(found, 2), np.split(np.where(there, reach, 0.0), 2)
    width = np.where(right > left, right - left, np.nan)
    return np.moveaxis((up - down) / width, 0, -1)


def logged_jacobian(residuals: Residuals, mean: Floats, steps: int, log: EvaluationLog) -> Floats:
    """The same by a log; in memory as it was computed, on which the last digits of its products depend."""
    found = log(lambda m: jacobian_at(residuals, m, steps), mean, "jacobian")
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(found, -1, 0)), 0, -1)


def _unpack(points: Floats) -> tuple[Floats, Floats]:
    """Means (N, d) and standard deviations (N, d) of candidates (N, 2 d) in the unit cube."""
    mean, log_std = np.split(points, 2, axis=1)
    return mean, SMALLEST_STD * (LARGEST_STD / SMALLEST_STD) ** log_std


def _truncated_normal(quantiles: Floats) -> Floats:
    """Standard normals truncated at two standard deviations, at the given quantiles."""
    return ndtri(ndtr(-2) + quantiles * (ndtr(2) - ndtr(-2)))


# --- how likely a recording is when the parameters are drawn from a distribution: a Gaussian per time step ---


def log_likelihood(residual: Floats, factor: Floats, deviation: Floats) -> Floats:
    """Logarithm of the density of the recording, per time step.

    At each step what is measured is normal about the simulated mean with covariance F Fᵀ + diag(deviation²)
    (the objective of Tiboni et al., "Domain randomization for robust, affordable and effective closed-loop control of
    soft robots", IROS 2023; there deviation² is the constant eps).

    Args:
        residual: (T, k) measured less simulated mean.
        factor: (T, k, r), F; the columns say how what is measured spreads with the parameters.
        deviation: (T, k) of the measurement.

    Returns:
        (T,); minus infinity where a residual is not finite.
    """
    finite = np.isfinite(residual).all(axis=1) & np.isfinite(factor).all(axis=(1, 2))
    result = np.full(len(residual), -np.inf)
    white = residual[finite] / deviation[finite]
    spread = factor[finite] / deviation[finite][..., None]
    square, log_det = _square_and_log_det(white, spread)
    log_det += 2 * np.log(deviation[finite]).sum(axis=1)
    result[finite] = -0.5 * (square + log_det + residual.shape[1] * np.log(2 * np.pi))
    return result


def _square_and_log_det(white: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """white·C⁻¹·white and log det C for C = I + S Sᵀ, per time step."""
    size, rank = spread.shape[1:]
    if rank >= size:
        lower = np.linalg.cholesky(np.eye(size) + spread @ spread.transpose(0, 2, 1))
        square = (np.linalg.solve(lower, white[..., None])[..., 0] ** 2).sum(axis=1)
    else:  # Woodbury: in the space of the columns
        lower = np.linalg.cholesky(np.eye(rank) + spread.transpose(0, 2, 1) @ spread)
        projected = np.linalg.solve(lower, np.einsum("tkr,tk->tr", spread, white)[..., None])[..., 0]
        square = (white**2).sum(axis=1) - (projected**2).sum(axis=1)
    return square, 2 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)


def sample_factor(samples: Floats) -> tuple[Floats, Floats]:
    """Mean (T, k) and factor (T, k, N) of the sample covariance of (N, T, k) samples."""
    mean = samples.mean(axis=0)
    return mean, np.moveaxis(samples - mean, 0, -1) / np.sqrt(len(samples) - 1)


def horizon(share: float, steps: int) -> int:
    """Time steps to look at when ``share`` of the search is done (Tiboni et al., equation for tau): it grows to 99 %
    of the recording, as errors of an open-loop replay add up and the first steps are the easiest to explain."""
    return max(1, int(steps * (1 - np.exp(-2 * np.log(10) * share))))
