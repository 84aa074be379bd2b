"""Whether policies of TrunkLift use the wall: what they reach where it stands elsewhere, or is out of reach.

    python benchmarks/lift_walls.py [--model cable]

Plays the entries of both boards with the wall moved, and prints the elevation of the object at the end of an episode,
mean over the seeds [mm].
"""

import argparse
from pathlib import Path

import numpy as np

from soro_bench.evaluation import evaluate
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.entry import entries_of, load_policy
from soro_bench.markdown import header, row
from soro_bench.packed import folder_of
from soro_bench.policies.policy import TrainedPolicy
from soro_bench.registration import task_type

RESULTS = Path(__file__).parents[1] / "leaderboard" / "results"
BOTH = ("TrunkLift-v0-100g", "TrunkLift-v0-50g")
OFFSETS = (-0.03, -0.015, 0.0, 0.015, 0.03, -0.2)  # m; randomised within +-0.03, out of reach at -0.2


def elevations(policy: TrainedPolicy, board: str, model: str) -> list[float]:
    """Final elevation [mm] for each place of the wall."""
    starts = [{"params": {**BOARDS[board].fixed, "wall_offset": offset}} for offset in OFFSETS]
    episodes = evaluate(policy.act, BOARDS[board].env_id, model, policy.card.action, starts)
    return [1e3 * float(episode.metric[-1]) for episode in episodes]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default=task_type("TrunkLift-v0").cheap)
    options = parser.parse_args()
    places = [f"{1e3 * offset:+.0f}" for offset in OFFSETS[:-1]] + ["out of reach"]
    print(header(("board", "trained", *places)))
    for board in BOTH:
        for archive in sorted((RESULTS / board / "ppo").glob("*.zip")):
            folder = folder_of(archive)
            policies = [load_policy(path) for path in entries_of(folder)]
            rows = np.array([elevations(policy, board, options.model) for policy in policies])
            print(row((board, folder.name, *(f"{mean:.1f}" for mean in rows.mean(axis=0)))))


if __name__ == "__main__":
    main()
