"""Levenberg-Marquardt descent of hypotheses with Jacobians from differences, side by side.

It serves fits of real robots, whose misfit is larger than the ruggedness of the simulation. The samples of other fits
(fit.py) are too wide where the phase of an oscillation runs away: that is linear near a point only. SciPy's method
would replay one point after the other.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds, normal_equations, replayed
from soro_bench.diagnosis.estimation.problem import Problem

_POWERS = 10.0 ** np.arange(6.0)  # of the damping, tried side by side


def descended(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, each at the local minimum of its cost; none is worse than before."""
    settings = problem.settings.descent
    factors = settings.smallest_damping * _POWERS
    found, damping = list(hypotheses), np.ones(len(hypotheses))
    going = [i for i, h in enumerate(hypotheses) if len(h.x)]
    for _ in range(settings.steps if going else 0):
        lines = _with_jacobians(problem, [found[i] for i in going])
        trials = [_steps(problem, h, damping[i] * factors) for i, h in zip(going, lines, strict=True)]
        improved = []
        for i, h, rows, points in zip(going, lines, replayed(problem, lines, trials), trials, strict=True):
            costs = [problem.cost(row, x) for row, x in zip(rows, points, strict=True)]
            best = int(np.argmin(costs))
            found[i] = h
            if costs[best] < h.cost:
                found[i] = replace(h, x=points[best], residual=rows[best], cost=costs[best])
                damping[i] *= factors[best]
            if costs[best] < (1.0 - settings.least_gain) * h.cost:
                improved.append(i)
        if not (going := improved):
            break
    return found


def _with_jacobians(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses with Jacobians at their points, by one-sided differences; linearisation error is unknown."""
    difference = problem.settings.descent.difference
    groups = []
    for h in hypotheses:
        low, high = bounds(problem, h.terms)
        step = np.where(h.x + difference <= high, difference, -difference)
        groups.append(np.clip(h.x + np.diag(step), low, high))
    found = []
    for h, rows, points in zip(hypotheses, replayed(problem, hypotheses, groups), groups, strict=True):
        jacobian = (rows - h.residual) / np.diag(points - h.x)[:, None]
        found.append(replace(h, jacobian=jacobian, error=np.zeros((0, len(h.residual)))))
    return found


def _steps(problem: Problem, h: Hypothesis, dampings: Floats) -> list[Floats]:
    """Points (n,) of least linearised cost, one for each damping (K,) of the Hessian's diagonal."""
    low, high = bounds(problem, h.terms)
    hessian, gradient = normal_equations(problem.discretisation, h.jacobian, h.residual, h.x)
    steps = [np.linalg.solve(hessian + d * np.diag(np.diag(hessian)), gradient) for d in dampings]
    return [np.clip(h.x - step, low, high) for step in steps]
