"""Which change between two recordings explains their difference, and how large it is."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import expit

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, term
from soro_bench.diagnosis.data_quality.noise import data_quality, outliers
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.paired import result
from soro_bench.diagnosis.paired.alignment import Pair
from soro_bench.diagnosis.paired.changes import LawChange, ParameterChange, possible_changes
from soro_bench.diagnosis.paired.fit import (
    Fit,
    evidence,
    finalists,
    fitted_alone,
    fitted_shared,
    fitted_together,
    screened,
)
from soro_bench.diagnosis.paired.problem import PairedProblem, Point
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.result_parts import Estimate
from soro_bench.diagnosis.robots.measured import Measured, ObservedSignal
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import StageProgress
from soro_bench.diagnosis.settings import Settings
from soro_bench.effects.effect import EVERY, Location
from soro_bench.recording.recording import RecordingError

_MOST_STEPS = 1500  # control steps of all pairs that are simulated; the rest is compared without it
_DRAWS = 400  # of the posterior, for intervals of sizes that are not linear in the unknowns


def explained(
    robot: Robot,
    pairs: Sequence[Pair],
    seed: int,
    progress: StageProgress,
    settings: Settings,
) -> result.Explanation:
    """The change that explains the difference of pairs of recordings, in all signals of the robot that they have.

    Raises:
        RecordingError: a recording lacks something that the robot needs.
        SimulationError: the simulation diverges.
    """
    robot, (sigma, *others) = _compared(robot, pairs, settings)
    before, after, notes = _measured(robot, pairs, settings)
    progress("fit of the parameters before the change")
    sizes = [each.size for each in robot.signals]
    scales = np.repeat([1.0, *(sigma / each for each in others)], sizes) if others else 1.0
    problem = PairedProblem(robot, before, after, _shared(robot), settings, scales=scales)
    nominal, fit = nominal_fit(unexplained(robot, before, sigma, settings, others), [], seed)
    nominal.check_finite(robot, nominal.simulated(robot, [(fit.x, ())]))
    start = np.concatenate([fit.x, np.zeros(sum(s.size for s in problem.shared))])
    problem, base = _before_change(problem, start, sigma, settings)
    search = _Search(problem, base, possible_changes(robot), sigma, seed, settings, progress)
    search.run()
    return search.explanation(tuple(notes))


def _compared(robot: Robot, pairs: Sequence[Pair], settings: Settings) -> tuple[Robot, list[float]]:
    """The robot with those of its other signals that move, and the noise of each signal.

    Raises:
        RecordingError: the first signal does not move, or has too few samples.
    """
    sides = [each for pair in pairs for each in (pair.before, pair.after)]
    measured = [robot.measured(side) for side in sides]
    kept: list[ObservedSignal] = []
    noises = []
    for which, signal in enumerate(robot.signals):
        seen = [each.only(which, signal) for each in measured]
        with suppress(*(RecordingError,) if which else ()):  # too few samples, or one value only: nothing to compare
            noises.append(max(data_quality(each, settings.data_quality).sigma for each in seen))
            kept += [replace(signal, reach=max(each.reach for each in seen))] if which else []
    return robot.explaining(kept), noises


def _shared(robot: Robot) -> tuple[Term, ...]:
    """Laws that both recordings have anyway: nearly every real robot is late, and the difference with it."""
    late = term(robot, "sensor_delay", Location("sensor", EVERY if robot.others else robot.signal))
    known = [(e.name, e.location) for e in robot.known_effects]
    return () if (late.name, late.location) in known else (late,)


def _measured(
    robot: Robot, pairs: Sequence[Pair], settings: Settings
) -> tuple[tuple[Measured, ...], tuple[Measured, ...], list[str]]:
    """Both sides of all pairs, as long as each other; the beginnings of long ones."""
    first, second, notes = [], [], []
    most = max(_MOST_STEPS // len(pairs), 1)
    for pair in pairs:
        one, two = robot.measured(pair.before), robot.measured(pair.after)
        count = min(len(one.time), len(two.time))
        if count > most:
            notes.append(f"the model explains the first {most * robot.control_timestep:.4g} s of a pair")
        one, two = (replace(each.first(min(count, most)), late=None) for each in (one, two))
        values, *others = (
            known + _without_outliers(new - known, settings)
            for known, new in zip((one.values, *one.others), (two.values, *two.others), strict=True)
        )
        second.append(replace(two, values=values, others=tuple(others)))
        first.append(one)
        notes += [*one.notes]
    return tuple(first), tuple(second), list(dict.fromkeys(notes))


def _without_outliers(values: Floats, settings: Settings) -> Floats:
    """Differences (T, P, D) without points that are alone and far off."""
    steps = np.abs(np.diff(values, axis=0))
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    if usual <= 0:
        return values
    found = values.copy()
    found[outliers(values / usual, settings.data_quality)] = np.nan
    return found


def _before_change(
    problem: PairedProblem, start: Floats, noise: float, settings: Settings
) -> tuple[PairedProblem, Point]:
    """The problem with the model's error before the change, and the shared unknowns there."""
    nothing = np.zeros(0)
    for _ in range(2):
        point = Point(np.clip(start, *problem.bounds), nothing, ())
        left = problem.measured[0] - problem.simulated([point])[0][0]
        seen = problem.seen[0] & np.isfinite(left)
        count = float(problem.seen[0].sum())
        sigma = max(float(np.sqrt((left[seen] ** 2).mean())), noise)
        share = problem.independent(left, seen) / count
        problem = replace(problem, sigma=(sigma, problem.sigma[1]), share=(share, problem.share[1]))
        if not problem.shared:
            break
        start = fitted_shared(problem, point.x, settings)
    return problem, Point(np.clip(start, *problem.bounds), nothing, ())


class _Search:
    """Changes one after another, as long as the evidence grows."""

    def __init__(
        self,
        problem: PairedProblem,
        base: Point,
        changes: Sequence[ParameterChange | LawChange],
        noise: float,
        seed: int,
        settings: Settings,
        progress: StageProgress,
    ):
        self.base, self.changes, self.noise, self.settings, self.progress = base, changes, noise, settings, progress
        self.rng = np.random.default_rng(seed)
        # what is to be explained is no noise: how independent its samples are shows when it is explained
        self.problem = replace(self._scaled(problem, base), share=(problem.share[0], 1.0))
        self.nothing = float(problem.squares([base])[0][1])  # the difference's own square
        self.singles: list[Fit] = []
        self.best: Fit | None = None

    def _scaled(self, problem: PairedProblem, point: Point) -> PairedProblem:
        """The problem with what a point leaves of the difference as its noise."""
        left = problem.measured[1] - problem.simulated([point])[1][0]
        seen = problem.seen[1] & np.isfinite(left)
        count = float(problem.seen[1].sum())
        sigma = max(float(np.sqrt((left[seen] ** 2).mean())), np.sqrt(2.0) * self.noise)
        share = problem.independent(left, seen) / count
        return replace(problem, sigma=(problem.sigma[0], sigma), share=(problem.share[0], share))

    def run(self) -> None:
        """Search for one change, and for more beside it."""
        self.progress("screening of changes")
        found = finalists(screened(self.problem, self.base, self.changes), self.settings)
        self.progress("fits of changes")
        if not found:
            return
        fits = fitted_alone(self.problem, self.base, found, self.settings)
        fits.sort(key=lambda each: each.squares[1])
        self.problem = self._scaled(self.problem, fits[0].point)
        self.progress("fits of changes together with the parameters")
        together = fitted_together(self.problem, fits[: self.settings.selection.kept], self.settings)
        self.problem = self._scaled(self.problem, min(together, key=lambda each: each.squares[1]).point)
        self.singles = [self._weighed(each) for each in (*together, *fits[self.settings.selection.kept :])]
        self.singles.sort(key=lambda each: -each.evidence)
        self.best = self.singles[0]
        while self._one_more():
            pass

    def _one_more(self) -> bool:
        """Add a change to the best ones if the evidence grows by enough; whether it did."""
        assert self.best is not None
        taken = {each.key for each in self.best.changes}
        others = [each for each in self.changes if each.key not in taken and self._possible(each)]
        problem = replace(self._scaled(self.problem, self.best.point), share=(self.problem.share[0], 1.0))
        found = finalists(screened(problem, self.best.point, others), self.settings)[: self.settings.selection.kept]
        if not found:
            return False
        best = min(fitted_alone(problem, self.best.point, found, self.settings), key=lambda each: each.squares[1])
        if best.squares[1] > self.best.squares[1] - self.settings.selection.least_gain_of_misfit * self.nothing:
            return False
        (joint,) = fitted_together(self._scaled(problem, best.point), [best], self.settings)
        problem = self._scaled(problem, joint.point)
        old, new = self._weighed(self.best, problem), self._weighed(joint, problem)
        if new.evidence < old.evidence:
            return False
        self.problem, self.best = problem, new
        return True

    def _possible(self, change: ParameterChange | LawChange) -> bool:
        """Whether the robot can have it beside the best changes."""
        assert self.best is not None
        point = Point(self.best.point.x, np.concatenate([self.best.point.z, change.typical]),
                      (*self.best.changes, change))  # fmt: skip
        return all(self.problem.robot.accepts(side.effects) for side in self.problem.sides(point))

    def _weighed(self, fit: Fit, problem: PairedProblem | None = None) -> Fit:
        """The fit with its evidence."""
        problem = problem or self.problem
        size = len(fit.point.x)
        shared = np.eye(size)
        if fit.joint:
            rows = fit.jacobian[: problem.measured[0].size, :size]
            shared = shared + rows.T @ rows
        return replace(fit, evidence=evidence(problem, fit, shared, self.base))

    def explanation(self, notes: tuple[str, ...]) -> result.Explanation:
        """The result."""
        # all by the same number of independent samples: each may have been weighed by another one on the way
        singles = [self._weighed(each) for each in self.singles]
        several = [self._weighed(self.best)] if self.best is not None and len(self.best.changes) > 1 else []
        unknown, (nothing, *chances) = self._probabilities([*singles, *several])
        candidates = _merged([
            self._change(each, 0, chance) for each, chance in zip(singles, chances, strict=False)
        ], self.settings.selection.least_gain_of_misfit)  # fmt: skip
        best = tuple(candidates[:1])
        if several:
            best = tuple(self._change(several[0], i, chances[-1]) for i in range(len(several[0].changes)))
        if nothing > max([unknown, *(each.probability for each in (*candidates, *best))]):
            best = ()
        return self._told(best, candidates, nothing, unknown, notes)

    @property
    def _left(self) -> float:
        """The difference's square that the best changes leave [signal's unit, squared]."""
        return self.best.squares[1] if self.best else self.nothing

    def _probabilities(self, fits: Sequence[Fit]) -> tuple[float, list[float]]:
        """That what has changed is none of the possible changes; and of no change, then of each fit's."""
        count = max(float(self.problem.seen[1].sum()), 1.0)
        without = -0.5 * self.problem.share[1] * count * np.log(max(self.nothing, 1e-300))
        evidences = np.array([without, *(each.evidence for each in fits)])
        counts = np.array([0, *(len(each.changes) for each in fits)])
        weights = probabilities(evidences, counts, len(self.changes))
        noise = count * 2.0 * self.noise**2
        share = max(self._left - noise, 0.0) / max(self.nothing - noise, 1e-300) if self.nothing > noise else 0.0
        unknown = float(expit((share - self.settings.paired.unknown_share) / self.settings.paired.unknown_width))
        certain = self.settings.probabilities.wrong_when_certain
        unknown = float(certain + (1.0 - certain) * unknown * (1.0 - weights[0]))
        return unknown, ((1.0 - unknown) * weights).tolist()

    def _told(
        self,
        best: tuple[result.Change, ...],
        candidates: Sequence[result.Change],
        nothing: float,
        unknown: float,
        notes: tuple[str, ...],
    ) -> result.Explanation:
        """Changes and their probabilities with errors, in numbers of the signal that differs most."""
        problem, robot = self.problem, self.problem.robot
        which = max(range(len(robot.signals)), key=lambda i: problem.rms(self.base, i)[1] * problem.scale(i))
        _, before = problem.rms(self.base, which)
        replay, after = problem.rms(self.best.point if self.best else self.base, which)
        return result.Explanation(
            robot.name,
            robot.signals[which].name,
            robot.signals[which].unit,
            best,
            tuple(candidates),
            nothing,
            unknown,
            explained=1.0 - self._left / max(self.nothing, 1e-300),
            before=before,
            after=after,
            replay=replay,
            informative=problem.share[1] * max(float(problem.seen[1].sum()), 1.0),
            notes=notes,
        )

    def _change(self, fit: Fit, number: int, probability: float) -> result.Change:
        """One change of a fit, of that change alone or of everything, with intervals."""
        change = fit.changes[number]
        covariance = fit.covariance()
        shared = len(fit.point.x) if fit.joint else 0  # unknowns beside those of changes that were fitted
        x = np.concatenate([fit.point.x[:shared], fit.point.z])
        draws = x + self.rng.multivariate_normal(np.zeros(len(x)), covariance, _DRAWS, method="eigh")
        first = sum(each.size for each in fit.changes[:number])
        z = fit.point.z[first : first + change.size]
        zs = draws[:, shared + first : shared + first + change.size]
        xs = draws[:, :shared] if shared else np.repeat(fit.point.x[None], _DRAWS, axis=0)
        explained = float(1.0 - fit.squares[1] / max(self.nothing, 1e-300))
        if isinstance(change, ParameterChange):
            estimates = _of_parameter(change, fit.point.x, z, xs, zs)
            return result.Change(change.kind, change.prior.name, change.location, estimates, True, False, explained,
                                 probability)  # fmt: skip
        estimates = _of_law(self.problem.robot, change, z, np.clip(zs, *change.bounds))
        return result.Change(change.kind, change.term.name, change.term.location, estimates, False,
                             change.removed(z), explained, probability)  # fmt: skip


def probabilities(evidences: Floats, counts: Floats, possible: int) -> Floats:
    """(H,) probabilities of hypotheses, by their log evidence (H,) and their numbers of changes (H,).

    A change is as likely as none, and each of the ``possible`` ones as likely as another: of hundreds, some explain a
    little by chance (Scott, Berger, "Bayes and empirical-Bayes multiplicity adjustment", 2010).
    """
    found = evidences - counts * np.log(max(possible, 1))
    weights = np.exp(found - found.max())
    return np.asarray(weights / weights.sum(), float)


def _interval(name: str, unit: str, value: float, draws: Floats) -> Estimate:
    low, high = np.quantile(draws, (0.05, 0.95))
    return Estimate(name, value, unit, float(low), float(high))


def _of_parameter(change: ParameterChange, x: Floats, z: Floats, xs: Floats, zs: Floats) -> tuple[Estimate, ...]:
    """Of a parameter: the mass that is added; or its factor, or what is added to it; and its values on both sides."""
    i, prior = change.index, change.prior
    old, new = float(prior.value(x[i])), float(prior.value(x[i] + z[0]))
    olds, news = prior.value(xs[:, i]), prior.value(xs[:, i] + zs[:, 0])
    values = (_interval("before", prior.unit, old, olds), _interval("after", prior.unit, new, news))
    if change.mass:
        return (_interval("mass", "kg", change.mass * (new - old), change.mass * (news - olds)), *values)
    if prior.logarithmic:
        return (_interval("factor", "1", new / old, news / olds), *values)
    return (_interval("added", prior.unit, new - old, news - olds), *values)


def _of_law(robot: Robot, change: LawChange, z: Floats, zs: Floats) -> tuple[Estimate, ...]:
    """Of a law: its quantities; the magnitude of one that acts before only is negative."""
    sign = -1.0 if change.removed(z) else 1.0
    values = change.effect(z).parameters
    drawn = [change.effect(row).parameters for row in zs]
    signs = np.array([-1.0 if change.removed(row) else 1.0 for row in zs])
    found = []
    for i, (quantity, magnitude) in enumerate(zip(change.term.quantities, change.magnitudes, strict=True)):
        unit = robot.unit_at(quantity.unit, change.term.location)
        draws = np.array([each[quantity.name] for each in drawn])
        first = i == 0 and magnitude and change.one_sided
        value = values[quantity.name] * (sign if first else 1.0)
        found.append(_interval(quantity.name, unit, value, draws * signs if first else draws))
    return tuple(found)


def _merged(changes: Sequence[result.Change], alike: float) -> list[result.Change]:
    """Changes, the most probable first; those of one kind that are at one place, or explain as much, are one, under the
    name of the most probable, a parameter before a law."""
    found: list[result.Change] = []
    for each in sorted(changes, key=lambda c: (-c.parameter, -c.probability)):
        same = [
            i for i, other in enumerate(found)
            if other.kind == each.kind
            and ((other.location == each.location and each.location is not None)
                 or abs(other.explained - each.explained) < alike)
        ]  # fmt: skip
        if not same:
            found.append(each)
            continue
        other = found[same[0]]
        first = other if other.probability >= alike * each.probability else each
        found[same[0]] = replace(first, probability=other.probability + each.probability)
    return sorted(found, key=lambda c: (-c.probability, -c.explained))
