"""Propose: which next recording of 10 s would best tell the answers apart that are left?

Candidate motions of the channels that the answers name are simulated under every answer as fitted. The evidence that a
recording of one would give, on average, is half the squared distance of what two answers predict, in units of the noise
(Box, Hill, "Discrimination among mechanistic models", 1967), less what other parameters and numerical error could do.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.fit import Hypothesis, bounds
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison, temperature
from soro_bench.effects.effect import Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.excitation import in_turn, loops, multisine, step_and_hold, triangles

DURATION, HOLD = 10.0, 4.0  # s
CLOSE = 0.05  # probability of an answer that is left
RIVALS = 3  # answers that are told apart, at most
FINALISTS, DIRECTIONS = 2, 2  # motions, and combinations of unknowns for which they are simulated again
APART = math.log(20.0)  # tempered evidence that tells two answers apart
_REST = 0.05  # of the duration, before and after a motion
_STROKE, _SLOW, _SLOW_LOOPS = 3, 10, 4  # time steps of full rate, and how much slower than that


@dataclass(frozen=True)
class Motion:
    """A candidate: actions (T, nu), rates that sum to zero, and what they are in words."""

    words: str
    actions: np.ndarray


@dataclass(frozen=True)
class Proposal:
    """The motion to record next.

    rivals: the answers that are left, the most probable first. separates: pairs of them that it would tell apart.
    evidence: what it would give on average [nats], for the pair of these (where there is none, of all) that is closest.
    """

    motion: Motion
    rivals: tuple[str, ...]
    separates: tuple[tuple[str, str], ...]
    evidence: float


def proposed(
    problem: Problem, comparison: Comparison, unknown: Location | None = None, seed: int = 0
) -> Proposal | None:
    """The motion that best tells the answers apart that are left; None where one stands alone.

    Args:
        unknown: where physics without a name acts, if that is the answer: then motion of the channels there.
        seed: of the motions' random phases.
    """
    rivals = competing(comparison)
    if len(rivals) < 2 and unknown is None:
        return None
    robot, as_fitted = problem.robot, [(a.hypothesis.x, a.hypothesis.terms) for a in rivals]
    temper = temperature(min(problem.misfit(a.hypothesis.residual) for a in comparison.answers))
    tried = motions(_candidates_at(robot, rivals, unknown), robot.channels, robot.control_timestep, seed)
    predicted = [predictions(problem, motion.actions, as_fitted) for motion in tried]
    first = [_rated(rivals, separations(problem, rivals, rows), temper) for rows in predicted]
    finalists = sorted(range(len(tried)), key=lambda i: -first[i])[:FINALISTS]
    found = [separations(problem, rivals, predicted[i], _changes(problem, rivals, tried[i].actions, predicted[i]))
             for i in finalists]  # fmt: skip
    best = max(range(len(found)), key=lambda i: _rated(rivals, found[i], temper))
    return _proposal(tried[finalists[best]], rivals, found[best], temper)


def competing(comparison: Comparison) -> list[Answer]:
    """The answers that are left, or the best of all improbable ones."""
    merged: dict[frozenset, Answer] = {}  # those that differ in where their fits began are one
    for answer in comparison.answers:
        first = merged.get(_locations(answer))
        chance = answer.probability + (first.probability if first else 0.0)
        merged[_locations(answer)] = replace(first or answer, probability=chance)
    answers = sorted(merged.values(), key=lambda a: -a.probability)
    return [a for a in answers if a.probability >= CLOSE][:RIVALS] or answers[:1]


def motions(channels: Sequence[int], names: Sequence[str], timestep: float, seed: int = 0) -> list[Motion]:
    """Candidates that move some channels, of those that fit into the duration.

    Args:
        channels: which.
        names: of all nu channels.
        timestep: s between actions.
        seed: of the phases of the multisine.
    """
    total = round(DURATION / timestep)
    room = total - 2 * int(_REST * total)
    groups, some = np.eye(len(names))[list(channels)], len(channels) < len(names)
    together = groups.sum(axis=0, keepdims=True)
    others = 1.0 - together if some else together
    triangle, hold = triangles(_STROKE, (1,)), step_and_hold(round(HOLD / timestep))
    parts = {
        "fast triangles of {}": _slowed(triangle, 1, groups, room),
        "slow triangles of {}": _slowed(triangle, _SLOW, groups, room),
        "slow nested loops of {}": _slowed(loops(), _SLOW_LOOPS, groups, room),
        f"steps of {{}} with holds of {HOLD:g} s": _slowed(hold, 1, together, room),
        f"slow triangles of {{}} with {'the others' if some else 'all'} pulled a little": np.concatenate([
            others, _slowed(triangle, _SLOW, groups, room - 2 * len(others)), -others
        ]),
        "sums of sines of {}": multisine(room, len(groups), timestep, seed) @ groups,
    }  # fmt: skip
    what = " and ".join(names[i] for i in channels) if some else "every channel"
    return [Motion(words.format(what), _padded(part, total)) for words, part in parts.items() if part.any()]


def _candidates_at(robot: Robot, rivals, unknown) -> Sequence[int]:
    """The channels at the places of effects that not all rivals have, or where unknown physics acts; all if none."""
    ranked_locations = [_locations(answer) for answer in rivals]
    location = (
        [unknown]
        if unknown
        else [site for _, site in frozenset.union(*ranked_locations) - frozenset.intersection(*ranked_locations)]
    )
    return sorted({robot.channel(site) for site in location} - {None}) or range(len(robot.channels))


def predictions(
    problem: Problem, actions: np.ndarray, points: Sequence[tuple[np.ndarray, Sequence[Term]]]
) -> np.ndarray:
    """(N, M) what the sensor would record under actions (T, nu), in units of its noise, less its mean over time.

    A constant difference would show at rest as well, and a bias or the way a robot came to rest make one: it is no
    reason to move.

    Args:
        points: unknowns, and suspects they belong to.
    """
    first = problem.recordings[0]
    seen = np.isfinite(first.values).any(axis=0)  # not what it never sees
    asked = replace(problem, recordings=(first.under(problem.robot.commanded(actions, problem.recorded)),))
    values = asked.simulated(problem.robot, points).reshape(len(points), len(actions), *seen.shape)
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
    changes, found = changes or [np.zeros((0, predicted.shape[1]))] * len(rivals), []
    for i, j in itertools.combinations(range(len(rivals)), 2):
        difference = np.nan_to_num(predicted[[i]] - predicted[[j]])  # what diverges tells nothing
        covariance = LowRank(np.concatenate([changes[i], changes[j]]))
        squares = float(covariance.product(difference, difference)[0, 0])
        found.append(0.5 * squares * _told(problem, rivals[i].hypothesis, rivals[j].hypothesis))
    return np.array(found)


def _changes(problem, rivals, actions, predicted) -> list[np.ndarray]:
    """Of each answer (DIRECTIONS, M): a standard deviation along the combinations of its unknowns that are known least.

    These few of the posterior's directions are those along which an answer can change most. The others are known from
    the recordings at hand.
    """
    points, ends = [], []
    for hypothesis in (answer.hypothesis for answer in rivals):
        variances, combinations = np.linalg.eigh(hypothesis.covariance(problem))
        steps = (np.sqrt(variances) * combinations)[:, -DIRECTIONS:].T
        allowed = bounds(problem, hypothesis.terms)
        points += [(np.clip(hypothesis.x + step, *allowed), hypothesis.terms) for step in steps]
        ends.append(len(points))
    rows = np.split(predictions(problem, actions, points), ends[:-1])
    return [np.nan_to_num(moved - own) for moved, own in zip(rows, predicted, strict=True)]


def _told(problem, a: Hypothesis, b: Hypothesis) -> float:
    """The share of a difference that is no numerical error.

    How refined models move is not simulated, which would cost more than all the rest: the share is the one that the
    numerical floor leaves of the difference in the recordings at hand.
    """
    difference = (a.residual - b.residual)[None]
    squares = float((difference**2).sum())
    return float(problem.discretisation.product(difference, difference)[0, 0]) / squares if squares else 1.0


def _rated(rivals, evidence, temper) -> float:
    """Of the pair that is mistaken most easily: minus the logarithm of a bound (Bhattacharyya's) on the chance to take
    one for the other, which is smaller for answers that are improbable at any rate. Evidence is tempered."""
    chances = [a.probability * b.probability for a, b in itertools.combinations(rivals, 2)]
    return min((e / (4.0 * temper) - 0.5 * math.log(max(c, 1e-300)) for e, c in zip(evidence, chances, strict=True)),
               default=0.0)  # fmt: skip


def _proposal(motion, rivals, evidence, temper) -> Proposal:
    names = labels(rivals)
    apart = [pair for pair, e in zip(itertools.combinations(names, 2), evidence, strict=True) if e >= APART * temper]
    enough = evidence[evidence >= APART * temper]
    return Proposal(motion, tuple(names), tuple(apart), float(min(enough if len(enough) else evidence, default=0.0)))


def labels(rivals: Sequence[Answer]) -> list[str]:
    """Names of the effects of every answer, with their places where the names do not tell them apart; "none"."""
    names = [" with ".join(a.names) or "none" for a in rivals]
    ranked_locations = [" with ".join(f"{s.name} at {s.location}" for s in a.hypothesis.terms) for a in rivals]
    return [site if names.count(name) > 1 else name for name, site in zip(names, ranked_locations, strict=True)]


def _locations(answer):
    return frozenset((s.name, s.location) for s in answer.hypothesis.terms)


def _slowed(rates, slowness, groups, room) -> np.ndarray:
    """(n, nu) rates of one group of channels after the other, as slow as fits and as often; empty if none does."""
    once = len(rates) * len(groups)
    slowness = max(1, min(slowness, room // once))
    return in_turn(np.tile(np.repeat(rates / slowness, slowness), room // (once * slowness)), groups)


def _padded(part, total) -> np.ndarray:
    before = int(_REST * total)
    return np.pad(part, ((before, total - before - len(part)), (0, 0)))
