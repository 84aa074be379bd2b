"""The point of the search box whose replay explains a recording, followed from the first steps to the last."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import qmc

from soro_bench.arrays import Floats
from soro_bench.inference.replay import MISSING
from soro_bench.inference.search import EvaluationLog, Residuals, SearchProgress
from soro_bench.inference.statistical_linearisation import LENGTHS, LowRank, linearised, sample_around

DIFFERENCE = 1e-3  # of the search box, step of the finite differences
HORIZONS, STEPS_PER_HORIZON = 20, 2
ATTEMPTS, EXPLAINED = 3, 1.1  # with other starting points, until this many standard deviations are left (noise: 1)
SCALES, CLOUD, PRIOR = (0.05, 0.03, 0.02, 0.012, 0.007, 0.004, 0.002), 20, 0.3  # of the search box
DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0)
SHARES, DRAWS = (0.03, 0.3), 4  # of the misfit, and how many points each


def best_track(
    residuals: Residuals,
    deviation: Floats,
    groups: Sequence[slice],
    dimension: int,
    log: EvaluationLog,
    seed: int,
    starts: int,
    progress: SearchProgress = lambda *_: None,
) -> Floats:
    """(d,) the point of the unit cube that explains the recording best: :func:`track`, and where much is left
    :func:`refine`, from other starting points until little is."""
    measured = sum(int((deviation[:, group] < MISSING).any(axis=1).sum()) for group in groups)
    enough = measured * np.log1p(EXPLAINED**2)
    best, lowest = np.full(dimension, 0.5), np.inf
    for attempt in range(ATTEMPTS):
        point, cost = track(residuals, deviation, groups, dimension, log, [seed, attempt], starts, progress)
        if cost >= enough:
            point, cost = refine(residuals, deviation, groups, point, cost, log, [seed, attempt])
        if cost < lowest:
            best, lowest = point, cost
        if lowest < enough:
            break
    return best


def refine(
    residuals: Residuals,
    deviation: Floats,
    groups: Sequence[slice],
    point: Floats,
    cost: float,
    log: EvaluationLog,
    seed: Sequence[int],
) -> tuple[Floats, float]:
    """A better point than one nearby, and its cost: steps on linear models over samples that shrink.

    Each round moves on to its best point even if that is worse: the way out of a local optimum leads uphill. Best is
    where most single numbers are explained.
    """
    steps, dimension, best = len(deviation), len(point), (point, cost)
    single = [slice(i, i + 1) for i in range(deviation.shape[1])]
    for k, scale in enumerate(SCALES):
        points = np.clip(sample_around(point, scale, CLOUD, [*seed, k]), 0, 1)
        found = log(lambda x: residuals(x, steps), points, "cloud")
        line = linearised(point, points, np.stack([_whiten(each, deviation).ravel() for each in found]))
        covariance = LowRank(line.error)
        hessian = covariance.product(line.jacobian, line.jacobian) + np.eye(dimension) / PRIOR**2
        step = -np.linalg.solve(hessian, covariance.product(line.jacobian, line.residual[None])[:, 0])
        trials = np.clip([point + length * step for length in LENGTHS], 0, 1)
        tried = log(lambda x: residuals(x, steps), trials, "trial")
        tried = np.concatenate([tried, found]) / deviation
        chosen = int(_robust_cost(tried, single).argmin())
        point, cost = np.concatenate([trials, points])[chosen], float(_robust_cost(tried[[chosen]], groups)[0])
        best = min(best, (point, cost), key=lambda pair: pair[1])
    return best


def track(
    residuals: Residuals,
    deviation: Floats,
    groups: Sequence[slice],
    dimension: int,
    log: EvaluationLog,
    seed: Sequence[int],
    starts: int,
    progress: SearchProgress = lambda *_: None,
) -> tuple[Floats, float]:
    """(d,) the point of the unit cube whose replay explains the recording, by continuation in the horizon; its cost.

    The first steps are explained first, which is easy as nothing has touched anything and errors have not added up;
    then a few more, from there. Each horizon takes Gauss-Newton steps on sum log(1 + s_tg), where s_tg is the mean
    square of the weighted residuals of signal g at step t: the likelihood when every step and signal has a variance of
    its own, so that one that cannot be explained does not outvote the others.
    """
    steps = len(deviation)
    horizons = np.unique(np.round(np.geomspace(min(3, steps), steps, HORIZONS)).astype(int))
    rng = np.random.default_rng(seed)
    points = qmc.Sobol(dimension, rng=rng).random(starts)
    costs = np.zeros(len(points))
    for i, until in enumerate(horizons):
        for _ in range(STEPS_PER_HORIZON):
            points, costs = _gauss_newton(residuals, deviation[:until], groups, points, log, int(until), rng)
        if i + 1 in {len(horizons) * k // 4 for k in (1, 2, 3)}:
            points = points[np.argsort(costs)[: max(1, len(points) // 2)]]
        progress(i + 1, len(horizons), float(costs.min()))
    return points[int(np.argmin(costs))], float(costs.min())


def _gauss_newton(
    residuals: Residuals,
    deviation: Floats,
    groups: Sequence[slice],
    points: Floats,
    log: EvaluationLog,
    until: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """One step from each of the points (S, d), the best of several lengths: new points and their costs."""
    starts, dimension = points.shape
    # backwards where forwards leaves the cube
    offset = np.where(points > 0.5, -DIFFERENCE, DIFFERENCE)
    shifted = points[:, None] + offset[:, :, None] * np.eye(dimension)
    asked = np.concatenate([points[:, None], shifted], axis=1).reshape(-1, dimension)
    found = log(lambda x: residuals(x, until), asked, "difference").reshape(starts, dimension + 1, until, -1)
    trials = np.stack([
        _trials(
            point, _whiten(one[0], deviation), _whiten((one[1:] - one[0]) / o[:, None, None], deviation), groups, rng
        )
        for point, one, o in zip(points, found, offset, strict=True)
    ])  # (S, n, d)
    found = log(lambda x: residuals(x, until), trials.reshape(-1, dimension), "trial")
    costs = _robust_cost(found / deviation, groups).reshape(starts, -1)
    best = costs.argmin(axis=1)
    return trials[np.arange(starts), best], costs[np.arange(starts), best]


def _whiten(residual: Floats, deviation: Floats) -> Floats:
    return np.nan_to_num(residual / deviation, nan=1e6, posinf=1e6, neginf=-1e6)


def _trials(point: Floats, white: Floats, slope: Floats, groups: Sequence[slice], rng: np.random.Generator) -> Floats:
    """(n, d) points to try: the present one, where Gauss-Newton with several dampings leads, and some at random around,
    as far as the linearised misfit grows by a fraction of itself: contacts make the true one rugged."""
    weight = np.empty_like(white)
    for group in groups:
        weight[:, group] = 1 / np.sqrt(1 + (white[:, group] ** 2).mean(axis=1, keepdims=True))
    a = (weight * slope).reshape(len(point), -1)
    hessian, gradient = a @ a.T, a @ (weight * white).ravel()
    ridge = 1e-9 * np.trace(hessian) + 1e-12
    steps = [np.linalg.solve(hessian + np.diag(damping * np.diag(hessian) + ridge), gradient) for damping in DAMPINGS]
    values, vectors = np.linalg.eigh(hessian + ridge * np.eye(len(point)))
    misfit = np.linalg.norm(weight * white)
    spread = vectors * np.minimum(misfit / np.sqrt(values * len(point)), 0.1)
    draws = np.concatenate([share * rng.standard_normal((DRAWS, len(point))) @ spread.T for share in SHARES])
    trials = np.concatenate([point[None], point - np.array(steps), point - steps[0] + draws])
    return np.clip(trials, 0, 1)


def _robust_cost(white: Floats, groups: Sequence[slice]) -> Floats:
    """(N,) sum of log(1 + mean square) over steps and signals of (N, T, k) weighted residuals."""
    cost = sum(np.log1p((white[:, :, group] ** 2).mean(axis=2)).sum(axis=1) for group in groups)
    return np.nan_to_num(cost, nan=1e300, posinf=1e300)
