"""Search for action sequences that raise the object of TrunkLift.

    python baselines/lift_search.py --mass 0.05 --wall --model cable --minutes 20
    python baselines/lift_search.py --mass 0.05 --wall --model flex --minutes 20 \\
        --start baselines/lift_sequences/cable_0.05kg_wall.json

A plan is ten knots of antagonistic cable displacements, 0.5 s apart. The first half of the time goes to exploration: an
archive keeps one simulation state per kind of situation (height, lean, place of the object, place of the tip), and
random moves start from its members, the more promising the more often (Ecoffet et al., "First return, then explore",
Nature 2021). The second half goes to CMA-ES over all knots of the best plan. What counts is the elevation held through
the last 0.5 s, and half as much the height of the object's lowest corner, both in the worse of two simulations: the
nominal one and one with a 0.01 % heavier and less rough object.

The archive (in --work) and the best sequence (in --out) are files; the same command goes on from them. Sequences that
are not in the folder lift_sequences are in lift_sequences.zip (soro_bench/packed.py).
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from soro_bench.cli import plain_errors
from soro_bench.envs.trunk_lift import TrunkLiftTask
from soro_bench.files import replacing, write_json
from soro_bench.leaderboard.strict import read_strict
from soro_bench.models import trunk_geometry as geo
from soro_bench.packed import is_there
from soro_bench.planning import actions_from_knots, antagonistic, roll_out

KNOT_STEPS = 10  # steps from knot to knot, 0.5 s
NUM_KNOTS = 10
DUE = KNOT_STEPS * np.arange(1, NUM_KNOTS + 1)
HELD_STEPS = 10  # the elevation counts that is held through the last 0.5 s
BEND_LIMITS = geo.CABLE_LIMITS[[0, 1, 4, 5]]  # m
STATE_FIELDS = ("qpos", "qvel", "act", "qacc_warmstart", "time")
STILL = 0.006  # m, an object whose path in the last 0.15 s is shorter is not in flight
STILL_STEPS = 3
OUT_OF_REACH = -0.2  # m, wall offset


def heights(task: TrunkLiftTask, ids: np.ndarray) -> np.ndarray:
    """(n, 3): elevation of the object's centre and of its lowest corner above their rest [m], and its lean [rad].

    The lean is the angle between the vertical and the face normal nearest to it.
    """
    lean = np.arccos(np.minimum(np.abs(task.vertical(ids)).max(axis=1), 1.0))
    return np.stack([task.elevation(ids), task.clearance(ids), lean], axis=1)


class Archive:
    """One state per kind of situation: the earliest, then the best.

    ``knots`` (n, 10, 4) m, ``used`` (n,) knots that led there, ``score`` (n,) mm, ``visits`` (n,), ``state`` (n, s).
    """

    FIELDS = ("knots", "used", "score", "visits", "state")

    def __init__(self, keys: Sequence = (), **rows: Sequence) -> None:
        self.place = {tuple(key): i for i, key in enumerate(keys)}
        self.rows = {name: list(rows.get(name, ())) for name in self.FIELDS}

    @classmethod
    def load(cls, path: Path) -> "Archive":
        """The archive of a file."""
        with np.load(path, allow_pickle=False) as data:
            return cls(data["keys"].tolist(), **{name: data[name] for name in cls.FIELDS})

    def save(self, path: Path) -> None:
        """Write the archive into a file, complete or not at all."""
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, keys=np.array(list(self.place)), **{k: np.array(v) for k, v in self.rows.items()})

    def __len__(self) -> int:
        return len(self.place)

    def offer(self, key: tuple, **row: Any) -> None:
        """Keep the row if its key is new, or if it came there with fewer knots or as many and a better score."""
        i = self.place.setdefault(key, len(self.place))
        if i == len(self.rows["score"]):
            for name in self.FIELDS:
                self.rows[name].append(0 if name == "visits" else row[name])
        elif (row["used"], -row["score"]) < (self.rows["used"][i], -self.rows["score"][i]):
            for name in row:
                self.rows[name][i] = row[name]

    def draw(self, rng: np.random.Generator, count: int) -> list[int]:
        """Rows to go on from: unfinished, promising, seldom visited."""
        score, visits = np.array(self.rows["score"]), np.array(self.rows["visits"])
        weight = np.exp(np.minimum(score / 2.5, 8)) / np.sqrt(1 + visits)
        weight[np.array(self.rows["used"]) >= NUM_KNOTS] = 0
        rows = rng.choice(len(weight), count, p=weight / weight.sum())
        for i in rows:
            self.rows["visits"][i] += 1
        return rows.tolist()

    def best_plans(self, count: int) -> np.ndarray:
        """(count, 10, 4) m: the plans of the best scores; unused knots repeat the last."""
        best = np.argsort(self.rows["score"])[::-1][:count]
        return np.stack([hold_on(self.rows["knots"][i], self.rows["used"][i]) for i in best])


def hold_on(knots: np.ndarray, used: int) -> np.ndarray:
    """(10, 4) knots [m] of which those after the first ``used`` repeat the last of these."""
    return np.concatenate([knots[:used], np.repeat(knots[max(used - 1, 0)][None], NUM_KNOTS - used, axis=0)])


class Explorer:
    """Random moves from the members of an archive."""

    def __init__(
        self, task: TrunkLiftTask, params: Mapping[str, float], archive: Archive, rng: np.random.Generator
    ) -> None:
        self.task, self.archive, self._rng = task, archive, rng
        self._options = {"params": params}
        self._ids = np.arange(task.num_envs)
        for field in STATE_FIELDS:
            task.sim.batch.bind(field)
        self._path = np.full(task.num_envs, np.inf)  # m, how far the objects moved in the last STILL_STEPS

    def restart(self, plan: np.ndarray | None = None) -> None:
        """Offer the start of an episode to the archive, and what the plan (10, 4) [m] comes by."""
        self.task.reset(self._ids, [self._rng] * len(self._ids), [self._options] * len(self._ids))
        self._path[:] = np.inf  # it starts in the air
        empty = np.zeros((len(self._ids), NUM_KNOTS, 4))
        self._offer(empty, np.zeros(len(self._ids), int))
        if plan is not None:
            actions = actions_from_knots(antagonistic(plan)[None], DUE)[0]
            for used in range(1, NUM_KNOTS + 1):
                self._play(np.tile(actions[KNOT_STEPS * (used - 1) : KNOT_STEPS * used], (len(self._ids), 1, 1)))
                self._offer(empty + plan, np.full(len(self._ids), used))

    def explore(self) -> None:
        """One random move from each of as many members as there are simulations."""
        rows = self.archive.draw(self._rng, len(self._ids))
        knots = np.array([self.archive.rows["knots"][i] for i in rows])
        used = np.array([self.archive.rows["used"][i] for i in rows])
        self._load(np.array([self.archive.rows["state"][i] for i in rows]))
        before = np.where(used[:, None] > 0, knots[self._ids, used - 1], 0.0)
        knots[self._ids, used] = after = self._move(before)
        actions = self._actions(antagonistic(before), antagonistic(after))
        self._play(actions)
        self._offer(knots, used + 1)

    def _play(self, actions: np.ndarray) -> Any:
        self._path[:] = 0
        for t in range(KNOT_STEPS):
            before = self.task.object_position(self._ids).copy()
            self.task.step(self._ids, actions[:, t])
            if t >= KNOT_STEPS - STILL_STEPS:
                self._path += np.linalg.norm(self.task.object_position(self._ids) - before, axis=1)

    def _move(self, before: np.ndarray) -> Any:
        """(n, 4) m: a nearby or a far bend, with some components as they were; within reach of the cables' rate."""
        rng, shape = self._rng, before.shape
        far = rng.random((len(before), 1)) < 0.5
        after = np.where(far, rng.uniform(-BEND_LIMITS, BEND_LIMITS, shape), before + rng.normal(0, 0.015, shape))
        after = np.where(rng.random(shape) < 0.35, before, after)
        reach = geo.CABLE_RATE * self.task.control_timestep * KNOT_STEPS
        return np.clip(before + np.clip(after - before, -reach, reach), -BEND_LIMITS, BEND_LIMITS)

    def _actions(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        rate = (after - before) / KNOT_STEPS / (geo.CABLE_RATE * self.task.control_timestep)
        return np.repeat(np.clip(rate, -1, 1)[:, None], KNOT_STEPS, axis=1).astype(np.float32)

    def _offer(self, knots: np.ndarray, used: np.ndarray) -> None:
        batch, ids = self.task.sim.batch, self._ids
        position = self.task.object_position(ids)
        tip = self.task.tip(ids) - position
        measured, up_axis = heights(self.task, ids), self._nearest_axis()
        state = np.concatenate([np.reshape(getattr(batch, f)[ids], (len(ids), -1)) for f in STATE_FIELDS], axis=1)
        for i in ids:
            elevation, clearance, lean = 1e3 * measured[i, 0], 1e3 * measured[i, 1], measured[i, 2]
            if not (np.isfinite(state[i]).all() and np.abs(position[i]).max() < 0.25):
                continue
            still = bool(self._path[i] < STILL)
            key = (int(elevation // 3), int(max(clearance, -2) // 2), int(position[i, 0] // 0.02),
                   int(position[i, 2] // 0.02), int(up_axis[i]), int(lean // 0.2), int(still),
                   *(int(v) for v in np.clip(tip[i], -0.09, 0.09) // 0.03))  # fmt: skip
            score = clearance + 0.15 * elevation if still else -2 + 0.1 * elevation
            self.archive.offer(key, knots=knots[i].copy(), used=int(used[i]), score=score, state=state[i])

    def _nearest_axis(self) -> Any:
        return np.abs(self.task.vertical(self._ids)).argmax(axis=1)

    def _load(self, states: Any) -> None:
        batch, first = self.task.sim.batch, 0
        for field in STATE_FIELDS:
            array = getattr(batch, field)
            size = int(np.prod(array.shape[1:]))
            array[self._ids] = states[:, first : first + size].reshape(len(self._ids), *array.shape[1:])
            first += size
        batch.forward(self._ids, stage=mujoco.mjtStage.mjSTAGE_VEL)


def rounded_actions(plans: np.ndarray) -> np.ndarray:
    """(n, 100, 8) float32 actions, to the four digits that a file holds, of plans (n, 10, 4) [m], to its six."""
    return np.round(actions_from_knots(antagonistic(np.round(plans, 6)), DUE), 4)


class Judge:
    """Plays whole plans and says what they hold."""

    def __init__(self, task: TrunkLiftTask, params: Mapping[str, float]) -> None:
        self._task = task
        friction = TrunkLiftTask.parameters.parameters["friction"].nominal
        self._params = (params, {**params, "cube_mass": 1.0001 * params["cube_mass"], "friction": 0.9999 * friction})

    def play(self, actions: np.ndarray, params: Mapping[str, float]) -> Any:
        """(n, t, 3) heights of actions (n, t, 8)."""
        return roll_out(self._task, actions, {"params": params}, lambda ids: heights(self._task, ids))

    def worth(self, plans: np.ndarray) -> np.ndarray:
        """(n,) mm: what plans (n, 10, 4) [m] hold."""
        return self.worth_of(rounded_actions(plans))

    def worth_of(self, actions: np.ndarray) -> np.ndarray:
        """(n,) mm: what actions (n, 100, 8) hold in the worse of the two simulations; -inf if one diverged."""
        worths = []
        for params in self._params:
            played = 1e3 * self.play(actions, params)
            elevation, clearance, peak = played[..., 0], played[..., 1], played[:, 2:, 0].max(axis=1)
            held = elevation[:, -HELD_STEPS:].min(axis=1) + 0.5 * clearance[:, -HELD_STEPS:].min(axis=1)
            worths.append(np.where(np.isfinite(held) & (peak < 100), held, -np.inf))  # what is flung does not count
        return np.min(worths, axis=0)

    def describe(self, plan: np.ndarray) -> dict:
        """The plan (10, 4) [m] as a sequence file, measured with its rounded actions in the nominal simulation."""
        rounded = rounded_actions(plan[None])
        played = self.play(rounded, self._params[0])[0]
        held, end = played[-HELD_STEPS:], played[-1]
        return {
            "elevation_held_mm": round(1e3 * float(held[:, 0].min()), 3),
            "elevation_end_mm": round(1e3 * float(end[0]), 3),
            "lowest_corner_held_mm": round(1e3 * float(held[:, 1].min()), 3),
            "lean_end_deg": round(float(np.degrees(end[2])), 1),
            "mujoco": mujoco.__version__,
            "knots_m": np.round(plan, 6).tolist(),
            "actions": [[float(str(rate)) for rate in row] for row in rounded[0]],
        }


def refine(
    judge: Judge,
    start: np.ndarray,
    best: float,
    options: argparse.Namespace,
    until: float,
    found: Callable[[np.ndarray, float], bool],
) -> None:
    """CMA-ES from the plan ``start`` (10, 4) [m] until the time ``until`` or ``found(plan, worth)`` is content.

    It is asked of every plan that is worth more than ``best`` and those before.
    """
    import cma

    step, seed, content = 2.0, 1 + options.seed, False
    while time.time() < until and not content:
        limits = np.tile(1e3 * BEND_LIMITS, NUM_KNOTS)
        settings = {"popsize": options.popsize, "seed": seed, "bounds": [-limits, limits], "verbose": -9}
        search = cma.CMAEvolutionStrategy(np.clip(1e3 * start.ravel(), -limits, limits), step, settings)
        search.inject([1e3 * start.ravel()], force=True)
        while not search.stop() and time.time() < until and not content:
            asked = search.ask()
            plans = 1e-3 * np.array(asked).reshape(-1, NUM_KNOTS, 4)
            worth = judge.worth(plans)
            search.tell(asked, list(np.nan_to_num(-worth, posinf=1e3)))
            if worth.max() > best:
                best, start = worth.max(), plans[worth.argmax()]
                content = found(start, best)
        seed, step = seed + 1, 1.5 * step


def case_name(options: argparse.Namespace) -> str:
    """What files of a case are called."""
    return f"{options.model}_{options.mass:g}kg_{'wall' if options.wall else 'no_wall'}"


def plan_of(path: Path) -> np.ndarray:
    """(10, 4) knots [m] of a sequence file; ValueError if it has none."""
    knots = np.array(read_strict(path).get("knots_m"), dtype=object)
    if knots.shape != (NUM_KNOTS, 4):
        raise ValueError(f"{path} holds no plan: knots_m of shape ({NUM_KNOTS}, 4) are needed")
    return knots.astype(float)


def search(options: argparse.Namespace) -> None:
    """Explore and then refine until the time is over, from what the files of the case hold."""
    name = case_name(options)
    params = {"cube_mass": options.mass, "wall_offset": 0.0 if options.wall else OUT_OF_REACH}
    task = TrunkLiftTask(num_envs=options.popsize, num_threads=1, model=options.model, action="continuous")
    archive_file, sequence_file = options.work / f"{name}.npz", options.out / f"{name}.json"
    archive = Archive.load(archive_file) if archive_file.exists() else Archive()
    explorer = Explorer(task, params, archive, np.random.default_rng([options.seed, len(archive)]))
    judge = Judge(task, params)
    starts = [*([options.start] if options.start else []), *([sequence_file] if is_there(sequence_file) else [])]
    known = [plan_of(path) for path in starts]
    for plan in [*known, None]:
        explorer.restart(plan)
    begin = saved = time.time()
    while (now := time.time()) < begin + 60 * options.minutes * options.explore:
        explorer.explore()
        if now > saved + 20:
            saved = now
            archive.save(archive_file)
            best = max(archive.rows["score"])
            print(f"{name} {now - begin:5.0f} s: {len(archive)} kinds of situation, best score {best:.2f}", flush=True)
    archive.save(archive_file)
    plans = np.concatenate([np.reshape(known, (-1, NUM_KNOTS, 4)), archive.best_plans(2 * options.popsize)])
    worth = judge.worth(plans)
    print(f"{name}: best of {len(plans)} known plans {worth.max():.2f} mm", flush=True)

    def found(plan: np.ndarray, value: float) -> bool:
        sequence = {"env_id": "TrunkLift-v0", "model": options.model, "action": "continuous", "mass_kg": options.mass,
                    "wall": options.wall, "params": params, **judge.describe(plan)}  # fmt: skip
        write_json(sequence_file, sequence)
        figures = {key: sequence[key] for key in ("elevation_held_mm", "lowest_corner_held_mm", "lean_end_deg")}
        print(f"{name} {time.time() - begin:5.0f} s: worth {value:.2f} mm, {figures}", flush=True)
        return figures["elevation_held_mm"] >= options.enough

    stored = -np.inf
    if is_there(sequence_file):  # only a better one takes its place; its actions count, since its knots are rounded
        before = read_strict(sequence_file)
        if before["elevation_held_mm"] >= options.enough:
            return
        stored = judge.worth_of(np.array(before["actions"], np.float32)[None])[0]
    refine(judge, plans[worth.argmax()], stored, options, begin + 60 * options.minutes, found)


def main() -> None:
    """Read the options and search."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mass", type=float, default=0.05, help="kg")
    parser.add_argument("--wall", action=argparse.BooleanOptionalAction, default=True, help="wall in reach")
    parser.add_argument("--model", choices=("cable", "flex"), default="cable")
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--explore", type=float, default=0.5, help="share of the time for exploration")
    parser.add_argument(
        "--enough", type=float, default=67.0, help="mm, elevation at which to stop; the goal is at 67.5"
    )
    parser.add_argument("--popsize", type=int, default=24, help="simulations at a time")
    parser.add_argument("--start", type=Path, help="sequence file to start from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/lift_search"), help="folder of the archives")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "lift_sequences")
    options = parser.parse_args()
    with plain_errors(parser.prog):
        search(options)


if __name__ == "__main__":
    main()
