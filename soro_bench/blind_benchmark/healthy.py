"""Healthy robots of other discretisations and simulators: nothing is missing, and yet they do not move like the model.

Five kinds: the cheap trunk at other time steps and integrators, the accurate one at other steps and solver settings,
chains of another number of links, a Cosserat rod in PyElastica, and, in ``sorosim.py``, rods that SoroSim computed.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from gymnasium import spaces

from soro_bench.blind_benchmark.cases import recording
from soro_bench.blind_benchmark.draw import draw_parameters, manoeuvre
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP, Engine, simulate
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.trunk_chain import displacements, simulate_chain
from soro_bench.recording.excitation import excitation
from soro_bench.recording.recording import Recording

DURATIONS = {"train": 20.0, "heldout": 12.0}  # s


@dataclass(frozen=True)
class Chain:
    """A chain of links; ``timestep`` is in seconds."""

    links: int
    timestep: float


@dataclass(frozen=True)
class Rod:
    """A Cosserat rod in PyElastica; ``pieces`` are elements of a neck, ``timestep`` is in seconds."""

    pieces: int
    timestep: float


_INTEGRATORS = {
    name: (("integrator", int(value)),)
    for name, value in (
        ("implicitfast", mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
        ("Euler", mujoco.mjtIntegrator.mjINT_EULER),
        ("RK4", mujoco.mjtIntegrator.mjINT_RK4),
    )
}
_CG = ("solver", int(mujoco.mjtSolver.mjSOL_CG))

# by kind: what stands in a label, and the robot
ROBOTS: dict[str, dict[str, Engine | Chain | Rod]] = {
    "cable": {
        "2.5 ms": Engine("cable", 0.0025),
        "12.5 ms": Engine("cable", 0.0125),
        "5 ms, implicitfast": Engine("cable", 0.005, _INTEGRATORS["implicitfast"]),
        "1.25 ms, RK4": Engine("cable", 0.00125, _INTEGRATORS["RK4"]),
        "5 ms": Engine("cable", 0.005),
        "2.5 ms, Euler": Engine("cable", 0.0025, _INTEGRATORS["Euler"]),
    },
    "flex": {
        "half step": Engine("flex", 0.0025),
        "double step": Engine("flex", 0.010),
        "quarter step": Engine("flex", 0.00125),
        "half step, CG, tolerance 1e-8": Engine("flex", 0.0025, (_CG, ("tolerance", 1e-8))),
    },
    "links": {f"{links} links": Chain(links, 0.0025) for links in (20, 15, 30, 12)},
    "pyelastica": {"2 elements a neck": Rod(2, 2e-4), "3 elements a neck": Rod(3, 1e-4)},
}


def draw(kind: str, seed: int) -> tuple[str, dict[str, float]]:
    """Which robot of a kind the case of a seed has, in turn, and its parameters."""
    names = list(ROBOTS[kind])
    return names[seed % len(names)], draw_parameters(np.random.default_rng([seed, 0]))


def build(kind: str, seed: int, durations: Mapping[str, float] = DURATIONS) -> tuple[dict[str, Recording], dict]:
    """The recordings of a healthy robot by role, and its label.

    Raises:
        ValueError: the simulation diverged.
    """
    name, parameters = draw(kind, seed)
    recordings = {
        role: recording(rows, keypoints(ROBOTS[kind][name], parameters, rows), noise)
        for role, (rows, noise) in drawn_actions(seed, durations).items()
    }
    return recordings, {"kind": kind, "robot": name, "seed": seed, "parameters": parameters, "effects": []}


def drawn_actions(
    seed: int, durations: Mapping[str, float] = DURATIONS
) -> dict[str, tuple[np.ndarray, np.random.Generator]]:
    """By role, of those with a duration, (T, 8) actions, and what draws the noise of their recording."""
    space = spaces.Box(-1.0, 1.0, (len(geo.CABLE_NAMES),), np.float32)
    actions = {
        "train": excitation(space, CONTROL_TIMESTEP, durations["train"], seed),
        "heldout": manoeuvre(durations["heldout"], [seed, 1]),
    }
    if "task" in durations:
        actions["task"] = manoeuvre(durations["task"], [seed, 4])
    return {role: (rows, np.random.default_rng([seed, 2, i])) for i, (role, rows) in enumerate(actions.items())}


def keypoints(robot: Engine | Chain | Rod, parameters: Mapping[str, float], actions: np.ndarray) -> np.ndarray:
    """(T + 1, 21, 3) m, before the first and after each of (T, 8) actions."""
    if isinstance(robot, Engine):
        return simulate(robot, parameters, [], actions).at(CONTROL_TIMESTEP * np.arange(len(actions) + 1))
    every = round(CONTROL_TIMESTEP / robot.timestep)
    pulls = displacements(actions, robot.timestep, every)
    if isinstance(robot, Chain):
        found = simulate_chain(robot.links, robot.timestep, parameters, pulls, every)
        if not np.isfinite(found).all():
            raise ValueError(f"the simulation of {robot.links} links diverged")
        return found
    from soro_bench.blind_benchmark.cosserat import Arm  # needs a package that the others do not

    return Arm(parameters, pieces=robot.pieces, timestep=robot.timestep).run(pulls, every)
