"""Whether recordings show a discrepancy at all: p-values of healthy robots, for predicted gains and slow residuals."""

import math
from collections.abc import Sequence

import numpy as np

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.settings import DEFAULT, ProbabilitySettings, Settings


def p_value(gain: float, settings: ProbabilitySettings = DEFAULT.probabilities) -> float:
    """Probability that one more term is predicted to gain so much where nothing is missing: a Gumbel distribution.

    Args:
        gain: log evidence [nats].
    """
    return float(-np.expm1(-np.exp(1.0 - gain / settings.healthy_gain)))


def alpha(settings: Settings = DEFAULT) -> float:
    """The p-value at which a discrepancy is as likely as none: that of the least gain that is worth a fit."""
    return p_value(settings.selection.least_gain, settings.probabilities)


def p_of(missing: float, settings: Settings) -> float:
    """The p-value at which a discrepancy is as probable as that."""
    return min(1.0, alpha(settings) * (1.0 - missing) / max(missing, 1e-300))


def p_slow(slow: float, pairs: float, settings: Settings = DEFAULT) -> float:
    """Probability that a healthy robot leaves so much slow variance.

    Args:
        slow: variance of the slow residual, in units of that of the fast one.
        pairs: number of pairs of samples that it is estimated from.
    """
    group = settings.probabilities
    limit = max(group.slow_variance, group.slow_deviations / math.sqrt(max(pairs, 1.0)))
    return min(1.0, alpha(settings) * (limit / slow) ** group.slow_power) if slow > 0 else 1.0


def slow_variance(residuals: Sequence[tuple[Problem, np.ndarray]]) -> tuple[float, float]:
    """The variance of slow residuals, in units of that of fast ones, and the number of pairs of samples behind it.

    Slow is what is still there after a lag (``ProbabilitySettings.slow_lag``), as white noise is not.

    Args:
        residuals: problems, and a residual (M,) of each.
    """
    squares, count, products, pairs = np.sum([_products(*each) for each in residuals], axis=0)
    slow = products / max(pairs, 1.0)
    return slow / max(squares / max(count, 1.0) - slow, 1e-9), pairs


def _products(problem: Problem, residual: np.ndarray) -> np.ndarray:
    """(4,) of a residual less discretisation error: sum of squares, their number, sum of products with the residual a
    lag later, and their number."""
    settings = problem.settings.probabilities
    largest, sums = problem.settings.data_quality.outlier_deviations, np.zeros(4)
    near = np.clip(problem.discretisation.without(residual), -largest, largest)
    parts = zip(problem.rows(near), problem.rows(problem.weight), problem.recordings, strict=True)
    for part, weight, recording in parts:
        sampled = weight.any(axis=1)
        part, weight, time = part[sampled], weight[sampled], recording.time[sampled]
        lag = math.ceil(settings.slow_lag / float(np.median(np.diff(time))) - 1e-6)
        later = (part[lag:] * part[:-lag]).sum(), (weight[lag:] * weight[:-lag]).sum()
        sums += [(part**2).sum(), weight.sum(), *later]
    return sums
