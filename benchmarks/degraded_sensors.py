"""A healthy arm read by degraded sensors: what is called physics, and whether the degradation is named.

    python benchmarks/degraded_sensors.py --out FOLDER [--seeds 3]

Writes one JSON file per case into the folder, goes on where it was stopped, and prints a table. The robot is the arm
of the tests, with other parameters than the model and half its time step; nothing is hidden in it.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.files import read_json, write_json
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP, TRUTH

STEP, NOISE = 0.02, 4e-4  # s; rad

Log = tuple[np.ndarray, np.ndarray]  # times [s] and angles [rad]


def _levels(number: float) -> Callable[[np.random.Generator, np.ndarray, np.ndarray], Log]:
    step = 2 * np.pi / number
    return lambda rng, time, x: (time, step * np.round(x / step))


def _changed(share: float, change: Callable[[np.random.Generator, np.ndarray], np.ndarray]):
    def read(rng: np.random.Generator, time: np.ndarray, x: np.ndarray) -> Log:
        """Change a share of the samples, not the first ones."""
        at, found = rng.random(len(x)) < share, x.copy()
        at[:2] = False
        found[at] = change(rng, x[at])
        return time, found

    return read


def _held(rows: int):
    return lambda rng, time, x: (time, x[np.arange(len(x)) // rows * rows])


def _frozen(rng: np.random.Generator, time: np.ndarray, x: np.ndarray) -> Log:
    found = x.copy()
    for at in rng.integers(30, len(x) - 30, 3):
        found[at : at + 12] = found[at]
    return time, found


def _bursts(share: float):
    def read(rng: np.random.Generator, time: np.ndarray, x: np.ndarray) -> Log:
        """Some samples are received late, and those after them not before."""
        late = np.where(rng.random(len(x)) < share, rng.uniform(0.01, 0.06, len(x)), 0.0)
        late[0] = 0.0
        return np.maximum.accumulate(time + late) + 1e-7 * np.arange(len(x)), x

    return read


def _coarse(tick: float):
    def read(rng: np.random.Generator, time: np.ndarray, x: np.ndarray) -> Log:
        """A clock that rounds down."""
        rounded = np.floor(time / tick + 1e-9) * tick
        kept = np.r_[True, np.diff(rounded) > 0]
        return rounded[kept], x[kept]

    return read


def _lost(share: float):
    def read(rng: np.random.Generator, time: np.ndarray, x: np.ndarray) -> Log:
        """Rows that are not in the log."""
        kept = rng.random(len(x)) > share
        kept[0] = True
        return time[kept], x[kept]

    return read


SENSORS = {
    "clean": ("", lambda rng, time, x: (time, x)),
    "1000 levels": ("quantisation", _levels(1000)),
    "2048 levels": ("quantisation", _levels(2048)),
    "8192 levels": ("quantisation", _levels(8192)),
    "1 % spikes": ("spikes", _changed(0.01, lambda rng, x: x + rng.choice([-1, 1], len(x)) * rng.uniform(0.3, 1.0))),
    "4 % zeros": ("placeholders", _changed(0.04, lambda rng, x: 0.0 * x)),
    "15 % missing": ("missing_samples", _changed(0.15, lambda rng, x: np.nan * x)),
    "10 % lost": ("missing_samples", _lost(0.1)),
    "held 2": ("held", _held(2)),
    "held 4": ("held", _held(4)),
    "frozen": ("frozen", _frozen),
    "clipped": ("clipping", lambda rng, time, x: (time, np.minimum(x, 0.35))),
    "20 % late": ("bursts", _bursts(0.2)),
    "30 % late": ("bursts", _bursts(0.3)),
    "clock of 7 ms": ("coarse_clock", _coarse(0.007)),
    "jitter of 8 ms": ("jitter", lambda rng, time, x: (time + np.r_[0, rng.uniform(0, 0.008, len(x) - 1)], x)),
}


def recording(paths: tuple[Path, Path], sensor: str, seed: int) -> Recording:
    """Of the healthy arm, read by a sensor."""
    rng = np.random.default_rng(seed)
    goals, start = np.repeat(rng.uniform(-0.6, 0.6, 20), 15)[:, None], np.full((1, 1), 0.2)
    (values,) = ModelRobot(*paths, threads=1, shorter=2).simulate(goals, TRUTH, [()], start)
    x = np.concatenate([start[None], values])[:, 0, 0]
    time, angle = SENSORS[sensor][1](rng, STEP * np.arange(len(x)), x + NOISE * rng.standard_normal(len(x)))
    return Recording({"goal": Signal(STEP * np.arange(len(goals)), goals)}, {"angle": Signal(time, angle, "rad")})


def case(paths: tuple[Path, Path], sensor: str, seed: int) -> dict:
    """What a diagnosis says of one recording."""
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, sensor, seed)])
    expected, names = SENSORS[sensor][0], [each.name for each in result.data]
    return {"robot": "arm", "sensor": sensor, "seed": seed, "verdict": result.verdict, "data": names,
            "physics": result.verdict in ("discrepancy", "outside_catalogue"),
            "named": expected in names if expected else not names}  # fmt: skip


def main() -> None:
    """Run the cases that are missing, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    paths = options.out / "arm.xml", options.out / "arm.toml"
    for path, text in zip(paths, (ARM, MAP), strict=True):
        path.write_text(text)
    found = []
    for seed in range(options.seeds):
        for sensor in SENSORS:
            record = options.out / f"{sensor.replace(' ', '_')}_{seed}.json"
            if not record.exists():
                write_json(record, case(paths, sensor, seed))
            found.append(read_json(record))
            print(f"{sensor:16} {seed} {found[-1]['verdict']:18} {', '.join(found[-1]['data'])}", flush=True)
    physics, named = (sum(each[key] for each in found) for key in ("physics", "named"))
    print(f"{len(found)} recordings: {physics} with physics of the robot, {named} named right")


if __name__ == "__main__":
    main()
