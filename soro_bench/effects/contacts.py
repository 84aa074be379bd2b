"""Laws of contact, at geoms. MuJoCo gives a pair of geoms the larger of their two coefficients of friction."""

from typing import ClassVar

import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.effects.effect import EffectError, Quantity
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law

_REACH = 1e-5  # m, beyond the micrometres by which a contact opens before it tears; it also cushions impacts


class _Sliding(Law):
    """Sliding friction of a geom that depends on its velocity."""

    category, kinds, stepped = "contact", ("geom",), True
    fields: ClassVar = ("geom_friction",)
    outputs, remembers = ("geom_xpos",), ("before",)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        for location, geom in zip(self.locations, self.ids, strict=True):
            if self.model.body_weldid[self.model.geom_bodyid[geom]] == 0:
                raise EffectError(f"{self.name} depends on how fast a geom moves; {location} never moves")
        self.before = np.zeros((len(self.rows), 3))
        self.run.scaled("geom_friction")

    def reset(self, which: Bools) -> None:
        self.before[which] = self.batch.geom_xpos[self.rows[which], self.ids[which]]

    def step(self, which: Bools) -> None:
        rows, ids = self.rows[which], self.ids[which]
        here = self.batch.geom_xpos[rows, ids]
        factor = self.factor(which, (here - self.before[which]) / self.dt)
        self.before[which] = here
        self.field("geom_friction")[rows, ids, 0] *= factor

    def factor(self, which: Bools, velocity: Floats) -> Floats:
        """(n,) of the friction coefficient at velocities (n, 3) [m/s]."""
        raise NotImplementedError


class AnisotropicFriction(_Sliding):
    """More friction one way than the other, as of bristles: along the world's -x, 1 + excess times."""

    name = "anisotropic_friction"
    quantities = (Quantity("excess", "1", 0.5, (0.0, 100.0)),)

    def factor(self, which: Bools, velocity: Floats) -> Floats:
        return 1.0 + self.values["excess"][which] * (velocity[:, 0] < 0)


class Stiction(_Sliding):
    """More friction at rest than sliding: 1 + excess exp(-(v / vs)^2) times."""

    name = "stiction"
    quantities = (
        Quantity("excess", "1", 0.5, (0.0, 100.0)),
        Quantity("velocity", "m/s", 0.005, (1e-6, 100.0)),
    )

    def factor(self, which: Bools, velocity: Floats) -> Floats:
        squared = (velocity * velocity).sum(axis=1) / self.values["velocity"][which] ** 2
        return 1.0 + self.values["excess"][which] * np.exp(-squared)


class Adhesion(Law):
    """Contacts that hold on until each of their points is pulled off with this force, within a reach of 10 um. Only
    stiff ones, of a solref of some 4 ms, stretch so little before they bear it; others let go much earlier."""

    name, category, kinds = "adhesion", "contact", ("geom",)
    quantities = (Quantity("force", "N", 0.1, (0.0, np.inf)),)
    # MuJoCo drops a contact that opens, and its adhesion with it, unless the geoms have a gap
    fields: ClassVar = ("geom_adhesion", "geom_gap")

    def write(self, which: Bools) -> None:
        at, force = (self.rows[which], self.ids[which]), self.values["force"][which]
        self.field("geom_adhesion")[at] += force
        gap = self.field("geom_gap")
        gap[at] = np.where(force > 0, np.maximum(gap[at], _REACH), gap[at])
