"""How fast PPO trains, and where its time goes.

    python benchmarks/training_speed.py [--env TrunkReach-v0] [--model cable] [--steps 64000]

Trains with one simulation thread and with two, in turn, and prints environment steps per second and per CPU-second, the
shares of the simulation (the environments' step), of the policy's actions and bookkeeping between steps, and of PPO's
update; the time of two million steps at that rate; and beside them a bare loop of mj_step over the same model, in the
same run.
"""

import argparse
import tempfile
import time
from collections import Counter
from contextlib import contextmanager

import mujoco
import numpy as np
from stable_baselines3 import PPO

from soro_bench.envs.sb3 import SB3VecEnv
from soro_bench.markdown import table
from soro_bench.registration import make_task, task_type
from soro_bench.training.ppo import default_config, train

PUBLISHED_STEPS = 2_000_000
BARE_STEPS = 2_000  # of the environment


@contextmanager
def timed(spent: Counter, owner: type, method: str):
    """Adds the seconds inside a method to ``spent``, by its name."""
    original = getattr(owner, method)

    def wrapper(*args, **kwargs):
        start = time.perf_counter()
        try:
            return original(*args, **kwargs)
        finally:
            spent[method] += time.perf_counter() - start

    setattr(owner, method, wrapper)
    try:
        yield
    finally:
        setattr(owner, method, original)


def bare_rate(env_id: str, model: str) -> float:
    """Environment steps per second of a loop of mj_step, random controls, on one thread."""
    task = make_task(env_id, 1, 1, model)
    simulated = task.sim.batch.get_model(0)
    substeps = round(task.control_timestep / simulated.opt.timestep)
    data, rng = mujoco.MjData(simulated), np.random.default_rng(0)
    start = time.perf_counter()
    for step in range(BARE_STEPS):
        if step % 100 == 0:  # an episode
            mujoco.mj_resetData(simulated, data)
        data.ctrl[:] = 0.1 * rng.uniform(-1, 1, simulated.nu)
        mujoco.mj_step(simulated, data, nstep=substeps)
    return BARE_STEPS / (time.perf_counter() - start)


def trained(env_id: str, model: str, steps: int, threads: int) -> dict:
    """Seconds of a training, and of its parts."""
    config, spent = default_config(env_id, steps, model=model, num_threads=threads), Counter()
    with tempfile.TemporaryDirectory() as folder, timed(spent, SB3VecEnv, "step_wait"), timed(spent, PPO, "train"):
        wall, cpu = time.perf_counter(), time.process_time()
        train(config, folder)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    done = config.num_segments * config.segment_steps
    simulation, update = spent["step_wait"] / wall, spent["train"] / wall
    return {"rate": done / wall, "cpu_rate": done / cpu, "simulation": simulation, "update": update,
            "rest": 1.0 - simulation - update}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="TrunkReach-v0")
    parser.add_argument("--model", help="the cheap one by default")
    parser.add_argument("--steps", type=int, default=64_000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    options.model = options.model or task_type(options.env).cheap
    measured = {threads: [] for threads in (1, 2)}
    bare = []
    for _ in range(options.repeats):
        bare.append(bare_rate(options.env, options.model))
        for threads, found in measured.items():
            found.append(trained(options.env, options.model, options.steps, threads))
    rows = []
    for threads, found in measured.items():
        m = {name: float(np.median([row[name] for row in found])) for name in found[0]}
        shares = (f"{m[name]:.0%}" for name in ("simulation", "rest", "update"))
        minutes = PUBLISHED_STEPS / m["rate"] / 60
        rows.append((threads, f"{m['rate']:.0f}", f"{m['cpu_rate']:.0f}", *shares, f"{minutes:.1f}"))
    heads = "threads", "env steps/s", "per CPU-s", "simulation", "actions, bookkeeping", "update", "2M steps [min]"
    print(table(heads, rows))
    print(f"bare loop of mj_step on one thread: {np.median(bare):.0f} env steps/s")


if __name__ == "__main__":
    main()
