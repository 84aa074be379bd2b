"""Laws of springs that yield or creep: friction that sticks, hysteresis, memory of the material.

MuJoCo's springs with a yield threshold are ideal elasto-plastic elements, integrated implicitly by its discrete
integrator: they stick, slip at stiffness times threshold, and never add energy. Friction is such a spring that slips
after a short way, the presliding. Prandtl 1928; for friction: Dahl, "A solid friction model", 1968.

The integrator takes every spring for elastic during a time step: one that slips resists like a damper of stiffness
times time step, 20 N s/m on a cable with 1 N of friction and 0.5 mm of presliding. While it slides, friction is
therefore a soft spring with the same force.
"""

import itertools
from typing import Any, ClassVar

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.effects.effect import EffectError, Location, Quantity
from soro_bench.effects.elements import NEVER, Elements
from soro_bench.effects.law import Law, OnJoints, coefficients, per_row, tension

_SOFTER = 100.0  # a spring that slides, than one that sticks, and than one that yields within a time step
_STABLE = 2.0  # of inertia over the square of a time step, an explicit spring; from 4 on it would be unstable
_AT_LIMIT = 0.999  # of what it gives before it slides
_LARGEST_BEND = 50.0  # of mu times angle: nothing slips long before, and exp(mu angle) stays finite
INFINITE = (0.0, np.inf)
_FORCE = "N or N m"
_PRESLIDING = Quantity("presliding", "m or rad", 5e-4, (1e-6, 0.1))  # LuGre bristles deflect by 1e-5 to 1e-3 m


class _Friction(Law):
    """Friction of a tendon or joint: a spring without rest length that yields."""

    category = "friction"
    kinds: ClassVar[tuple[str, ...]] = ("tendon", "joint")
    fields: ClassVar[tuple[str, ...]] = ("tendon_stiffness", "tendon_springyield")
    outputs: ClassVar[tuple[str, ...]] = ("ten_length", "ten_velocity")
    stepped = True
    of_load: ClassVar[bool] = False  # what holds grows with the load at once, as the level does

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        # a tendon's own spring, a joint's second one
        on_joint = [location.kind == "joint" for location in self.locations]
        self.springs = np.array([elements.spring_of(i) if j else i for i, j in zip(self.ids, on_joint, strict=True)])
        stiff = [getattr(self.model, name)[self.springs] != 0 for name in ("tendon_stiffness", "tendon_stiffnesspoly")]
        taken = (self.model.tendon_plasticadr[self.springs] < 0) | stiff[0] | stiff[1].any(axis=1)
        if taken.any():
            raise EffectError(f"{self.name} needs tendons without a spring of their own; see instrument()")
        self.run.claim(self, self.rows, self.springs)
        # only the discrete integrator is implicit in stiffness
        self.explicit = self.model.opt.integrator != mujoco.mjtIntegrator.mjINT_DISCRETE
        actuators = [elements.actuators_on(location) for location in self.locations]
        self.actuators = np.full((len(actuators), max(map(len, actuators), default=0)), -1)
        for i, each in enumerate(actuators):
            self.actuators[i, : len(each)] = each

    def write(self, which: Bools) -> None:
        level = self.level(which)
        self._set(which, level, self._presliding(which, level))

    def reset(self, which: Bools) -> None:
        """An episode begins without friction, wherever the spring is then."""
        self._set_rest(which, self.batch.ten_length[self.rows[which], self.springs[which]])

    def step(self, which: Bools) -> None:
        rows, springs = self.rows[which], self.springs[which]
        length, velocity = self.batch.ten_length[rows, springs], self.batch.ten_velocity[rows, springs]
        rest = self.batch.plastic[rows, self.model.tendon_plasticadr[springs]]
        shortening, lengthening = self.levels(which)
        level = np.where(length > rest, lengthening, shortening)
        # of what it gives; where it slides the force follows the level, so this does not ask for the new one
        given = (length - rest) / self.field("tendon_springyield")[rows, springs]
        slides = (np.abs(given) >= _AT_LIMIT) & (given * velocity > 0)
        force = level * given if self.of_load else self.field("tendon_stiffness")[rows, springs] * (length - rest)
        force = np.where(slides, np.sign(force) * level, np.clip(force, -shortening, lengthening))
        # as stiff in both directions
        ratio = np.divide(level, shortening, out=np.ones_like(level), where=shortening > 0)
        reach = self._presliding(which, level, ratio)
        reach = np.where(slides, _SOFTER * np.maximum(reach, np.abs(velocity) * self.dt), reach)
        self._set(which, level, reach)
        self._set_rest(which, length - reach * force / np.maximum(level, 1e-12))

    def remembered(self, own: Bools) -> list[tuple[Floats, Any]]:
        at = self.rows[own], self.springs[own]
        return [*_rests(self, own), *((self.field(name), at) for name in _Friction.fields)]

    def level(self, which: Bools) -> Floats:
        """(n,) the force at which it slips while it becomes shorter."""
        raise NotImplementedError

    def levels(self, which: Bools) -> tuple[Floats, Floats]:
        """The same, and (n,) the force at which it slips while it becomes longer."""
        level = self.level(which)
        return level, level

    def _presliding(self, which: Bools, level: Floats, ratio: Floats | float = 1.0) -> Floats:
        """(n,) how far it gives: ``ratio`` times its presliding, more where a spring would be too stiff."""
        reach = self.values["presliding"][which] * ratio
        if not self.explicit:
            return reach
        weight = self.field("tendon_invweight0")[self.rows[which], self.springs[which]]
        return np.maximum(reach, level * weight * self.dt**2 / _STABLE)

    def _set(self, which: Bools, level: Floats, reach: Floats) -> None:
        at = self.rows[which], self.springs[which]
        self.field("tendon_stiffness")[at] = level / reach
        self.field("tendon_springyield")[at] = reach

    def _set_rest(self, which: Bools, rest: Floats) -> None:
        rows, slots = self.rows[which], self.model.tendon_plasticadr[self.springs[which]]
        self.batch.plastic[rows, slots] = self.batch.plastic[rows, slots + 1] = rest


class CoulombFriction(_Friction):
    """Dry friction of a constant force; a negative one takes away frictionloss that the model has."""

    name = "coulomb_friction"
    quantities = (Quantity("friction", _FORCE, 1.0, (-np.inf, np.inf), of="force", takes=True), _PRESLIDING)
    fields = (*_Friction.fields, "tendon_frictionloss", "dof_frictionloss")

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        field, i = elements.resistance(location)
        return float(getattr(elements.model, f"{field}_frictionloss")[i])

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.of_model = [elements.resistance(location) for location in self.locations]

    def write(self, which: Bools) -> None:
        super().write(which)
        for i in np.flatnonzero(which & (self.values["friction"] < 0.0)):
            field, column = self.of_model[i]
            loss, at = self.field(f"{field}_frictionloss"), (self.rows[i], column)
            loss[at] = max(loss[at] + self.values["friction"][i], 0.0)

    def level(self, which: Bools) -> Floats:
        return np.maximum(self.values["friction"][which], 0.0)


class StribeckFriction(_Friction):
    """Dry friction that is larger near standstill: Fc + (Fs - Fc) exp(-(v/vs)^2)."""

    name = "stribeck_friction"
    quantities = (
        Quantity("friction", _FORCE, 1.0, INFINITE, of="force"),
        Quantity("static_ratio", "1", 2.0, (1.0, 10.0)),
        Quantity("stribeck_velocity", "m/s or rad/s", 0.02, (1e-4, 100.0)),
        _PRESLIDING,
    )

    def level(self, which: Bools) -> Floats:
        velocity = self.batch.ten_velocity[self.rows[which], self.springs[which]]
        excess = (self.values["static_ratio"] - 1.0)[which]
        ratio = 1.0 + excess * np.exp(-((velocity / self.values["stribeck_velocity"][which]) ** 2))
        return self.values["friction"][which] * ratio


class LoadFriction(_Friction):
    """Dry friction in proportion to the load: on a joint mu times the torque of all actuators; a tendon that bends
    round its eyelets has, beyond them, exp(-mu angle) of its tension while it is pulled and exp(mu angle) of it while
    it is paid out (Euler, Eytelwein). The angle is the sum of those by which the bodies along it are bent against each
    other, none in the model's reference configuration: there it is taken for running through straight channels,
    wherever a model has its sites. What holds grows with the load, as in LuGre models with a normal force (Canudas de
    Wit, Tsiotras, "Dynamic tire friction models for vehicle traction control", 1999)."""

    name, of_load = "load_friction", True
    quantities = (Quantity("mu", "1", 0.1, (0.0, 10.0)), _PRESLIDING)
    outputs = ("ten_length", "ten_velocity", "actuator_force", "qfrc_actuator", "xmat")

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.on_joint = np.array([location.kind == "joint" for location in self.locations])
        self.dofs = np.where(self.on_joint, self.model.jnt_dofadr[np.where(self.on_joint, self.ids, 0)], 0)
        paths = [[] if joint else _bends(self.model, i) for i, joint in zip(self.ids, self.on_joint, strict=True)]
        longest = max(1, *map(len, paths))
        # the bodies on both sides of every bend, and there the direction of the tendon, which is the same at rest; what
        # is too short goes on with no direction
        self.bodies, self.ways = np.zeros((2, len(paths), longest), int), np.zeros((2, len(paths), longest, 3))
        for i, path in enumerate(paths):
            for k, (near, far, along, onward) in enumerate(path):
                self.bodies[:, i, k], self.ways[:, i, k] = (near, far), (along, onward)

    def level(self, which: Bools) -> Floats:
        return self.levels(which)[0]

    def levels(self, which: Bools) -> tuple[Floats, Floats]:
        rows, on_joint, mu = self.rows[which], self.on_joint[which], self.values["mu"][which]
        torque = np.abs(self.batch.qfrc_actuator[rows, self.dofs[which]]) * mu
        if on_joint.all():
            return torque, torque
        load = tension(self.batch, rows, self.actuators[which])
        bend = np.minimum(mu * self._angle(which), _LARGEST_BEND)
        return np.where(on_joint, torque, -np.expm1(-bend) * load), np.where(on_joint, torque, np.expm1(bend) * load)

    def _angle(self, which: Bools) -> Floats:
        """(n,) sums of the angles [rad] by which tendons bend."""
        turns = self.batch.xmat[self.rows[which][:, None], self.bodies[:, which]]
        turns = turns.reshape(*turns.shape[:3], 3, 3)
        along, onward = (turns @ self.ways[:, which, :, :, None])[..., 0]
        sine = np.linalg.norm(np.cross(along, onward), axis=-1)
        # one after the other, so that a sum does not depend on how long the longest tendon is
        return np.add.accumulate(np.arctan2(sine, (along * onward).sum(axis=-1)), axis=1)[:, -1]


class GearFriction(_Friction):
    """Dry friction of a loaded gear: in proportion to the torques on its two sides, those of the actuators and all
    others, and to its preload, and larger near standstill.

    mu (|T - backdrive L| + preload) (1 + (static_ratio - 1) exp(-(v/vs)^2)) with the actuators' torque T and the load's
    L, which has the other sign where the actuators carry it (Duclusaud et al., "Extended friction models for the
    physics simulation of servo actuators", 2025).
    """

    name, kinds = "gear_friction", ("joint",)
    quantities = (
        Quantity("mu", "1", 0.05, (0.0, 10.0)),
        Quantity("backdrive", "1", 1.0, (0.0, 10.0), also=(3.0,)),
        Quantity("preload", _FORCE, 1.0, INFINITE, of="force"),
        Quantity("static_ratio", "1", 1.5, (1.0, 10.0)),
        Quantity("stribeck_velocity", "m/s or rad/s", 0.2, (1e-4, 100.0)),
        _PRESLIDING,
    )
    outputs = (
        "ten_length", "ten_velocity", "qfrc_actuator", "qfrc_passive", "qfrc_constraint", "qfrc_applied", "qfrc_bias",
    )  # fmt: skip

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.dofs = self.model.jnt_dofadr[self.ids]

    def level(self, which: Bools) -> Floats:
        rows, dofs, springs = self.rows[which], self.dofs[which], self.springs[which]
        data, values = self.batch, {name: each[which] for name, each in self.values.items()}
        strain = data.ten_length[rows, springs] - data.plastic[rows, self.model.tendon_plasticadr[springs]]
        own = -self.field("tendon_stiffness")[rows, springs] * strain
        others = data.qfrc_passive[rows, dofs] - own + data.qfrc_applied[rows, dofs] + data.qfrc_constraint[rows, dofs]
        load = others - data.qfrc_bias[rows, dofs]
        torque = np.abs(data.qfrc_actuator[rows, dofs] - values["backdrive"] * load)
        speed = data.ten_velocity[rows, springs] / values["stribeck_velocity"]
        level = values["mu"] * (torque + values["preload"])
        return level * (1.0 + (values["static_ratio"] - 1.0) * np.exp(-(speed**2)))


class InputFriction(_Friction):
    """Dry friction of what an actuator drives, mu (|F| + preload) with the force F of this one actuator: a belt under
    tension, or a seal under the pressure that it holds. Only where other actuators drive the same joint or tendon; else
    this is load_friction.
    """

    name, kinds = "input_friction", ("actuator",)
    quantities = (
        Quantity("mu", "1", 0.02, (0.0, 10.0)),
        Quantity("preload", _FORCE, 10.0, INFINITE, of="force"),
        _PRESLIDING,
    )
    outputs = (*_Friction.outputs, "actuator_force")

    def prepare(self, elements: Elements) -> None:
        own = self.locations
        self.inputs = np.array([elements.id(location) for location in own])
        self.locations = [elements.driven_by(location) for location in own]
        super().prepare(elements)
        self.locations = own
        if (np.count_nonzero(self.actuators >= 0, axis=1) < 2).any():
            raise EffectError(f"{self.name} acts where several actuators drive one joint or tendon; see load_friction")

    def level(self, which: Bools) -> Floats:
        rows, ids = self.rows[which], self.inputs[which]
        force = np.abs(self.model.actuator_gear[ids, 0] * self.batch.actuator_force[rows, ids])
        return self.values["mu"][which] * (force + self.values["preload"][which])


class _SecondSpring(OnJoints):
    """A law of the springs beside those of joints."""

    bending_only = True

    def prepare(self, elements: Elements) -> None:
        super().prepare(elements)
        self.springs = np.array([elements.spring_of(joint) for joint in self.joints], int)
        self.run.claim(self, self.rows, self.springs)
        self.slots = self.model.tendon_plasticadr[self.springs]

    def beside(self, which: Bools, ratio: Floats) -> None:
        """Make them ratios (n,) of the springs of joints."""
        at, rows = (self.rows[which], self.springs[which]), (self.rows[which], self.joints[which])
        pairs = [coefficients(self.model, name) for name in ("jnt_stiffness", "tendon_stiffness")]
        for own, name in zip(*pairs, strict=True):
            values = self.field(own)[rows]
            self.field(name)[at] = per_row(ratio, values) * values

    def reset(self, which: Bools) -> None:
        """It begins at rest where the joint's own spring is."""
        rows, slots = self.rows[which], self.slots[which]
        rest = self.field("qpos_spring")[rows, self.qpos[which]]
        self.batch.plastic[rows, slots] = self.batch.plastic[rows, slots + 1] = rest

    def remembered(self, own: Bools) -> list[tuple[Floats, Any]]:
        return _rests(self, own)


class Hysteresis(_SecondSpring):
    """A Jenkins element beside the springs: stiffness ratio times theirs, slipping beyond the yield strain."""

    name, category, shared = "hysteresis", "hysteresis_or_play", True
    quantities = (
        Quantity("ratio", "1", 0.5, (0.0, 20.0)),
        Quantity("yield_strain", "rad or m", 0.03, (1e-4, 10.0), also=(0.1,)),
    )
    fields = ("tendon_stiffness", "tendon_springyield")

    def write(self, which: Bools) -> None:
        self.beside(which, self.values["ratio"][which])
        self.field("tendon_springyield")[self.rows[which], self.springs[which]] = self.values["yield_strain"][which]


class ViscoelasticCreep(_SecondSpring):
    """Standard linear solid: beside each spring another one whose rest length follows it with a time constant."""

    name, category, shared, stepped = "viscoelastic_creep", "slow_drift", True, True
    only_shared = True
    quantities = (
        Quantity("ratio", "1", 0.3, (0.0, 20.0)),
        Quantity("time_constant", "s", 2.0, (1e-3, 1e4), also=(0.4, 10.0)),
    )
    fields = ("tendon_stiffness",)
    outputs = ("ten_length",)

    def write(self, which: Bools) -> None:
        self.beside(which, self.values["ratio"][which])

    def step(self, which: Bools) -> None:
        rows, slots = self.rows[which], self.slots[which]
        length = self.batch.ten_length[rows, self.springs[which]]
        share = -np.expm1(-self.dt / self.values["time_constant"][which])
        plastic = self.batch.plastic  # lower and upper end of the rest length
        rest = plastic[rows, slots] + share * (length - plastic[rows, slots])
        plastic[rows, slots] = plastic[rows, slots + 1] = rest


class PlasticSet(_SecondSpring):
    """Springs that yield: beyond a strain their rest position moves along by a share of the excess, and stays.

    A share of each spring is ideally plastic, the rest of it elastic.
    """

    name, category = "plastic_set", "slow_drift"
    # infinity is no effect, and a strength is easier to search than a threshold
    quantities = (
        Quantity("softness", "1/rad or 1/m", 5.0, (0.0, 1e4)),
        Quantity("share", "1", 0.5, (0.0, 1.0)),
    )
    fields: ClassVar = ("jnt_stiffness", "tendon_stiffness", "tendon_springyield")

    def write(self, which: Bools) -> None:
        rows, softness = self.rows[which], self.values["softness"][which]
        share = np.where(softness > 0, self.values["share"][which], 0.0)
        self.beside(which, share)
        self.field("tendon_springyield")[rows, self.springs[which]] = np.where(
            softness > 0, 1.0 / np.maximum(softness, 1e-9), NEVER
        )
        for name in coefficients(self.model, "jnt_stiffness"):
            own = self.field(name)
            own[rows, self.joints[which]] *= per_row(1.0 - share, own[0])


def _rests(law: _Friction | _SecondSpring, own: Bools) -> list[tuple[Floats, Any]]:
    """Where the rest lengths of the springs of entries ``own`` (n,) are, both ends of them."""
    slots = law.model.tendon_plasticadr[law.springs[own]]
    return [(law.batch.plastic, (law.rows[own], slots + end)) for end in (0, 1)]


def _bends(model: mujoco.MjModel, tendon: int) -> list[tuple[int, int, Floats, Floats]]:
    """Where a spatial tendon goes from one body to another: both, and its direction there at rest in their frames."""
    wraps = np.arange(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    kinds = model.wrap_type[wraps]
    if np.isin(kinds, (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)).any():
        raise EffectError(f"tendon {model.tendon(tendon).name} wraps around a geom; load_friction needs one that only "
                          "goes through sites")  # fmt: skip
    data, found = mujoco.MjData(model), []
    mujoco.mj_kinematics(model, data)
    for (i, one), (j, other) in itertools.pairwise(zip(model.wrap_objid[wraps], kinds, strict=True)):
        if {one, other} != {int(mujoco.mjtWrap.mjWRAP_SITE)}:
            continue  # a pulley, beyond which another branch begins
        near, far = model.site_bodyid[[i, j]]
        way = data.site_xpos[j] - data.site_xpos[i]
        if near != far and way.any():  # two sites at one place say no direction
            along = way / np.linalg.norm(way)
            found.append((near, far, *(data.xmat[body].reshape(3, 3).T @ along for body in (near, far))))
    return found
