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
    """Suspects that explain some of what is left: log evidence gained, and the estimated coordinates of each."""

    suspects: tuple[Suspect, ...]
    gain: float
    x: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Evidence:
    """What K response rows say together, parameters and floor marginalised: the evidence gained by magnitudes m (K,) is
    -pull m - m matrix m / 2. ``lower`` (K,) bounds them, and ``blocks`` are the rows of each candidate."""

    candidates: tuple[Suspect, ...]
    matrix: np.ndarray
    pull: np.ndarray
    lower: np.ndarray
    blocks: tuple[np.ndarray, ...]

    def lead(self, chosen: Sequence[int]) -> Lead:
        """The best magnitudes of some candidates together."""
        rows = np.concatenate([self.blocks[i] for i in chosen])
        matrix, pull, lower = self.matrix[np.ix_(rows, rows)], self.pull[rows], self.lower[rows]
        at, free = np.zeros(len(rows)), np.ones(len(rows), bool)
        for _ in rows:  # what would cross its bound stays there, and the rest is solved again
            at[free] = -np.linalg.solve(matrix[np.ix_(free, free)], pull[free])
            crossing = at < lower
            if not crossing.any():
                break
            free &= ~crossing
            at[~free] = 0.0
        gain = -float(pull @ at + 0.5 * at @ matrix @ at) - 0.5 * float(np.linalg.slogdet(matrix)[1])
        ends = np.cumsum([len(self.blocks[i]) for i in chosen])[:-1]
        return Lead(
            tuple(self.candidates[i] for i in chosen),
            gain,
            tuple(_coordinates(self.candidates[i], part) for i, part in zip(chosen, np.split(at, ends), strict=True)),
        )


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


def evidence(problem: Problem, base: Hypothesis, candidates: Sequence[Suspect], found) -> Evidence:
    """What the responses ``found`` of the candidates say about the residual of a hypothesis."""
    floor, rows = base.floor(problem), np.concatenate(found)
    hessian = floor.product(base.slope, base.slope) + np.eye(len(base.x))
    gradient = floor.product(base.slope, base.residual[None])[:, 0] + base.x
    cross = floor.product(rows, base.slope)
    reduced = np.linalg.solve(hessian, cross.T).T
    return Evidence(
        tuple(candidates),
        floor.product(rows, rows) + np.eye(len(rows)) - reduced @ cross.T,
        floor.product(rows, base.residual[None])[:, 0] - reduced @ gradient,
        np.concatenate([c.lower[list(c.magnitudes)] for c in candidates]),
        tuple(np.split(np.arange(len(rows)), np.cumsum([len(each) for each in found])[:-1])),
    )


def singles(found: Evidence) -> list[Lead]:
    """One candidate at a time, the best first."""
    return sorted((found.lead([i]) for i in range(len(found.candidates))), key=lambda lead: -lead.gain)


def pairs(found: Evidence, firsts: int = 20) -> list[Lead]:
    """Two candidates at a time, the best first: each of the best singles with every other one."""
    gains = [found.lead([i]).gain for i in range(len(found.candidates))]
    order = np.argsort(gains)[::-1]
    leads = [found.lead([i, j]) for n, i in enumerate(order[:firsts]) for j in order[n + 1 :]]
    return sorted(leads, key=lambda lead: -lead.gain)


def _coordinates(candidate, magnitudes):
    x = np.zeros(candidate.size)
    x[list(candidate.magnitudes)] = magnitudes
    return x
