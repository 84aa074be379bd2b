"""Draws reach_curves.png, push_curves.png, reach_distances.png and push_distances.png from the leaderboard's entries.

python docs/images/training.py
"""

from pathlib import Path

import numpy as np

from soro_bench.campaign.run import ENTRY
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.plots import curves_of
from soro_bench.plotting import pyplot

RESULTS = Path(__file__).parents[2] / "leaderboard" / "results"
ON_REACH = ("oracle", "rf_dropo", "bayes_sim", "bayes_sim_variance", "udr", "dr_box", "rf_dropo_cable", "oracle_flex")
ON_PUSH = ("oracle", "rf_dropo", "bayes_sim", "bayes_sim_variance", "udr", "dr_box", "rf_dropo_cable",
           "rf_dropo_unmodelled", "bayes_sim_unmodelled", "udr_unmodelled")  # fmt: skip


def curves(groups):
    """Thin lines of single trainings, and their medians."""
    figure, axes = pyplot().subplots(figsize=(6, 3.75), layout="constrained")
    for i, group in enumerate(groups):
        own = curves_of(group)
        for steps, final in own:
            axes.semilogy(steps, final, color=f"C{i}", alpha=0.3, lw=0.7)
        grid = max((steps for steps, _ in own), key=len)
        median = np.median([np.interp(grid, *curve) for curve in own], axis=0)
        axes.semilogy(grid, median, color=f"C{i}", lw=1.8, label=f"{group.name} ({len(own)} runs)")
    axes.set(xlabel="environment steps", ylabel="final distance in training [mm]")
    axes.set_yticks(ticks := (1, 2, 5, 10, 20, 50, 100), [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return figure


def distances(groups):
    """A panel for every model evaluated on, and in it a point for every final distance, and means."""
    labels = list(groups[0].labels)
    figure, panels = pyplot().subplots(1, len(labels), figsize=(9, 3.75), layout="constrained", sharey=True)
    rng, everything = np.random.default_rng(0), [group.scores(label) for group in groups for label in labels]
    for label, axes in zip(labels, panels, strict=True):
        for at, group in enumerate(groups):
            values = group.scores(label).ravel()
            size, alpha = (6, 0.4) if len(values) > 30 else (20, 0.7)
            axes.scatter(at + rng.uniform(-0.25, 0.25, len(values)), values, s=size, alpha=alpha, lw=0, color=f"C{at}")
            axes.plot([at - 0.35, at + 0.35], 2 * [values.mean()], color="black", lw=2)
        axes.set(title=f"on {label}", yscale="log")
        axes.set_yticks(ticks := (0.5, 1, 2, 5, 10, 20, 50, 100, 200), [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_ylim(0.9 * min(map(np.min, everything)), 1.1 * max(map(np.max, everything)))
        axes.set_xticks(range(len(groups)), [group.method for group in groups], rotation=30, ha="right")
        axes.grid(axis="y", alpha=0.3)
    panels[0].set(ylabel="final distance [mm]")
    return figure


def main():
    boards = gather_control(RESULTS)
    reach, push = (
        {group.method: group for group in boards[board] if group.entry == ENTRY}
        for board in ("TrunkReach-v0", "TrunkPush-v0")
    )
    for name, figure in (
        ("reach_curves", curves([reach["oracle"], reach["udr"]])),
        ("push_curves", curves([push["oracle"], push["udr"]])),
        ("reach_distances", distances([reach[method] for method in ON_REACH])),
        ("push_distances", distances([push[method] for method in ON_PUSH])),
    ):
        figure.savefig(Path(__file__).with_name(f"{name}.png"), dpi=160, metadata={"Software": None})


if __name__ == "__main__":
    main()
