"""All 46,656 six-step sequences of MultiGait: which one walks farthest?

    python benchmarks/multigait_gaits.py

Sequences share their beginnings, so they are walked as a tree: the states after each sequence of k actions are kept in
runs/multigait_gaits/level<k>.npz (written every minute; the same command goes on from there) and each is continued by
the six actions. Then the best sequence is run on all meshes, forwards and mirrored (front and rear legs swapped).
Writes docs/results/multigait_gaits.json.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.envs.multigait import MultiGaitTask
from soro_bench.files import replacing, write_json
from soro_bench.models.walker_mesh import RESOLUTIONS
from soro_bench.sources import SIMULATION, claim, version_of

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "docs" / "results" / "multigait_gaits.json"
ACTIONS, STEPS = 6, 6
SIMULATIONS = 48  # at a time, a multiple of 6
SAVE_INTERVAL = 60.0  # s
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time")
MIRROR = np.array([0, 2, 1, 3, 5, 4])  # the action with front and rear swapped


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

    def root(self):
        """State and way of the empty sequence."""
        self._task.reset(self._ids, [np.random.default_rng(0)] * SIMULATIONS, [{}] * SIMULATIONS)
        return self._states()[:1], np.zeros((1, 1))

    def grow(self, states, way, level: int):
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

    def observations(self, states) -> np.ndarray:
        """(n, 8) what is observed in states."""
        parts = []
        for first in range(0, len(states), SIMULATIONS):
            part = states[first : first + SIMULATIONS]
            self._load(self._ids[: len(part)], part)
            parts.append(self._task._observe(self._ids[: len(part)]))
        return np.concatenate(parts)

    def _states(self):
        batch = self._task.sim.batch
        return np.concatenate([np.reshape(getattr(batch, f), (SIMULATIONS, -1)) for f in STATE], axis=1)

    def _load(self, ids, states):
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


def displacement_mm(sequences, mesh: str, threads: int) -> list[float]:
    """mm, the displacement after each of the sequences."""
    ids = np.arange(len(sequences))
    task = MultiGaitTask(len(ids), threads, mesh=mesh)
    task.reset(ids, [np.random.default_rng(0)] * len(ids), [{}] * len(ids))
    for actions in np.transpose(sequences):
        step = task.step(ids, actions)
    return [round(float(x), 3) for x in 1e3 * step.info["displacement"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "multigait_gaits")
    options = parser.parse_args()
    claim(options.work / "sources.txt", version_of(SIMULATION))
    tree = Tree(options.work, options.threads)
    states, way = tree.root()
    for level in range(1, STEPS + 1):
        states, way = tree.grow(states, way, level)
    way = 1e3 * way  # mm
    final = way[:, -1]
    clipped = np.maximum(np.diff(way, axis=1), 0).sum(axis=1)
    best, best_clipped = int(final.argmax()), int(clipped.argmax())
    result = {
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
        write_json(RESULT, result)
    print(result)


if __name__ == "__main__":
    main()
