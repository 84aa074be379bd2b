"""Is the posterior of BayesSim calibrated?

    python benchmarks/bayes_sim_calibration.py --model cable

Trains on 1,000 simulations of the committed recording's actions, with both kinds of features, and checks the posterior
on 100 others by simulation-based calibration and TARP (sbi). Prints p-values; small ones mean no calibration.
Writes docs/results/measured.json.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from sbi.diagnostics import check_sbc, check_tarp, run_sbc, run_tarp

from soro_bench.assets import asset_path
from soro_bench.files import read_json, write_json
from soro_bench.inference import bayes_sim
from soro_bench.inference.replay import Replay
from soro_bench.markdown import header, row
from soro_bench.recording.parquet import load

ROOT = Path(__file__).parents[1]
CHECK_SAMPLES = 500  # of the posterior, for each simulation that it is checked on


def calibration(estimator: bayes_sim.Estimator, points: np.ndarray, summaries: np.ndarray, seed: int = 0) -> dict:
    """Simulation-based checks of the posterior on other simulations, by sbi.

    Args:
        points: (n, d) of the unit cube, drawn uniformly.
        summaries: (n, m) of what was simulated there.

    Returns:
        p-values: "sbc", one per parameter, of the ranks of the true values among the posterior's samples being uniform
        (Talts et al., 2018), and "tarp", one, of the expected coverage being nominal (Lemos et al., ICML 2023).
    """
    torch.manual_seed(seed)
    theta = torch.as_tensor(points, dtype=torch.float32)
    x = torch.as_tensor((summaries - estimator.center) / estimator.scale, dtype=torch.float32)
    quiet = {"show_progress_bar": False}
    ranks, averaged = run_sbc(theta, x, estimator.posterior, CHECK_SAMPLES, **quiet)
    sbc = check_sbc(ranks, theta, averaged, CHECK_SAMPLES)["ks_pvals"]
    coverage, nominal = run_tarp(theta, x, estimator.posterior, num_posterior_samples=CHECK_SAMPLES, **quiet)
    return {"sbc": [float(p) for p in sbc], "tarp": [float(check_tarp(coverage, nominal)[1])]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=["TrunkReach-v0", "TrunkPush-v0"])
    parser.add_argument("--model", default="cable")
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--checks", type=int, default=100)
    options = parser.parse_args()
    rows = []
    print(header(("environment", "features", "SBC, p per parameter", "TARP, p")))
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
            found = calibration(estimator, points[train:], summaries[train:])
            rows.append({"env_id": env_id, "model": options.model, "features": features,
                         "parameters": list(replay.names), **found})  # fmt: skip
            cells = ", ".join(f"{name} {p:.2g}" for name, p in zip(replay.names, found["sbc"], strict=True))
            print(row((env_id, features, cells, f"{found['tarp'][0]:.2g}")), flush=True)
    path = ROOT / "docs" / "results" / "measured.json"
    every = read_json(path)
    every["bayes_sim_calibration"][options.model] = rows
    write_json(path, every)


if __name__ == "__main__":
    main()
