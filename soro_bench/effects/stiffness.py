"""Laws of what resists motion in proportion, stiffness and viscous friction, and of where springs are at rest."""

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.effects.effect import EffectError, Location, Quantity
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law, OnJoints, coefficients, per_row

_OF_FLEX = ("flex_stiffness", "flex_bending")


class ViscousFriction(Law):
    """A force in proportion to the velocity; a negative one takes away damping that the model has."""

    name, category, kinds, adds = "viscous_friction", "timing", ("tendon", "joint"), True
    quantities = (Quantity("damping", "N s/m or N m s/rad", 1.0, (-np.inf, np.inf), of="damping", takes=True),)
    fields = ("tendon_damping", "dof_damping")

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        field, i = elements.resistance(location)
        return float(getattr(elements.model, f"{field}_damping")[i])

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.on_joint = np.array([location.kind == "joint" for location in self.locations])

    def write(self, which: Bools) -> None:
        for field, chosen in (("tendon_damping", ~self.on_joint), ("dof_damping", self.on_joint)):
            i = np.flatnonzero(which & chosen)
            ids = self.ids[i] if field == "tendon_damping" else self.model.jnt_dofadr[self.ids[i]]
            damping, at = self.field(field), (self.rows[i], ids)
            np.add.at(damping, at, self.values["damping"][i])
            damping[at] = np.maximum(damping[at], 0.0)


class LocalStiffness(OnJoints):
    """A part that is softer or stiffer than its model, and damped in proportion."""

    name, category, kinds = "local_stiffness", "local", ("body", "joint", "flex")
    quantities = (Quantity("factor", "1", 0.7, (0.02, 50.0), null=1.0),)
    fields = ("jnt_stiffness", "dof_damping", *_OF_FLEX)

    def prepare(self, elements: Elements) -> None:
        self.springs = _Springs(self, elements)

    def write(self, which: Bools) -> None:
        self.springs.scale(self.values["factor"], which)


class StiffnessDrift(OnJoints):
    """Stiffness that changes steadily with clock time: temperature, ageing."""

    name, category, kinds, stepped = "stiffness_drift", "local", ("body", "joint", "flex"), True
    only_shared = True
    quantities = (Quantity("rate", "1/min", -0.4, (-10.0, 10.0)),)
    fields = ("jnt_stiffness", "dof_damping", *_OF_FLEX)
    shared = True

    def prepare(self, elements: Elements) -> None:
        self.springs = _Springs(self, elements)
        self.springs.share()

    def step(self, which: Bools) -> None:
        factor = np.ones(len(self.rows))
        factor[which] = np.maximum(1.0 + self.values["rate"][which] * self.time(which) / 60.0, 0.05)
        self.springs.scale(factor, which)


class RestBend(OnJoints):
    """Springs that are at rest elsewhere: a part that was moulded, mounted or stored bent."""

    name, category, bending_only = "rest_bend", "static_error", True
    quantities = (
        Quantity("angle_x", "rad or m", 0.02, (-3.0, 3.0)),  # of the first joint, or of the only one
        Quantity("angle_y", "rad or m", 0.02, (-3.0, 3.0)),  # of the second one
    )
    fields = ("qpos_spring",)

    @classmethod
    def idle(cls, elements: Elements, location: Location) -> frozenset[str]:
        joints = elements.sprung(elements.id(location), bending_only=True) if location.kind == "body" else [location]
        return frozenset({"angle_y"} if len(joints) == 1 else ())

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.first = np.searchsorted(self.place, self.place)

    def write(self, which: Bools) -> None:
        number = (np.arange(len(self.place)) - self.first)[which]
        angles = np.stack([self.values["angle_x"][which], self.values["angle_y"][which]])
        angle = np.where(number < 2, angles[np.minimum(number, 1), np.arange(len(number))], 0.0)
        self.field("qpos_spring")[self.rows[which], self.qpos[which]] += angle


class _StrainDependent(OnJoints):
    """Springs whose stiffness depends on how far they are, or were, strained."""

    category, bending_only, shared, only_shared, stepped = "amplitude", True, True, True, True
    fields = ("jnt_stiffness",)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        for name in self.fields:
            self.run.scaled(name)

    def step(self, which: Bools) -> None:
        factor, at = self.factor(self.strain(), which)[which], (self.rows[which], self.joints[which])
        for name in self.fields:
            values = self.field(name)
            np.multiply.at(values, at, per_row(factor, values[0]))

    def factor(self, strain: Floats, which: Bools) -> Floats:
        """(n,) of the stiffness at strains (n,)."""
        raise NotImplementedError


class Stiffening(_StrainDependent):
    """Springs with a cubic term: k q (1 + beta |q|^2)."""

    name = "stiffening"
    quantities = (Quantity("beta", "1/rad^2 or 1/m^2", 2.0, (0.0, 1e6)),)

    def factor(self, strain: Floats, which: Bools) -> Floats:
        return 1.0 + self.values["beta"] * strain**2


class MullinsSoftening(_StrainDependent):
    """Softer below the largest strain so far, and as stiff as ever at it.

    Mullins, "Softening of rubber by deformation", 1969; as a pseudo-elasticity (Ogden, Roxburgh, 1999).
    """

    name = "mullins_softening"
    quantities = (
        Quantity("softening", "1", 0.3, (0.0, 0.9)),
        Quantity("strain", "rad or m", 0.05, (1e-4, 10.0), also=(0.2,)),
    )
    remembers = ("largest",)

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.largest = np.zeros(len(self.rows))

    def reset(self, which: Bools) -> None:
        self.largest[which] = 0.0

    def factor(self, strain: Floats, which: Bools) -> Floats:
        self.largest[which] = np.maximum(self.largest, strain)[which]
        below = 1.0 - strain / np.maximum(self.largest, 1e-12)
        return 1.0 - self.values["softening"] * -np.expm1(-self.largest / self.values["strain"]) * below


class _Springs:
    """Springs and dampers of joints, or the stiffness of flexes, that are scaled together."""

    def __init__(self, law: OnJoints, elements: Elements):
        places = [self._places(law, elements, location) for location in law.locations]
        counts = [len(each) for each in places]
        law.rows = np.repeat(law.rows, counts)
        law.values = {name: np.repeat(values, counts) for name, values in law.values.items()}
        flat = [place for each in places for place in each]
        self.law = law
        self.fields = np.array([field for field, _ in flat])
        self.columns = np.array([column for _, column in flat], int)

    def _places(self, law: OnJoints, elements: Elements, location: Location) -> list[tuple[str, int]]:
        model, i = law.model, elements.id(location)
        joints = np.zeros(0, int)
        if location.kind in ("joint", "body"):
            joints = elements.sprung(i if location.kind == "body" else model.jnt_bodyid[i])
        if not len(joints):
            flex = {"flex": i, "body": elements.flex_before(i)}.get(location.kind)
            if flex is None:
                raise EffectError(f"{law.name} acts on springs of joints or of a flex; {location} has none")
            found = [(field, column) for field in _OF_FLEX for column in _columns(model, field, flex)]
            if not found:
                raise EffectError(f"{law.name} needs elasticity of the flex; that of {location} has none")
            return found  # its damping is in proportion
        joints = np.array([i]) if location.kind == "joint" else joints
        springs, dampers = coefficients(model, "jnt_stiffness"), coefficients(model, "dof_damping")
        found = [(field, j) for field in springs for j in joints]
        return found + [(field, model.jnt_dofadr[j]) for field in dampers for j in joints]

    def share(self) -> None:
        """Let other laws scale the same ones in every time step."""
        for field in np.unique(self.fields):
            self.law.run.scaled(str(field))

    def scale(self, factor: Floats, which: Bools) -> None:
        """Multiply them by factors (n,) of the law's entries."""
        for field in np.unique(self.fields):
            i = np.flatnonzero(which & (self.fields == field))
            values = self.law.field(str(field))
            np.multiply.at(values, (self.law.rows[i], self.columns[i]), per_row(factor[i], values[0]))


def _columns(model: mujoco.MjModel, field: str, flex: int) -> range:
    """Where the values of a flex are in a field; none where it has no such elasticity."""
    starts = getattr(model, field + "adr")
    if (start := starts[flex]) < 0:
        return range(0)
    return range(start, min(starts[starts > start], default=len(getattr(model, field))))
