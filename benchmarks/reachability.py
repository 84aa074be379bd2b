"""How near a planner brings the tip to each of the 27 evaluation goals of TrunkReach.

    python benchmarks/reachability.py --model cable --minutes 25
    python benchmarks/reachability.py --model flex --minutes 25      # starts from the plans for cable

Searches open-loop plans (reach_planner.py) for all goals at once, saves one JSON file per goal after every
improvement and goes on from these files. Prints a table and writes docs/results/measured.json and, of every
model searched so far, docs/images/reachability.png.
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.reach_planner import ReachPlan, ReachPlanner
from soro_bench.envs.trunk_reach import EVALUATION_GOALS, TrunkReachTask
from soro_bench.files import read_json, replacing, write_json
from soro_bench.markdown import table
from soro_bench.models.trunk import VARIANTS
from soro_bench.plotting import pyplot
from soro_bench.sources import SIMULATION, claim, version_of

ROOT = Path(__file__).parents[1]
RANDOM_MOVES = {"cable": 512, "flex": 0}  # flex starts from the plans for cable
POPSIZE = {"cable": 12, "flex": 8}
SIMULATIONS = 54  # at a time


def plan_file(work: Path, model: str, goal: int) -> Path:
    return work / model / f"goal{goal:02d}.json"


def save_plan(path: Path, plan: ReachPlan) -> None:
    data = {
        "goal_m": plan.goal.tolist(),
        "final_mm": 1e3 * plan.final,
        "closest_mm": 1e3 * plan.closest,
        "rollouts": plan.rollouts,
        "due_steps": list(plan.due),
        "knots_m": plan.found.tolist(),
    }
    write_json(path, data)


def load_knots(path: Path) -> tuple[np.ndarray, tuple[int, ...], int] | None:
    """The knots (k, 8) [m] of a plan, their steps and the rollouts spent, or None."""
    if not path.exists():
        return None
    data = read_json(path)
    return np.array(data["knots_m"]), tuple(data["due_steps"]), data["rollouts"]


def start(planner: ReachPlanner, goals: Sequence[int], model: str, work: Path) -> None:
    """Give the planner what earlier runs found: this model's plans, else cable's, else random moves."""
    earlier = {}
    for source in (model, "cable"):
        for i, g in enumerate(goals):
            if i not in earlier and (found := load_knots(plan_file(work, source, g))):
                earlier[i] = found
                if source == model:
                    planner.plans[i].rollouts = found[2]
    for due in sorted({found[1] for found in earlier.values()}):
        planner.try_knots(np.array([found[0] for found in earlier.values() if found[1] == due]), due)
    if len(earlier) < len(goals):
        planner.try_random(max(RANDOM_MOVES[model], 64))


def search(options: argparse.Namespace) -> None:
    goals = options.goals
    task = TrunkReachTask(num_envs=SIMULATIONS, num_threads=1, model=options.model, action="continuous")
    planner = ReachPlanner(task, EVALUATION_GOALS[goals], POPSIZE[options.model], options.seed)
    begin = time.time()
    start(planner, goals, options.model, options.work)
    saved: dict[int, tuple[float, int]] = {}

    def save() -> None:
        for g, plan in zip(goals, planner.plans, strict=True):
            if saved.get(g) != (plan.final, plan.rollouts):
                saved[g] = plan.final, plan.rollouts
                save_plan(plan_file(options.work, options.model, g), plan)

    save()
    cheap = TrunkReachTask(num_envs=SIMULATIONS, num_threads=1, model="cable", action="continuous")
    for left in itertools.chain(planner.correct(cheap), planner.improve()):
        save()
        final = 1e3 * np.array([plan.final for plan in planner.plans])
        print(f"{options.model} {time.time() - begin:5.0f} s: {left} goals beyond 1 mm, mean {final.mean():.2f} mm, "
              f"worst {final.max():.2f} mm", flush=True)  # fmt: skip
        if time.time() > begin + 60 * options.minutes:
            break


def collect(options: argparse.Namespace) -> dict:
    """The plans of all goals in one dict."""
    plans = [read_json(path) for path in sorted((options.work / options.model).glob("goal*.json"))]
    final = np.array([plan["final_mm"] for plan in plans])
    return {
        "env_id": "TrunkReach-v0",
        "model": options.model,
        "action": "continuous",
        "mujoco": mujoco.__version__,
        "mean_final_mm": final.mean(),
        "min_final_mm": final.min(),
        "max_final_mm": final.max(),
        "solved": int((final <= 1).sum()),
        "plans": plans,
    }


def print_table(result: dict) -> None:
    rows = []
    for plan in result["plans"]:
        goal = ", ".join(f"{1e3 * x:g}" for x in plan["goal_m"])
        kind = "move and hold" if len(plan["due_steps"]) == 2 else "swing"
        rows.append((goal, f"{plan['final_mm']:.2f}", kind, plan["rollouts"]))
    print(table(("goal x, y, z [mm]", "best final distance [mm]", "plan", "rollouts"), rows))
    print(f"mean {result['mean_final_mm']:.2f}, min {result['min_final_mm']:.2f}, max {result['max_final_mm']:.2f} mm; "
          f"{result['solved']} of {len(result['plans'])} within 1 mm")  # fmt: skip


def plot(results: Path, path: Path) -> None:
    """Final distance per goal, one row of bars per model."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(11, 3.6), layout="constrained")
    models = read_json(results)["reachability"]
    found = [models[model] for model in VARIANTS if model in models]
    for i, result in enumerate(found):
        x = np.arange(len(result["plans"])) + (i - (len(found) - 1) / 2) * 0.4
        axes.bar(x, [plan["final_mm"] for plan in result["plans"]], 0.38, label=f"{result['model']} model")
    labels = ["\n".join(f"{1e3 * c:g}" for c in plan["goal_m"]) for plan in found[0]["plans"]]
    axes.set_xticks(range(len(labels)), labels, fontsize=7)
    axes.axhline(1.0, color="black", linewidth=0.8, linestyle="--", label="success, 1 mm")
    axes.set(xlabel="goal x, y, z [mm]", ylabel="best final distance [mm]", title="TrunkReach: what a planner reaches")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=tuple(VARIANTS), default="cable")
    parser.add_argument("--goals", type=int, nargs="+", default=list(range(len(EVALUATION_GOALS))), help="0 to 26")
    parser.add_argument("--minutes", type=float, default=25)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/reachability"), help="folder of the plans per goal")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    options = parser.parse_args()
    claim(options.work / "sources.txt", version_of(SIMULATION))
    search(options)
    result = collect(options)
    print_table(result)
    if len(result["plans"]) < len(EVALUATION_GOALS):
        return  # to be published when all are there
    results = options.docs / "results" / "measured.json"
    measured = read_json(results)
    measured["reachability"][options.model] = result
    write_json(results, measured)
    plot(results, options.docs / "images" / "reachability.png")


if __name__ == "__main__":
    main()
