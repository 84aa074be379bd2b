"""How well the unknowns of a fit are known, from replays all over its own posterior.

The slopes of a descent are those at a point, to a hundredth of a prior's deviation. Where things stick or touch,
replays jump there, and what jumps looks like knowledge: of four parameters of which only ratios count one was known to
1 %, and was off by 13 % (benchmarks/interval_coverage.py counts such). Clouds of points as wide as the posterior say
what changes over that width, and what they leave is an error that counts (statistical linearisation, iterated;
García-Fernández et al., "Posterior linearization filter", 2015). They begin wide, as a narrow cloud sees only jumps.
"""

from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.inference.statistical_linearisation import linearised, sample_around

# standard deviations of the first cloud: in those of the priors, and a share of a magnitude, which is known to be there
_WIDE, _SHARE = 0.3, 0.3
_ROUNDS, _POINTS, _EACH = 4, 64, 4  # clouds, and points of one: at least, and for each unknown


def with_covariance(problem: Problem, hypothesis: Hypothesis, seed: int) -> Hypothesis:
    """The hypothesis with the covariance of its unknowns, if it has one of slopes at a point."""
    if len(hypothesis.error):
        return hypothesis
    x, terms, n = hypothesis.x, hypothesis.terms, len(hypothesis.x)
    low, high = bounds(problem, terms)
    root = np.diag(_begin(problem, hypothesis))
    for k in range(_ROUNDS):
        normal = sample_around(np.zeros(n), 1.0, max(_POINTS, _EACH * n), [seed, k])
        points = np.clip(x + normal @ root.T, low, high)
        rows = problem.residuals([(point, terms) for point in points])
        inverse = np.linalg.inv(root)
        line = linearised(np.zeros(n), (points - x) @ inverse.T, rows)
        there = replace(hypothesis, jacobian=inverse.T @ line.jacobian, error=line.error)
        covariance = there.covariance(problem)
        root = np.linalg.cholesky(covariance)
    return replace(hypothesis, known=covariance)


def _begin(problem, hypothesis) -> np.ndarray:
    """(n,) standard deviations of the first cloud."""
    magnitudes = np.array([*[False] * problem.parameters, *(m for s in hypothesis.terms for m in s.magnitudes)])
    small = np.clip(_SHARE * np.abs(hypothesis.x), 1e-6, _WIDE)
    return np.where(magnitudes, small, _WIDE)
