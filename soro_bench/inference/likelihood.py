"""How likely a recording is when the parameters are drawn from a distribution: a Gaussian per time step."""

import numpy as np

from soro_bench.arrays import Floats


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
