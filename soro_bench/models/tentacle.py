"""A real silicone tentacle with two tendons as a chain of rigid pieces, for the diagnosis of its static shapes.

    python -m soro_bench.models.tentacle

writes ``assets/mjcf/real/tentacle.xml``. The TOML file beside it is not generated.

All numbers are those of the authors' model (github.com/tud-phi/soromox at 4f03054, MIT, its folder
paper_results/secVa_system_identification) before they fit anything, unless a line says otherwise. The frame is that of
their motion capture: y points down.
"""

import mujoco
import numpy as np

from soro_bench.files import mjcf_path

GRAVITY = 9.81  # m/s^2
LENGTH, RADIUS, TAPER = 0.36, 0.01541, 0.0295  # m; m at the base; m per m, to 4.80 mm at the tip
YOUNG, DENSITY = 505e3, 1500.0  # Pa, kg/m^3
# degrees from x to z, which the authors count as 30 and 150 from another axis: the recordings show which; m, where they
# end, and from the axis
TENDONS, TIED, OFFSET = (60.0, -60.0), 0.305, 0.0114
MARKERS = ((0.1291, 0.025), (0.2195, -0.021), (0.280, 0.020), (0.368, 0.0))  # m along the axis, and off it along x
_ROOT = (-0.030, -0.006, -0.013)  # m, from the base marker: the authors' 30 and 13 mm, and y so that m1 is right
_PIECES = 12
# m, from a joint to the holes on both sides: further away a tendon would cut corners, and pull more where it bends more
_HOLE = 0.001
# s, damping over stiffness, of no effect on a shape at rest: assumed, so that the model comes to rest within 3 s
_RELAXATION = 0.05
_TIMESTEP = 0.01  # s; the discrete integrator is implicit in the springs, but not in tensions, and 0.05 s is too long


def radius(at: float) -> float:
    """m, of the rod at a distance [m] from its base."""
    return RADIUS - TAPER * at


def tentacle(pieces: int = _PIECES) -> mujoco.MjSpec:
    """The tentacle, hanging, with holes of its tendons beside its joints and four markers."""
    spec = mujoco.MjSpec()
    spec.modelname = "tentacle"
    spec.option.timestep, spec.option.gravity = _TIMESTEP, (0, GRAVITY, 0)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    body, frame = spec.worldbody.add_body(name="root", pos=_ROOT), 0.0
    # as many diameters long each: it bends most where it is thin
    edges = (RADIUS - radius(0.0) * (radius(LENGTH) / RADIUS) ** (np.arange(pieces + 1) / pieces)) / TAPER
    holes = [[_hole(body, i, 0.0, 0.0)] for i in range(len(TENDONS))]
    for k in range(pieces):
        middle = (edges[k] + edges[k + 1]) / 2
        before, body = body, body.add_body(name=f"piece{k + 1}of{pieces}", pos=[0, middle - frame, 0])
        for i in range(len(TENDONS)):
            if middle < TIED:
                holes[i] += [_hole(before, i, middle - _HOLE, frame), _hole(body, i, middle + _HOLE, middle)]
        frame = middle
        _add_piece(body, middle, edges[k + 1] - edges[k])
        for n, (along, aside) in enumerate(MARKERS):
            if edges[k] < along <= edges[k + 1] or (k == pieces - 1 and along > LENGTH):
                body.add_site(name=f"m{n + 1}", pos=[aside, along - middle, 0])
    for i, sites in enumerate(holes):
        tendon = spec.add_tendon(name=f"tendon{i + 1}")
        for site in sites:
            tendon.wrap_site(site)
        spec.add_actuator(
            name=f"motor{i + 1}", trntype=mujoco.mjtTrn.mjTRN_TENDON, target=tendon.name, gear=[-1, 0, 0, 0, 0, 0],
            ctrllimited=True, ctrlrange=[0, 15],  # N; 7.7 N is the largest of one tendon
        )  # fmt: skip
    return spec


def _hole(body: mujoco.MjsBody, tendon: int, at: float, middle: float) -> str:
    """A hole of a tendon at a distance [m] from the base, on a body whose frame is at ``middle`` [m]."""
    angle, offset = np.radians(TENDONS[tendon]), OFFSET - TAPER * at
    name = f"hole{tendon + 1}_{1000 * at:.0f}"
    body.add_site(name=name, pos=[offset * np.cos(angle), at - middle, offset * np.sin(angle)])
    return name


def _add_piece(body: mujoco.MjsBody, middle: float, length: float) -> None:
    """Two hinges in its middle that are as stiff as a piece, and its mass."""
    r = radius(middle)
    stiffness = YOUNG * np.pi / 4 * r**4 / length
    for axis, direction in (("x", [1, 0, 0]), ("z", [0, 0, 1])):
        body.add_joint(
            name=f"bend_{axis}{body.name.removeprefix('piece')}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=direction,
            stiffness=[stiffness, 0, 0], damping=[_RELAXATION * stiffness, 0, 0],
        )  # fmt: skip
    mass = DENSITY * np.pi * r**2 * length
    across = mass * (3 * r**2 + length**2) / 12
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, [0, 0, 0], [across, mass * r**2 / 2, across]
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, -length / 2, 0, 0, length / 2, 0], size=[r, 0, 0],
        contype=0, conaffinity=0, mass=0,
    )  # fmt: skip


def main() -> None:
    """Write the model."""
    note = "<!-- Written by soro_bench/models/tentacle.py, which has the sources of all numbers. -->\n"
    spec = tentacle()
    spec.compile()
    (mjcf_path("trunk.xml").parent / "real" / "tentacle.xml").write_text(note + spec.to_xml())


if __name__ == "__main__":
    main()
