"""Halve and double every setting of the diagnosis, and record what changes on development robots.

    python benchmarks/diagnosis_settings.py [--anew] [--stages selection fit ...]
    python docs/generate.py

The first command takes half an hour of one core and can be stopped: it goes on with the settings that
docs/results/measured.json lacks, or begins again with --anew. The second one writes docs/reference/settings.md.

The robots are an arm of one joint: healthy, with a payload, with a delayed motor, and with dry friction. A healthy arm
with spikes, coarse levels and late stamps serves the data quality; an arm that something pushes at random serves the
localisation of what no law explains; and one that has got a payload serves the comparison of pairs.

Each case runs once with settings that note where they are read. A setting that nobody has read can change nothing, and
is not varied. The spoilt and the pushed arm are for settings that are first read in their stages, or nowhere else: all
others the first four cases show.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.limits import reached_limits
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.pipeline import Diagnosis, Run, run_diagnosis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import Progress
from soro_bench.diagnosis.settings import DEFAULT, Settings, listed
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP, SIGMA, TRUTH

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
NOT_READ = "not read in these cases"
FACTORS = {"halved": 0.5, "doubled": 2.0}
PAIRED = "paired"  # the group of the comparison of pairs
GOALS, HELD, STEP = 8, 15, 0.02  # of the arm, control steps of each, s
LEVEL, SPIKE, SPIKES = 0.004, 0.5, 4  # rad, rad, samples
LATE = 0.006  # s, of one sample in five
PUSH = 0.05  # N m, standard deviation
_NOTED = 0.01  # of a probability, from which a change is noted
_MOVED = 0.1  # posterior standard deviations of an unknown, likewise
Groups = dict[str, Any]  # settings by the names of their stages
Paths = tuple[Path, Path]


@dataclass(frozen=True)
class Case:
    """hidden: effects of the arm. spoilt: by its sensor. pushed: by something outside the catalogue. paired: compared
    with the arm without the effects. stages: of settings that are varied in it, by where they are first read; all if
    empty."""

    hidden: tuple[Effect, ...] = ()
    spoilt: bool = False
    pushed: bool = False
    paired: bool = False
    stages: tuple[str, ...] = ()


_PAYLOAD = Effect("payload", Location("body", "arm"), {"mass": 0.1})
CASES = {
    "healthy": Case(),
    "payload": Case((_PAYLOAD,)),
    "delay": Case((Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.03}),)),
    "friction": Case((Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05}),)),
    "spoilt": Case(spoilt=True, stages=("data quality",)),
    "pushed": Case(pushed=True, stages=("localisation", "next recording", "limits")),
    PAIRED: Case((_PAYLOAD,), paired=True),
}


@dataclass
class Reads:
    """Where settings were first read: stages by "group.name"."""

    stage: str = "data quality"
    first: dict[str, str] = field(default_factory=dict)

    def begin(self, stage: str) -> None:
        """A stage begins."""
        self.stage = stage

    def watched(self, name: str, group: Any) -> Any:
        """The same settings, but for that they note when they are read."""
        kind = type(group)
        names = {each.name for each in fields(kind)}

        def read(settings: Any, attribute: str) -> Any:
            if attribute in names:
                self.first.setdefault(f"{name}.{attribute}", self.stage)
            return object.__getattribute__(settings, attribute)

        watched = type(kind.__name__, (kind,), {"__getattribute__": read})
        return watched(**{each: getattr(group, each) for each in names})


class RememberingRobot(ModelRobot):
    """A robot that simulates each replay once: most settings leave most replays as they were."""

    replays: ClassVar[dict[tuple, Floats]] = {}

    def shortened(self, factor: int) -> Robot:
        """The same robot with time steps shorter by a factor."""
        return RememberingRobot(*self._sources, self.threads, factor, self._baseline)

    def _roll_out(self, drives: Any, parameters: Any, physics: Any, before_step: Any) -> Floats:
        if before_step:
            return super()._roll_out(drives, parameters, physics, before_step)
        columns = zip(drives, parameters, physics, strict=True)
        keys = [(self.shorter, d.actions.tobytes(), d.start.tobytes(), x.tobytes(), repr(e)) for d, x, e in columns]
        new = [i for i, key in enumerate(keys) if key not in self.replays]
        if new:
            values = super()._roll_out([drives[i] for i in new], parameters[new], [physics[i] for i in new], None)
            self.replays.update({keys[i]: each for i, each in zip(new, values, strict=True)})
        return np.stack([self.replays[key] for key in keys])


@dataclass(frozen=True)
class Outcome:
    """What is said of a case, by what it is about; a probability; numbers, and how far each may move unnoticed."""

    said: dict[str, str]
    probability: float
    numbers: Floats
    deviation: Floats


CaseRun = Callable[[Groups, Progress], Outcome]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", nargs="*", help="groups of settings, such as selection; all by default")
    parser.add_argument("--anew", action="store_true", help="forget what was measured of these groups")
    options = parser.parse_args()
    defaults = {each.name: getattr(DEFAULT, each.name) for each in fields(DEFAULT)}
    if unknown := sorted({*(options.stages or [])} - {*defaults}):
        parser.error(f"no group {unknown[0]}; there are {', '.join(defaults)}")
    groups = options.stages or [*defaults]
    measured = read_json(RESULTS)
    known = measured["settings_sensitivity"]
    names = {f"{group}.{each[1]}" for group, settings in defaults.items() for each in listed(group, settings)}
    for key in [each for each in known if each not in names or (options.anew and each.split(".")[0] in groups)]:
        del known[key]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "arm.xml", Path(folder) / "arm.toml"
        for path, text in zip(paths, (ARM, MAP), strict=True):
            path.write_text(text)
        runs = {name: runner(paths, case) for name, case in CASES.items() if (name == PAIRED) <= (PAIRED in groups)}
        usual, read = with_defaults(runs, defaults)
        remembered = RememberingRobot.replays
        for key, label, settings in varied(defaults, groups):
            RememberingRobot.replays = dict(remembered)  # of the defaults only, to bound the memory
            if label in known.get(key, {}):
                continue
            reading = [name for name in runs if key in read[name]]
            if isinstance(settings, ValueError):
                found: Any = {"all": f"refused, {settings}"}
            elif not reading:
                found = NOT_READ
            else:
                texts = {name: changed(runs[name], settings, usual[name]) for name in reading}
                found = {name: text for name, text in texts.items() if text}
            known.setdefault(key, {})[label] = found
            write_json(RESULTS, measured)
            print(key, label, found or "no change", flush=True)


def with_defaults(runs: dict[str, CaseRun], defaults: Groups) -> tuple[dict[str, Outcome], dict[str, set[str]]]:
    """Outcomes of all cases with default settings, and the settings that are varied in each."""
    usual, stages = {}, {}
    for name, run in runs.items():
        reads = Reads()
        watched = {group: reads.watched(group, each) for group, each in defaults.items()}
        reads.first.clear()  # as they were made
        usual[name] = run(watched, reads.begin)
        stages[name] = reads.first
    return usual, varied_in(stages)


def varied_in(stages: dict[str, dict[str, str]]) -> dict[str, set[str]]:
    """The settings that are varied in each case.

    Args:
        stages: by case, where each setting was first read.
    """
    everywhere = {key for name, first in stages.items() if not CASES[name].stages for key in first}
    return {
        name: {key for key, stage in first.items() if stage in CASES[name].stages or key not in everywhere}
        if CASES[name].stages
        else {*first}
        for name, first in stages.items()
    }


def varied(defaults: Groups, groups: Sequence[str]) -> Iterator[tuple[str, str, Groups | ValueError]]:
    """Name of a setting, name of the factor, and settings with that one times the factor, or why they are refused."""
    for group in groups:
        for _, name, value, _, _ in listed(group, defaults[group]):
            for label, factor in FACTORS.items():
                try:
                    changed = replace(defaults[group], **{name: times(value, factor)})
                except ValueError as error:
                    yield f"{group}.{name}", label, error
                else:
                    yield f"{group}.{name}", label, {**defaults, group: changed}


def times(value: Any, factor: float) -> Any:
    """A setting times a factor; whole numbers stay whole."""
    if isinstance(value, tuple):
        return tuple(times(each, factor) for each in value)
    return round(value * factor) if isinstance(value, int) else value * factor


def runner(paths: Paths, case: Case) -> CaseRun:
    """A function that runs a case with settings, and calls another one with the name of every stage."""
    train, heldout = (recording(paths, case, seed) for seed in (0, 1))
    robot = RememberingRobot(*paths, threads=1)
    if case.paired:
        before = recording(paths, Case(), 0)
        return lambda groups, stage: of_pair(robot, before, train, Settings(**groups), stage)

    def run(groups: Groups, stage: Progress) -> Outcome:
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
    covariance = best.hypothesis.covariance(found.explanation.problem)
    return Outcome(said, best.probability, best.hypothesis.x, np.sqrt(np.diag(covariance)))


def of_pair(robot: Robot, before: Recording, after: Recording, settings: Settings, stage: Progress) -> Outcome:
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


def changed(run: CaseRun, settings: Groups, usual: Outcome) -> str:
    """What changes in a case; nothing where all that is said, its probability and the unknowns stay."""
    try:
        now = run(settings, lambda stage: None)
    except (ValueError, ArithmeticError, LookupError, TypeError, np.linalg.LinAlgError) as error:
        return f"refused: {error}".split("\n")[0][:80]
    pairs = {about: (usual.said[about], now.said[about]) for about in usual.said}
    said = [
        f"{before} becomes {after}" if about == "answer" else f"{about}: {before} becomes {after}"
        for about, (before, after) in pairs.items()
        if before != after
    ]
    if usual.said["answer"] != now.said["answer"]:
        return ", ".join(said)
    if abs(now.probability - usual.probability) >= _NOTED:
        said.append(f"probability {usual.probability:.2f} to {now.probability:.2f}")
    moved = float(np.max(np.abs(now.numbers - usual.numbers) / usual.deviation, initial=0.0))
    if moved >= _MOVED:
        said.append(f"unknowns by {moved:.1f} deviations")
    return ", ".join(said)


if __name__ == "__main__":
    main()
