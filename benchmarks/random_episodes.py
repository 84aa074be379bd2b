"""Random actions over random parameters: does anything become NaN, crash or explode?

    python benchmarks/random_episodes.py --model cable --episodes 3400
    python benchmarks/random_episodes.py --model flex --episodes 700

Runs that many episodes of every trunk task, with discrete and continuous actions in turn. Half of them have parameters
drawn uniformly from the published search box and uniformly random actions. The others have parameters at a corner of
that box, and actions that stay at a bound for five steps on average. Writes counts to --work after every batch; a run
that was interrupted goes on from there. Whole, they are copied to docs/results/measured.json. Warnings are those of
MuJoCo that are not of a bad state, as a state that is counts as diverged.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np

import soro_bench
from soro_bench.files import read_json, write_json
from soro_bench.randomization import search_box
from soro_bench.registration import make_task
from soro_bench.sources import SIMULATION, claim, version_of

TRUNK_IDS = [env_id for env_id in soro_bench.ENV_IDS if env_id.startswith("Trunk")]
BATCH = 50
STEPS = 100
CHANGED = 0.2  # probability that an action that stays at a bound changes, in each step
EXAMPLES = 5  # episodes that diverged whose parameters are kept, of each environment
RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
WARNINGS = [mujoco.mjtWarning(i).name for i in range(int(mujoco.mjtWarning.mjNWARNING))]


def run_batch(env_id: str, model: str, number: int, threads: int) -> dict:
    """Counts over one batch of episodes; ``number`` seeds it."""
    action, hard = ("discrete", "continuous")[number % 2], number // 2 % 2 == 1
    task = make_task(env_id, BATCH, threads, model, action=action)
    everyone = np.arange(BATCH)
    rng = np.random.default_rng([number, len(env_id)])
    task.randomize(search_box(task.randomized))
    corners = [{"params": {p.name: float(rng.choice(p.search)) for p in task.randomized} if hard else {}}
               for _ in everyone]  # fmt: skip
    observation, _ = task.reset(everyone, [np.random.default_rng([number, i]) for i in range(BATCH)], corners)
    diverged = np.zeros(BATCH, bool)
    low, high = task.single_observation_space.low, task.single_observation_space.high
    finite, inside, fastest, largest = True, True, 0.0, 0.0
    actions = np.zeros(BATCH, int) if action == "discrete" else np.zeros((BATCH, 8))
    for each in range(STEPS):
        drawn = rng.integers(16, size=BATCH) if action == "discrete" else rng.uniform(-1, 1, (BATCH, 8))
        drawn = np.sign(drawn) if hard and action == "continuous" else drawn
        changed = rng.random(BATCH) < (CHANGED if hard and each else 1.0)
        actions[changed] = drawn[changed]
        step = task.step(everyone, actions)
        finite &= bool(np.isfinite(step.observation).all() and np.isfinite(step.reward).all())
        sane, largest = ~step.diverged, max(largest, float(np.abs(step.reward).max()))
        inside &= bool(((step.observation[sane] >= low) & (step.observation[sane] <= high)).all())
        diverged |= step.diverged
        tip = step.observation[:, 60:63]
        moved = np.linalg.norm(tip - observation[:, 60:63], axis=1)
        fastest = max(fastest, float(moved[sane].max(initial=0.0)) / task.control_timestep)
        observation = step.observation
    counts = task.sim.batch.warning[:, :, 1].sum(axis=0)
    return {
        "episodes": BATCH,
        "diverged": int(diverged.sum()),
        "diverged_params": [task.parameters.to_dict(task.sim.params[i]) for i in np.flatnonzero(diverged)[:EXAMPLES]],
        "not_finite": int(not finite),
        "outside_space": int(not inside),
        "fastest_tip_m_per_s": fastest,
        "largest_reward": largest,
        "warnings": {name: int(count) for name, count in zip(WARNINGS, counts, strict=True) if count},
    }


def merge(total: dict, batch: dict) -> dict:
    """Sum of two counts."""
    if not total:
        return batch
    merged = {key: total[key] + batch[key] for key in total if isinstance(total[key], int | list)}
    merged |= {key: max(total[key], batch[key]) for key in ("fastest_tip_m_per_s", "largest_reward")}
    merged["diverged_params"] = merged["diverged_params"][:EXAMPLES]
    names = sorted({*total["warnings"], *batch["warnings"]})
    merged["warnings"] = {name: total["warnings"].get(name, 0) + batch["warnings"].get(name, 0) for name in names}
    return merged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=("cable", "flex"), default="cable")
    parser.add_argument("--episodes", type=int, default=3400, help="per task")
    parser.add_argument("--only", nargs="+", choices=TRUNK_IDS, default=TRUNK_IDS, help="environments")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=Path("runs/random_episodes"))
    options = parser.parse_args()
    claim(options.work / "sources.txt", version_of(SIMULATION))
    path = options.work / f"random_episodes_{options.model}.json"
    totals = read_json(path) if path.exists() else {}
    start, done_now = time.monotonic(), 0
    for env_id in options.only:
        done = totals.get(env_id, {}).get("episodes", 0)
        for number in range(done // BATCH, -(-options.episodes // BATCH)):
            totals[env_id] = merge(totals.get(env_id, {}), run_batch(env_id, options.model, number, options.threads))
            write_json(path, totals)
            done_now += BATCH
            left = sum(max(0, options.episodes - totals.get(e, {}).get("episodes", 0)) for e in options.only)
            minutes = (time.monotonic() - start) / done_now * left / 60
            print(f"{env_id} {totals[env_id]['episodes']} episodes, {minutes:.0f} min left", end="\r", flush=True)
    print()
    every = read_json(RESULTS)
    every["random_episodes"][options.model] |= totals
    write_json(RESULTS, every)
    for env_id, counts in totals.items():
        print(env_id, {key: value for key, value in counts.items() if key != "diverged_params"})


if __name__ == "__main__":
    main()
