"""Episodes as a rerun recording (.rrd): a view for reviewers, not the archive.

Every episode has its own entities (/episode_01/world, /episode_01/plots, /episode_01/summary) and its own tab, all on
one timeline "time" that starts at 0 s: a reviewer steps through the episodes by their tabs and sees all of them move
together in the first one. A robot comes in as a :class:`soro_bench.recording.drawing.Drawing`.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from soro_bench.evaluation import Episode
from soro_bench.recording.drawing import Drawing
from soro_bench.recording.rerun_stream import identity, recorded, require_rerun
from soro_bench.recording.trunk_drawing import draw_trunk
from soro_bench.recording.walker_drawing import draw_walker

DRAWINGS = {"Trunk": draw_trunk, "MultiGait": draw_walker}  # by how the environment's id begins


def write_recording(path: str | Path, episodes: Sequence[Episode], title: str) -> None:
    """Write ``episodes`` into the file ``path``, which appears complete or not at all.

    The same episodes and title give the same content and recording id. The bytes differ: rerun draws ids for rows,
    chunks and the blueprint, and orders the columns of the file's index at random.
    """
    require_rerun()
    from soro_bench.recording.rerun_entities import layout, log_episodes

    if not episodes:
        raise ValueError("a recording needs at least one episode")
    drawings = [draw(episode) for episode in episodes]
    with recorded(path, title, identity(title, [episode.metric for episode in episodes])) as recording:
        recording.send_blueprint(layout(episodes, drawings))
        recording.flush()  # what comes now must not overtake it
        log_episodes(recording, episodes, drawings, title)


# python -m rerun_cli (0.41) succeeds whatever becomes of the viewer
RERUN = (sys.executable, "-c", "import sys, rerun_cli.__main__ as rerun; sys.exit(rerun.main())")


def open_viewer(path: str | Path) -> None:
    """Open a recording in rerun's viewer and wait until it is closed.

    The viewer collects no usage statistics and listens to this machine only (by default it listens to the network).
    """
    require_rerun()
    if not Path(path).is_file():
        raise FileNotFoundError(f"no recording {path}")
    ended = subprocess.run([*RERUN, "--bind", "127.0.0.1", str(path)], env=viewer_environment())
    if ended.returncode:
        raise ValueError("rerun's viewer did not run; it needs a display, and --no-open does without it")


def viewer_environment() -> dict[str, str]:
    """Environment variables with which rerun's programs collect no usage statistics, whatever the user's settings.

    Where CI is set, rerun takes the machine for a build server and leaves its settings alone. Its viewer still asks
    GitHub for a newer version.
    """
    environment = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    return {**environment, "CI": "true"}


def draw(episode: Episode) -> Drawing:
    """The drawing of an episode; ValueError if there is none of its robot."""
    for prefix, draw in DRAWINGS.items():
        if episode.env_id.startswith(prefix):
            return draw(episode)
    raise ValueError(f"{episode.env_id} has no drawing; there are drawings of {', '.join(DRAWINGS)}")
