"""How far simulated robots are from the points that were measured."""

from collections.abc import Mapping

import numpy as np

from soro_bench.evaluation import Episode
from soro_bench.recording.drawing import Points
from soro_bench.recording.recording import Recording, Signal

_RADIUS = 0.0015  # m, drawn only
# one for each signal in turn; colours that no robot has
_COLORS = np.array([(255, 0, 200), (0, 170, 200), (255, 140, 0), (120, 60, 200)], np.uint8)


def measured_points(recording: Recording, begin: float) -> dict[str, Points]:
    """Every signal of places [m] in the frame "world", a row of coordinates or several, by its name.

    Args:
        begin: s, in the time of the recording, from which theirs counts.
    """
    names = [name for name in recording.names if _is_places(recording.signals[name])]
    return {
        name: Points(
            recording.signals[name].time - begin,
            recording.signals[name].values.reshape(len(recording.signals[name].time), -1, 3),
            _RADIUS,
            _COLORS[i % len(_COLORS)],
        )
        for i, name in enumerate(names)
    }


def distances(runs: Mapping[str, Episode], measured: Mapping[str, Points]) -> dict[str, np.ndarray]:
    """How far the runs are from what was measured, by signal, of those that runs have too.

    Returns:
        (n, points, runs) m each, at the n times, NaN where a point was not seen and where there is no run.
    """
    found = {}
    for name, points in measured.items():
        count = points.positions.shape[1]
        own = [(run.time, run.signals[name].reshape(len(run.time), -1)) for run in runs.values() if name in run.signals]
        if len(own) == len(runs) and all(values.shape[1] == 3 * count for _, values in own):
            found[name] = np.stack([_distance(points, *each) for each in own], axis=2)
    return found


def _distance(points: Points, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    at = np.apply_along_axis(lambda column: np.interp(points.time, time, column), 0, values)
    # a log may have its first sample up to a control step before the first command
    at[(points.time < 2 * time[0] - time[1]) | (points.time > time[-1] + 1e-6)] = np.nan
    return np.linalg.norm(at.reshape(points.positions.shape) - points.positions, axis=-1)


def over_points(away: np.ndarray) -> np.ndarray:
    """(n, runs) root mean squares of distances (n, points, runs) over the points that were seen; NaN where none was."""
    seen = np.isfinite(away)
    return np.sqrt(np.where(seen, away**2, 0).sum(axis=1) / np.where(seen.any(axis=1), seen.sum(axis=1), np.nan))


def _is_places(signal: Signal) -> bool:
    return (signal.unit, signal.frame) == ("m", "world") and signal.values.shape[1:][-1:] == (3,)
