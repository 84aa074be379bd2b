"""Laws of contact, at geoms. MuJoCo gives a pair of geoms the larger of their two coefficients of friction."""

from typing import ClassVar

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import EffectError, Quantity
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law

_REACH = 1e-5  # m, beyond what a contact stretches by before it tears; it also cushions impacts
_SPARE = 2.0  # times what it stretches by in the model as it is: parameters may halve a mass
_SHORTEST = 2.0  # time steps, the shortest time constant of a contact (MuJoCo's refsafe)
_IMPEDANCES = 1e-4, 0.9999  # MuJoCo's limits


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
    """Contacts that hold on until each of their points is pulled off with this force. With another geom they reach 10
    um farther than the two, which are soft, stretch before they bear it; with a flex 10 um, so they let go earlier."""

    name, category, kinds = "adhesion", "contact", ("geom",)
    quantities = (Quantity("force", "N", 0.1, (0.0, np.inf)),)
    # MuJoCo drops a contact that opens, and its adhesion with it, unless the geoms have a gap
    fields: ClassVar = ("geom_adhesion", "geom_gap")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        found = {geom: _stretches(self.model, geom, self.dt) for geom in np.unique(self.ids).tolist()}
        self.loose, self.firm, self.width = np.stack([found[geom] for geom in self.ids.tolist()], axis=1)

    def write(self, which: Bools) -> None:
        at, force = (self.rows[which], self.ids[which]), self.values["force"][which]
        self.field("geom_adhesion")[at] += force
        gap = self.field("geom_gap")
        gap[at] = np.where(force > 0, np.maximum(gap[at], _REACH), gap[at])
        pull = force[:, None]
        stretch = np.minimum(pull * self.loose[which], np.maximum(self.width[which], pull * self.firm[which]))
        np.add.at(gap, self.rows[which], _SPARE * stretch)  # of both geoms of a contact, whose gaps add up


def _stretches(model: mujoco.MjModel, geom: int, dt: float) -> Floats:
    """(3, ngeom) shares of all geoms in the stretch of their contacts with a geom, in m/N where their impedance is the
    least and the largest, and the stretch [m] at which it has changed from one to the other; 0 where they never touch.

    At rest a contact with the impedance d of two bodies with inverse weights A bears f where R f = k d r: r is its
    stretch, R = A (1 - d) / d, and k the stiffness that solref gives (MuJoCo's chapters Computation and Modeling).

    Args:
        dt: s, a time step.
    """
    body, kinds, masks = model.geom_bodyid, model.geom_contype, model.geom_conaffinity
    touch = ((kinds[geom] & masks) | (kinds & masks[geom])) > 0
    others = np.flatnonzero(touch & (body != body[geom]))
    found = np.zeros((3, model.ngeom))
    if not len(others):
        return found
    solref, solimp = _mixed(model, geom, others)
    time = np.maximum(solref[:, 0], _SHORTEST * dt) * solref[:, 1]
    squared = np.where(solref[:, 0] > 0, time**2, -1.0 / np.minimum(solref[:, 0], -mujoco.mjMINVAL))  # s^2
    impedances = np.clip(np.sort(solimp[:, :2], axis=1).T, *_IMPEDANCES)
    found[:2, others] = (1.0 - impedances) * squared * (solimp[:, 1] / impedances) ** 2
    found[2, others] = solimp[:, 2]
    found[:, geom] = found[:, others].max(axis=1)
    found[:2] *= model.body_invweight0[body, 0]
    return found


def _mixed(model: mujoco.MjModel, geom: int, others: Ints) -> tuple[Floats, Floats]:
    """(n, 2) solref and (n, 5) solimp of the contacts of a geom with others: those of the higher priority; of equal
    ones the weighted mean, or of direct values of solref the least."""
    weight, priority = model.geom_solmix, model.geom_priority
    share = weight[geom] / np.maximum(weight[geom] + weight[others], mujoco.mjMINVAL)
    equal = (priority[others] == priority[geom])[:, None]
    share = np.where(equal, share[:, None], priority[geom] > priority[others][:, None])
    solref, solimp = (share * own[geom] + (1.0 - share) * own[others] for own in (model.geom_solref, model.geom_solimp))
    own, other = model.geom_solref[geom], model.geom_solref[others]
    direct = equal & ((own <= 0).any() | (other <= 0).any(axis=1, keepdims=True))
    return np.where(direct, np.minimum(own, other), solref), solimp
