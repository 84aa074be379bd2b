"""How often intervals of a diagnosis hold the truth, of an arm that sticks.

    python benchmarks/interval_coverage.py --arms 6

Every arm is simulated with parameters drawn from their priors, dry friction that its model lacks, and a tenth of the
model's time step. Only ratios of all these forces show in the motion. Prints, of every number, the truth and its 90 %
interval, and how many intervals hold it: as they are, and from the slopes that the fits ended with. Of another law
than dry friction there is no friction to hold.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.blind_benchmark.report import report_of
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.pipeline import Diagnosis, run_diagnosis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.markdown import header, row
from soro_bench.recording.recording import Recording, Signal

ARM = """<mujoco model="arm"><option timestep="0.005" integrator="discrete"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.02" armature="0.002"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.2" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position name="motor" joint="hinge" kp="1.5" kv="0.05" ctrlrange="-1.2 1.2"/></actuator></mujoco>"""
FIELDS = {
    "mass": (0.2, ["body_mass:arm", "body_inertia:arm"]),
    "damping": (0.5, ["dof_damping:hinge"]),
    "kp": (0.2, ["actuator_gainprm[0]:motor", "actuator_biasprm[1]:motor", "actuator_biasprm[2]:motor"]),
    "armature": (0.5, ["dof_armature:hinge"]),
}  # standard deviation of the prior's logarithm, and what is scaled
MAP = """[robot]
control_timestep = 0.01
[commands.goal]
actuators = ["motor"]
[signal]
name = "angle"
joints = ["hinge"]
unit = "rad"
[initial]
joints = ["hinge"]
""" + "".join(f"[parameters.{name}]\nfields = {fields}\ndeviation = {deviation}\n"
              for name, (deviation, fields) in FIELDS.items())  # fmt: skip
FRICTION, NOISE, SECONDS = 0.06, 9e-4, 15.0  # N m, rad


def recording(truth: dict[str, float], rng: np.random.Generator) -> Recording:
    """Of the arm with its true parameters, under triangles of several speeds."""
    spec = mujoco.MjSpec.from_string(ARM)
    spec.option.timestep /= 10
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.joint("hinge").frictionloss = FRICTION
    spec.joint("hinge").solref_friction = [2 * spec.option.timestep, 1.0]  # sticks; by default it creeps
    model = spec.compile()
    model.body("arm").mass *= truth["mass"]
    model.body("arm").inertia *= truth["mass"]
    model.dof_damping *= truth["damping"]
    model.dof_armature *= truth["armature"]
    model.actuator_gainprm *= truth["kp"]
    model.actuator_biasprm *= truth["kp"]
    data, time = mujoco.MjData(model), 0.01 * np.arange(round(SECONDS / 0.01))
    corners = np.cumsum(rng.uniform(0.3, 2.0, 40))
    goals = np.interp(time, [0.0, 1.0, *(1.0 + corners)], [0.0, 0.0, *rng.uniform(-1.0, 1.0, 40)])
    angles = np.zeros(len(time) + 1)
    for i, goal in enumerate(goals):
        data.ctrl[0] = goal
        mujoco.mj_step(model, data, nstep=20)
        angles[i + 1] = data.qpos[0]
    angles += NOISE * rng.standard_normal(len(angles))
    times = 0.01 * np.arange(len(angles))
    return Recording({"goal": Signal(time, goals[:, None])}, {"angle": Signal(times, angles, "rad")})


def intervals(found: Diagnosis) -> dict[str, tuple[float, float]]:
    """90 % intervals of the parameters and of the friction, if that is the answer."""
    report = report_of(build_result(found))
    ends = {name: tuple(each["ci90"]) for name, each in report["parameters"].items()}
    first = report["effects"][0]["parameters"]
    return ends | ({"friction": tuple(first["friction"]["ci90"])} if "friction" in first else {})


def of_slopes(found: Diagnosis) -> Diagnosis:
    """The same with the covariances that the slopes of the fits say."""
    answers = [replace(a, hypothesis=replace(a.hypothesis, known=None)) for a in found.comparison.answers]
    return replace(found, comparison=replace(found.comparison, answers=tuple(answers)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=6)
    options = parser.parse_args()
    print(header(("arm", "answer", "what", "truth", "interval", "from slopes")), flush=True)
    held = []
    with tempfile.TemporaryDirectory() as folder:
        model, mapping = Path(folder) / "arm.xml", Path(folder) / "map.toml"
        model.write_text(ARM)
        mapping.write_text(MAP)
        for seed in range(options.arms):
            rng = np.random.default_rng(seed)
            truth = {name: float(np.exp(deviation * rng.standard_normal())) for name, (deviation, _) in FIELDS.items()}
            found = run_diagnosis(
                ModelRobot(model, mapping, threads=1), [recording(truth, rng)], [recording(truth, rng)]
            )
            both, name = (intervals(found), intervals(of_slopes(found))), " with ".join(found.best.names) or "nothing"
            for what, value in {**truth, "friction": FRICTION}.items():
                ends = [each.get(what, (np.nan, np.nan)) for each in both]
                held.append([low <= value <= high for low, high in ends])
                print(row((seed, name, what, f"{value:.3g}", *(f"{low:.3g} to {high:.3g}" for low, high in ends))),
                      flush=True)  # fmt: skip
    count = np.sum(held, axis=0)
    print(f"\n{count[0]} of {len(held)} intervals hold the truth, {count[1]} of those from slopes")


if __name__ == "__main__":
    main()
