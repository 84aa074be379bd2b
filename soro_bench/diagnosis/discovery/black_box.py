"""The last resort where no law of the grammar holds: a Gaussian process of the state at a place, as a sum of bumps.

A process with as many inducing points as there are bumps (subset of regressors; Quiñonero-Candela and Rasmussen, "A
unifying view of sparse approximate Gaussian process regression", 2005). As with laws (regression.py), what a bump would
change in the recordings is regressed, not the estimated input.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2

from soro_bench.arrays import Floats
from soro_bench.diagnosis.discovery.library import Read, Term
from soro_bench.diagnosis.discovery.located_input import LocatedInput
from soro_bench.diagnosis.discovery.regression import Candidate, Structure
from soro_bench.effects.expression import Bumps

_MOST = 3  # variables of a black box; sixteen bumps fill no more dimensions
_WIDTHS = (0.5, 1.0, 2.0)  # of bumps, in standard deviations of each variable
_SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)  # prior deviations of weights, in rms of the input
_NEGLIGIBLE = 1e-3  # of the largest channel; a force across a joint moves nothing
_LEAST_GAIN = 25.0  # nats, of a further variable; as a term of a law may gain by chance


@dataclass(frozen=True)
class _Fit:
    """Bumps of every channel, their weights, and the log evidence of these [nats]."""

    bumps: tuple[tuple[int, tuple[Read, ...], Floats, Floats], ...]  # channel, variables, widths, centres (n, K)
    weights: Floats
    gain: float


def black_box(located: LocatedInput, seed: int) -> Structure | None:
    """The structure of most evidence, its variables chosen one by one; None where none explains anything.

    Its parameter is a factor of one for every channel.
    """
    best, chosen = None, list[str]()
    moving = [each for reads in located.reads for each in _moving(reads)]
    for own in (True, False):  # what the place does itself comes first
        names = dict.fromkeys(each.name for each in moving if (each.variable.place is None) == own)
        while len(chosen) < _MOST and (left := [name for name in names if name not in chosen]):
            fits = [(_fit(located, [*chosen, name], width, seed), name) for name in left for width in _WIDTHS]
            fit, name = max(fits, key=lambda pair: pair[0].gain)
            if fit.gain < (best.gain if best else 0.0) + _LEAST_GAIN:
                break
            best = fit
            chosen.append(name)
    return _structure(located, best) if best else None


def _moving(reads: Sequence[Read]) -> list[Read]:
    """Positions, velocities and commands that change. A motor's force follows from what is looked for."""
    return [each for each in reads if each.variable.of not in ("time", "force") and each.values.std() > 1e-9]


def _fit(located: LocatedInput, names: Sequence[str], width: float, seed: int) -> _Fit:
    parts, rows = [], list[Floats]()
    for channel, reads in enumerate(located.reads):
        used = tuple(each for each in _moving(reads) if each.name in names)
        if not used:
            continue
        values = np.stack([each.values for each in used], axis=1)
        deviations = values.std(axis=0)
        centres = _centres(values / deviations, located.problem.settings.discovery.bumps, seed) * deviations
        parts.append((channel, used, width * deviations, centres))
        apart = (values[:, None] - centres) / (width * deviations)
        for column in np.exp(-0.5 * (apart**2).sum(axis=2)).T:
            force = np.zeros_like(located.force)
            force[:, channel] = column * _rms(located, channel)
            rows.append(located.changed(force))
    gain, weights = _weights(located, np.array(rows))
    return _Fit(tuple(parts), weights, gain)


def _rms(located: LocatedInput, channel: int) -> float:
    return float(np.sqrt((located.force[:, channel] ** 2).mean())) or 1.0


def _centres(values: Floats, count: int, seed: int) -> Floats:
    """(n, K) means of clusters of values (T, K), which begin as far apart as they can."""
    first = int(np.argmin(((values - np.median(values, axis=0)) ** 2).sum(axis=1)))
    chosen, apart = [first], ((values - values[first]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(values)) and apart.max() > 0.0:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, ((values - values[chosen[-1]]) ** 2).sum(axis=1))
    rng = np.random.default_rng(seed)  # begins nothing here, as all means are given
    return np.asarray(kmeans2(values, values[chosen], minit="matrix", rng=rng)[0])


def _weights(located: LocatedInput, rows: Floats) -> tuple[float, Floats]:
    """Log evidence [nats] of bumps that change the residual by rows (n, M), and their weights (n,)."""
    white = located.covariance.white(np.vstack([rows, located.origin]))
    gram = rows @ rows.T - white[:-1] @ white[:-1].T
    pull = rows @ located.origin - white[:-1] @ white[-1]
    size, vectors = np.linalg.eigh(gram)
    size, turned = np.maximum(size, 0.0), vectors.T @ pull
    found = []
    for scale in _SCALES:
        gain = 0.5 * float((turned**2 / (size + scale**-2)).sum() - np.log1p(scale**2 * size).sum())
        found.append((gain, -vectors @ (turned / (size + scale**-2))))
    return max(found, key=lambda pair: pair[0])


def _structure(located: LocatedInput, fit: _Fit) -> Structure:
    candidates, coefficients = [], []
    changed = np.zeros_like(located.origin)
    ends = np.cumsum([len(centres) for *_, centres in fit.bumps])[:-1]
    parts = np.split(fit.weights, ends)
    sizes = [float(np.abs(part).max()) * _rms(located, bumps[0]) for bumps, part in zip(fit.bumps, parts, strict=True)]
    for (channel, used, widths, centres), weights, size in zip(fit.bumps, parts, sizes, strict=True):
        if size <= _NEGLIGIBLE * max(sizes):
            continue
        largest = float(np.abs(weights).max())
        rows = np.column_stack([centres, weights / largest])
        bumps = Bumps(
            tuple(each.name for each in used), tuple(map(float, widths)), tuple(tuple(map(float, row)) for row in rows)
        )
        term = Term(bumps, "1", tuple(each.variable for each in used))
        candidates.append(Candidate((term,), channel))
        coefficients.append((size,))
        force = np.zeros_like(located.force)
        force[:, channel] = coefficients[-1][0] * located.feature(term, channel)
        changed = changed + located.changed(force)
    return Structure(located, tuple(candidates), tuple(coefficients), fit.gain, located.parameters(changed))
