"""The signals of recordings: which of a robot's they have, how noisy they are, and what is left out of them."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from soro_bench.diagnosis.data_quality.inspection import Inspected
from soro_bench.diagnosis.data_quality.noise import DataQuality, compressed, data_quality
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.result_robot import DataFinding
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import Settings
from soro_bench.recording.recording import NOTES, Recording, RecordingError, with_file

S = TypeVar("S")
T = TypeVar("T")
Groups = tuple[tuple[Inspected, ...], tuple[Inspected, ...]]  # of recordings to explain, and held-out ones


def explaining(robot: Robot, inspections: Groups, settings: Settings) -> tuple[Robot, Groups]:
    """The robot with those of its other signals that the recordings to explain have, and what was seen of them."""
    names = labels([each.recording for each in inspections[0]], ())
    measured = [named(label, robot.measured, each.recording) for label, each in zip(names, inspections[0], strict=True)]
    first = max(each.only(0, robot.signals[0]).reach for each in measured)
    kept, notes = [], []
    for which, signal in enumerate(robot.others, 1):
        qualities, reach = [], 0.0
        for whole, each in zip(measured, inspections[0], strict=True):
            if signal.name in each.recording.signals:
                seen = whole.only(which, signal)
                with suppress(RecordingError):  # too few samples, or one value only: nothing to explain
                    qualities.append(_quality(seen, each.others[which - 1], settings))
                    reach = max(reach, seen.reach)
        if qualities:
            kept.append((which - 1, replace(signal, reach=reach)))
        else:
            notes.append(f"{signal.name} is not explained: the recordings have no samples of it that change")
    explained, heldout = (
        tuple(replace(each, others=tuple(each.others[i] for i, _ in kept)) for each in group) for group in inspections
    )
    return robot.explaining([signal for _, signal in kept], notes, first), (explained, heldout)


def answers_of(
    robot: Robot, measured: Sequence[Measured], tested: Sequence[Measured], settings: Settings
) -> tuple[tuple[Measured, ...], tuple[Measured, ...], list[DataFinding]]:
    """The recordings to explain and the held-out ones, whose first signals were compared with their commands; and what
    was found."""
    found = []
    for number, (label, each) in enumerate(zip(labels(measured, tested), (*measured, *tested), strict=True)):
        check = partial(answered, number=number, robot=robot, settings=settings)
        found.append(named(label, check, each))
    values, count = tuple(each.measured for each in found), len(measured)
    return values[:count], values[count:], [finding for each in found for finding in each.findings]


def imported(recordings: Sequence[Recording]) -> Iterator[DataFinding]:
    """What the imports of recordings have left out, changed or seen."""
    for number, recording in enumerate(recordings):
        for line in recording.metadata.get(NOTES, "").splitlines():
            group, _, name = line.partition(": ")[0].partition(".")
            about = name if group in ("signals", "commands") else ""
            yield DataFinding("import", about, number, 0, 0.0, f"import: {line.rstrip('.')}")


def qualities_of(
    robot: Robot, measured: Sequence[Measured], found: Sequence[Inspected], settings: Settings
) -> list[list[DataQuality | None]]:
    """Of each signal the noise and gaps in every recording; None where another signal than the first is missing."""
    qualities: list[list[DataQuality | None]] = [
        [_quality(each.only(0, robot.signals[0]), one, settings) for each, one in zip(measured, found, strict=True)]
    ]
    for which, signal in enumerate(robot.others, 1):
        qualities.append([])
        for each, one in zip(measured, found, strict=True):
            quality = None
            with suppress(RecordingError):
                quality = _quality(each.only(which, signal), one.others[which - 1], settings)
            qualities[-1].append(quality)
    return qualities


def _quality(measured: Measured, found: Inspected, settings: Settings) -> DataQuality:
    """Noise and gaps of what is left of a recording."""
    if not found.findings:
        return data_quality(measured, settings.data_quality)
    quality = data_quality(replace(measured, values=compressed(measured.values)), settings.data_quality)
    least = max(quality.least, found.step / math.sqrt(12))
    return DataQuality(max(quality.sigma, least), least, float(np.isnan(measured.values).mean()))


def left_out(before: Problem, after: Problem) -> Iterator[DataFinding]:
    """What fits left out of other signals than the first."""
    for which, signal in enumerate(before.robot.others, 1):
        weights = zip(before.split(before.weight, which), after.split(after.weight, which), strict=True)
        for number, (had, has) in enumerate(weights):
            if count := int((had - has).sum()):
                share = count / float(had.sum())
                said = f"{signal.name}: {100 * share:.2g} % of the samples are alone and far off; left out"
                yield DataFinding("spikes", signal.name, number, count, share, said)


def labels(recordings: Sequence[Recording | Measured], heldout: Sequence[Recording | Measured]) -> list[str]:
    """Names of the recordings to explain and of the held-out ones."""
    groups = ("recording", recordings), ("held-out recording", heldout)
    return [with_file(f"{kind} {number}", each.file) for kind, group in groups for number, each in enumerate(group, 1)]


def named(label: str, function: Callable[[S], T], recording: S) -> T:
    """What a function makes of a recording; its errors say which recording it was."""
    try:
        return function(recording)
    except RecordingError as error:
        raise RecordingError(f"{label}: {error}") from error
