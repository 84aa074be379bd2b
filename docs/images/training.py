"""Draws reach_curves.png, push_curves.png and reach_distances.png from the leaderboard's entries.

python docs/images/training.py
"""

from pathlib import Path

import numpy as np

from soro_bench.campaign.run import ENTRY
from soro_bench.leaderboard.gather import gather_control
from soro_bench.leaderboard.plots import curves_of
from soro_bench.report import pyplot

RESULTS = Path(__file__).parents[2] / "leaderboard" / "results"


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
    """A point for every final distance, and means."""
    figure, axes = pyplot().subplots(figsize=(6, 3.75), layout="constrained")
    rng, names = np.random.default_rng(0), []
    for group in groups:
        for label in group.labels:
            values, at = group.scores(label).ravel(), len(names)
            axes.scatter(at + rng.uniform(-0.2, 0.2, len(values)), values, s=8, alpha=0.5, lw=0, color=f"C{at}")
            axes.plot([at - 0.3, at + 0.3], 2 * [values.mean()], color="black", lw=2)
            names.append(f"{group.name}\non {label}")
    axes.set(ylabel="final distance [mm]", ylim=(0, None))
    axes.set_xticks(range(len(names)), names)
    axes.grid(axis="y", alpha=0.3)
    return figure


def main():
    boards = gather_control(RESULTS)
    reach, push = (
        [group for group in boards[board] if group.entry == ENTRY and group.method in ("oracle", "udr")]
        for board in ("TrunkReach-v0", "TrunkPush-v0")
    )
    for name, figure in (
        ("reach_curves", curves(reach)),
        ("push_curves", curves(push)),
        ("reach_distances", distances(reach)),
    ):
        figure.savefig(Path(__file__).with_name(f"{name}.png"), dpi=160, metadata={"Software": None})


if __name__ == "__main__":
    main()
