"""Laws of a material that is bent, where there are no joints but a flex between two bodies: moments across that neck.

They are the laws of springs.py and stiffness.py of the same names, which use MuJoCo's own springs. Moments are
explicit: stable unless they are many times stiffer than the neck, whose own damping is implicit.
"""

from typing import ClassVar

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats, rotate_by_quaternion
from soro_bench.effects.effect import EffectError
from soro_bench.effects.elements import Elements
from soro_bench.effects.law import Law
from soro_bench.effects.springs import Hysteresis, PlasticSet, ViscoelasticCreep
from soro_bench.effects.stiffness import MullinsSoftening, RestBend, Stiffening

_CELL = 24  # numbers that place the eight nodes of a flex's cell


class AcrossNeck(Law):
    """A moment that depends on how a neck is bent, now and before.

    Entry i acts between the bodies ``near[i]`` and ``far[i]``; bends and moments are (n, 3) rotation vectors [rad] and
    N m in the frame of the near body, without twist.
    """

    joint_law: ClassVar[type[Law]]  # the law of joints that says the same
    kinds, stepped, outputs, remembers = ("body",), True, ("xquat",), ("memory", "_pushed")

    def __init_subclass__(cls) -> None:
        cls.name, cls.category, cls.quantities = cls.joint_law.name, cls.joint_law.category, cls.joint_law.quantities

    def prepare(self, elements: Elements) -> None:
        model = self.model
        self.far = np.array([elements.id(location) for location in self.locations])
        self.flexes: list[int] = []
        for location, body in zip(self.locations, self.far, strict=True):
            flex = elements.flex_before(body)
            if flex is None or model.flex_nodenum[flex] * 3 != _CELL or model.flex_stiffnessadr[flex] < 0:
                raise EffectError(f"{self.name} acts on springs of joints or of a neck of flex; {location} has none")
            self.flexes.append(flex)
        first = model.flex_nodeadr[self.flexes]
        self.near = np.array([model.flex_nodebodyid[a : a + _CELL // 3].min() for a in first])
        self._modes = [_Modes(model, flex) for flex in self.flexes]
        self._stiffness = np.zeros(len(self.rows))
        self._pushed = np.zeros((len(self.rows), 3))
        self.memory = np.zeros((len(self.rows), 3))

    def write(self, which: Bools) -> None:
        field = self.field("flex_stiffness")
        for i in np.flatnonzero(which):
            start = self.model.flex_stiffnessadr[self.flexes[i]]
            # minus: it gives forces
            cell = -field[self.rows[i], start : start + _CELL**2].reshape(_CELL, _CELL)
            self._stiffness[i] = _bending_stiffness(cell, self._modes[i])

    def reset(self, which: Bools) -> None:
        self._pushed[which] = 0.0
        self.memory[which] = 0.0
        for bodies in (self.near, self.far):
            self.batch.xfrc_applied[self.rows[which], bodies[which], 3:] = 0.0

    def step(self, which: Bools) -> None:
        rows = self.rows[which]
        near, far = (self.batch.xquat[rows, bodies[which]] for bodies in (self.near, self.far))
        axes = np.stack([modes.axis for modes in self._modes])[which]
        bend = _across(near, far)
        bend = bend - (bend * axes).sum(axis=1, keepdims=True) * axes
        moment = self._stiffness[which, None] * self.strain(which, bend)
        push = rotate_by_quaternion(moment, near) - self._pushed[which]
        self._pushed[which] += push
        moments = self.batch.xfrc_applied[:, :, 3:]
        np.add.at(moments, (rows, self.far[which]), push)
        np.subtract.at(moments, (rows, self.near[which]), push)

    def strain(self, which: Bools, bend: Floats) -> Floats:
        """(n, 3) the moment over the neck's stiffness, at bends (n, 3)."""
        raise NotImplementedError

    def value(self, name: str, which: Bools) -> Floats:
        """(n, 1) of a quantity, in its unit."""
        return self.values[name][which, None]


class NeckStiffening(AcrossNeck):
    """k q (1 + beta |q|^2)."""

    joint_law = Stiffening

    def strain(self, which: Bools, bend: Floats) -> Floats:
        return -self.value("beta", which) * (bend * bend).sum(axis=1, keepdims=True) * bend


class NeckMullins(AcrossNeck):
    """Softer below the largest bend so far."""

    joint_law = MullinsSoftening

    def strain(self, which: Bools, bend: Floats) -> Floats:
        size = _size(bend)
        largest = self.memory[which, :1] = np.maximum(self.memory[which, :1], size)
        lost = self.value("softening", which) * -np.expm1(-largest / self.value("strain", which))
        return lost * (1.0 - size / np.maximum(largest, 1e-12)) * bend


class NeckHysteresis(AcrossNeck):
    """A Jenkins element: an ideally plastic spring beside the neck."""

    joint_law = Hysteresis

    def strain(self, which: Bools, bend: Floats) -> Floats:
        limit = self.value("yield_strain", which)
        stretch = bend - self.memory[which]
        stretch = stretch * np.minimum(1.0, limit / np.maximum(_size(stretch), 1e-12))
        self.memory[which] = bend - stretch
        return -self.value("ratio", which) * stretch


class NeckCreep(AcrossNeck):
    """A standard linear solid: a spring whose rest follows the bend."""

    joint_law = ViscoelasticCreep

    def strain(self, which: Bools, bend: Floats) -> Floats:
        share = -np.expm1(-self.dt / self.value("time_constant", which))
        self.memory[which] += share * (bend - self.memory[which])
        return self.value("ratio", which) * (self.memory[which] - bend)


class NeckPlasticSet(AcrossNeck):
    """A share of the neck is ideally plastic."""

    joint_law = PlasticSet

    def strain(self, which: Bools, bend: Floats) -> Floats:
        softness = self.value("softness", which)
        excess = bend - self.memory[which]
        beyond = 1.0 - 1.0 / np.maximum(np.maximum(softness, 1e-12) * _size(excess), 1.0)
        self.memory[which] += np.where(softness > 0, beyond, 0.0) * excess
        return self.value("share", which) * self.memory[which]


class NeckRestBend(AcrossNeck):
    """At rest elsewhere."""

    joint_law = RestBend

    def strain(self, which: Bools, bend: Floats) -> Floats:
        x, y = self.values["angle_x"][which], self.values["angle_y"][which]
        return np.stack([x, y, np.zeros(len(x))], axis=1)


NECKS = {
    law.name: law for law in (NeckStiffening, NeckMullins, NeckHysteresis, NeckCreep, NeckPlasticSet, NeckRestBend)
}


class _Modes:
    """Rigid motions of the far end of a flex's cell: three turns about the middle of that end, three ways."""

    def __init__(self, model: mujoco.MjModel, flex: int):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        first = model.flex_nodeadr[flex]
        nodes = slice(first, first + _CELL // 3)
        places, bodies = model.flex_node0[nodes], model.flex_nodebodyid[nodes]
        far = bodies == bodies.max()
        middle = places[far].mean(axis=0)
        arms = np.where(far[:, None], places - middle, 0.0)
        turns = [np.cross(axis, arms).ravel() for axis in np.eye(3)]
        ways = [(far[:, None] * axis).ravel() for axis in np.eye(3)]
        self.motions = np.array(turns + ways)  # (6, 24)
        axis = middle - places[~far].mean(axis=0)
        self.world_axis = axis / np.linalg.norm(axis)
        inverse = np.zeros(4)
        mujoco.mju_negQuat(inverse, data.xquat[bodies.min()])
        self.axis = np.zeros(3)  # of the neck, in the frame of the near body
        mujoco.mju_rotVecQuat(self.axis, self.world_axis, inverse)


def _bending_stiffness(cell: Floats, modes: _Modes) -> float:
    """N m/rad of a neck whose far end is free to move while it is turned; the mean of all directions."""
    matrix = modes.motions @ cell @ modes.motions.T
    turning, coupling, moving = matrix[:3, :3], matrix[:3, 3:], matrix[3:, 3:]
    free = turning - coupling @ np.linalg.solve(moving, coupling.T)
    axis = modes.world_axis
    return float(np.trace(free) - axis @ free @ axis) / 2.0


def _across(near: Floats, far: Floats) -> Floats:
    """(n, 3) rotation vectors from orientations near to far (n, 4), in the frame of the near ones."""
    w, v = near[:, :1], near[:, 1:]
    real = w * far[:, :1] + (v * far[:, 1:]).sum(axis=1, keepdims=True)
    vector = w * far[:, 1:] - far[:, :1] * v - np.cross(v, far[:, 1:])
    vector = np.where(real < 0, -vector, vector)
    sine = _size(vector)
    return vector * 2.0 * np.arctan2(sine, np.abs(real)) / np.maximum(sine, 1e-12)


def _size(vectors: Floats) -> Floats:
    return np.sqrt((vectors * vectors).sum(axis=1, keepdims=True))
