"""What an inference found, as a file that training takes for a distribution and people can read; and which combinations
of parameters a recording determines."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.files import write_json
from soro_bench.inference.guard import Guard, finite
from soro_bench.parameters import Parameter
from soro_bench.randomization import Gaussian, TruncatedNormal

DETERMINED, VAGUE = 0.05, 0.3  # relative standard deviations below and above which the words change
MINOR = 0.15  # a parameter with a smaller part than this of the largest is left out of the words


@dataclass(frozen=True)
class Combination:
    """A product of powers of the parameters: exponents by name, and the relative standard deviation of the product."""

    exponents: dict[str, float]
    relative_std: float

    @property
    def words(self) -> str:
        """For people: "trunk_mass / young_modulus is determined to 0.1 %"."""
        if self.relative_std < DETERMINED:
            verdict = f"is determined to {_percent(self.relative_std)}"
        elif self.relative_std < VAGUE:
            verdict = f"is known only to {_percent(self.relative_std)}"
        else:
            verdict = "is not determined by this recording"
        return f"{_product(self.exponents)} {verdict}"

    def to_dict(self) -> dict[str, Any]:
        """As a posterior's file has it."""
        return {**asdict(self), "words": self.words}


def fisher(jacobian: Floats, deviation: Floats) -> Floats:
    """(d, d) information of a recording about the parameters: the sum over time of Jᵀ diag(deviation)⁻² J.

    Args:
        jacobian: (T, k, d) of what is measured; NaN says nothing, as where a replay beside the estimate diverged.
        deviation: (T, k) of the measurement; samples are taken for independent.
    """
    white = (jacobian / deviation[..., None]).reshape(-1, jacobian.shape[-1])
    white = np.where(np.isfinite(white), white, 0.0)
    return white.T @ white


def combinations(
    jacobian: Floats, deviation: Floats, parameters: Sequence[Parameter], values: Floats
) -> list[Combination]:
    """The eigenvectors of the Fisher information in the logarithms of the parameters, best determined first.

    What may be zero, such as the place of a wall, has no logarithm: it counts in widths of its search box.

    Args:
        jacobian: (T, k, d) of what is measured with respect to the parameters in their units.
        deviation: (T, k), in the same units as what is measured.
        parameters, values: of the estimate, (d,).
    """
    information = fisher(jacobian * scales(parameters, values), deviation)
    eigenvalues, vectors = np.linalg.eigh(information)
    found = []
    for value, vector in zip(eigenvalues[::-1], vectors.T[::-1], strict=True):
        vector = vector / vector[np.argmax(np.abs(vector))]
        exponents = {p.name: round(float(e), 3) for p, e in zip(parameters, vector, strict=True)}
        scale = float(np.linalg.norm(vector))
        std = scale / np.sqrt(value) if value > 0 else np.inf
        found.append(Combination(exponents, float(min(std, 1e6))))
    return found


def scales(parameters: Sequence[Parameter], values: Floats) -> Floats:
    """(d,) of what relative changes of the parameters are relative to: their values, or widths of search boxes."""
    boxes = np.array([p.search for p in parameters])
    return np.where((boxes[:, 0] <= 0) & (boxes[:, 1] >= 0), boxes[:, 1] - boxes[:, 0], values)


def _product(exponents: Mapping[str, float]) -> str:
    kept = {name: power for name, power in exponents.items() if abs(power) >= MINOR}
    over = [_power(name, power) for name, power in kept.items() if power > 0]
    under = [_power(name, -power) for name, power in kept.items() if power < 0]
    return " * ".join(over or ["1"]) + "".join(f" / {factor}" for factor in under)


def _power(name: str, power: float) -> str:
    return name if abs(power - 1) < 0.1 else f"{name}^{power:.2g}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


SCHEMA = "soro-bench/posterior/1"


@dataclass(frozen=True)
class Posterior:
    """A distribution over parameters and how it came about.

    Args:
        method: "rf-dropo", ...
        distribution: what domain randomisation samples from.
        estimate: the best single value of each parameter, SI units.
        fit: root mean square of measured less simulated at the estimate, by signal, in its unit.
        guard: what nominal parameters leave, bounds, and whether the model explains the recording.
        combinations: what the recording determines.
        known: values that were given.
        model: what the recording was replayed on.
        replay: fingerprint of what was replayed.
        replays: of the whole recording, the equivalent in time steps.
        settings: of the method.
    """

    method: str
    distribution: TruncatedNormal | Gaussian
    estimate: dict[str, float]
    fit: dict[str, float]
    guard: Guard
    combinations: list[Combination]
    known: dict[str, float]
    model: str
    replay: str
    replays: float
    settings: dict[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path) -> None:
        """Write JSON that :func:`soro_bench.randomization.load` reads as the distribution."""
        write_json(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """What the file holds."""
        return {
            "schema": SCHEMA,
            **self.distribution.to_dict(),
            "method": self.method,
            "estimate": self.estimate,
            "known": self.known,
            "fit": {name: finite(value) for name, value in self.fit.items()},
            **self.guard.to_dict(),
            "identifiability": [c.to_dict() for c in self.combinations],
            "model": self.model,
            "replay": self.replay,
            "replays": round(self.replays, 2),
            "settings": self.settings,
        }
