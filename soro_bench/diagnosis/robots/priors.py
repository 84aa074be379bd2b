"""Prior knowledge of a robot's parameters, and what a baseline diagnosis adds to it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.settings import PriorSettings
from soro_bench.effects.effect import Effect

_DEFAULT = PriorSettings()
LIMIT = _DEFAULT.limit


@dataclass(frozen=True)
class FixedParameter:
    """A parameter that is known, so that no fit changes it.

    value: [unit]. nominal: that of the model or of a baseline diagnosis. recorded: whether the recordings have the
    value; else a user gave it.
    """

    name: str
    unit: str
    value: float
    nominal: float
    recorded: bool


@dataclass(frozen=True)
class Prior:
    """The prior of a parameter: normal in its logarithm, or in itself.

    nominal: its median [unit]. deviation: of the logarithm, or in the unit. bounds: least and largest value [unit].
    """

    name: str
    unit: str
    nominal: float
    deviation: float
    logarithmic: bool
    bounds: tuple[float, float]

    def value(self, x: float | Floats) -> Floats:
        """Values [unit] at coordinates ``x``, in standard deviations from the nominal value."""
        value = self.nominal * np.exp(self.deviation * x) if self.logarithmic else self.nominal + self.deviation * x
        return np.clip(value, *self.bounds)

    def reach(self, limit: float = LIMIT) -> Floats:
        """(2,) least and largest coordinate. Beyond them the value stays at its bounds.

        Args:
            limit: largest distance from the nominal value, in standard deviations.
        """
        ends = np.array(self.bounds)
        with np.errstate(divide="ignore"):  # the logarithm of zero
            ends = np.log(ends / self.nominal) if self.logarithmic else ends - self.nominal
        return np.clip(ends / self.deviation, -limit, limit)

    def fixed(self, value: float, recorded: bool) -> FixedParameter:
        """The parameter with a known value [unit].

        Raises:
            ValueError: the value is out of bounds.
        """
        if not self._allows(value):
            low, high = self.bounds
            unit = "" if self.unit == "1" else f" {self.unit}"
            raise ValueError(f"{self.name} = {value:g} is not possible; allowed is {low:g} to {high:g}{unit}")
        return FixedParameter(self.name, self.unit, float(value), self.nominal, recorded)

    def about(self, value: float, spread: float, settings: PriorSettings = _DEFAULT) -> "Prior":
        """The prior for the same robot after a baseline diagnosis.

        Args:
            value: of the parameter in the baseline [unit].
            spread: its standard deviation there [unit].

        Raises:
            ValueError: the value is out of bounds.
        """
        if not self._allows(value):
            low, high = self.bounds
            raise ValueError(f"{self.name} = {value} in the baseline diagnosis; allowed is {low} to {high}")
        known = spread / value if self.logarithmic else spread
        deviation = min(self.deviation, float(np.hypot(known, settings.same_robot * self.deviation)))
        return replace(self, nominal=value, deviation=deviation)

    def _allows(self, value: float) -> bool:
        """Whether a value [unit] is within the bounds, and has a logarithm where that counts."""
        low, high = self.bounds
        return low <= value <= high and not (self.logarithmic and value <= 0)


@dataclass(frozen=True)
class Baseline:
    """Result of a baseline diagnosis of the same robot.

    parameters: values by name. spread: their standard deviations by name. effects: that it found.
    """

    parameters: Mapping[str, float]
    spread: Mapping[str, float]
    effects: tuple[Effect, ...]


class CannotHave(ValueError):
    """A robot cannot have the effects that a baseline diagnosis found."""
