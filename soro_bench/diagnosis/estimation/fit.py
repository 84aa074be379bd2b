"""Joint maximum a posteriori fits of parameters and effects to recordings, by Gauss-Newton steps; their covariance.

Unknowns x are in standard deviations of their priors. The residual is white noise plus a discretisation error of low
rank, whose coefficients are unknowns with standard normal priors too (discretisation.py).

Jacobians are regressions over replays around a point (inference/statistical_linearisation.py).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, effects_at, slices
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals
from soro_bench.diagnosis.estimation.problem import Points, Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect
from soro_bench.inference.statistical_linearisation import LENGTHS, Line, LowRank, linearised, sample_around


@dataclass(frozen=True)
class Hypothesis:
    """Candidate terms (none: the nominal robot) and the most probable unknowns so far.

    x: (n,) parameters, then the coordinates of the terms. residual: (M,) there. cost: minus the log posterior there.
    jacobian: (n, M) of the residual. error: (E, M) basis of the covariance of the linearisation error. known: (n, n)
    covariance of x, where Jacobian and error do not give it (with_covariance).
    """

    terms: tuple[Term, ...]
    x: Floats
    residual: Floats
    cost: float
    jacobian: Floats
    error: Floats
    known: Floats | None = None

    def discretisation(self, problem: Problem) -> LowRank:
        """Covariance of discretisation and linearisation errors together."""
        return LowRank(np.concatenate([problem.discretisation.basis, self.error]))

    def log_evidence(self, problem: Problem) -> float:
        """Log evidence of the recordings by Laplace's approximation, up to a constant that all hypotheses share."""
        return -self.cost - 0.5 * float(np.linalg.slogdet(_hessian(problem.discretisation, self.jacobian))[1])

    def covariance(self, problem: Problem) -> Floats:
        """(n, n) posterior covariance of x."""
        if self.known is not None:
            return self.known
        return np.asarray(np.linalg.inv(_hessian(self.discretisation(problem), self.jacobian)), float)

    def scaled(self, problem: Problem, factor: float | Floats) -> "Hypothesis":
        """The same hypothesis of a problem whose residuals are ``factor`` times as large; one factor, or (M,)."""
        parts = {name: getattr(self, name) * factor for name in ("residual", "jacobian", "error")}
        return replace(self, **parts, cost=problem.cost(parts["residual"], self.x))

    def effects(self, parameters: int) -> list[Effect]:
        """The terms as fitted, after so many parameters."""
        return effects_at(self.x[parameters:], self.terms)

    def effects_of_terms(self, parameters: int) -> list[list[Effect]]:
        """The same, of each term."""
        return [
            term.effects(self.x[part]) for term, part in zip(self.terms, slices(self.terms, parameters), strict=True)
        ]


def allowing(problem: Problem, best: Hypothesis, others: Sequence[Hypothesis]) -> tuple[Problem, list[Hypothesis]]:
    """The problem with the best hypothesis's misfit as noise, if it dominates (``Problem.allowing``), and ``others`` of
    that problem."""
    same = problem.allowing(*problem.left_of_each(best.residual))
    return same, [each.scaled(same, problem.factor_to(same)) for each in others]


@dataclass(frozen=True)
class Guess:
    """Where a fit begins: unknowns (n,), their terms, and the Jacobian (n, M) if it is known from before."""

    x: Floats
    terms: tuple[Term, ...] = ()
    jacobian: Floats | None = None


def fitted(
    problem: Problem,
    guesses: Sequence[Guess],
    scales: Sequence[float],
    seed: int,
    first: Sequence[Floats] | None = None,
) -> list[Hypothesis]:
    """Maximum a posteriori fits from several guesses, whose replays run together.

    Args:
        scales: standard deviations of the samples of each linearisation, in standard deviations of the priors.
        first: residuals (N, M) of the first samples of each guess, where they have been replayed.
    """
    best: list[Hypothesis] = []
    guesses = _within(problem, guesses)
    for k, scale in enumerate(scales):
        samples = _samples(problem, guesses, scale, [seed, k])
        found = first if k == 0 and first is not None else replayed(problem, guesses, samples)
        lines = [
            linearised(g.x, points, rows, g.jacobian) for g, points, rows in zip(guesses, samples, found, strict=True)
        ]
        trials = [_trials(problem, guess, line) for guess, line in zip(guesses, lines, strict=True)]
        found = replayed(problem, guesses, trials)
        news = []
        for i, (guess, line, points, rows) in enumerate(zip(guesses, lines, trials, found, strict=True)):
            kept = [replace(best[i], jacobian=line.jacobian, error=line.error)] if best else []
            news.append(min([*_hypotheses(problem, guess, points, rows, line), *kept], key=lambda h: h.cost))
        best = news
        guesses = [
            replace(g, x=h.x, jacobian=g.jacobian if g.jacobian is None else h.jacobian)
            for g, h in zip(guesses, best, strict=True)
        ]
    return best


def fitted_under_discretisation(
    problem: Problem,
    refined: Sequence[Robot],
    points: Points,
    guesses: Sequence[Guess],
    scales: Sequence[float],
    seed: int,
    compared: Sequence[Floats] = (),
) -> tuple[Problem, list[Hypothesis]]:
    """The problem with the discretisation errors at ``points`` and differences of other simulations at the unknowns
    ``compared`` too, and fits to it.

    The first samples of the fits need no discretisation error and are replayed beside it.
    """
    guesses = _within(problem, guesses)
    samples = _samples(problem, guesses, scales[0], [seed, 0])
    asked = _asked(guesses, samples)
    discretisation, found = discretisation_and_residuals(problem, refined, points, asked, compared)
    problem = problem.with_discretisation(discretisation)
    return problem, fitted(problem, guesses, scales, seed, _split(found, samples))


def linearised_at(problem: Problem, guess: Guess, scale: float, seed: int) -> Hypothesis:
    """The hypothesis at a guess (n,) itself, not fitted, with the slopes of samples around it.

    Args:
        scale: standard deviation of the samples, in standard deviations of the priors.
    """
    samples = np.concatenate([guess.x[None], _sample(problem, guess, scale, [seed, 0])])
    (rows,) = replayed(problem, [guess], [samples])
    line = linearised(guess.x, samples, rows)
    return _hypotheses(problem, guess, [guess.x], rows[:1], line)[0]


def _hypotheses(
    problem: Problem, guess: Guess, points: Sequence[Floats], residuals: Floats, line: Line
) -> list[Hypothesis]:
    """Hypotheses at points (N, n) with residuals (N, M), which share a linearisation."""
    return [
        Hypothesis(guess.terms, x, row, problem.cost(row, x), line.jacobian, line.error)
        for x, row in zip(points, residuals, strict=True)
    ]


def replayed(
    problem: Problem, guesses: Sequence[Guess] | Sequence[Hypothesis], groups: Sequence[Sequence[Floats] | Floats]
) -> list[Floats]:
    """Residuals (N, M) at the points (N, n) of each guess, replayed together."""
    return _split(problem.residuals(_asked(guesses, groups)), groups)


def _asked(
    guesses: Sequence[Guess] | Sequence[Hypothesis], groups: Sequence[Sequence[Floats] | Floats]
) -> list[tuple[Floats, Sequence[Term]]]:
    """All points of all guesses, each with its terms."""
    terms = [guess.terms for guess in guesses]
    return [(x, some) for some, points in zip(terms, groups, strict=True) for x in points]


def _split(rows: Floats, groups: Sequence[Sequence[Floats] | Floats]) -> list[Floats]:
    """The rows of each group."""
    ends = np.cumsum([0, *(len(points) for points in groups)])
    return [rows[begin:end] for begin, end in itertools.pairwise(ends)]


def _within(problem: Problem, guesses: Sequence[Guess]) -> list[Guess]:
    """The guesses with their unknowns inside the bounds."""
    return [replace(g, x=np.clip(g.x, *bounds(problem, g.terms))) for g in guesses]


def bounds(problem: Problem, terms: Sequence[Term]) -> Floats:
    """(2, n) least and largest value of each unknown."""
    limit = problem.settings.priors.limit
    return np.hstack([
        np.zeros((2, 0)),
        *[prior.reach(limit)[:, None] for prior in problem.robot.priors],
        *[s.bounds for s in terms],
    ])


def _samples(problem: Problem, guesses: Sequence[Guess], scale: float, seed: Sequence[int]) -> list[Floats]:
    """(N, n) points around each guess."""
    return [_sample(problem, guess, scale, seed) for guess in guesses]


def _sample(problem: Problem, guess: Guess, scale: float, seed: Sequence[int]) -> Floats:
    """(N, n) points around a guess, more of them for more unknowns."""
    settings = problem.settings.fit
    more, known = len(guess.x) - problem.parameters, guess.jacobian is not None
    fewest = settings.samples_with_jacobian
    count = fewest + more if known else max(settings.samples, fewest + 2 * len(guess.x))
    return np.clip(sample_around(guess.x, scale, count, seed), *bounds(problem, guess.terms))


def _trials(problem: Problem, guess: Guess, line: Line) -> list[Floats]:
    """Points (n,) on the way to the minimum of the linearised cost, within the bounds."""
    x, largest = guess.x, problem.settings.fit.largest_step
    discretisation = LowRank(np.concatenate([problem.discretisation.basis, line.error]))
    lower, upper = bounds(problem, guess.terms)
    hessian, gradient = normal_equations(discretisation, line.jacobian, line.residual, x)
    free, step = np.ones(len(x), bool), np.zeros(len(x))
    for _ in range(len(x)):
        step[:] = 0.0
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        crossing = free & (((x + step < lower) & (x <= lower)) | ((x + step > upper) & (x >= upper)))
        if not crossing.any():
            break
        free &= ~crossing
    return [np.clip(x + np.clip(length * step, -largest, largest), lower, upper) for length in LENGTHS]


def normal_equations(discretisation: LowRank, jacobian: Floats, residual: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Hessian (n, n) and gradient (n,) of the linearised cost at x (n,), with standard normal priors of x.

    Args:
        discretisation: covariance of the errors beside the noise.
        jacobian: (n, M) of the residual.
        residual: (M,) at x.
    """
    return _hessian(discretisation, jacobian), discretisation.product(jacobian, residual[None])[:, 0] + x


def _hessian(discretisation: LowRank, jacobian: Floats) -> Floats:
    """(n, n) of the linearised cost, with standard normal priors."""
    return discretisation.product(jacobian, jacobian) + np.eye(len(jacobian))


# --- Levenberg-Marquardt descent ---

_STEPS = 10  # at most with Jacobians by differences; the gain of a step ends most descents
LEAST_GAIN = 0.003  # share of the cost that a step has to gain for another one
_POWERS = 10.0 ** np.arange(6.0)  # of the damping, tried side by side
_NOTICED = 0.1  # nats, that a step has to gain along a direction that only priors know
_AS_PREDICTED = 0.5  # share of its predicted gain, from which on the Jacobian of a step is good for the next one


def descended(problem: Problem, hypotheses: Sequence[Hypothesis], least_gain: float = LEAST_GAIN) -> list[Hypothesis]:
    """The hypotheses, each at the local minimum of its cost; none is worse than before. They go side by side.

    It serves fits of real robots, whose misfit is larger than the ruggedness of the simulation. The samples of other
    fits are too wide where the phase of an oscillation runs away: that is linear near a point only. SciPy's method
    would replay one point after the other. Changes between recordings have a descent of their own (paired/fit.py): of
    white residuals, with Jacobians by differences only.

    A Jacobian by differences costs a replay for each unknown. As long as steps gain what it predicts, it is updated
    by what they change instead (Broyden, "A class of methods for solving nonlinear simultaneous equations", 1965).
    Another one by differences is worth it as long as steps gain enough on average.

    Args:
        least_gain: share of the cost that a step has to gain for another one.
    """
    settings = problem.settings.descent
    factors = settings.smallest_damping * _POWERS
    found, damping, counts = list(hypotheses), np.ones(len(hypotheses)), np.zeros(len(hypotheses), int)
    going, updated = [i for i, h in enumerate(hypotheses) if len(h.x)], dict[int, Floats]()
    begun, steps = list(hypotheses), np.zeros(len(hypotheses), int)  # with the last Jacobians by differences
    while going:
        if anew := [i for i in going if i not in updated]:
            for i, h in zip(anew, _with_jacobians(problem, [found[i] for i in anew]), strict=True):
                found[i] = begun[i] = h
            counts[anew], steps[anew] = counts[anew] + 1, 0
        lines = {i: replace(found[i], jacobian=updated.get(i, found[i].jacobian)) for i in going}
        trials = [_steps(problem, lines[i], damping[i] * factors) for i in going]
        rows_of = replayed(problem, [lines[i] for i in going], trials)
        steps[going], further, updated = steps[going] + 1, [], {}
        for i, rows, points in zip(going, rows_of, trials, strict=True):
            h, costs = lines[i], [problem.cost(row, x) for row, x in zip(rows, points, strict=True)]
            best = int(np.argmin(costs))
            there = replace(h, x=points[best], residual=rows[best], cost=costs[best])
            if there.cost < h.cost:
                found[i] = replace(there, jacobian=found[i].jacobian)
                damping[i] *= factors[best]
            if there.cost < (1.0 - least_gain) * h.cost:
                predicted = problem.cost(h.residual + (there.x - h.x) @ h.jacobian, there.x)
                if h.cost - there.cost >= _AS_PREDICTED * (h.cost - predicted):
                    updated[i] = _updated(h, there)
            worth = found[i].cost < (1.0 - steps[i] * least_gain) * begun[i].cost
            if i in updated or (worth and counts[i] < _STEPS):
                further.append(i)
        going = further
    return found


def settled(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis at the minimum of its cost, along directions too that no recording shows: Gauss-Newton steps with
    central differences. The errors of other Jacobians are larger than the slopes of priors, which decide there."""
    h, difference, n = hypothesis, problem.settings.descent.difference, len(hypothesis.x)
    for _ in range(_STEPS if n else 0):
        points = np.clip(h.x + difference * np.vstack([np.eye(n), -np.eye(n)]), *bounds(problem, h.terms))
        after, before = np.split(problem.residuals([(x, h.terms) for x in points]), 2)
        jacobian = (after - before) / np.diag(points[:n] - points[n:])[:, None]
        line = replace(h, jacobian=jacobian, error=h.error[:0])
        trials = _trials(problem, Guess(h.x, h.terms), Line(h.residual, jacobian, line.error))
        rows = problem.residuals([(x, h.terms) for x in trials])
        costs = [problem.cost(row, x) for row, x in zip(rows, trials, strict=True)]
        best = int(np.argmin(costs))
        if not costs[best] < line.cost - _NOTICED:
            return line
        h = replace(line, x=trials[best], residual=rows[best], cost=costs[best])
    return h


def _updated(before: Hypothesis, after: Hypothesis) -> Floats:
    """(n, M) Jacobian at a point, from that at another one and what the step between them changed."""
    step = after.x - before.x
    more = after.residual - before.residual - step @ before.jacobian
    return before.jacobian + np.outer(step, more) / (step @ step)


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


# --- posterior covariance ---

_ROUNDS = 4  # of samples, each as wide as the covariance before it
_SAMPLES = 64  # replays of a round, beside two for each unknown
_WIDTH = 0.3  # prior deviations of the first samples, as narrow ones see jumps only; share of an effect's magnitude
_LEAST_WIDTH = 1e-6  # prior deviations; keeps the first samples apart


def with_covariance(problem: Problem, hypothesis: Hypothesis, seed: int) -> Hypothesis:
    """The hypothesis with its posterior covariance; unchanged if its fit had samples, which give one, or if it
    has no unknown.

    The Jacobian of a descent holds at a point, to a hundredth of a prior's deviation. Where things stick or touch,
    replays jump there, and a jump looks like knowledge: of four parameters of which only ratios count, one had a
    deviation of 1 % and was off by 13 % (benchmarks/interval_coverage.py counts these). Samples as wide as the
    posterior show what changes over its width, and the linearisation error counts (iterated statistical linearisation;
    García-Fernández et al., "Posterior linearization filter", 2015). The first samples are wide, since narrow ones see
    jumps only.
    """
    if len(hypothesis.error) or not len(hypothesis.x):
        return hypothesis
    x, terms, n = hypothesis.x, hypothesis.terms, len(hypothesis.x)
    low, high = bounds(problem, terms)
    root = np.diag(_first_widths(problem, hypothesis))
    for k in range(_ROUNDS):
        normal = sample_around(np.zeros(n), 1.0, _SAMPLES + 2 * n, [seed, k])
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
    magnitudes = np.array([*[False] * problem.parameters, *(m for s in hypothesis.terms for m in s.magnitudes)])
    small = np.clip(_WIDTH * np.abs(hypothesis.x), _LEAST_WIDTH, _WIDTH)
    return np.where(magnitudes, small, _WIDTH)
