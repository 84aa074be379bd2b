"""A posterior for people: a table in words, and a picture with the ridges."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.files import replacing
from soro_bench.inference.identifiability import scales
from soro_bench.inference.posterior import Posterior
from soro_bench.inference.replay import Replay
from soro_bench.markdown import table
from soro_bench.plotting import pyplot

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRAWN = 2000  # samples of the distribution


def write_report(posterior: Posterior, replay: Replay, path: str | Path) -> str:
    """Write a corner plot beside ``path`` (.png) and return the result in Markdown."""
    path = Path(path)
    rng = np.random.default_rng(0)
    drawn = [posterior.distribution.sample(rng) for _ in range(DRAWN)]
    draws = np.array([[d[name] for name in replay.names] for d in drawn])
    picture = path.with_suffix(".png")
    corner_plot(posterior, replay, draws, picture)
    rows = [
        (p.name, f"{posterior.estimate[p.name]:.6g}", f"{values.std():.2g}", p.unit)
        for p, values in zip(replay.parameters, draws.T, strict=True)
    ]
    lines = [table(("parameter", "estimate", "standard deviation", "unit"), rows)]
    fit = ", ".join(f"{name} {value:.3g}" for name, value in posterior.fit.items())
    lines += ["", f"left unexplained (root mean square, SI): {fit}", f"{posterior.replays:.0f} replays"]
    lines += [f"- {combination.words}" for combination in posterior.combinations]
    lines += ["", f"{path}, {picture}; train on it with: soro-bench train ENV --randomization {path}"]
    return "\n".join(lines)


def corner_plot(posterior: Posterior, replay: Replay, draws: Floats, path: Path) -> None:
    """The distribution (dots) and, through its estimate, the combination that the recording determines least (line)."""
    plt = pyplot()
    names, count = replay.names, len(replay.names)
    estimate = np.array([posterior.estimate[name] for name in names])
    weakest = posterior.combinations[-1]
    along = np.array([weakest.exponents[name] for name in names])
    reach = min(weakest.relative_std, 0.5)
    cloud = 100 * (draws - estimate) / scales(replay.parameters, estimate)  # percent
    ridge = 100 * np.expm1(np.linspace(-reach, reach, 50)[:, None] * along)
    labels = [f"{p.name}\n% from {e:.5g} {p.unit}" for p, e in zip(replay.parameters, estimate, strict=True)]
    figure, axes = plt.subplots(count, count, figsize=(2.4 * count, 2.4 * count), layout="constrained", squeeze=False)
    for i in range(count):
        for j in range(count):
            _panel(axes[i, j], cloud, ridge, i, j)
        axes[count - 1, i].set_xlabel(labels[i], fontsize=8)
        if i > 0:
            axes[i, 0].set_ylabel(labels[i], fontsize=8)
    figure.suptitle("least determined (red):\n" + weakest.words, fontsize=9)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130, metadata={"Software": None})
    plt.close(figure)


def _panel(ax: "Axes", cloud: Floats, ridge: Floats, i: int, j: int) -> None:
    """Parameter i over parameter j [percent]: draws (n, d), and a ridge (m, d)."""
    ax.tick_params(labelsize=7)
    if j > i:
        ax.axis("off")
    elif i == j:
        ax.hist(cloud[:, i], bins=40, color="C0", alpha=0.7)
        ax.axvline(0, color="k", lw=1)
        ax.set_yticks([])
    else:
        ax.plot(cloud[:, j], cloud[:, i], ",", color="C0", alpha=0.5)
        ax.plot(ridge[:, j], ridge[:, i], color="C3", lw=1)
        ax.plot(0, 0, "k+")
