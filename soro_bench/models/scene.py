"""Parameters of what surrounds the robot: friction, the object, the wall."""

from collections.abc import Mapping

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.models.simulation import FieldWrite


class ContactFriction:
    """``friction``: one sliding friction coefficient for every pair, as in the reference simulator."""

    def __init__(self, model: mujoco.MjModel):
        self._geoms = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
        self._friction = model.geom_friction[self._geoms].copy()

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter."""
        sliding = params["friction"]
        friction = np.tile(self._friction, (len(sliding), 1, 1))
        friction[:, :, 0] = sliding[:, None]
        return [FieldWrite("geom_friction", self._geoms, friction)]


class ObjectMass:
    """``cube_mass``: a solid body, so the inertia scales with the mass."""

    def __init__(self, model: mujoco.MjModel):
        self._body = np.array([model.body("object").id])
        self._inertia_per_mass = model.body_inertia[self._body] / model.body_mass[self._body, None]

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter."""
        mass = params["cube_mass"][:, None]
        return [
            FieldWrite("body_mass", self._body, mass),
            FieldWrite("body_inertia", self._body, mass[:, :, None] * self._inertia_per_mass),
        ]


class WallOffset:
    """``wall_offset``: moves the wall along x."""

    def __init__(self, model: mujoco.MjModel):
        self._body = np.array([model.body("wall").id])
        self._nominal = model.body_pos[self._body].copy()

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter."""
        offset = params["wall_offset"][:, None, None] * np.array([1.0, 0.0, 0.0])
        return [FieldWrite("body_pos", self._body, self._nominal + offset)]
