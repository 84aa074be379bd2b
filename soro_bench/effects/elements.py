"""The elements of a MuJoCo model that effects act on, and what a model needs so that they can."""

from dataclasses import dataclass, field

import mujoco
import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.effects.effect import EACH, EVERY, EffectError, Location

AUXILIARY = "auxiliary:"  # and a joint's name: a spring of the effects, beside the joint's own
FOUND = "found_at_"  # the same in a patched model
NEVER = 1e9  # m or rad, a yield threshold that is not reached
SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
OBJECTS = {  # by kind of location
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "flex": mujoco.mjtObj.mjOBJ_FLEX,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
}
_APART = 1e-9  # m; masses that are closer are at one point
_SHARE = 0.03  # of a range, what counts as a typical force or length
_SPEED, _TURN = 0.05, 1.0  # m/s and rad/s, at which a typical damping gives a typical force


def instrument(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Give a model the plastic springs that effects use, without stiffness; it simulates the same numbers.

    MuJoCo allocates the state of a spring that can yield when it compiles: tendons without a spring of their own and
    scalar joints get one, and every scalar joint also a second spring, a fixed tendon.
    """
    for tendon in spec.tendons:
        if not np.any(tendon.stiffness):
            tendon.springyield = NEVER
    for joint in spec.joints:
        if joint.type in SCALAR_JOINTS and joint.name:
            spring = spec.add_tendon(name=AUXILIARY + joint.name)
            spring.wrap_joint(joint.name, 1.0)
            _do_nothing(spring)
    return spec


def _do_nothing(spring: mujoco.MjsTendon) -> None:
    """Whatever the model's defaults give its tendons."""
    spring.stiffness, spring.damping = np.zeros_like(spring.stiffness), np.zeros_like(spring.damping)
    spring.frictionloss = spring.armature = 0.0
    spring.limited = spring.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    spring.springlength, spring.springyield = (-1.0, -1.0), NEVER


def without_unused_springs(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Take from an instrumented model the springs that no effect has given a stiffness; the others become parts of the
    model, which ``instrument`` can prepare again."""
    for tendon in list(spec.tendons):
        own = tendon.name.startswith(AUXILIARY)
        if np.any(tendon.stiffness):
            tendon.name = _free(spec, tendon.name.replace(AUXILIARY, FOUND, 1)) if own else tendon.name
        elif own:
            spec.delete(tendon)
        else:
            tendon.springyield = 0.0
    return spec


def _free(spec: mujoco.MjSpec, name: str) -> str:
    """The name, with a number where one of that name was found before."""
    taken = {tendon.name for tendon in spec.tendons}
    return next(one for one in (name, *(f"{name}_{k}" for k in range(2, len(taken) + 3))) if one not in taken)


@dataclass
class Elements:
    """Names and sizes in a compiled model, whose elements stay as they are."""

    model: mujoco.MjModel
    # what was asked for before
    _found: dict[tuple[Location, bool, bool], list[Location]] = field(default_factory=dict, repr=False, compare=False)
    _joint_ids: dict[tuple[int, bool], Ints] = field(default_factory=dict, repr=False, compare=False)

    def locations(self, kind: str) -> list[Location]:
        """All locations of a kind; for "model" there is one, "gravity"; sensors are the recording's."""
        names = {
            "tendon": self._tendons,
            "joint": self._joints,
            "actuator": lambda: _names(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, self.model.nu),
            "body": self._bodies,
            "flex": lambda: _names(self.model, mujoco.mjtObj.mjOBJ_FLEX, self.model.nflex),
            "geom": self._geoms,
            "model": lambda: ["gravity"],
        }[kind]()
        return [Location(kind, name) for name in names]

    def welded(self) -> list[Location]:
        """Bodies without a joint that move with one before them, such as a gripper that is fixed to a hand.

        They have a mass; frames without one are no parts that carry. Of those whose masses are at one point, and at
        that of a moving body, the first is enough: nothing can tell them apart.
        """
        model = self.model
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        root = model.body_weldid
        found: list[Location] = []
        kept = {i: [data.xipos[i]] for i in range(model.nbody) if model.body_jntnum[i] > 0}
        for i in range(model.nbody):
            near = kept.get(int(root[i])) if model.body_mass[i] > 0 else None
            if root[i] == i or near is None or min(np.abs(data.xipos[i] - each).max() for each in near) < _APART:
                continue
            near.append(data.xipos[i])
            found += [Location("body", model.body(i).name)] if model.body(i).name else []
        return found

    def expand(self, location: Location, elastic: bool = False, welded: bool = False) -> list[Location]:
        """The locations that one stands for; EffectError if there is no such element.

        Args:
            elastic: whether every body is every one that hangs on springs or a flex.
            welded: whether a body may be one without a joint of its own; every body is none of them.
        """
        if (location, elastic, welded) not in self._found:
            self._found[location, elastic, welded] = self._expanded(location, elastic, welded)
        return self._found[location, elastic, welded]

    def _expanded(self, location: Location, elastic: bool, welded: bool) -> list[Location]:
        locations = self.locations(location.kind)
        if welded and location.kind == "body" and location.name != EVERY and location not in locations:
            locations += [Location("body", name) for name in self._moved()]
        if elastic and location == Location("body", EVERY):
            locations = [p for p in locations if self._hangs(self.id(p))]
        all_of_kind = location.name in (EVERY, EACH)
        chosen = locations if all_of_kind else [p for p in locations if p.name == location.name]
        if not chosen:
            there_are = ", ".join(p.name for p in locations) or "none"
            raise EffectError(
                f"the model has no {location.kind} {location.name!r} that an effect could act on ({there_are})"
            )
        return chosen

    def id(self, location: Location) -> int:
        """MuJoCo's number of an element."""
        return mujoco.mj_name2id(self.model, OBJECTS[location.kind], location.name)

    def joints_of(self, body: int, bending_only: bool = False) -> Ints:
        """Scalar joints of a body: its hinges only, where there are some and only bending counts."""
        if (body, bending_only) not in self._joint_ids:
            self._joint_ids[body, bending_only] = self._joints_of(body, bending_only)
        return self._joint_ids[body, bending_only]

    def _joints_of(self, body: int, bending_only: bool) -> Ints:
        model, start = self.model, self.model.body_jntadr[body]
        joints = np.arange(start, start + model.body_jntnum[body])
        hinges = joints[model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE]
        return hinges if bending_only and len(hinges) else joints[np.isin(model.jnt_type[joints], SCALAR_JOINTS)]

    def sprung(self, body: int, bending_only: bool = False) -> Ints:
        """The joints of ``joints_of`` whose springs laws may change: none where the model has no springs but a flex,
        whose nodes or vertices the body moves. Other springs may get their stiffness at run time."""
        model, joints = self.model, self.joints_of(body, bending_only)
        of_flex = body in model.flex_nodebodyid or body in model.flex_vertbodyid
        return joints if not of_flex or self.stiff(joints) else joints[:0]

    def stiff(self, joints: Ints) -> bool:
        """Whether the model has a spring in any of some joints."""
        model = self.model
        return bool(model.jnt_stiffness[joints].any() or model.jnt_stiffnesspoly[joints].any())

    def flex_before(self, body: int) -> int | None:
        """The flex that joins a body, where several of its nodes are, to one before it, as a neck does; None if there
        is none."""
        model = self.model
        for flex in range(model.nflex):
            first = model.flex_nodeadr[flex]
            nodes = model.flex_nodebodyid[first : first + model.flex_nodenum[flex]]
            if np.count_nonzero(nodes == body) > 1 and nodes.max() == body:
                return flex
        return None

    def spring_of(self, joint: int) -> int:
        """The tendon that is the second spring of a joint."""
        name = AUXILIARY + self.model.joint(joint).name
        if (spring := mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_TENDON, name)) < 0:
            raise EffectError(f"joint {self.model.joint(joint).name} has no spring for effects; see instrument()")
        return spring

    def actuators_on(self, location: Location) -> Ints:
        """Actuators that pull at a tendon or turn a joint."""
        kind = {"tendon": mujoco.mjtTrn.mjTRN_TENDON, "joint": mujoco.mjtTrn.mjTRN_JOINT}[location.kind]
        model = self.model
        return np.flatnonzero((model.actuator_trntype == kind) & (model.actuator_trnid[:, 0] == self.id(location)))

    def driven_by(self, actuator: Location) -> Location:
        """The tendon or scalar joint that an actuator drives.

        Raises:
            EffectError: it drives something else.
        """
        model, i = self.model, self.id(actuator)
        target, transmission = int(model.actuator_trnid[i, 0]), model.actuator_trntype[i]
        if transmission == mujoco.mjtTrn.mjTRN_TENDON:
            return Location("tendon", model.tendon(target).name)
        if transmission == mujoco.mjtTrn.mjTRN_JOINT and model.jnt_type[target] in SCALAR_JOINTS:
            return Location("joint", model.joint(target).name)
        raise EffectError(f"{actuator} drives neither a tendon nor a scalar joint")

    def resistance(self, location: Location) -> tuple[str, int]:
        """Where the model has damping and dry friction of a tendon or joint: "tendon" or "dof", and its number."""
        i = self.id(location)
        return ("dof", int(self.model.jnt_dofadr[i])) if location.kind == "joint" else ("tendon", i)

    def turns(self, location: Location) -> bool:
        """Whether what moves at a location turns and does not slide: a hinge, what drives one, a body that bends."""
        if location.kind not in ("joint", "actuator", "body"):
            return False
        model, i = self.model, self.id(self.expand(location)[0])
        if location.kind == "body":
            joints = self.joints_of(i, bending_only=True)
            return not len(joints) or model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_HINGE
        if location.kind == "actuator":
            if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT:
                return False
            i = model.actuator_trnid[i, 0]
        return model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE

    def scale(self, location: Location, of: str | None) -> float:
        """What a typical force, damping or length is a multiple of: a share of the location's range, or 1; of
        compliances it is that of the servo itself, and of masses that of the robot, or 1 kg."""
        if of is None:
            return 1.0
        if of == "mass":
            return max(self._mass(), 1.0)
        if of == "compliance":
            return 1.0 / max(abs(float(self.model.actuator_gainprm[self.id(location), 0])), 1e-6)
        if of == "damping":
            return self.scale(location, "force") / (_TURN if self.turns(location) else _SPEED)
        model = self.model
        if location.kind == "actuator":
            i = self.id(location)
            if of == "force":
                largest = self._largest_force(i) or 1.0
                return _SHARE * _width(model.actuator_forcerange[i], model.actuator_forcelimited[i], largest)
            integrates = model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR
            span = (model.actuator_actrange if integrates else model.actuator_ctrlrange)[i]
            return _SHARE * _width(span, True, 1.0)
        actuators = self.actuators_on(location)
        spans = [_width(model.actuator_forcerange[i], model.actuator_forcelimited[i], 0.0) for i in actuators]
        if spans and max(spans) > 0:
            return _SHARE * max(spans)
        if location.kind == "joint" and (stiffness := float(np.ravel(model.jnt_stiffness[self.id(location)])[0])) > 0:
            return _SHARE * stiffness
        driven = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        near = actuators if len(actuators) or location.kind != "joint" else driven
        largest = max(map(self._largest_force, near), default=0.0)
        return _SHARE * (largest or self._weight(location)) or 1.0

    def _largest_force(self, actuator: int) -> float:
        """What its largest control gives in a joint or tendon [N, N m]; 0 where there is none."""
        model, control = self.model, self.model.actuator_ctrladr[actuator]
        fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        if not (fixed and model.actuator_ctrllimited[control]):
            return 0.0
        factor = abs(float(model.actuator_gainprm[actuator, 0] * model.actuator_gear[actuator, 0]))
        return factor * float(np.abs(model.actuator_ctrlrange[control]).max())

    def _weight(self, location: Location) -> float:
        """N or N m, the largest force in a joint of the weight of what hangs on it; 0 at other locations."""
        if location.kind != "joint":
            return 0.0
        model, i = self.model, self.id(location)
        body = model.jnt_bodyid[i]
        weight = float(model.body_subtreemass[body] * np.linalg.norm(model.opt.gravity))
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_SLIDE:
            return weight
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return weight * float(np.linalg.norm(np.cross(data.xaxis[i], data.subtree_com[body] - data.xanchor[i])))

    def _mass(self) -> float:
        """kg, of all bodies that move but loose objects, which are alone and free."""
        model, free = self.model, int(mujoco.mjtJoint.mjJNT_FREE)
        joints = model.body_jntadr
        alone = np.isclose(model.body_mass, model.body_subtreemass) & (model.body_jntnum == 1)
        loose = alone & (model.jnt_type[np.maximum(joints, 0)] == free if model.njnt else False)
        return float(model.body_mass[~loose & (model.body_weldid != 0)].sum())

    def _hangs(self, body: int) -> bool:
        return len(self.sprung(body)) > 0 or self.flex_before(body) is not None

    def _tendons(self) -> list[str]:
        names = _names(self.model, mujoco.mjtObj.mjOBJ_TENDON, self.model.ntendon)
        return [name for name in names if not name.startswith(AUXILIARY)]

    def _joints(self) -> list[str]:
        model = self.model
        names = _names(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt)
        return [name for name in names if int(model.joint(name).type[0]) in SCALAR_JOINTS]

    def _bodies(self) -> list[str]:
        model = self.model
        moving = [i for i in range(1, model.nbody) if model.body_jntnum[i] > 0]
        return [model.body(i).name for i in moving if model.body(i).name]

    def _moved(self) -> list[str]:
        """Bodies without a joint that move with one before them."""
        model = self.model
        moved = (model.body_jntnum == 0) & (model.body_jntnum[model.body_weldid] > 0)
        return [model.body(i).name for i in np.flatnonzero(moved) if model.body(i).name]

    def _geoms(self) -> list[str]:
        model = self.model
        touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
        return [model.geom(i).name for i in touching if model.geom(i).name]


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> list[str]:
    names = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
    return [name for name in names if name]


def _width(span: Floats, limited: bool, otherwise: float) -> float:
    width = float(np.abs(span).max())
    return width if limited and width > 0 else otherwise


def length_unit(model: mujoco.MjModel, actuator: int) -> str:
    """ "rad" for an actuator that turns a hinge, directly or by a tendon round joints, else "m"."""
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    of_joint = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    target, transmission = model.actuator_trnid[actuator, 0], model.actuator_trntype[actuator]
    if transmission in of_joint:
        return "m" if model.jnt_type[target] == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
    if transmission == int(mujoco.mjtTrn.mjTRN_TENDON):
        path = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
        joints = model.wrap_objid[path][model.wrap_type[path] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
        return "rad" if len(joints) and (model.jnt_type[joints] == hinge).all() else "m"
    return "m"


def setpoint_unit(model: mujoco.MjModel, actuator: int) -> str:
    """The unit of an actuator's setpoint: a length or angle for servos of positions, and its rate for those of
    velocities; a force where the control is one; else "1", as for the inflation of a chamber."""
    length = length_unit(model, actuator)
    if model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE):
        # a model may get its stiffness at run time: both are 0 then
        of_position, of_velocity = model.actuator_biasprm[actuator, 1:3]
        return f"{length}/s" if of_position == 0 and of_velocity != 0 else length
    direct = model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
    direct = direct and model.actuator_gainprm[actuator, 0] * abs(model.actuator_gear[actuator, 0]) == 1.0
    return {"m": "N", "rad": "N m"}[length] if direct else "1"
