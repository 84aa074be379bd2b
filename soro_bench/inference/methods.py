"""The inference methods under one roof: a recording in, a posterior out."""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.inference import rf_dropo
from soro_bench.inference.continuation import EXPLAINED
from soro_bench.inference.guard import Guard, guarded, rms
from soro_bench.inference.posterior import Posterior, combinations, fisher
from soro_bench.inference.replay import SIMULATIONS, Replay
from soro_bench.inference.search import EvaluationLog, SearchProgress, cma_search
from soro_bench.parallel import HERE, Workers, each, one_blas_thread
from soro_bench.randomization import Gaussian, TruncatedNormal

LEAST_SIMULATIONS = 50  # of BayesSim, whose network would learn nothing from fewer
_LEAST = {"simulations": LEAST_SIMULATIONS, "iterations": 1, "max_iterations": 1, "popsize": 2, "samples": 2,
          "starts": 1}  # fmt: skip
METHODS = ("rf-dropo", "bayes-sim", "dropo", "droid", "sysid")
# a distribution, the best values (d,) in their units, and the slope (T, k, d) there
_Found = tuple[TruncatedNormal | Gaussian, Floats, Floats]


@dataclass
class Search:
    """A replay on the unit cube of its search box, with a log, whose ``work`` counts time steps."""

    replay: Replay
    log: EvaluationLog
    seed: int
    progress: SearchProgress
    workers: Workers

    def __post_init__(self) -> None:
        self.low, high = np.array([p.search for p in self.replay.parameters]).T
        self.width = high - self.low

    @property
    def dimension(self) -> int:
        """How many parameters are inferred, d."""
        return len(self.low)

    def residuals(self, points: Floats, steps: int) -> Floats:
        """(N, steps, k) measured less simulated at points (N, d) of the unit cube."""
        return np.concatenate(list(self.parts(points, steps)))

    def parts(self, points: Floats, steps: int) -> Iterator[Floats]:
        """The same for SIMULATIONS points after the other, each part as soon as it is there."""
        values = self.low + self.width * points
        jobs = [
            (self.replay, values[first : first + SIMULATIONS], steps) for first in range(0, len(points), SIMULATIONS)
        ]
        # a single part is simulated before a worker has its simulations compiled
        for part in each(Replay.residuals, jobs, self.workers if len(jobs) > 1 else HERE):
            self.log.work += len(part) * steps
            yield part

    def point(self, values: Floats) -> Floats:
        """Parameter values (d,) on the unit cube."""
        return (values - self.low) / self.width


@one_blas_thread
def infer(
    method: str,
    replay: Replay,
    work: str | Path | None = None,
    seed: int = 0,
    progress: SearchProgress = lambda *_: None,
    workers: Workers = HERE,
    **settings: Any,
) -> Posterior:
    """A distribution over the parameters of ``replay``.

    Args:
        method: "rf-dropo" (settings: optimizer, "linearised" or "sampled", and those of that function), "bayes-sim"
            (features, simulations), "droid", "sysid", "dropo" (needs a replay with ``restart=True``).
        work: file of the log of evaluations, from which an interrupted inference goes on; None for none.
        seed: of everything random.
        progress: called with what is done, what there is to do, and the cost so far.
        workers: what simulates, wherever more than SIMULATIONS points are asked for at once.
        settings: of the method.

    Raises:
        ValueError: the method or a setting is not allowed, the log is of another inference, or nothing can be inferred.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    if seed < 0:
        raise ValueError(f"seed {seed}: 0 or more is needed")
    for name, least in _LEAST.items():
        if settings.get(name) is not None and settings[name] < least:
            raise ValueError(f"{settings[name]} {name}; at least {least} are needed")
    if not 0.0 <= (settings.get("start") or 0.0) <= 1.0:
        raise ValueError(f"start {settings['start']}: a share of the search box, from 0 to 1, is needed")
    if (method == "dropo") != replay.restarts:
        raise ValueError("dropo needs a replay that restarts from the recorded states, the other methods one that does "
                         "not")  # fmt: skip
    title = json.dumps([method, seed, settings, replay.fingerprint()], sort_keys=True)
    search = Search(replay, EvaluationLog(work, hashlib.sha256(title.encode()).hexdigest()), seed, progress, workers)
    distribution, estimate, jacobian = _FUNCTIONS[method](search, **settings)
    return _posterior(method, search, distribution, estimate, jacobian, {"seed": seed, **settings})


def _rf_dropo(search: Search, optimizer: str = "linearised", **settings: Any) -> _Found:
    replay = search.replay
    if optimizer not in ("linearised", "sampled"):
        raise ValueError(f"optimizer {optimizer!r}; allowed are linearised and sampled")
    if optimizer == "sampled":
        fit = rf_dropo.sampled(search.residuals, replay.deviation, search.dimension, search.log, search.seed,
                               progress=search.progress, **settings)  # fmt: skip
    else:
        fit = rf_dropo.linearised(search.residuals, replay.deviation, replay.groups, search.dimension, search.log,
                                  search.seed, progress=search.progress, **settings)  # fmt: skip
    mean = search.low + search.width * fit.mean
    # how much the parameters vary, which the likelihood is about, and how well their means are known
    errors = np.sqrt(np.diag(uncertainty(fit.jacobian, replay.deviation)))
    std = np.minimum(np.hypot(fit.std, errors), rf_dropo.LARGEST_STD)
    return TruncatedNormal(replay.names, mean, search.width * std), mean, -fit.jacobian / search.width


def uncertainty(jacobian: Floats, deviation: Floats) -> Floats:
    """(d, d) covariance with which means are known, in shares of the box; its own where a recording says nothing.

    Args:
        jacobian, deviation: see :func:`soro_bench.inference.posterior.fisher`.
    """
    prior = np.eye(jacobian.shape[-1]) / rf_dropo.LARGEST_STD**2
    return np.asarray(np.linalg.inv(fisher(jacobian, deviation) + prior), float)


def _droid(search: Search, iterations: int = 60, popsize: int = 16) -> _Found:
    """Tsai et al., "DROID: minimizing the reality gap using single-shot human demonstration", RA-L 2021: a point
    estimate, by CMA-ES on the squared error of the whole replay."""
    steps, deviation = search.replay.steps, search.replay.deviation

    def cost(points: Floats, share: float) -> Floats:
        def squares(points: Floats) -> Floats:
            return np.asarray(((search.residuals(points, steps) / deviation) ** 2).sum(axis=(1, 2)), float)

        return search.log(squares, points, "squares")

    best = cma_search(cost, search.dimension, iterations, popsize, search.seed, search.progress)
    values = search.low + search.width * best
    return TruncatedNormal(search.replay.names, values, np.zeros(search.dimension)), values, _slope(search, best)


def _sysid(search: Search, max_iterations: int = 30, start: float | None = None, starts: int = 4) -> _Found:
    """Nonlinear least squares by mujoco.sysid; the normal approximation at the optimum.

    It starts from the nominal values, or a share of the search box in every direction. As long as it ends above the
    noise, it starts again from the best of SIMULATIONS random points of the box, ``starts`` times in all.
    """
    replay, steps = search.replay, search.replay.steps
    nominal = np.clip(search.point(np.array([p.nominal for p in replay.parameters])), 0.01, 0.99)
    best = _least_squares(search, nominal if start is None else np.full(search.dimension, start), max_iterations)
    left = search.log(lambda p: search.residuals(p[None], steps)[0], best, "fit")
    if starts > 1 and not _left(replay, left) < EXPLAINED:
        points = np.random.default_rng(search.seed).random((SIMULATIONS, search.dimension))
        costs = search.log(
            lambda p: np.array([_left(replay, one) for one in search.residuals(p, steps)]), points, "rms"
        )
        for point in points[np.argsort(costs, kind="stable")[: starts - 1]]:
            other = _least_squares(search, point, max_iterations)
            found = search.log(lambda p: search.residuals(p[None], steps)[0], other, "fit")
            if _left(replay, found) < _left(replay, left) or np.isnan(_left(replay, left)):
                best, left = other, found
            if _left(replay, left) < EXPLAINED:
                break
    slope = _slope(search, best)
    # not mujoco.sysid's, which knows no prior: what a recording says nothing about would have any variance
    covariance = np.outer(search.width, search.width) * uncertainty(slope * search.width, _deviation(replay, left))
    values = search.low + search.width * best
    return Gaussian(replay.names, values, 0.5 * (covariance + covariance.T)), values, slope


def _left(replay: Replay, residual: Floats) -> float:
    """What a residual (T, k) has of what was measured, rms in standard deviations; NaN if it diverged."""
    return float(np.sqrt(((residual / replay.deviation)[~np.isnan(replay.measured)] ** 2).mean()))


def _least_squares(search: Search, begin: Floats, max_iterations: int) -> Floats:
    """The point (d,) of the unit cube at which least squares end that begin at another."""
    from mujoco import sysid

    replay, steps = search.replay, search.replay.steps
    params = sysid.ParameterDict({
        name: sysid.Parameter(name, float(value), 0.0, 1.0) for name, value in zip(replay.names, begin, strict=True)
    })

    def residual(x: Floats, _params: Any) -> tuple[list[Floats], None, None]:
        # (d,) or, for several points at once, (d, n)
        points = np.reshape(x, (search.dimension, -1)).T
        found = search.log(lambda p: search.residuals(p, steps) / replay.deviation, points, "residual")
        return [np.nan_to_num(found, nan=1e6).reshape(len(points), -1).T.reshape(-1, *np.shape(x)[1:])], None, None

    # forward differences far above the solver's noise
    quiet: dict[str, Any] = {"output": io.StringIO()}  # its own switch does not reach the optimiser
    _, result = sysid.optimize(params, residual, verbose=False, max_iters=max_iterations, eps=1e-4, **quiet)
    return np.asarray(np.clip(np.asarray(result.x, float).ravel(), 0, 1))


def _bayes_sim(search: Search, features: str = "mdn", simulations: int = 1000, samples: int = 2000) -> _Found:
    """Ramos et al., "BayesSim", RSS 2019; see bayes_sim.py."""
    from soro_bench.inference import bayes_sim

    replay = search.replay
    if replay.steps < 2:
        raise ValueError("a recording of 1 step; bayes-sim needs 2 or more for its summaries")
    points = np.random.default_rng(search.seed).random((simulations, search.dimension))
    measured = np.nan_to_num(replay.measured)
    # an entry of the log is SIMULATIONS points, and those that it has are not simulated again
    to_come = search.parts(points[search.log.known * SIMULATIONS :], replay.steps)

    def simulated(first: int, _points: Floats) -> Floats:
        signals = measured - next(to_come)
        # another seed than that of the points, which [seed, 0] is too
        noise = _sensor_noise(replay, len(signals), [search.seed, 1 + first])
        return bayes_sim.summarise(signals + noise, replay.actions)

    parts = []
    for first in range(0, simulations, SIMULATIONS):
        some = points[first : first + SIMULATIONS]
        parts.append(search.log(partial(simulated, first), some, "summary"))
        search.progress(min(first + SIMULATIONS, simulations), simulations, np.nan)
    summaries = np.concatenate(parts)
    sane = np.isfinite(summaries).all(axis=1)
    if (count := sane.sum()) < LEAST_SIMULATIONS:
        raise ValueError(f"{simulations - count} of {simulations} simulations diverged; "
                         f"bayes-sim needs {LEAST_SIMULATIONS} that do not")  # fmt: skip
    estimator = bayes_sim.train(points[sane], summaries[sane], features, search.seed)
    drawn = estimator.sample(bayes_sim.summarise(measured[None], replay.actions)[0], samples, search.seed)
    values = search.low + search.width * drawn.mean(axis=0)
    distribution = TruncatedNormal(replay.names, values, search.width * drawn.std(axis=0))
    return distribution, values, _slope(search, drawn.mean(axis=0))


def _sensor_noise(replay: Replay, count: int, seed: Sequence[int]) -> Floats:
    """(count, T, k) what the sensor would add to simulations, where the recording has samples."""
    normal = np.random.default_rng(seed).standard_normal((count, *replay.measured.shape))
    return np.where(np.isnan(replay.measured), 0.0, replay.sensor_noise * normal)


_FUNCTIONS: dict[str, Callable[..., _Found]] = {
    "rf-dropo": _rf_dropo,
    "dropo": _rf_dropo,
    "droid": _droid,
    "sysid": _sysid,
    "bayes-sim": _bayes_sim,
}


def _slope(search: Search, point: Floats) -> Floats:
    """(T, k, d) derivative of what is simulated with respect to the parameters in their units."""
    return -rf_dropo.logged_jacobian(search.residuals, point, search.replay.steps, search.log) / search.width


def _posterior(
    method: str,
    search: Search,
    distribution: TruncatedNormal | Gaussian,
    estimate: Floats,
    slope: Floats,
    settings: dict[str, Any],
) -> Posterior:
    """What was found, with the fit at the estimate (d,) and what the slope (T, k, d) there says is determined.

    Where the model does not explain the recording, the distribution is widened by what it leaves.
    """
    replay, steps = search.replay, search.replay.steps
    residual = search.log(lambda p: search.residuals(p[None], steps)[0], search.point(estimate), "fit")
    guard = guarded(replay, residual, slope * search.width, search.point(estimate))
    distribution = _widened(search, distribution, slope, guard)
    deviation = guard.widening * replay.deviation if guard.unexplained else _deviation(replay, residual)
    return Posterior(
        method=method,
        distribution=_with_known(distribution, replay.known),
        estimate=dict(zip(replay.names, map(float, estimate), strict=True)),
        fit=rms(replay, residual),
        guard=guard,
        combinations=combinations(slope, deviation, replay.parameters, estimate),
        known=replay.known,
        model=replay.model,
        replay=replay.fingerprint(),
        replays=search.log.work / steps,
        settings=settings,
    )


def _widened(
    search: Search, found: TruncatedNormal | Gaussian, slope: Floats, guard: Guard
) -> TruncatedNormal | Gaussian:
    """A distribution with the errors of its means besides, as far as they come of a model that does not explain."""
    if not guard.unexplained:
        return found
    errors = uncertainty(slope * search.width, guard.widening * search.replay.deviation)
    if isinstance(found, Gaussian):
        errors = np.outer(search.width, search.width) * 0.5 * (errors + errors.T)
        return Gaussian(found.names, found.mean, errors)  # the covariance was of the same errors, as if independent
    std = np.minimum(np.hypot(found.std / search.width, np.sqrt(np.diag(errors))), rf_dropo.LARGEST_STD)
    return TruncatedNormal(found.names, found.mean, search.width * std)


def _deviation(replay: Replay, residual: Floats) -> Floats:
    """(T, k) of the measurement, or what a fit leaves if it is more."""
    return max(1.0, _left(replay, residual)) * replay.deviation


def _with_known(distribution: TruncatedNormal | Gaussian, known: dict[str, float]) -> TruncatedNormal | Gaussian:
    """The distribution together with the known values, which training has to hold as well."""
    names, values, count = (*distribution.names, *known), np.array(list(known.values()), float), len(known)
    mean = np.append(distribution.mean, values)
    if isinstance(distribution, Gaussian):
        return Gaussian(names, mean, np.pad(distribution.cov, (0, count)))
    return TruncatedNormal(names, mean, np.append(distribution.std, np.zeros(count)))
