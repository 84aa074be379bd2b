"""Healthy robots read by degraded sensors: what is called physics, and whether the degradation is named.

    python benchmarks/degraded_sensors.py --out FOLDER [--models FOLDER] [--robots arm trunk] [--seeds 2]

The robots are the arm of the tests, the servo of the real studies, the trunk, and six public models, which lie in the
FOLDER of --models (see public_models.py). Each has other parameters than its model, within their priors, and a shorter
time step; nothing is hidden in it. Writes one JSON file per case into the folder, and goes on where it was stopped.
Prints a table; with all robots and sensors it writes docs/results/measured.json.
"""

import argparse
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.hidden_effects import CONTROL, DEVIATION, commands, hidden_robot, mapping, recorded
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.model_file import load_model
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import ARM, MAP, TRUTH

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "measured.json"
NOISE = 5e-4  # of the widest motion of a coordinate
DURATION = 6.0  # s, of recordings
TRUNK_STEPS = 80  # control steps
PHYSICS = "discrepancy", "outside_catalogue"  # verdicts
ALIKE = {"unmoved", "unanswered_command"}  # where a joint moves nothing else, both look the same
STILL = "although commands move"  # in the sentence of a signal that does not
SAID = {"constant_command"}  # a healthy recording may have it
PUBLIC = (
    "dm_control/suite/reacher",
    "dm_control/suite/finger",
    "dm_control/suite/pendulum",
    "gymnasium/envs/mujoco/assets/swimmer",
    "dm_control/suite/cartpole",
    "dm_control/suite/point_mass",
)


@dataclass(frozen=True)
class Log:
    """Times (T,) [s] and values (T, P, D) of a signal. step: s, of the control; reach: of its widest coordinate."""

    time: np.ndarray
    values: np.ndarray
    step: float
    reach: float

    @property
    def widest(self) -> int:
        """The point that moves most."""
        return int(np.ptp(self.values, axis=0).max(axis=1).argmax())


Sensor = Callable[[np.random.Generator, Log], Log]


def _levels(number: float) -> Sensor:
    """Rounded to this many levels in the widest motion."""
    return lambda rng, log: replace(log, values=np.round(log.values * number / log.reach) * log.reach / number)


def _changed(share: float, change: Callable[[np.random.Generator, np.ndarray, Log], np.ndarray]) -> Sensor:
    def read(rng: np.random.Generator, log: Log) -> Log:
        """Change a share of the points, not the first ones."""
        found, at = log.values.copy(), rng.random(log.values.shape[:2]) < share
        at[:2] = False
        found[at] = change(rng, log.values[at], log)
        return replace(log, values=found)

    return read


def _off(rng: np.random.Generator, points: np.ndarray, log: Log) -> np.ndarray:
    """Points far from where they are, in any direction."""
    way = rng.standard_normal(points.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return points + way * log.reach * rng.uniform(0.3, 1.0, (len(points), 1))


def _held(rows: float) -> Sensor:
    """A sensor whose period is so many rows of its logger, which repeats what it has."""

    def read(rng: np.random.Generator, log: Log) -> Log:
        row = np.arange(len(log.time))
        fresh = np.maximum(np.floor((row - 0.3) / rows) * rows + 0.3, 0.0)  # no row is at the time of a sample
        return replace(log, values=CubicSpline(row, log.values)(fresh))

    return read


def _frozen(rng: np.random.Generator, log: Log) -> Log:
    """One point stands still for a dozen samples, three times."""
    found, point = log.values.copy(), log.widest
    for at in rng.integers(len(found) // 10, len(found) - 30, 3):
        found[at : at + 12, point] = found[at, point]
    return replace(log, values=found)


def _clipped(rng: np.random.Generator, log: Log) -> Log:
    """The coordinate that moves most ends at four fifths of its motion."""
    flat = log.values.reshape(len(log.values), -1).copy()
    at = np.ptp(flat, axis=0).argmax()
    flat[:, at] = np.minimum(flat[:, at], flat[:, at].min() + 0.8 * np.ptp(flat[:, at]))
    return replace(log, values=flat.reshape(log.values.shape))


def _wrapped(rng: np.random.Generator, log: Log) -> Log:
    """An angle that begins again after a turn, as it does between the least and the largest one."""
    middle = 0.5 * (log.values.min(axis=0) + log.values.max(axis=0))
    return replace(log, values=np.mod(log.values - middle, 2 * np.pi) + middle)


def _bursts(share: float) -> Sensor:
    def read(rng: np.random.Generator, log: Log) -> Log:
        """Some samples are received late, and those after them not before."""
        count = len(log.time)
        late = np.where(rng.random(count) < share, log.step * rng.uniform(0.5, 3.0, count), 0.0)
        late[0] = 0.0
        return replace(log, time=np.maximum.accumulate(log.time + late) + 1e-7 * np.arange(count))

    return read


def _coarse(share: float) -> Sensor:
    def read(rng: np.random.Generator, log: Log) -> Log:
        """A clock that rounds down to a share of the control step."""
        rounded = np.floor(log.time / (share * log.step) + 1e-9) * share * log.step
        kept = np.r_[True, np.diff(rounded) > 0]
        return replace(log, time=rounded[kept], values=log.values[kept])

    return read


def _jitter(rng: np.random.Generator, log: Log) -> Log:
    return replace(log, time=log.time + np.r_[0, rng.uniform(0, 0.4 * log.step, len(log.time) - 1)])


def _set_clock(rng: np.random.Generator, log: Log) -> Log:
    """A clock that is set while the robot moves."""
    middle = len(log.time) // 2
    return replace(log, time=log.time + np.where(np.arange(len(log.time)) > middle, 7.3 * log.step, 0.0))


def _lost(share: float) -> Sensor:
    def read(rng: np.random.Generator, log: Log) -> Log:
        """Rows that are not in the log."""
        kept = rng.random(len(log.time)) > share
        kept[0] = True
        return replace(log, time=log.time[kept], values=log.values[kept])

    return read


def _dropouts(rng: np.random.Generator, log: Log) -> Log:
    """Nothing for twelve samples, four times."""
    kept = np.ones(len(log.time), bool)
    for at in rng.integers(5, len(log.time) - 20, 4):
        kept[at : at + 12] = False
    return replace(log, time=log.time[kept], values=log.values[kept])


def _dead(noise: float) -> Sensor:
    def read(rng: np.random.Generator, log: Log) -> Log:
        """The point that moves most stays where it begins."""
        found, point = log.values.copy(), log.widest
        found[:, point] = found[0, point] + noise * log.reach * rng.standard_normal(found[:, point].shape)
        return replace(log, values=found)

    return read


SENSORS: dict[str, tuple[str, Sensor]] = {
    "clean": ("", lambda rng, log: log),
    "150 levels": ("quantisation", _levels(150)),
    "1000 levels": ("quantisation", _levels(1000)),
    "1 % spikes": ("spikes", _changed(0.01, _off)),
    "4 % zeros": ("placeholders", _changed(0.04, lambda rng, points, log: 0.0 * points)),
    "15 % missing": ("missing_samples", _changed(0.15, lambda rng, points, log: np.nan * points)),
    "10 % lost": ("missing_samples", _lost(0.1)),
    "dropouts": ("missing_samples", _dropouts),
    "held 1.5": ("held", _held(1.5)),
    "held 3": ("held", _held(3)),
    "held 1.27": ("held", _held(1.27)),
    "frozen": ("frozen", _frozen),
    "clipped": ("clipping", _clipped),
    "wrapped": ("wrap", _wrapped),
    "25 % late": ("bursts", _bursts(0.25)),
    "coarse clock": ("coarse_clock", _coarse(0.35)),
    "jitter": ("jitter", _jitter),
    "set clock": ("clock_step", _set_clock),
    "dead": ("unmoved", _dead(0.0)),
    "dead, noisy": ("unmoved", _dead(NOISE)),
    "lost command": ("unanswered_command", lambda rng, log: log),
}


@dataclass(frozen=True)
class Subject:
    """A robot to diagnose, and exact recordings of one with other parameters.

    record: of random motion; one command does not reach its actuator if the second argument says so.
    """

    robot: Robot
    record: Callable[[np.random.Generator, bool], Recording]

    def can(self, sensor: str) -> bool:
        """Whether its recordings can be read by a sensor."""
        return sensor != "wrapped" or self.robot.unit == "rad"


def _recording(robot: Robot, actions: dict[str, np.ndarray], values: np.ndarray, **metadata: str) -> Recording:
    """Of commands (T, A), and a signal (T + 1, P, D) from before the first control step on."""
    time = robot.control_timestep * np.arange(len(values))
    sent = {name: Signal(time[:-1], rows) for name, rows in actions.items()}
    return Recording(sent, {robot.signal: Signal(time, values, robot.unit, robot.frame)}, metadata=metadata)


def _goals(rng: np.random.Generator, reach: float, step: float, many: int) -> np.ndarray:
    """(T, 1) set points that jump."""
    each = round(0.3 / step)
    return np.repeat(rng.uniform(-reach, reach, -(-many // each)), each)[:many, None]


def _arrived(sent: np.ndarray, lost: bool) -> np.ndarray:
    """(T, A) commands that reach the actuators; all but the first of the first channel may be lost."""
    arrived = sent.copy()
    arrived[:, 0] = sent[0, 0] if lost else sent[:, 0]
    return arrived


def _drawn(rng: np.random.Generator, robot: Robot, deviation: float) -> np.ndarray:
    """(1, d) parameters whose logarithms are off by so much at most; those without one stay."""
    factors = np.exp(deviation * rng.uniform(-1, 1, len(robot.priors)))
    return np.array([[p.nominal * (f if p.logarithmic else 1.0) for p, f in zip(robot.priors, factors, strict=True)]])


def arm(folder: Path) -> Subject:
    paths = folder / "arm.xml", folder / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    finer = ModelRobot(*paths, threads=1, shorter=2)

    def record(rng: np.random.Generator, lost: bool) -> Recording:
        goals, start = _goals(rng, 0.6, CONTROL, round(DURATION / CONTROL)), np.full((1, 1), 0.2)
        (values,) = finer.simulate(_arrived(goals, lost), TRUTH, [()], start)
        return _recording(finer, {"goal": goals}, np.concatenate([start[None], values]))

    return Subject(ModelRobot(*paths, threads=1), record)


def servo(folder: Path) -> Subject:
    """The bench of the real studies, healthy."""
    model, mapped = (ROOT / "assets" / "mjcf" / "real" / f"bam_servo.{kind}" for kind in ("xml", "toml"))
    finer = ModelRobot(model, mapped, threads=1, shorter=2)

    def record(rng: np.random.Generator, lost: bool) -> Recording:
        many = round(DURATION / finer.control_timestep)
        goals, start, on = 0.5 * _goals(rng, 2.0, 0.005, many), np.zeros((1, 1)), np.ones((many, 1))
        parameters = _drawn(rng, finer, DEVIATION)
        controls = np.column_stack([_arrived(goals, lost), np.zeros(many)])
        (values,) = finer.simulate(controls, parameters, [()], start, settings=np.ones((many, 2)))
        sent = {"goal": goals, "enabled": on}
        return _recording(finer, sent, np.concatenate([start[None], values]), firmware_gain="200")

    return Subject(ModelRobot(model, mapped, threads=1), record)


def trunk(folder: Path) -> Subject:
    finer = SuiteRobot("TrunkReach-v0", threads=1, shorter=2)

    def record(rng: np.random.Generator, lost: bool) -> Recording:
        number = np.arange(TRUNK_STEPS)[:, None, None]
        rates, phases = rng.uniform(0.01, 0.06, (3, 8)), rng.uniform(size=(3, 8))
        actions = np.sin(2 * np.pi * (rates * number + phases)).mean(axis=1)
        arrived = _arrived(np.concatenate([0.0 * actions[:1], actions]), lost)[1:]
        parameters = _drawn(rng, finer, 0.5 * DEVIATION)
        (values,) = finer.simulate(arrived, parameters, [()])
        (start,) = finer.simulate(0.0 * arrived[:1], parameters, [()])
        metadata = {"env_id": finer.env_id, "action": "continuous"}
        return _recording(finer, {"action": actions}, np.concatenate([start, values]), **metadata)

    return Subject(SuiteRobot("TrunkReach-v0", threads=1), record)


def public(folder: Path, path: Path) -> Subject:
    """A public model, simulated by MuJoCo alone."""
    model = load_model(path)
    unit = "rad" if (model.jnt_type == 3).all() else "1"  # of hinges only, or not
    mapped = folder / f"{path.stem}.toml"
    mapped.write_text(mapping(model, model.opt.timestep, unit))
    robot = ModelRobot(path, mapped, threads=1)

    def record(rng: np.random.Generator, lost: bool) -> Recording:
        factors = dict(zip(("mass", "damping"), np.exp(DEVIATION * rng.uniform(-1, 1, 2)), strict=True))
        controls = commands(model, rng, round(DURATION / CONTROL))
        values = recorded(*hidden_robot(path, None, factors), _arrived(controls, lost))
        return _recording(robot, {"all": controls}, values[:, :, None])

    return Subject(robot, record)


def subjects(folder: Path, models: Path | None) -> dict[str, Callable[[], Subject]]:
    """Robots by name, built when they are needed."""
    found: dict[str, Callable[[], Subject]] = {each.__name__: partial(each, folder) for each in (arm, servo, trunk)}
    for name in PUBLIC if models else ():
        found[name.split("/")[-1]] = partial(public, folder, Path(models or "") / f"{name}.xml")
    return found


def degraded(subject: Subject, sensor: str, rng: np.random.Generator) -> Recording:
    """A recording of a healthy robot, as a sensor reads it."""
    whole = subject.record(rng, sensor == "lost command")
    robot = subject.robot
    signal = whole.signals[robot.signal]
    reach = float(np.ptp(signal.values, axis=0).max())
    noisy = signal.values + NOISE * reach * rng.standard_normal(signal.values.shape)
    log = SENSORS[sensor][1](rng, Log(signal.time, noisy.reshape(-1, *robot.shape), robot.control_timestep, reach))
    read = replace(signal, time=log.time, values=log.values)
    return replace(whole, signals={**whole.signals, robot.signal: read})


def case(name: str, subject: Subject, sensor: str, seed: int) -> dict:
    """What a diagnosis says of one recording."""
    rng = np.random.default_rng([seed, zlib.crc32(f"{name} {sensor}".encode())])
    expected = SENSORS[sensor][0]
    try:
        result = diagnose(subject.robot, [degraded(subject, sensor, rng)])
        verdict, found = result.verdict, [each.name for each in result.data if each.name not in SAID]
        effects, seconds = [f.name for f in result.findings[:2]] if verdict in PHYSICS else [], result.seconds
    except RecordingError as error:  # nothing is left
        verdict, effects, seconds = f"refused: {error}", [], 0.0
        found = ["unmoved"] if STILL in str(error) else []
    if expected in ALIKE and ALIKE & set(found):
        expected = (ALIKE & set(found)).pop()
    return {"robot": name, "sensor": sensor, "seed": seed, "verdict": verdict, "data": found, "effects": effects,
            "physics": verdict in PHYSICS, "named": expected in found if expected else not found,
            "others": [each for each in found if each != expected], "seconds": round(seconds, 1)}  # fmt: skip


def main() -> None:
    """Run the cases that are missing, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--robots", nargs="+")
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=list(SENSORS))
    parser.add_argument("--seeds", type=int, default=2, help="of the arm; the others have one")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = []
    known = subjects(options.out, options.models)
    for name in options.robots or known:
        subject = known[name]()
        for seed in range(options.seeds if name == "arm" else 1):
            for sensor in filter(subject.can, options.sensors):
                record = options.out / f"{name}_{sensor.replace(' ', '_')}_{seed}.json"
                if not record.exists():
                    write_json(record, case(name, subject, sensor, seed))
                found.append(one := read_json(record))
                print(f"{name:14} {sensor:14} {seed} {one['verdict'][:70]:18} {', '.join(one['data'])} "
                      f"{'' if one['named'] and not one['physics'] else '<<<'} {', '.join(one['effects'])} "
                      f"{one['seconds']} s", flush=True)  # fmt: skip
    print(summary(found))
    if options.models and not options.robots and options.sensors == list(SENSORS):
        write_json(RESULTS, read_json(RESULTS) | {"degraded_sensors": found})


def summary(found: list[dict]) -> str:
    """Markdown: by sensor, in how many recordings it was named, and in how many there was physics."""
    rows = []
    for sensor, (expected, _) in SENSORS.items():
        of = [each for each in found if each["sensor"] == sensor]
        wrong = Counter(each["robot"] for each in of if each["physics"] or not each["named"])
        if of:
            rows.append((sensor, expected or "nothing", str(len(of)), str(sum(each["named"] for each in of)),
                         str(sum(each["physics"] for each in of)), ", ".join(wrong)))  # fmt: skip
    named, physics = (sum(each[key] for each in found) for key in ("named", "physics"))
    names = ("sensor", "to be named", "recordings", "named", "physics", "wrong with")
    robots = len({each["robot"] for each in found})
    return f"{table(names, rows)}\n\n{len(found)} recordings of {robots} robots: {named} named, {physics} with physics"


if __name__ == "__main__":
    main()
