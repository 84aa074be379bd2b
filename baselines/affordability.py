"""Affordability, the second claim of the published study: train MultiGait on the cheap mesh, test on the fine one.

    python baselines/affordability.py

Trains PPO on the coarse mesh with and without domain randomisation, for episodes of 6 and 12 steps, three seeds each;
evaluates every policy on both meshes, with and without observation noise (five rollouts with noise), and writes
results.json, results.md and displacements.png into --out. An interrupted run goes on from its last checkpoint.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import Progress

from soro_bench.envs.multigait import PUBLISHED_RANDOMIZATION
from soro_bench.experiment import Method, run_method, write_evaluation
from soro_bench.files import read_json, replacing, write_json
from soro_bench.report import pyplot
from soro_bench.results import interval
from soro_bench.training.policy import Policy
from soro_bench.training.ppo import default_config

ENV_ID = "MultiGait-v0"
METHODS = (
    Method("no_dr", lambda env_id, seed, folder: None),
    Method("dr", lambda env_id, seed, folder: PUBLISHED_RANDOMIZATION),
)
EPISODE_STEPS = (6, 12)
MESHES = ("coarse", "fine")
NOISY_ROLLOUTS = 5


def evaluations(folder: Path, steps: int) -> list[dict]:
    """Results of the policy in ``folder`` on both meshes, without and with noise; those that are there are read."""
    policy, results = Policy.load(folder), []
    for mesh in MESHES:
        for noise, starts in ((False, [{}]), (True, [{}] * NOISY_ROLLOUTS)):
            label = f"{mesh}_noise" if noise else mesh
            path = folder / f"evaluation_{label}.json"
            if not path.exists():
                write_evaluation(policy, mesh, folder, label, starts=starts, max_episode_steps=steps,
                                 observation_noise=noise)  # fmt: skip
            results.append({**read_json(path), "episode_steps": steps})
    return results


def rows_of(results) -> list[dict]:
    """Mean displacement and 95 % bootstrap interval per episode length, method and evaluation."""
    rows = []
    for steps in EPISODE_STEPS:
        for method in METHODS:
            for label in [f"{mesh}{noise}" for mesh in MESHES for noise in ("", "_noise")]:
                cell = [r["final_displacement_mm"] for r in results if r["episode_steps"] == steps
                        and r["policy"]["method"] == method.name and r["evaluated_on"] == label]  # fmt: skip
                if cell:
                    mean, low, high = interval(cell)
                    rows.append({"episode_steps": steps, "method": method.name, "evaluated_on": label,
                                 "seeds": len(cell), "mean": mean, "low": low, "high": high})  # fmt: skip
    return rows


def write_tables(results, out: Path) -> None:
    """results.json, results.md and displacements.png."""
    rows = rows_of(results)
    lines = ["| episode [steps] | method | evaluated on | seeds | displacement [mm], 95 % interval |", "|" + "---|" * 5]
    for row in rows:
        figures = f"{row['mean']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"
        lines.append(
            f"| {row['episode_steps']} | {row['method']} | {row['evaluated_on']} | {row['seeds']} | {figures} |"
        )
    with replacing(out / "results.md") as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    write_json(out / "results.json", results)
    plot(rows, out / "displacements.png")


def plot(rows, path: Path) -> None:
    """Bars like the paper's figure: with and without randomisation, on both meshes, with and without noise."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(EPISODE_STEPS), figsize=(9, 3.6), layout="constrained", sharey=True)
    labels = [f"{mesh}{noise}" for mesh in MESHES for noise in ("", "_noise")]
    for ax, steps in zip(axes, EPISODE_STEPS, strict=True):
        for m, method in enumerate(METHODS):
            cells = {row["evaluated_on"]: row for row in rows
                     if row["episode_steps"] == steps and row["method"] == method.name}  # fmt: skip
            x = [i + 0.36 * m - 0.18 for i, label in enumerate(labels) if label in cells]
            values = np.array([
                [cells[label][k] for k in ("mean", "low", "high")] for label in labels if label in cells
            ])
            if len(values):
                error = np.abs(values[:, 1:] - values[:, :1]).T
                ax.bar(x, values[:, 0], width=0.34, yerr=error, capsize=3, label=method.name)
        ax.set_xticks(range(len(labels)), [label.replace("_", "\n") for label in labels])
        ax.set(title=f"{steps} steps")
        ax.grid(alpha=0.3, axis="y")
    axes[0].set_ylabel("displacement [mm]")
    axes[0].legend(frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, help="environment steps per policy")
    parser.add_argument("--out", type=Path, default=Path("runs/affordability"))
    options = parser.parse_args()
    results = []
    with Progress() as progress:
        for steps in EPISODE_STEPS:
            config = replace(default_config(ENV_ID, options.steps), episode_steps=steps)
            for method in METHODS:
                folder = options.out / f"{steps}_steps"
                bar = progress.add_task(f"{steps} steps, {method.name}", total=len(options.seeds) * config.total_steps)

                def report(label, done, total, row, bar=bar):
                    seed = options.seeds.index(int(label.split()[-1]))
                    progress.update(bar, completed=seed * total + done, total=len(options.seeds) * total)

                run_method(method, config, options.seeds, (), folder, report)
                for seed in options.seeds:
                    results += evaluations(folder / method.name / f"seed{seed}", steps)
    write_tables(results, options.out)


if __name__ == "__main__":
    main()
