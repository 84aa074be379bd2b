"""Whether a change between two recordings of the same commands is named, and its size found.

    python benchmarks/paired_changes.py --work FOLDER [--data data/real] [--only servo trunk accurate asl]

Simulated changes of a servo (an arm of one hinge) and of the trunk's lumped model, both simulated with half the time
step and with other parameters than the model that explains them; one change of the trunk recorded on the accurate
model, from which the lumped one is farther than the change moves it; and the recordings of the ASL trunk without and
with a weight. Every case is a file of --work, and the same command goes on with what is missing. Prints a table; with
all cases it writes docs/results/measured.json. A case is right if the first change that is named is of the right kind
and its size within 20 % (25 % for the weight).
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.paired.api import compare
from soro_bench.diagnosis.paired.result import Change, PairedResult
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import asset_path, read_json, read_toml, write_json
from soro_bench.markdown import table
from soro_bench.recording.importers import import_recording
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.simulated import record
from tests.arm import ARM, MAP

RESULTS = Path(__file__).parents[1] / "docs/results/measured.json"
ENV = "TrunkReach-v0"
SERVO = {"inertia": 1.2, "damping": 0.8, "zero": 0.01}
TRUNK = {"trunk_mass": 0.46, "young_modulus": 4.1e6, "damping": 0.12}
STEPS = 364  # control steps of 50 ms, the shortest excitation of the trunk
NOISE = {"servo": 5e-4, "trunk": 5e-4}  # rad and m
TOLERANCE = {"servo": 0.2, "trunk": 0.2, "accurate": 0.2, "asl": 0.25}


@dataclass(frozen=True)
class Case:
    """A change, and what is right.

    effects, parameters: after the change. kind: that has to be named. size: first quantity of it [its unit]; a factor
    counts as its distance from 1.
    """

    robot: str
    name: str
    kind: str
    size: float
    effects: tuple[Effect, ...] = ()
    parameters: dict[str, float] | None = None


def _case(robot: str, name: str, kind: str, size: float, kind_of: str, where: str, **values: float) -> Case:
    return Case(robot, name, kind, size, (Effect(name, Location(kind_of, where), values),))


CASES = (
    _case("servo", "payload", "payload", 0.02, "body", "arm", mass=0.02),
    _case("servo", "actuator_gain", "actuator gain", 0.85, "actuator", "motor", gain=0.85),
    _case("servo", "coulomb_friction", "friction", 0.03, "joint", "hinge", friction=0.03, presliding=5e-4),
    _case("servo", "actuator_delay", "delay", 0.03, "actuator", "motor", delay=0.03),
    _case("servo", "compliance", "actuator stiffness", 0.12, "actuator", "motor", compliance=0.12),
    Case("servo", "damping", "damping", 2.0, parameters={"damping": 1.6}),
    _case("trunk", "payload", "payload", 0.03, "body", "vertebra8", mass=0.03),
    _case("trunk", "actuator_gain", "actuator gain", 0.8, "actuator", "L2", gain=0.8),
    _case("trunk", "coulomb_friction", "friction", 1.0, "tendon", "L1", friction=1.0, presliding=5e-4),
    _case("trunk", "actuator_delay", "delay", 0.03, "actuator", "*", delay=0.03),
    Case("trunk", "stiffness", "stiffness", 0.8, parameters={"young_modulus": 0.8 * 4.1e6}),
    Case("trunk", "damping", "damping", 1.5, parameters={"damping": 1.5 * 0.12}),
    _case("accurate", "payload", "payload", 0.03, "body", "vertebra8", mass=0.03),
    Case("servo", "nothing", "nothing", 0.0),
    Case("trunk", "nothing", "nothing", 0.0),
    Case("asl", "200g", "payload", 0.2),
)


def servo(case: Case, folder: Path) -> tuple[Robot, Recording, Recording]:
    """The arm and its two recordings."""
    model, mapping = folder / "arm.xml", folder / "arm.toml"
    model.write_text(ARM)
    mapping.write_text(MAP)
    truth = ModelRobot(model, mapping, threads=1, shorter=2)
    goals = np.repeat(np.random.default_rng(0).uniform(-0.6, 0.6, 15), 15)[:, None]

    def recorded(parameters: dict[str, float], effects: tuple[Effect, ...], seed: int) -> Recording:
        start = np.full((1, 1), 0.2)
        (values,) = truth.simulate(goals, np.array([list(parameters.values())]), [effects], start)
        values = np.concatenate([start[None], values])[:, 0, 0]
        values = values + NOISE["servo"] * np.random.default_rng(seed).standard_normal(len(values))
        times = truth.control_timestep * np.arange(len(values))
        return Recording({"goal": Signal(times[:-1], goals)}, {"angle": Signal(times, values, "rad")})

    after = {**SERVO, **(case.parameters or {})}
    return ModelRobot(model, mapping, threads=1), recorded(SERVO, (), 1), recorded(after, case.effects, 2)


def trunk(case: Case, _: Path) -> tuple[Robot, Recording, Recording]:
    """The lumped trunk, and two recordings of it with half the time step."""
    robot, truth = SuiteRobot(ENV, threads=1), SuiteRobot(ENV, threads=1, shorter=2)

    def recorded(parameters: dict[str, float], effects: tuple[Effect, ...], seed: int) -> Recording:
        found = record(ENV, "excitation", model=robot.model_name, steps=STEPS, params=parameters, effects=effects)
        values = np.array([[parameters.get(each.name, each.nominal) for each in truth.priors]])
        (moved,) = truth.simulate(truth.actions(found), values, [effects])
        keypoints = found.signals["keypoints"]
        return _noisy(
            found, np.concatenate([keypoints.values[:1], moved.reshape(-1, *keypoints.values.shape[1:])]), seed
        )

    return robot, recorded(TRUNK, (), 1), recorded({**TRUNK, **(case.parameters or {})}, case.effects, 2)


def accurate(case: Case, _: Path) -> tuple[Robot, Recording, Recording]:
    """The lumped trunk, and two recordings of the accurate one."""

    def recorded(effects: tuple[Effect, ...], seed: int) -> Recording:
        found = record(ENV, "excitation", steps=STEPS, params=TRUNK, effects=effects)
        return _noisy(found, found.signals["keypoints"].values, seed)

    return SuiteRobot(ENV, threads=1), recorded((), 1), recorded(case.effects, 2)


def _noisy(found: Recording, keypoints: Floats, seed: int) -> Recording:
    """A recording of the trunk with these keypoints (T, 21, 3) m, as a sensor has them, and nothing else."""
    noise = NOISE["trunk"] * np.random.default_rng(seed).standard_normal(keypoints.shape)
    return replace(found, signals={"keypoints": replace(found.signals["keypoints"], values=keypoints + noise)})


def real(case: Case, data: Path) -> tuple[Robot, Recording, Recording]:
    """The model of the ASL trunk, and its recordings without and with a weight."""
    mapping = read_toml(asset_path("mjcf/real/asl_trunk_import.toml"))
    before, after = (
        import_recording(data / "asl_trunk" / f"servo_random1_{weight}.npz", mapping) for weight in ("0g", case.name)
    )
    robot = ModelRobot(asset_path("mjcf/real/asl_trunk.xml"), asset_path("mjcf/real/asl_trunk.toml"), threads=1)
    return robot, before, after


def summary(case: Case, found: PairedResult, seconds: float) -> dict:
    """What is kept of a case."""
    explanation = found.explanation
    assert explanation is not None
    signal = next(each for each in found.signals if each.name == explanation.signal)
    first = explanation.changes[0] if explanation.changes else None
    return {
        "robot": case.robot,
        "case": case.name,
        "kind": case.kind,
        "size": case.size,
        "verdict": signal.verdict,
        "p_value": min(signal.p_value, 1.0),
        "difference_rms": signal.rms,
        "noise": signal.noise,
        "named": first.kind if first else "nothing",
        "term": _term(first),
        "found": [first.estimates[0].value, first.estimates[0].low, first.estimates[0].high] if first else None,
        "unit": first.estimates[0].unit if first else "",
        "probability": first.probability if first else explanation.nothing,
        "unknown": explanation.unknown,
        "explained": explanation.explained,
        "others": [_term(each) for each in explanation.changes[1:]],
        "replay_rms": explanation.replay,
        "cpu_s": round(seconds, 1),
    }


def _term(change: Change | None) -> str:
    """Law or parameter, and where."""
    if change is None:
        return ""
    return change.name + (f" at {change.location}" if change.location else "")


def right(found: dict) -> bool:
    """Whether kind and size are right."""
    if found["named"] != found["kind"]:
        return False
    if found["kind"] == "nothing":
        return True
    null = 1.0 if found["kind"] in ("actuator gain", "stiffness", "damping") and found["unit"] == "1" else 0.0
    off = found["found"][0] - found["size"]
    return abs(off) <= TOLERANCE[found["robot"]] * abs(found["size"] - null)


def main() -> None:
    """Run what is missing, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--only", nargs="*", default=["servo", "trunk", "accurate", "asl"])
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[Case, Path], tuple[Robot, Recording, Recording]]] = {
        "servo": servo, "trunk": trunk, "accurate": accurate, "asl": real,
    }  # fmt: skip
    for case in CASES:
        path = arguments.work / f"{case.robot}_{case.name}.json"
        if case.robot not in arguments.only or path.exists():
            continue
        with TemporaryDirectory() as folder:
            start = time.process_time()
            robot, before, after = makers[case.robot](case, arguments.data if case.robot == "asl" else Path(folder))
            found = compare([before], [after], robot)
            write_json(path, summary(case, found, time.process_time() - start))
        print(path, flush=True)
    found_of = [read_json(path) for path in sorted(arguments.work.glob("*.json"))]
    head = ("robot", "change", "true", "found [90 %]", "term", "probability", "right")
    print(table(head, [_row(each) for each in found_of]))
    if len(found_of) == len(CASES):
        write_json(RESULTS, read_json(RESULTS) | {"paired_changes": found_of})


def _row(found: dict) -> list[str]:
    """A row of the table."""
    size = "{:.3g} [{:.3g}, {:.3g}]".format(*found["found"]) if found["found"] else ""
    true = f"{found['kind']}, {found['size']:g}"
    chance, answer = f"{found['probability']:.2f}", "yes" if right(found) else "no"
    return [found["robot"], found["case"], true, f"{size} {found['unit']}", found["term"], chance, answer]


if __name__ == "__main__":
    main()
