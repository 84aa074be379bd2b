"""Input models: how an unknown input changes in time.

It is free, or linear in the commands and in the robot's shape. Both are Gaussian: values with a prior covariance, and
factors of the unit inputs at a location that are linear in these values.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag

from soro_bench.diagnosis.estimation.problem import Problem

CORRELATION_TIMES = (0.2, 0.6, 2.0)  # s, of a free input, Matern 3/2; the best one counts
SCALES = 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0  # unit inputs, prior deviations that are tried
_SHAPES = 8  # principal components of the signal, in which an input may be linear
_JITTER = 1e-9  # of a covariance, so that its Cholesky factor exists


class Nodes:
    """Nodes in time with straight lines between them, of all recordings one after the other.

    Args:
        fewest: control steps between nodes, at least.

    Attributes:
        every: control steps between nodes. time: (n,) s of the nodes in their recordings. recording: (n,) the numbers
            of these. counts: how many each recording has.
    """

    def __init__(self, problem: Problem, fewest: int = 1):
        timestep, settings = problem.robot.control_timestep, problem.settings.localisation
        self._steps = [len(recording.values) for recording in problem.recordings]
        self._sample = problem.robot.columns
        self.every = max(1, round(settings.node_spacing / timestep), fewest)
        self._apart = max(2, math.ceil(settings.memory / (self.every * timestep)))  # nodes between pulses of a replay
        self.counts = [(steps - 1) // self.every + 2 for steps in self._steps]
        self._number = np.concatenate([np.arange(count) for count in self.counts])
        self.time = timestep * self.every * self._number
        self.recording = np.repeat(np.arange(len(self.counts)), self.counts)

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording, of values (n, K) at the nodes."""
        factors = []
        for steps, part in zip(self._steps, np.split(values, np.cumsum(self.counts)[:-1]), strict=True):
            position = np.arange(steps) / self.every
            before = position.astype(int)
            factors.append(part[before] + (position - before)[:, None] * (part[before + 1] - part[before]))
        return factors

    def values(self, factors: Sequence[np.ndarray]) -> np.ndarray:
        """(n, K) at the nodes, of factors (T, K) in every control step of each recording."""
        values = [
            part[np.minimum(self.every * np.arange(count), len(part) - 1)]
            for part, count in zip(factors, self.counts, strict=True)
        ]
        return np.concatenate(values)

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) in each recording, of each of P replays.

        Pulses at nodes that are a memory of the robot apart share a replay.
        """
        return [
            self.factors((self._number % self._apart == comb)[:, None].astype(float)) for comb in range(self._apart)
        ]

    def owners(self) -> Iterator[tuple[int, int, slice]]:
        """Every node, the replay that has a pulse there, and the samples in which the pulse shows."""
        first, node = 0, 0
        for steps, count in zip(self._steps, self.counts, strict=True):
            for number in range(count):
                begin, end = (np.clip((number + k) * self.every, 0, steps) for k in (-1, self._apart - 1))
                shown = slice(first + int(begin) * self._sample, first + int(end) * self._sample)
                yield node, number % self._apart, shown
                node += 1
            first += steps * self._sample


class Free:
    """(n, K) values of K unit inputs at nodes in time; in long recordings these are farther apart.

    Args:
        components: K.
    """

    linear = False

    def __init__(self, problem: Problem, components: int):
        settings, steps = problem.settings.localisation, sum(len(each.values) for each in problem.recordings)
        self.nodes = Nodes(problem, math.ceil(components * steps / settings.most_values))
        self.size = len(self.nodes.time)

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording."""
        return self.nodes.factors(values)

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) in each recording, of each of P replays."""
        return self.nodes.pulses()

    def parts(self, rows: np.ndarray) -> sp.csr_array:
        """(n K, M) change by each value, from the changes by replays of pulses (K, P, M)."""
        values, columns, ends = [], [], [0]
        for _, comb, shown in self.nodes.owners():
            for row in rows[:, comb]:
                values.append(row[shown])
                columns.append(np.arange(shown.start, shown.stop))
                ends.append(ends[-1] + shown.stop - shown.start)
        shape = len(ends) - 1, rows.shape[-1]
        return sp.csr_array((np.concatenate(values), np.concatenate(columns), ends), shape=shape)

    def covariances(self) -> list[np.ndarray]:
        """(n, n) prior covariances of one component, for each correlation time: Matern 3/2 in each recording."""
        covariances = []
        for correlation in CORRELATION_TIMES:
            blocks = []
            for time in np.split(self.nodes.time, np.cumsum(self.nodes.counts)[:-1]):
                lag = np.abs(np.subtract.outer(time, time)) / correlation
                blocks.append((1.0 + lag) * np.exp(-lag))
            covariances.append(block_diag(*blocks) + _JITTER * np.eye(self.size))
        return covariances


class Linear:
    """(F, K) weights of features, for K unit inputs.

    Features are a constant, the setpoints, and principal components of the signal, each with a mean square of one.

    Args:
        setpoints: (T, nu) of the actuators in every control step of each recording.
        names: of the actuators.

    Attributes:
        features: (T, F) in the control steps of all recordings. names: of the features.
    """

    linear = True

    def __init__(self, problem: Problem, setpoints: Sequence[np.ndarray], names: Sequence[str]):
        commanded = np.concatenate(setpoints)
        shape = np.concatenate([each.values.reshape(len(each.values), -1) for each in problem.recordings])
        seen = ~np.isnan(shape)
        mean = np.where(seen, shape, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        shape = np.where(seen, shape - mean, 0.0)  # missing samples count as the mean
        shape = shape @ np.linalg.svd(shape, full_matrices=False)[2][:_SHAPES].T
        features = [np.ones((len(commanded), 1)), commanded - commanded.mean(axis=0), shape]
        unscaled = np.concatenate(features, axis=1)
        self.features = unscaled / np.maximum(np.sqrt((unscaled**2).mean(axis=0)), 1e-12)
        self.names = ["constant", *(f"setpoint of {name}" for name in names), *["shape"] * shape.shape[1]]
        self.size = unscaled.shape[1]
        self._parts = np.split(self.features, np.cumsum([len(each) for each in setpoints])[:-1])

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording."""
        return [part @ values for part in self._parts]

    def pulses(self) -> list[list[np.ndarray]]:
        """Factors (T, 1) in each recording, of each of F replays: one a feature.

        Cables go slack, so the sum of the responses to pulses is not the response to a feature.
        """
        return [[part[:, [i]] for part in self._parts] for i in range(self.size)]

    def parts(self, rows: np.ndarray) -> np.ndarray:
        """(F K, M) change by each weight, from the changes by replays of features (K, F, M)."""
        return rows.swapaxes(0, 1).reshape(-1, rows.shape[-1])

    def covariances(self) -> list[np.ndarray]:
        """(F, F) prior covariance of one component: weights are independent."""
        return [np.eye(self.size)]

    def shares(self, values: np.ndarray) -> dict[str, float]:
        """Share of an input that is linear in each feature, by the squares of its weights (F, K); the largest first.

        All components of the shape count together.
        """
        squares = (values**2).sum(axis=1)
        shares: dict[str, float] = {}
        for name, part in zip(self.names, squares / max(squares.sum(), 1e-300), strict=True):
            shares[name] = shares.get(name, 0.0) + float(part)
        return dict(sorted(shares.items(), key=lambda item: -item[1]))
