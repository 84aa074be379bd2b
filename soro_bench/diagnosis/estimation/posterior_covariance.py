"""Posterior covariance of a fit, from replays as wide as its own posterior.

The Jacobian of a descent holds at a point, to a hundredth of a prior's deviation. Where things stick or touch, replays
jump there, and a jump looks like knowledge: of four parameters of which only ratios count, one had a deviation of 1 %
and was off by 13 % (benchmarks/interval_coverage.py counts these). Samples as wide as the posterior show what changes
over its width, and the linearisation error counts (iterated statistical linearisation; García-Fernández et al.,
"Posterior linearization filter", 2015). The first samples are wide, since narrow ones see jumps only.
"""

from dataclasses import replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.inference.statistical_linearisation import linearised, sample_around

_LEAST_WIDTH = 1e-6  # prior deviations; keeps the first samples apart


def with_covariance(problem: Problem, hypothesis: Hypothesis, seed: int) -> Hypothesis:
    """The hypothesis with its posterior covariance; unchanged if its fit had samples, which give one, or if it
    has no unknown."""
    if len(hypothesis.error) or not len(hypothesis.x):
        return hypothesis
    settings = problem.settings.covariance
    x, terms, n = hypothesis.x, hypothesis.terms, len(hypothesis.x)
    low, high = bounds(problem, terms)
    root = np.diag(_first_widths(problem, hypothesis))
    for k in range(settings.rounds):
        normal = sample_around(np.zeros(n), 1.0, max(settings.samples, settings.samples_per_unknown * n), [seed, k])
        points = np.clip(x + normal @ root.T, low, high)
        rows = problem.residuals([(point, terms) for point in points])
        inverse = np.linalg.inv(root)
        line = linearised(np.zeros(n), (points - x) @ inverse.T, rows)
        there = replace(hypothesis, jacobian=inverse.T @ line.jacobian, error=line.error)
        covariance = there.covariance(problem)
        root = np.asarray(np.linalg.cholesky(covariance), float)
    return replace(hypothesis, known=covariance)


def _first_widths(problem: Problem, hypothesis: Hypothesis) -> Floats:
    """(n,) standard deviations of the first samples."""
    settings = problem.settings.covariance
    magnitudes = np.array([*[False] * problem.parameters, *(m for s in hypothesis.terms for m in s.magnitudes)])
    small = np.clip(settings.magnitude_share * np.abs(hypothesis.x), _LEAST_WIDTH, settings.parameter_width)
    return np.where(magnitudes, small, settings.parameter_width)
