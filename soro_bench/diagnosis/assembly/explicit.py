"""Explicit values in a MuJoCo spec for what its compiler would derive.

A patched model has other masses, positions or ranges than the model that it comes from. What a compiler derives from
them (inertia from geoms, damping from a ratio, ranges from those of joints) would change too, but a simulation whose
fields change keeps it. So it is written as it was compiled, and MuJoCo need not derive it again.
"""

import mujoco

from soro_bench.arrays import Floats

_FREE, _TRUE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtAlignFree.mjALIGNFREE_TRUE
_UNALIGNED = mujoco.mjtAlignFree.mjALIGNFREE_FALSE


def make_explicit(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Give a spec the values that its compiler derived for ``model``, which was compiled from it just now."""
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
