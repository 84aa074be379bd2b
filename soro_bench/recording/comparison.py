"""A recording beside simulated robots that get the same actions, for the Rerun viewer."""

from collections.abc import Mapping
from pathlib import Path

from soro_bench.envs.episode import Episode
from soro_bench.recording.distances import distances, measured_points
from soro_bench.recording.recording import Recording
from soro_bench.recording.rerun_stream import require_rerun
from soro_bench.recording.simulated import replay, replay_begins


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
    measured = measured_points(recording, replay_begins(recording))
    write_runs(path, title, runs, measured, distances(runs, measured))
