"""How well the methods recover the parameters behind a recording.

    python benchmarks/inference_recovery.py [--only reach push ...] [--model flex]

Three 5 s recordings per task, simulated with nominal parameters: TrunkReach under random discrete actions, TrunkPush
under the three oracle policies of the leaderboard. Every inference is a file in --work, and the same command goes on
with what is missing. Writes docs/results/measured.json and prints a table of the worst errors.

    python benchmarks/inference_recovery.py --calibration --model cable

Is the posterior of BayesSim calibrated? Trains on 1,000 simulations of the committed recording's actions, with both
kinds of features, and checks the posterior on 100 others by simulation-based calibration and TARP (sbi). Prints
p-values; small ones mean no calibration.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.files import asset_path, read_json, write_json
from soro_bench.inference import bayes_sim
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import Replay
from soro_bench.markdown import header, table
from soro_bench.markdown import row as markdown_row
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.recording.parquet import load
from soro_bench.recording.recording import Recording
from soro_bench.recording.simulated import record
from soro_bench.registration import task_type
from soro_bench.sources import SIMULATION, claim, version_of

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "measured.json"
POLICIES = ROOT / "leaderboard" / "results" / "TrunkPush-v0" / "ppo" / "oracle"
REACH, PUSH = "TrunkReach-v0", "TrunkPush-v0"
E_WRONG = {"young_modulus": 0.8 * ALL_PARAMETERS["young_modulus"].nominal}
CHECK_SAMPLES = 500  # of the posterior, for each simulation that it is checked on
SAMPLED = {"optimizer": "sampled", "iterations": 100, "samples": 20}
# name: environment, method, what differs
CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "reach": (REACH, "rf-dropo", {}),
    "push": (PUSH, "rf-dropo", {}),
    "push_unmodelled": (PUSH, "rf-dropo", {"known": E_WRONG}),
    "push_unmodelled_cables_too": (PUSH, "rf-dropo", {"known": E_WRONG, "also": ("cable_stiffness",)}),
    "reach_noise": (REACH, "rf-dropo", {"noise": 5e-4}),
    "push_noise": (PUSH, "rf-dropo", {"noise": 5e-4}),
    # the published search, with a fifth of its samples and iterations
    "reach_noise_sampled": (REACH, "rf-dropo", {"noise": 5e-4, "settings": SAMPLED}),
    "reach_cable": (REACH, "rf-dropo", {"model": "cable"}),
    "push_cable": (PUSH, "rf-dropo", {"model": "cable"}),
    "reach_droid": (REACH, "droid", {}),
    # from the middle of the search box: the truth of these recordings is nominal
    "reach_sysid": (REACH, "sysid", {"settings": {"start": 0.5}}),
    "push_sysid": (PUSH, "sysid", {"settings": {"start": 0.5}}),
    "reach_dropo": (REACH, "dropo", {}),
    "push_dropo": (PUSH, "dropo", {}),
    "reach_bayes_sim_mdn": (REACH, "bayes-sim", {"settings": {"features": "mdn"}}),
    "push_bayes_sim_mdn": (PUSH, "bayes-sim", {"settings": {"features": "mdn"}}),
    "reach_bayes_sim_mdrff": (REACH, "bayes-sim", {"settings": {"features": "mdrff"}}),
    "push_bayes_sim_mdrff": (PUSH, "bayes-sim", {"settings": {"features": "mdrff"}}),
}
RUNS = ((0, 0), (1, 0), (2, 0))  # recording, seed of the inference
MORE_SEEDS = ((0, 1), (0, 2))  # of the two main cases


def recording_of(env_id: str, number: int, noise: float, model: str) -> Recording:
    """The recording of that number, with its full state."""
    if env_id == REACH:
        return record(env_id, "random", model, "discrete", seed=number, noise=noise, full_state=True)
    return record(env_id, str(POLICIES / f"seed{number}.json"), model, seed=number, noise=noise, full_state=True)


def run(case: str, number: int, seed: int, work: Path, model: str, threads: int) -> dict:
    """One inference; its result is kept in a file."""
    path = work / model / case / f"recording{number}_seed{seed}.json"
    if path.exists():
        return read_json(path)
    env_id, method, change = CASES[case]
    noise = change.get("noise", 0.0)
    names = [p.name for p in task_type(env_id).randomized] + list(change.get("also", ()))
    names = [name for name in names if name not in change.get("known", {})]
    replay = Replay(
        recording_of(env_id, number, noise, model), names, change.get("known"), change.get("model"), noise,
        restart=method == "dropo", threads=threads,
    )  # fmt: skip
    start = time.process_time()  # of the whole inference: one that was interrupted begins anew
    posterior = infer(method, replay, None, seed, **change.get("settings", {}))
    write_json(path, {**posterior.to_dict(), "cpu_s": round(time.process_time() - start, 1)})
    return read_json(path)


def row(case: str, results: list[dict]) -> dict:
    """Errors of the runs of one case."""
    estimates = [{**r["known"], **r["estimate"]} for r in results]

    def ratio(a: str, b: str) -> list[float]:
        nominal = ALL_PARAMETERS[a].nominal / ALL_PARAMETERS[b].nominal
        return [e[a] / e[b] / nominal - 1 for e in estimates]

    def difference(a: str) -> list[float]:
        return [e[a] - ALL_PARAMETERS[a].nominal for e in estimates]

    errors = {"mass_over_E": ratio("trunk_mass", "young_modulus"), "poisson_ratio": difference("poisson_ratio")}
    errors["trunk_mass"] = [e["trunk_mass"] / ALL_PARAMETERS["trunk_mass"].nominal - 1 for e in estimates]
    if "cube_mass" in estimates[0]:
        errors["friction"] = difference("friction")
        errors["cube_over_trunk"] = ratio("cube_mass", "trunk_mass")
    return {
        "case": case,
        "runs": len(results),
        "worst": {name: max(values, key=abs) for name, values in errors.items()},
        "median_absolute": {name: float(np.median(np.abs(values))) for name, values in errors.items()},
        "keypoints_rms_mm": [round(1e3 * r["fit"]["keypoints"], 4) for r in results],
        "cpu_s": [r["cpu_s"] for r in results],
        "replays": [r["replays"] for r in results],
    }


def worst(results: list[dict]) -> str:
    """Markdown: the worst run of each case."""
    names = ("mass_over_E", "poisson_ratio", "friction", "cube_over_trunk", "trunk_mass")
    heads = ("case", "runs", "mass/E", "nu", "friction", "cube/trunk mass", "trunk mass", "left [mm]", "CPU-s")
    rows = []
    for r in results:
        cells = [f"{r['worst'][n]:+.3g}" if n in r["worst"] else "" for n in names]
        left = f"{max(r['keypoints_rms_mm']):.3g}"
        rows.append((r["case"], r["runs"], *cells, left, f"{np.median(r['cpu_s']):.0f}"))
    return table(heads, rows)


def calibration(estimator: "bayes_sim.Estimator", points: np.ndarray, summaries: np.ndarray, seed: int = 0) -> dict:
    """Simulation-based checks of the posterior on other simulations, by sbi.

    Args:
        points: (n, d) of the unit cube, drawn uniformly.
        summaries: (n, m) of what was simulated there.

    Returns:
        p-values: "sbc", one per parameter, of the ranks of the true values among the posterior's samples being uniform
        (Talts et al., 2018), and "tarp", one, of the expected coverage being nominal (Lemos et al., ICML 2023).
    """
    import torch
    from sbi.diagnostics import check_sbc, check_tarp, run_sbc, run_tarp

    torch.manual_seed(seed)
    theta = torch.as_tensor(points, dtype=torch.float32)
    x = torch.as_tensor((summaries - estimator.center) / estimator.scale, dtype=torch.float32)
    quiet = {"show_progress_bar": False}
    ranks, averaged = run_sbc(theta, x, estimator.posterior, CHECK_SAMPLES, **quiet)
    sbc = check_sbc(ranks, theta, averaged, CHECK_SAMPLES)["ks_pvals"]
    coverage, nominal = run_tarp(theta, x, estimator.posterior, num_posterior_samples=CHECK_SAMPLES, **quiet)
    return {"sbc": [float(p) for p in sbc], "tarp": [float(check_tarp(coverage, nominal)[1])]}


def check_calibration(model: str, simulations: int = 1000, checks: int = 100) -> None:
    """Print p-values of BayesSim's posterior on recordings of two environments, and keep them."""
    rows = []
    print(header(("environment", "features", "SBC, p per parameter", "TARP, p")))
    for env_id in (REACH, PUSH):
        replay = Replay(load(asset_path(f"recordings/{env_id}.parquet")), model=model)
        low, high = np.array([p.search for p in replay.parameters]).T
        points = np.random.default_rng(0).random((simulations + checks, len(low)))
        signals = replay.simulate(low + points * (high - low))
        sane = np.asarray(np.isfinite(signals).all(axis=(1, 2)))
        summaries = bayes_sim.summarise(signals[sane], replay.actions)
        points, train = points[sane], sane[:simulations].sum()
        for features in bayes_sim.FEATURES:
            estimator = bayes_sim.train(points[:train], summaries[:train], features)
            found = calibration(estimator, points[train:], summaries[train:])
            rows.append({"env_id": env_id, "model": model, "features": features,
                         "parameters": list(replay.names), **found})  # fmt: skip
            cells = ", ".join(f"{name} {p:.2g}" for name, p in zip(replay.names, found["sbc"], strict=True))
            print(markdown_row((env_id, features, cells, f"{found['tarp'][0]:.2g}")), flush=True)
    every = read_json(RESULTS)
    every["bayes_sim_calibration"][model] = rows
    write_json(RESULTS, every)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--model", default="flex", help="of the recordings, and of the inference where it is the same")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "inference")
    parser.add_argument("--calibration", action="store_true", help="of BayesSim, instead")
    options = parser.parse_args()
    if options.calibration:
        check_calibration(options.model)
        return
    claim(options.work / "sources.txt", version_of((*SIMULATION, "inference/*.py")))
    rows = []
    for i, case in enumerate(options.only):
        results = []
        for number, seed in RUNS + (MORE_SEEDS if case in ("reach", "push") else ()):
            print(f"case {i + 1} of {len(options.only)}: {case}, recording {number}, seed {seed}", flush=True)
            results.append(run(case, number, seed, options.work, options.model, options.threads))
        rows.append(row(case, results))
        every = read_json(RESULTS)
        models = every["inference"]
        others = [r for r in models.get(options.model, []) if r["case"] != case]
        models[options.model] = sorted([*others, rows[-1]], key=lambda r: list(CASES).index(r["case"]))
        write_json(RESULTS, every)
        print(worst(rows[-1:]), flush=True)
    print(worst(rows))


if __name__ == "__main__":
    main()
