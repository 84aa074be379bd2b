"""Active diagnosis: how many recordings settle the answer, asked for or all of one kind?

    python benchmarks/active_diagnosis.py --out FOLDER [--seeds 3]

The robot is the arm of the tests with a hidden effect. Its first recording is short: a slow sine, or small steps. Each
further one is what the diagnosis asks for, or 10 s of the excitation that any robot may get, with other random phases.
Settled is an answer beside which no other has a probability of 0.05; right is its name. One JSON file for each case;
the same command goes on with what is missing. Prints a table and writes docs/results/measured.json.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.active import Round, diagnose_actively
from soro_bench.diagnosis.result_parts import NextRecording
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP, SIGMA, TRUTH

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
MOST = 3  # further recordings
STEP, DURATION = 0.02, 10.0  # s
HINGE, MOTOR, BODY = Location("joint", "hinge"), Location("actuator", "motor"), Location("body", "arm")
HIDDEN = {
    "delay": Effect("actuator_delay", MOTOR, {"delay": 0.03}),
    "lag": Effect("actuator_lag", MOTOR, {"time_constant": 0.03}),
    "dry friction": Effect("coulomb_friction", HINGE, {"friction": 0.02}),
    "viscous friction": Effect("viscous_friction", HINGE, {"damping": 0.03}),
    "payload": Effect("payload", BODY, {"mass": 0.02}),
    "play": Effect("backlash", HINGE, {"width": 0.01}),
}
FIRST: dict[str, Callable[[np.random.Generator], Floats]] = {
    "slow sine": lambda rng: 0.4 * np.sin(0.4 * np.pi * STEP * np.arange(150) + rng.uniform(0.0, 6.0))[:, None],
    "small steps": lambda rng: np.repeat(rng.uniform(-0.1, 0.1, 3), 25)[:, None],
}
ACTIVE, FIXED = "asked for", "excitation"


def recorded(robot: ModelRobot, hidden: Effect, goals: Floats, rng: np.random.Generator) -> Recording:
    """What the arm does."""
    start = np.full((1, 1), 0.2)
    (values,) = robot.simulate(goals, TRUTH, [[hidden]], start)
    angle = np.concatenate([start[None], values])[:, 0, 0]
    times = STEP * np.arange(len(angle))
    noisy = angle + SIGMA * rng.standard_normal(len(angle))
    return Recording({"goal": Signal(times[:-1], goals)}, {"angle": Signal(times, noisy, "rad")})


def rounds(folder: Path, effect: Effect, first: str, how: str, seed: int) -> tuple[Round, ...]:
    """Diagnoses of an arm until its answer is settled."""
    paths = folder / "arm.xml", folder / "arm.toml"
    limited = ARM.replace('name="motor"', 'name="motor" ctrlrange="-0.6 0.6"')
    for path, text in zip(paths, (limited, MAP), strict=True):
        path.write_text(text)
    rng = np.random.default_rng(seed)
    real, simulated = ModelRobot(*paths, threads=1, shorter=2), ModelRobot(*paths, threads=1)

    def source(wanted: NextRecording, number: int) -> Recording:
        goals = np.array(wanted.actions) if how == ACTIVE else simulated.excited(None, DURATION, 100 * seed + number)
        return recorded(real, effect, goals, rng)

    begun = recorded(real, effect, FIRST[first](rng), rng)
    return diagnose_actively(simulated, [begun], source, MOST, seed=seed)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found = []
    for seed in range(options.seeds):
        for hidden, effect in HIDDEN.items():
            for first in FIRST:
                for how in (ACTIVE, FIXED):
                    path = options.out / f"{hidden}_{first}_{how}_{seed}.json".replace(" ", "_")
                    if not path.exists():
                        with tempfile.TemporaryDirectory() as folder:
                            made = rounds(Path(folder), effect, first, how, seed)
                        case = {"hidden": hidden, "first": first, "how": how, "seed": seed, "right": effect.name}
                        write_json(path, case | {"rounds": [asdict(each) for each in made]})
                    found.append(read_json(path))
                    print(
                        path.stem, [(r["answer"], round(r["probability"], 2)) for r in found[-1]["rounds"]], flush=True
                    )
    rows = []
    for how in (ACTIVE, FIXED):
        cases = [case for case in found if case["how"] == how]
        open_at_first = [case for case in cases if case["rounds"][0]["proposed"]]
        last = [case["rounds"][-1] for case in open_at_first]
        right = sum(each["answer"] == case["right"] for each, case in zip(last, open_at_first, strict=True))
        more = [len(case["rounds"]) - 1 for case in open_at_first]
        settled = sum(each["probability"] > 0.95 for each in last)
        rows.append((how, len(open_at_first), f"{np.mean(more):.2f}", settled, right))
    print(table(("further recordings are", "cases open at first", "recordings, mean", "settled", "right"), rows))
    write_json(RESULTS, read_json(RESULTS) | {"active_diagnosis": found})


if __name__ == "__main__":
    main()
