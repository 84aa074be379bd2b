"""Screening: how much of the misfit would each candidate term explain?

Each term is simulated once at a typical magnitude. Its response is compared with the residual, less what parameters or
discretisation error can change as well. That is a linear estimate of its magnitude and of the log evidence it gains.

Some terms have a response before they are simulated: that beside another hypothesis, or that of a law that looks alike.
They are simulated only where that predicts some gain.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis import spread_terms
from soro_bench.diagnosis.candidates import Term, effects_at
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import Problem, finite
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import ScreeningSettings
from soro_bench.diagnosis.spread_terms import SpreadTerm, spread
from soro_bench.effects.catalogue import CATEGORIES, PHYSICS
from soro_bench.effects.effect import Effect, Location


@dataclass(frozen=True)
class ScreenedCandidate:
    """Terms that explain some of the misfit of a hypothesis, to first order.

    terms: of the hypothesis, and those to be added. gain: predicted gain in log evidence. x: (n,) estimate of all
    unknowns. chosen: indices of the added terms among the candidates.
    """

    terms: tuple[Term, ...]
    gain: float
    x: np.ndarray
    chosen: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Sorted names of the terms."""
        return tuple(sorted(term.name for term in self.terms))

    @property
    def effects(self) -> list[Effect]:
        """The terms as estimated."""
        return effects_at(self.x[len(self.x) - sum(term.size for term in self.terms) :], self.terms)


@dataclass(frozen=True)
class Evidence:
    """What the responses of all candidates say together, with parameters and discretisation error marginalised.

    Magnitudes m (K,) gain the log evidence -pull m - m matrix m / 2, and the best unknowns of the hypothesis move by
    step - shift m.

    base: the hypothesis. responses: (k, M) of each candidate. matrix: (K, K). pull: (K,). bounds: (2, K) of the
    magnitudes. blocks: which of the K magnitudes each candidate has. step: (n,). shift: (n, K). simulated: candidates
    whose responses were, beside this hypothesis or one that hardly differs.
    """

    base: Hypothesis
    candidates: tuple[Term, ...]
    responses: Sequence[np.ndarray]
    matrix: np.ndarray
    pull: np.ndarray
    bounds: np.ndarray
    blocks: tuple[np.ndarray, ...]
    step: np.ndarray
    shift: np.ndarray
    settings: ScreeningSettings
    simulated: frozenset[Term] = frozenset()

    @property
    def of_all(self) -> float:
        """Misfit that all candidates explain together, whatever the signs of their magnitudes [nats]."""
        return 0.5 * float(self.pull @ np.linalg.solve(self.matrix, self.pull))

    def screened_candidate(self, chosen: Sequence[int]) -> ScreenedCandidate:
        """The best magnitudes of some candidates together."""
        rows = np.concatenate([self.blocks[i] for i in chosen])
        magnitudes, gain = _best(self.matrix[np.ix_(rows, rows)], self.pull[rows], self.bounds[:, rows])
        x = self._parameters(self.shift[:, rows] @ magnitudes)
        ends = np.cumsum([len(self.blocks[i]) for i in chosen])[:-1]
        added = [self.candidates[i] for i in chosen]
        parts = [_coordinates(term, part) for term, part in zip(added, np.split(magnitudes, ends), strict=True)]
        return ScreenedCandidate((*self.base.terms, *added), gain, np.concatenate([x, *parts]), tuple(chosen))

    def at_each(self, term: SpreadTerm) -> ScreenedCandidate:
        """The best magnitudes of a law at several elements together, whose own terms are all candidates."""
        chosen = self._chosen(term)
        rows, mixing = np.concatenate([self.blocks[i] for i in chosen]), term.mixing
        alone = self.matrix[np.ix_(rows, rows)] - np.eye(len(rows))  # without the priors of the members
        matrix = mixing @ alone @ mixing.T + np.eye(len(mixing))
        magnitudes, gain = _best(matrix, mixing @ self.pull[rows], term.bounds[:, : len(mixing)])
        x = self._parameters(self.shift[:, rows] @ (magnitudes @ mixing))
        coordinates = np.concatenate([magnitudes, np.zeros(term.size - len(magnitudes))])
        return ScreenedCandidate((*self.base.terms, term), gain, np.concatenate([x, coordinates]), chosen)

    def _parameters(self, moved: np.ndarray) -> np.ndarray:
        """(n,) unknowns of the hypothesis beside added terms that move them by -``moved`` (n,)."""
        largest = self.settings.largest_step
        return self.base.x + np.clip(self.step - moved, -largest, largest)

    def _chosen(self, term: SpreadTerm) -> tuple[int, ...]:
        """Indices of the members of a term among the candidates."""
        return tuple(self.candidates.index(member) for member in term.members)

    def guess(self, candidate: ScreenedCandidate) -> Guess:
        """Where to begin a fit. Unknowns that only shape a response have no column of the Jacobian yet."""
        jacobian = [self.base.jacobian]
        for term in candidate.terms[len(self.base.terms) :]:
            rows = np.zeros((term.size, self.base.jacobian.shape[1]))
            rows[list(term.magnitudes)] = self.response(term)
            jacobian.append(rows)
        return Guess(candidate.x, candidate.terms, np.concatenate(jacobian))

    def response(self, term: Term) -> np.ndarray:
        """(k, M) of a candidate, or of a law at several elements: change of the residual by its k magnitudes."""
        if isinstance(term, SpreadTerm):
            return term.mixing @ np.concatenate([self.responses[i] for i in self._chosen(term)])
        return self.responses[self.candidates.index(term)]

    def detectable(self, gain: float) -> tuple[tuple[Term, float], ...]:
        """Of each candidate, the coordinate of its first magnitude that gains so much if nothing else is missing.

        Args:
            gain: log evidence [nats].
        """
        rows = np.array([block[0] for block in self.blocks])
        information = np.maximum(np.diag(self.matrix)[rows] - 1.0, 1e-12)
        return tuple(zip(self.candidates, np.sqrt(2.0 * gain / information).tolist(), strict=True))


def screen(
    problem: Problem,
    base: Hypothesis,
    candidates: Sequence[Term],
    robot: Robot,
    known: Mapping[Term, np.ndarray] | None = None,
    near: Collection[Term] = (),
) -> Evidence:
    """What all candidates say about the residual of a hypothesis; those are simulated that may matter.

    Args:
        base: beside which they are simulated. robot: see ``responses``.
        known: (k, M) responses beside a hypothesis of the same problem that is not far off.
        near: of these, the ones that were simulated so near that they hold here.
    """
    known = known or {}
    alike = {one: first for one, first in _like_others(candidates).items() if one not in known}
    found = {one: known[one] for one in candidates if one in known}
    simulated = set(near) & set(found)
    assumed = (set(found) | set(alike)) - simulated

    def simulate(chosen: Sequence[Term]) -> None:
        found.update(zip(chosen, responses(problem, base, chosen, robot), strict=True))
        simulated.update(chosen)

    if unknown := [one for one in candidates if one not in assumed | simulated]:
        simulate(unknown)
    found |= {one: found[first] for one, first in alike.items()}
    screened = evidence(problem, base, candidates, [found[one] for one in candidates])
    if chosen := _to_simulate(problem, screened, assumed, alike):
        simulate(chosen)
        screened = evidence(problem, base, candidates, [found[one] for one in candidates])
    return replace(screened, simulated=frozenset(simulated))


def _like_others(candidates: Sequence[Term]) -> dict[Term, Term]:
    """Terms that look like an earlier one, of the same class at the same location, and take long to simulate: their
    laws read the state between time steps."""
    first: dict[tuple[str, Location, int, bool], Term] = {}
    found = {}
    for one in candidates:
        if one.location.kind != "sensor" and PHYSICS[one.name].stepped:
            key = CATEGORIES[one.name], one.location, sum(one.magnitudes), one.removable > 0
            if (like := first.setdefault(key, one)) is not one:
                found[one] = like
    return found


def _to_simulate(problem: Problem, rough: Evidence, assumed: set[Term], alike: Collection[Term]) -> list[Term]:
    """Of terms whose response is ``assumed``, those that are predicted to gain most, and all where the best candidate
    acts; the members of laws that are predicted to gain clearly more at all elements together; and of those like others
    one of each law, where it shows most."""
    settings, robot, gains = rough.settings, problem.robot, [each.gain for each in _alone(rough)]
    order = sorted(range(len(gains)), key=lambda i: -gains[i])
    limit = settings.least_share * gains[order[0]]
    chosen = [rough.candidates[i] for i in order if gains[i] > limit and rough.candidates[i] in assumed]
    there = robot.moved_at(rough.candidates[order[0]].location)
    chosen += [one for one in rough.candidates if one in assumed and robot.moved_at(one.location) == there]
    least = gains[order[0]] + problem.settings.selection.least_gain
    for members in spread_terms.alike(rough.candidates):
        if set(members) & assumed and beyond_chance(problem, rough.at_each(spread(members))) > least:
            chosen += [one for one in members if one in assumed]
    information = np.diag(rough.matrix)
    largest: dict[str, tuple[float, Term]] = {}
    for one, block in zip(rough.candidates, rough.blocks, strict=True):
        if one in alike and information[block[0]] > largest.get(one.name, (0.0, one))[0]:
            largest[one.name] = float(information[block[0]]), one
    chosen += [one for _, one in largest.values()]
    return list(dict.fromkeys(chosen))


def responses(problem: Problem, base: Hypothesis, candidates: Sequence[Term], robot: Robot) -> list[np.ndarray]:
    """(k, M) of each candidate: change of the residual per prior deviation of each of its k magnitudes.

    Args:
        base: the hypothesis beside which each candidate is simulated.
        robot: that is simulated. These are differences of two replays, so time steps may be longer than in fits.
    """
    points: list[tuple[np.ndarray, tuple[Term, ...]]] = []
    magnitudes = []
    for candidate in candidates:
        for column in np.flatnonzero(candidate.magnitudes):
            x = np.where(np.arange(candidate.size) == column, candidate.simulated, 0.0)
            points.append((np.concatenate([base.x, x]), (*base.terms, candidate)))
            magnitudes.append(x[column])
    without, *simulated = problem.simulated(robot, [(base.x, base.terms), *points])
    rows = finite((without - np.array(simulated)) / problem.sigma / np.array(magnitudes)[:, None]) * problem.weight
    ends = np.cumsum([sum(candidate.magnitudes) for candidate in candidates])
    return np.split(rows, ends[:-1])


def evidence(
    problem: Problem, base: Hypothesis, candidates: Sequence[Term], simulated: Sequence[np.ndarray]
) -> Evidence:
    """What the simulated responses of candidates say about the residual of a hypothesis.

    Args:
        simulated: (k, M) of each candidate, as ``responses`` returns them.
    """
    discretisation, rows = base.discretisation(problem), np.concatenate(simulated)
    hessian, gradient = normal_equations(discretisation, base.jacobian, base.residual, base.x)
    cross = discretisation.product(rows, base.jacobian)
    shift, step = np.linalg.solve(hessian, cross.T), -np.linalg.solve(hessian, gradient)
    return Evidence(
        base,
        tuple(candidates),
        simulated,
        discretisation.product(rows, rows) + np.eye(len(rows)) - cross @ shift,
        discretisation.product(rows, base.residual[None])[:, 0] + cross @ step,
        np.concatenate([term.bounds[:, list(term.magnitudes)] for term in candidates], axis=1),
        tuple(np.split(np.arange(len(rows)), np.cumsum([len(response) for response in simulated])[:-1])),
        step,
        shift,
        problem.settings.screening,
    )


def beyond_chance(problem: Problem, candidate: ScreenedCandidate) -> float:
    """The predicted gain, less what further unknowns of the last term than one gain by chance [nats]."""
    if problem.misfit_dominated:  # then the whole residual counts as noise, and all gains are small
        return candidate.gain
    return candidate.gain - problem.settings.probabilities.gain_of_unknown * (candidate.terms[-1].size - 1)


def singles(screened: Evidence) -> list[ScreenedCandidate]:
    """One candidate at a time, the largest predicted gain first."""
    return sorted(_alone(screened), key=lambda candidate: -candidate.gain)


def _alone(screened: Evidence) -> list[ScreenedCandidate]:
    """One candidate at a time."""
    return [screened.screened_candidate([i]) for i in range(len(screened.candidates))]


def pairs(screened: Evidence) -> list[ScreenedCandidate]:
    """Two candidates at a time, the largest predicted gain first: each that gains something with every other one."""
    gains = np.array([each.gain for each in _alone(screened)])
    order = np.argsort(gains)[::-1]
    firsts = order[gains[order] > screened.settings.least_share * gains[order[0]]]
    paired = [screened.screened_candidate([i, j]) for n, i in enumerate(firsts) for j in order[n + 1 :]]
    return sorted(paired, key=lambda candidate: -candidate.gain)


def _best(matrix: np.ndarray, pull: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, float]:
    """The best magnitudes (k,) within their bounds (2, k), and the log evidence that they gain; see ``Evidence``."""
    magnitudes, free = np.zeros(len(pull)), np.ones(len(pull), bool)
    for _ in pull:  # a magnitude that would cross its bound stays there, and the rest is solved again
        rest = pull[free] + matrix[np.ix_(free, ~free)] @ magnitudes[~free]
        magnitudes[free] = -np.linalg.solve(matrix[np.ix_(free, free)], rest)
        inside = np.clip(magnitudes, *bounds)
        crossing = inside != magnitudes
        if not crossing.any():
            break
        free &= ~crossing
        magnitudes = inside
    gain = -float(pull @ magnitudes + 0.5 * magnitudes @ matrix @ magnitudes)
    return magnitudes, gain - 0.5 * float(np.linalg.slogdet(matrix)[1])


def _coordinates(term: Term, magnitudes: np.ndarray) -> np.ndarray:
    """(size,) coordinates of a term with these magnitudes, and what is typical otherwise."""
    x = np.zeros(term.size)
    x[list(term.magnitudes)] = magnitudes
    return x
