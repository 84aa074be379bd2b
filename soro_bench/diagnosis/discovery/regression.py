"""Sparse regression of an unknown input over the grammar of laws.

The input is not regressed itself: it is smooth, and known only as far as it moves the robot. What a term would change
in the recordings is regressed on what they need, under the covariance of discretisation and parameters. Responses to
pulses turn a term into that, so thousands of terms cost no replay.

The last resort, a black box, is regressed in the same way: a sum of Gaussian bumps of the state at a place, which is a
Gaussian process with as many inducing points (subset of regressors; Quiñonero-Candela and Rasmussen, "A unifying view
of sparse approximate Gaussian process regression", 2005).
"""

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.optimize import minimize

from soro_bench.arrays import Floats
from soro_bench.diagnosis.discovery.library import Group, Read, Term, groups
from soro_bench.diagnosis.discovery.located_input import LocatedInput
from soro_bench.effects.custom_law import Variable
from soro_bench.effects.effect import Location
from soro_bench.effects.expression import MOST_BUMPS, Bumps, functions_in

_BY_CHANCE = 25.0  # nats, that a coefficient may gain by chance and by the error of the linear response
_RIDGE = 1e-9  # of a Gram matrix, whose columns may be the same
_DISTANCE = "d"
_OF_KIND = 12  # laws of friction, and of memory, that are replayed at least
_GRID, _AROUND, _TRIALS = 5, 0.2, 80  # points a side, m beyond where the body was, and trials of a search for a point
_FALLS: tuple[float, ...] = (0.0, 1.0, -1.0, -2.0, -3.0)  # powers of the distance from a point


@dataclass(frozen=True)
class Candidate:
    """Terms that come together, at a channel of an input; ``point`` [m] is where they pull to, if they do."""

    terms: Group
    channel: int
    point: tuple[float, ...] = ()


@dataclass(frozen=True)
class Structure:
    """A law: candidates with the regressed coefficients of their terms, and the log evidence that these gain [nats].

    x: (d,) parameters of the robot beside it.
    """

    located: LocatedInput
    candidates: tuple[Candidate, ...]
    coefficients: tuple[tuple[float, ...], ...]
    gain: float
    x: Floats

    @property
    def location(self) -> Location:
        """Where the input acts."""
        return self.located.estimate.location


def structures(located: LocatedInput) -> list[Structure]:
    """Laws of one to three terms that explain an input, the largest gain first."""
    library = _candidates(located)
    search = _Search(located, library)
    (one, two, three), least = located.problem.settings.discovery.replayed, _least(located)
    singles = search.with_kinds(search.best([()], len(library), -np.inf), one)
    pairs = search.best(singles[: two // 2], two, least)
    triples = search.best(pairs[:three], three, least)
    found = [search.structure(each) for each in (*singles, *pairs, *triples)]
    return sorted(found, key=lambda each: -each.gain)


def _candidates(located: LocatedInput) -> list[Candidate]:
    frequencies, found = located.peaks(), []
    for channel, reads in enumerate(located.reads):
        found += [Candidate(group, channel) for group in groups(reads, frequencies)]
    for point in _points(located):
        found += [Candidate((_central(power),), 0, point) for power in _FALLS]
    return found


def _points(located: LocatedInput) -> list[tuple[float, ...]]:
    """Points [m] that a force on a body may pull to: the best ones for a power of the distance, and for a spring with
    a length at rest."""
    met, place = located.meeting_point(), located.place
    if met is None or place is None:
        return []
    low, high = place.min(axis=0) - _AROUND, place.max(axis=0) + _AROUND
    grid = np.stack(np.meshgrid(*np.linspace(low, high, _GRID).T, indexing="ij"), axis=-1).reshape(-1, 3)
    starts, found = np.vstack([np.clip(met, low, high), grid]), []
    for powers in ((-2.0,), (0.0, 1.0)):
        start = min(starts, key=lambda each: -_gain_at(located, each, powers))
        best = minimize(lambda each, p=powers: -_gain_at(located, each, p), start, method="Nelder-Mead",
                        options={"maxfev": _TRIALS, "initial_simplex": _simplex(start, _AROUND / 4.0)})  # fmt: skip
        found.append(tuple(float(each) for each in best.x))
    return found


def _simplex(start: Floats, size: float) -> Floats:
    return np.vstack([start, start + size * np.eye(len(start))])


def _gain_at(located: LocatedInput, point: Floats, powers: Sequence[float]) -> float:
    """Log evidence [nats] that pulls to a point gain, by powers of the distance."""
    gram, pull = located.products(np.array([located.at_nodes(located.pulls(point, power)) for power in powers]))
    gram += 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-12 * np.eye(len(gram))
    return 0.5 * float(pull @ np.linalg.solve(gram, pull))


def _central(power: float) -> Term:
    """A power of the distance from a point."""
    variable = Variable(_DISTANCE, "distance", 0.0, 1e6, None, None, ("px", "py", "pz"))
    if power == 0.0:
        return Term(1.0, "1")
    unit = "m" if power == 1.0 else f"m^{power:g}"
    return Term(_DISTANCE if power == 1.0 else ("power", _DISTANCE, power), unit, (variable,))


class _Search:
    """Sets of candidates by the evidence that they gain together."""

    def __init__(self, located: LocatedInput, library: Sequence[Candidate]):
        self.located, self.library = located, library
        forces, self.columns, start = list[Floats](), list[slice](), 0
        for each in library:
            own = [_force(located, each, term) for term in each.terms]
            forces += [located.at_nodes(force) for force in own]
            self.columns.append(slice(start, start + len(own)))
            start += len(own)
        self.gram, self.pull = located.products(np.array(forces))
        self.scale = np.sqrt(np.maximum(np.diag(self.gram), 1e-12))

    def solved(self, chosen: Sequence[int]) -> tuple[float, Floats]:
        """Gain [nats] and coefficients of candidates."""
        columns = np.concatenate([np.arange(self.columns[i].start, self.columns[i].stop) for i in chosen])
        scale = self.scale[columns]
        gram = self.gram[np.ix_(columns, columns)] / np.outer(scale, scale) + _RIDGE * np.eye(len(columns))
        pull = self.pull[columns] / scale
        found = np.linalg.solve(gram, pull)
        return 0.5 * float(pull @ found) - _BY_CHANCE * len(columns), -found / scale

    def best(self, begun: Sequence[tuple[int, ...]], count: int, least: float) -> list[tuple[int, ...]]:
        """The sets with one candidate more that gain most, ``least`` more than without it."""
        gains: dict[tuple[int, ...], float] = {}
        for chosen in begun:
            before = self.solved(chosen)[0] if chosen else 0.0
            for i, each in enumerate(self.library):
                one = tuple(sorted((*chosen, i)))
                apart = {self.library[k].point for k in chosen} | {each.point}
                if i in chosen or one in gains or len(apart) > 1 or self.scale[self.columns[i]].min() <= 1e-6:
                    continue
                gain = self.solved(one)[0]
                if gain > before + least:
                    gains[one] = gain
        forms: dict[object, tuple[int, ...]] = {}  # of the same form with other shapes, the best one
        for one in sorted(gains, key=lambda one: -gains[one]):
            forms.setdefault(frozenset(self._form(i) for i in one), one)
        return list(forms.values())[:count]

    def _form(self, which: int) -> tuple[object, ...]:
        """A candidate without the values of its shapes."""
        each = self.library[which]
        return each.channel, each.point, tuple(term.expression for term in each.terms)

    def with_kinds(self, ranked: Sequence[tuple[int, ...]], count: int) -> list[tuple[int, ...]]:
        """The first ones, and of friction and of what remembers the best ones: where something sticks or lags, what a
        term changes is far from linear."""
        kinds: dict[str, list[tuple[int, ...]]] = {"sign": [], "memory": []}
        for one in ranked:
            for term in self.library[one[0]].terms:
                friction = "sign" in functions_in(term.expression)
                if friction or term.states:
                    kinds["sign" if friction else "memory"].append(one)
        more = [*kinds["sign"][:_OF_KIND], *kinds["memory"][: _OF_KIND // 4]]
        return list(dict.fromkeys([*ranked[:count], *more]))

    def structure(self, chosen: tuple[int, ...]) -> Structure:
        """The law of some candidates."""
        gain, values = self.solved(chosen)
        sizes = np.cumsum([len(self.library[i].terms) for i in chosen])[:-1]
        coefficients = tuple(tuple(map(float, part)) for part in np.split(values, sizes))
        parts = [self.library[i] for i in chosen]
        terms = [(each, term) for each in parts for term in each.terms]
        forces = [value * _force(self.located, *each) for value, each in zip(values, terms, strict=True)]
        x = self.located.parameters(self.located.changed(sum(forces, np.zeros_like(self.located.force))))
        return Structure(self.located, tuple(parts), coefficients, gain, x)


def _power_of(term: Term) -> float:
    """Of the distance in a central force."""
    if isinstance(term.expression, tuple):
        return float(term.expression[2])
    return 1.0 if term.expression == _DISTANCE else 0.0


def _force(located: LocatedInput, candidate: Candidate, term: Term) -> Floats:
    """(T, K) of a term with a coefficient of one."""
    force = np.zeros_like(located.force)
    if candidate.point:
        force[:] = located.pulls(np.array(candidate.point), _power_of(term))
    else:
        force[:, candidate.channel] = located.feature(term, candidate.channel)
    return force


# --- black boxes ---

_FOREIGN = 6  # variables of other elements, those that explain most alone, that are tried beside own ones
_WIDTHS = (0.5, 0.7, 1.0, 2.0)  # of bumps, in standard deviations of each variable
_SCALES = (0.1, 0.3, 1.0)  # prior deviations of weights, in rms of the input; larger ones replay worse
_NEGLIGIBLE = 1e-3  # of the largest channel; a force across a joint moves nothing


@dataclass(frozen=True)
class _Fit:
    """Bumps of every channel, their weights, and the log evidence of these [nats]."""

    bumps: tuple[tuple[int, tuple[Read, ...], Floats, Floats], ...]  # channel, variables, widths, centres (n, K)
    weights: Floats
    gain: float


def black_box(located: LocatedInput, seed: int) -> Structure | None:
    """The structure of most evidence; None where none explains anything. Its parameters are factors of each channel.

    Of two variables one is the place's own, where it has any, and a further or a foreign one has to explain so much
    more as a further term of a law does.
    """
    moving = [each for reads in located.reads for each in _moving(reads)]
    own = {each.name for each in moving if each.variable.place is None}
    least, fits = _least(located), dict[tuple[str, ...], _Fit]()

    def worth(names: tuple[str, ...]) -> float:
        return fits[names].gain - least * (len(names) + sum(name not in own for name in names))

    for name in dict.fromkeys(each.name for each in moving):
        fits[name,] = _of_best_width(located, (name,), seed)
    singles = [name for (name,) in sorted(fits, key=worth, reverse=True)]
    foreign = [name for name in singles if name not in own][:_FOREIGN]
    begun = [name for name in singles if name in own] or foreign[:1]
    for pair in itertools.product(begun, [*begun, *foreign]):
        if len(set(pair)) == len(pair) and pair[::-1] not in fits:
            fits[pair] = _of_best_width(located, pair, seed)
    best = max(fits, key=worth, default=None)
    if best is None or worth(best) <= 0.0:
        return None
    for name in [*begun, *foreign]:
        if name not in best:
            fits[*best, name] = _of_best_width(located, (*best, name), seed)
    return _structure(located, fits[max(fits, key=worth)])


def _of_best_width(located: LocatedInput, names: tuple[str, ...], seed: int) -> _Fit:
    """The fit of the width of most evidence."""
    return max((_fit(located, names, width, seed) for width in _WIDTHS), key=lambda each: each.gain)


def _least(located: LocatedInput) -> float:
    """Log evidence [nats] that one more term or variable has to gain."""
    return located.problem.settings.selection.least_gain_of_misfit * located.explained


def _moving(reads: Sequence[Read]) -> list[Read]:
    """Positions, velocities and commands that change. A motor's force follows from what is looked for."""
    return [each for each in reads if each.variable.of not in ("time", "force") and each.values.std() > 1e-9]


def _fit(located: LocatedInput, names: Sequence[str], width: float, seed: int) -> _Fit:
    parts, forces = [], list[Floats]()
    for channel, reads in enumerate(located.reads):
        used = tuple(each for each in _moving(reads) if each.name in names)
        if not used:
            continue
        values = np.stack([each.values for each in used], axis=1)
        deviations = values.std(axis=0)
        centres = _centres(values / deviations, MOST_BUMPS, seed) * deviations
        parts.append((channel, used, width * deviations, centres))
        apart = (values[:, None] - centres) / (width * deviations)
        for column in np.exp(-0.5 * (apart**2).sum(axis=2)).T:
            force = np.zeros_like(located.force)
            force[:, channel] = column * _rms(located, channel)
            forces.append(located.at_nodes(force))
    gain, weights = _weights(located, np.array(forces))
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the mean of an empty cluster stays where it was
        return np.asarray(kmeans2(values, values[chosen], minit="matrix", rng=rng)[0])


def _weights(located: LocatedInput, forces: Floats) -> tuple[float, Floats]:
    """Log evidence [nats] of bumps that are forces (n, N) at the nodes, and their weights (n,)."""
    gram, pull = located.products(forces)
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
