"""Probes: where on the robot something acts, whatever it is.

A constant force is let act at one place after the other, and the robot replayed: along every tendon, in three
directions on every body, on the joints of every body, and in three directions on all bodies by their mass, as gravity.
The setpoint of every actuator is moved as well, since a servo gives way to no force. Cut into short windows, of which
each may be scaled freely or linearly in what the robot is told and in its shape, these responses stand for anything at
a place that changes slowly within a window; an offset of each measured point stands for a fault there. No law is
assumed. That says where to look: at the places at which they explain most of what parameters and numerical error do
not, forces are found by replays (forces.py), and the one that is more probable than all others says where something
acts.

A body is pushed in three directions where a tendon or an actuator pulls in one, so the windows of those are a third as
long: every place has as many free numbers. With the same windows for all, a force at the tip explained more of what the
motor of one cable did to another than that cable.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from soro_bench.diagnosis.estimation.fit import Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.input_models import UNKNOWNS, Nodes
from soro_bench.diagnosis.localisation.residual_maps import windows
from soro_bench.diagnosis.localisation.test_inputs import Source, sources
from soro_bench.diagnosis.localisation.unknown_inputs import SETTLED, Driven, Search
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Location

WINDOW = 0.15  # s, times the number of directions
FIRST, OF_A_KIND = 6, 2  # places that are looked at, and of every kind at least
FINALISTS, ROUNDS = 8, 8  # of the first round of the search for forces, and how many rounds follow, at most
_SCALES = np.geomspace(0.03, 30.0, 13)  # of a force in a window, standard deviations of the prior in those units


@dataclass(frozen=True)
class Force:
    """What explains most of what a hypothesis leaves if anything may act at a place.

    components: K names, such as "x" (of the world) or "pull". units: of each. start: (n,) s, nodes with straight lines
    between them, of all recordings one after the other; recording: (n,) their numbers. values: (n, K). left: rms
    [signal's unit] of what it does not explain. shares: what part of it is linear in what; empty if it is free in time.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    recording: np.ndarray
    values: np.ndarray
    left: float
    shares: dict[str, float]


@dataclass(frozen=True)
class RankedLocation:
    """A place, the evidence (natural logarithm) that any force there gains, and that force."""

    location: Location
    gain: float
    force: Force


def ranked_locations(
    problem: Problem, robot: Robot, base: Hypothesis, refined: Sequence[Robot] = ()
) -> list[RankedLocation]:
    """Where forces would explain most of what a hypothesis leaves, the best place first; none if no force gains more
    than the best of so many forms and places does by chance, or if forces leave more than nothing does.

    Args:
        robot: that is pushed, with the time steps of its model.
        refined: the same simulated more accurately.
    """
    search = Search(problem, robot, base, refined)
    everything, rows = search.sized(sources(problem, robot, base))
    driven, input_models = [], (False, True)
    for linear in input_models:
        gains = [_gain(problem, base, row, search.linear.features if linear else None) for row in rows]
        driven += search.begin(_screened_candidates(robot, everything, gains), linear)
    race = _raced(search, driven, everything)
    best: dict[Location, Driven] = {}
    chance = np.log(len(input_models) * len(everything))
    for one in sorted(race.driven, key=lambda one: -one.gain):
        if one.gain > chance:
            best.setdefault(one.location, one)
    found = [RankedLocation(one.location, one.gain, _force(problem, search, one)) for one in best.values()]
    # parameters make up for some forces to first order, which is far from what they do
    return [site for site in found if site.force.left < problem.left(base.residual)]


def _screened_candidates(robot: Robot, everything: Sequence[Source], gains: Sequence[float]) -> list[Source]:
    """What gains most, of every kind but faults of measured points a few, and what else may act on the same cables."""
    order, kinds, chosen = np.argsort(-np.asarray(gains), kind="stable").tolist(), Counter(), []
    for rank, i in enumerate(order):
        one = everything[i]
        kinds[one.unit_inputs[0].kind, one.location.kind] += 1
        if rank < FIRST or (not one.measured and kinds[one.unit_inputs[0].kind, one.location.kind] <= OF_A_KIND):
            chosen.append(one)
    cables = {robot.channel(one.location) for one in chosen} - {None}
    return [one for one in everything if one in chosen or robot.channel(one.location) in cables]


class _Race:
    """Forces at places that are found in rounds, of which those go on that may still lead."""

    def __init__(self, search: Search):
        self.driven: list[Driven] = []
        self._search, self._last = search, []  # what each gained last

    @property
    def best(self) -> Driven:
        """The most probable one."""
        return max(self.driven, key=lambda one: one.gain)

    def enter(self, driven: Sequence[Driven]) -> None:
        """A round of some more, the best of which go on."""
        new = sorted(self._search.better(driven), key=lambda one: -one.gain)
        self.driven += new
        self._last += [one.gain if i < FINALISTS else 0.0 for i, one in enumerate(new)]

    def run(self) -> None:
        """As many rounds as those need that would lead if they gained once more what they gained last: of an obstacle
        that is hit, the next round gains two thirds of that."""
        for _ in range(ROUNDS):
            gain, last = np.array([one.gain for one in self.driven]), np.array(self._last)
            best, chosen = gain.argmax(), np.flatnonzero((gain + last >= gain.max()) & (last > SETTLED))
            alone = set(chosen) == {best} and last[best] < gain[best]  # and not in its first round
            if alone or not len(chosen):
                break
            for i, one in zip(chosen, self._search.better([self.driven[i] for i in chosen]), strict=True):
                self._last[i], self.driven[i] = one.gain - self.driven[i].gain, one


def _raced(search: Search, driven: Sequence[Driven], everything: Sequence[Source]) -> _Race:
    """A race of some, and then of those beside the best too, as long as one of them is better."""
    race = _Race(search)
    race.enter(driven)
    race.run()
    while new := _beside(search.robot, race, everything):
        race.enter(search.begin(new, race.best.input_model.linear))
        race.run()
    return race


def _beside(robot: Robot, race: _Race, everything: Sequence[Source]) -> list[Source]:
    """Those beside the best that have not entered: the linear estimate, which chose where to look, is far from where
    large forces lead."""
    best = race.best
    locations, kind = robot.beside(best.location), best.source.unit_inputs[0].kind
    entered = {
        (one.location, one.source.unit_inputs[0].kind)
        for one in race.driven
        if one.input_model.linear == best.input_model.linear
    }
    near = [one for one in everything if one.location in locations and one.unit_inputs[0].kind == kind]
    return [one for one in near if (one.location, kind) not in entered]


def _force(problem, search, one: Driven) -> Force:
    unit_inputs, nodes = one.source.unit_inputs, Nodes(problem) if one.input_model.linear else one.input_model.nodes
    return Force(
        tuple(apply_input.component for apply_input in unit_inputs),
        tuple(apply_input.unit for apply_input in unit_inputs),
        nodes.time,
        nodes.recording,
        nodes.values(one.input_model.factors(one.values)) * [apply_input.amount for apply_input in unit_inputs],
        search.left(one),
        one.input_model.shares(one.values) if one.input_model.linear else {},
    )


def _gain(problem, base, rows, features=None) -> float:
    """Of free combinations of rows (K, M) in every window, or of such that are linear in features (T, F); the best of
    several sizes."""
    duration = sum(each.time[-1] for each in problem.recordings)
    window = windows(problem, max(WINDOW * len(rows), duration * len(rows) / UNKNOWNS))
    free = _Windowed(rows, window)
    discretisation = base.discretisation(problem)
    hessian, gradient = normal_equations(discretisation, base.jacobian, base.residual, base.x)
    explained, inner = (
        free.times(discretisation.basis),
        np.eye(len(discretisation.basis)) + discretisation.basis @ discretisation.basis.T,
    )

    def product(other):
        """Of the free combinations with rows (C, M), the floor marginalised."""
        return free.times(other) - explained @ np.linalg.solve(inner, discretisation.basis @ other.T)

    cross = product(base.jacobian)
    reduced = np.linalg.solve(hessian, cross.T)
    information = free.squares() - explained @ np.linalg.solve(inner, explained.T) - cross @ reduced
    pull = product(base.residual[None])[:, 0] - reduced.T @ gradient
    if features is not None:
        one = window[:: len(window) // len(features)]  # of every control step
        means = np.array([features[one == number].mean(axis=0) for number in np.unique(one)])
        weights = np.kron(means, np.eye(len(rows)))
        information, pull = weights.T @ information @ weights, weights.T @ pull
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values, turned = np.maximum(values, 0.0), vectors.T @ pull
    return max(
        0.5 * float((turned**2 / (values + scale**-2)).sum() - np.log1p(scale**2 * values).sum()) for scale in _SCALES
    )


class _Windowed:
    """Rows (K, M), each free in every of W windows: W times K rows, a window after the other, zero outside theirs."""

    def __init__(self, rows: np.ndarray, window: np.ndarray):
        first = np.unique(window, return_index=True)[1]  # windows rise
        self._cuts, self._parts = first[1:], np.split(rows, first[1:], axis=1)

    def times(self, other: np.ndarray) -> np.ndarray:
        """(W K, C) products with rows (C, M)."""
        parts = np.split(other, self._cuts, axis=1)
        return np.concatenate([own @ part.T for own, part in zip(self._parts, parts, strict=True)])

    def squares(self) -> np.ndarray:
        """(W K, W K) products with themselves."""
        return block_diag(*[part @ part.T for part in self._parts])
