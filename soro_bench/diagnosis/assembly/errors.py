"""Errors of hypotheses: of plain replays, as anybody can repeat them, and without discretisation error.

Fits have shorter time steps than the model, and a covariance of discretisation error. What is shown has neither: it is
replayed at the model's own time step, and every sample that the fits use counts alike.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Points, Problem
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_parts import Errors
from soro_bench.diagnosis.result_robot import ACCURATE, ReplayedRobot, SignalErrors, WorseReplay
from soro_bench.diagnosis.robots.priors import CannotHave
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer
from soro_bench.inference.statistical_linearisation import LowRank

_LEAVES_MOST = 0.7  # of the motion's rms, half of its square

HypothesisKey = tuple[bytes, tuple[Term, ...]]


@dataclass(frozen=True)
class PlainReplays:
    """Replays at the time step of the model.

    problems: of the recordings that were fitted to, and of held-out ones if there are any.
    rows: of each problem the samples (M,) [signal's unit], by hypothesis.
    built: of each problem the rms of a coordinate by the model as built. nominal: its parameters.
    accurate: of each problem the same by the robot's accurate model, with what was found; None if there is none.
    """

    problems: tuple[Problem, ...]
    rows: Mapping[HypothesisKey, tuple[Floats, ...]]
    built: tuple[float, ...]
    nominal: Mapping[str, float]
    accurate: tuple[float, ...] | None = None

    def of(self, hypothesis: Hypothesis) -> tuple[Floats, ...]:
        """Of each problem the samples (M,) of a hypothesis [signal's unit]."""
        return self.rows[_key(hypothesis)]

    def rms(self, hypothesis: Hypothesis) -> list[float]:
        """Of each problem the rms of a coordinate [signal's unit]; infinite where the simulation diverges."""
        return [plain_rms(*each) for each in zip(self.problems, self.of(hypothesis), strict=True)]

    def errors(self, diagnosis: Diagnosis, answer: Answer) -> tuple[Errors, Errors | None]:
        """Of the recordings that an answer was fitted to, and of held-out ones, if there are any."""
        plain = zip(self.rms(diagnosis.explanation.nominal), self.rms(answer.hypothesis), strict=True)
        fits = [each for each in (answer.train, answer.heldout) if each is not None]
        found = [
            Errors(*pair, fit.noise, *(fit.own or (fit.before, fit.after)), motion(problem))
            for pair, fit, problem in zip(plain, fits, self.problems, strict=True)
        ]
        return found[0], found[1] if len(found) > 1 else None

    def of_signal(self, diagnosis: Diagnosis, which: int) -> SignalErrors:
        """Errors of one signal [its unit]: with fitted parameters only, and by the best hypothesis."""
        first, signal = self.problems[0], diagnosis.robot.signals[which]
        rows = zip(*(self.of(each) for each in (diagnosis.explanation.nominal, diagnosis.best.hypothesis)), strict=True)
        found = [
            tuple(_finite(plain_rms(problem, row, which)) for row in pair)
            for problem, pair in zip(self.problems, rows, strict=True)
        ]
        heldout = found[1] if len(found) > 1 else (None, None)
        return SignalErrors(signal.name, signal.unit, first.sensors[which], *found[0], *heldout)


def plain_replays(diagnosis: Diagnosis) -> PlainReplays:
    """Replay every hypothesis of a diagnosis, and the model as built, on all recordings."""
    problems = tuple(each for each in (diagnosis.explanation.problem, diagnosis.tested) if each is not None)
    hypotheses = [diagnosis.explanation.nominal, *(answer.hypothesis for answer in diagnosis.comparison.answers)]
    hypotheses += [law.best.hypothesis] if (law := diagnosis.discovery) and law.best else []
    points = {_key(each): (each.x, each.terms) for each in hypotheses}
    robot = diagnosis.robot if diagnosis.robot.shorter == 1 else diagnosis.robot.shortened(1)
    parts = _samples(robot, problems, list(points.values()))
    rows = {key: tuple(part[i] for part in parts) for i, key in enumerate(points)}
    built = robot.as_built()
    nominal = {prior.name: float(prior.nominal) for prior in built.priors}
    return PlainReplays(problems, rows, tuple(rms_as_it_is(built, problems)), nominal, _accurate(diagnosis, problems))


def _accurate(diagnosis: Diagnosis, problems: Sequence[Problem]) -> tuple[float, ...] | None:
    """Of each problem the rms of a coordinate by the accurate model of the robot, with what was found.

    That model has other discretisation errors and the same physics, so what is found with the cheap one has to lower
    the error there too.
    """
    robot = diagnosis.robot if diagnosis.robot.shorter == 1 else diagnosis.robot.shortened(1)
    found = _found(diagnosis)
    try:
        accurate = robot.accurate()
        if accurate is None or not accurate.accepts(found.effects(len(robot.priors))):
            return None
    except CannotHave:
        return None
    return tuple(_rms(accurate, problems, (found.x, found.terms)))


def _found(diagnosis: Diagnosis) -> Hypothesis:
    """The best hypothesis where it has effects, else the fitted parameters."""
    return diagnosis.best.hypothesis if diagnosis.best.names else diagnosis.explanation.nominal


def replayed_robots(
    diagnosis: Diagnosis, replays: PlainReplays, patched: bool, law: Hypothesis | None = None
) -> tuple[ReplayedRobot, ...]:
    """The robots whose replays are shown: as built, with fitted parameters, and by every hypothesis with effects.

    Args:
        patched: whether the patch is the best hypothesis, or ``law``.
        law: a discovered one, which is the patch.
    """
    best = diagnosis.best
    found = [ReplayedRobot("nominal", dict(replays.nominal), (), *map(_finite, replays.built))]
    for answer in (None, *diagnosis.comparison.ranked):
        hypothesis = answer.hypothesis if answer else diagnosis.explanation.nominal
        if answer and not answer.names:
            continue
        name = "fitted" if answer is None else ("alternative" if answer is not best else "best")
        name = "patched" if name == "best" and patched and law is None else name
        found.append(_replayed(name, diagnosis, hypothesis, replays.rms(hypothesis)))
    if law is not None:
        found.append(_replayed("patched", diagnosis, law, replays.rms(law)))
    if replays.accurate is not None:
        found.append(_replayed(ACCURATE, diagnosis, _found(diagnosis), replays.accurate))
    return tuple(found)


def _replayed(name: str, diagnosis: Diagnosis, hypothesis: Hypothesis, errors: Sequence[float]) -> ReplayedRobot:
    """The robot of a hypothesis, with errors of its replays."""
    robot = diagnosis.robot
    laws = tuple(effect.to_json() for effect in (*robot.known_effects, *hypothesis.effects(len(robot.priors))))
    return ReplayedRobot(name, robot.every_parameter(hypothesis.x), laws, *map(_finite, errors))


def worse_replays(robots: Sequence[ReplayedRobot], same: float) -> tuple[WorseReplay, ...]:
    """Where a robot that a result is about replays recordings worse than the model as built does.

    Args:
        robots: the model as built first.
        same: share by which errors may differ and count as the same.
    """
    found, built = [], robots[0]
    for each in robots[1:]:
        pairs = (("fitted", built.train, each.train), ("held-out", built.heldout, each.heldout))
        for name, before, after in pairs:
            if each.name in ("alternative", ACCURATE) or before is None or after is None or math.isnan(before):
                continue
            if not after <= (1.0 + same) * before:
                found.append(WorseReplay(each.name, name, before, after))
    return tuple(found)


def _finite(error: float) -> float:
    """NaN for the error of a replay that diverges."""
    return error if math.isfinite(error) else math.nan


def plain(problem: Problem, robot: Robot) -> Problem:
    """A problem of the same recordings for a robot, without discretisation errors."""
    return replace(problem, robot=robot, discretisation=LowRank(np.zeros((0, problem.weight.size))))


def rms_as_it_is(robot: Robot, problems: Sequence[Problem]) -> list[float]:
    """Of each problem's recordings the rms [signal's unit] of replays by a robot with nominal parameters and without
    effects."""
    return _rms(robot, problems, (np.zeros(len(robot.priors)), ()))


def _samples(robot: Robot, problems: Sequence[Problem], points: Points) -> list[Floats]:
    """(N, M) samples [first signal's unit] of replays of each problem's recordings by a robot, all side by side."""
    found = [plain(each, robot) for each in problems]
    every = tuple(recording for each in found for recording in each.recordings)
    replace(found[0], recordings=every).simulated(robot, points)  # which the robot remembers
    return [each.simulated(robot, points) for each in found]


def _rms(robot: Robot, problems: Sequence[Problem], point: tuple[Floats, Sequence[Term]]) -> list[float]:
    """Of each problem's recordings the rms of a coordinate [signal's unit] by a robot at a point."""
    rows = _samples(robot, problems, [point])
    return [plain_rms(problem, row[0]) for problem, row in zip(problems, rows, strict=True)]


def plain_rms(problem: Problem, simulated: Floats, which: int = 0) -> float:
    """Root mean square of measured less simulated (M,) of one signal [its unit], as any replay shows it.

    It is infinite where the simulation diverges, and NaN where the recordings lack the signal.

    Args:
        which: the number of the signal.
    """
    columns = (problem.measured, simulated, problem.weight)
    measured, values, weight = (np.concatenate([part.ravel() for part in problem.split(c, which)]) for c in columns)
    off = (measured[weight > 0] - values[weight > 0]) * (problem.sigmas[which] / problem.sigma)
    if not off.size:
        return math.nan
    return float(np.sqrt(np.mean(off**2))) if np.isfinite(off).all() else math.inf


def leave_most(errors: Errors) -> bool:
    """Whether plain replays with fitted parameters leave so much of the motion that they test nothing, or diverge."""
    return errors.motion is not None and not errors.before < _LEAVES_MOST * errors.motion


def motion(problem: Problem) -> float:
    """Root mean square of the first signal [its unit] about the mean of each coordinate in each recording."""
    parts = zip(problem.split(problem.measured), problem.split(problem.weight), strict=True)
    present = [np.where(weight > 0, values, np.nan).reshape(len(values), -1) for values, weight in parts]
    seen = [each[:, np.isfinite(each).any(axis=0)] for each in present]
    off = np.concatenate([(each - np.nanmean(each, axis=0)).ravel() for each in seen])
    return float(np.sqrt(np.nanmean(off**2)))


def _key(hypothesis: Hypothesis) -> HypothesisKey:
    """What tells a hypothesis from others of the same robot: its coordinates and terms."""
    return hypothesis.x.tobytes(), tuple(hypothesis.terms)
