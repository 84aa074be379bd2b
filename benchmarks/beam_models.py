"""The silicone beam: how it is best simulated, and its frequency and decay recorded and simulated.

    python benchmarks/beam_models.py models
    python benchmarks/beam_models.py gravity --data data/real
    python benchmarks/beam_models.py load52 --data data/real --report runs/studies/silicone_beam_0/load

models: frequency, damping by the time steps, and what a step costs. A beam without damping, clamped, swings about where
a force of 0.1 N at its end bends it. `chain` is ``soro_bench/models/silicone_beam.py``; `flex` is rigid slices that
move freely, joined by trilinear cells with nodes on both, of an elastic constant along the beam that is Young's modulus
and across it the shear modulus of a beam.

gravity, load52: parameters are fitted to the recording a, without effects; with --report those and the effects are what
a diagnosis has found. Then what is left of the recordings a and b, and of the height of the first marker in windows of
two periods a fit of A exp(-s t) cos(2 pi f t + p) + c + d t: amplitude A, frequency f, logarithmic decrement s / f.
"""

import argparse
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import least_squares

from soro_bench.diagnosis.baseline import baseline
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import FITTED
from soro_bench.files import mjcf_path, read_toml
from soro_bench.models import silicone_beam as beam
from soro_bench.recording.importers import import_recording

# --- models ---

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


def _add_cell(spec: mujoco.MjSpec, k: int, near: mujoco.MjsBody, far: mujoco.MjsBody) -> None:
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


def models() -> None:
    """Print a table."""
    slender = 3.516 / (2 * np.pi) * np.sqrt(BENDING / (beam.DENSITY * AREA * beam.LENGTH**4))
    static = 1e3 * (beam.LENGTH**3 / (3 * BENDING) + beam.LENGTH / (beam.SHEAR * AREA))
    print(f"theory: {static:.2f} mm/N; {slender:.2f} Hz without shear and turning inertia")
    print("model            step [ms]  nv  mm/N   Hz     damping ratio  us per step")
    models = [(f"flex, {n} cells", flex(n, h), h) for n in (5, 10) for h in (1e-3, 2.5e-4)]
    models += [(f"chain, {s.count} slices", chain(s, s.timestep), s.timestep) for s in (beam.COARSE, beam.FINE)]
    for name, spec, step in models:
        nv, deflection, frequency, ratio, cost = measured(spec)
        print(f"{name:17}{1e3 * step:<11}{nv:<4}{deflection:<7.2f}{frequency:<7.3f}{ratio:<15.4f}{cost:.0f}")


# --- recordings ---

FREQUENCY = {"gravity": 7.7, "load52": 4.4}  # Hz, about
LOADS = {"gravity": "0", "load52": "52"}  # g on a string
WINDOWS, FROM = 5, 0.3  # from 0.3 s after the hand lets go: its fingers and the slack string are out of the way


def decay(time: np.ndarray, height: np.ndarray, frequency: float) -> np.ndarray:
    """(WINDOWS, 3) amplitude [mm], frequency [Hz] and logarithmic decrement."""
    found = []
    for k in range(WINDOWS):
        chosen = (time >= 2 * k / frequency) & (time < 2 * (k + 1) / frequency)
        t, h = time[chosen] - time[chosen][0], 1e3 * height[chosen]

        def left(q: np.ndarray, t: np.ndarray = t, h: np.ndarray = h) -> np.ndarray:
            return q[0] * np.exp(-q[1] * t) * np.cos(2 * np.pi * q[2] * t + q[3]) + q[4] + q[5] * t - h

        starts = [[np.ptp(h) / 2, 2.0, frequency, phase, h.mean(), 0.0] for phase in (0, 1.5, 3, 4.5)]
        best = min((least_squares(left, start) for start in starts), key=lambda fit: fit.cost)
        found.append([abs(best.x[0]), best.x[2], best.x[1] / best.x[2]])
    return np.array(found)


def recorded(options: argparse.Namespace) -> None:
    """Print the table of a kind of recordings."""
    kind, model = options.kind, mjcf_path("real/silicone_beam.xml")
    found = baseline(options.report) if options.report else None
    robot = ModelRobot(model, model.with_suffix(".toml"), baseline=found).shortened(FITTED)
    mapping, folder = read_toml(mjcf_path("real/silicone_beam_import.toml")), options.data / "silicone_beam_arm"
    mapping["metadata"]["load"] = LOADS[kind]
    measured = [robot.measured(import_recording(folder / f"beam_{kind}_V2_{run}.csv", mapping)) for run in "ab"]
    x = np.zeros(len(robot.priors))
    if not found:
        _, nominal = nominal_fit(
            unexplained(robot, (measured[0],), data_quality(measured[0]).sigma), robot.refined(), seed=0
        )
        x = nominal.x
    print("; ".join(map(str, robot.known_effects)) or "no effects")
    print(", ".join(f"{name} {value:.4g}" for name, value in robot.parameters(x).items()))
    for run, each in zip("ab", measured, strict=True):
        _compare(unexplained(robot, (each,), 1.0), x, f"{kind} {run}", FREQUENCY[kind])


def _compare(problem: Problem, x: np.ndarray, label: str, frequency: float) -> None:
    (measured,) = problem.recordings
    simulated = problem.simulated(problem.robot, [(x, ())])[0].reshape(measured.values.shape)
    left = 1e3 * np.sqrt(np.nanmean((measured.values - simulated) ** 2))
    held = np.asarray(measured.settings)[:, 0]
    since = measured.time - measured.time[np.flatnonzero(held == 0)[0]] - FROM
    seen = np.isfinite(measured.values[:, 0, 0])  # not every step of the simulation was recorded
    rows = [decay(since[seen], each[seen, 0, 0], frequency) for each in (measured.values, simulated)]
    print(f"{label}: {left:.3f} mm rms of a coordinate; recorded | simulated amplitude mm, Hz, decrement")
    for recorded, replayed in zip(*rows, strict=True):
        print("   " + " | ".join(f"{a:6.3f} {f:6.3f} {d:6.3f}" for a, f, d in (recorded, replayed)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["models", *FREQUENCY])
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--report", type=Path, help="folder of a diagnosis")
    options = parser.parse_args()
    if options.kind == "models":
        models()
    else:
        recorded(options)


if __name__ == "__main__":
    main()
