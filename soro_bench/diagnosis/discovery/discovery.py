"""A law outside the catalogue, from the input that explains a residual: regressed, fitted by replays, tested."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.discovery.law_terms import LawTerm, law_terms
from soro_bench.diagnosis.discovery.located_input import LocatedInput, channels
from soro_bench.diagnosis.discovery.regression import Structure, black_box, structures
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, allowing, bounds, fitted, with_covariance
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.ranking import RankedLocation
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.stopping import explained_beyond_chance
from soro_bench.diagnosis.settings import ProbabilitySettings
from soro_bench.effects.effect import Effect, Location
from soro_bench.effects.expression import bumps_in

_SEED = 900  # of samples, after those of other stages
_SHARES = (0.5, 1.0)  # of regressed coefficients that are replayed
_TESTED_PART = 0.3  # of a recording, its end, where nothing was held out


@dataclass(frozen=True)
class Found:
    """A fitted law and what it leaves.

    structure: what it came of. misfit: above the noise, of the recordings fitted to and of those held out [nats].
    probabilities: say what unknowns gain by chance.
    """

    structure: Structure
    hypothesis: Hypothesis
    misfit: float
    heldout_misfit: float
    probabilities: ProbabilitySettings

    @property
    def boxed(self) -> bool:
        """Whether it is a black box instead of a law."""
        return boxed(self.structure)

    @property
    def total(self) -> float:
        """Misfit of all recordings, with what its unknowns gain by chance [nats]."""
        chance = self.probabilities.gain_of_unknown * sum(each.size for each in self.hypothesis.terms)
        return self.misfit + self.heldout_misfit + chance


@dataclass(frozen=True)
class Discovery:
    """What became of the search for a law.

    best: the law, or else a black box; None where neither holds on held-out motion. others: laws that leave about as
    much. location: where it acts. heldout_before, heldout_nearest, heldout_after: mean square of the held-out residual,
    in units of the sensor's noise: of fitted parameters, of the catalogue's best answer, and with the law (NaN if
    none). own_test: whether the ends of the recordings were held out, as nothing else was. peaks: Hz, of the spectrum
    of the input, the largest first. located: the input.
    """

    best: Found | None
    others: tuple[Found, ...]
    location: Location
    heldout_before: float
    heldout_nearest: float
    heldout_after: float
    own_test: bool
    peaks: tuple[float, ...]
    located: LocatedInput

    @property
    def explained(self) -> float:
        """Share of the held-out mean square that the law explains."""
        return 1.0 - self.heldout_after / self.heldout_before

    @property
    def noise_share(self) -> float:
        """Share of the held-out mean square that is the sensor's noise, which nothing explains."""
        return 1.0 / self.heldout_before

    @property
    def beats(self) -> float:
        """What the law leaves of held-out motion above the noise, over what the catalogue's best answer leaves."""
        return max(self.heldout_after - 1.0, 0.0) / max(self.heldout_nearest - 1.0, 1e-9)


def boxed(structure: Structure) -> bool:
    """Whether a structure is a black box instead of a law."""
    return any(bumps_in(term.expression) for each in structure.candidates for term in each.terms)


def discovered(
    problem: Problem, tested: Problem | None, robot: Robot, nominal: Hypothesis, nearest: Hypothesis,
    ranked: Sequence[RankedLocation], seed: int,
) -> Discovery | None:  # fmt: skip
    """The law outside the catalogue at one of the places where an unknown input explains most; None where no law can
    act there.

    Args:
        problem: of the recordings fitted to. tested: of held-out ones. nominal: the robot with fitted parameters.
        nearest: the catalogue's best answer.
        ranked: locations, the best first.
    """
    settings, alike = problem.settings.discovery, problem.settings.selection.turn_gain
    estimates = sorted((each for site in ranked for each in site.estimates), key=lambda each: -each.gain)
    near = [each for each in estimates if each.gain > settings.location_share * estimates[0].gain]
    near = [each for each in near if channels(robot, each.source)][: problem.settings.selection.kept]
    if not near:
        return None
    begun, own = (problem, False) if tested else (_beginning(problem), True)
    test = tested or _end(problem)
    inputs = [LocatedInput(problem, robot, nominal, each) for each in near]
    before, with_nearest = (_mean_square(test, each) for each in (nominal, nearest))
    laws = [each for located in inputs for each in structures(located)]
    fitted_on, found = _fitted(begun, test, nominal, laws, seed)
    peaks = tuple(each / (2.0 * np.pi) for each in inputs[0].peaks())
    nothing = Discovery(None, (), near[0].location, before, with_nearest, np.nan, own, peaks, inputs[0])
    best = None
    if found:
        best = _simplified(fitted_on, test.with_noise_of(fitted_on), _simplest(found, alike), seed)
        best = _as_seen(best, fitted_on, test)
    after = _mean_square(test, best.hypothesis) if best else np.nan
    if best is None or not _holds(test, nominal, best, settings.least_explained):
        nothing = replace(nothing, heldout_after=after)
        fitted_on, best = _boxed(begun, test, nominal, inputs[0], seed)
        found, after = [], _mean_square(test, best.hypothesis) if best else np.nan
        if best is None or not _holds(test, nominal, best, settings.least_removed):
            return nothing
    kept = replace(best, hypothesis=_of_problem(with_covariance(fitted_on, best.hypothesis, seed), fitted_on, problem))
    others = tuple(each for each in found if each is not best and each.total < best.total + _slack(best, alike))
    location, located = best.structure.location, best.structure.located
    return Discovery(kept, others, location, before, with_nearest, after, own, peaks, located)


def _holds(test: Problem, nominal: Hypothesis, found: Found, least: float) -> bool:
    """Whether a law holds on held-out motion: it explains so large a share of what is above the noise, and not by
    chance. What its parameters explain without it, where they do so better than the nominal ones, does not count."""
    law = found.hypothesis
    rows = test.residuals([(nominal.x, nominal.terms), (law.x[: test.parameters], ()), (law.x, law.terms)])
    nothing, alone, after = (_in_noise(test, row) for row in rows)
    before, row = (alone, rows[1]) if alone < nothing else (nothing, rows[0])
    share = 1.0 - max(after - 1.0, 0.0) / max(before - 1.0, 1e-9)
    return share >= least and explained_beyond_chance(test, row, share, min(1.0 / before, 1.0))


def _boxed(
    problem: Problem, test: Problem, nominal: Hypothesis, located: LocatedInput, seed: int
) -> tuple[Problem, Found | None]:
    """The black box at a place, and the problem that it is fitted to; held-out motion has no say in which one it is."""
    box = black_box(located, seed)
    problem, found = _fitted(problem, test, nominal, [box] if box else [], seed)
    return problem, found[0] if found else None


def _fitted(
    problem: Problem, test: Problem, nominal: Hypothesis, found: Sequence[Structure], seed: int
) -> tuple[Problem, list[Found]]:
    """Fits of the structures that leave least with regressed coefficients, the best first; and their problem, whose
    noise is what the best of them leaves where that is more than the sensor's."""
    settings = problem.settings.discovery
    pairs = [(each, law_terms(each)) for each in found]
    pairs = [pair for pair in pairs if _one_a_place(*pair) and problem.robot.accepts(_begun(pair[1]))]
    if not pairs:
        return problem, []
    starts = [(pair, _start(nominal, problem, *pair, share)) for pair in pairs for share in _SHARES]
    rows = problem.residuals([(x, terms) for (_, terms), x in starts])
    costs = [float((problem.discretisation.without(row) ** 2).sum()) for row in rows]
    left = [each // 2 for each in settings.replayed]
    chosen: list[tuple[tuple[Structure, tuple[LawTerm, ...]], Floats]] = []
    for i in np.argsort(costs, kind="stable").tolist():
        (structure, _), _ = starts[i]
        size = 0 if boxed(structure) else len(structure.candidates) - 1
        if left[size] and all(structure is not other[0] for other, _ in chosen):
            left[size] -= 1
            chosen.append(starts[i])
    if not chosen:
        return problem, []
    radii = problem.settings.selection.fit_radius, problem.settings.selection.fit_radius_last
    guesses = [Guess(x, terms) for (_, terms), x in chosen]
    once = fitted(problem, guesses, radii, seed + _SEED)
    problem, once = allowing(problem, min(once, key=lambda h: h.cost), once)
    test = test.with_noise_of(problem)
    results = _judged(problem, test, [pair[0] for pair, _ in chosen], once)[: settings.replayed[-1]]
    again = [Guess(each.hypothesis.x, each.hypothesis.terms) for each in results]
    more = fitted(problem, again, radii[1:], seed + _SEED + 1)
    better = [min(pair, key=lambda h: h.cost) for pair in zip((r.hypothesis for r in results), more, strict=True)]
    problem, better = allowing(problem, min(better, key=lambda h: h.cost), better)
    return problem, _judged(problem, test.with_noise_of(problem), [each.structure for each in results], better)


def _one_a_place(structure: Structure, terms: Sequence[LawTerm]) -> bool:
    """Whether each of its laws has a place of its own; the force of a black box may have several components."""
    return boxed(structure) or len({each.location for each in terms}) == len(terms)


def _begun(terms: Sequence[LawTerm]) -> list[Effect]:
    """The effects that a fit begins with."""
    return [effect for each in terms for effect in each.effects(each.simulated)]


def _judged(
    problem: Problem, test: Problem, found: Sequence[Structure], hypotheses: Sequence[Hypothesis]
) -> list[Found]:
    """The hypotheses with what they leave, the least first."""
    rows = test.residuals([(h.x, h.terms) for h in hypotheses])
    judged = [
        Found(structure, h, problem.misfit(h.residual), test.misfit(row), problem.settings.probabilities)
        for structure, h, row in zip(found, hypotheses, rows, strict=True)
    ]
    return sorted(judged, key=lambda each: each.total)


def _start(
    nominal: Hypothesis, problem: Problem, structure: Structure, terms: Sequence[LawTerm], share: float
) -> Floats:
    """(n,) unknowns on the way from the nominal robot to the regressed ones."""
    without = nominal.x[: problem.parameters]
    x = np.clip(without + share * (structure.x - without), *bounds(problem, ()))
    return np.concatenate([x, *(share * each.simulated for each in terms)])


def _slack(best: Found, alike: float) -> float:
    """By how much another law may leave more than the best one and be as good [nats]."""
    return alike * max(best.misfit + best.heldout_misfit, 0.0) + best.probabilities.gain_of_term


def _simplified(problem: Problem, test: Problem, whole: Found, seed: int) -> Found:
    """The law without those of its terms that it does not need: fitted again without each in turn."""
    while len(whole.structure.candidates) > 1:
        less = [_without(whole, i, problem.parameters) for i in range(len(whole.structure.candidates))]
        guesses = [Guess(x, terms) for _, terms, x in less]
        selection = problem.settings.selection
        fits = fitted(problem, guesses, (selection.fit_radius, selection.fit_radius_last), seed + _SEED + 2)
        best = _judged(problem, test, [structure for structure, _, _ in less], fits)[0]
        if best.total > whole.total + _slack(whole, problem.settings.selection.turn_gain):
            break
        whole = best
    return whole


def _as_seen(found: Found, problem: Problem, test: Problem) -> Found:
    """The law with the ranges that its variables had in all recordings."""
    hypothesis, located = found.hypothesis, found.structure.located
    effects = hypothesis.effects(problem.parameters)
    terms = [
        replace(term, law=located.seen(effect, test, hypothesis.x, effects)) if isinstance(term, LawTerm) else term
        for term, effect in zip(hypothesis.terms, effects, strict=True)
    ]
    return replace(found, hypothesis=replace(hypothesis, terms=tuple(terms)))


def _without(found: Found, which: int, parameters: int) -> tuple[Structure, tuple[LawTerm, ...], Floats]:
    """A law without one of its candidates: its structure and terms, and unknowns that begin where the others were."""
    structure, coordinates = found.structure, found.hypothesis.x[parameters:].tolist()
    unknowns = [each for term in found.hypothesis.terms if isinstance(term, LawTerm) for each in term.unknowns]
    fitted_values = iter([each.value(x) for each, x in zip(unknowns, coordinates, strict=True) if each.is_coefficient])
    shapes = {each.name: x for each, x in zip(unknowns, coordinates, strict=True) if not each.is_coefficient}
    order = sorted(range(len(structure.candidates)), key=lambda i: structure.candidates[i].channel)
    values = {i: tuple(next(fitted_values) for _ in structure.candidates[i].terms) for i in order}
    kept = [i for i in range(len(structure.candidates)) if i != which]
    less = Structure(structure.located, tuple(structure.candidates[i] for i in kept),
                     tuple(values[i] for i in kept), structure.gain, structure.x)  # fmt: skip
    terms = law_terms(less)
    starts = [shapes.get(each.name, each.start) for term in terms for each in term.unknowns]
    return less, terms, np.concatenate([found.hypothesis.x[:parameters], starts])


def _simplest(found: Sequence[Found], alike: float) -> Found:
    """Of the laws that are about as good as the best one, that with the fewest unknowns; forces before setpoints."""
    best = found[0]
    close = [each for each in found if each.total <= best.total + _slack(best, alike)]
    return min(close, key=_complexity)


def _complexity(found: Found) -> tuple[int, bool, float]:
    """How much a law has: unknowns, whether it moves a setpoint, and what it leaves."""
    terms = found.hypothesis.terms
    return sum(each.size for each in terms), any(each.location.kind == "actuator" for each in terms), found.total


def _mean_square(problem: Problem, hypothesis: Hypothesis) -> float:
    """Of the residual of a hypothesis, in units of the sensor's noise."""
    return _in_noise(problem, problem.residuals([(hypothesis.x, hypothesis.terms)])[0])


def _in_noise(problem: Problem, residual: Floats) -> float:
    """Mean square of a residual (M,), in units of the sensor's noise."""
    in_noise = residual * (problem.of_samples(problem.of_columns(problem.sigmas) / problem.of_columns(problem.sensors)))
    return float((in_noise**2).sum() / problem.weight.sum())


def _of_problem(hypothesis: Hypothesis, fitted_on: Problem, problem: Problem) -> Hypothesis:
    """A fit of a problem with other noise, or of a part of its recordings, as one of the problem; its covariance is
    that of the fit."""
    known = hypothesis.covariance(fitted_on)
    same = hypothesis.scaled(problem, fitted_on.factor_to(problem))
    (residual,) = problem.residuals([(same.x, same.terms)])
    return replace(same, residual=residual, cost=problem.cost(residual, same.x), known=known)


def _beginning(problem: Problem) -> Problem:
    """The problem of which the end of every recording does not count."""
    return _weighted(problem, first=True)


def _end(problem: Problem) -> Problem:
    """The problem of which only the end of every recording counts."""
    return _weighted(problem, first=False)


def _weighted(problem: Problem, first: bool) -> Problem:
    parts = []
    for row in problem.rows(problem.weight):
        begins = (np.arange(len(row)) < (1.0 - _TESTED_PART) * len(row))[:, None]
        parts.append((row * (begins if first else ~begins)).ravel())
    weight = np.concatenate(parts)
    basis = problem.discretisation.basis * weight
    return replace(problem, weight=weight, discretisation=type(problem.discretisation)(basis))
