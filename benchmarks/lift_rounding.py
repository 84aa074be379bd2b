"""How much the sequences of TrunkLift depend on the last bit: a table in docs/lift.md.

    python benchmarks/lift_rounding.py --copies 20

Each sequence is replayed with objects whose masses differ in the twelfth digit.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from rich.progress import track

import soro_bench  # noqa: F401  registers the environments
from soro_bench.files import read_json

SEQUENCES = Path(__file__).parents[1] / "baselines" / "lift_sequences"
HELD_STEPS = 10  # as in baselines/lift_search.py


def elevation_held(sequence, lighter):
    """Elevation [mm] held to the end of an object whose mass is less by the share ``lighter``."""
    env = gymnasium.make(sequence["env_id"], model=sequence["model"], action=sequence["action"])
    mass = sequence["params"]["cube_mass"] * (1 - lighter)
    env.reset(seed=0, options={"params": {**sequence["params"], "cube_mass": mass}})
    infos = [env.step(np.array(action, np.float32))[-1] for action in sequence["actions"]]
    return 1e3 * min(info["elevation"] for info in infos[-HELD_STEPS:])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--copies", type=int, default=20)
    copies = parser.parse_args().copies
    rows = []
    for path in track(sorted(SEQUENCES.glob("*.json")), "sequences"):
        sequence = read_json(path)
        held = np.array([elevation_held(sequence, 1e-12 * k) for k in range(copies)])
        recorded = sequence["elevation_held_mm"]
        share = np.mean(np.abs(held - recorded) < 3)
        rows.append(f"| {path.stem} | {recorded:.1f} | {np.median(held):.1f} | {held.min():.1f} | {share:.0%} |")
    print("| sequence | recorded [mm] | median | least | within 3 mm |\n|---|---|---|---|---|", *rows, sep="\n")


if __name__ == "__main__":
    main()
