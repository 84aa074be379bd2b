"""Laws of the catalogue that MJCF has, beside those that are in the fields of a simulation's model.

Dry friction is MuJoCo's own, which has no presliding. Delays and lags begin at zero, not at the first command.
"""

import math
from collections.abc import Callable, Mapping

import mujoco

from soro_bench.effects.effect import Effect
from soro_bench.effects.elements import Elements

_WHOLE = 1e-9  # time steps, rounding of a delay
_STIFF = 2.0  # time steps, in which MuJoCo's friction stops a slip: it allows no shorter time
_HARD = (0.99, 0.99, 0.001, 0.5, 2.0)  # how much of a slip it stops: on an arm it is then nearest to the law
_Law = Callable[[mujoco.MjSpec, str, str, Mapping[str, float]], bool]


def write_law(spec: mujoco.MjSpec, elements: Elements, effect: Effect) -> bool:
    """Give a spec an effect that MJCF can express; False, and the spec is as it was, if it cannot.

    Args:
        spec: every element that the effect acts on has a name.
        elements: of the model that was compiled from it.
    """
    law = LAWS.get(effect.name)
    if law is None:
        return False
    original = spec.copy()
    for location in elements.expand(effect.location):
        if not law(spec, location.kind, location.name, effect.parameters):
            _restore(spec, original)
            return False
    return True


def _restore(spec: mujoco.MjSpec, original: mujoco.MjSpec) -> None:
    """Give actuators what they had before; no law that can be refused changes anything else."""
    for actuator, before in zip(spec.actuators, original.actuators, strict=True):
        for name in _CHANGED:
            setattr(actuator, name, getattr(before, name))


_CHANGED = (
    "gainprm", "biasprm", "biastype", "dyntype", "dynprm", "actdim", "actearly", "nsample", "interp", "delay",
)  # fmt: skip


def _friction(spec: mujoco.MjSpec, kind: str, name: str, values: Mapping[str, float]) -> bool:
    element = spec.joint(name) if kind == "joint" else spec.tendon(name)
    if values["friction"] < 0.0:  # which is taken away from what the model has
        element.frictionloss = max(element.frictionloss + values["friction"], 0.0)
        return True
    if not element.frictionloss:
        element.solref_friction, element.solimp_friction = (_STIFF * spec.option.timestep, 1.0), _HARD
    element.frictionloss += values["friction"]
    return True


def _gain(spec: mujoco.MjSpec, kind: str, name: str, values: Mapping[str, float]) -> bool:
    """The force is linear in the setpoint: its gain, or all terms of an affine one."""
    actuator = spec.actuator(name)
    if not _linear(actuator):
        return False
    actuator.gainprm[:3] = values["gain"] * actuator.gainprm[:3]
    return True


def _offset(spec: mujoco.MjSpec, kind: str, name: str, values: Mapping[str, float]) -> bool:
    """A shift of the setpoint is a constant force where the gain is one."""
    actuator = spec.actuator(name)
    none, affine = mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE
    if actuator.gaintype != mujoco.mjtGain.mjGAIN_FIXED or actuator.biastype not in (none, affine):
        return False
    if actuator.biastype == none:
        actuator.biastype, actuator.biasprm[:3] = affine, [0.0, 0.0, 0.0]
    actuator.biasprm[0] += actuator.gainprm[0] * values["offset"]
    return _linear(actuator)


def _linear(actuator: mujoco.MjsActuator) -> bool:
    """Whether its force is a factor times its setpoint plus a bias: control or activation, as it is or filtered."""
    gains = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE
    dynamics = mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_INTEGRATOR
    return actuator.gaintype in gains and actuator.dyntype in dynamics and actuator.actdim <= 1


def _delay(spec: mujoco.MjSpec, kind: str, name: str, values: Mapping[str, float]) -> bool:
    """MuJoCo's history of controls, read between samples as the law does."""
    actuator, delay = spec.actuator(name), values["delay"]
    if delay < 0.0:
        actuator.delay = max(actuator.delay + delay, 0.0)
        actuator.nsample = actuator.nsample if actuator.delay else 0
        return True
    if actuator.nsample or not _linear(actuator):
        return False
    actuator.nsample = math.ceil(delay / spec.option.timestep - _WHOLE) + 1
    actuator.interp, actuator.delay = 1, delay
    return True


def _lag(spec: mujoco.MjSpec, kind: str, name: str, values: Mapping[str, float]) -> bool:
    """A filter of the control, whose new value acts in the same time step."""
    actuator = spec.actuator(name)
    if values["time_constant"] < 0.0:
        actuator.dynprm[0] = max(actuator.dynprm[0] + values["time_constant"], 0.0)
        return True
    if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE or not _linear(actuator):
        return False
    actuator.dyntype, actuator.actdim, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, 1, 1
    actuator.dynprm[0] = values["time_constant"]
    return True


LAWS: dict[str, _Law] = {
    "coulomb_friction": _friction,
    "stribeck_friction": _friction,
    "actuator_gain": _gain,
    "pretension": _offset,
    "actuator_delay": _delay,
    "actuator_lag": _lag,
}
