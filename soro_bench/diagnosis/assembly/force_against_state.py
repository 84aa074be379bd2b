"""Force against state: the force estimated at a location from the recordings, beside what the fitted law does there.

Friction is a function of a cable's speed, stiffening one of a neck's bend, a delay one of how fast the command moves.
The fitted law is observed: the fitted robot is replayed, and after every control step its passive forces are compared
with those of the same robot without the law in the same state (of a law of setpoints, what it makes of them is known).
Straight lines between a few nodes of the state, for states that fall and for states that rise, are fitted to these
forces. Where they do not describe them, as where a law has a long memory, there is no curve.

The recordings correct these values. The robot without the law is replayed with the forces that were observed, which
moves it as the fitted robot, and with a little more at one node at a time. The corrections are that combination of the
responses which, with the other unknowns and the numerical error, explains most of what the fit leaves. They are of
first order: right where the fitted motion is close to the recorded one. The cost is eleven replays.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.diagnosis.assembly.law_evaluation import Servos, Springs, law_site
from soro_bench.diagnosis.candidates import slices
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.residual_maps import windows
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Effect

_OF_RATE = ("friction", "timing")  # classes of laws that depend on the rate of a state; others on the state
_NODES = 4  # of either direction
_EXTREME = 0.02  # of the states, beyond the outer nodes at either end
_SLOW = 0.1  # of the largest rate, below which a state neither rises nor falls
_PUSH = 0.2  # of the law's largest force
_UNKNOWN = 0.5  # of the law's largest force, a deviation above which the recordings say too little
_LEAST_SHARE = 0.6  # of the law's squared force that a function of the state has to describe
_LEAST_WINDOWS = 10  # that errors are estimated from


BeforeStep = Callable[[int], None]  # called with the number of a control step


@dataclass(frozen=True)
class Curve:
    """Force against state at the nodes, of falling and of rising states: arrays are (2, n).

    law: of the fitted law; NaN at states that were not reached. measured, deviation: what the recordings say, with its
    standard deviation; NaN where they say too little. share: of the law's squared force, described by the lines.
    labels: of state and force, with units.
    """

    effect: Effect
    state: np.ndarray
    law: np.ndarray
    measured: np.ndarray
    deviation: np.ndarray
    share: float
    labels: tuple[str, str]


def force_against_state(diagnosis: Diagnosis) -> Curve | None:
    """Of the first effect of the best hypothesis whose law is a function of the state of a place; None without one."""
    problem, hypothesis = diagnosis.explanation.problem, diagnosis.best.hypothesis
    for i, term in enumerate(hypothesis.terms):
        site = law_site(problem.robot, term)
        if site and (curve := _curve(problem, hypothesis, i, site)):
            return curve
    return None


def _curve(problem: Problem, hypothesis: Hypothesis, i: int, site: Springs | Servos) -> Curve | None:
    of_terms, of_rate = (
        hypothesis.effects_of_terms(problem.parameters),
        CATEGORIES[hypothesis.terms[i].name] in _OF_RATE,
    )
    effects, others = ([*itertools.chain(*each)] for each in (of_terms, of_terms[:i] + of_terms[i + 1 :]))
    states, forces = _observed(problem, hypothesis, [effects, others], site)
    nodes, weights = _nodes(states, problem.robot.control_timestep, of_rate)
    flat = np.concatenate([each.reshape(len(each), -1) for each in weights], axis=1)
    force = np.concatenate([each.ravel() for each in forces]) * flat.any(axis=0)
    law = np.linalg.lstsq(flat.T, force)[0]
    share = float(((law @ flat) ** 2).sum() / max((force**2).sum(), 1e-300))
    if share < _LEAST_SHARE:
        return None
    size = float(np.abs(law).max())
    more = _PUSH * size * np.eye(1 + len(law))[:, 1:]  # nothing first
    replays = _with_inputs(problem, hypothesis, others, site, forces, more, weights)
    change, deviation = _corrections(problem, hypothesis, i, (replays[1:] - replays[0]) / _PUSH)
    law[flat.sum(axis=1) < 1.0] = np.nan
    known = np.where((deviation < _UNKNOWN) & np.isfinite(law), size, np.nan)
    columns = (law, law + known * change, known * deviation)
    fitted, measured, spread = ((site.scale * each).reshape(2, -1) for each in columns)
    scale, unit = site.of_state
    label = f"rate of the {site.state} [{unit}/s]" if of_rate else f"{site.state} [{unit}]"
    return Curve(of_terms[i][0], scale * nodes, fitted, measured, spread, share, (label, site.force))


def _nodes(tracks: Sequence[np.ndarray], timestep: float, of_rate: bool) -> tuple[np.ndarray, list[np.ndarray]]:
    """States at the nodes (2, n), and of every recording how much each counts in every step (2 n, T, K).

    A state that neither rises nor falls counts for its last direction; in laws that depend on the rate not at all.
    """
    rates = [np.diff(track, axis=0, prepend=track[:1]) / timestep for track in tracks]
    states = [np.abs(rate) for rate in rates] if of_rate else tracks
    slow = _SLOW * np.quantile(np.abs(np.concatenate(rates)), 1.0 - _EXTREME)
    counted = [(np.abs(rate) >= slow) | (not of_rate) for rate in rates]
    sample = np.concatenate([state[which] for state, which in zip(states, counted, strict=True)])
    low, high = (float(each) for each in np.quantile(sample, (_EXTREME, 1.0 - _EXTREME)))
    nodes, weights = np.linspace(low, high, _NODES), []
    for state, rate, which in zip(states, rates, counted, strict=True):
        hats = np.stack([np.interp(state, nodes, row) for row in np.eye(_NODES)]) * which
        rising = _rising(rate, slow)
        weights.append(np.concatenate([hats * ~rising, hats * rising]))
    return nodes * np.array([[-1.0 if of_rate else 1.0], [1.0]]), weights


def _rising(rates: np.ndarray, slow: float) -> np.ndarray:
    """(T, K) whether the last change that was not slow was a rise."""
    rising, last = np.zeros(rates.shape, bool), np.ones(rates.shape[1], bool)
    for t, rate in enumerate(rates):
        rising[t] = last = np.where(np.abs(rate) >= slow, rate > 0, last)
    return rising


def _corrections(
    problem: Problem, hypothesis: Hypothesis, i: int, responses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(B,) how much of each response (B, M) the recordings ask for, and standard deviations; one is the prior's.

    What a function of the state cannot give is no white noise, so the deviations are what one second more or less
    changes (the jackknife: Tukey, 1958).
    """
    others = np.delete(np.arange(len(hypothesis.x)), slices(hypothesis.terms, problem.parameters)[i])
    discretisation = hypothesis.discretisation(problem).basis
    design = np.concatenate([-responses, hypothesis.jacobian[others], discretisation])
    x = np.concatenate([np.zeros(len(responses)), hypothesis.x[others], np.zeros(len(discretisation))])
    duration = sum(each.time[-1] for each in problem.recordings)
    seconds = min(problem.settings.localisation.map_window, duration / _LEAST_WINDOWS)
    parts = np.split(np.arange(design.shape[1]), np.flatnonzero(np.diff(windows(problem, seconds))) + 1)
    information = np.array([design[:, part] @ design[:, part].T for part in parts])
    pulls = np.array([design[:, part] @ hypothesis.residual[part] for part in parts])
    hessian, pull = information.sum(axis=0) + np.eye(len(x)), pulls.sum(axis=0) + x
    without_one = np.linalg.solve(hessian - information, (pulls - pull)[:, :, None])[:, :, 0]
    off, inverse = without_one - without_one.mean(axis=0), np.linalg.inv(hessian)
    # what no second tells keeps the prior's deviation
    covariance = (1.0 - 1.0 / len(parts)) * off.T @ off + inverse @ inverse
    return -(inverse @ pull)[: len(responses)], np.sqrt(np.diag(covariance))[: len(responses)]


def _observed(
    problem: Problem, hypothesis: Hypothesis, effects: Sequence[Sequence[Effect]], site: Springs | Servos
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States and what the law does there, (T, K) at the end of every step of every recording."""
    found: list[list[np.ndarray]] = []

    def watch(recording: int) -> BeforeStep:
        found.append([])
        return lambda step: found[recording].append(site.observed())

    _replayed(problem, hypothesis, effects, watch)
    ends = [np.array([*track[1:], track[-1]]) for track in found]
    return [track[:, 0] for track in ends], [track[:, 1] for track in ends]


def _with_inputs(
    problem: Problem, hypothesis: Hypothesis, effects: Sequence[Effect], site: Springs | Servos,
    forces: Sequence[np.ndarray], more: np.ndarray, weights: Sequence[np.ndarray],
) -> np.ndarray:  # fmt: skip
    """(N, M) replays with forces (T, K) of every recording, and more at the nodes (N, B)."""

    def apply_input(recording: int) -> BeforeStep:
        acting = forces[recording] + np.tensordot(more, weights[recording], 1)
        return lambda step: site.apply_input(acting[:, step])

    simulated = _replayed(problem, hypothesis, [effects] * len(more), apply_input)
    site.apply_input(np.zeros((len(more), forces[0].shape[1])))
    return simulated


def _replayed(
    problem: Problem, hypothesis: Hypothesis, effects: Sequence[Sequence[Effect]],
    before_step: Callable[[int], BeforeStep],
) -> np.ndarray:  # fmt: skip
    """(N, M) in units of the noise; ``before_step`` gives what to call before the steps of every recording."""
    parameters = np.tile(list(problem.robot.parameters(hypothesis.x).values()), (len(effects), 1))
    parts = [
        problem.robot.simulate_all([each.drive], parameters, effects, before_step(k))[0]
        for k, each in enumerate(problem.recordings)
    ]
    return problem.scaled(parts) / problem.sigma * problem.weight
