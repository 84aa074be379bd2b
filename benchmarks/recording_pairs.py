"""Two recordings of one robot: whether the 90 % intervals of its parameters overlap, or a result says that they do not.

    python benchmarks/recording_pairs.py --out FOLDER [--robots arm servo trunk] [--seeds 10]

Writes one JSON file per pair into the folder, goes on where it was stopped, and prints a table. Robots have parameters
drawn from their priors and half the time step of their model; the second motion is half as wide as the first one.
"healthy" pairs hide nothing, "effect" pairs one law of the catalogue. In "unexplained" pairs the same law is hidden and
no law is looked for, so that the structure is wrong.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.interval_coverage import ARM as SERVO
from soro_bench.arrays import Floats
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.result_parts import Agreement
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP

SERVO_MAP = (
    MAP.split("[parameters", maxsplit=1)[0]
    + """
[parameters.mass]
fields = ["body_mass:arm", "body_inertia:arm"]
deviation = 0.2
[parameters.damping]
fields = ["dof_damping:hinge"]
deviation = 0.5
[parameters.armature]
fields = ["dof_armature:hinge"]
deviation = 0.5
"""
)
NEVER = 1e9  # times the misfit: no law is predicted to gain so much
CONDITIONS = ("healthy", "effect", "unexplained")


@dataclass(frozen=True)
class Kind:
    """A robot, its noise [unit of its signal], what is hidden, and its motion (T, A) of a width."""

    robot: Callable[[Path], Robot]
    noise: float
    hidden: Effect
    motion: Callable[[np.random.Generator, float], Floats]
    recording: Callable[[Floats, Floats, Floats], Recording]


def _of_file(name: str, model: str, mapping: str) -> Callable[[Path], Robot]:
    def robot(folder: Path) -> Robot:
        paths = folder / f"{name}.xml", folder / f"{name}.toml"
        for path, text in zip(paths, (model, mapping), strict=True):
            path.write_text(text)
        return ModelRobot(*paths, threads=1)

    return robot


def _steps(rng: np.random.Generator, width: float) -> Floats:
    """5 s of goals [rad], held for 0.3 s each."""
    return np.repeat(rng.uniform(-0.6, 0.6, 17), 15)[:, None] * width


def _rates(rng: np.random.Generator, width: float) -> Floats:
    """10 s of cable rates from -1 to 1, held for 0.4 s each, that come back."""
    half = np.repeat(rng.uniform(-1.0, 1.0, (13, 8)), 8, axis=0) * width
    return np.concatenate([half, -half[::-1]])


def _angles(time: Floats, actions: Floats, values: Floats) -> Recording:
    goal, angle = Signal(time[:-1], actions), Signal(time, values[:, 0, 0], "rad")
    return Recording({"goal": goal}, {"angle": angle})


def _keypoints(time: Floats, actions: Floats, values: Floats) -> Recording:
    signals = {"keypoints": Signal(time, values, "m", "world")}
    return Recording({"action": Signal(time[:-1], actions)}, signals, {}, {"env_id": "TrunkReach-v0",
                                                                          "action": "continuous"})  # fmt: skip


HINGE = Location("joint", "hinge")
KINDS = {
    "arm": Kind(
        _of_file("arm", ARM, MAP), 5e-4, Effect("coulomb_friction", HINGE, {"friction": 0.04}), _steps, _angles
    ),
    "servo": Kind(
        _of_file("servo", SERVO, SERVO_MAP),
        9e-4,
        Effect("coulomb_friction", HINGE, {"friction": 0.06}),
        _steps,
        _angles,
    ),
    "trunk": Kind(
        lambda _: SuiteRobot("TrunkReach-v0", threads=1),
        5e-4,
        Effect("actuator_gain", Location("actuator", "L0"), {"gain": 0.7}),
        _rates,
        _keypoints,
    ),
}


def recordings(kind: Kind, robot: Robot, hidden: bool, rng: np.random.Generator) -> tuple[list[Recording], Floats]:
    """Two recordings of a robot with other parameters, and these (1, d)."""
    truth = np.array([[float(prior.value(x)) for prior, x in zip(robot.priors, rng.standard_normal(99), strict=False)]])
    finer, found = robot.shortened(2), []
    for width in (1.0, 0.5):
        actions = kind.motion(rng, width)
        start = np.zeros((1, *robot.shape))
        (values,) = finer.simulate(actions, truth, [[kind.hidden] if hidden else []], start[0])
        first = finer.simulate(actions[:1] * 0.0, truth, [[]], start[0])[0, :1] if robot.shape[0] > 1 else start
        values = np.concatenate([first, values])
        values = np.asarray(values + kind.noise * rng.standard_normal(values.shape), float)
        stamps = np.asarray(robot.control_timestep * np.arange(len(values)), float)
        found.append(kind.recording(stamps, actions, values))
    return found, truth


def _settings(condition: str) -> Settings:
    if condition != "unexplained":
        return DEFAULT
    # neither laws nor locations are looked for
    selection = replace(DEFAULT.selection, least_gain_of_misfit=NEVER)
    report = replace(DEFAULT.report, least_probability=1.0)
    return replace(DEFAULT, selection=selection, report=report)


def case(name: str, condition: str, seed: int, folder: Path) -> dict:
    """What a diagnosis of a pair says."""
    kind, rng, begin = KINDS[name], np.random.default_rng(seed), time.perf_counter()
    robot = kind.robot(folder)
    pair, truth = recordings(kind, robot, condition != "healthy", rng)
    result = diagnose(robot, pair, settings=_settings(condition))
    true = dict(zip([prior.name for prior in robot.priors], truth[0].tolist(), strict=True))
    return {
        "robot": name,
        "condition": condition,
        "seed": seed,
        "verdict": result.verdict,
        "effects": list(result.best.names),
        "overlap": all(each.overlap for each in result.agreement),
        "said": any(each.changes for each in result.agreement),
        "quantities": [_quantity(each, true) for each in result.agreement],
        "seconds": round(time.perf_counter() - begin, 1),
    }


def _quantity(found: Agreement, true: dict[str, float]) -> dict:
    values = [[each.value, each.low, each.high] for each in found.estimates]
    return {"name": found.name, "law": found.law, "truth": None if found.law else true[found.name],
            "estimates": values, "p_value": found.p_value, "overlap": found.overlap}  # fmt: skip


def _row(name: str, condition: str, cases: list[dict]) -> tuple[str, ...]:
    apart = [each for each in cases if not each["overlap"]]
    held = [low <= q["truth"] <= high for each in cases for q in each["quantities"] if q["truth"] is not None
            for _, low, high in q["estimates"]]  # fmt: skip
    seconds = sorted(each["seconds"] for each in cases)
    return (
        name, condition, f"{len(cases)}", f"{len(cases) - len(apart)}", f"{sum(each['said'] for each in apart)}",
        f"{100 * np.mean(held):.0f} %" if held else "", f"{seconds[len(seconds) // 2]:.0f}",
    )  # fmt: skip


def main() -> None:
    """Diagnose the pairs that are missing, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robots", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--seeds", type=int, default=10)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in options.robots:
        for condition in options.conditions:
            cases = []
            for seed in range(options.seeds):
                record = options.out / f"{name}_{condition}_{seed}.json"
                if not record.exists():
                    write_json(record, case(name, condition, seed, options.out))
                cases.append(read_json(record))
                print(name, condition, seed, cases[-1]["verdict"], cases[-1]["overlap"], cases[-1]["said"], flush=True)
            rows.append(_row(name, condition, cases))
    head = ("robot", "condition", "pairs", "overlap", "apart and said", "intervals that hold the truth", "median s")
    print(table(head, rows))


if __name__ == "__main__":
    main()
