"""Active diagnosis: propose a recording, get it, diagnose all of them, until one answer is left.

A proposal is the motion that best tells the remaining answers apart
(:mod:`soro_bench.diagnosis.selection.experiment_design`). It is answered by a simulated robot of the suite, or by
whoever records the real one and puts the file into a folder.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import NextRecording
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import StageProgress, silent
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import load_effects
from soro_bench.files import brief
from soro_bench.recording.excitation import write_actions
from soro_bench.recording.known import Told
from soro_bench.recording.parquet import load
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.simulated import record

_POLL = 0.2  # s between looks for a file
_READ = ("env_id", "model", "action", "noise")  # metadata of a recording that a simulated robot is made from
Source = Callable[[NextRecording, int], Recording]  # answers the k-th proposal, from 1


@dataclass(frozen=True)
class Round:
    """One diagnosis of several: of how many recordings, the likeliest hypothesis with its probability, and the motion
    that was proposed then; "" where one answer is left."""

    recordings: int
    verdict: str
    answer: str
    probability: float
    proposed: str


def diagnose_actively(
    robot: Robot,
    recordings: Sequence[Recording],
    source: Source,
    most: int,
    heldout: Sequence[Recording] = (),
    seed: int = 0,
    progress: StageProgress = silent,
    settings: Settings = DEFAULT,
    known: Told = (),
) -> tuple[Result, tuple[Round, ...]]:
    """Diagnose, get the recording that the diagnosis asks for, and diagnose again.

    Args:
        source: gives the recording that is asked for.
        most: recordings that are asked for at most.
        heldout, seed, progress, settings, known: as for :func:`soro_bench.diagnosis.api.diagnose`, whose errors this
            function raises too.

    Returns:
        The last result, and a row per diagnosis. It ends early where no second answer is left.
    """
    recordings = list(recordings)
    rounds: list[Round] = []
    while True:
        result = diagnose(robot, recordings, heldout, seed, progress, settings, known)
        wanted = result.next_recording if len(rounds) < most else None
        best = result.hypotheses[0]
        answer, probability = " + ".join(best.names) or "none", best.probability
        if result.verdict == "outside_catalogue":
            answer, probability = result.answer, result.unknown
        proposed = wanted.motion if wanted else ""
        rounds.append(Round(len(recordings), result.verdict, answer, probability, proposed))
        if wanted is None:
            return result, tuple(rounds)
        recordings.append(source(wanted, len(rounds)))


@dataclass(frozen=True)
class SimulatedAnswer:
    """A simulated robot of the suite that is like one of its recordings: with those parameters, that model and noise.

    Args:
        recording: of the robot; ``soro-bench record`` wrote it.
        effects: physics that the robot has, as the environment takes it.
    """

    recording: Recording
    effects: Path

    def __post_init__(self) -> None:
        if missing := [name for name in _READ if name not in self.recording.metadata]:
            raise ValueError(f"the first recording has no {missing[0]!r} in its metadata; a simulated robot can answer "
                             "for recordings of soro-bench record only")  # fmt: skip
        if self.recording.metadata["action"] != "continuous":
            raise ValueError("the first recording has discrete actions; a simulated robot answers with continuous ones")
        _noise(self.recording)  # before a diagnosis, not after it
        load_effects(self.effects, ALL)

    def __call__(self, wanted: NextRecording, number: int) -> Recording:
        """Simulate the proposed actions; the seed of the noise is the number of the proposal."""
        about, actions = self.recording.metadata, np.array(wanted.actions)
        return record(
            about["env_id"], actions, about["model"], params=self.recording.parameters, seed=number,
            noise=_noise(self.recording), effects=self.effects,
        )  # fmt: skip


def _noise(recording: Recording) -> float:
    """Standard deviation of the noise [m] that the metadata of a recording say."""
    text = recording.metadata["noise"]
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not 0.0 <= found < math.inf:
        raise ValueError(f"the noise in the first recording's metadata is {brief(text)}; 0 or more is needed")
    return found


@dataclass(frozen=True)
class DroppedFile:
    """Whoever records the robot: proposals are written into a folder as next_1.csv, and next_1.parquet is awaited.

    A file that is there already answers at once, so an interrupted loop goes on with the files that it has.

    channels: names of the columns of a proposal; action.0, action.1 and so on by default.
    """

    folder: Path
    say: Callable[[str], None]
    channels: Sequence[str] = ()

    def __call__(self, wanted: NextRecording, number: int) -> Recording:
        """Wait for the file that answers."""
        actions, answer = self.folder / f"next_{number}.csv", self.folder / f"next_{number}.parquet"
        write_actions(actions, wanted.control_timestep, np.array(wanted.actions), self.channels)
        if not answer.exists():
            self.say(f"{actions}: {wanted.motion}, {wanted.duration_s:g} s. Replay it and write {answer}")
        refused: tuple[int, float] | None = None  # size and time of a file that could not be read
        while True:
            before = _state(answer)
            if before is not None and before != refused:
                time.sleep(_POLL)
                if _state(answer) != before:  # it still grows
                    continue
                try:
                    return load(answer)
                except RecordingError as error:
                    self.say(f"{error}; write it again")
                    refused = before
            time.sleep(_POLL)


def _state(path: Path) -> tuple[int, float] | None:
    """Size and time of a file; None if there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_size, found.st_mtime
