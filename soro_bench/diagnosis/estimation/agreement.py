"""Whether several recordings agree: the unknowns of a joint fit, fitted to each recording alone.

A structure that is right has the same parameters in every recording, but for chance. A wrong one makes up for what it
lacks with parameters that depend on the motion (parameter constancy as a test of a model's structure; Ljung, "System
Identification", 1999, section 16.6).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, allowing, descended, fitted, with_covariance
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.result_parts import NINETY
from soro_bench.inference.statistical_linearisation import LowRank


@dataclass(frozen=True)
class Alone:
    """The fit of one recording, and its problem."""

    problem: Problem
    hypothesis: Hypothesis


@dataclass(frozen=True)
class Difference:
    """How far an unknown is from recording to recording.

    p_value: of a larger difference between any two recordings by chance, corrected for the number of pairs and unknowns
    that are compared (Bonferroni). overlap: whether the 90 % intervals of all pairs do.
    """

    p_value: float
    overlap: bool

    def is_change(self, alpha: float) -> bool:
        """Whether a difference is none by chance.

        Args:
            alpha: chance of any difference that is called a change, of all that are compared.
        """
        return self.p_value < alpha and not self.overlap


def fitted_alone(problem: Problem, joint: Hypothesis, seed: int) -> list[Alone]:
    """The unknowns of a joint fit, fitted to each recording alone from there by Gauss-Newton steps; the discretisation
    error is that of the joint problem, and the joint fit stays where no step lowers the cost."""
    ends = np.cumsum([0, *(part.size for part in problem.rows(problem.weight))])
    bounds = itertools.pairwise(ends.tolist())
    return [_fitted(*_of_one(problem, joint, k, slice(*pair)), seed) for k, pair in enumerate(bounds)]


def _of_one(problem: Problem, joint: Hypothesis, k: int, part: slice) -> tuple[Problem, Hypothesis]:
    """The problem of recording k, whose samples are ``part`` of all, and the joint fit as a hypothesis of it."""
    error = LowRank(problem.discretisation.basis[:, part])
    one = replace(problem, recordings=(problem.recordings[k],), weight=problem.weight[part], discretisation=error)
    residual = joint.residual[part]
    cost = one.cost(residual, joint.x)
    return one, Hypothesis(joint.terms, joint.x, residual, cost, joint.jacobian[:, part], joint.error[:, part])


def _fitted(problem: Problem, joint: Hypothesis, seed: int) -> Alone:
    settings = problem.settings.selection
    radii = settings.fit_radius, settings.fit_radius, settings.fit_radius_last
    if problem.misfit_dominated:
        (found,) = descended(problem, [joint])
    else:
        (found,) = fitted(problem, [Guess(joint.x, joint.terms, joint.jacobian)], radii, seed)
    problem, (found,) = allowing(problem, best := min(found, joint, key=lambda h: h.cost), [best])
    return Alone(problem, with_covariance(problem, found, seed))


def difference(values: Sequence[float], spreads: Sequence[float], compared: int) -> Difference:
    """How far apart values with independent normal errors are.

    Args:
        values: (K,) of an unknown, one of each recording.
        spreads: (K,) their standard deviations.
        compared: number of unknowns that are looked at.
    """
    pairs = list(itertools.combinations(zip(values, spreads, strict=True), 2))
    apart = [(abs(a - b), s, t) for (a, s), (b, t) in pairs]
    largest = max((gap / math.hypot(s, t) for gap, s, t in apart), default=0.0)
    chance = math.erfc(largest / math.sqrt(2.0)) * len(pairs) * compared
    return Difference(min(1.0, chance), all(gap <= NINETY * (s + t) for gap, s, t in apart))


def together(found: Sequence[Alone], deviations: Sequence[Floats]) -> list[Difference]:
    """The difference of each unknown.

    Args:
        deviations: (n,) standard deviations of the unknowns of each recording.
    """
    x = np.array([each.hypothesis.x for each in found])
    spread = np.array(deviations)
    return [difference(x[:, i].tolist(), spread[:, i].tolist(), x.shape[1]) for i in range(x.shape[1])]
