"""Speed of MultiGait: what an environment step costs on each mesh.

    python benchmarks/multigait_speed.py [--repeats 5]

Episodes of random discrete actions, meshes in turn, so that a machine whose speed drifts affects all alike. Prints
medians: CPU-seconds per simulated second, environment steps per CPU-second, the ratio to the coarse mesh, and the rate
of the whole machine (all processors) as a multiple of the published training's 0.83 steps per second.
"""

import argparse
import time

import numpy as np

from soro_bench.envs.multigait import MultiGaitTask
from soro_bench.markdown import table
from soro_bench.models.walker_mesh import RESOLUTIONS

PUBLISHED_RATE = 0.83  # environment steps per second: 500,000 steps in 7 days on 24 threads (Tiboni et al., 2023)
NUM_ENVS = {"coarse": 16, "fine": 4, "finest": 2}
STEPS = 6


def episode(task, rng, clock) -> float:
    """Seconds per environment step."""
    ids = np.arange(task.num_envs)
    task.reset(ids, [np.random.default_rng(i) for i in ids], [{}] * len(ids))
    start = clock()
    for _ in range(STEPS):
        task.step(ids, rng.integers(6, size=len(ids)))
    return (clock() - start) / (STEPS * len(ids))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    one = {mesh: MultiGaitTask(NUM_ENVS[mesh], 1, mesh=mesh) for mesh in RESOLUTIONS}
    everything = MultiGaitTask(NUM_ENVS["coarse"], 0, mesh="coarse")
    cpu, wall = {mesh: [] for mesh in RESOLUTIONS}, []
    for repeat in range(options.repeats):
        for mesh, task in one.items():
            cpu[mesh].append(episode(task, np.random.default_rng(repeat), time.process_time))
        wall.append(episode(everything, np.random.default_rng(repeat), time.perf_counter))
    rows = []
    for mesh, task in one.items():
        seconds = np.median(cpu[mesh])
        ratio = np.median(np.array(cpu[mesh]) / np.array(cpu["coarse"]))
        cost = seconds / task.control_timestep
        rows.append((mesh, task.model.nv, f"{cost:.3f}", f"{1 / seconds:.1f}", f"{ratio:.1f}"))
    heads = "mesh", "degrees of freedom", "CPU-s per simulated s", "env steps per CPU-s", "cost / coarse"
    print(table(heads, rows))
    rate = 1 / np.median(wall)
    print(f"\nwhole machine, coarse: {rate:.1f} env steps/s, {rate / PUBLISHED_RATE:.0f} times the published rate")


if __name__ == "__main__":
    main()
