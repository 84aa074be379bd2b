"""Stiffness of every neck of the compiled models against the finite-element table.

    python benchmarks/neck_fit.py

The trunk beyond a neck is moved rigidly by a small amount (a bend or twist about the neck's middle, a stretch, a
sideways shift) and the elastic force on it read from MuJoCo's ``qfrc_spring``, at E = 4.5 MPa.
"""

import argparse

import mujoco
import numpy as np

from soro_bench import parameters as prm
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet

# motion -> the freejoint coordinate (3 translations, 3 rotations) that it moves and that resists it
MOTIONS = {"bend": 3, "bend_y": 4, "twist": 5, "axial": 2, "shear": 0}
STEP = {"bend": 1e-4, "bend_y": 1e-4, "twist": 1e-4, "axial": 1e-6, "shear": 1e-6}  # rad or m
# The table's compliance between and at its rows, relative to nu = 0.45
MEAN_COMPLIANCE = {
    "bend": {0.40: 1.10, 0.425: 1.06, 0.475: 0.89, 0.49: 0.74},
    "axial": {0.40: 1.07, 0.49: 0.87},
    "twist": {0.40: 1.08, 0.49: 0.69},
}


def compiled(name: str, poisson_ratio: float) -> mujoco.MjModel:
    """The model with its parameters written, as an environment uses it."""
    model = trunk.build_spec("reach.xml", name).compile()
    parameters = ParameterSet(*trunk.PARAMETERS)
    sim = Simulation(model, parameters, [trunk.TrunkParameters(model)], nsim=1)
    values = {"poisson_ratio": poisson_ratio, "young_modulus": geo.YOUNG_MODULUS_OF_TABLE}
    sim.set_params(np.arange(1), parameters.to_array(values)[None])
    return sim.batch.get_model(0)


def flex_stiffness(model: mujoco.MjModel, motion: str, size: float | None = None) -> np.ndarray:
    """(10,) N/m or N m/rad, from central differences of +-``size``."""
    data = mujoco.MjData(model)
    size = STEP[motion] if size is None else size
    coordinate = MOTIONS[motion]
    return np.array([
        (_flex_force(model, data, k, coordinate, -size) - _flex_force(model, data, k, coordinate, size)) / (2 * size)
        for k in range(geo.NUM_NECKS)
    ])


def _flex_force(model, data, k, coordinate, size):
    """Force or torque on vertebra ``k`` along ``coordinate``, the trunk beyond neck k moved by ``size`` along it."""
    mujoco.mj_resetData(model, data)
    pivot = data.qpos[7 * k : 7 * k + 3].copy()  # the vertebra's frame, at the neck's middle
    turn = np.array([1.0, 0, 0, 0])
    if coordinate >= 3:
        mujoco.mju_axisAngle2Quat(turn, np.eye(3)[coordinate - 3], size)
    for j in range(k, geo.NUM_NECKS):
        pose = data.qpos[7 * j : 7 * j + 7]
        moved = np.empty(3)
        mujoco.mju_rotVecQuat(moved, pose[:3] - pivot, turn)
        pose[:3] = pivot + moved
        if coordinate < 3:
            pose[coordinate] += size
        pose[3:] = turn
    mujoco.mj_forward(model, data)
    return data.qfrc_spring[6 * k + coordinate]


def cable_stiffness(model: mujoco.MjModel, motion: str) -> np.ndarray:
    """(10,) the same for the joints of the serial chain."""
    data = mujoco.MjData(model)
    joint = {"bend": "bend_x"}.get(motion, motion)
    force = []
    for k in range(geo.NUM_NECKS):
        mujoco.mj_resetData(model, data)
        data.joint(f"{joint}{k}").qpos[0] = STEP[motion]
        mujoco.mj_forward(model, data)
        force.append(-data.qfrc_spring[model.joint(f"{joint}{k}").dofadr[0]] / STEP[motion])
    return np.array(force)


def main():
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    tables = {"bend": geo.BEND, "axial": geo.AXIAL, "twist": geo.TWIST}
    tables |= {"bend_y": geo.BEND, "shear": geo.AXIAL / geo.AXIAL_PER_SHEAR}
    for name, measure in (("flex", flex_stiffness), ("cable", cable_stiffness)):
        print(f"{name}: measured stiffness / table - 1, in parts per million, necks 0 to 9")
        for motion in MOTIONS if name == "flex" else ("bend", "bend_y", "axial"):
            for row, nu in enumerate(geo.POISSON_RATIO_OF_TABLE):
                error = 1e6 * (measure(compiled(name, nu), motion) / tables[motion][row] - 1)
                print(f"  {motion:7} nu {nu:.2f} " + " ".join(f"{e:8.3f}" for e in error))
    print("mean compliance relative to nu 0.45, all necks: model (finite elements)")
    for motion, expected in MEAN_COMPLIANCE.items():
        reference = flex_stiffness(compiled("flex", 0.45), motion)
        for nu, value in expected.items():
            ratio = (reference / flex_stiffness(compiled("flex", nu), motion)).mean()
            print(f"  {motion:7} nu {nu:.3f} {ratio:.3f} ({value})  {100 * (ratio / value - 1):+.1f} %")
    print("flex: secant stiffness at a finite motion / that at a small one, mean over necks")
    model = compiled("flex", prm.POISSON_RATIO.nominal)
    for motion, sizes in {"bend": (0.1, 0.3, 0.6, 1.0), "twist": (0.1, 0.3), "axial": (1e-3, 2e-3)}.items():
        small = flex_stiffness(model, motion)
        for size in sizes:
            ratio = (flex_stiffness(model, motion, size) / small).mean()
            print(f"  {motion:7} {size:5} {'m' if motion == 'axial' else 'rad':3} {ratio:.3f}")


if __name__ == "__main__":
    main()
