"""Random actions over random parameters on MultiGait: does it become NaN, fly, tumble or sink?

    python benchmarks/multigait_random.py --episodes 1000

Parameters uniform in the search box, random actions, discrete and continuous in turn, 6 steps. Adds counts to
a file in --work after every batch and goes on from there. Whole, they are copied to docs/results/multigait_random.json.
Warnings are those of MuJoCo that are not of a bad state, as a state that is counts as diverged.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.envs.multigait import MultiGaitTask
from soro_bench.files import read_json, write_json
from soro_bench.models import walker
from soro_bench.randomization import search_box
from soro_bench.sources import SIMULATION, claim, version_of

NAME, RESULTS = "multigait_random.json", Path(__file__).parents[1] / "docs" / "results"
BATCH, STEPS = 50, 6


def run_batch(number: int, threads: int) -> dict:
    """Counts and extremes of one batch of episodes; ``number`` seeds it."""
    action = ("discrete", "continuous")[number % 2]
    task = MultiGaitTask(BATCH, threads, mesh="coarse", action=action)
    task.randomize(search_box(walker.PARAMETERS))
    floor = task.model.geom("floor").pos[2]
    ids, rng = np.arange(BATCH), np.random.default_rng(number)
    task.reset(ids, [np.random.default_rng([number, i]) for i in ids], [{}] * BATCH)
    rest = task.signals(ids)["vertices"]
    diverged = np.zeros(BATCH, bool)
    lowest, airborne, tilt = 0.0, 0.0, 0.0
    for _ in range(STEPS):
        actions = rng.integers(6, size=BATCH) if action == "discrete" else rng.uniform(-1, 1, (BATCH, 3))
        step = task.step(ids, actions)
        diverged |= step.diverged
        now = task.signals(ids)["vertices"]
        height = now[:, :, 2].min(axis=1) - floor
        lowest, airborne = min(lowest, height.min()), max(airborne, height.max())
        tilt = max(tilt, max(tilt_of(now[i], rest[i]) for i in ids))
    counts = task.sim.batch.warning[:, :, 1].sum(axis=0)
    silenced = int(mujoco.mjtWarning.mjWARN_INERTIA)
    return {
        "episodes": BATCH,
        "diverged": int(diverged.sum()),
        "warnings": int(counts.sum() - counts[silenced]),
        "lowest_vertex_mm": 1e3 * float(lowest),
        "highest_lowest_vertex_mm": 1e3 * float(airborne),
        "largest_tilt_deg": float(np.degrees(tilt)),
    }


def tilt_of(now, rest) -> float:
    """Angle [rad] by which the middle of the body leans, from the best rigid fit (Kabsch)."""
    middle = np.abs(rest[:, 0]) < 0.02  # m
    a, b = now[middle] - now[middle].mean(axis=0), rest[middle] - rest[middle].mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.arccos(np.clip(turn[2, 2], -1, 1)))


def merge(total: dict, batch: dict) -> dict:
    """Sums of counts, extremes of lengths and angles."""
    if not total:
        return batch
    combined = {key: total[key] + batch[key] for key in ("episodes", "diverged", "warnings")}
    combined["lowest_vertex_mm"] = min(total["lowest_vertex_mm"], batch["lowest_vertex_mm"])
    for key in ("highest_lowest_vertex_mm", "largest_tilt_deg"):
        combined[key] = max(total[key], batch[key])
    return combined


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/multigait_random"))
    options = parser.parse_args()
    claim(options.work / "sources.txt", version_of(SIMULATION))
    path = options.work / NAME
    total = read_json(path) if path.exists() else {}
    start, first = time.monotonic(), total.get("episodes", 0)
    while (done := total.get("episodes", 0)) < options.episodes:
        total = merge(total, run_batch(done // BATCH, options.threads))
        write_json(path, total)
        rate = (total["episodes"] - first) / (time.monotonic() - start)
        print(f"{total['episodes']} episodes, {(options.episodes - total['episodes']) / rate / 60:.0f} min left",
              end="\r", flush=True)  # fmt: skip
    write_json(RESULTS / NAME, total)
    print(f"\n{total}")


if __name__ == "__main__":
    main()
