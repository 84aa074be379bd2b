"""A recording beside the simulated robot that gets the same actions, for the Rerun viewer."""

from pathlib import Path

import numpy as np

from soro_bench.recording.drawing import Points
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.rerun_log import require_rerun, write_recording
from soro_bench.recording.simulated import replay

_RADIUS = 0.0015  # m, drawn only
# one for each signal in turn; colours that no robot has
_COLORS = np.array([(255, 0, 200), (0, 170, 200), (255, 140, 0), (120, 60, 200)], np.uint8)


def write_comparison(recording: Recording, path: str | Path, title: str) -> None:
    """Write the measured points of a recording and its replay into a Rerun file; ValueError if it has no replay."""
    require_rerun()  # before the work, not after it
    write_recording(path, [replay(recording)], title, measured_points(recording))


def measured_points(recording: Recording) -> dict[str, Points]:
    """Every signal of places [m] in the frame "world", a row of coordinates or several, by its name."""
    names = [name for name in recording.names if _is_places(recording.signals[name])]
    return {
        name: Points(
            recording.signals[name].time - recording.start,
            recording.signals[name].values.reshape(len(recording.signals[name].time), -1, 3),
            _RADIUS,
            _COLORS[i % len(_COLORS)],
        )
        for i, name in enumerate(names)
    }


def _is_places(signal: Signal) -> bool:
    return (signal.unit, signal.frame) == ("m", "world") and signal.values.shape[1:][-1:] == (3,)
