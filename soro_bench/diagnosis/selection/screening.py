"""Screening: how much of what is left would each effect explain?

Each suspect is simulated once at a typical magnitude. The response, less what a change of parameters or numerical error
would do too, is compared with the residual: a linear estimate of its magnitude and of the evidence gained.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import DIVERGED, Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect


@dataclass(frozen=True)
class ScreenedCandidate:
    """Suspects that explain some of what a hypothesis leaves.

    suspects: of the hypothesis, and those to be added. gain: log evidence gained. x: (n,) estimate of all unknowns.
    chosen: which candidates these are.
    """

    terms: tuple[Term, ...]
    gain: float
    x: np.ndarray
    chosen: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Sorted names of the suspects."""
        return tuple(sorted(s.name for s in self.terms))

    @property
    def effects(self) -> list[Effect]:
        """The suspects as estimated."""
        return effects_at(self.x[len(self.x) - sum(s.size for s in self.terms) :], self.terms)


@dataclass(frozen=True)
class Evidence:
    """What K response rows say together, parameters and floor marginalised: the evidence gained by magnitudes m (K,) is
    -pull m - m matrix m / 2. ``bounds`` (2, K) of them, and ``blocks`` are the rows of each candidate. With magnitudes
    m the best unknowns of the hypothesis move by step - shift m, where step is (n,) and shift (n, K)."""

    base: Hypothesis
    candidates: tuple[Term, ...]
    responses: Sequence[np.ndarray]
    matrix: np.ndarray
    pull: np.ndarray
    bounds: np.ndarray
    blocks: tuple[np.ndarray, ...]
    step: np.ndarray
    shift: np.ndarray

    def screened_candidate(self, chosen: Sequence[int]) -> ScreenedCandidate:
        """The best magnitudes of some candidates together."""
        rows = np.concatenate([self.blocks[i] for i in chosen])
        matrix, pull, bounds = self.matrix[np.ix_(rows, rows)], self.pull[rows], self.bounds[:, rows]
        at, free = np.zeros(len(rows)), np.ones(len(rows), bool)
        for _ in rows:  # what would cross its bound stays there, and the rest is solved again
            rest = pull[free] + matrix[np.ix_(free, ~free)] @ at[~free]
            at[free] = -np.linalg.solve(matrix[np.ix_(free, free)], rest)
            inside = np.clip(at, *bounds)
            crossing = inside != at
            if not crossing.any():
                break
            free &= ~crossing
            at = inside
        gain = -float(pull @ at + 0.5 * at @ matrix @ at) - 0.5 * float(np.linalg.slogdet(matrix)[1])
        x = self.base.x + np.clip(self.step - self.shift[:, rows] @ at, -1, 1)
        ends = np.cumsum([len(self.blocks[i]) for i in chosen])[:-1]
        added = [self.candidates[i] for i in chosen]
        parts = [_coordinates(s, part) for s, part in zip(added, np.split(at, ends), strict=True)]
        return ScreenedCandidate((*self.base.terms, *added), gain, np.concatenate([x, *parts]), tuple(chosen))

    def guess(self, screened_candidate: ScreenedCandidate) -> Guess:
        """Where to begin a fit: what shapes a response without being its magnitude has no slope yet."""
        jacobian = [self.base.jacobian]
        for i in screened_candidate.chosen:
            rows = np.zeros((self.candidates[i].size, self.base.jacobian.shape[1]))
            rows[list(self.candidates[i].magnitudes)] = self.responses[i]
            jacobian.append(rows)
        return Guess(screened_candidate.x, screened_candidate.terms, np.concatenate(jacobian))

    def detectable(self, gain: float) -> tuple[tuple[Term, float], ...]:
        """Of each candidate, the coordinate of its first magnitude that gains as much if nothing else is missing."""
        rows = np.array([block[0] for block in self.blocks])
        information = np.maximum(np.diag(self.matrix)[rows] - 1.0, 1e-12)
        return tuple(zip(self.candidates, np.sqrt(2.0 * gain / information).tolist(), strict=True))


def responses(problem: Problem, base: Hypothesis, candidates: Sequence[Term], robot: Robot) -> list[np.ndarray]:
    """(k, M) of each suspect: change of the residual of ``robot`` per standard deviation of each of its k magnitudes.

    These are differences of two replays, which a simulation with longer time steps than the fitted one gives as well.
    """
    points, shares = [], []
    for candidate in candidates:
        for column in np.flatnonzero(candidate.magnitudes):
            x = np.where(np.arange(candidate.size) == column, candidate.simulated, 0.0)
            points.append((np.concatenate([base.x, x]), (*base.terms, candidate)))
            shares.append(x[column])
    without, *simulated = problem.simulated(robot, [(base.x, base.terms), *points])
    found = (without - np.array(simulated)) / problem.sigma * problem.weight / np.array(shares)[:, None]
    found = np.nan_to_num(found, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
    ends = np.cumsum([sum(c.magnitudes) for c in candidates])
    return np.split(found, ends[:-1])


def evidence(problem: Problem, base: Hypothesis, candidates: Sequence[Term], found) -> Evidence:
    """What the responses ``found`` of the candidates say about the residual of a hypothesis."""
    discretisation, rows = base.discretisation(problem), np.concatenate(found)
    hessian, gradient = normal_equations(discretisation, base.jacobian, base.residual, base.x)
    cross = discretisation.product(rows, base.jacobian)
    shift, step = np.linalg.solve(hessian, cross.T), -np.linalg.solve(hessian, gradient)
    return Evidence(
        base,
        tuple(candidates),
        found,
        discretisation.product(rows, rows) + np.eye(len(rows)) - cross @ shift,
        discretisation.product(rows, base.residual[None])[:, 0] + cross @ step,
        np.concatenate([c.bounds[:, list(c.magnitudes)] for c in candidates], axis=1),
        tuple(np.split(np.arange(len(rows)), np.cumsum([len(each) for each in found])[:-1])),
        step,
        shift,
    )


def singles(found: Evidence) -> list[ScreenedCandidate]:
    """One candidate at a time, the best first."""
    return sorted(
        (found.screened_candidate([i]) for i in range(len(found.candidates))),
        key=lambda screened_candidate: -screened_candidate.gain,
    )


def pairs(found: Evidence, firsts: int = 20) -> list[ScreenedCandidate]:
    """Two candidates at a time, the best first: each of the best singles with every other one."""
    gains = [found.screened_candidate([i]).gain for i in range(len(found.candidates))]
    order = np.argsort(gains)[::-1]
    screened_candidates = [
        found.screened_candidate([i, j]) for n, i in enumerate(order[:firsts]) for j in order[n + 1 :]
    ]
    return sorted(screened_candidates, key=lambda screened_candidate: -screened_candidate.gain)


def _coordinates(candidate, magnitudes):
    x = np.zeros(candidate.size)
    x[list(candidate.magnitudes)] = magnitudes
    return x
