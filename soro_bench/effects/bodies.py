"""Laws of mass, weight and the surroundings."""

import numpy as np

from soro_bench.arrays import Bools, rotate_by_vector
from soro_bench.effects.effect import Location, Quantity
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law


class Payload(Law):
    """A point mass at a body's centre of mass; the body may be fixed to one that moves."""

    name, category, kinds, adds, welded = "payload", "inertia", ("body",), True, True
    quantities = (Quantity("mass", "kg", 0.015, (0.0, 1e4), of="mass"),)
    fields = ("body_mass",)

    def write(self, which: Bools) -> None:
        # of several at one body too
        np.add.at(self.field("body_mass"), (self.rows[which], self.ids[which]), self.values["mass"][which])


class BaseTilt(Law):
    """The base stands askew: gravity is turned by a rotation vector in world axes."""

    name, category, kinds = "base_tilt", "static_error", ("model",)
    quantities = tuple(Quantity(f"about_{axis}", "rad", 0.02, (-np.pi, np.pi)) for axis in "xyz")
    fields = ("opt.gravity",)

    @classmethod
    def idle(cls, elements: Elements, location: Location) -> frozenset[str]:
        gravity = elements.model.opt.gravity
        along = np.abs(gravity) == np.linalg.norm(gravity)  # about which gravity does not turn
        return frozenset(f"about_{axis}" for axis, same in zip("xyz", along, strict=True) if same and gravity.any())

    def prepare(self, elements: Elements) -> None:
        pass

    def write(self, which: Bools) -> None:
        gravity, rows = self.field("opt.gravity"), self.rows[which]
        vector = np.stack([self.values[q.name][which] for q in self.quantities], axis=1)
        gravity[rows] = rotate_by_vector(gravity[rows], vector)


class FluidDrag(Law):
    """Drag in proportion to the squared speed of a body's centre of mass."""

    name, category, kinds, stepped, shared = "fluid_drag", "inertia", ("body",), True, True
    only_shared = True
    quantities = (Quantity("drag", "N s^2/m^2", 0.1, (0.0, 1e6)),)
    outputs, remembers = ("xipos",), ("before", "_pushed")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.before, self._pushed = np.zeros((2, len(self.rows), 3))

    def reset(self, which: Bools) -> None:
        self.before[which] = self.batch.xipos[self.rows[which], self.ids[which]]
        self._pushed[which] = 0.0
        self.batch.xfrc_applied[self.rows[which], self.ids[which], :3] = 0.0

    def step(self, which: Bools) -> None:
        rows, ids = self.rows[which], self.ids[which]
        here = self.batch.xipos[rows, ids]
        velocity = (here - self.before[which]) / self.dt
        self.before[which] = here
        speed = np.sqrt((velocity * velocity).sum(axis=1))
        # no more than would stop it, with what it carries, within a time step, so that it never pushes; a third of that
        # where it is free in all three directions, over which the inverse weight is a mean
        most = 1.0 / np.maximum(3.0 * self.field("body_invweight0")[rows, ids, 0], 1e-9) / self.dt
        factor = np.minimum(self.values["drag"][which] * speed, most)
        push = -factor[:, None] * velocity - self._pushed[which]
        self._pushed[which] += push
        self.batch.xfrc_applied[rows, ids, :3] += push  # others push too
