"""Both trunk models against figures of the reference simulator and of finite elements.

    python benchmarks/reference_tips.py

1. Where the tip is after one action from rest, in TrunkReach.
2. The same as a function of the time step and of the integrator.
3. Tip deflection per newton on one cable, without gravity, and how it depends on Poisson's ratio.
"""

import argparse

import gymnasium
import mujoco
import numpy as np

import soro_bench  # noqa: F401  registers the environments
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet

# mm, tip after the action. Action 15 releases a slack cable: free fall. Recorded with the reference simulator by the
# authors of the published study (docs/archive/tasks_and_models.md).
REFERENCE_TIPS = {
    1: (-10.36, -16.37, 181.36),
    3: (10.12, -16.29, 181.40),
    5: (-5.08, -17.37, 181.79),
    15: (0.01, -12.13, 183.36),
}
DEFLECTION = {"L0": 41.6, "S0": 24.2}  # mm/N, tip, finite elements on the reference mesh
# tip compliance relative to nu = 0.45, finite elements
COMPLIANCE = {0.40: 1.10, 0.425: 1.06, 0.475: 0.89, 0.49: 0.74}
LOAD = 0.02  # N, small enough for a linear answer and within the range of every activation
SETTLING_TIME = 5.0  # s


def tips_of_environment(name: str) -> dict[int, np.ndarray]:
    """Tip [mm] after the first action of an episode of TrunkReach."""
    env = gymnasium.make("TrunkReach-v0", model=name)
    tips = {}
    for action in REFERENCE_TIPS:
        env.reset(seed=0)
        observation, *_ = env.step(action)
        tips[action] = 1e3 * observation[60:63]
    env.close()
    return tips


def tips_of_model(name: str, timestep: float, integrator: mujoco.mjtIntegrator) -> dict[int, np.ndarray]:
    """The same with another time step [s] and integrator."""
    model = parametrised(name, {}, timestep, integrator)
    tips = {}
    for action in REFERENCE_TIPS:
        data = mujoco.MjData(model)
        data.ctrl[action % 8] = geo.CABLE_RATE if action < 8 else -geo.CABLE_RATE
        mujoco.mj_step(model, data, round(0.05 / timestep))
        mujoco.mj_kinematics(model, data)
        tips[action] = 1e3 * data.site("keypoint20").xpos
    return tips


def tip_deflection(name: str, cable: str, poisson_ratio: float) -> float:
    """Tip deflection per force on a cable [mm/N], without gravity."""
    model = parametrised(name, {"poisson_ratio": poisson_ratio})
    model.opt.gravity[:] = 0
    model.actuator_gainprm[:] = 0
    model.actuator_biasprm[:] = 0
    data = mujoco.MjData(model)
    model.actuator(cable).gainprm[0] = 1.0  # tension = activation, which stays as long as the control is 0
    data.act[model.actuator(cable).actadr[0]] = LOAD
    mujoco.mj_step(model, data, round(SETTLING_TIME / model.opt.timestep))
    mujoco.mj_kinematics(model, data)
    tip = data.site("keypoint20").xpos
    return 1e3 * np.linalg.norm(tip - [0, 0, geo.KEYPOINT_Z[-1]]) / LOAD


def parametrised(name, params, timestep=None, integrator=None) -> mujoco.MjModel:
    """The model with its parameters written, as an environment uses it."""
    spec = trunk.build_spec("reach.xml", name)
    if timestep is not None:
        spec.option.timestep, spec.option.integrator = timestep, integrator
    model, parameters = spec.compile(), ParameterSet(*trunk.PARAMETERS)
    sim = Simulation(model, parameters, [trunk.TrunkParameters(model)], nsim=1)
    sim.set_params(np.arange(1), parameters.to_array(params)[None])
    return sim.batch.get_model(0)


def print_tips(label: str, tips: dict[int, np.ndarray]):
    """One row per action: tip, difference from the reference, its length."""
    for action, tip in tips.items():
        difference = tip - REFERENCE_TIPS[action]
        vectors = [" ".join(f"{value:7.2f}" for value in vector) for vector in (tip, difference)]
        print(f"{label:26} a = {action:2}  {vectors[0]}  {vectors[1]}  {np.linalg.norm(difference):5.2f}")


def main():
    """Print the three tables."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print("tip after one action [mm]        x       y       z     minus reference: x y z  distance")
    for name in trunk.VARIANTS:
        print_tips(name, tips_of_environment(name))
    print("\ndistance of the tip from the reference [mm]" + "".join(f"  a = {a:2}" for a in REFERENCE_TIPS))
    discrete, fast = mujoco.mjtIntegrator.mjINT_DISCRETE, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name, integrator in (("flex", discrete), ("cable", discrete), ("cable", fast)):
        for timestep in (0.010, 0.005, 0.0025, 0.0005):
            tips = tips_of_model(name, timestep, integrator)
            distances = [np.linalg.norm(tip - REFERENCE_TIPS[action]) for action, tip in tips.items()]
            label = f"{name} {integrator.name.removeprefix('mjINT_').lower()} {1e3 * timestep:g} ms"
            print(f"{label:43}" + "".join(f"{d:8.2f}" for d in distances))
    print("\ntip deflection without gravity [mm/N]  (finite elements)")
    for name in trunk.VARIANTS:
        for cable, expected in DEFLECTION.items():
            nominal = tip_deflection(name, cable, 0.45)
            print(f"{name:6} {cable}  nu 0.45  {nominal:6.2f}  ({expected})  {100 * (nominal / expected - 1):+.1f} %")
            for nu, ratio in COMPLIANCE.items():
                value = tip_deflection(name, cable, nu) / nominal
                print(f"{name:6} {cable}  nu {nu:<5}  x {value:.3f}  ({ratio})  {100 * (value / ratio - 1):+.1f} %")


if __name__ == "__main__":
    main()
