"""Of what form a force at a place is in time: free, or linear in what the robot is told and in how it is shaped.

Both are Gaussian: values with a prior covariance, and factors of the pushes at a place that are linear in them.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag

from soro_bench.diagnosis.problem import Problem

SPACING = 0.1  # s, of nodes; piecewise constant forces of 0.15 s put a base that rocks at 2 Hz into a vertebra
MEMORY = 0.9  # s, after which a trunk is where it would be without a pulse
UNKNOWNS = 1000  # of a place; in long recordings nodes are farther apart
TIMES = (0.2, 0.6, 2.0)  # s, correlation of a force that is free in time
SHAPES = 8  # principal components of what is measured
_JITTER = 1e-9


class Free:
    """Nodes in time with straight lines between them, of all recordings one after the other: (n, K) values of K pushes.

    Attributes:
        time: (n,) s of the nodes in their recordings. recording: (n,) the numbers of these.
    """

    linear = False

    def __init__(self, problem: Problem, components: int):
        timestep = problem.robot.control_timestep
        self._steps = [len(each.values) for each in problem.recordings]
        self._sample = int(np.prod(problem.robot.shape))
        fewest = math.ceil(components * sum(self._steps) / UNKNOWNS)
        self._every = max(1, round(SPACING / timestep), fewest)  # control steps between nodes
        self._apart = max(2, math.ceil(MEMORY / (self._every * timestep)))  # nodes between pulses of a replay
        self._counts = [(steps - 1) // self._every + 2 for steps in self._steps]
        self.size = sum(self._counts)
        self._number = np.concatenate([np.arange(count) for count in self._counts])
        self.time = timestep * self._every * self._number
        self.recording = np.repeat(np.arange(len(self._counts)), self._counts)

    def factors(self, values: np.ndarray) -> list[np.ndarray]:
        """(T, K) in every control step of each recording."""
        found = []
        for steps, part in zip(self._steps, np.split(values, np.cumsum(self._counts)[:-1]), strict=True):
            at = np.arange(steps) / self._every
            low = at.astype(int)
            found.append(part[low] + (at - low)[:, None] * (part[low + 1] - part[low]))
        return found

    def values(self, factors: Sequence[np.ndarray]) -> np.ndarray:
        """(n, K) of factors (T, K) in every control step of each recording."""
        found = []
        for part, count in zip(factors, self._counts, strict=True):
            found.append(part[np.minimum(self._every * np.arange(count), len(part) - 1)])
        return np.concatenate(found)

    def replays(self) -> np.ndarray:
        """(P, n) values of one push in each of P replays: pulses that are a memory of the robot apart share one."""
        return (self._number % self._apart == np.arange(self._apart)[:, None]).astype(float)

    def parts(self, rows: np.ndarray) -> sp.csr_array:
        """(n K, M) what each value changes, of what the replays do (K P, M), those of a push one after the other."""
        samples = rows.shape[1]
        rows = rows.reshape(-1, self._apart, samples)
        values, columns, ends = [], [], [0]
        for comb, (begin, end) in zip(self._number % self._apart, self._spans(), strict=True):
            for row in rows[:, comb]:
                values.append(row[begin:end])
                columns.append(np.arange(begin, end))
                ends.append(ends[-1] + end - begin)
        return sp.csr_array((np.concatenate(values), np.concatenate(columns), ends), shape=(len(ends) - 1, samples))

    def covariances(self) -> list[np.ndarray]:
        """(n, n) of one push, some: Matern 3/2 in each recording."""
        found = []
        for correlation in TIMES:
            blocks = []
            for begin, end in pairwise([0, *np.cumsum(self._counts)]):
                lag = np.abs(np.subtract.outer(self.time[begin:end], self.time[begin:end])) / correlation
                blocks.append((1.0 + lag) * np.exp(-lag))
            found.append(block_diag(*blocks) + _JITTER * np.eye(self.size))
        return found

    def _spans(self) -> list[tuple[int, int]]:
        """The samples in which a pulse at each node shows."""
        found, first = [], 0
        for steps, count in zip(self._steps, self._counts, strict=True):
            for node in range(count):
                begin, end = (np.clip((node + k) * self._every, 0, steps) for k in (-1, self._apart - 1))
                found.append((first + int(begin) * self._sample, first + int(end) * self._sample))
            first += steps * self._sample
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

    def replays(self) -> np.ndarray:
        """(F, F) weights of one push in each of F replays."""
        return np.eye(self.size)

    def parts(self, rows: np.ndarray) -> np.ndarray:
        """(F K, M) what each weight changes, of what the replays do (K F, M), those of a push one after the other."""
        return rows.reshape(-1, self.size, rows.shape[1]).swapaxes(0, 1).reshape(rows.shape)

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
