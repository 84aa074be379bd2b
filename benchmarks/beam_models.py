"""How the silicone beam is best simulated: its frequency, its damping by the time steps, and what a step costs.

    python benchmarks/beam_models.py

A beam without damping, clamped, swings about where a force of 0.1 N at its end bends it. `chain` is
``soro_bench/models/silicone_beam.py``; `flex` is rigid slices that move freely, joined by trilinear cells with nodes on
both, of an elastic constant along the beam that is Young's modulus and across it the shear modulus of a beam.
"""

import argparse
import time
import warnings

import mujoco
import numpy as np

from soro_bench.models import silicone_beam as beam

FORCE, SECONDS = 0.1, 0.6
AREA, BENDING = beam.SIDE**2, beam.YOUNG * beam.SIDE**4 / 12


def flex(count: int, timestep: float) -> mujoco.MjSpec:
    """The beam of slices joined by cells; the last slice is half as long as the others."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = timestep, mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.gravity = [0, 0, 0]
    before, length = spec.worldbody.add_body(name="clamp"), beam.LENGTH / count
    for k in range(count):
        body = spec.worldbody.add_body(name=f"slice{k + 1}", pos=[0, 0, (k + 1) * length])
        body.add_freejoint()
        extent = length if k < count - 1 else length / 2
        mass = beam.DENSITY * AREA * extent
        across = mass * (AREA + extent**2) / 12
        body.explicitinertial, body.mass, body.ipos = True, mass, [0, 0, (extent - length) / 2]
        body.inertia = [across, across, mass * AREA / 6]
        _add_cell(spec, k, before, body)
        before = body
    body.add_site(name="edge")
    return spec


def _add_cell(spec, k, near, far):
    half = beam.SIDE / 2
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (0, 1)]
    nodes = np.array([(x, y, 0.0) for x, y, _ in corners]).ravel()
    bodies = [(near, far)[z].name for *_, z in corners]
    # Lame parameters for which lambda + 2 mu is Young's modulus of the beam, and mu its shear modulus
    mu, lame = beam.SHEAR, beam.YOUNG - 2 * beam.SHEAR
    spec.add_flex(
        name=f"cell{k + 1}", dim=3, order=1, radius=0, vert=nodes, vertbody=bodies, node=nodes, nodebody=bodies,
        elem=[0, 2, 4, 3, 0, 4, 1, 3, 4, 2, 6, 3, 4, 6, 7, 3, 4, 5, 1, 3, 4, 7, 5, 3],
        young=mu * (3 * lame + 2 * mu) / (lame + mu), poisson=lame / (2 * (lame + mu)),
        contype=0, conaffinity=0, selfcollide=mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
    )  # fmt: skip


def chain(slices: beam.Slices, timestep: float) -> mujoco.MjSpec:
    """The beam of the diagnosis without load, hand, weight and damping."""
    spec = beam.silicone_beam(slices)
    spec.option.timestep, spec.option.gravity = timestep, [0, 0, 0]
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.delete(spec.body("load"))
    for joint in spec.joints:
        joint.damping = [0, 0, 0]
    return spec


def measured(spec: mujoco.MjSpec) -> tuple[int, float, float, float, float]:
    """Degrees of freedom, deflection [mm/N], frequency [Hz], damping ratio, time of a step [us]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of elastic parameters without equality constraints
        model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    edge, steps = data.site("edge"), round(SECONDS / model.opt.timestep)
    first, body = edge.xpos.copy(), model.site("edge").bodyid[0]
    mujoco.mj_applyFT(model, data, np.array([FORCE, 0, 0]), np.zeros(3), first, body, data.qfrc_applied)
    way, began = np.zeros(steps), time.process_time()
    for i in range(steps):
        mujoco.mj_step(model, data)
        way[i] = edge.xpos[0] - first[0]
    cost = 1e6 * (time.process_time() - began) / steps
    rising = np.flatnonzero(np.diff((way > way.mean()).astype(int)) > 0)
    period = (rising[3] - rising[0]) / 3  # steps
    early, late = way[: round(2 * period)], way[round(2 * period) : round(4 * period)]
    ratio = np.log(early.std() / late.std()) / (4 * np.pi)
    return model.nv, 1e3 * late.mean() / FORCE, 1 / (period * model.opt.timestep), ratio, cost


def main() -> None:
    """Print a table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    slender = 3.516 / (2 * np.pi) * np.sqrt(BENDING / (beam.DENSITY * AREA * beam.LENGTH**4))
    static = 1e3 * (beam.LENGTH**3 / (3 * BENDING) + beam.LENGTH / (beam.SHEAR * AREA))
    print(f"theory: {static:.2f} mm/N; {slender:.2f} Hz without shear and turning inertia")
    print("model            step [ms]  nv  mm/N   Hz     damping ratio  us per step")
    models = [(f"flex, {n} cells", flex(n, h), h) for n in (5, 10) for h in (1e-3, 2.5e-4)]
    models += [(f"chain, {s.count} slices", chain(s, s.timestep), s.timestep) for s in (beam.COARSE, beam.FINE)]
    for name, spec, step in models:
        nv, deflection, frequency, ratio, cost = measured(spec)
        print(f"{name:17}{1e3 * step:<11}{nv:<4}{deflection:<7.2f}{frequency:<7.3f}{ratio:<15.4f}{cost:.0f}")


if __name__ == "__main__":
    main()
