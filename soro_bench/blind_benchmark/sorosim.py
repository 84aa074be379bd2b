"""Rods that SoroSim computed, as recordings of a robot, and MuJoCo chains as the models that they are diagnosed with.

A release is a recording: the rod is held by forces at its middle and tip, which are its commands, and let go after
the first control step. Gravity is another in each release, so each has a model of its own. Data: ``data/reference/
sorosim`` of github.com/ContinuumRoboticsLab/opencr-mujoco at 17fff8b (MIT), as releases.csv and release_NAME.csv.
"""

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.recording.recording import Recording, Signal

LENGTH, RADIUS, YOUNG, POISSON, DENSITY = 0.6, 0.0008, 200e9, 0.33, 7870.0  # m, m, Pa, 1, kg/m^3: steel [data]
_PIECES, _FINER, _TIMESTEP = 10, 20, 5e-4  # of the model and the accurate one; s
_TWISTS = 1e-8  # kg m^2 more for each piece: its own 3e-10 about the axis would need steps of 10 us
_CONTROL, _DURATION = 0.01, 5.0  # s
_RELAXED, _HEAVIER = 3.0, 10.0  # s in which the held model comes to rest, with so many times the damping
_SPREAD = 0.2  # of the model's parameters about those of the rod, logarithmic
_NOISE = 0.0005  # m
_POINTS = ("middle", "tip")
_ACCURATE = "finer.xml"


def releases(folder: Path) -> list[dict[str, str]]:
    """Rows of releases.csv: of steel, which no moments hold.

    Raises:
        FileNotFoundError: there is no such table in the folder.
    """
    with open(folder / "releases.csv", newline="", encoding="utf-8") as file:
        if not (found := [row for row in csv.DictReader(file) if row["material"] == "steel"]):
            raise FileNotFoundError(f"{folder / 'releases.csv'} has no release of steel")
    return found


def build(folder: Path, seed: int) -> tuple[dict[str, str], Recording, dict]:
    """Texts of files by name, the recording of a release, the next one for the next seed, and the label.

    Files: model.xml; map.toml; finer.xml, the accurate model that the map names. Ten pieces leave up to 0.5 mm of
    SoroSim's motion, as much as the noise, and twenty 0.2 mm.
    """
    rows = releases(folder)
    row, rng = rows[seed % len(rows)], np.random.default_rng(seed)
    factors = {name: math.exp(rng.uniform(-_SPREAD, _SPREAD)) for name in ("stiffness", "mass", "damping")}
    held = np.array([float(row[f"{part}_force_{axis}"]) for part in ("mid", "tip") for axis in "xyz"])  # N
    gravity = np.array([float(row[f"gravity_{axis}"]) for axis in "xyz"])
    models = [_model(pieces, gravity, float(row["true_damping_s"]), factors, held) for pieces in (_PIECES, _FINER)]
    table = np.genfromtxt(folder / f"{row['take']}.csv", delimiter=",", names=True, max_rows=round(_DURATION / 0.005))
    points = np.stack([np.column_stack([table[f"{p}_{a}_m"] for a in "xyz"]) for p in ("mid", "tip")], axis=1)[::2]
    points = np.concatenate([points[:1], points])  # it is still held at the end of the first control step
    times = _CONTROL * np.arange(len(points))
    commands = np.zeros((len(points) - 1, len(held)))
    commands[0] = held
    measured = points + _NOISE * rng.standard_normal(points.shape)
    recording = Recording(
        {"forces": Signal(times[:-1], commands, "N")}, {"points": Signal(times, measured, "m", "world")}
    )
    truth = {name: 1 / factor for name, factor in factors.items()}
    label = {"kind": "sorosim", "robot": row["take"], "seed": seed, "parameters": truth, "effects": []}
    return {"model.xml": models[0], "map.toml": _map(), _ACCURATE: models[1]}, recording, label


def _model(pieces: int, gravity: np.ndarray, damping: float, factors: Mapping[str, float], held: np.ndarray) -> str:
    """MJCF of a rod with the posture in which forces hold it."""
    spec = chain(pieces, gravity, damping, factors)
    spec.add_key(name="held", qpos=_posture(spec, held))
    return spec.to_xml()


def chain(pieces: int, gravity: np.ndarray, damping: float, factors: Mapping[str, float]) -> mujoco.MjSpec:
    """A steel rod along x as pieces with joints in their middles.

    Args:
        pieces: how many, an even number.
        gravity: (3,) m/s^2.
        damping: s, damping over stiffness.
        factors: of "stiffness", "mass" and "damping".
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep, spec.option.gravity = _TIMESTEP, gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_site(name="world")
    step, inertia = LENGTH / pieces, math.pi * RADIUS**4 / 4
    bend = factors["stiffness"] * YOUNG * inertia / step
    body, ahead = spec.worldbody.add_body(name="clamp"), step / 2
    for k in range(pieces):
        body, ahead = body.add_body(name=f"piece{k}", pos=[ahead, 0, 0]), step
        length = step if k < pieces - 1 else step / 2
        mass = factors["mass"] * DENSITY * math.pi * RADIUS**2 * length
        across = mass * (3 * RADIUS**2 + length**2) / 12 + _TWISTS
        body.explicitinertial, body.mass, body.ipos = True, mass, [length / 2, 0, 0]
        body.inertia = [mass * RADIUS**2 / 2 + _TWISTS, across, across]
        for name, about, k_joint in (
            ("twist", (1, 0, 0), bend / (1 + POISSON)),
            ("bend_y", (0, 1, 0), bend),
            ("bend_z", (0, 0, 1), bend),
        ):
            joint = body.add_joint(name=f"{name}{k}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=about)
            joint.stiffness[0], joint.damping[0] = k_joint, k_joint * damping * factors["damping"]
        if k == pieces // 2 - 1:
            body.add_site(name="middle", pos=[step / 2, 0, 0])
    body.add_site(name="tip", pos=[step / 2, 0, 0])
    for point in _POINTS:
        for axis, unit in zip("xyz", np.eye(3), strict=True):
            spec.add_actuator(
                name=f"{point}_{axis}", trntype=mujoco.mjtTrn.mjTRN_SITE, target=point, refsite="world",
                gear=[*unit, 0, 0, 0],
            )  # fmt: skip
    return spec


def _posture(spec: mujoco.MjSpec, held: np.ndarray) -> np.ndarray:
    """Positions in which the model is at rest under forces."""
    model = spec.compile()
    model.dof_damping[:] *= _HEAVIER
    data = mujoco.MjData(model)
    data.ctrl[:] = held
    mujoco.mj_step(model, data, round(_RELAXED / _TIMESTEP))
    return data.qpos.copy()


def _map() -> str:
    names = ", ".join(f'"{point}_{axis}"' for point in _POINTS for axis in "xyz")
    lines = [
        f'[robot]\ncontrol_timestep = {_CONTROL}\nsettle = 0.5\nrelax = true\naccurate = "{_ACCURATE}"',
        f'[commands.forces]\nactuators = [{names}]\nunit = "N"',
        '[signal]\nname = "points"\nsites = ["middle", "tip"]\nunit = "m"\nframe = "world"',
        '[initial]\nkeyframe = "held"',
        f'[parameters.stiffness]\nfields = ["jnt_stiffness:*", "dof_damping:*"]\ndeviation = {_SPREAD}',
        f'[parameters.mass]\nfields = ["body_mass:piece*", "body_inertia:piece*"]\ndeviation = {_SPREAD}',
        f'[parameters.damping]\nfields = ["dof_damping:*"]\ndeviation = {_SPREAD}',
    ]
    return "\n\n".join(lines) + "\n"
