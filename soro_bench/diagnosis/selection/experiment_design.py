"""Experiment design: which next recording would best tell the remaining answers apart?

Candidate motions of the channels that the answers name are simulated under every answer as fitted. The evidence that a
recording would give, on average, is half the squared distance of two answers' predictions, in units of the noise (Box,
Hill, "Discrimination among mechanistic models", 1967), less what other parameters and discretisation error could do.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Bools
from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, temperature
from soro_bench.diagnosis.settings import DEFAULT, ExperimentDesignSettings, Settings
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.excitation import in_turn, loops, multisine, step_and_hold, triangles

_SEPARATED = 20.0  # tempered odds, from which one of two answers is improbable


@dataclass(frozen=True)
class Motion:
    """A candidate motion.

    words: what it is. actions: (T, nu) rates that sum to zero, as the robot begins where it ends. duration: s.
    """

    words: str
    actions: np.ndarray
    duration: float


@dataclass(frozen=True)
class Proposal:
    """The motion to record next.

    rivals: the answers that remain, the most probable first. separates: pairs of them that it would tell apart.
    evidence: that it would give on average [nats], for the closest of these pairs; where there are none, of
    all pairs.
    """

    motion: Motion
    rivals: tuple[str, ...]
    separates: tuple[tuple[str, str], ...]
    evidence: float


def proposed(
    problem: Problem, comparison: Comparison, unknown: Location | None = None, seed: int = 0
) -> Proposal | None:
    """The motion that best tells the remaining answers apart; None where there is only one, no command to move, or no
    motion that fits.

    Args:
        unknown: where a discrepancy outside the catalogue acts, if that is the answer: then the channels there move.
        seed: of the motions' random phases.
    """
    settings = problem.settings.experiment_design
    rivals = competing(comparison, problem.settings)
    if (len(rivals) < 2 and unknown is None) or not problem.robot.driven.any():
        return None
    robot, as_fitted = problem.robot, [(a.hypothesis.x, a.hypothesis.terms) for a in rivals]
    least_misfit = min(problem.misfit(a.hypothesis.residual) for a in comparison.answers)
    tempered_by = temperature(least_misfit, problem.settings.probabilities)
    channels = _channels(robot, rivals, unknown)
    if not (tried := motions(channels, robot.channels, robot.control_timestep, seed, settings, robot.driven)):
        return None
    predicted = [predictions(problem, motion.actions, as_fitted) for motion in tried]
    first = [_rated(rivals, separations(problem, rivals, rows), tempered_by) for rows in predicted]
    finalists = sorted(range(len(tried)), key=lambda i: -first[i])[: settings.finalists]
    separated = [
        separations(problem, rivals, predicted[i], _changes(problem, rivals, tried[i].actions, predicted[i]))
        for i in finalists
    ]
    best = max(range(len(separated)), key=lambda i: _rated(rivals, separated[i], tempered_by))
    enough = math.log(_SEPARATED) * tempered_by
    return _proposal(tried[finalists[best]], rivals, separated[best], enough)


def competing(comparison: Comparison, settings: Settings = DEFAULT) -> list[Answer]:
    """The answers that remain, the most probable first; the best one if all are improbable."""
    merged: dict[frozenset[tuple[str, Location]], Answer] = {}  # fits that only began elsewhere are one answer
    for answer in comparison.answers:
        first = merged.get(_laws(answer))
        probability = answer.probability + (first.probability if first else 0.0)
        merged[_laws(answer)] = replace(first or answer, probability=probability)
    answers = sorted(merged.values(), key=lambda a: -a.probability)
    likely = [a for a in answers if a.probability >= settings.report.least_probability]
    return likely[: settings.experiment_design.rivals] or answers[:1]


def motions(
    channels: Sequence[int],
    names: Sequence[str],
    timestep: float,
    seed: int = 0,
    settings: ExperimentDesignSettings = DEFAULT.experiment_design,
    driven: Bools | None = None,
) -> list[Motion]:
    """Candidates that move some channels, of those that fit into the duration.

    Args:
        channels: indices of those that move.
        names: of all nu channels.
        timestep: s between actions.
        seed: of the phases of the multisine.
        driven: (nu,) which channels have commands; all by default.
    """
    every = np.ones(len(names)) if driven is None else driven.astype(float)
    total = round(settings.duration / timestep)
    room = total - 2 * int(settings.rest * total)
    groups, some = np.eye(len(names))[list(channels)], len(channels) < every.sum()
    together = groups.sum(axis=0, keepdims=True)
    others = every - together if some else together
    triangle, hold = triangles(settings.stroke, (1,)), step_and_hold(round(settings.hold / timestep))
    slow_beside = _slowed(triangle, settings.slow, groups, room - 2 * len(others))
    pulled = np.concatenate([others, slow_beside, -others]) if slow_beside.any() else slow_beside
    sines = multisine(room, len(groups), timestep, seed) @ groups if room > 1 else groups[:0]
    parts = {
        "fast triangles of {}": _slowed(triangle, 1, groups, room),
        "slow triangles of {}": _slowed(triangle, settings.slow, groups, room),
        "slow nested loops of {}": _slowed(loops(), settings.slow, groups, room),
        f"steps of {{}} with holds of {settings.hold:g} s": _slowed(hold, 1, together, room),
        f"slow triangles of {{}} with {'the others' if some else 'all'} pulled a little": pulled,
        "sums of sines of {}": sines,
    }
    what = " and ".join(names[i] for i in channels) if some else "every channel"
    before = int(settings.rest * total)
    return [
        Motion(words.format(what), np.pad(part, ((before, total - before - len(part)), (0, 0))), total * timestep)
        for words, part in parts.items()
        if part.any()
    ]


def _channels(robot: Robot, rivals: Sequence[Answer], unknown: Location | None) -> Sequence[int]:
    """The channels at the locations of terms that not all rivals have, or of an unknown discrepancy; all if none. Only
    those with commands can move."""
    laws = [_laws(answer) for answer in rivals]
    differing = frozenset.union(*laws) - frozenset.intersection(*laws)
    locations = [unknown] if unknown else [location for _, location in differing]
    channels, driven = {robot.channel(location) for location in locations}, np.flatnonzero(robot.driven).tolist()
    return [channel for channel in driven if channel in channels] or driven


def predictions(
    problem: Problem, actions: np.ndarray, points: Sequence[tuple[np.ndarray, Sequence[Term]]]
) -> np.ndarray:
    """(N, M) what the sensor would record under actions (T, nu), in units of its noise, less its mean over time.

    A constant difference would show at rest as well, and a bias or the way a robot came to rest cause one. It is no
    reason to move.

    Args:
        points: unknowns, and the terms they belong to.
    """
    first = problem.recordings[0]
    seen = np.asarray(np.isfinite(first.columns).any(axis=0))  # points that are never measured tell nothing
    asked = replace(problem, recordings=(first.under(problem.robot.commanded(actions, problem.recorded)),))
    values = asked.simulated(problem.robot, points).reshape(len(points), len(actions), len(seen))
    values = values[:, :, seen] - values[:, :, seen].mean(axis=1, keepdims=True)
    return values.reshape(len(points), -1) / problem.sigma


def separations(
    problem: Problem, rivals: Sequence[Answer], predicted: np.ndarray, changes: Sequence[np.ndarray] = ()
) -> np.ndarray:
    """(pairs,) evidence [nats] that a recording would give on average for the answer of a pair that is true.

    Args:
        predicted: (R, M) by each of R answers.
        changes: of each answer (K, M), what else it could predict.
    """
    changes = changes or [np.zeros((0, predicted.shape[1]))] * len(rivals)
    evidence = []
    for i, j in itertools.combinations(range(len(rivals)), 2):
        difference = np.nan_to_num(predicted[[i]] - predicted[[j]])  # a simulation that diverges tells nothing
        covariance = LowRank(np.concatenate([changes[i], changes[j]]))
        squares = float(covariance.product(difference, difference)[0, 0])
        evidence.append(0.5 * squares * _physical_share(problem, rivals[i].hypothesis, rivals[j].hypothesis))
    return np.array(evidence)


def _changes(
    problem: Problem, rivals: Sequence[Answer], actions: np.ndarray, predicted: np.ndarray
) -> list[np.ndarray]:
    """Of each answer (K, M): changes of its predictions (R, M) along the K widest directions of its posterior.

    Along these an answer can change most. The other directions are known from the recordings at hand.
    """
    points: list[tuple[np.ndarray, Sequence[Term]]] = []
    ends = []
    for hypothesis in (answer.hypothesis for answer in rivals):
        variances, directions = np.linalg.eigh(hypothesis.covariance(problem))
        steps = (np.sqrt(variances) * directions)[:, -problem.settings.experiment_design.finalists :].T
        allowed = bounds(problem, hypothesis.terms)
        points += [(np.clip(hypothesis.x + step, *allowed), hypothesis.terms) for step in steps]
        ends.append(len(points))
    if not points:  # every parameter is known
        return [np.zeros((0, predicted.shape[1]))] * len(rivals)
    rows = np.split(predictions(problem, actions, points), ends[:-1])
    return [np.nan_to_num(moved - own) for moved, own in zip(rows, predicted, strict=True)]


def _physical_share(problem: Problem, first: Hypothesis, second: Hypothesis) -> float:
    """The share of a difference that is no discretisation error.

    How refined models move is not simulated, which would cost more than all the rest. The share is that of the
    difference in the recordings at hand.
    """
    difference = (first.residual - second.residual)[None]
    squares = float((difference**2).sum())
    return float(problem.discretisation.product(difference, difference)[0, 0]) / squares if squares else 1.0


def _rated(rivals: Sequence[Answer], evidence: np.ndarray, temperature: float) -> float:
    """How well a motion tells the closest pair of answers apart.

    That is minus the logarithm of Bhattacharyya's bound on the chance to take one for the other, which is smaller for
    improbable answers. The evidence (pairs,) is divided by the temperature.
    """
    chances = [a.probability * b.probability for a, b in itertools.combinations(rivals, 2)]
    ratings = (
        e / (4.0 * temperature) - 0.5 * math.log(max(chance, 1e-300))
        for e, chance in zip(evidence, chances, strict=True)
    )
    return min(ratings, default=0.0)


def _proposal(motion: Motion, rivals: Sequence[Answer], evidence: np.ndarray, enough: float) -> Proposal:
    """A motion that tells pairs of rivals apart if their evidence (pairs,) is enough [nats]."""
    names = labels(rivals)
    apart = [pair for pair, e in zip(itertools.combinations(names, 2), evidence, strict=True) if e >= enough]
    large = evidence[evidence >= enough]
    return Proposal(motion, tuple(names), tuple(apart), float(min(large if len(large) else evidence, default=0.0)))


def labels(rivals: Sequence[Answer]) -> list[str]:
    """Names of the effects of every answer, with their locations where answers have the same laws; "none"."""
    laws = [frozenset(a.names) for a in rivals]
    located = [" with ".join(f"{term.name} at {term.location}" for term in a.hypothesis.terms) for a in rivals]
    return [
        full if laws.count(same) > 1 else " with ".join(a.names) or "none"
        for a, same, full in zip(rivals, laws, located, strict=True)
    ]


def _laws(answer: Answer) -> frozenset[tuple[str, Location]]:
    """Its laws with their locations."""
    return frozenset((term.name, term.location) for term in answer.hypothesis.terms)


def _slowed(rates: np.ndarray, slowness: int, groups: np.ndarray, room: int) -> np.ndarray:
    """(n, nu) rates (k,) of one group of channels (G, nu) after the other, as slow and as often as fits.

    Args:
        slowness: how many times slower than full rate, at most.
        room: control steps that there are; the result is empty if the motion needs more at full rate.
    """
    once = len(rates) * len(groups)
    slowness = max(1, min(slowness, room // once))
    times = max(0, room // (once * slowness))
    return in_turn(np.tile(np.repeat(rates / slowness, slowness), times), groups)
