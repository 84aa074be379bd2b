"""Diagnose a robot: from recordings to a result."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.pipeline import Run, run_diagnosis
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import SeedAnswer
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import StageProgress, silent
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.known import Told, known_parameters
from soro_bench.recording.recording import Recording


@one_blas_thread
@quiet()
def diagnose(
    robot: Robot,
    recordings: Sequence[Recording],
    heldout: Sequence[Recording] = (),
    seed: int = 0,
    progress: StageProgress = silent,
    settings: Settings = DEFAULT,
    known: Told = (),
) -> Result:
    """Say which physics the simulation of a robot lacks, from recordings of the real one.

    Args:
        robot: simulated; a :class:`~soro_bench.diagnosis.robots.suite_robot.SuiteRobot` or a
            :class:`~soro_bench.diagnosis.robots.model_robot.ModelRobot` of any MJCF file.
        recordings: to explain, in SI units.
        heldout: of another motion, to test the explanation on.
        seed: of the random numbers; the same seed gives the same result.
        progress: called with the name of every stage.
        settings: numbers of the method, one group per stage.
        known: parameters that are known, by name, {"trunk_mass": 0.42}; or texts as of the command line,
            ["trunk_mass=0.42", "recorded"], where "recorded" takes the values that the recordings have.

    Raises:
        RecordingError: a recording lacks something; the message says what.
        ValueError: the robot has no such parameter as is known, or it cannot have that value.
        SimulationError: the simulation diverges.
    """
    names = [*(prior.name for prior in robot.priors), *(each.name for each in robot.fixed)]
    if (found := known_parameters(known, [*recordings, *heldout], names)).values:
        robot = robot.knowing(found)
    return build_result(run_diagnosis(robot, recordings, heldout, Run(seed, progress, settings)))


def with_seeds(results: Sequence[Result]) -> Result:
    """The first of several results of the same recordings, with the answers of all of them, the most frequent first.

    Args:
        results: of :func:`diagnose` with different seeds.
    """
    counts = Counter(each.answer for each in results)
    found = (SeedAnswer(answer, count, count / len(results)) for answer, count in counts.most_common())
    return replace(results[0], seeds=tuple(found))
