"""Compare recordings of one robot before and after a change: from recordings to a result."""

import time
from collections.abc import Sequence

from soro_bench.diagnosis.paired.alignment import Pair, aligned
from soro_bench.diagnosis.paired.difference import Difference, difference, measured
from soro_bench.diagnosis.paired.explanation import explained
from soro_bench.diagnosis.paired.result import PairedResult, SignalDifference
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import StageProgress, silent
from soro_bench.diagnosis.settings import DEFAULT, DataQualitySettings, Settings
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.known import Told, known_parameters
from soro_bench.recording.recording import Recording, RecordingError, Signal, with_file


@one_blas_thread
@quiet()
def compare(
    before: Sequence[Recording],
    after: Sequence[Recording],
    robot: Robot | None = None,
    seed: int = 0,
    progress: StageProgress = silent,
    settings: Settings = DEFAULT,
    known: Told = (),
) -> PairedResult:
    """Measure, test and explain what differs between recordings of the same commands.

    Args:
        before, after: recordings in SI units; each one after is compared with one before that has the same commands.
            Several of the same commands on one side show how far runs of one robot differ.
        robot: simulated, to explain the difference of its signals; without one it is measured and tested only.
        seed: of the random numbers; the same seed gives the same result.
        progress: called with the name of every stage.
        settings: numbers of the method.
        known: parameters that are known, as of a diagnosis; before the change.

    Raises:
        RecordingError: the commands are not the same, or a recording lacks something; the message says what.
        SimulationError: the simulation diverges.
    """
    start = time.perf_counter()
    progress("commands")
    pairs, repeats = _paired(before, after, settings)
    progress("differences")
    signals, notes = _signals(pairs, repeats, settings)
    explanation = None
    if robot is not None:
        names = [*(prior.name for prior in robot.priors), *(each.name for each in robot.fixed)]
        if (told := known_parameters(known, [*before, *after], names)).values:
            robot = robot.knowing(told)
        found = next((each for each in signals if each.name == robot.signal), None)
        if found is None:
            raise RecordingError(f"both recordings need the signal {robot.signal!r} of the robot; "
                                 f"they have {', '.join(each.name for each in signals)}")  # fmt: skip
        others = [each for each in robot.others if each.name in {signal.name for signal in signals}]
        explanation = explained(robot.explaining(others), pairs, seed, progress, settings)
    notes += [note for pair in pairs for note in pair.notes]
    commands = tuple(pair.commands for pair in pairs)
    return PairedResult(
        commands, tuple(signals), explanation, seed, time.perf_counter() - start, tuple(dict.fromkeys(notes))
    )


def _check_distinct(before: Sequence[Recording], after: Sequence[Recording]) -> None:
    """Refuse recordings that are given twice: they differ by nothing, and are no runs of their own.

    Raises:
        RecordingError: two are the same.
    """
    known: dict[str, str] = {}
    for side, recordings in (("before", before), ("after", after)):
        for number, each in enumerate(recordings, 1):
            label = with_file(f"recording {number} {side} the change", each.file)
            if (first := known.setdefault(each.digest(), label)) != label:
                raise RecordingError(f"{first} and {label} are the same; give another one for one of them")


def _paired(
    before: Sequence[Recording], after: Sequence[Recording], settings: Settings
) -> tuple[list[Pair], list[Pair]]:
    """Pairs of the same commands; and pairs of runs of one robot, from both sides."""
    if not before or not after:
        raise RecordingError("one recording before and one after the change are needed at least")
    _check_distinct(before, after)
    pairs: list[Pair] = []
    used: set[int] = set()
    for number, each in enumerate(after):
        order = sorted(range(len(before)), key=lambda i: (i in used, i != number, i))
        label = with_file(f"recording {number + 1} after the change", each.file)
        pair, i = _first_aligned(before, order, each, settings, label)
        pairs.append(pair)
        used.add(i)
    repeats = _repeats(before, settings) + _repeats(after, settings)
    return pairs, repeats


def _first_aligned(
    before: Sequence[Recording], order: Sequence[int], after: Recording, settings: Settings, name: str
) -> tuple[Pair, int]:
    """The first recording of some whose commands are the same, paired."""
    first: RecordingError | None = None
    for i in order:
        try:
            return aligned(before[i], after, settings), i
        except RecordingError as error:
            first = first or error
    raise RecordingError(f"{name}: {first}") from first


def _repeats(recordings: Sequence[Recording], settings: Settings) -> list[Pair]:
    """Pairs of recordings of one side that have the same commands."""
    found = []
    for i, one in enumerate(recordings):
        for other in recordings[i + 1 :]:
            try:
                found.append(aligned(one, other, settings))
            except RecordingError:
                continue
    return found


def _signals(
    pairs: Sequence[Pair], repeats: Sequence[Pair], settings: Settings
) -> tuple[list[SignalDifference], list[str]]:
    """What differs in every signal that all recordings have; and what there is to say of the others."""
    found, notes = [], []
    first = pairs[0].before
    for name, signal in first.signals.items():
        if not all(_have(name, signal, pair) for pair in pairs):
            notes.append(f"{name} is not compared: not all recordings have it in the same unit, frame and shape")
            continue
        try:
            here = [difference(name, pair, settings.data_quality) for pair in pairs]
        except RecordingError as error:
            notes.append(f"{name} is not compared: {error}")
            continue
        same = [pair for pair in repeats if _have(name, signal, pair)]
        found.append(measured(here, _differences(name, same, settings.data_quality), settings))
    if not found:
        raise RecordingError("; ".join(notes) or "the recordings have no signal")
    return found, notes


def _have(name: str, like: Signal, pair: Pair) -> bool:
    """Whether both recordings of a pair have a signal of that name in the unit, frame and shape of another one."""
    kind = like.unit, like.frame, like.values.shape[1:]
    signals = (each.signals.get(name) for each in (pair.before, pair.after))
    return all(each is not None and (each.unit, each.frame, each.values.shape[1:]) == kind for each in signals)


def _differences(name: str, pairs: Sequence[Pair], settings: DataQualitySettings) -> list[Difference]:
    """Of those pairs that have enough samples of a signal in common."""
    found = []
    for pair in pairs:
        try:
            found.append(difference(name, pair, settings))
        except RecordingError:
            continue
    return found
