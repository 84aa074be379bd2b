"""A real silicone beam as a chain of rigid slices, for the diagnosis of recordings of its free oscillation.

    python -m soro_bench.models.silicone_beam

writes ``assets/mjcf/real/silicone_beam.xml`` and ``hung_beam.xml``. The TOML files beside them are not generated.

Someone holds the beam straight and lets go, so that it falls and swings about where its weight bends it, alone or with
a load that hangs on its end. Joints in the middle of each slice bend about two axes, and slides let it shear.

Why no flex: it needs the discrete integrator, whose steps h damp an oscillation by as much as a damping ratio of
angular frequency times h / 2, at 1 ms half of what the recordings show, and cost forty times as much
(``benchmarks/beam_models.py``). Here springs are explicit and nothing is damped but by the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench.files import mjcf_path

# [authors]: github.com/srl-ethz/diffPD_sim2real, python/realbeam_experiments/real_beam_ds10_load_1_V2.py.
# [recordings]: what beam_gravity_V2_a.csv and beam_load52_V2_a.csv say; x is up, and z goes from the clamp to the end.
GRAVITY = 9.80709  # m/s^2 [authors]
LENGTH, SIDE = 0.1, 0.03  # m [authors]
DENSITY, YOUNG = 1070.0, 263824.0  # kg/m^3, Pa [authors]
SHEAR = YOUNG / 3 * 5 / 6  # Pa, of an incompressible material, times the share of a rectangle that counts in bending
LOAD = 0.51012 / GRAVITY  # kg [authors], who take it for a force on the upper edge of the end
_CLAMP = (0.0536, 0.0303, -0.0265)  # m, its middle: the markers beside it and the authors' places of these
# m, from the middle of the end face to the three markers on it, at the first sample of beam_gravity_V2_a [recordings]
_MARKERS = ((0.0204, 0.0003, 0.0014), (0.0091, 0.0207, 0.0020), (-0.0085, -0.0209, -0.0029))
_RELAXATION = 0.002  # s, damping over stiffness: the oscillation loses a quarter per period [recordings]
# A string holds the load: it first falls slower than the beam, then tears at it, and swings to and fro in 0.9 s
# [recordings].
_STRING = 0.2  # m
_STRING_STIFFNESS, _STRING_DAMPING = 1000.0, 0.2  # N/m, N s/m; assumed: it stretches by 5 mm under the load
_LOAD_DAMPING = 0.005  # N s/m, next to nothing
_HAND_STIFFNESS, _HAND_DAMPING = 1e4, 20.0  # N/m, N s/m: so stiff that the first marker is where it was recorded


@dataclass(frozen=True)
class Slices:
    """How a beam is cut, and a time step [s] that is short enough for the explicit springs of such slices."""

    count: int
    timestep: float


# With 4 slices the first frequency is 0.4 % above that of many. It is no discretisation error for the diagnosis: a fit
# of the stiffness takes it up, and as a floor it explains away frequencies that are wrong by 2 %.
COARSE, FINE = Slices(4, 1e-3), Slices(10, 2.5e-4)


def silicone_beam(slices: Slices = COARSE) -> mujoco.MjSpec:
    """The beam, clamped, with three markers, a hand that can hold the first one, and the load on a string."""
    spec = mujoco.MjSpec()
    spec.modelname = "silicone_beam"
    spec.option.timestep, spec.option.gravity = slices.timestep, (-GRAVITY, 0, 0)
    # explicit in stiffness and implicit in damping
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    length = LENGTH / slices.count
    body, ahead = spec.worldbody.add_body(name="clamp", pos=_CLAMP), length / 2
    for k in range(slices.count):
        # the finer model has other slices, under other names: no effect at one is at the other
        body = body.add_body(name=f"slice{k + 1}of{slices.count}", pos=[0, 0, ahead])
        ahead = length
        _add_slice(body, k, slices)
    for i, place in enumerate(_MARKERS):
        body.add_site(name=f"marker{i}", pos=np.add(place, [0, 0, length / 2]))
    _add_load(spec, body.add_site(name="edge", pos=[SIDE / 2, 0, length / 2]))
    _add_hand(spec)
    return spec


def hung_beam(slices: Slices = COARSE) -> mujoco.MjSpec:
    """The beam in its vertical plane, with the first marker, the hand, and a hook of no weight at the upper edge of its
    end: what hangs there is not part of the model. It bends only: shear makes it 7 % softer, which is a parameter."""
    spec = mujoco.MjSpec()
    spec.modelname = "hung_beam"
    spec.option.timestep, spec.option.gravity = slices.timestep, (-GRAVITY, 0, 0)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    length = LENGTH / slices.count
    body, ahead = spec.worldbody.add_body(name="clamp", pos=_CLAMP), length / 2
    for k in range(slices.count):
        body = body.add_body(name=f"slice{k + 1}of{slices.count}", pos=[0, 0, ahead])
        ahead = length
        stiffness = 0.93 * YOUNG * SIDE**4 / 12 / length
        _add_joint(body, f"bend_{k + 1}of{slices.count}", mujoco.mjtJoint.mjJNT_HINGE, [0, 1, 0], stiffness)
        _add_mass(body, length)
    hook = body.add_body(name="hook", pos=[SIDE / 2, 0, length / 2])
    hook.explicitinertial, hook.mass, hook.ipos, hook.inertia = True, 1e-6, [0, 0, 0], [1e-10] * 3
    body.add_site(name="marker0", pos=np.add(_MARKERS[0], [0, 0, length / 2]))
    _add_hand(spec, ("x",))
    return spec


def _add_slice(body: mujoco.MjsBody, k: int, slices: Slices) -> None:
    """A slice with joints in its middle that are as stiff as it is."""
    length, area = LENGTH / slices.count, SIDE**2
    bending, shear = YOUNG * SIDE**4 / 12 / length, SHEAR * area / length
    for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
        name = f"{axis}{k + 1}of{slices.count}"
        _add_joint(body, f"bend_{name}", mujoco.mjtJoint.mjJNT_HINGE, direction, bending)
        _add_joint(body, f"shear_{name}", mujoco.mjtJoint.mjJNT_SLIDE, direction, shear)
    _add_mass(body, length)


def _add_mass(body: mujoco.MjsBody, length: float) -> None:
    """Mass and inertia of a slice."""
    area = SIDE**2
    mass = DENSITY * area * length
    across = mass * (area + length**2) / 12
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, [0, 0, 0], [across, across, mass * area / 6]
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[SIDE / 2, SIDE / 2, length / 2], contype=0, conaffinity=0, mass=0
    )


def _add_joint(body: mujoco.MjsBody, name: str, kind: mujoco.mjtJoint, axis: Sequence[float], stiffness: float) -> None:
    """A joint with a spring [N/m, N m/rad] and the damping that goes with it."""
    body.add_joint(
        name=name, type=kind, axis=axis, stiffness=[stiffness, 0, 0], damping=[_RELAXATION * stiffness, 0, 0]
    )


def _add_load(spec: mujoco.MjSpec, edge: mujoco.MjsSite) -> None:
    """A point that moves freely, under a string that is slack where it is shorter than at rest."""
    upper = np.add(_CLAMP, [SIDE / 2, 0, LENGTH])
    load = spec.worldbody.add_body(name="load", pos=upper - [_STRING, 0, 0])
    for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])):
        load.add_joint(
            name=f"load_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction, damping=[_LOAD_DAMPING, 0, 0]
        )
    load.explicitinertial = True
    load.mass, load.ipos, load.inertia = LOAD, [0, 0, 0], [1e-6] * 3  # it does not turn
    load.add_geom(size=[0.01, 0, 0], contype=0, conaffinity=0, mass=0)
    string = spec.add_tendon(
        name="string",
        stiffness=[_STRING_STIFFNESS, 0, 0],
        damping=[_STRING_DAMPING, 0, 0],
        springlength=[0, _STRING],
    )
    string.wrap_site(edge.name)
    string.wrap_site(load.add_site(name="hook").name)


def _add_hand(spec: mujoco.MjSpec, axes: Sequence[str] = ("x", "y")) -> None:
    """Servos that hold the first marker across the beam, at positions in the frame of the recordings."""
    spec.worldbody.add_site(name="origin")
    for axis in axes:
        direction = [1, 0, 0] if axis == "x" else [0, 1, 0]
        spec.add_actuator(
            name=f"hand_{axis}", trntype=mujoco.mjtTrn.mjTRN_SITE, target="marker0", refsite="origin",
            gear=[*direction, 0, 0, 0],
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=[_HAND_STIFFNESS] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0, -_HAND_STIFFNESS, -_HAND_DAMPING] + [0] * 7,
        )  # fmt: skip


def main() -> None:
    """Write the model."""
    note = "<!-- Written by soro_bench/models/silicone_beam.py, which has the sources of all numbers. -->\n"
    for spec in (silicone_beam(), hung_beam()):
        spec.compile()
        (mjcf_path("trunk.xml").parent / "real" / f"{spec.modelname}.xml").write_text(note + spec.to_xml())


if __name__ == "__main__":
    main()
