"""Every robot of the suite with two hidden effects: is each one named, and what does the diagnosis cost?

    python benchmarks/whole_suite.py --out FOLDER [--envs TrunkPush-v0 ...]
    python docs/generate.py

Writes one JSON file per environment into the folder, with the result beside it, and goes on where it was stopped; with
all of them it writes docs/results/measured.json. The effects were chosen before any of these diagnoses ran. The robot
to diagnose has the model and the parameters of the hidden one, so this tests objects, contacts and cost, not model
error.
"""

import argparse
import resource
import time
from pathlib import Path

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.simulated import record

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
NOISE = 5e-4  # m
GAIN = Effect("actuator_gain", Location("actuator", "L1"), {"gain": 0.8})
HIDDEN = {
    "TrunkReach-v0": (GAIN, Effect("coulomb_friction", Location("tendon", "S2"), {"friction": 1.0})),
    "TrunkPush-v0": (GAIN, Effect("payload", Location("body", "object"), {"mass": 0.1})),
    "TrunkLift-v0": (GAIN, Effect("payload", Location("body", "vertebra7"), {"mass": 0.03})),
    "MultiGait-v0": (
        Effect("actuator_gain", Location("actuator", "centre"), {"gain": 0.8}),
        Effect("pressure_leak", Location("actuator", "front_left"), {"rate": 0.2}),
    ),
}
STEPS = {"MultiGait-v0": (216, 216)}  # control steps of the recording to explain and of the held-out one; the fewest
TRUNK_STEPS = (400, 400)
# A mass on a body whose mass is a parameter moves as one that the parameter has: either name is right.
SAME = {("TrunkPush-v0", "payload"): "cube_mass"}
LEAST_MOVED = 2.0  # prior standard deviations, from which a parameter counts as named


def case(env_id: str, out: Path) -> dict:
    """What a diagnosis of an environment says of its two effects."""
    model = SuiteRobot(env_id, threads=1).model_name
    recordings = [
        record(env_id, "excitation", model=model, seed=seed, steps=steps, noise=NOISE, effects=HIDDEN[env_id])
        for seed, steps in enumerate(STEPS.get(env_id, TRUNK_STEPS), 1)
    ]
    wall, processor = time.perf_counter(), time.process_time()
    result = diagnose(SuiteRobot(env_id), recordings[:1], recordings[1:], progress=print)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    result.save(out / f"{env_id}_result.json")
    found = {each.name: each for each in result.best.effects}
    return {
        "env": env_id,
        "model": model,
        "verdict": result.verdict,
        "effects": [_named(env_id, effect, result) for effect in HIDDEN[env_id]],
        "others": sorted(found.keys() - {effect.name for effect in HIDDEN[env_id]}),
        "seconds": round(wall),
        "processor_seconds": round(processor),
        "memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2),
    }


def _named(env_id: str, effect: Effect, result: Result) -> dict:
    """Whether a result names an effect at its location, or the parameter that is the same."""
    names = [each for each in result.best.effects if each.name == effect.name]
    parameter = SAME.get((env_id, effect.name))
    moved = [
        each
        for each in result.parameters
        if each.estimate.name == parameter and abs(each.prior_deviations) >= LEAST_MOVED
    ]
    return {
        "name": effect.name,
        "location": str(effect.location),
        "named": bool(names or moved),
        "located": any(each.location == effect.location for each in names) or bool(moved),
        "as": parameter if moved and not names else effect.name if names else None,
    }


def main() -> None:
    """Diagnose the environments that are missing, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--envs", nargs="+", choices=HIDDEN, default=list(HIDDEN))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for env_id in options.envs:
        if not (path := options.out / f"{env_id}.json").exists():
            write_json(path, case(env_id, options.out))
    found = [read_json(path) for name in HIDDEN if (path := options.out / f"{name}.json").exists()]
    head = ("environment", "hidden", "named", "located", "others named", "s", "CPU-s", "GB")
    print(table(head, [row for each in found for row in _rows(each)]))
    if len(found) == len(HIDDEN):
        write_json(RESULTS, read_json(RESULTS) | {"whole_suite": found})


def _rows(found: dict) -> list[tuple[str, ...]]:
    """A row for each effect."""
    cost = [f"{found[key]}" for key in ("seconds", "processor_seconds", "memory_gb")]
    return [
        (found["env"], f"{each['name']} at {each['location']}", str(each["as"]), "yes" if each["located"] else "no",
         ", ".join(found["others"]) or "none", *cost)
        for each in found["effects"]
    ]  # fmt: skip


if __name__ == "__main__":
    main()
