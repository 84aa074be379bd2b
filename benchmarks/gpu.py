"""What a GPU changes. Run it on a machine with one; each part is short, and prints a table to keep.

    python benchmarks/gpu.py                                  # pictures, updates, threads
    python benchmarks/gpu.py worlds --out FOLDER              # env steps/s without learning, beside a CPU thread
    python benchmarks/gpu.py agreement --out FOLDER           # the same trajectories in MuJoCo Warp and in MuJoCo
    python benchmarks/gpu.py learning --out FOLDER            # seconds of training, and the score on the CPU

Without a part it prints what renders the environments and how fast; milliseconds of PPO's update and of its actions for
all environments, on CPU and on CUDA, in turn; whether a short training writes the same policy with the GPU hidden as
with it, and with one simulation thread as with all; and environment steps per second by the number of threads.

worlds: random actions, also with randomised parameters and with --deterministic of MuJoCo Warp, and whether that gives
the same bytes twice. The CPU's rate is that of one thread in the same run.

agreement: --count random trajectories of 100 steps, nominal and over the search box. Both simulations begin with
cables slack by a micrometre: at rest they are at the edge of slackness, where rounding decides. Tells the largest
difference of points of the robot in millimetres, as long as nothing touches, and the distances in the end.

learning: --seeds trainings from process start with kernels cached; each policy is evaluated on the CPU.

--device cpu runs worlds and agreement without a GPU, thousands of times slower.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch

import soro_bench  # before OpenGL, for which it chooses EGL where there is no display
from soro_bench.evaluation import evaluate
from soro_bench.markdown import table
from soro_bench.policies.policy import Policy
from soro_bench.randomization import search_box
from soro_bench.registration import task_type
from soro_bench.training.configuration import default_config
from soro_bench.training.ppo import make_agent, make_env, train

if TYPE_CHECKING:  # which needs the gpu extra
    from soro_bench.envs.torch_vector import TorchVectorEnv

ENV_ID = "TrunkReach-v0"
NUM_ENVS = 64
FRAMES = 50
REPEATS = 5
STEPS = 20  # of all environments, per measurement of threads


def rendering() -> None:
    """Frames per second of every environment, and the name of what draws them."""
    from OpenGL import GL

    rows = []
    for env_id in soro_bench.ENV_IDS:
        env = gymnasium.make(env_id, render_mode="rgb_array")
        env.reset(seed=0)
        env.render()  # the first one makes the context
        start = time.perf_counter()
        for _ in range(FRAMES):
            frame = np.asarray(env.render())
        rate = FRAMES / (time.perf_counter() - start)
        drawn_by = GL.glGetString(GL.GL_RENDERER).decode()
        rows.append((env_id, f"{frame.shape[1]}x{frame.shape[0]}", f"{rate:.0f}", drawn_by))
        env.close()
    print(table(("environment", "size", "frames/s", "drawn by"), rows), flush=True)


def updates() -> None:
    """PPO's update and actions by device."""
    torch.set_num_threads(1)  # as in training
    config = default_config(ENV_ID, num_threads=1)
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    agents = {}
    for device in devices:
        agents[device] = make_agent(config, make_env(config), device)
        agents[device].learn(config.num_envs * config.rollout_steps)
    found: dict[str, list[tuple[float, float]]] = {device: [] for device in devices}
    for _ in range(REPEATS):
        for device, agent in agents.items():
            start = time.perf_counter()
            agent.train()  # ends with losses as numbers, so CUDA has caught up
            observations, updated = agent._last_obs, time.perf_counter()
            assert observations is not None  # it has learned
            for _ in range(config.rollout_steps):
                agent.predict(observations)
            found[device].append((updated - start, (time.perf_counter() - updated) / config.rollout_steps))
    rows = [(device, *(f"{1e3 * np.median(column):.2f}" for column in zip(*seconds, strict=True)))
            for device, seconds in found.items()]  # fmt: skip
    print(table(("device", "update [ms]", "actions [ms]"), rows), flush=True)


def policy_hash(threads: int) -> str:
    """SHA-256 of the policy that a short training writes."""
    with tempfile.TemporaryDirectory() as folder:
        train(default_config(ENV_ID, 32_000, num_threads=threads), folder)
        return hashlib.sha256((Path(folder) / "policy.safetensors").read_bytes()).hexdigest()


def same_policy() -> None:
    """The same training with all threads, with one, and with one where CUDA sees no GPU."""
    here, one = policy_hash(0), policy_hash(1)
    command = [sys.executable, __file__, "--policy"]
    hidden = subprocess.run(
        command, env=os.environ | {"CUDA_VISIBLE_DEVICES": ""}, capture_output=True, text=True, check=True
    )
    found = {"all threads": here, "one thread": one, "one thread, GPU hidden": hidden.stdout.split()[-1]}
    print(f"torch {torch.__version__}, CUDA {'available' if torch.cuda.is_available() else 'not available'}")
    print(table(("training", "policy"), [(name, value[:12]) for name, value in found.items()]), flush=True)


def threads() -> None:
    """Environment steps per second, and the gain over one thread."""
    counts = [2**k for k in range((os.cpu_count() or 1).bit_length())]
    rng, rows = np.random.default_rng(0), []
    for model in ("cable", "flex"):
        envs = {
            count: gymnasium.make_vec(ENV_ID, num_envs=NUM_ENVS, num_threads=count, model=model, action="continuous")
            for count in counts
        }
        shape = next(iter(envs.values())).action_space.shape or ()
        actions = rng.uniform(-1, 1, (STEPS, *shape)).astype(np.float32)
        rates: dict[int, list[float]] = {count: [] for count in counts}
        for _ in range(REPEATS):
            for count, vector in envs.items():
                vector.reset(seed=0)
                start = time.perf_counter()
                for action in actions:
                    vector.step(action)
                rates[count].append(STEPS * NUM_ENVS / (time.perf_counter() - start))
        median = {count: np.median(rate) for count, rate in rates.items()}
        rows += [(model, count, f"{rate:.0f}", f"{rate / median[1]:.2f}x") for count, rate in median.items()]
    print(table(("model", "threads", "env steps/s", "of one"), rows))


def device_name(device: str) -> str:
    """What the figures were measured on."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"


def rate_of(envs: "TorchVectorEnv", steps: int) -> tuple[float, str]:
    """Environment steps per second, the median of REPEATS, and a hash of the last observations."""
    generator = torch.Generator(device=envs.device).manual_seed(0)
    shape = (envs.num_envs, *(envs.single_action_space.shape or ()))
    rates, observation = [], envs.reset(seed=0)[0]
    for _ in range(REPEATS):
        start = time.perf_counter()
        for _ in range(steps):
            observation, *_ = envs.step(2 * torch.rand(shape, generator=generator, device=envs.device) - 1)
        digest = hashlib.sha256(observation.cpu().numpy().tobytes()).hexdigest()  # waits for the device
        rates.append(steps * envs.num_envs / (time.perf_counter() - start))
    return float(np.median(rates)), digest


def thread_rate(env_id: str, model: str, action: str) -> float:
    """Environment steps per second of one CPU thread."""
    kind = task_type(env_id)
    options: dict[str, Any] = {kind.variant_name: model, "num_threads": 1, "action": action}
    vector = gymnasium.make_vec(env_id, 32, vectorization_mode="vector_entry_point", **options)
    vector.reset(seed=0)
    vector.action_space.seed(0)
    actions, start = [vector.action_space.sample() for _ in range(STEPS)], time.perf_counter()
    for each in actions:
        vector.step(each)
    return STEPS * 32 / (time.perf_counter() - start)


def worlds(options: argparse.Namespace) -> None:
    """How fast environments are, by their number."""
    from soro_bench.envs.torch_vector import TorchVectorEnv

    rows = []
    for env_id in options.only:
        kind = task_type(env_id)
        for model in options.models or (kind.cheap, kind.accurate):
            thread = thread_rate(env_id, model, "continuous")
            for count in options.worlds:
                for name, randomised, deterministic in (("", False, False), ("randomised", True, False),
                                                        ("deterministic", False, True)):  # fmt: skip
                    if name and count != options.worlds[-1]:
                        continue
                    box = search_box(kind.randomized) if randomised else None
                    try:
                        envs = TorchVectorEnv(env_id, count, options.device, model, distribution=box,
                                              deterministic=deterministic, on_nan="truncate")  # fmt: skip
                        rate, digest = rate_of(envs, options.steps)
                        same = rate_of(envs, options.steps)[1] == digest if deterministic else ""
                        found = (f"{rate:,.0f}", f"{rate / thread:.0f}x", same)
                    except (ValueError, RuntimeError) as error:
                        found = (str(error)[:120], "", "")
                    rows.append((env_id, model, f"{count:,}", name, *found))
                    print(*rows[-1], flush=True)
                    save(options, "worlds", rows)
    print(device_name(options.device))
    print(table(("environment", "model", "worlds", "", "env steps/s", "CPU threads", "same bytes"), rows))


def agreement(options: argparse.Namespace) -> None:
    """How far MuJoCo Warp is from MuJoCo."""
    from soro_bench.models.warp_simulation import WarpSimulation

    rows = []
    for env_id in options.only:
        kind: Any = task_type(env_id)
        for randomised in (False, True):
            tasks = [
                kind(options.count, threads, **{kind.variant_name: kind.cheap}, action="continuous", **extra)
                for threads, extra in ((0, {}), (1, {"simulation": partial(WarpSimulation, device=options.device)}))
            ]
            try:
                found = compared(tasks, options.steps, randomised)
            except ValueError as error:
                found = (str(error)[:120], "", "", "")
            rows.append((env_id, "search box" if randomised else "nominal", *found))
            print(*rows[-1], flush=True)
            save(options, "agreement", rows)
    print(device_name(options.device))
    names = ("environment", "parameters", "99 % of points [mm]", "largest [mm]", "metric, MuJoCo [mm]", "Warp [mm]")
    print(table(names, rows))


def compared(tasks: "list[Any]", steps: int, randomised: bool) -> tuple[str, ...]:
    """Differences of what is observed of the robot, before anything touches, and the metrics in the end."""
    count, rng = tasks[0].num_envs, np.random.default_rng(1)
    everyone = np.arange(count)
    for task in tasks:
        task.randomize(search_box(task.randomized) if randomised else None)
        ids = task.sim.array(everyone)
        task.reset(ids, [np.random.default_rng(i) for i in everyone], [{}] * count)
        if task.sim.batch.bind("ctrl").shape[1] == 8:  # a trunk
            task.sim.batch.bind("act")[:] = -1e-6
            task.sim.begin(ids)
    apart = np.zeros((steps, count))
    touched = np.zeros(count, bool)
    for k in range(steps):
        actions = rng.uniform(-1, 1, (count, tasks[0].moves.shape[0])).astype(np.float32)
        seen = []
        for task in tasks:
            found = task.step(task.sim.array(everyone), task.sim.array(actions))
            seen.append(task.sim.on_host(found.observation)[:, :63])
        contacts = tasks[0].sim.batch.bind("ncon") if hasattr(tasks[0].sim.batch, "ncon") else None
        touched |= np.zeros(count, bool) if contacts is None else np.asarray(contacts).reshape(count, -1).any(axis=1)
        apart[k] = np.where(touched, np.nan, 1e3 * np.abs(seen[0] - seen[1]).max(axis=1))
    ends = [1e3 * np.asarray(task.sim.on_host(task._info(task.sim.array(everyone))[task.metric])) for task in tasks]
    spread = [f"{each.mean():.2f} +- {1.96 * each.std() / np.sqrt(count):.2f}" for each in ends]
    return f"{np.nanquantile(apart, 0.99):.5f}", f"{np.nanmax(apart):.5f}", *spread


def learning(options: argparse.Namespace) -> None:
    """Seconds of training on the device, and the score of its policy on the CPU."""
    rows = []
    for env_id in options.only:
        for seed in range(options.seeds):
            folder = Path(options.out) / f"{env_id}_{seed}"
            if folder.exists():
                raise SystemExit(f"{folder} has a training, whose time would not be measured; choose another --out")
            command = [sys.executable, "-m", "soro_bench.cli", "train", env_id, "--device", options.device,
                       "--seed", str(seed), "--out", str(folder)]  # fmt: skip
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            seconds = time.perf_counter() - start
            policy, kind = Policy.load(folder), task_type(env_id)
            episodes = evaluate(policy.act, env_id, kind.cheap, "continuous", list(kind.evaluation))
            score = 1e3 * np.mean([each.metric[-1] for each in episodes])
            steps = policy.card.steps
            rows.append((env_id, seed, f"{steps:,}", f"{seconds:.0f}", f"{steps / seconds:,.0f}", f"{score:.2f}"))
            print(*rows[-1], flush=True)
            save(options, "learning", rows)
    print(device_name(options.device))
    print(table(("environment", "seed", "steps", "wall [s]", "env steps/s", f"{kind.metric} on the CPU [mm]"), rows))


def save(options: argparse.Namespace, name: str, rows: list[tuple]) -> None:
    """Keep what was measured so far."""
    path = Path(options.out) / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"device": device_name(options.device), "rows": rows}, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", choices=("worlds", "agreement", "learning"))
    parser.add_argument("--policy", action="store_true", help=argparse.SUPPRESS)  # see same_policy
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--only", nargs="+", default=list(soro_bench.ENV_IDS))
    parser.add_argument("--models", nargs="+", help="of the robot; the cheap and the accurate one by default")
    parser.add_argument("--worlds", nargs="+", type=int, default=[2048, 8192, 32768])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    if options.policy:
        print(policy_hash(1))
    elif options.part:
        {"worlds": worlds, "agreement": agreement, "learning": learning}[options.part](options)
    else:
        for part in (rendering, updates, same_policy, threads):
            part()


if __name__ == "__main__":
    main()
