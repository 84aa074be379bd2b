"""Fits of changes to paired recordings: screening, least squares of the change alone, then of everything together."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.paired.changes import LawChange, ParameterChange
from soro_bench.diagnosis.paired.problem import PairedProblem, Point
from soro_bench.diagnosis.settings import Settings

_STARTS = (0.3, 1.0, 3.0)  # times the predicted size; a law's effect is not linear in it
_DAMPINGS = np.array([0.01, 0.1, 1.0, 100.0])  # of the Hessian's diagonal, tried side by side
_STEPS = 10  # of a descent, at most
_LEAST_GAIN = 0.003  # share of the cost that a step has to gain for another one
_TOGETHER = 64  # replays side by side
_EDGE = 1e-9  # of an interval, by which a start lies inside its bounds


@dataclass(frozen=True)
class Fit:
    """Changes as fitted.

    jacobian: of the residuals, (2 M, n) over all unknowns, the changes' last; or (M, k) of the difference over a
    change alone. squares: what is left before and of the difference [signal's unit, squared]. evidence: logarithm, up
    to a constant of the problem.
    joint: whether the shared unknowns were fitted too.
    """

    point: Point
    jacobian: Floats
    squares: tuple[float, float]
    evidence: float
    joint: bool

    @property
    def changes(self) -> tuple[ParameterChange | LawChange, ...]:
        """That were fitted."""
        return self.point.changes

    def covariance(self) -> Floats:
        """(n, n) of the unknowns that were fitted, with standard normal priors."""
        return np.asarray(np.linalg.inv(self.jacobian.T @ self.jacobian + np.eye(self.jacobian.shape[1])), float)


@dataclass(frozen=True)
class Screened:
    """A change with its predicted coordinates and gain in log evidence."""

    change: ParameterChange | LawChange
    z: Floats
    gain: float


def screened(problem: PairedProblem, base: Point, changes: Sequence[ParameterChange | LawChange]) -> list[Screened]:
    """Changes beside those of a base point, the largest predicted gain first; each is simulated once for each of its
    magnitudes, and its response is compared with what is left of the difference."""
    half = problem.measured[0].size
    (without,) = problem.residuals([base])
    jobs = [(change, column) for change in changes for column in np.flatnonzero(change.magnitudes).tolist()]
    rows: list[Floats] = []
    for start in range(0, len(jobs), _TOGETHER):
        points = [
            replace(base, z=np.concatenate([base.z, _only(change.typical, change, column)]),
                    changes=(*base.changes, change))
            for change, column in jobs[start : start + _TOGETHER]
        ]  # fmt: skip
        for row, (change, column) in zip(problem.residuals(points), jobs[start : start + _TOGETHER], strict=True):
            rows.append((row - without)[half:] / change.typical[column])
    found, number = [], 0
    for change in changes:
        columns = np.flatnonzero(change.magnitudes)
        response = np.array(rows[number : number + len(columns)])
        number += len(columns)
        gram = response @ response.T + np.eye(len(columns))
        pull = response @ without[half:]
        size = -np.linalg.solve(gram, pull)
        low, high = change.bounds[:, columns]
        size = np.clip(size, low, high)
        gain = float(-pull @ size - 0.5 * size @ gram @ size - 0.5 * np.linalg.slogdet(gram)[1])
        z = np.where(change.magnitudes, 0.0, change.typical)
        z[columns] = size
        found.append(Screened(change, z, gain))
    return sorted(found, key=lambda each: -each.gain)


def _only(typical: Floats, change: ParameterChange | LawChange, column: int) -> Floats:
    """Typical coordinates with one magnitude only; shapes have theirs."""
    here = np.arange(len(typical)) == column
    return np.where(np.array(change.magnitudes) & ~here, 0.0, typical)


def finalists(found: Sequence[Screened], settings: Settings) -> list[Screened]:
    """The changes that are worth a fit, a few of each law."""
    kept: list[Screened] = []
    counts: Counter[str] = Counter()
    least = settings.screening.least_share * max(found[0].gain, 0.0) if found else 0.0
    for each in found:
        name = each.change.key[0]
        if len(kept) == settings.selection.candidates or each.gain <= least:
            break
        if counts[name] < settings.selection.candidates_per_law:
            kept.append(each)
            counts[name] += 1
    return kept


def fitted_shared(problem: PairedProblem, x: Floats, settings: Settings) -> Floats:
    """(n,) shared unknowns of the recordings before the change alone."""
    half, nothing = problem.measured[0].size, np.zeros(0)

    def residuals(rows: list[tuple[int, Floats]]) -> Floats:
        return problem.residuals([Point(row, nothing, ()) for _, row in rows])[:, :half]

    ((_, best),) = _descended(residuals, [x], [problem.bounds], settings)
    return best


def fitted_alone(problem: PairedProblem, base: Point, starts: Sequence[Screened], settings: Settings) -> list[Fit]:
    """Each of some changes fitted to the difference, beside those of the base point, which stay as they are.

    The shared unknowns stay too. Where a law acts before the change, they have taken up some of it; that is left to the
    fit of everything together.
    """
    half = problem.measured[0].size

    def points(rows: Sequence[tuple[int, Floats]]) -> list[Point]:
        return [Point(base.x, np.concatenate([base.z, row]), (*base.changes, starts[i].change)) for i, row in rows]

    guesses = [
        (i, np.clip(np.where(each.change.magnitudes, factor * each.z, each.z), *each.change.bounds))
        for i, each in enumerate(starts)
        for factor in _STARTS
    ]
    costs = (problem.residuals(points(guesses))[:, half:] ** 2).sum(axis=1) + [float(z @ z) for _, z in guesses]
    best = costs.reshape(len(starts), len(_STARTS)).argmin(axis=1)
    first = [guesses[i * len(_STARTS) + k][1] for i, k in enumerate(best)]
    bounds = [each.change.bounds for each in starts]
    found = _descended(lambda rows: problem.residuals(points(rows))[:, half:], first, bounds, settings)
    return _fits(problem, points([(i, z) for i, (_, z) in enumerate(found)]), [j for j, _ in found], joint=False)


def fitted_together(problem: PairedProblem, fits: Sequence[Fit], settings: Settings) -> list[Fit]:
    """Changes and the shared unknowns fitted together, from where fits ended."""

    def points(rows: Sequence[tuple[int, Floats]]) -> list[Point]:
        return [Point(row[: len(fits[i].point.x)], row[len(fits[i].point.x) :], fits[i].changes) for i, row in rows]

    bounds = [np.hstack([problem.bounds, *(each.bounds for each in fit.changes)]) for fit in fits]
    starts = [np.concatenate([fit.point.x, fit.point.z]) for fit in fits]
    found = _descended(lambda rows: problem.residuals(points(rows)), starts, bounds, settings)
    return _fits(problem, points([(i, v) for i, (_, v) in enumerate(found)]), [j for j, _ in found], joint=True)


def _fits(problem: PairedProblem, points: Sequence[Point], jacobians: Sequence[Floats], joint: bool) -> list[Fit]:
    squares = problem.squares(points)
    return [
        Fit(point, jacobian, (float(one), float(two)), np.nan, joint)
        for point, jacobian, (one, two) in zip(points, jacobians, squares, strict=True)
    ]


def _descended(
    residuals: Callable[[list[tuple[int, Floats]]], Floats],
    starts: Sequence[Floats],
    bounds: Sequence[Floats],
    settings: Settings,
) -> list[tuple[Floats, Floats]]:
    """Levenberg-Marquardt fits side by side, with standard normal priors: of each the Jacobian (M, n) and the unknowns.

    The Jacobian is that of the last step's beginning: at convergence its standard deviations are right to 1 %. That of
    a diagnosis (``descended`` in ``estimation/fit.py``) is for hypotheses of a ``Problem``, whose costs have a
    covariance, and updates Jacobians between steps; it ends at other digits.

    Args:
        residuals: (N, M) of N pairs of a fit's number and its unknowns (n,).
        starts, bounds: (n,) and (2, n) of each fit.
    """
    edges = [_EDGE * np.minimum(high - low, 1.0) for low, high in bounds]
    found = [np.clip(x, b[0] + e, b[1] - e) for x, b, e in zip(starts, bounds, edges, strict=True)]
    jacobians: list[Floats] = [np.zeros((0, 0))] * len(found)
    damping, going = np.ones(len(found)), list(range(len(found)))
    for _ in range(_STEPS):
        lines = _linearised(residuals, [(i, found[i]) for i in going], bounds, settings)
        trials, costs = [], {}
        for i, (here, jacobian) in zip(going, lines, strict=True):
            jacobians[i], costs[i] = jacobian, float(here @ here + found[i] @ found[i])
            points = _steps(found[i], here, jacobian, _DAMPINGS * damping[i])
            trials += [(i, np.clip(point, *bounds[i])) for point in points]
        tried = (_in_parts(residuals, trials) ** 2).sum(axis=1) + [float(x @ x) for _, x in trials]
        improved = []
        for k, i in enumerate(going):
            part = slice(k * len(_DAMPINGS), (k + 1) * len(_DAMPINGS))
            best = int(np.argmin(tried[part]))
            if tried[part][best] < costs[i]:
                found[i] = trials[k * len(_DAMPINGS) + best][1]
                damping[i] *= float(_DAMPINGS[best] / _DAMPINGS[1])
            if tried[part][best] < (1.0 - _LEAST_GAIN) * costs[i]:
                improved.append(i)
        if not (going := improved):
            break
    return list(zip(jacobians, found, strict=True))


def _linearised(
    residuals: Callable[[list[tuple[int, Floats]]], Floats],
    points: Sequence[tuple[int, Floats]],
    bounds: Sequence[Floats],
    settings: Settings,
) -> list[tuple[Floats, Floats]]:
    """Residuals (M,) and Jacobians (M, n), by one-sided differences, at the unknowns (n,) of some fits.

    Args:
        residuals, bounds: as of ``_descended``.
        points: numbers of the fits with their unknowns.
    """
    moved = [_beside(x, bounds[i], settings) for i, x in points]
    rows = _in_parts(
        residuals, [(i, each) for (i, x), others in zip(points, moved, strict=True) for each in (x, *others)]
    )
    found, first = [], 0
    for (_, x), others in zip(points, moved, strict=True):
        here, there = rows[first], rows[first + 1 : first + 1 + len(x)]
        first += 1 + len(x)
        found.append((here, ((there - here) / np.diag(others - x)[:, None]).T))
    return found


def _steps(x: Floats, residual: Floats, jacobian: Floats, dampings: Floats) -> list[Floats]:
    """Unknowns (n,) of least linearised cost, one for each damping (K,) of the Hessian's diagonal."""
    hessian = jacobian.T @ jacobian + np.eye(len(x))
    gradient = jacobian.T @ residual + x
    return [x - np.linalg.solve(hessian + factor * np.diag(np.diag(hessian)), gradient) for factor in dampings]


def _beside(x: Floats, bounds: Floats, settings: Settings) -> Floats:
    """(n, n) unknowns of which one each is moved, within the bounds."""
    size = settings.descent.difference
    by = np.where(x + size <= bounds[1], size, -size)
    return np.asarray(x + np.diag(by), float)


def _in_parts(residuals: Callable[[list[tuple[int, Floats]]], Floats], points: Sequence[tuple[int, Floats]]) -> Floats:
    """Residuals of many points, some at a time, which bounds the memory."""
    return np.vstack([residuals(list(points[k : k + _TOGETHER])) for k in range(0, len(points), _TOGETHER)])


def evidence(problem: PairedProblem, fit: Fit, shared: Floats, reference: Point) -> float:
    """Log evidence of changes against none, up to a constant of the problem.

    The noise of the difference is as unknown as what is left of it is (Student's t): only ratios of squares count.

    Args:
        shared: (n, n) information of the shared unknowns without a change.
        reference: without a change.
    """
    independent = problem.share[1] * float(problem.seen[1].sum())
    value = -0.5 * independent * float(np.log(max(fit.squares[1], 1e-300)))
    squares = problem.squares([reference])[0]
    information = fit.jacobian.T @ fit.jacobian + np.eye(fit.jacobian.shape[1])
    value -= 0.5 * float(np.linalg.slogdet(information)[1])
    value -= 0.5 * float(fit.point.z @ fit.point.z)
    if fit.joint:
        value += 0.5 * float(np.linalg.slogdet(shared)[1])
        value -= 0.5 * problem.share[0] * (fit.squares[0] - float(squares[0])) / problem.sigma[0] ** 2
        value -= 0.5 * float(fit.point.x @ fit.point.x - reference.x @ reference.x)
    return value
