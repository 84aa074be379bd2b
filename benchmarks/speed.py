"""Speed of the trunk environments, as ratios measured in one run.

    python benchmarks/speed.py [--repeats 15]

Prints, for every environment and model: environment steps per CPU-second of the vector environment on one thread, its
rate as a share of a bare mj_step loop over the same model (same controls, no observations, rewards or resets), the
wall-clock gain of two threads over one, and the time to give one simulation new parameters. Every figure is the median
of measurements taken in turn, so that a machine whose speed drifts affects both sides of a ratio alike.
"""

import argparse
import time

import gymnasium
import mujoco
import numpy as np

import soro_bench
from soro_bench.markdown import header, row
from soro_bench.models import trunk_geometry as geo
from soro_bench.registration import task_type

NUM_ENVS = 16
TRUNK_IDS = [env_id for env_id in soro_bench.ENV_IDS if env_id.startswith("Trunk")]


def bare_loop(task, controls):
    """CPU-seconds of a plain loop of mj_step over NUM_ENVS MjData, per environment step."""
    model = task.sim.batch.get_model(0)
    substeps = round(task.control_timestep / model.opt.timestep)
    datas = [mujoco.MjData(model) for _ in range(NUM_ENVS)]

    def run():
        start = time.process_time()
        for control in controls:
            for data, u in zip(datas, control, strict=True):
                data.ctrl[:] = u
                mujoco.mj_step(model, data, nstep=substeps)
        return (time.process_time() - start) / (len(controls) * NUM_ENVS)

    def reset():
        for data in datas:
            mujoco.mj_resetData(model, data)

    return run, reset


def vector_env(env_id, model, threads, actions, clock):
    """Seconds by ``clock`` of the vector environment, per environment step."""
    envs = gymnasium.make_vec(env_id, num_envs=NUM_ENVS, num_threads=threads, model=model, action="continuous")
    envs.reset(seed=0)

    def run():
        start = clock()
        for action in actions:
            envs.step(action)
        return (clock() - start) / (len(actions) * NUM_ENVS)

    return run, lambda: envs.reset(seed=0)


def parameter_reset(env_id, model):
    """Seconds to give one simulation new parameters."""
    task = task_type(env_id)(1, model=model)
    only, nominal = np.arange(1), task.parameters.nominal[None]

    def run():
        start = time.perf_counter()
        for _ in range(20):
            task.sim.set_params(only, nominal)
        return (time.perf_counter() - start) / 20

    return run


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--steps", type=int, default=20, help="environment steps per measurement")
    options = parser.parse_args()
    heads = "environment", "model", "env steps per CPU-s", "of a bare mj_step loop", "two threads", "parameter reset"
    print(header(heads))
    for env_id in TRUNK_IDS:
        for model in ("cable", "flex"):
            rng = np.random.default_rng(0)
            actions = rng.uniform(-1, 1, (options.steps, NUM_ENVS, len(geo.CABLE_NAMES))).astype(np.float32)
            task = task_type(env_id)(1, model=model)
            bare, reset_bare = bare_loop(task, geo.CABLE_RATE * actions.astype(float))
            one, reset_one = vector_env(env_id, model, 1, actions, time.process_time)
            wall_one, reset_wall_one = vector_env(env_id, model, 1, actions, time.perf_counter)
            wall_two, reset_wall_two = vector_env(env_id, model, 2, actions, time.perf_counter)
            new_parameters = parameter_reset(env_id, model)
            rows = []
            for _ in range(options.repeats):
                for reset in (reset_bare, reset_one, reset_wall_one, reset_wall_two):
                    reset()
                rows.append([bare(), one(), wall_one(), wall_two(), new_parameters()])
            seconds = np.array(rows)
            share = np.median(seconds[:, 0] / seconds[:, 1])
            gain = np.median(seconds[:, 2] / seconds[:, 3])
            rate, reset_ms = 1 / np.median(seconds[:, 1]), 1e3 * np.median(seconds[:, 4])
            figures = f"{rate:.0f}", f"{share:.2f}", f"{gain:.2f}x", f"{reset_ms:.2f} ms"
            print(row((env_id, model, *figures)), flush=True)


if __name__ == "__main__":
    main()
