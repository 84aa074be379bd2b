"""Ranking of locations: where on the robot an unknown input acts.

A constant test input acts at one location after the other, and the robot is replayed. Test inputs are forces along
every tendon, in three directions on every body, on the joints of every body, and on all bodies by their mass, as
gravity. The setpoint of every actuator moves as well, since a servo hardly gives way to forces. An offset of each
measured point stands for a sensor fault. No law is assumed.

The responses are cut into short windows. Each window may be scaled freely, or linearly in the commands and in the
robot's shape, so they stand for any slow input. That predicts where to look. At the locations with the largest
predicted gain, inputs are estimated by replays (unknown_inputs.py), and the most probable one says where it acts.

A force on a body has three directions and one along a tendon has one, so windows of the latter are a third as long:
every location has as many free numbers. With the same windows for all, a force at the tip explained more of a wrong
cable motor than a force along that cable.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from soro_bench.diagnosis.estimation.fit import Hypothesis, normal_equations
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.localisation.input_models import SCALES, Linear, Nodes
from soro_bench.diagnosis.localisation.residual_maps import windows
from soro_bench.diagnosis.localisation.test_inputs import Source, sources
from soro_bench.diagnosis.localisation.unknown_inputs import FINALISTS, LEAST_GAIN, ROUNDS, Estimate, Search
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import SelectionSettings
from soro_bench.effects.effect import Location


@dataclass(frozen=True)
class Force:
    """The unknown input at a location that explains most of a residual.

    components: K names, such as "x" (of the world) or "pull". units: of each.
    start: (n,) s, nodes with straight lines between them, of all recordings one after the other.
    recording: (n,) the numbers of the recordings. values: (n, K) in these units.
    remaining_rms: of the residual that it does not explain [signal's unit].
    shares: share of it that is linear in each feature; empty if it is free in time.
    """

    components: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    recording: np.ndarray
    values: np.ndarray
    remaining_rms: float
    shares: dict[str, float]


@dataclass(frozen=True)
class RankedLocation:
    """A location, the log evidence that an unknown input there gains [nats], and that input.

    estimates: of inputs at the location, one of each kind, the best first.
    """

    location: Location
    gain: float
    force: Force
    estimates: tuple[Estimate, ...]


def ranked_locations(
    problem: Problem, robot: Robot, base: Hypothesis, refined: Sequence[Robot] = ()
) -> list[RankedLocation]:
    """Locations at which an unknown input explains the residual of a hypothesis, the largest gain first.

    Locations are left out where the gain is not above that of the best of so many by chance, or where the input leaves
    a larger residual than no input.

    Args:
        robot: on which the inputs act, with the time steps of its model.
        refined: the same simulated more accurately.
    """
    search = Search(problem, robot, base, refined)
    everything, rows = search.sized(sources(problem, robot, base))
    entrants: list[Estimate] = []
    models = (False, True)  # free in time, or linear in commands and shape
    for linear in models:
        gains = [_predicted_gain(problem, base, row, search.linear.features if linear else None) for row in rows]
        entrants += search.begin(_screened(robot, everything, gains, problem.settings.selection), linear)
    estimates = _estimated(search, entrants, everything)
    by_chance = np.log(len(models) * len(everything))
    best: dict[Location, dict[str, Estimate]] = {}
    for estimate in sorted(estimates, key=lambda e: -e.gain):
        if estimate.gain > by_chance:
            best.setdefault(estimate.location, {}).setdefault(estimate.source.kind, estimate)
    firsts = [(tuple(each.values()), next(iter(each.values()))) for each in best.values()]
    ranked = [RankedLocation(e.location, e.gain, _force(problem, search, e), kinds) for kinds, e in firsts]
    # parameters make up for some inputs to first order, which is far from what they do
    return [site for site in ranked if site.force.remaining_rms < problem.left(base.residual)]


def _screened(
    robot: Robot, everything: Sequence[Source], gains: Sequence[float], settings: SelectionSettings
) -> list[Source]:
    """Test inputs with the largest predicted gains, a few of every kind, and all others that act on the same cables.

    Sensor faults are screened exactly, so they have to be among the best.
    """
    order = np.argsort(-np.asarray(gains), kind="stable").tolist()
    times: Counter[tuple[str, str]] = Counter()
    chosen = []
    for rank, i in enumerate(order):
        source = everything[i]
        times[source.kind, source.location.kind] += 1
        few = times[source.kind, source.location.kind] <= settings.candidates_per_law
        if rank < settings.candidates or (not source.measured and few):
            chosen.append(source)
    cables = {robot.channel(source.location) for source in chosen} - {None}
    return [source for source in everything if source in chosen or robot.channel(source.location) in cables]


class _Rounds:
    """Estimates of inputs that improve in rounds, of which those go on that may still become the best."""

    def __init__(self, search: Search):
        self.estimates: list[Estimate] = []
        self._search = search
        self._last_gains: list[float] = []

    @property
    def best(self) -> Estimate:
        """The one with the largest gain."""
        return max(self.estimates, key=lambda estimate: estimate.gain)

    def enter(self, entrants: Sequence[Estimate]) -> None:
        """A round of new estimates, the best of which go on."""
        new = sorted(self._search.better(entrants), key=lambda estimate: -estimate.gain)
        self.estimates += new
        self._last_gains += [e.gain if i < FINALISTS else 0.0 for i, e in enumerate(new)]

    def run(self) -> None:
        """Rounds of all that would become the best if they gained once more what they gained last.

        Where an obstacle is hit, the next round gains two thirds of the last one.
        """
        for _ in range(ROUNDS):
            gains, last = np.array([e.gain for e in self.estimates]), np.array(self._last_gains)
            best = gains.argmax()
            chosen = np.flatnonzero((gains + last >= gains.max()) & (last > LEAST_GAIN))
            alone = set(chosen) == {best} and last[best] < gains[best]  # and not in its first round
            if alone or not len(chosen):
                break
            for i, better in zip(chosen, self._search.better([self.estimates[i] for i in chosen]), strict=True):
                self._last_gains[i], self.estimates[i] = better.gain - self.estimates[i].gain, better


def _estimated(search: Search, entrants: Sequence[Estimate], everything: Sequence[Source]) -> list[Estimate]:
    """Rounds of the entrants, and then of inputs beside the best one too, as long as one of them is better."""
    rounds = _Rounds(search)
    rounds.enter(entrants)
    rounds.run()
    while new := _beside(search.robot, rounds, everything):
        rounds.enter(search.begin(new, rounds.best.input_model.linear))
        rounds.run()
    return rounds.estimates


def _beside(robot: Robot, rounds: _Rounds, everything: Sequence[Source]) -> list[Source]:
    """Test inputs at the locations beside the best one that have not entered.

    The linear prediction chose where to look, and large inputs are far from linear.
    """
    best = rounds.best
    locations, kind = robot.beside(best.location), best.source.kind
    entered = {
        (estimate.location, estimate.source.kind)
        for estimate in rounds.estimates
        if estimate.input_model.linear == best.input_model.linear
    }
    near = [source for source in everything if source.location in locations and source.kind == kind]
    return [source for source in near if (source.location, kind) not in entered]


def _force(problem: Problem, search: Search, estimate: Estimate) -> Force:
    """An estimate in the units of its components."""
    unit_inputs, model = estimate.source.unit_inputs, estimate.input_model
    nodes = Nodes(problem) if isinstance(model, Linear) else model.nodes
    return Force(
        tuple(unit_input.component for unit_input in unit_inputs),
        tuple(unit_input.unit for unit_input in unit_inputs),
        nodes.time,
        nodes.recording,
        nodes.values(model.factors(estimate.values)) * [unit_input.amount for unit_input in unit_inputs],
        search.remaining_rms(estimate),
        model.shares(estimate.values) if isinstance(model, Linear) else {},
    )


def _predicted_gain(problem: Problem, base: Hypothesis, rows: np.ndarray, features: np.ndarray | None = None) -> float:
    """Log evidence that responses (K, M) gain, free in every window or linear in features (T, F).

    The prior deviation is the best of several.
    """
    settings = problem.settings.localisation
    duration = sum(recording.time[-1] for recording in problem.recordings)
    window = windows(problem, max(settings.node_spacing * len(rows), duration * len(rows) / settings.most_values))
    free = _Windowed(rows, window)
    discretisation = base.discretisation(problem)
    hessian, gradient = normal_equations(discretisation, base.jacobian, base.residual, base.x)
    explained = free.times(discretisation.basis)
    inner = np.eye(len(discretisation.basis)) + discretisation.basis @ discretisation.basis.T

    def product(other: np.ndarray) -> np.ndarray:
        """(W K, C) of the responses with rows (C, M), the discretisation error marginalised."""
        return free.times(other) - explained @ np.linalg.solve(inner, discretisation.basis @ other.T)

    cross = product(base.jacobian)
    reduced = np.linalg.solve(hessian, cross.T)
    information = free.squares() - explained @ np.linalg.solve(inner, explained.T) - cross @ reduced
    pull = product(base.residual[None])[:, 0] - reduced.T @ gradient
    if features is not None:
        of_step = window[:: len(window) // len(features)]  # the window of every control step
        means = np.array([features[of_step == number].mean(axis=0) for number in np.unique(of_step)])
        weights = np.kron(means, np.eye(len(rows)))
        information, pull = weights.T @ information @ weights, weights.T @ pull
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    values, turned = np.maximum(values, 0.0), vectors.T @ pull
    return max(
        0.5 * float((turned**2 / (values + scale**-2)).sum() - np.log1p(scale**2 * values).sum()) for scale in SCALES
    )


class _Windowed:
    """Rows (K, M), each free in every one of W windows: W times K rows, zero outside their windows."""

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
