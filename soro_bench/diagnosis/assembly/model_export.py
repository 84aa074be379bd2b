"""A robot's model in MJCF with other parameters and with the effects that MJCF can express."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.native_laws import write_law
from soro_bench.diagnosis.robots.model_file import with_advice
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.effects.effect import Effect
from soro_bench.effects.elements import without_unused_springs
from soro_bench.models.simulation import quiet

_ROUNDING = 1e-9  # of a field's largest value; what differs by more may be why models move apart
_MENTIONED = 5  # fields, in a message
_FREE, _TRUE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtAlignFree.mjALIGNFREE_TRUE
_UNALIGNED = mujoco.mjtAlignFree.mjALIGNFREE_FALSE


class PatchError(ValueError):
    """MJCF cannot say what the fitted model is."""


@dataclass(frozen=True)
class ExportedModel:
    """MJCF of a robot. effects: in it. remaining: what it lacks."""

    xml: str
    effects: tuple[Effect, ...]
    remaining: tuple[Effect, ...]


def exported(robot: Robot, parameters: Mapping[str, float], effects: Sequence[Effect], note: str = "") -> ExportedModel:
    """A robot's model with parameters and effects; it moves as the simulation with those that a model's fields hold.

    Args:
        note: for the comment at the top of the file.

    Raises:
        PatchError: MJCF cannot say what they change, such as the stiffness matrix of a flex; names it.
    """
    in_fields = [effect for effect in effects if robot.native(effect)]
    spec = patched_spec(robot, parameters, in_fields)
    checked(_text(spec), robot.model(parameters, in_fields))
    written = [effect for effect in effects if effect in in_fields or write_law(spec, robot.elements, effect)]
    remaining = [effect for effect in effects if effect not in written]
    comment = " ".join([_comment(robot, parameters, written, remaining), note]).strip()
    spec.comment = re.sub("-(?=-)", "- ", comment)  # two hyphens would end it
    xml = _text(spec)
    if len(written) > len(in_fields):
        checked(xml, spec.compile())
    return ExportedModel(xml, tuple(written), tuple(remaining))


def patched_spec(robot: Robot, parameters: Mapping[str, float], effects: Sequence[Effect]) -> mujoco.MjSpec:
    """A robot's model with parameters and with effects of its fields, all of its values explicit.

    Raises:
        PatchError: MuJoCo cannot write a field that they change, or refuses its value, such as an inertia that no body
            can have.
    """
    spec, model = robot.spec(), robot.model(parameters, effects)
    with warnings.catch_warnings():  # of attributes that a later MuJoCo will not have, and the patched model has not
        warnings.simplefilter("ignore")
        make_explicit(spec, spec.compile())
    for actuator in spec.actuators:  # a mapping may widen ranges
        actuator.ctrllimited = int(model.actuator_ctrllimited[model.actuator_ctrladr[actuator.id]])
    try:
        spec.compile()
        spec.copy_back(model)
        spec.compile()
    except ValueError as error:
        raise PatchError(f"MJCF cannot hold the fitted model: {with_advice(error)}") from error
    return without_unused_springs(spec)


def checked(xml: str, model: mujoco.MjModel) -> mujoco.MjModel:
    """The model of an MJCF text, which has to move as ``model`` does.

    Raises:
        PatchError: it cannot be read, or moves in another way; names the fields that differ.
    """
    try:
        again = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise PatchError(f"the fitted model cannot be read again from MJCF: {with_advice(error)}") from error
    found = motion_difference(model, again)
    if not found.alike:
        lost = _differing(model, again)
        names = ", ".join(lost[:_MENTIONED] + ["..."] * (len(lost) > _MENTIONED)) or "values that no field shows"
        raise PatchError(
            f"MJCF cannot hold the fitted {names}: within {found.seconds:g} s the written model is "
            f"{found.largest:.2g} m or rad from the fitted one"
        )
    return again


def _text(spec: mujoco.MjSpec) -> str:
    """MJCF of a spec: as it is written, with all digits; as it was compiled, with six, where MuJoCo refuses that."""
    spec.compile()
    try:
        spec.compiler.savecompiled = 0
        return spec.to_xml()
    except ValueError:  # attached models with other settings of the compiler
        spec.compiler.savecompiled = 1
        return spec.to_xml()


def _differing(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """Names of the fields of the same shape that differ by more than rounding."""
    found = []
    for name in sorted(MODEL_FIELDS):
        a, b = (np.array(attrgetter(name)(each), float) for each in (model, other))
        scale = np.abs(a).max(initial=0.0)
        if a.shape == b.shape and not np.allclose(a, b, rtol=0.0, atol=_ROUNDING * scale, equal_nan=True):
            found.append(name)
    return found


def _comment(
    robot: Robot, parameters: Mapping[str, float], written: Sequence[Effect], remaining: Sequence[Effect]
) -> str:
    named = [(prior.name, parameters[prior.name], prior.unit) for prior in robot.priors]
    named += [(each.name, each.value, each.unit) for each in robot.fixed]
    values = ", ".join(f"{name} {value:.6g} {unit}" for name, value, unit in named)
    said = [f"Robot of {robot.name}, model {robot.model_name}, as diagnosed. Parameters: {values}."]
    said.append(f"Effects in this model: {listed(written) or 'none'}.")
    if remaining:
        said.append(f"Not in this model: {listed(remaining)}.")
    if written:
        said.append("effects.json has all effects, those of this model too: do not apply it here.")
    return " ".join(said)


def listed(effects: Sequence[Effect]) -> str:
    """Effects with their locations, in words."""
    return ", ".join(f"{effect.name} at {effect.location}" for effect in effects)


# --- explicit values: what a compiler would derive from other masses, positions and ranges ---


def make_explicit(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Give a spec the values that its compiler derived for ``model``, which was compiled from it just now.

    A patched model has other masses, positions or ranges than the model that it comes from. What a compiler derives
    from them (inertia from geoms, damping from a ratio, ranges from those of joints) would change too, but a simulation
    whose fields change keeps it. So it is written as it was compiled, and MuJoCo need not derive it again.
    """
    infers = any(_derives_mass(body.compiler) for body in spec.bodies)
    for body in spec.bodies[1:]:
        if (infers or not body.explicitinertial) and not _aligned(body):
            _set_inertial(body, model)
    for body in spec.bodies:
        _keep_inertia(body.compiler)
    for joint in spec.joints:
        if any(joint.springdamper):
            joint.stiffness[0] = model.jnt_stiffness[joint.id]  # the first coefficients of polynomials
            joint.damping[0] = model.dof_damping[model.jnt_dofadr[joint.id]]
            joint.springdamper = [0.0, 0.0]
    for tendon in spec.tendons:
        tendon.springlength = _row(model, "tendon_lengthspring", tendon.id)
    for actuator in spec.actuators:
        _set_actuator(actuator, model)
    _keep_inertia(spec.compiler)
    spec.compiler.LRopt.useexisting = 1


def _derives_mass(compiler: mujoco.MjsCompiler) -> bool:
    """Whether masses or inertia that are written may not be those of the model."""
    geoms = compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    bounds = compiler.boundmass > 0 or compiler.boundinertia > 0
    return bool(geoms or bounds or compiler.settotalmass > 0 or compiler.balanceinertia)


def _keep_inertia(compiler: mujoco.MjsCompiler) -> None:
    """Masses and inertia are as they are written, or of geoms where nothing is written."""
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.boundmass = compiler.boundinertia = 0.0
    compiler.settotalmass, compiler.balanceinertia = -1.0, 0


def _aligned(body: mujoco.MjsBody) -> bool:
    """Whether compilation moves the frame of a body into its centre of mass; its inertial is none of its own frame."""
    free = [joint.align for joint in body.joints if joint.type == _FREE]
    return any(align == _TRUE or (align != _UNALIGNED and body.compiler.alignfree) for align in free)


def _set_inertial(body: mujoco.MjsBody, model: mujoco.MjModel) -> None:
    body.mass, body.inertia = float(_row(model, "body_mass", body.id)[0]), _row(model, "body_inertia", body.id)
    body.ipos, body.iquat = _row(model, "body_ipos", body.id), _row(model, "body_iquat", body.id)
    body.fullinertia = [float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0]  # not a number: the three of the axes count
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.explicitinertial = 1


def _set_actuator(actuator: mujoco.MjsActuator, model: mujoco.MjModel) -> None:
    """What comes from inertia (dampratio), from a joint (inheritrange) and from the whole model (lengthrange)."""
    actuator.gainprm = _row(model, "actuator_gainprm", actuator.id)
    actuator.biasprm = _row(model, "actuator_biasprm", actuator.id)
    if actuator.inheritrange:
        integrates = actuator.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        name = "actrange" if integrates else "ctrlrange"
        setattr(actuator, name, _row(model, f"actuator_{name}", actuator.id))
        actuator.inheritrange = 0.0
    actuator.lengthrange = _row(model, "actuator_lengthrange", actuator.id)


def _row(model: mujoco.MjModel, field: str, row: int) -> Floats:
    """Numbers of one element."""
    return getattr(model, field)[row].reshape(-1)


# --- whether two models are one robot: whether they move alike ---

ALIKE = 1e-6  # m or rad, and of positions beyond 1 their share: models that differ by less are one
LONG, SHORT = 2.0, 0.2  # s, replayed; the short one of chaotic models
_SEQUENCES = 3  # of random commands
_HELD = 0.1  # s, a command
_SAMPLES = 100  # at most, of a replay
_SPEED = 0.1  # m/s or rad/s, of the first motion: masses and dampings show in all degrees of freedom
_CHANGE = 1e-10  # m/s or rad/s; it shows how chaotic a model is
_RESET = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]


@dataclass(frozen=True)
class MotionDifference:
    """How two models differ over some seconds. largest: [m or rad], as ``ALIKE`` says; infinite where their positions
    are not the same numbers. chaotic: whether a change by 1e-10 m/s or rad/s would grow beyond ``ALIKE``."""

    largest: float
    seconds: float
    chaotic: bool

    @property
    def alike(self) -> bool:
        """Whether the models are one."""
        return self.largest <= ALIKE


@quiet()
def motion_difference(model: mujoco.MjModel, other: mujoco.MjModel) -> MotionDifference:
    """Compare replays of random commands, the same ones each time: of 2 s, or of 0.2 s where the motion is chaotic."""
    if (model.nq, model.nv, model.nu, model.nbody) != (other.nq, other.nv, other.nu, other.nbody):
        return MotionDifference(np.inf, 0.0, False)
    short = _compared(model, other, SHORT)
    if short > ALIKE:  # a long replay could only be farther away
        return MotionDifference(short, SHORT, False)
    chaotic = any(
        _largest(_replay(model, seed, LONG), _replay(model, seed, LONG, _CHANGE)) > ALIKE for seed in range(_SEQUENCES)
    )
    if chaotic:
        return MotionDifference(short, SHORT, True)
    return MotionDifference(_compared(model, other, LONG), LONG, False)


def _compared(model: mujoco.MjModel, other: mujoco.MjModel, seconds: float) -> float:
    """The largest difference in several replays of some seconds."""
    return max(_largest(_replay(model, seed, seconds), _replay(other, seed, seconds)) for seed in range(_SEQUENCES))


def _replay(model: mujoco.MjModel, seed: int, seconds: float, change: float = 0.0) -> Floats:
    """(T, n) positions of joints and bodies; they end where MuJoCo finds that the simulation diverges.

    Args:
        change: of the first velocities [m/s or rad/s], of random sign.
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    data.qvel[:] = _SPEED * rng.standard_normal(model.nv) + change * rng.choice([-1.0, 1.0], model.nv)
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    steps = max(round(seconds / model.opt.timestep), 1)
    held, every = max(round(_HELD / model.opt.timestep), 1), max(steps // _SAMPLES, 1)
    found = []
    for step in range(steps):
        if step % held == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        if any(data.warning[each].number for each in _RESET):
            break
        if step % every == 0:
            found.append(np.concatenate([data.qpos, data.xpos.ravel()]))
    return np.array(found).reshape(len(found), -1)


def _largest(one: Floats, other: Floats) -> float:
    """The largest difference of positions (T, n), of large ones as a share."""
    if one.shape != other.shape:
        return np.inf
    return float((np.abs(one - other) / np.maximum(np.abs(one), 1.0)).max(initial=0.0))
