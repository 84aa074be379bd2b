"""Linear models of a rugged simulation, by regression over sampled points.

A cable robot's motion is rugged in its parameters: cables fall slack, things are hit, and the derivative at a point
says little about the next percent. A regression over a cloud does (statistical linearisation), and what it leaves is an
error of the linear model that a step has to allow for: a covariance of low rank. The cloud shrinks as the fit improves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import qmc

LENGTHS = (0.5, 1.0, 1.5)  # of a step, tried
MOST = 3.0  # standard deviations of what a basis explains, rms of its coefficients
RIDGE, FREE = 1.0, 0.05  # observations that a slope is worth which is known beforehand, or not


class LowRank:
    """Products with the inverse of the covariance I + Bᵀ B of whitened residuals; the basis B is (F, M)."""

    def __init__(self, basis: np.ndarray):
        self.basis = basis
        self._inner = np.eye(len(basis)) + basis @ basis.T

    def product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(A, C) of rows a (A, M) and b (C, M)."""
        if not len(self.basis):
            return a @ b.T
        return a @ b.T - (a @ self.basis.T) @ np.linalg.solve(self._inner, self.basis @ b.T)

    def without(self, residual: np.ndarray) -> np.ndarray:
        """(M,) what the basis does not explain with coefficients that are possible: of a residual that is far larger,
        it could take up most of what looks like it only if it were many times enlarged."""
        if not len(self.basis):
            return residual
        return residual - self._coefficients(self.basis @ residual) @ self.basis

    def _coefficients(self, products: np.ndarray) -> np.ndarray:
        """(F,) the most probable coefficients, or the best ones of those that are as large as is possible.

        Args:
            products: (F,) of the basis with a residual.
        """
        found, most = np.linalg.solve(self._inner, products), MOST * np.sqrt(len(products))
        if np.linalg.norm(found) <= most:
            return found
        squares, directions = np.linalg.eigh(self._inner)
        along = directions.T @ products

        def excess(ridge: float) -> float:
            return float(np.linalg.norm(along / (squares + ridge))) - most

        # not scaled ones: of rows that are almost equal the difference has large ones, and all would be scaled by these
        ridge = brentq(excess, 0.0, np.linalg.norm(along) / most) if excess(0.0) > 0 else 0.0
        return np.asarray(directions @ (along / (squares + ridge)))


@dataclass(frozen=True)
class Line:
    """A linear model around a point: residual (M,) there, slope (n, M), and a basis (N, M) of its error."""

    residual: np.ndarray
    jacobian: np.ndarray
    error: np.ndarray


def sample_around(x: np.ndarray, scale: float, count: int, seed: Sequence[int]) -> np.ndarray:
    """(count, n) points around x, a quasi-random sample of a normal distribution of standard deviation ``scale``."""
    if not len(x):  # nothing is unknown
        return np.zeros((count, 0))
    engine = qmc.Halton(len(x), rng=np.random.default_rng(seed))
    normal = qmc.MultivariateNormalQMC(np.zeros(len(x)), engine=engine, inv_transform=True)
    return x + scale * np.clip(normal.random(count), -3, 3)


def linearised(x: np.ndarray, points: np.ndarray, residuals: np.ndarray, jacobian: np.ndarray | None = None) -> Line:
    """The linear regression of residuals (N, M) at points (N, n) around x.

    A ``jacobian`` (n, M) that is known beforehand is changed only as far as the points speak against it (ridge
    regression), and there may be fewer of them than unknowns. A null row of it stands for one that is not known.
    """
    scale = np.sqrt(((points - x) ** 2).mean()) if len(x) else 1.0
    design, ridge = np.column_stack([np.ones(len(points)), (points - x) / scale]), np.zeros(1 + len(x))
    if jacobian is None:
        jacobian = np.zeros((len(x), residuals.shape[1]))
    else:
        ridge[1:] = np.where(jacobian.any(axis=1), RIDGE, FREE)
    rest = residuals - (points - x) @ jacobian
    hat = np.linalg.solve(design.T @ design + np.diag(ridge), design.T)
    coefficients = hat @ rest
    freedom = len(points) - np.trace(design @ hat)
    error = (rest - design @ coefficients) / np.sqrt(freedom)
    return Line(coefficients[0], jacobian + coefficients[1:] / scale, error)
