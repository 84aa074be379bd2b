"""Changes between two recordings of one robot: a parameter that moves, or a law that acts in one of them only.

A change has coordinates like a candidate term, in standard deviations of its prior; at zero nothing has changed. Where
a law can act in one direction only, as friction can, a negative coordinate means that it acts before and not after.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term, term, terms
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.catalogue import ALL, PHYSICS
from soro_bench.effects.effect import EVERY, Effect, Location

EVERYWHERE = ("coulomb_friction", "viscous_friction", "actuator_saturation", "compliance")  # ageing
_KINDS = {
    "local_stiffness": "stiffness", "viscous_friction": "damping", "coulomb_friction": "friction",
    "stribeck_friction": "friction", "load_friction": "friction", "gear_friction": "friction",
    "actuator_delay": "delay", "sensor_delay": "delay", "actuator_lag": "delay", "sensor_bias": "sensor shift",
    "marker_slip": "sensor shift", "frame_misalignment": "sensor shift", "actuator_saturation": "actuator strength",
    "compliance": "actuator stiffness", "pretension": "actuator offset",
}  # fmt: skip
# laws of the same kinds in other forms, which differences of two runs tell apart too seldom for what they cost
_ALIKE = (
    "stribeck_friction", "load_friction", "gear_friction", "hysteresis", "plastic_set", "viscoelastic_creep",
    "mullins_softening", "stiffening", "stiffness_drift", "fluid_drag", "actuator_deadband", "marker_slip",
)  # fmt: skip
# what a parameter is, by the first of the model's fields that it changes: a mass changes inertias too, and a modulus
# damping
_FIELDS = (
    (("body_mass",), "payload"),
    (("jnt_stiffness", "tendon_stiffness", "flex_stiffness", "flex_bending", "flex_young"), "stiffness"),
    (("actuator_gainprm",), "actuator gain"),
    (("actuator_forcerange",), "actuator strength"),
    (("actuator_biasprm",), "actuator offset"),
    (("dof_frictionloss", "tendon_frictionloss", "geom_friction"), "friction"),
    (("dof_damping", "tendon_damping", "flex_damping"), "damping"),
    (("dof_armature", "body_inertia"), "inertia"),
    (("site_pos", "site_quat"), "sensor shift"),
    (("tendon_lengthspring", "qpos_spring"), "offset at rest"),
    (("body_pos", "body_quat", "geom_pos", "geom_quat"), "mounting"),
)  # fmt: skip


@dataclass(frozen=True)
class Side:
    """One of the two recordings: parameter coordinates (d,), and effects."""

    x: Floats
    effects: tuple[Effect, ...]


class Change(Protocol):
    """What may have changed; coordinates are (size,)."""

    @property
    def size(self) -> int:
        """Number of coordinates."""

    @property
    def bounds(self) -> Floats:
        """(2, size) least and largest coordinates."""

    @property
    def typical(self) -> Floats:
        """(size,) coordinates of a typical change."""

    @property
    def magnitudes(self) -> tuple[bool, ...]:
        """Which coordinates are zero without the change."""

    @property
    def key(self) -> tuple[str, str]:
        """Name and location, to tell it from others."""

    def sides(self, z: Floats, x: Floats, shared: Sequence[Effect]) -> tuple[Side, Side]:
        """The robot before and after the change.

        Args:
            z: (size,) of the change.
            x: (d,) of the parameters before it.
            shared: effects of both recordings.
        """


@dataclass(frozen=True)
class ParameterChange:
    """A parameter of the robot that is another one afterwards; its coordinate is in prior deviations.

    index: among the priors. kind, location: what it is, from the model's
    fields that it changes. mass: kg that one unit of the parameter adds to the robot, 0 for other parameters.
    """

    index: int
    prior: Prior
    kind: str
    location: Location | None
    mass: float
    size: int = 1
    magnitudes: tuple[bool, ...] = (True,)

    @property
    def bounds(self) -> Floats:
        """(2, 1) both ends of the prior, from anywhere in it."""
        low, high = self.prior.reach()
        return np.array([[low - high], [high - low]])

    @property
    def typical(self) -> Floats:
        """(1,) half a deviation."""
        return np.array([0.5])

    @property
    def key(self) -> tuple[str, str]:
        """Name and location."""
        return self.prior.name, "parameter"

    def sides(self, z: Floats, x: Floats, shared: Sequence[Effect]) -> tuple[Side, Side]:
        """The robot before and after the change."""
        moved = x.copy()
        moved[self.index] += z[0]
        return Side(x, tuple(shared)), Side(moved, tuple(shared))


@dataclass(frozen=True)
class LawChange:
    """A law that acts in one of the recordings only."""

    term: Term

    @property
    def kind(self) -> str:
        """What it is, in words."""
        return _KINDS.get(self.term.name, self.term.name.replace("_", " "))

    @property
    def size(self) -> int:
        """Number of coordinates of the law."""
        return self.term.size

    @property
    def one_sided(self) -> bool:
        """Whether it has one direction only."""
        return bool(self.term.bounds[0, 0] == 0.0)

    @property
    def bounds(self) -> Floats:
        """(2, size) those of the law; of its other direction too, where that means before."""
        found = self.term.bounds.copy()
        if self.one_sided:
            found[0, 0] = -found[1, 0]
        return found

    @property
    def typical(self) -> Floats:
        """(size,) the law with typical magnitudes."""
        return self.term.simulated

    @property
    def magnitudes(self) -> tuple[bool, ...]:
        """Which coordinates are zero without the law."""
        return self.term.magnitudes

    @property
    def key(self) -> tuple[str, str]:
        """Name and location."""
        return self.term.name, str(self.term.location)

    def removed(self, z: Floats) -> bool:
        """Whether the law acts before and not after."""
        return self.one_sided and bool(z[0] < 0)

    def effect(self, z: Floats) -> Effect:
        """The law that acts on one side."""
        return self.term.effect(np.concatenate([[abs(z[0])], z[1:]]) if self.removed(z) else z)

    def sides(self, z: Floats, x: Floats, shared: Sequence[Effect]) -> tuple[Side, Side]:
        """The robot before and after the change; a law that both have anyway grows by it."""
        own, plain = _joined(self.effect(z), shared), tuple(shared)
        return (Side(x, own), Side(x, plain)) if self.removed(z) else (Side(x, plain), Side(x, own))


def _joined(effect: Effect, shared: Sequence[Effect]) -> tuple[Effect, ...]:
    """Effects with one more; its magnitude is added to that of the same law at the same place."""
    found = []
    for each in shared:
        if (each.name, each.location) == (effect.name, effect.location):
            first = ALL[effect.name].quantities[0]
            total = each.parameters[first.name] + effect.parameters[first.name] - first.null
            total = float(np.clip(total, *first.bounds))
            effect = Effect(effect.name, effect.location, {**effect.parameters, first.name: total})
        else:
            found.append(each)
    return (*found, effect)


def possible_changes(robot: Robot) -> list[ParameterChange | LawChange]:
    """Every parameter, every law at every location, and laws at all locations of a kind from one cause."""
    found: list[ParameterChange | LawChange] = [_parameter_change(robot, i) for i in range(len(robot.priors))]
    every = [
        Location(kind, EVERY)
        for kind in ("tendon", "joint", "actuator")
        if len(robot.locations(kind)) > 1
    ]  # fmt: skip
    both = [term(robot, name, at) for name in EVERYWHERE for at in every if at.kind in PHYSICS[name].kinds]
    both = [one for one in both if robot.accepts([one.effect(one.simulated)])]
    laws = list(dict.fromkeys([*both, *(one for one in terms(robot) if one.name not in _ALIKE and not one.removable)]))
    return found + [LawChange(one) for one in laws if not _only_damps(robot, one)]


def _only_damps(robot: Robot, one: Term) -> bool:
    """Whether a law of stiffness acts on joints that have none, and so on their dampers alone."""
    if one.name != "local_stiffness" or one.location.kind not in ("body", "joint"):
        return False
    elements = robot.elements
    at = elements.id(one.location)
    joints = np.array([at]) if one.location.kind == "joint" else elements.joints_of(at)
    return len(joints) > 0 and not elements.stiff(joints)


def _parameter_change(robot: Robot, index: int) -> ParameterChange:
    """What a parameter is, from two compiled models that differ by it."""
    prior, x = robot.priors[index], np.zeros(len(robot.priors))
    plain, moved = ({**robot.parameters(x)} for _ in range(2))
    moved[prior.name] = float(prior.value(0.5))
    first, masses = _fields(robot.model(plain, []))
    second, _ = _fields(robot.model(moved, []))
    kind = "parameter"
    for names, kind_of in _FIELDS:
        if any(name in first and not np.array_equal(first[name], second[name]) for name in names):
            kind = kind_of
            break
    mass, location = 0.0, None
    if kind == "payload":
        added = second["body_mass"] - masses
        mass = float(added.sum()) / (moved[prior.name] - plain[prior.name])
        at = np.flatnonzero(added)
        if len(at) == 1:
            location = Location("body", robot.elements.model.body(int(at[0])).name)
    return ParameterChange(index, prior, kind, location, mass)


def _fields(model: mujoco.MjModel) -> tuple[dict[str, Floats], Floats]:
    """Copies of the fields that say what a parameter is, and the masses."""
    names = [name for names, _ in _FIELDS for name in names if hasattr(model, name)]
    return {name: np.array(getattr(model, name), float) for name in names}, np.array(model.body_mass, float)
