"""What an inference found, as a file that training takes for a distribution and people can read."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from soro_bench.files import write_json
from soro_bench.inference.guard import Guard
from soro_bench.inference.identifiability import Combination
from soro_bench.randomization import Distribution

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
    distribution: Distribution
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
            "fit": self.fit,
            **self.guard.to_dict(),
            "identifiability": [c.to_dict() for c in self.combinations],
            "model": self.model,
            "replay": self.replay,
            "replays": round(self.replays, 2),
            "settings": self.settings,
        }
