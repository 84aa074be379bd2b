"""MultiGait: all its gaits, what PPO makes of them, and random actions over random parameters.

    python benchmarks/multigait.py gaits
    python benchmarks/multigait.py ppo [--seeds 4]
    python benchmarks/multigait.py random [--episodes 1000]

gaits: which of the 46,656 six-step sequences walks farthest? They share their beginnings, so they are walked as a tree:
the states after each sequence of k actions are kept in runs/multigait_gaits/level<k>.npz (written every minute; the
same command goes on from there) and each is continued by the six actions. Then the best sequence is run on all meshes,
forwards and mirrored (front and rear legs swapped).

ppo: without randomisation and noise an episode is determined by its actions, so that a training on a table of all
sequences takes seconds instead of minutes, and variants can be compared over seeds.

random: does anything become NaN, fly, tumble or sink? Parameters uniform in the search box, random actions, discrete
and continuous in turn, 6 steps. Adds counts to a file in --work after every batch and goes on from there. Warnings are
those of MuJoCo that are not of a bad state, as a state that is counts as diverged.

Whole results are in docs/results/measured.json.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from soro_bench.envs.multigait import MultiGaitTask
from soro_bench.files import read_json, replacing, write_json
from soro_bench.models import walker
from soro_bench.models.walker_mesh import RESOLUTIONS
from soro_bench.policies.policy import OBSERVATION_CLIP
from soro_bench.randomization import search_box
from soro_bench.sources import SIMULATION, claim, version_of
from soro_bench.training.configuration import PPOConfig, default_config
from soro_bench.training.ppo import make_agent

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "measured.json"
ACTIONS, STEPS = 6, 6
SIMULATIONS = 48  # at a time, a multiple of 6
SAVE_INTERVAL = 60.0  # s
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time")
MIRROR = np.array([0, 2, 1, 3, 5, 4])  # the action with front and rear swapped


def publish(**parts: dict) -> None:
    """Write parts of the results; the others stay."""
    every = read_json(RESULTS)
    every["multigait"] |= parts
    write_json(RESULTS, every)


# --- gaits ---


class Tree:
    """The states after every sequence of a given length.

    Sequence i of length k is the base-6 number i with k digits, first action first. ``way`` (6^k, k + 1) is the
    displacement [m] after 0 to k actions.
    """

    def __init__(self, folder: Path, threads: int):
        self._folder = folder
        self._task = MultiGaitTask(SIMULATIONS, threads, mesh=MultiGaitTask.cheap)
        self._ids = np.arange(SIMULATIONS)
        for field in STATE:
            self._task.sim.batch.bind(field)

    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """State and way of the empty sequence."""
        self._task.reset(self._ids, [np.random.default_rng(0)] * SIMULATIONS, [{}] * SIMULATIONS)
        return self._states()[:1], np.zeros((1, 1))

    def grow(self, states: np.ndarray, way: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """States and ways of the sequences that are one action longer; goes on from the level's file."""
        path = self._folder / f"level{level}.npz"
        count = ACTIONS * len(states)
        new_states, new_way, done = np.empty((count, states.shape[1])), np.empty((count, level + 1)), 0
        if path.exists():
            with np.load(path, allow_pickle=False) as data:
                done = len(data["way"])
                new_way[:done] = data["way"]
                new_states[: len(data["states"])] = data["states"]  # none of the last level
        start, first, saved = time.monotonic(), done, time.monotonic()
        while done < count:
            sequences = np.arange(done, min(done + SIMULATIONS, count))
            parents = sequences // ACTIONS
            ids = self._ids[: len(sequences)]
            self._load(ids, states[parents])
            self._task.step(ids, sequences % ACTIONS)
            displacement = self._task.center_of_mass(ids)[:, 0]
            new_states[sequences] = self._states()[: len(sequences)]
            new_way[sequences] = np.column_stack([way[parents], displacement])
            done = int(sequences[-1]) + 1
            if time.monotonic() - saved > SAVE_INTERVAL or done == count:
                saved = time.monotonic()
                with replacing(path) as temporary, open(temporary, "wb") as file:
                    np.savez(file, states=new_states[: done if level < STEPS else 0], way=new_way[:done])
                left = (saved - start) / max(done - first, 1) * (count - done) / 60
                print(f"level {level}: {done} of {count} sequences, {left:.0f} min left", flush=True)
        return new_states, new_way

    def observations(self, states: np.ndarray) -> np.ndarray:
        """(n, 8) what is observed in states."""
        parts = []
        for first in range(0, len(states), SIMULATIONS):
            part = states[first : first + SIMULATIONS]
            self._load(self._ids[: len(part)], part)
            parts.append(self._task._observe(self._ids[: len(part)]))
        return np.concatenate(parts)

    def _states(self) -> np.ndarray:
        batch = self._task.sim.batch
        return np.concatenate([np.reshape(getattr(batch, f), (SIMULATIONS, -1)) for f in STATE], axis=1)

    def _load(self, ids: np.ndarray, states: np.ndarray) -> None:
        batch, first = self._task.sim.batch, 0
        for field in STATE:
            array = getattr(batch, field)
            size = int(np.prod(array.shape[1:]))
            array[ids] = states[:, first : first + size].reshape(len(ids), *array.shape[1:])
            first += size
        batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)


def digits(i: int) -> list[int]:
    """The actions of sequence i."""
    return [i // ACTIONS**k % ACTIONS for k in reversed(range(STEPS))]


def displacement_mm(sequences: np.ndarray, mesh: str, threads: int) -> list[float]:
    """mm, the displacement after each of the sequences."""
    ids = np.arange(len(sequences))
    task = MultiGaitTask(len(ids), threads, mesh=mesh)
    task.reset(ids, [np.random.default_rng(0)] * len(ids), [{}] * len(ids))
    for actions in np.transpose(sequences):
        step = task.step(ids, actions)
    return [round(float(x), 3) for x in 1e3 * step.info["displacement"]]


def gaits(options: argparse.Namespace) -> None:
    """Walk them all."""
    claim(options.work / "sources.txt", version_of(SIMULATION))
    tree = Tree(options.work, options.threads)
    states, way = tree.root()
    for level in range(1, STEPS + 1):
        states, way = tree.grow(states, way, level)
    way = 1e3 * way  # mm
    final = way[:, -1]
    clipped = np.maximum(np.diff(way, axis=1), 0).sum(axis=1)
    best, best_clipped = int(final.argmax()), int(clipped.argmax())
    result: dict[str, Any] = {
        "sequences": len(final),
        "quantiles_mm": {str(q): round(float(np.quantile(final, q)), 3) for q in (0, 0.05, 0.25, 0.5, 0.75, 0.95, 1)},
        "best": [{"actions": digits(int(i)), "displacement_mm": round(float(final[i]), 3)}
                 for i in np.argsort(-final)[:10]],
        "best_of_clipped_reward": {"actions": digits(best_clipped), "return_mm": round(float(clipped[best_clipped]), 3),
                                   "displacement_mm": round(float(final[best_clipped]), 3)},
    }  # fmt: skip
    gaits = np.array([digits(best), MIRROR[digits(best)]])
    result["meshes"] = {}
    for mesh in RESOLUTIONS:
        result["meshes"][mesh] = dict(
            zip(("forward_mm", "mirrored_mm"), displacement_mm(gaits, mesh, options.threads), strict=True)
        )
        print(mesh, result["meshes"][mesh], flush=True)
        publish(gaits=result)
    print(result)


# --- ppo ---

VARIANTS: dict[str, dict[str, Any]] = {
    "discount 0.99, bootstrapped after the last step": {"discount": 0.99, "finite_horizon": False},
    "no discount, bootstrapped": {"finite_horizon": False},
    "discount 0.99, nothing after the last step": {"discount": 0.99},
    "no discount, nothing after the last step": {},
    "the same, twice the steps": {"total_steps": 23_040},
}


class Table(VecEnv):
    """Episodes looked up in the table: ``observations[k]`` (6^k, 8) and ``way[k]`` (6^k,) mm after k actions."""

    def __init__(
        self, observations: Sequence[np.ndarray], way: Sequence[np.ndarray], num_envs: int, finite_horizon: bool
    ):
        super().__init__(num_envs, spaces.Box(-1.0, 2.0, (8,), np.float64), spaces.Discrete(ACTIONS))
        self._observations, self._way, self._finite_horizon = observations, way, finite_horizon

    def reset(self) -> np.ndarray:
        self._length, self._place = 0, np.zeros(self.num_envs, int)
        return self._observations[0][self._place]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        place, before = ACTIONS * self._place + self._actions, self._way[self._length][self._place]
        self._length, self._place = self._length + 1, place
        reward = (self._way[self._length][place] - before).astype(np.float32)
        if self._length < STEPS:
            return self._observations[self._length][place], reward, np.zeros(self.num_envs, bool), [{}] * self.num_envs
        # the state after the last action is not in the table; that before it stands for it
        last = self._observations[STEPS - 1][place // ACTIONS]
        infos = [{"terminal_observation": one, "TimeLimit.truncated": not self._finite_horizon} for one in last]
        return self.reset(), reward, np.ones(self.num_envs, bool), infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        pass

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return [False] * self.num_envs


def table() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Observations and ways, from the files of the gaits."""
    tree = Tree(ROOT / "runs" / "multigait_gaits", threads=0)
    states, way = tree.root()
    observations, ways = [tree.observations(states)], [way[:, -1]]
    for level in range(1, STEPS + 1):
        states, way = tree.grow(states, way, level)
        ways.append(way[:, -1])
        if level < STEPS:
            observations.append(tree.observations(states))
    return observations, [1e3 * way for way in ways]


def displacement(observations: Sequence[np.ndarray], way: Sequence[np.ndarray], config: PPOConfig) -> float:
    """What the trained policy walks [mm], without exploration."""
    env = Table(observations, way, config.num_envs, config.finite_horizon)
    floor = config.observation_floor**2
    normalised = VecNormalize(env, norm_reward=False, clip_obs=OBSERVATION_CLIP, epsilon=floor)
    agent = make_agent(config, normalised)
    agent.lr_schedule = lambda _: config.learning_rate * (1.0 - agent.num_timesteps / config.total_steps)
    agent.learn(config.total_steps)
    place = 0
    for length in range(STEPS):
        observation = normalised.normalize_obs(observations[length][place : place + 1])
        place = ACTIONS * place + int(agent.predict(observation, deterministic=True)[0][0])
    return float(way[STEPS][place])


def ppo(options: argparse.Namespace) -> None:
    """Train on the table."""
    observations, way = table()
    print(f"best of all {len(way[-1])}: {way[-1].max():.2f} mm")
    for name, changes in VARIANTS.items():
        config = replace(default_config("MultiGait-v0"), **changes)
        found = [displacement(observations, way, replace(config, seed=seed)) for seed in range(options.seeds)]
        print(f"{name}: {', '.join(f'{x:.1f}' for x in found)} mm", flush=True)


# --- random ---

BATCH = 50


def run_batch(number: int, threads: int) -> dict:
    """Counts and extremes of one batch of episodes; ``number`` seeds it."""
    action = ("discrete", "continuous")[number % 2]
    task = MultiGaitTask(BATCH, threads, mesh="coarse", action=action)
    task.randomize(search_box(walker.PARAMETERS))
    floor = task.model.geom("floor").pos[2]
    ids, rng = np.arange(BATCH), np.random.default_rng(number)
    task.reset(ids, [np.random.default_rng([number, i]) for i in range(BATCH)], [{}] * BATCH)
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


def tilt_of(now: np.ndarray, rest: np.ndarray) -> float:
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


def random(options: argparse.Namespace) -> None:
    """Add batches to the counts."""
    claim(options.work / "sources.txt", version_of(SIMULATION))
    path = options.work / "multigait_random.json"
    total = read_json(path) if path.exists() else {}
    start, first = time.monotonic(), total.get("episodes", 0)
    while (done := total.get("episodes", 0)) < options.episodes:
        total = merge(total, run_batch(done // BATCH, options.threads))
        write_json(path, total)
        rate = (total["episodes"] - first) / (time.monotonic() - start)
        print(f"{total['episodes']} episodes, {(options.episodes - total['episodes']) / rate / 60:.0f} min left",
              end="\r", flush=True)  # fmt: skip
    publish(random=total)
    print(f"\n{total}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="gaits | ppo | random")
    for function in (gaits, ppo, random):
        command = commands.add_parser(function.__name__)
        command.set_defaults(function=function)
        if function is ppo:
            command.add_argument("--seeds", type=int, default=4)
            continue
        command.add_argument("--threads", type=int, default=0)
        command.add_argument("--work", type=Path, default=ROOT / "runs" / f"multigait_{function.__name__}")
        if function is random:
            command.add_argument("--episodes", type=int, default=1000)
    options = parser.parse_args()
    options.function(options)


if __name__ == "__main__":
    main()
