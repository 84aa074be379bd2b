"""Of what form a force at a place is in time: free, or linear in what the robot is told and in how it is shaped.

Both are Gaussian: values with a prior covariance, and factors of the pushes at a place that are linear in them.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag

from soro_bench.diagnosis.estimation.problem import Problem

SPACING = 0.1  # s, of nodes; piecewise constant forces of 0.15 s put a base that rocks at 2 Hz into a vertebra
MEMORY = 0.9  # s, after which a trunk is where it would be without a pulse
UNKNOWNS = 1000  # of a place; in long recordings nodes are farther apart
TIMES = (0.2, 0.6, 2.0)  # s, correlation of a force that is free in time
SHAPES = 8  # principal components of what is measured
_JITTER = 1e-9


class Nodes:
    """Nodes in time with straight lines between them, of all recordings one after the other.

    Attributes:
        every: control steps between nodes. time: (n,) s of the nodes in their recordings. recording: (n,) the numbers
            of these. counts: how many each recording has.
    """

    def __init__(self, problem: Problem, fewest: int = 1):
        timestep = problem.robot.control_timestep
        self._steps = [len(each.values) for each in problem.recordings]
        self._sample = int(np.prod(problem.robot.shape))
        self.every = max(1, round(SPACING / timestep), fewest)
        self._apart = max(2, math.ceil(MEMORY / (self.every * timestep)))  # nodes between pulses of a replay
        self.counts = [(steps - 1) // self.every + 2 for steps in self._steps]
        self._number = np.concatenate([np.arange(count) for count in self.counts])
        self.time = timestep * self.every * self._number
        self.recording = np.repeat(np.arange(len(self.counts)), self.counts)

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording, of values (n, K) at the nodes."""
        found = []
        for steps, part in zip(self._steps, np.split(values, np.cumsum(self.counts)[:-1]), strict=True):
            at = np.arange(steps) / self.every
            low = at.astype(int)
            found.append(part[low] + (at - low)[:, None] * (part[low + 1] - part[low]))
        return found

    def values(self, factors: Sequence[np.ndarray]) -> np.ndarray:
        """(n, K) at the nodes, of factors (T, K) in every control step of each recording."""
        found = []
        for part, count in zip(factors, self.counts, strict=True):
            found.append(part[np.minimum(self.every * np.arange(count), len(part) - 1)])
        return np.concatenate(found)

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) of each of P replays: pulses at nodes that are a memory of the robot apart share one."""
        return [
            self.factors((self._number % self._apart == comb)[:, None].astype(float)) for comb in range(self._apart)
        ]

    def owners(self) -> Iterator[tuple[int, int, slice]]:
        """Every node, the replay that has a pulse there, and the samples in which that shows."""
        first, node = 0, 0
        for steps, count in zip(self._steps, self.counts, strict=True):
            for number in range(count):
                begin, end = (np.clip((number + k) * self.every, 0, steps) for k in (-1, self._apart - 1))
                shown = slice(first + int(begin) * self._sample, first + int(end) * self._sample)
                yield node, number % self._apart, shown
                node += 1
            first += steps * self._sample


class Free:
    """(n, K) values of K pushes at nodes in time; in long recordings these are farther apart."""

    linear = False

    def __init__(self, problem: Problem, components: int):
        steps = sum(len(each.values) for each in problem.recordings)
        self.nodes = Nodes(problem, math.ceil(components * steps / UNKNOWNS))
        self.size = len(self.nodes.time)

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording."""
        return self.nodes.factors(values)

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) of each of P replays."""
        return self.nodes.pulses()

    def parts(self, rows: np.ndarray) -> sp.csr_array:
        """(n K, M) what each value changes, of what replays of pulses do (K, P, M)."""
        values, columns, ends = [], [], [0]
        for _, comb, shown in self.nodes.owners():
            for row in rows[:, comb]:
                values.append(row[shown])
                columns.append(np.arange(shown.start, shown.stop))
                ends.append(ends[-1] + shown.stop - shown.start)
        shape = len(ends) - 1, rows.shape[-1]
        return sp.csr_array((np.concatenate(values), np.concatenate(columns), ends), shape=shape)

    def covariances(self) -> list[np.ndarray]:
        """(n, n) of one push, some: Matern 3/2 in each recording."""
        found = []
        for correlation in TIMES:
            blocks = []
            for time in np.split(self.nodes.time, np.cumsum(self.nodes.counts)[:-1]):
                lag = np.abs(np.subtract.outer(time, time)) / correlation
                blocks.append((1.0 + lag) * np.exp(-lag))
            found.append(block_diag(*blocks) + _JITTER * np.eye(self.size))
        return found


class Linear:
    """(F, K) weights of features, for K pushes: a constant, the setpoints, and principal components of what is
    measured, each with a mean square of one.

    Args:
        setpoints: (T, nu) of the actuators in every control step of each recording.
        names: of the actuators.

    Attributes:
        features: (T, F) in the control steps of all recordings. names: of the features.
    """

    linear = True

    def __init__(self, problem: Problem, setpoints: Sequence[np.ndarray], names: Sequence[str]):
        told = np.concatenate(setpoints)
        shape = np.concatenate([each.values.reshape(len(each.values), -1) for each in problem.recordings])
        shape = np.nan_to_num(shape - np.nanmean(shape, axis=0))  # what is missing is as usual
        shape = shape @ np.linalg.svd(shape, full_matrices=False)[2][:SHAPES].T
        found = np.concatenate([np.ones((len(told), 1)), told - told.mean(axis=0), shape], axis=1)
        self.features = found / np.maximum(np.sqrt((found**2).mean(axis=0)), 1e-12)
        self.names = ["constant", *(f"setpoint of {name}" for name in names), *["shape"] * shape.shape[1]]
        self.size = found.shape[1]
        self._parts = np.split(self.features, np.cumsum([len(each) for each in setpoints])[:-1])

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording."""
        return [part @ values for part in self._parts]

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) of each of F replays, one a feature: where cables go slack, sums of others mislead."""
        return [[part[:, [i]] for part in self._parts] for i in range(self.size)]

    def parts(self, rows: np.ndarray) -> np.ndarray:
        """(F K, M) what each weight changes, of what replays of pulses do (K, F, M)."""
        return rows.swapaxes(0, 1).reshape(-1, rows.shape[-1])

    def covariances(self) -> list[np.ndarray]:
        """(F, F) of one push: weights are independent."""
        return [np.eye(self.size)]

    def shares(self, values: np.ndarray) -> dict[str, float]:
        """What part of a force is linear in what, by its weights; all components of the shape together."""
        squares = (values**2).sum(axis=1)
        shares: dict[str, float] = {}
        for name, part in zip(self.names, squares / max(squares.sum(), 1e-300), strict=True):
            shares[name] = shares.get(name, 0.0) + float(part)
        return dict(sorted(shares.items(), key=lambda item: -item[1]))
