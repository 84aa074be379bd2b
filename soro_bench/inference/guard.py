"""What an inference has to say of itself: how far nominal parameters are, bounds, and a model that does not explain.

A method finds the best parameters of its model, whether or not the model is right. The same checks follow every method.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from soro_bench.arrays import Bools, Floats
from soro_bench.inference.replay import Replay

FAR = 3.0  # standard deviations of the noise, rms: white noise leaves 1, and never 2 in a hundred samples
OF_MOTION = 0.01  # what replays of the right model leave is below 0.4 % of the motion, where a search ended early
WORSE = 1.01  # times the nominal error: less is no difference that anybody would act upon
AT_BOUND = 0.005  # of the width of the search box


@dataclass(frozen=True)
class Guard:
    """What is said of an estimate.

    nominal: rms of measured less simulated with nominal parameters, by signal, in its unit.
    worse: signals of which the estimate leaves more than nominal parameters do.
    at_bounds: "lower" or "upper" by the parameters that are at a bound of their search box.
    misfit: rms over the noise of what no change of the parameters nearby would take away, by signal.
    unexplained: signals of which that is far above the noise, and a part of the motion.
    widening: how many times wider intervals are than those of white noise.
    """

    nominal: dict[str, float]
    worse: tuple[str, ...] = ()
    at_bounds: dict[str, str] = field(default_factory=dict)
    misfit: dict[str, float] = field(default_factory=dict)
    unexplained: tuple[str, ...] = ()
    widening: float = 1.0

    def to_dict(self) -> dict[str, object]:
        """As a posterior's file has it; None for what a replay that diverges leaves."""
        return {
            "nominal_fit": {name: finite(value) for name, value in self.nominal.items()},
            "worse_than_nominal": list(self.worse),
            "at_bounds": self.at_bounds,
            "misfit_over_noise": {name: finite(value) for name, value in self.misfit.items()},
            "unexplained": list(self.unexplained),
            "widening": finite(self.widening),
        }


def finite(value: float) -> float | None:
    """A number for JSON, which has no infinite ones; None for one of those, as where a replay diverges."""
    return value if math.isfinite(value) else None


def guarded(replay: Replay, residual: Floats, slope: Floats, point: Floats) -> Guard:
    """The checks of an estimate.

    Args:
        residual: (T, k) measured less simulated there, 0 where nothing was measured; NaN from where it diverged.
        slope: (T, k, d) derivative of what is simulated with respect to the unit cube of the search box.
        point: (d,) the estimate on that cube.
    """
    nominal, left = rms(replay, replay.nominal_residual), rms(replay, residual)
    noise = noise_of(replay)
    worse = tuple(name for name in nominal if not left[name] <= max(WORSE * nominal[name], noise[name]))
    misfit = {name: _unreachable(replay, residual, slope, point, group, seen) for name, group, seen in _groups(replay)}
    moved = {name: motion(replay.measured[:, group]) for name, group, _ in _groups(replay)}
    unexplained = tuple(
        name for name, times in misfit.items() if times > FAR and times * noise[name] > OF_MOTION * moved[name]
    )
    ends = {name: "lower" if x < 0.5 else "upper" for name, x in zip(replay.names, point, strict=True)
            if not AT_BOUND < x < 1.0 - AT_BOUND}  # fmt: skip
    return Guard(nominal, worse, ends, misfit, unexplained, _widening(replay, residual, unexplained))


def rms(replay: Replay, residual: Floats) -> dict[str, float]:
    """Root mean square of a residual (T, k) over what was measured, by signal, in its unit."""
    return {name: float(np.sqrt((residual[:, group][seen] ** 2).mean())) for name, group, seen in _groups(replay)}


def noise_of(replay: Replay) -> dict[str, float]:
    """Standard deviation of the noise by signal, in its unit: of the sensor and of what a simulation is trusted to."""
    return {name: float(np.sqrt((replay.deviation[:, group][seen] ** 2).mean()))
            for name, group, seen in _groups(replay)}  # fmt: skip


def motion(values: Floats) -> float:
    """Root mean square over time of measured numbers (T, n) about their means, NaN where missing."""
    known = values[:, ~np.isnan(values).all(axis=0)]
    return float(np.sqrt(np.nanmean((known - np.nanmean(known, axis=0)) ** 2)))


def independent(residual: Floats, seen: Bools) -> float:
    """The number of samples of white noise that say as much as a residual, 1 or more.

    Numbers that are alike over time count once in an integrated autocorrelation time (up to where it is lost, Geyer,
    "Practical Markov chain Monte Carlo", Statistical Science 7(4), 1992), and those of one time as many as the
    participation ratio of their covariance says.

    Of a change, ``diagnosis/paired/problem.py`` counts them by the same idea, but not to the same number: here the sum
    ends at the first lag that is not alike, each lag is weighed by what was measured at both ends, and where much is
    missing there may be more samples than were measured.

    Args:
        residual: (T, n) in units of its noise, 0 where nothing was measured.
        seen: (T, n) which numbers were measured. Steps without any do not count: a sensor may be slower than control.
    """
    rows = seen.any(axis=1)
    residual, weight = residual[rows], seen[rows].astype(float)
    steps, size = residual.shape
    power, count = float((residual**2).sum()), float(weight.sum())
    if power == 0.0:
        return max(count, 1.0)
    time = 1.0
    for lag in range(1, steps):
        both = float((weight[lag:] * weight[:-lag]).sum())
        if both == 0.0:
            continue
        # of a whole residual the sum over power, which weighs distant lags less
        share = both / count * steps / (steps - lag)
        alike = float((residual[lag:] * residual[:-lag]).sum()) / power / share
        if alike <= 0.0:
            break
        time += 2.0 * alike
    covariance = residual.T @ residual if size <= steps else residual @ residual.T
    columns = power**2 / float((covariance**2).sum())
    return max(steps / time * columns, 1.0)


def _groups(replay: Replay) -> list[tuple[str, slice, Bools]]:
    """Name, columns and which of their samples (T, n) were measured, of every signal."""
    seen = ~np.isnan(replay.measured)
    return [(name, group, seen[:, group]) for name, group in zip(replay.signal_names, replay.groups, strict=True)]


def _unreachable(replay: Replay, residual: Floats, slope: Floats, point: Floats, group: slice, seen: Bools) -> float:
    """rms over the noise of what of a signal's residual no step inside the search box takes away, to first order."""
    white = (residual[:, group] / replay.deviation[:, group])[seen]
    steps = (slope[:, group] / replay.deviation[:, group][..., None])[seen]
    if not np.isfinite(white).all():
        return math.inf
    if not np.isfinite(steps).all():
        return float(np.sqrt((white**2).mean()))
    found = lsq_linear(steps, white, bounds=(np.minimum(-point, -1e-9), np.maximum(1.0 - point, 1e-9)))
    return float(np.sqrt(2.0 * found.cost / white.size))


def _widening(replay: Replay, residual: Floats, unexplained: tuple[str, ...]) -> float:
    """How many times wider intervals are: the rms over the noise, and the samples that are not independent."""
    columns = [group for name, group, _ in _groups(replay) if name in unexplained]
    if not columns:
        return 1.0
    white = np.concatenate([(residual / replay.deviation)[:, group] for group in columns], axis=1)
    seen = np.concatenate([each for name, _, each in _groups(replay) if name in unexplained], axis=1)
    count = int(seen.sum())
    if not np.isfinite(white).all():
        return math.inf
    return float(np.sqrt((white**2).sum() / count) * np.sqrt(max(count / independent(white, seen), 1.0)))
