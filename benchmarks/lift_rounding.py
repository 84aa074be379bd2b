"""How much the sequences of TrunkLift depend on the last bit (docs/archive/tasks_and_models.md).

    python benchmarks/lift_rounding.py --copies 20

Each sequence is replayed with objects whose masses differ in the twelfth digit.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from rich.progress import track

from soro_bench.leaderboard.strict import read_strict
from soro_bench.markdown import table
from soro_bench.packed import names

FOLDER = Path(__file__).parents[1] / "baselines" / "lift_sequences"  # or the archive beside it
SEQUENCES = [FOLDER / name for name in names(FOLDER)]
RECORDED = "elevation_held_mm", "elevation_end_mm", "lowest_corner_held_mm"  # in the files
TOLERANCE = 3.0  # mm
HELD_STEPS = 10  # as in baselines/lift_search.py


def copies(sequence: dict, count: int) -> np.ndarray:
    """(count, 3) what ``RECORDED`` is for objects lighter by 0, 1, 2 ... parts in 1e12; NaN where it diverges."""
    env = gymnasium.make(f"soro_bench:{sequence['env_id']}", model=sequence["model"], action=sequence["action"])
    return np.array([_replayed(env, sequence, 1e-12 * k) for k in range(count)])


def _replayed(env: gymnasium.Env, sequence: dict, lighter: float) -> list[float]:
    mass = sequence["params"]["cube_mass"] * (1 - lighter)
    env.reset(seed=0, options={"params": {**sequence["params"], "cube_mass": mass}})
    infos = [env.step(np.array(action, np.float32))[-1] for action in sequence["actions"]]
    if any(info["diverged"] for info in infos):
        return [np.nan] * len(RECORDED)
    elevation, clearance = (1e3 * np.array([info[key] for info in infos]) for key in ("elevation", "clearance"))
    return [elevation[-HELD_STEPS:].min(), elevation[-1], clearance[-HELD_STEPS:].min()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--copies", type=int, default=20)
    count = parser.parse_args().copies
    rows = []
    for path in track(SEQUENCES, "sequences"):
        sequence = read_strict(path)
        recorded, held = sequence[RECORDED[0]], copies(sequence, count)[:, 0]
        share = np.mean(np.abs(held - recorded) < TOLERANCE)
        figures = (f"{value:.1f}" for value in (recorded, np.median(held), held.min()))
        rows.append((path.stem, *figures, f"{share:.0%}"))
    print(table(("sequence", "recorded [mm]", "median", "least", "within 3 mm"), rows))


if __name__ == "__main__":
    main()
