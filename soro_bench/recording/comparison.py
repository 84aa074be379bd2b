"""A recording beside simulated robots that get the same actions, for the Rerun viewer."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from soro_bench.recording.drawing import Points
from soro_bench.recording.episode import Episode
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.rerun_log import require_rerun
from soro_bench.recording.simulated import replay, replay_begins

_RADIUS = 0.0015  # m, drawn only
# one for each signal in turn; colours that no robot has
_COLORS = np.array([(255, 0, 200), (0, 170, 200), (255, 140, 0), (120, 60, 200)], np.uint8)


def write_comparison(
    recording: Recording, path: str | Path, title: str, runs: Mapping[str, Episode] | None = None
) -> None:
    """Write the measured points of a recording and robots that got its actions into a Rerun file.

    Args:
        runs: what one or two robots did, by name. By default the replay; ValueError if the recording has none.
    """
    require_rerun()  # before the work, not after it
    from soro_bench.recording.rerun_runs import write_runs

    runs = runs or {"replay": replay(recording)}
    write_runs(path, title, runs, measured_points(recording, replay_begins(recording)))


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


def _is_places(signal: Signal) -> bool:
    return (signal.unit, signal.frame) == ("m", "world") and signal.values.shape[1:][-1:] == (3,)
