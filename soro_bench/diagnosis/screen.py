"""Screening: how much of what is left would each effect explain?

Each suspect is simulated once at a typical magnitude. The response, less what a change of parameters or numerical error
would do too, is compared with the residual: a linear estimate of its magnitude and of the evidence gained.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.diagnosis.fit import MAGNITUDE_DEVIATION, Hypothesis, Problem, Suspect
from soro_bench.diagnosis.robot import Robot
from soro_bench.effects.catalogue import ALL, PHYSICS
from soro_bench.effects.effect import EVERY, Port


def suspects(robot: Robot, points: int) -> list[Suspect]:
    """Every effect at every port of the robot, and every fault of its sensor, which has that many points."""
    found = []
    for name, law in PHYSICS.items():
        if name in PNEUMATIC:
            continue
        for kind in law.kinds:
            ports = [] if kind == "joint" and "body" in law.kinds else robot.ports(kind)
            every = [Port(kind, EVERY)] if law.shared and len(ports) > 1 else []
            for port in every if law.only_shared else every + ports:
                found += variants(suspect(robot, name, port))
    for name, fault in ALL.items():
        if name not in PHYSICS and name != "outliers":
            indices = range(points) if fault.local else [None]
            found += [suspect(robot, name, Port("sensor", robot.signal, i)) for i in indices]
    return found


def suspect(robot: Robot, name: str, where: Port) -> Suspect:
    """An effect at a port, with what is typical there."""
    quantities, magnitudes = ALL[name].quantities, []
    for i, q in enumerate(quantities):
        magnitudes.append(i == 0 or (q.null == 0.0 and q.bounds[0] < 0))
    scale = robot.elements.scale
    port = robot.ports(where.kind)[0] if where.name == EVERY else where
    typical = tuple(q.typical * (scale(port, q.of) if where.kind != "sensor" else 1.0) for q in quantities)
    return Suspect(name, where, typical, tuple(magnitudes))


PNEUMATIC = ("pressure_leak", "pressure_asymmetry", "supply_coupling")


def variants(one: Suspect) -> list[Suspect]:
    """A suspect, and those that begin at other values of what shapes the signature."""
    found = [one]
    for i, q in enumerate(ALL[one.name].quantities):
        for value in q.also:
            found.append(replace(one, typical=(*one.typical[:i], value, *one.typical[i + 1 :])))
    return found


@dataclass(frozen=True)
class Lead:
    """A suspect that explains some of what is left: log evidence gained, and estimated coordinates (size,)."""

    suspect: Suspect
    gain: float
    x: np.ndarray


def responses(problem: Problem, base: Hypothesis, candidates: Sequence[Suspect]) -> list[np.ndarray]:
    """(k, M) of each suspect: change of the residual per standard deviation of each of its k magnitudes."""
    points, shares = [], []
    for candidate in candidates:
        for column in np.flatnonzero(candidate.magnitudes):
            x = np.zeros(candidate.size)
            x[column] = 1.0 / MAGNITUDE_DEVIATION
            points.append((np.concatenate([base.x, x]), (*base.suspects, candidate)))
            shares.append(x[column])
    found = (problem.residuals(points) - base.residual) / np.array(shares)[:, None]
    ends = np.cumsum([sum(c.magnitudes) for c in candidates])
    return np.split(found, ends[:-1])


def screen(problem: Problem, base: Hypothesis, candidates: Sequence[Suspect], found) -> list[Lead]:
    """Leads, the best first; ``found`` are the responses of the candidates."""
    floor = base.floor(problem)
    hessian = floor.product(base.slope, base.slope) + np.eye(len(base.x))
    gradient = floor.product(base.slope, base.residual[None])[:, 0] + base.x
    leads = []
    for candidate, response in zip(candidates, found, strict=True):
        cross = floor.product(response, base.slope)
        reduced = np.linalg.solve(hessian, cross.T).T
        own = floor.product(response, response) + np.eye(len(response)) - reduced @ cross.T
        pull = floor.product(response, base.residual[None])[:, 0] - reduced @ gradient
        at = -np.linalg.solve(own, pull)
        lower = candidate.lower[list(candidate.magnitudes)]
        at = np.maximum(at, lower)
        gain = -float(pull @ at + 0.5 * at @ own @ at) - 0.5 * float(np.linalg.slogdet(own)[1])
        x = np.zeros(candidate.size)
        x[list(candidate.magnitudes)] = at
        leads.append(Lead(candidate, gain, x))
    return sorted(leads, key=lambda lead: -lead.gain)
