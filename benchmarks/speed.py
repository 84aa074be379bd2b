"""Speed of the environments, of training and of effects, as ratios measured in one run.

    python benchmarks/speed.py trunk [--repeats 15] [--steps 20]
    python benchmarks/speed.py walker [--repeats 5]
    python benchmarks/speed.py training [--env TrunkReach-v0] [--model cable] [--steps 64000] [--repeats 3]
    python benchmarks/speed.py effects [--model cable] [--repeats 5]

trunk: for every environment and model, environment steps per CPU-second of the vector environment on one thread, its
rate as a share of a bare mj_step loop over the same model (same controls, no observations, rewards or resets), the
wall-clock gain of two threads over one, and the time to give one simulation new parameters. Every figure is the median
of measurements taken in turn, so that a machine whose speed drifts affects both sides of a ratio alike.

walker: episodes of random discrete actions of MultiGait, meshes in turn. Medians of CPU-seconds per simulated second,
environment steps per CPU-second, the ratio to the coarse mesh, and the rate of the whole machine (all processors) as a
multiple of the published training's 0.83 steps per second.

training: trains with one simulation thread and with two, in turn. Environment steps per second and per CPU-second, the
shares of the simulation (the environments' step), of the policy's actions and bookkeeping between steps, and of PPO's
update; the time of two million steps at that rate; and a bare loop of mj_step over the same model, in the same run.

effects: what each costs on a trunk, as a ratio to the simulation without effects.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import mujoco
import numpy as np
from stable_baselines3 import PPO

import soro_bench
from soro_bench.diagnosis.candidates import terms, typical
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect
from soro_bench.envs.multigait import MultiGaitTask
from soro_bench.envs.sb3 import SB3VecEnv
from soro_bench.envs.task import Task
from soro_bench.markdown import header, row, table
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.walker_mesh import RESOLUTIONS
from soro_bench.registration import make_task, task_type
from soro_bench.training.configuration import default_config
from soro_bench.training.ppo import train

# --- trunk ---

NUM_ENVS = 16
TRUNK_IDS = [env_id for env_id in soro_bench.ENV_IDS if env_id.startswith("Trunk")]


Measurement = Callable[[], float]


def bare_loop(task: Task, controls: np.ndarray) -> tuple[Measurement, Callable[[], object]]:
    """CPU-seconds of a plain loop of mj_step over NUM_ENVS MjData, per environment step."""
    model = task.sim.batch.get_model(0)
    substeps = round(task.control_timestep / model.opt.timestep)
    datas = [mujoco.MjData(model) for _ in range(NUM_ENVS)]

    def run() -> float:
        start = time.process_time()
        for control in controls:
            for data, u in zip(datas, control, strict=True):
                data.ctrl[:] = u
                mujoco.mj_step(model, data, nstep=substeps)
        return (time.process_time() - start) / (len(controls) * NUM_ENVS)

    def reset() -> None:
        for data in datas:
            mujoco.mj_resetData(model, data)

    return run, reset


def vector_env(
    env_id: str, model: str, threads: int, actions: np.ndarray, clock: Callable[[], float]
) -> tuple[Measurement, Callable[[], object]]:
    """Seconds by ``clock`` of the vector environment, per environment step."""
    envs = gymnasium.make_vec(env_id, num_envs=NUM_ENVS, num_threads=threads, model=model, action="continuous")
    envs.reset(seed=0)

    def run() -> float:
        start = clock()
        for action in actions:
            envs.step(action)
        return (clock() - start) / (len(actions) * NUM_ENVS)

    return run, lambda: envs.reset(seed=0)


def parameter_reset(env_id: str, model: str) -> Measurement:
    """Seconds to give one simulation new parameters."""
    task = make_task(env_id, 1, 1, model)
    only, nominal = np.arange(1), task.parameters.nominal[None]

    def run() -> float:
        start = time.perf_counter()
        for _ in range(20):
            task.sim.set_params(only, nominal)
        return (time.perf_counter() - start) / 20

    return run


def trunk(options: argparse.Namespace) -> None:
    """The environments of the trunk."""
    heads = "environment", "model", "env steps per CPU-s", "of a bare mj_step loop", "two threads", "parameter reset"
    print(header(heads))
    for env_id in TRUNK_IDS:
        for model in ("cable", "flex"):
            rng = np.random.default_rng(0)
            actions = rng.uniform(-1, 1, (options.steps, NUM_ENVS, len(geo.CABLE_NAMES))).astype(np.float32)
            task = make_task(env_id, 1, 1, model)
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


# --- walker ---

PUBLISHED_RATE = 0.83  # environment steps per second: 500,000 steps in 7 days on 24 threads (Tiboni et al., 2023)
WALKERS = {"coarse": 16, "fine": 4, "finest": 2}
EPISODE = 6


def episode(task: Task, rng: np.random.Generator, clock: Callable[[], float]) -> float:
    """Seconds per environment step."""
    ids = np.arange(task.num_envs)
    task.reset(ids, [np.random.default_rng(i) for i in ids], [{}] * len(ids))
    start = clock()
    for _ in range(EPISODE):
        task.step(ids, rng.integers(6, size=len(ids)))
    return (clock() - start) / (EPISODE * len(ids))


def walker(options: argparse.Namespace) -> None:
    """MultiGait."""
    one = {mesh: MultiGaitTask(WALKERS[mesh], 1, mesh=mesh) for mesh in RESOLUTIONS}
    everything = MultiGaitTask(WALKERS["coarse"], 0, mesh="coarse")
    cpu: dict[str, list[float]] = {mesh: [] for mesh in RESOLUTIONS}
    wall = []
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


# --- training ---

PUBLISHED_STEPS = 2_000_000
BARE_STEPS = 2_000  # of the environment


@contextmanager
def timed(spent: dict[str, float], owner: type, method: str) -> Iterator[None]:
    """Adds the seconds inside a method to ``spent``, by its name."""
    original = getattr(owner, method)

    def wrapper(*args: Any, **kwargs: Any) -> Any:
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
    config = default_config(env_id, steps, model=model, num_threads=threads)
    spent: dict[str, float] = defaultdict(float)
    with tempfile.TemporaryDirectory() as folder, timed(spent, SB3VecEnv, "step_wait"), timed(spent, PPO, "train"):
        wall, cpu = time.perf_counter(), time.process_time()
        train(config, folder)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    done = config.num_segments * config.segment_steps
    simulation, update = spent["step_wait"] / wall, spent["train"] / wall
    return {"rate": done / wall, "cpu_rate": done / cpu, "simulation": simulation, "update": update,
            "rest": 1.0 - simulation - update}  # fmt: skip


def training(options: argparse.Namespace) -> None:
    """PPO."""
    model = options.model or task_type(options.env).cheap
    measured: dict[int, list[dict[str, float]]] = {threads: [] for threads in (1, 2)}
    bare: list[float] = []
    for _ in range(options.repeats):
        bare.append(bare_rate(options.env, model))
        for threads, found in measured.items():
            found.append(trained(options.env, model, options.steps, threads))
    rows: list[tuple[str | float, ...]] = []
    for threads, found in measured.items():
        m = {name: float(np.median([row[name] for row in found])) for name in found[0]}
        shares = (f"{m[name]:.0%}" for name in ("simulation", "rest", "update"))
        minutes = PUBLISHED_STEPS / m["rate"] / 60
        rows.append((threads, f"{m['rate']:.0f}", f"{m['cpu_rate']:.0f}", *shares, f"{minutes:.1f}"))
    heads = "threads", "env steps/s", "per CPU-s", "simulation", "actions, bookkeeping", "update", "2M steps [min]"
    print(table(heads, rows))
    print(f"bare loop of mj_step on one thread: {np.median(bare):.0f} env steps/s")


# --- effects ---

SIMULATIONS, CONTROLS = 32, 60


def seconds(task: Task, effects: Sequence[Effect], actions: np.ndarray) -> float:
    """CPU-seconds per simulated second."""
    ids = np.arange(SIMULATIONS)
    task.sim.assign_effects([effects] * SIMULATIONS)
    task.reset(ids, [np.random.default_rng(0)] * SIMULATIONS, [{}] * SIMULATIONS)
    start = time.process_time()
    for action in actions:
        task.step(ids, np.repeat(action[None], SIMULATIONS, axis=0))
    return (time.process_time() - start) / (SIMULATIONS * CONTROLS * task.control_timestep)


def effects(options: argparse.Namespace) -> None:
    """Every effect of a trunk, at one location."""
    model = options.model or task_type("TrunkReach-v0").cheap
    robot = SuiteRobot("TrunkReach-v0", model, threads=1)
    task = make_task("TrunkReach-v0", SIMULATIONS, 1, model, action="continuous", effects=())
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (CONTROLS // 5, 8)), 5, axis=0).astype(np.float32)
    first = {one.name: one for one in reversed(terms(robot)) if one.location.kind != "sensor"}
    timestep = task.model.opt.timestep
    print(header(("effect", "location", "cost / without", "more [us per time step]")))
    for name in sorted(first):
        effect = typical(first[name])
        pairs = [(seconds(task, (effect,), actions), seconds(task, (), actions)) for _ in range(options.repeats)]
        ratio, more = np.median([(a / b, 1e6 * timestep * (a - b)) for a, b in pairs], axis=0)
        print(row((name, str(effect.location), f"{ratio:.2f}", f"{more:.0f}")), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    measured = parser.add_subparsers(required=True, metavar="trunk | walker | training | effects")
    for function, repeats in ((trunk, 15), (walker, 5), (training, 3), (effects, 5)):
        command = measured.add_parser(function.__name__)
        command.set_defaults(function=function)
        command.add_argument("--repeats", type=int, default=repeats)
        if function in (training, effects):
            command.add_argument("--model", help="the cheap one by default")
        if function in (trunk, training):
            steps = 20 if function is trunk else 64_000
            command.add_argument("--steps", type=int, default=steps, help="environment steps of a measurement")
        if function is training:
            command.add_argument("--env", default="TrunkReach-v0")
    options = parser.parse_args()
    options.function(options)


if __name__ == "__main__":
    main()
