"""What every effect costs on a trunk, as a ratio to the simulation without effects, in the same run.

python benchmarks/effects_cost.py [--model cable] [--repeats 5]
"""

import argparse
import time

import numpy as np

from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.markdown import header, row
from soro_bench.registration import make_task

SIMULATIONS, STEPS = 32, 60


def seconds(task, effects, actions) -> float:
    """CPU-seconds per simulated second."""
    ids = np.arange(SIMULATIONS)
    task.sim.assign_effects([effects] * SIMULATIONS)
    task.reset(ids, [np.random.default_rng(0)] * SIMULATIONS, [{}] * SIMULATIONS)
    start = time.process_time()
    for action in actions:
        task.step(ids, np.repeat(action[None], SIMULATIONS, axis=0))
    return (time.process_time() - start) / (SIMULATIONS * STEPS * task.control_timestep)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="cable")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    robot = SuiteRobot("TrunkReach-v0", options.model, threads=1)
    task = make_task("TrunkReach-v0", SIMULATIONS, 1, options.model, action="continuous", effects=())
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (STEPS // 5, 8)), 5, axis=0).astype(np.float32)
    first = {one.name: one for one in reversed(terms(robot)) if one.location.kind != "sensor"}
    timestep = task.model.opt.timestep
    print(header(("effect", "place", "cost / without", "more [us per time step]")))
    for name in sorted(first):
        effect = typical(first[name])
        pairs = [(seconds(task, (effect,), actions), seconds(task, (), actions)) for _ in range(options.repeats)]
        ratio, more = np.median([(a / b, 1e6 * timestep * (a - b)) for a, b in pairs], axis=0)
        print(row((name, effect.location, f"{ratio:.2f}", f"{more:.0f}")), flush=True)


if __name__ == "__main__":
    main()
