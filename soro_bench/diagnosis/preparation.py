"""Preparation: recordings freed of what sensors and loggers did to them, and the robots that replay them.

A signal in another unit than its recording names is refused: it would be taken for physics.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.data_quality.inspection import Inspected, inspected
from soro_bench.diagnosis.data_quality.noise import DataQuality
from soro_bench.diagnosis.data_quality.signals import answers_of, explaining, labels, named, qualities_of
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.result_robot import DataFinding
from soro_bench.diagnosis.robots.measured import Measured, ObservedSignal
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.recording.recording import Recording, RecordingError

_MOST_NUMBERS = 300_000  # of all recordings: four minutes of a trunk; every candidate term adds as many
_WRONG_UNITS = (180 / np.pi, 100.0, 1000.0)  # degrees for rad, cm for m, mm for m


@dataclass(frozen=True)
class Prepared:
    """What a diagnosis explains, and with what.

    robot: explains the signals that the recordings have. fitted: the same with the time step of fits. refined: more
    accurate ones. measured: recordings to explain. heldout: those that nothing is fitted to. inspected: of each
    recording to explain, then of each held-out one. answers: findings of commands that nothing followed. qualities: of
    the first signal in each recording that has it. noise: of each signal [its unit]. least: the least that it may be.
    """

    robot: Robot
    fitted: Robot
    refined: Sequence[Robot]
    measured: tuple[Measured, ...]
    heldout: tuple[Measured, ...]
    inspected: tuple[Inspected, ...]
    answers: Sequence[DataFinding]
    qualities: tuple[DataQuality, ...]
    noise: tuple[float, ...]
    least: tuple[float, ...]
    settings: Settings

    @property
    def spoilt(self) -> bool:
        """Whether samples were found to be wrong before anything was fitted."""
        return any(each.all_findings for each in self.inspected)

    @property
    def findings(self) -> tuple[DataFinding, ...]:
        """What sensors, loggers and commands did to the recordings."""
        return (*(finding for each in self.inspected for finding in each.all_findings), *self.answers)

    def unexplained(self, robot: Robot, measured: tuple[Measured, ...]) -> Problem:
        """Some of the recordings, of which a robot explains nothing yet."""
        first, *others = self.noise
        return unexplained(robot, measured, first, self.settings, others)


def prepared(
    robot: Robot, recordings: Sequence[Recording], heldout: Sequence[Recording], settings: Settings
) -> Prepared:
    """Recordings as a diagnosis explains them.

    Raises:
        RecordingError: a recording lacks something, or moves as if in another unit; says what.
    """
    inspections = _inspected(robot, recordings, heldout, settings)
    robot, inspections = explaining(robot, inspections, settings)
    measured, tested = _measured(robot, *inspections)
    measured, tested, answers = answers_of(robot, measured, tested, settings)
    looked_at = (*inspections[0], *inspections[1])
    qualities = qualities_of(robot, (*measured, *tested), looked_at, settings)
    measured, tested = (
        tuple(found.applied(each) for each, found in zip(some, group, strict=True))
        for some, group in zip((measured, tested), inspections, strict=True)
    )
    found_of = [[each for each in group if each is not None] for group in qualities]
    least = tuple(max(a.least for a in group) for group in found_of)
    # of one sensor: motion only adds to it
    noise = tuple(max(min(a.sigma for a in group), low) for group, low in zip(found_of, least, strict=True))
    fitted = robot.shortened(settings.discretisation.fitted_refinement)
    refined = robot.refined(settings.discretisation.reference_refinement)
    found = Prepared(
        robot, fitted, refined, measured, tested, looked_at, answers, tuple(found_of[0]), noise, least, settings
    )
    check_unit_and_sign(found.unexplained(robot, measured))
    return found


def _inspected(
    robot: Robot, recordings: Sequence[Recording], heldout: Sequence[Recording], settings: Settings
) -> tuple[tuple[Inspected, ...], tuple[Inspected, ...]]:
    """The recordings to explain and the held-out ones, freed of what sensors and loggers did to them."""
    if not recordings:
        raise RecordingError("there is no recording to explain")
    found = []
    for number, (label, recording) in enumerate(zip(labels(recordings, heldout), (*recordings, *heldout), strict=True)):
        check = partial(inspected, number=number, robot=robot, settings=settings)
        found.append(named(label, check, recording))
    return tuple(found[: len(recordings)]), tuple(found[len(recordings) :])


def _measured(robot: Robot, *groups: Sequence[Inspected]) -> list[tuple[Measured, ...]]:
    """What the diagnosis sees of the recordings to explain, and of held-out ones."""
    given = [[each.recording for each in group] for group in groups]
    names = labels(*given)
    left = iter(names)
    found = [tuple(named(next(left), robot.measured, each) for each in group) for group in given]
    recorded = zip(names, itertools.chain(*given), strict=True)
    for (first, one), (second, other) in itertools.combinations(recorded, 2):
        if _same(robot, one, other):
            raise RecordingError(f"{first} and {second} are the same; what is explained twice is no more certain, and "
                                 "held-out recordings have to be others than those that are explained")  # fmt: skip
    if (size := sum(each.columns.size for group in found for each in group)) > _MOST_NUMBERS:
        raise RecordingError(f"{size} numbers to explain; at most {_MOST_NUMBERS}, so cut the recordings")
    return found


def _same(robot: Robot, one: Recording, other: Recording) -> bool:
    """Whether two recordings have the same samples of the robot's signal."""
    first, second = (each.signals.get(robot.signal) for each in (one, other))
    return first is not None and second is not None and np.array_equal(first.values, second.values, equal_nan=True)


def unexplained(
    robot: Robot,
    measured: tuple[Measured, ...],
    sigma: float,
    settings: Settings = DEFAULT,
    others: Sequence[float] = (),
) -> Problem:
    """Recordings of which nothing is explained yet, without discretisation error.

    Args:
        sigma: noise of the first signal [its unit]. others: that of the robot's other signals; 1 by default.
    """
    weight = np.concatenate([np.isfinite(each.columns).ravel().astype(float) for each in measured])
    sigmas = tuple((each, 0.0) for each in (others or [1.0] * len(robot.others)))
    nothing = LowRank(np.zeros((0, weight.size)))
    problem = Problem(robot, measured, sigma, weight, nothing, settings=settings, others=sigmas)
    errors = np.concatenate([_late(measured), _begun_apart(robot, measured, sigma)])
    problem = problem.with_discretisation(errors * problem.of_samples(problem.scales) if sigmas else errors)
    return replace(problem, of_recordings=len(errors))


def _begun_apart(robot: Robot, measured: tuple[Measured, ...], sigma: float) -> np.ndarray:
    """(F, M) how the signals [their units] change where a replay that begins at a noisy sample begins a standard
    deviation of its noise apart, in each of its numbers. Where nothing drives a robot back, it stays apart."""
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    size = sum(each.columns.size for each in measured)
    rows, begin = [np.zeros((0, size))], 0
    for each in measured:
        if each.start is not None and each.start.shape == robot.shape:
            apart = sigma * np.eye(each.start.size).reshape(-1, *robot.shape)
            drives = [replace(each.drive, start=start) for start in (each.start, *(each.start + apart))]
            before, *after = (values[0].ravel() for values in robot.simulate_all(drives, nominal, [()]))
            found = np.zeros((len(after), size))
            found[:, begin : begin + each.columns.size] = np.nan_to_num(np.array(after) - before)
            rows.append(found)
        begin += each.columns.size
    return np.concatenate(rows)


def _late(measured: tuple[Measured, ...]) -> np.ndarray:
    """(F, M) how the signals [their units] change with each possible error of their time stamps."""
    size = sum(each.columns.size for each in measured)
    rows, start = [np.zeros((0, size))], 0
    for each in measured:
        if each.late is not None:
            found = np.zeros((len(each.late), size))
            found[:, start : start + each.columns.size] = (each.late * _rate(each)).reshape(len(each.late), -1)
            rows.append(found)
        start += each.columns.size
    return np.concatenate(rows)


def _rate(measured: Measured) -> np.ndarray:
    """(T, C) rates of change of the signals, across missing samples too."""
    columns = measured.columns
    for column in columns.T:
        seen = np.isfinite(column)
        if seen.any():
            column[:] = np.gradient(np.interp(measured.time, measured.time[seen], column[seen]), measured.time)
    return np.nan_to_num(columns)


def check_unit_and_sign(problem: Problem) -> None:
    """Refuse a signal that moves like the nominal robot, but as many times as far as in another unit, or inverted.

    Raises:
        RecordingError: it does.
    """
    simulated = problem.simulated(problem.robot, [(np.zeros(problem.parameters), ())])[0]
    for which, signal in enumerate(problem.robot.signals):
        parts = zip(problem.split(problem.measured, which), problem.split(simulated, which), strict=True)
        _check(problem, signal, [_motions(*pair) for pair in parts])


def _check(problem: Problem, signal: ObservedSignal, pairs: Sequence[tuple[Floats, Floats]]) -> None:
    """Refuse a signal by its measured and simulated motions in every recording, each in a row."""
    settings = problem.settings.data_quality
    measured, simulated = (np.concatenate(one) for one in zip(*pairs, strict=True))
    product, squares = float(measured @ simulated), float(simulated @ simulated)
    if not abs(product) > (1.0 - settings.unit_tolerance) * np.sqrt(squares * float(measured @ measured)) > 0:
        return
    factor = product / squares
    for scale in (-1.0, *_WRONG_UNITS, *(1.0 / scale for scale in _WRONG_UNITS)):
        if abs(factor / scale - 1.0) < settings.unit_tolerance:
            raise RecordingError(
                f"{signal.name} moves {factor:.3g} times as far in the recordings as in the model; is "
                f"it in {signal.unit}, and the model the right way round?"
            )


def _motions(measured: Floats, simulated: Floats) -> tuple[Floats, Floats]:
    """Samples (T, P, D) that both have, about their means, in a row."""
    seen = np.isfinite(measured) & np.isfinite(simulated)
    count = np.maximum(seen.sum(axis=0), 1)

    def centred(samples: Floats) -> Floats:
        """Shared samples about their means, in a row."""
        mean = np.where(seen, samples, 0.0).sum(axis=0) / count
        return np.where(seen, samples - mean, 0.0).ravel()

    return centred(measured), centred(simulated)
