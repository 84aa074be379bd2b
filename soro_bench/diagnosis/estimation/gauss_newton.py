"""Levenberg-Marquardt descent of hypotheses with slopes from differences, side by side.

For fits of real robots, which leave more than the ruggedness of the simulation. The clouds of other fits (fit.py) are
too wide where the phase of an oscillation runs away, which is linear only near a point. (Not SciPy's, which would
replay one point after the other.)
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds, normal_equations, replayed
from soro_bench.diagnosis.estimation.problem import Problem

_DIFFERENCE = 0.01  # of an unknown, for its slope, in standard deviations of its prior
# steps at most, the share of the cost by which one has to help for another one, and factors of the damping that are
# tried side by side
_STEPS, _HELPS, _FACTORS = 10, 0.003, 10.0 ** np.arange(-2.0, 4.0)


def descended(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses, each led down to where its cost is least; never worse."""
    found, damping, going = list(hypotheses), np.ones(len(hypotheses)), list(range(len(hypotheses)))
    for _ in range(_STEPS):
        lines = _with_jacobians(problem, [found[i] for i in going])
        trials = [_steps(problem, h, damping[i] * _FACTORS) for i, h in zip(going, lines, strict=True)]
        helped = []
        for i, h, rows, points in zip(going, lines, replayed(problem, lines, trials), trials, strict=True):
            costs = [problem.cost(row, x) for row, x in zip(rows, points, strict=True)]
            best = int(np.argmin(costs))
            found[i] = h
            if costs[best] < h.cost:
                found[i] = replace(h, x=points[best], residual=rows[best], cost=costs[best])
                damping[i] *= _FACTORS[best]
            if costs[best] < (1.0 - _HELPS) * h.cost:
                helped.append(i)
        if not (going := helped):
            break
    return found


def _with_jacobians(problem, hypotheses):
    """The hypotheses with slopes where they are; what those do not explain is not known."""
    groups = []
    for h in hypotheses:
        low, high = bounds(problem, h.terms)
        step = np.where(h.x + _DIFFERENCE <= high, _DIFFERENCE, -_DIFFERENCE)
        groups.append(np.clip(h.x + np.diag(step), low, high))
    found = []
    for h, rows, points in zip(hypotheses, replayed(problem, hypotheses, groups), groups, strict=True):
        jacobian = (rows - h.residual) / np.diag(points - h.x)[:, None]
        found.append(replace(h, jacobian=jacobian, error=np.zeros((0, len(h.residual)))))
    return found


def _steps(problem, h, dampings):
    """Points where the linearised cost, with some dampings of the diagonal, is least."""
    low, high = bounds(problem, h.terms)
    hessian, gradient = normal_equations(problem.discretisation, h.jacobian, h.residual, h.x)
    steps = [np.linalg.solve(hessian + d * np.diag(np.diag(hessian)), gradient) for d in dampings]
    return [np.clip(h.x - step, low, high) for step in steps]
