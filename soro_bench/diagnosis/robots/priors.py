"""What a diagnosis believes of a robot before it sees a recording."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.effects.effect import Effect

LIMIT = 4.0  # standard deviations of the prior that a parameter, or the shape of an effect, may be off
SAME = 0.1  # of the prior's deviation, how far a parameter of a robot may be from what it was before


@dataclass(frozen=True)
class Prior:
    """What is believed of a parameter: normal in its logarithm, or in itself."""

    name: str
    unit: str
    nominal: float
    deviation: float
    logarithmic: bool
    bounds: tuple[float, float]

    def value(self, x):
        """Values from coordinates ``x`` in standard deviations from the nominal one."""
        value = self.nominal * np.exp(self.deviation * x) if self.logarithmic else self.nominal + self.deviation * x
        return np.clip(value, *self.bounds)

    @property
    def reach(self) -> np.ndarray:
        """(2,) the least and the largest coordinate: the value stays at its bounds beyond them."""
        ends = np.array(self.bounds)
        with np.errstate(divide="ignore"):  # the logarithm of zero
            ends = np.log(ends / self.nominal) if self.logarithmic else ends - self.nominal
        return np.clip(ends / self.deviation, -LIMIT, LIMIT)

    def about(self, value: float, spread: float) -> "Prior":
        """Of the same robot, for which an earlier recording has shown this value; ValueError for one out of bounds.

        Args:
            spread: standard deviation [of the parameter] with which it was known then.
        """
        low, high = self.bounds
        if not low <= value <= high or (self.logarithmic and value <= 0):
            raise ValueError(f"{self.name} = {value} was found earlier; allowed is {low} to {high}")
        known = spread / value if self.logarithmic else spread
        deviation = min(self.deviation, float(np.hypot(known, SAME * self.deviation)))
        return replace(self, nominal=value, deviation=deviation)


@dataclass(frozen=True)
class Baseline:
    """What an earlier diagnosis has found of the same robot: values of its parameters by name, their standard
    deviations, and effects."""

    parameters: Mapping[str, float]
    spread: Mapping[str, float]
    effects: tuple[Effect, ...]


class CannotHave(ValueError):
    """A robot cannot have the effects that an earlier diagnosis has found."""
