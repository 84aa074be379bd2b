"""Replays of the robots of a result on any recordings: what a diagnosis prints, anybody can repeat.

A replay is plain: at the time step of the model, without any covariance. What counts is what the diagnosis looks at:
samples that the inspection of the signal keeps, at the time stamps that it rebuilds, but for points that stand still or
are alone and far off. Of recordings of the diagnosis itself the result says which these are.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.data_quality.samples import far_off
from soro_bench.diagnosis.result import Result, plain_json
from soro_bench.diagnosis.result_robot import ACCURATE, ReplayedRobot, SignalQuality
from soro_bench.diagnosis.robots.measured import Measured, ObservedSignal
from soro_bench.diagnosis.robots.model_file import ModelError, source_files, with_advice
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import MAX_EFFECTS, Effect, effect_from
from soro_bench.files import brief
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.recording import Recording, RecordingError

SCHEMA = "soro-bench/replay-check/1"
ROBOTS = ("nominal", "fitted", "patched", "best", ACCURATE)  # of a result, in this order
ALONE = "model_alone"  # patched_model.xml without remaining effects
ROLES = FITTED, HELD_OUT, NEW = "fitted to", "held out", "new"
_DEVIATION = 1.4826  # standard deviations of normal noise in its median size
_TINY = float(np.finfo(float).tiny)
_ROUNDING = 1e-6  # of a value in a file, by which it may be beyond its bounds


@dataclass(frozen=True)
class FileErrors:
    """Errors of plain replays of a signal of a recording.

    name: of its file. signal, unit: of the signal. role: "fitted to", "held out" or "new" to the diagnosis. samples:
    numbers that count. left_out: share of the numbers that do not. rms: of a coordinate [signal's unit], by robot; NaN
    where a replay diverges. points: the same of each point; NaN where nothing was measured.
    """

    name: str
    signal: str
    unit: str
    role: str
    samples: int
    left_out: float
    rms: dict[str, float]
    points: dict[str, tuple[float, ...]]


@dataclass(frozen=True)
class ReplayCheck:
    """Errors of plain replays of several recordings.

    robot, model: names, as the result has them. noise: of the first signal [its unit]. robots: that were replayed.
    files: a row for every recording and signal that it has. notes: in words.
    """

    robot: str
    model: str
    noise: float
    robots: tuple[str, ...]
    files: tuple[FileErrors, ...]
    notes: tuple[str, ...] = ()

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals, the first one first."""
        return tuple(dict.fromkeys(each.signal for each in self.files))

    def pooled(self, role: str, signal: str | None = None) -> dict[str, float]:
        """Root mean squares over all files of a role, by robot; empty if there is none.

        Args:
            signal: the first one by default.
        """
        signal = signal or self.signals[0]
        files = [each for each in self.files if (each.role, each.signal) == (role, signal)]
        count = sum(each.samples for each in files)
        square = {name: sum(each.samples * each.rms[name] ** 2 for each in files) for name in self.robots}
        return {name: math.sqrt(each / count) for name, each in square.items()} if count else {}

    def to_json(self) -> dict:
        """A JSON object; NaN is null."""
        pooled = {
            signal: {role: plain_json(found) for role in ROLES if (found := self.pooled(role, signal))}
            for signal in self.signals
        }
        return {"schema": SCHEMA, **plain_json(self), "pooled": pooled}


def robot_of(
    result: Result, folder: str | Path = "", model: str | Path | None = None, mapping: str | Path | None = None
) -> tuple[Robot, list[str]]:
    """The robot of a result, by its model as built, and what to say of its files.

    Args:
        folder: of the result; paths of its files are those of the working directory, or else from there.
        model, mapping: where these files are now, if not where the result says.

    Raises:
        ValueError: a file is not there; says which option names it.
    """
    name, told = result.robot.name, (model, mapping)
    if result.trainable:
        if any(told):
            raise ValueError(f"{brief(name)} is a robot of the suite: leave out --model and --map")
        return SuiteRobot(name, result.robot.model, signals=result.robot.others), []
    known = result.robot.files if len(result.robot.files) == len(told) else (None, None)
    paths: list[Path] = []
    for option, given, file in zip(("--model ROBOT.xml", "--map MAP.toml"), told, known, strict=True):
        tried = [Path(given)] if given else ([Path(file.path), Path(folder) / file.path] if file else [])
        if (path := next((each for each in tried if each.is_file()), None)) is None:
            where = f"not at {brief(str(tried[0]))}" if tried else "not in the result"
            raise ValueError(f"the file of {brief(name)} is {where}; say where it is: {option}")
        paths.append(path)
    changed = [
        f"{path} has changed since the diagnosis"
        for path, file, found in zip(paths, known, source_files(*paths), strict=True)
        if file and file.sha256 != found.sha256
    ]
    return ModelRobot(paths[0], paths[1]), changed


@one_blas_thread
@quiet()
def check_replays(
    result: Result, robot: Robot, recordings: Mapping[str, Recording], notes: Sequence[str] = ()
) -> ReplayCheck:
    """Replay the robots of a result on recordings, which need not be those of the diagnosis.

    Args:
        robot: of the result, as :func:`robot_of` makes it; one of a baseline or with known parameters counts as built.
        recordings: by name.
        notes: to begin with.

    Raises:
        RecordingError: a recording is not of this robot; names it.
        ValueError: the result is not of this robot.
    """
    robot, said = robot.as_built(), list(notes)
    if (robot.signal, robot.unit) != (result.robot.signal, result.robot.unit):
        raise ValueError(f"the result is of {brief(result.robot.signal)} in {brief(result.robot.unit)}; this robot has "
                         f"{robot.signal} in {robot.unit}")  # fmt: skip
    robot = robot.explaining([each for each in robot.others if each.name in result.robot.others])
    shown = _replayed_robots(result)
    finer = robot.accurate() if any(each.name == ACCURATE for each in shown) else None
    shown = [each for each in shown if each.name != ACCURATE or finer]
    points = [(finer if each.name == ACCURATE and finer else robot, *_point(robot, each)) for each in shown]
    alone = _alone(result, robot, said)
    names = (*(each.name for each in shown), *([ALONE] if alone else []))
    if not recordings:
        raise ValueError("there is no recording to replay")
    files: list[FileErrors] = []
    for name, recording in recordings.items():
        try:
            measured, spoilt = _measured(robot, recording)
        except RecordingError as error:
            raise RecordingError(f"{name}: {error}") from error
        runs = _runs(measured, [*points, *([(alone, _nominal(alone), ())] if alone else [])])
        role, quality = _role(result, recording)
        seen = np.isfinite(measured.columns)
        if quality:
            seen[_left_out(quality, seen.shape)] = False
        else:
            fitted = runs[names.index("fitted") if "fitted" in names else -1]
            seen &= ~_far(robot, measured.columns - fitted, seen, result.train.noise, spoilt)
        whole = np.isfinite(robot.measured(recording).columns)
        files += _errors(robot, name, role, dict(zip(names, measured.columns - runs, strict=True)), seen, whole)
    found = ReplayCheck(result.robot.name, result.robot.model, result.train.noise, names, tuple(files))
    return replace(found, notes=(*said, *_differing(result, shown, found)))


def _replayed_robots(result: Result) -> list[ReplayedRobot]:
    """The robots of a result; of an older version those that its parameters and patch are of."""
    robots = result.robots
    if not robots:
        nominal = {each.estimate.name: each.nominal for each in result.parameters}
        values = {each.estimate.name: each.estimate.value for each in result.parameters}
        last = "patched" if result.patch.effects else "fitted"
        robots = (
            *([] if result.robot.has_baseline else [ReplayedRobot("nominal", nominal, (), math.nan)]),
            ReplayedRobot(last, values, result.patch.effects, math.nan),
        )
    found = [next((each for each in robots if each.name == name), None) for name in ROBOTS]
    return [each for each in found if each is not None]


def _nominal(robot: Robot) -> Floats:
    """(d,) values of a robot's parameters as it is built."""
    return np.array([prior.nominal for prior in robot.priors])


def _point(robot: Robot, of: ReplayedRobot) -> tuple[Floats, tuple[Effect, ...]]:
    """The values of parameters (d,) and the effects of a robot, checked: they are from a file.

    Raises:
        ValueError: this robot has other parameters or bounds, or cannot have these effects.
    """
    names = [prior.name for prior in robot.priors]
    if sorted(of.parameters) != sorted(names):
        raise ValueError(f"the result has parameters {brief(', '.join(of.parameters))}; this robot has "
                         f"{', '.join(names)}")  # fmt: skip
    values = np.array([of.parameters[name] for name in names])
    for prior, value in zip(robot.priors, values, strict=True):
        low, high = prior.bounds
        near = _ROUNDING * abs(value)
        if not low - near <= value <= high + near:
            raise ValueError(f"{prior.name} is {value:g} in the result; allowed is {low:g} to {high:g} {prior.unit}")
    if len(of.effects) > MAX_EFFECTS:
        raise ValueError(f"the result has {len(of.effects)} effects at once; at most {MAX_EFFECTS} are allowed")
    effects = tuple(effect_from(each, ALL) for each in of.effects)
    if not robot.simulation.accepts([each for each in effects if each.location.kind != "sensor"]):
        raise ValueError(f"this robot cannot have {', '.join(f'{e.name} at {e.location}' for e in effects)} at once")
    bounds = np.array([prior.bounds for prior in robot.priors]).reshape(-1, 2)
    return np.clip(values, *bounds.T), effects


def _alone(result: Result, robot: Robot, said: list[str]) -> Robot | None:
    """The robot by the patched model alone; None, and a note in ``said``, if there is none or it cannot be used."""
    if result.patch.model is None:
        return None
    try:
        return robot.as_built(checked_model(result.patch.model, robot))
    except (ValueError, mujoco.FatalError) as error:
        said.append(f"the patched model of the result is not replayed: {error}")
        return None


def _measured(robot: Robot, recording: Recording) -> tuple[Measured, bool]:
    """What counts of a recording, as a diagnosis sees it, and whether its inspection left anything out."""
    found = inspected(recording, 0, robot, DEFAULT)
    return found.applied(answered(robot.measured(found.recording), 0, robot).measured), bool(found.all_findings)


def _runs(measured: Measured, points: Sequence[tuple[Robot, Floats, tuple[Effect, ...]]]) -> Floats:
    """(N, T, C) the numbers of all signals of replays at points, a robot with parameters and effects each."""
    runs = [robot.simulate_all([measured.drive], values[None], [effects])[0] for robot, values, effects in points]
    return np.concatenate(runs)


def _role(result: Result, recording: Recording) -> tuple[str, SignalQuality | None]:
    """The role of a recording, and what the result says of it; None of a new one."""
    digest = recording.digest()
    number = next((i for i, each in enumerate(result.recordings) if each.digest == digest), None)
    if number is None:
        return NEW, None
    return (FITTED if number < result.trained_on else HELD_OUT), result.recordings[number]


def _left_out(quality: SignalQuality, shape: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """Samples and columns that fits left out; ValueError if the recording has no such ones."""
    samples, columns = ([pair[i] for pair in quality.left_out] for i in (0, 1))
    for name, indices, size in (("sample", samples, shape[0]), ("column", columns, shape[1])):
        if indices and not 0 <= min(indices) <= max(indices) < size:
            wrong = next(each for each in indices if not 0 <= each < size)
            raise ValueError(f"the result leaves out {name} {wrong} of a recording with {size}")
    return samples, columns


def _signals(robot: Robot) -> Iterator[tuple[ObservedSignal, slice]]:
    """The signals of a robot, and the columns of their numbers."""
    first = 0
    for each in robot.signals:
        yield each, slice(first, first + each.size)
        first += each.size


def _far(robot: Robot, residual: Floats, seen: Bools, noise: float, spoilt: bool) -> Bools:
    """(T, C) whether a number is of a point that is alone and far off its replay (T, C); none where that diverges.

    Args:
        seen: (T, C) what was measured. noise: of the first signal. spoilt: whether the inspection left anything out.
    """
    far = np.zeros(residual.shape, bool)
    for which, (signal, columns) in enumerate(_signals(robot)):
        off, there = residual[:, columns], seen[:, columns]
        if there.any() and np.isfinite(off[there]).all():
            usual = max(_DEVIATION * float(np.median(np.abs(off[there]))), 0.0 if which else noise, _TINY)
            points = np.where(there, off / usual, np.nan).reshape(-1, *signal.shape)
            far[:, columns] = np.repeat(far_off(points, spoilt), signal.shape[1], axis=1)
    return far


def _errors(
    robot: Robot, name: str, role: str, residuals: Mapping[str, Floats], seen: Bools, whole: Bools
) -> Iterator[FileErrors]:
    """Errors of every signal that a recording has.

    Args:
        residuals: (T, C) by robot. seen: (T, C) what counts. whole: (S, C) what was measured, before any inspection.
    """
    for signal, columns in _signals(robot):
        shape, there = (len(seen), *signal.shape), seen[:, columns]
        if not there.any():
            continue
        count = there.reshape(shape).sum(axis=(0, 2))
        squares = {  # NaN of a replay that diverges
            key: np.where(there, off[:, columns] ** 2, 0.0).reshape(shape).sum(axis=(0, 2))
            for key, off in residuals.items()
        }
        points = {
            key: np.sqrt(np.divide(each, count, np.full(len(count), np.nan), where=count > 0))
            for key, each in squares.items()
        }
        left_out = max(1.0 - int(there.sum()) / max(int(whole[:, columns].sum()), 1), 0.0)
        yield FileErrors(
            name,
            signal.name,
            signal.unit,
            role,
            int(there.sum()),
            left_out,
            {key: float(np.sqrt(each.sum() / count.sum())) for key, each in squares.items()},
            {key: tuple(each.tolist()) for key, each in points.items()},
        )


def _differing(result: Result, shown: Sequence[ReplayedRobot], found: ReplayCheck) -> list[str]:
    """Notes on errors that are others than the diagnosis has printed for the same recordings."""
    roles = (FITTED, result.trained_on), (HELD_OUT, len(result.recordings) - result.trained_on)
    said, unit = [], result.robot.unit
    for role, count in roles:
        if not count or sum((each.role, each.signal) == (role, found.signals[0]) for each in found.files) != count:
            continue
        pooled = found.pooled(role)
        for each in shown:
            printed, again = each.train if role == FITTED else each.heldout, pooled[each.name]
            if printed is not None and abs(again - printed) > DEFAULT.report.same_error * printed:
                said.append(f"{each.name}, {role}: the diagnosis has {printed:.4g} {unit}, this replay "
                            f"{again:.4g} {unit}; the model, its mapping or soro_bench has changed")  # fmt: skip
    return said


# A model's text from a stranger's file: it is used only if it is the user's own robot with other numbers.
# what a patched model never has: it would open files, load libraries or make many elements of one
_NEVER = re.compile(r"<\s*(!DOCTYPE|!ENTITY|include|plugin|extension|replicate|composite|flexcomp)\b")
# attributes that name files and folders, or ask for memory
_COSTLY = re.compile(r"file\w*|\w+dir|width|height|nrow|ncol|memory|count|nuser\w*|nstack|njmax|nconmax")
_SIZES = ("nq", "nv", "nu", "nbody", "nmesh", "ntex", "nhfield")
_MEMORY = 4  # times that of the robot's own model


def checked_model(xml: str, robot: Robot) -> str:
    """The MJCF text, if it is of this robot: no file beside those of its model, as many parts, the same time step.

    Raises:
        ModelError: it is another one; nothing that it names has been opened.
    """
    if found := _NEVER.search(xml):
        raise ModelError(f"it has <{found[1]}>")
    spec = robot.spec()
    own = spec.compile()
    if foreign := _costly(xml) - _costly(spec.to_xml()):
        raise ModelError(f"it has {brief(sorted(foreign)[0])}, which the model of the robot has not")
    try:
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise ModelError(f"it is no MuJoCo model: {with_advice(error)}") from error
    for name in _SIZES:
        if getattr(model, name) != getattr(own, name):
            raise ModelError(f"it has {name} {getattr(model, name)}, the model of the robot {getattr(own, name)}")
    if model.opt.timestep != own.opt.timestep:
        raise ModelError(f"its time step is {model.opt.timestep:g} s, that of the robot {own.opt.timestep:g} s")
    if model.narena > _MEMORY * own.narena:
        raise ModelError(f"it asks for {model.narena} bytes of memory, the model of the robot for {own.narena}")
    return xml


def _costly(xml: str) -> set[str]:
    """Attributes in MJCF that name files or ask for memory, with their values."""
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise ModelError(f"it is no XML: {error}") from error
    return {f"{key}={value}" for each in root.iter() for key, value in each.attrib.items() if _COSTLY.fullmatch(key)}
