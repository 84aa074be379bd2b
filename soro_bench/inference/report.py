"""A posterior for people: a table in words, and a picture with the ridges."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.files import replacing
from soro_bench.inference.guard import noise_of, rms
from soro_bench.inference.posterior import Posterior, scales
from soro_bench.inference.replay import Replay
from soro_bench.markdown import table
from soro_bench.plotting import pyplot
from soro_bench.randomization import Gaussian, TruncatedNormal

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
    deviations = _deviations(posterior.distribution)
    rows = [
        (p.name, rounded(posterior.estimate[p.name], deviations[p.name]), f"{deviations[p.name]:.2g}", p.unit)
        for p in replay.parameters
    ]
    lines = [table(("parameter", "estimate", "standard deviation", "unit"), rows)]
    lines += ["", left("the estimate leaves", posterior.fit, replay), f"{posterior.replays:.0f} replays"]
    lines += [f"- {combination.words}" for combination in posterior.combinations]
    lines += [f"\n{warning}" for warning in warnings(posterior, replay)]
    lines += ["", f"{path}, {picture}; train on it with: soro-bench train ENV --randomization {path}"]
    return "\n".join(lines)


def _deviations(found: TruncatedNormal | Gaussian) -> dict[str, float]:
    """Of each parameter the standard deviation that the file has; draws are cut at two of them, and vary less."""
    values = np.sqrt(np.diag(found.cov)) if isinstance(found, Gaussian) else found.std
    return dict(zip(found.names, map(float, values), strict=True))


def left(what: str, values: Mapping[str, float], replay: Replay) -> str:
    """Such as "nominal parameters leave (rms of a coordinate): keypoints 8.72 mm", of values by signal in SI units."""
    return f"{what} (rms of a coordinate): " + ", ".join(
        f"{name} {_length(value, replay.units[name])}" for name, value in values.items()
    )


def nominal_words(replay: Replay) -> str:
    """What nominal parameters leave, in a line."""
    return left("nominal parameters leave", rms(replay, replay.nominal_residual), replay)


def rounded(value: float, deviation: float) -> str:
    """A number with the digits that its standard deviation leaves, two of which are uncertain; six at most."""
    if not deviation > 0.0 or value == 0.0:
        return f"{value:.4g}"
    digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(deviation)) + 2
    return f"{value:.{min(max(digits, 1), 6)}g}"


def warnings(posterior: Posterior, replay: Replay) -> list[str]:
    """What has to be known before the estimate is used, in sentences."""
    guard, noise, found = posterior.guard, noise_of(replay), []
    for name in guard.worse:
        nominal, estimate = (_length(values[name], replay.units[name]) for values in (guard.nominal, posterior.fit))
        found.append(f"Worse than nominal: of {name} the estimate leaves {estimate}, nominal parameters {nominal}. "
                     "Do not use it.")  # fmt: skip
    if guard.at_bounds:
        named = (f"{name} ({posterior.estimate[name]:.3g}, {end})" for name, end in guard.at_bounds.items())
        found.append(f"At a bound of the search box: {', '.join(named)}. The best value may lie beyond, or stand for "
                     "what the model lacks.")  # fmt: skip
    if guard.unexplained:
        least = (f"{_length(guard.misfit[name] * noise[name], replay.units[name])} of {name}, {guard.misfit[name]:.0f} "
                 "times the noise" for name in guard.unexplained)  # fmt: skip
        found.append(
            f"The model does not explain the recording: all parameters nearby leave {', '.join(least)}. The standard "
            f"deviations are {guard.widening:.2g} times those of noise, and of this model's best fit, not of the "
            "robot. Say --noise if the sensor is noisier, or ask soro-bench diagnose what the model lacks."
        )
    return found


def _length(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "a replay that diverges"
    return f"{1e3 * value:.3g} mm" if unit == "m" else f"{value:.3g} {unit}".removesuffix(" 1")


def corner_plot(posterior: Posterior, replay: Replay, draws: Floats, path: Path) -> None:
    """The distribution (dots) and, through its estimate, the combination that the recording determines least (line)."""
    plt = pyplot()
    names, count = replay.names, len(replay.names)
    estimate = np.array([posterior.estimate[name] for name in names])
    weakest = posterior.combinations[-1]
    along = np.array([weakest.exponents[name] for name in names])
    reach = min(weakest.relative_std, 0.5)
    wide = scales(replay.parameters, estimate)
    cloud, line = 100 * (draws - estimate) / wide, np.linspace(-reach, reach, 50)[:, None] * along  # percent
    ridge = 100 * np.where(wide == estimate, np.expm1(line), line)  # those that may be 0 have no logarithm
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
