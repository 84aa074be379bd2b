"""Other simulations of the same robot: how far they are apart says how far another simulator may be.

None of them is more accurate than the others. They are replayed at a few points without effects, and only their
differences from the robot's own simulation are used (estimation/discretisation.py).
"""

from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.replays import Replays
from soro_bench.models.trunk_chain import displacements, simulate_chain

Variant = Callable[[Sequence[Drive], Floats], list[Floats]]  # drives, (N, d) parameters -> (N, T, C) of each drive

CHAINS = (10, 15, 30)  # links; as many as necks, a few more, and enough for a rod
_CHAIN_TIMESTEP = 0.005  # s


_INTEGRATOR = mujoco.mjtIntegrator
_OTHER = {
    int(_INTEGRATOR.mjINT_IMPLICITFAST): _INTEGRATOR.mjINT_EULER,
    int(_INTEGRATOR.mjINT_IMPLICIT): _INTEGRATOR.mjINT_EULER,
}


def plain(robot: Replays) -> Variant:
    """A robot's replays without effects."""
    return lambda drives, parameters: robot.simulate_all(drives, parameters, [()] * len(parameters))


def with_other_integrator(robot: Replays) -> Replays:
    """The robot, from now on by another integrator: implicitfast, or Euler where it was implicit."""
    integrator = _OTHER.get(int(robot.simulation.model.opt.integrator), _INTEGRATOR.mjINT_IMPLICITFAST)
    robot.simulation.batch.expand("opt.integrator")[...] = int(integrator)
    return robot


def trunk_chains(names: Sequence[str], control_timestep: float) -> list[Variant]:
    """The trunk as chains of other numbers of links than it has necks.

    Args:
        names: of the parameters, in the order of their columns.
        control_timestep: s.
    """
    return [partial(_replayed, links, names, control_timestep) for links in CHAINS]


def _replayed(
    links: int, names: Sequence[str], control_timestep: float, drives: Sequence[Drive], parameters: Floats
) -> list[Floats]:
    every, found = round(control_timestep / _CHAIN_TIMESTEP), []
    for drive in drives:
        pulls = displacements(drive.actions, _CHAIN_TIMESTEP, every)
        rows = (dict(zip(names, row, strict=True)) for row in parameters.tolist())
        points = np.stack([simulate_chain(links, _CHAIN_TIMESTEP, row, pulls, every)[1:] for row in rows])
        found.append(points.reshape(*points.shape[:2], -1))
    return found
