"""Is the posterior of BayesSim calibrated?

    python benchmarks/bayes_sim_calibration.py --model cable

Trains on 1,000 simulations of the committed recording's actions, with both kinds of features, and checks the posterior
on 100 others by simulation-based calibration and TARP (sbi). Prints p-values; small ones mean no calibration.
Writes docs/results/bayes_sim_calibration_<model>.json.
"""

import argparse
from pathlib import Path

import numpy as np

from soro_bench.assets import asset_path
from soro_bench.files import write_json
from soro_bench.inference import bayes_sim
from soro_bench.inference.replay import Replay
from soro_bench.recording.parquet import load

ROOT = Path(__file__).parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=["TrunkReach-v0", "TrunkPush-v0"])
    parser.add_argument("--model", default="cable")
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--checks", type=int, default=100)
    options = parser.parse_args()
    rows = []
    print("| environment | features | SBC, p per parameter | TARP, p |\n|---|---|---|---|")
    for env_id in options.envs:
        replay = Replay(load(asset_path(f"recordings/{env_id}.parquet")), model=options.model)
        low, high = np.array([p.search for p in replay.parameters]).T
        points = np.random.default_rng(0).random((options.simulations + options.checks, len(low)))
        signals = replay.simulate(low + points * (high - low))
        sane = np.isfinite(signals).all(axis=(1, 2))
        summaries = bayes_sim.summarise(signals[sane], replay.actions)
        points, train = points[sane], sane[: options.simulations].sum()
        for features in bayes_sim.FEATURES:
            estimator = bayes_sim.train(points[:train], summaries[:train], features)
            found = bayes_sim.calibration(estimator, points[train:], summaries[train:])
            rows.append({"env_id": env_id, "model": options.model, "features": features,
                         "parameters": list(replay.names), **found})  # fmt: skip
            cells = ", ".join(f"{name} {p:.2g}" for name, p in zip(replay.names, found["sbc"], strict=True))
            print(f"| {env_id} | {features} | {cells} | {found['tarp'][0]:.2g} |", flush=True)
    write_json(ROOT / "docs" / "results" / f"bayes_sim_calibration_{options.model}.json", rows)


if __name__ == "__main__":
    main()
