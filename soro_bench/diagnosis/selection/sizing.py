"""Typical magnitudes that suit the recordings, where those of the catalogue would move the robot far too much.

A typical magnitude is a share of what the robot's actuators can do, or of its weight. A pendulum that swings for a
minute has a friction of a hundredth of that. Its response to ten times its friction says nothing of the friction.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.screening import responses


def sized(problem: Problem, nominal: Hypothesis, candidates: Sequence[Term], robot: Robot) -> list[Term]:
    """The candidates, with smaller typical magnitudes where their responses are far larger than the misfit.

    Only of fits that leave more than the sensor's noise: without a misfit there is no magnitude to look for, and what
    would just be seen is said for the catalogue's.

    Args:
        nominal: the fit without a term.
        robot: that is simulated.
    """
    settings, found = problem.settings.screening, list(candidates)
    if not problem.misfit_dominated:
        return found
    misfit, tried = float(np.linalg.norm(nominal.residual)), list(range(len(found)))
    for _ in range(problem.settings.selection.turns):
        largest = dict(zip(tried, _largest(problem, nominal, [found[i] for i in tried], robot), strict=True))
        tried = [i for i in tried if largest[i] > settings.largest_response * misfit]
        for i in tried:
            found[i] = smaller(found[i], misfit / largest[i])
        if not tried:
            break
    return found


def _largest(problem: Problem, nominal: Hypothesis, candidates: Sequence[Term], robot: Robot) -> list[float]:
    """Norm of the largest response of each candidate to one of its typical magnitudes [noise deviations]."""
    found = []
    for term, rows in zip(candidates, responses(problem, nominal, candidates, robot), strict=True):
        sizes = np.abs(term.simulated[list(term.magnitudes)])
        found.append(float((np.linalg.norm(rows, axis=1) * sizes).max()))
    return [max(most, 1e-12) for most in found]


def smaller(term: Term, share: float) -> Term:
    """The same term with a share of its typical magnitudes; what shapes its response stays."""
    columns = zip(term.quantities, term.typical, term.magnitudes, strict=True)
    values = (q.null + share * (value - q.null) if magnitude else value for q, value, magnitude in columns)
    return replace(term, typical=tuple(values))
