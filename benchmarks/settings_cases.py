"""The cases of benchmarks/diagnosis_settings.py, quick ones first.

An arm of one joint is healthy, or has a payload, a delayed motor or dry friction, which is compared with the healthy
one too; or a spoilt sensor; or something pushes it at random. Of logs by degraded sensors only the data quality is
looked at. Of the last ones the whole result: two recordings between which an arm has become heavier, arms of three
joints with a law outside the catalogue (hidden_arms.py), and a trunk with a weak cable.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchmarks import discovered_laws
from benchmarks.degraded_sensors import SENSORS, arm, degraded, trunk
from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.assembly.limits import reached_limits
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.pipeline import Diagnosis, Run, run_diagnosis
from soro_bench.diagnosis.preparation import check_unit_and_sign, unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.replays import Memory
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.robots.variants import Variant
from soro_bench.diagnosis.selection.forward_selection import StageProgress
from soro_bench.diagnosis.settings import Settings
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import Effect, Location, effect_from
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import ARM, MAP, SIGMA, TRUTH

GOALS, HELD, STEP = 8, 15, 0.02  # of the arm, control steps of each, s
LEVEL, SPIKE, SPIKES = 0.004, 0.5, 4  # rad, rad, samples
LATE = 0.006  # s, of one sample in five
PUSH = 0.05  # N m, standard deviation
TRUNK_STEPS, TRUNK_NOISE, WEAK = 60, 5e-4, 0.7  # control steps, m, gain of a cable
REMEMBERED = 5000  # replays, at most; of a trunk 150 MB
TRUNK_SENSORS = "150 levels", "1 % spikes", "4 % zeros", "held 1.5", "frozen", "25 % late"
NOT_WHOLE = "data_quality", "paired"  # groups that are not varied where diagnoses are slow
HIDDEN = ("quadratic_spring",)  # families of laws
Groups = dict[str, Any]  # settings by the names of their stages
Paths = tuple[Path, Path]


@dataclass(frozen=True)
class Case:
    """hidden: effects of the arm. spoilt: by its sensor. pushed: by something outside the catalogue. paired: compared
    with the arm without the effects."""

    hidden: tuple[Effect, ...] = ()
    spoilt: bool = False
    pushed: bool = False
    paired: bool = False


_PAYLOAD = Effect("payload", Location("body", "arm"), {"mass": 0.1})
ARMS = {
    "healthy": Case(),
    "payload": Case((_PAYLOAD,)),
    "paired": Case((_PAYLOAD,), paired=True),
    "spoilt": Case(spoilt=True),
    "delay": Case((Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.03}),)),
    "friction": Case((Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05}),)),
    "pushed": Case(pushed=True),
    "three effects": Case((
        _PAYLOAD,
        Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.03}),
        Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05}),
    )),
}


class Asked:
    """How many replays were asked for, remembered ones too: the cost of a diagnosis."""

    replays: ClassVar[int] = 0


class Forgetful(Memory):
    """Of a robot whose replays are remembered here, where all are counted that a diagnosis asks for."""

    def keep(self, key: object, values: Floats) -> None:
        """Remember nothing."""


class RememberingRobot(ModelRobot):
    """A robot that simulates each replay once: most settings leave most replays as they were."""

    replays: ClassVar[dict[tuple, Floats]] = {}
    _memory = Forgetful()

    def shortened(self, factor: int) -> Robot:
        """The same robot with time steps shorter by a factor."""
        return RememberingRobot(*self._sources, self.threads, factor, self._baseline)

    def _roll_out(self, drives: Any, parameters: Any, physics: Any, before_step: Any) -> Floats:
        roll_out = super()._roll_out
        return _remembered(self.replays, self.shorter, roll_out, drives, parameters, physics, before_step)


def _remembered(
    replays: dict[tuple, Floats], which: Any, roll_out: Callable[..., Floats], drives: Any, parameters: Any,
    physics: Any, before_step: Any,
) -> Floats:  # fmt: skip
    """Replays by a robot ``which``, those that are new simulated."""
    Asked.replays += len(drives)
    if before_step:
        return roll_out(drives, parameters, physics, before_step)
    columns = zip(drives, parameters, physics, strict=True)
    keys = [(which, d.actions.tobytes(), np.asarray(d.start).tobytes(), x.tobytes(), repr(e)) for d, x, e in columns]
    if len(replays) > REMEMBERED:
        replays.clear()
    new = [i for i, key in enumerate(keys) if key not in replays]
    if new:
        values = roll_out([drives[i] for i in new], parameters[new], [physics[i] for i in new], None)
        replays.update({keys[i]: each for i, each in zip(new, values, strict=True)})
    return np.stack([replays[key] for key in keys])


class RememberingTrunk(SuiteRobot):
    """The same of the trunk, of one signal; its other simulations are built once."""

    def __init__(self) -> None:
        super().__init__("TrunkReach-v0", threads=1, signals=())
        self.replays: dict[tuple, Floats] = {}
        self._built: dict[Any, Any] = {}
        self._remember_replays(self, "own")

    def _remember_replays(self, robot: SuiteRobot, which: Any) -> Robot:
        robot._roll_out = partial(_remembered, self.replays, which, robot._roll_out)  # type: ignore[method-assign]
        robot._memory = Forgetful()
        return robot

    def shortened(self, factor: int) -> Robot:
        """The same robot with shorter time steps."""
        if factor not in self._built:
            robot = super().shortened(factor)
            assert isinstance(robot, SuiteRobot)
            self._built[factor] = self._remember_replays(robot, factor)
        return self._built[factor]

    def accurate(self) -> Robot | None:
        """The same robot by the suite's accurate model."""
        if "accurate" not in self._built:
            robot = super().accurate()
            assert isinstance(robot, SuiteRobot)
            self._built["accurate"] = self._remember_replays(robot, "accurate")
        return self._built["accurate"]

    def variants(self) -> tuple[Variant, ...]:
        """Other simulations, each with a memory."""
        if "variants" not in self._built:
            plain = SuiteRobot("TrunkReach-v0", threads=1, signals=()).variants()
            self._built["variants"] = tuple(partial(self._by_variant, i, each) for i, each in enumerate(plain))
        return self._built["variants"]

    def _by_variant(self, number: int, variant: Variant, drives: Any, parameters: Floats) -> list[Floats]:
        Asked.replays += len(drives)
        key = "variant", number, *(each.actions.tobytes() for each in drives), parameters.tobytes()
        if key not in self._built:
            self._built[key] = variant(drives, parameters)
        return self._built[key]


@dataclass(frozen=True)
class Outcome:
    """What is said of a case, by what it is about; a probability; numbers, and how far each may move unnoticed; and
    figures, of which a tenth is told, as of the replays that it took."""

    said: dict[str, str]
    probability: float
    numbers: Floats
    deviation: Floats
    figures: dict[str, float] = field(default_factory=dict)


CaseRun = Callable[[Groups, StageProgress], Outcome]


@dataclass(frozen=True)
class Planned:
    """A case: what builds it, and the groups of settings that are not varied in it, as others are for these."""

    build: Callable[[], CaseRun]
    without: tuple[str, ...] = ()


def arm_files(folder: Path) -> Paths:
    """The model and the map of the arm, written into a folder."""
    paths = folder / "arm.xml", folder / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    return paths


def runner(paths: Paths, case: Case) -> CaseRun:
    """A function that runs a case with settings, and calls another one with the name of every stage."""
    train, heldout = (recording(paths, case, seed) for seed in (0, 1))
    robot = RememberingRobot(*paths, threads=1)
    if case.paired:
        before = recording(paths, Case(), 0)
        return lambda groups, stage: of_pair(robot, before, train, Settings(**groups), stage)

    def run(groups: Groups, stage: StageProgress) -> Outcome:
        found = run_diagnosis(robot, [train], [heldout], Run(progress=stage, settings=Settings(**groups)))
        stage("limits")
        limits = ", ".join(f"{each.name} of {each.element}" for each in reached_limits(found))
        return of_diagnosis(found, limits)

    return run


def recording(paths: Paths, case: Case, seed: int) -> Recording:
    """Of an arm with other parameters and half the time step."""
    rng = np.random.default_rng(seed)
    goals = np.repeat(rng.uniform(-0.6, 0.6, GOALS), HELD)[:, None]
    robot, start = ModelRobot(*paths, threads=1, shorter=2), np.full((1, 1), 0.2)
    push = np.repeat(PUSH * np.random.default_rng([seed, 1]).standard_normal(GOALS * HELD // 5), 5)

    def pushed(step: int) -> None:
        robot.simulation.batch.qfrc_applied[:] = push[min(step, len(push) - 1)]

    (values,) = robot.simulate(goals, TRUTH, [case.hidden], start, before_step=pushed if case.pushed else None)
    angle = np.concatenate([start[None], values])[:, 0, 0] + SIGMA * rng.standard_normal(len(goals) + 1)
    if case.spoilt:
        angle = LEVEL * np.round(angle / LEVEL)
        angle[rng.choice(np.arange(5, len(goals) - 5), SPIKES, replace=False)] += SPIKE
    time = STEP * np.arange(len(angle))
    given = {"goal": Signal(time[:-1], goals)}
    if case.spoilt:
        time = time + LATE * (rng.random(len(time)) < 0.2)
    return Recording(given, {"angle": Signal(time, angle, "rad")})


def of_diagnosis(found: Diagnosis, limits: str) -> Outcome:
    """Best answer of a diagnosis, and what comes with it."""
    best = found.best
    outside = found.detected and found.comparison.unknown > found.comparison.likeliest
    said = {
        "answer": "discrepancy outside the catalogue" if outside else " + ".join(best.names) or "nothing",
        "location": str(found.ranked_locations[0].location) if found.ranked_locations else "none",
        "data": ", ".join(sorted({each.name for each in found.data})) or "nothing",
        "next recording": found.proposal.motion.words if found.proposal else "none",
        "limits": limits or "none",
    }
    figures = {}
    if found.ranked_locations:
        figures["error with an input at the location"] = found.ranked_locations[0].force.remaining_rms
    if found.proposal:
        moves = float(np.abs(np.diff(found.proposal.motion.actions, axis=0)).sum())
        figures |= {"evidence of the next recording": found.proposal.evidence, "its moves": moves}
    covariance = best.hypothesis.covariance(found.explanation.problem)
    return Outcome(said, best.probability, best.hypothesis.x, np.sqrt(np.diag(covariance)), figures)


def of_pair(robot: Robot, before: Recording, after: Recording, settings: Settings, stage: StageProgress) -> Outcome:
    """What has changed between two recordings."""
    result = compare([before], [after], robot, progress=stage, settings=settings)
    found = result.explanation
    changes = found.changes if found else ()
    estimates = [each for change in changes for each in change.estimates]
    said = {
        "difference": result.signals[0].verdict,
        "answer": " + ".join(f"{each.name} at {each.location or 'the model'}" for each in changes) or "nothing",
    }
    widths = [(each.high or np.inf) - (each.low or -np.inf) for each in estimates]  # of 90 %, 3.3 deviations
    probability = changes[0].probability if changes else 1.0
    return Outcome(said, probability, np.array([each.value for each in estimates]), np.array(widths) / 3.29)


def cases(folder: Path) -> dict[str, Planned]:
    """All cases by name, in the order in which settings are varied in them."""
    paths = arm_files(folder)
    arms: dict[str, Callable[[], CaseRun]] = {name: partial(runner, paths, case) for name, case in ARMS.items()}
    quick, slow = dict(list(arms.items())[:5]), dict(list(arms.items())[5:])
    whole: dict[str, Callable[[], CaseRun]] = {
        "two recordings": partial(two_recordings, paths),
        **{f"hidden {family}": partial(hidden_arm, folder, family) for family in HIDDEN},
        "trunk": weak_cable,
    }
    return {
        **{name: Planned(partial(counted, build)) for name, build in quick.items()},
        "logs": Planned(partial(logs, folder)),
        **{name: Planned(partial(counted, build), NOT_WHOLE) for name, build in {**slow, **whole}.items()},
    }


def counted(build: Callable[[], CaseRun]) -> CaseRun:
    """A case that tells how many replays it takes."""
    run = build()

    def counting(groups: Groups, stage: StageProgress) -> Outcome:
        before = Asked.replays
        outcome = run(groups, stage)
        return replace(outcome, figures={**outcome.figures, "replays": float(Asked.replays - before)})

    return counting


def logs(folder: Path) -> CaseRun:
    """Recordings of healthy robots by degraded sensors; of an arm also with values between levels, of a trunk in mm."""
    read: list[tuple[str, Robot, Recording]] = []
    paths = arm_files(folder)
    robots = {"arm": RememberingRobot(*paths, threads=1), "trunk": RememberingTrunk()}
    subjects = ("arm", arm(folder), SENSORS), ("trunk", trunk(folder), TRUNK_SENSORS)
    for name, subject, sensors in subjects:
        for sensor in filter(subject.can, sensors):
            rng = np.random.default_rng([0, zlib.crc32(f"{name} {sensor}".encode())])
            read.append((f"{name} {sensor}", robots[name], degraded(subject, sensor, rng)))
    whole = recording(paths, Case(), 0)
    signal = whole.signals["angle"]
    between = LEVEL * np.round(signal.values / LEVEL)
    between[7::40] += 0.3 * LEVEL
    spoilt = Recording(whole.commands, {"angle": replace(signal, values=between)})
    read.append(("arm between levels", robots["arm"], spoilt))
    whole = degraded(subject, "clean", np.random.default_rng(0))
    signals = {name: replace(each, values=1000.0 * each.values) for name, each in whole.signals.items()}
    read.append(("trunk in mm", robots["trunk"], replace(whole, signals=signals)))

    def run(groups: Groups, stage: StageProgress) -> Outcome:
        settings = Settings(**groups)
        found = {name: _of_log(robot, each, settings) for name, robot, each in read}
        numbers = np.array([number for _, each in found.values() for number in each])
        said = {name: names for name, (names, _) in found.items()}
        return Outcome(said, 1.0, numbers, 0.1 * np.abs(numbers) + 1e-300)  # told from 1 %

    return run


def _of_log(robot: Robot, given: Recording, settings: Settings) -> tuple[str, tuple[float, float]]:
    """What is found in a log; its samples that are left, and its noise."""
    try:
        found = inspected(given, 0, robot, settings)
        measured = found.applied(robot.measured(found.recording))
        answers = answered(measured, 0, robot, settings)
        quality = data_quality(answers.measured, settings.data_quality)
        check_unit_and_sign(unexplained(robot, (answers.measured,), quality.sigma, settings))
    except RecordingError as error:
        return f"refused: {error}"[:60], (0.0, 0.0)
    names = sorted({each.name for each in (*found.findings, *answers.findings)})
    return ", ".join(names) or "nothing", (float(np.isfinite(answers.measured.values).sum()), quality.sigma)


def two_recordings(paths: Paths) -> CaseRun:
    """An arm that has become heavier between two recordings."""
    robot = RememberingRobot(*paths, threads=1)
    train = [recording(paths, Case(), 0), recording(paths, Case(ARMS["payload"].hidden), 2)]
    return partial(_whole, robot, train, [recording(paths, Case(), 1)])


def weak_cable() -> CaseRun:
    """A trunk of which one cable pulls less than it should, moved by random setpoints for a few seconds."""
    subject, truth = trunk(Path()), SuiteRobot("TrunkReach-v0", threads=1, shorter=2, signals=())
    weak, found = Effect("actuator_gain", Location("actuator", "L0"), {"gain": WEAK}), []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        moved = subject.record(rng, False)
        actions = moved.commands["action"].values[:TRUNK_STEPS]
        nominal = np.array([[prior.nominal for prior in truth.priors]])
        (values,) = truth.simulate(actions, nominal, [(weak,)])
        values = values + TRUNK_NOISE * rng.standard_normal(values.shape)
        time = truth.control_timestep * np.arange(1, 1 + len(values))
        signal = Signal(time, values, truth.unit, truth.frame)
        sent = Signal(time - truth.control_timestep, actions)
        found.append(Recording({"action": sent}, {truth.signal: signal}, metadata=moved.metadata))
    return partial(_whole, RememberingTrunk(), found[:1], found[1:])


def hidden_arm(folder: Path, family: str) -> CaseRun:
    """An arm of three joints with a law that the catalogue lacks."""
    (folder / family).mkdir(exist_ok=True)
    _, recordings = discovered_laws.case(family, 0)
    return partial(_whole, discovered_laws.robot(folder / family), recordings[:1], recordings[1:2])


def _whole(
    robot: Robot, train: Sequence[Recording], heldout: Sequence[Recording], groups: Groups, stage: StageProgress
) -> Outcome:
    """The whole result of a diagnosis."""
    found = run_diagnosis(robot, train, heldout, Run(progress=stage, settings=Settings(**groups)))
    result = build_result(found)
    outcome = of_diagnosis(found, ", ".join(f"{each.name} of {each.element}" for each in result.limits))
    outcome.said["verdict"] = result.verdict
    outcome.said["when"] = "; ".join(f"{each.condition} {each.intervals}" for each in result.findings[:1])
    outcome.said["changes"] = ", ".join(each.name for each in result.agreement if each.changes) or "nothing"
    laws = [effect_from(each, ALL) for each in result.discovery.effects] if result.discovery else []
    outcome.said["law"] = "; ".join(f"{each.law.expression} at {each.location}" for each in laws if each.law) or "none"
    outcome.said["other laws"] = str(len(result.discovery.others) if result.discovery else 0)
    outcome.figures["limit of the law"] = max((each.law.limit for each in laws if each.law), default=0.0)
    outcome.figures.update({f"{name} of the law": value for each in laws for name, value in each.parameters.items()})
    outcome.said["replays"] = str(len(result.worse_replays))
    return outcome
