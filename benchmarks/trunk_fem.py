"""The reference simulator's trunk, built again: finite elements and cables as SOFA and its SoftRobots plugin have them.

    python benchmarks/trunk_fem.py trunk.vtk [--recordings FOLDER] [--random 6] [--out FOLDER]

trunk.vtk is the mesh of SoftRobots (examples/tutorials/Trunk/mesh, LGPL-3); it is not part of this package. Without
contact it does what the reference does: with --recordings its error is printed for each of TrunkReach that
trunk_models.py reads. With --random it moves by random actions of three seconds, and tells how far both of our models
are from it; --out keeps these motions as recordings.

What it shows of the published trunk:

- Tetrahedra are linear and corotational, and turn with their first edge and face. Nodes have equal masses; implicit
  Euler steps of 10 ms with Rayleigh damping.
- A cable is a constraint on its length, linearised at the beginning of a step, whose force may be of any size.
- A cable moves by no more than 1 mm from its displacement in a step, but that displacement is read one step late: so
  cables move at 50 mm/s where 100 were meant.
- At some actions a command is updated six times, and not five (``SIXTH``).
"""

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from rich.progress import track
from scipy.sparse.linalg import splu

from benchmarks.trunk_models import points_of, recordings_of, replayed_actions
from soro_bench import parameters as prm
from soro_bench.arrays import Floats, Ints
from soro_bench.files import read_bytes
from soro_bench.markdown import table
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

STEP, ALPHA, BETA = 0.01, 0.1, 0.1  # s, 1/s, s: time step and Rayleigh damping of the published scene
UPDATES, UPDATE = 5, 1e-3  # of a command in an action; m of each, and most that a cable moves in a step
SIXTH = (1, 9, *range(39, 99))  # actions whose sixth update comes with the first of the next one: float arithmetic
FIXED = 0.020  # m, nodes nearer to the clamp do not move
GRAVITY = np.array([0.0, -9.81, 0.0])
ITERATIONS, PRECISION = 2000, 1e-9  # of the cables' forces, by Gauss-Seidel
LENGTH = 60  # random actions
OURS = [*itertools.product(("TrunkReach-v0", "TrunkReach-v1"), trunk.VARIANTS)]
LARGEST = 100_000_000  # bytes of a mesh


def read_mesh(path: Path) -> tuple[Floats, Ints]:
    """(n, 3) nodes [m] and (e, 4) tetrahedra of a binary legacy VTK file in mm, such as Gmsh writes."""
    data = read_bytes(path, LARGEST)

    def block(word: bytes, at: int) -> tuple[list[bytes], int]:
        begin = data.index(word, at)
        end = data.index(b"\n", begin)
        return data[begin:end].split(), end + 1

    try:
        (_, count, _), at = block(b"POINTS", 0)
        nodes = np.frombuffer(data, ">f8", 3 * int(count), at).reshape(-1, 3).astype(float)
        (_, _, size), at = block(b"CELLS", at + 24 * int(count))
        cells, found, i = np.frombuffer(data, ">i4", int(size), at), [], 0
        while i < len(cells):
            if cells[i] == 4:
                found.append(cells[i + 1 : i + 5])
            i += max(int(cells[i]), 0) + 1
        tetrahedra = np.array(found, int).reshape(-1, 4)
        if not np.isfinite(nodes[tetrahedra]).all() or not len(tetrahedra) or tetrahedra.min() < 0:
            raise ValueError("no tetrahedra")
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path} is no mesh of tetrahedra as a binary legacy VTK file, or it is cut") from error
    return 1e-3 * nodes, tetrahedra


class FiniteElementTrunk:
    """The trunk of the published scene with nominal parameters, at rest.

    x, v: (n, 3) positions [m] and velocities of the nodes. tension: (8,) of the cables [N].
    """

    def __init__(self, nodes: Floats, tetrahedra: Ints):
        self.rest, self.tetrahedra = nodes, tetrahedra
        self.x, self.v, self.tension = nodes.copy(), np.zeros_like(nodes), np.zeros(8)
        self.mass = np.full(nodes.size, prm.TRUNK_MASS.nominal / len(nodes))
        self.free = np.flatnonzero(np.repeat(nodes[:, 2] > FIXED, 3))
        self.dofs = (3 * tetrahedra[:, :, None] + np.arange(3)).reshape(-1, 12)
        self.local = np.einsum("eij,enj->eni", self._frames(), self._edges())
        self.stiffness = self._element_stiffness()
        self._attach_cables()

    def _edges(self) -> Floats:
        """(e, 4, 3) corners of the tetrahedra from their first one."""
        return self.x[self.tetrahedra] - self.x[self.tetrahedra[:, :1]]

    def _frames(self) -> Floats:
        """(e, 3, 3) rows of the axes that turn with an element: along its first edge, and across its first face."""
        edges = self._edges()
        x, z = edges[:, 1], np.cross(edges[:, 1], edges[:, 2])
        x, z = (each / np.linalg.norm(each, axis=1)[:, None] for each in (x, z))
        return np.stack([x, np.cross(z, x), z], axis=1)

    def _element_stiffness(self) -> Floats:
        """(e, 12, 12) N/m in the elements' axes."""
        young, poisson = prm.YOUNG_MODULUS.nominal, prm.POISSON_RATIO.nominal
        shear = young / 2 / (1 + poisson)
        law = np.diag(np.repeat([2 * shear, shear], 3))
        law[:3, :3] += young * poisson / (1 + poisson) / (1 - 2 * poisson)
        corners = np.concatenate([np.ones((*self.local.shape[:2], 1)), self.local], axis=2)
        gradient, volume = np.linalg.inv(corners)[:, 1:], np.abs(np.linalg.det(corners)) / 6
        strains = np.zeros((len(corners), 6, 4, 3))  # xx, yy, zz, xy, yz, zx
        for row, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))):
            strains[:, row, :, i] = gradient[:, j]
            strains[:, row, :, j] = gradient[:, i]
        strain: Floats = strains.reshape(-1, 6, 12)
        return np.einsum("eai,ab,ebj,e->eij", strain, law, strain, volume)

    def forces(self) -> tuple[Floats, sp.csc_matrix]:
        """(3n,) elastic forces [N], and the stiffness of the elements as they are turned."""
        frames = self._frames()
        strained = np.einsum("eij,enj->eni", frames, self._edges()) - self.local
        force = -np.einsum("eij,ej->ei", self.stiffness, strained.reshape(-1, 12)).reshape(-1, 4, 3)
        total = np.zeros(self.mass.size)
        np.add.at(total, self.dofs, np.einsum("eij,eni->enj", frames, force).reshape(-1, 12))
        blocks = self.stiffness.reshape(-1, 4, 3, 4, 3)
        turned = np.einsum("eba,eibjc,ecd->eiajd", frames, blocks, frames, optimize=True).reshape(-1, 12, 12)
        rows, columns = np.repeat(self.dofs, 12, axis=1).ravel(), np.tile(self.dofs, (1, 12)).ravel()
        return total, sp.csc_matrix((turned.ravel(), (rows, columns)), shape=(self.mass.size,) * 2)

    def _attach_cables(self) -> None:
        """Points of the cables, each fixed in a tetrahedron, and the lengths of the cables at rest."""
        eyelets = [geo.LONG_CABLE_EYELETS] * 4 + [geo.SHORT_CABLE_EYELETS] * 4
        radius = geo.CABLE_RADIUS[[0, *np.repeat(np.arange(geo.NUM_NECKS), 2)]]
        self.eyelets = np.split(np.arange(sum(eyelets)), np.cumsum(eyelets)[:-1])
        points = np.concatenate([
            np.outer(radius[:count], direction) + np.outer(geo.KEYPOINT_Z[:count], [0, 0, 1])
            for count, direction in zip(eyelets, geo.CABLE_DIRECTIONS, strict=True)
        ])
        corners = np.concatenate([np.ones((len(self.tetrahedra), 4, 1)), self.rest[self.tetrahedra]], axis=2)
        weights = np.einsum("pj,eji->pei", np.insert(points, 0, 1.0, axis=1), np.linalg.inv(corners))
        element = weights.min(axis=2).argmax(axis=1)  # the one that it is in, or nearest to
        chosen = weights[np.arange(len(points)), element]
        row = np.repeat(3 * np.arange(len(points))[:, None] + np.arange(3), 4, axis=0).reshape(-1, 4, 3)
        column = 3 * self.tetrahedra[element][:, :, None] + np.arange(3)
        values = np.broadcast_to(chosen[:, :, None], row.shape)
        self.attached = sp.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), (points.size, self.rest.size))
        self.rest_length = self.lengths()

    def points(self) -> Floats:
        """(P, 3) of all cables [m], one cable after the other."""
        return (self.attached @ self.x.ravel()).reshape(-1, 3)

    def keypoints(self) -> Floats:
        """(21, 3) means of the long cables' points [m]."""
        return self.points()[np.array(self.eyelets[:4])].mean(axis=0)

    def lengths(self) -> Floats:
        """(8,) m."""
        points = self.points()
        return np.array([np.linalg.norm(np.diff(points[ids], axis=0), axis=1).sum() for ids in self.eyelets])

    def displacements(self) -> Floats:
        """(8,) by how much the cables are shorter than at rest [m]."""
        return self.rest_length - self.lengths()

    def _jacobian(self) -> Floats:
        """(8, 3n) of the displacements."""
        points, rows = self.points(), np.zeros((8, len(self.points()), 3))
        for cable, ids in enumerate(self.eyelets):
            along = np.diff(points[ids], axis=0)
            along /= np.linalg.norm(along, axis=1)[:, None]
            rows[cable, ids[:-1]] += along
            rows[cable, ids[1:]] -= along
        return rows.reshape(8, -1) @ self.attached

    def step(self, wanted: Floats) -> None:
        """Advance by ``STEP``; cables pull as hard as needed for displacements of ``wanted`` (8,) [m], or are slack."""
        force, stiffness = self.forces()
        free, velocity = self.free, self.v.ravel()
        damped = STEP * (STEP + BETA)
        system = ((1 + STEP * ALPHA) * sp.diags(self.mass) + damped * stiffness).tocsc()[free][:, free]
        push = force + self.mass * np.tile(GRAVITY, len(self.x)) - ALPHA * self.mass * velocity
        push = STEP * push - damped * (stiffness @ velocity)
        solve = splu(system).solve
        change = np.zeros_like(velocity)
        change[free] = solve(push[free])
        rows = self._jacobian()[:, free]
        by_cables = solve(np.ascontiguousarray(rows.T))
        begin = self.displacements() + STEP * rows @ (velocity + change)[free]
        impulse = _impulses(STEP * rows @ by_cables, wanted - begin)
        change[free] += by_cables @ impulse
        self.v = self.v + change.reshape(-1, 3)
        self.x, self.tension = self.x + STEP * self.v, impulse / STEP


def _impulses(compliance: Floats, wanted: Floats) -> Floats:
    """(8,) impulses that are not negative and give the displacements, or larger ones where they are none."""
    found = np.zeros(len(wanted))
    for _ in range(ITERATIONS):
        before = found.copy()
        for i, row in enumerate(compliance):
            found[i] = max(0.0, found[i] + (wanted[i] - row @ found) / row[i])
        if np.abs(found - before).max() <= PRECISION * max(1e-6, np.abs(found).max()):
            break
    return found


def updates(actions: Ints, sixth: bool) -> Iterator[list[list[int]]]:
    """Of every action, the actions that change a command in each of its time steps."""
    late: list[int] = []
    for number, action in enumerate(actions.tolist()):
        steps = [[action] for _ in range(UPDATES)]
        steps[0] += late
        late = [action] if sixth and number in SIXTH else []
        yield steps


def moved(nodes: Floats, tetrahedra: Ints, actions: Ints, sixth: bool) -> tuple[Floats, float]:
    """(T + 1, 21, 3) keypoints [m] at rest and after every discrete action, and the largest force of a cable [N].

    Args:
        sixth: whether some actions are updated six times.
    """
    robot, largest = FiniteElementTrunk(nodes, tetrahedra), 0.0
    found, commanded, before, last = [robot.keypoints()], np.zeros(8), np.zeros(8), np.zeros(8)
    for steps in updates(actions, sixth):
        for step in steps:
            for action in step:
                commanded[action % 8] += UPDATE if action < 8 else -UPDATE
            wanted = np.minimum(before + np.clip(commanded - before, -UPDATE, UPDATE), geo.CABLE_LIMITS)
            robot.step(wanted)
            before, last = last, robot.displacements()
            largest = max(largest, float(robot.tension.max()))
        found.append(robot.keypoints())
    return np.array(found), largest


def rms(one: Floats, other: Floats) -> float:
    """Distance of points (..., 3)."""
    return float(np.sqrt(((one - other) ** 2).sum(axis=-1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    try:
        mesh, rows = read_mesh(options.mesh), list[tuple[str, ...]]()
    except (OSError, ValueError) as error:
        parser.error(str(error))
    for name, env_id, actions, seen in recordings_of(options.recordings) if options.recordings else ():
        if env_id == "TrunkReach-v0":
            points, force = moved(*mesh, actions, sixth=True)
            off = rms(1e3 * points, points_of(seen)[:, :21])
            print(f"{name}: {off:.2f} mm, rms over keypoints; cables pull with up to {force:.0f} N")
    for seed in track(range(options.random), "random actions"):
        actions = np.random.default_rng(seed).integers(16, size=LENGTH)
        true = 1e3 * moved(*mesh, actions, sixth=False)[0]
        ours = [points_of(replayed_actions(env_id, name, actions))[:, :21] for env_id, name in OURS]
        rows.append((str(seed), *(f"{rms(true, each):.1f}" for each in ours)))
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
            seen = np.concatenate([true.reshape(len(true), -1), np.zeros((len(true), 3))], axis=1)
            file = options.out / f"random_{seed}.npz"
            np.savez_compressed(file, actions=actions, observations=seen[:-1], next_observations=seen[1:])
    if rows:
        means = [f"{np.mean([float(value) for value in column]):.1f}" for column in list(zip(*rows, strict=True))[1:]]
        names = (f"{env_id}, {name} [mm]" for env_id, name in OURS)
        print(table(("seed", *names), [*rows, ("mean", *means)]))


if __name__ == "__main__":
    main()
