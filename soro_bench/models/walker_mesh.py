"""Meshes of the MultiGait walker: an X-shaped slab of silicone with a membrane below and five chambers inside.

One quadrant is cut into two structured blocks, centre and leg; the other three are its mirror images, so every mesh has
the body's fourfold symmetry. Frame: x forward, y to the left, z up, origin below the body's centre. SI units.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soro_bench.arrays import Floats, Ints

# Corners of one quadrant's outline [m], from the mesh of Tiboni et al., IROS 2023 (docs/archive/tasks_and_models.md).
NOTCH = np.array([0.02952, 0.0])
TIP_INNER = np.array([0.06785, 0.01782])
TIP_OUTER = np.array([0.0637, 0.02925])
WAIST = np.array([0.01479, 0.01612])
HEIGHT = 0.0063  # m, the same source
CHAMBER_FLOOR, CHAMBER_CEILING = 0.0010, 0.0048  # m, the same source
CHAMBERS = ("centre", "rear_left", "rear_right", "front_left", "front_right")  # the order of the observation
LEG_SPAN = (0.1, 0.9)  # part of the leg's length that its chamber takes; from the same mesh
_LEG_AXIS = (TIP_INNER + TIP_OUTER - NOTCH - WAIST) / np.linalg.norm(TIP_INNER + TIP_OUTER - NOTCH - WAIST)


@dataclass(frozen=True)
class Resolution:
    """How finely a quadrant is cut."""

    along_centre: int  # quads along x from the centre to the leg
    across: int  # quads across the leg
    along_leg: int
    levels: tuple[float, ...]  # m, heights of the layers' faces


RESOLUTIONS = {
    "coarse": Resolution(2, 1, 5, (0.0, HEIGHT)),
    "fine": Resolution(2, 2, 5, (0.0, CHAMBER_FLOOR, CHAMBER_CEILING, HEIGHT)),
    "finest": Resolution(3, 3, 8, (0.0, CHAMBER_FLOOR, CHAMBER_CEILING, HEIGHT)),
}


@dataclass(frozen=True)
class Mesh:
    """Nodes (N, 3) m; tetrahedra (E, 4); triangles (F, 3) of the bottom face; chamber (E,) of each tetrahedron, -1
    for none."""

    nodes: Floats
    tetrahedra: Ints
    bottom: Ints
    chamber: Ints


def chamber_axes() -> Floats:
    """(5, 3) unit vectors along which the chambers grow: x for the centre, the leg's axis for a leg."""
    legs = [[sx * _LEG_AXIS[0], sy * _LEG_AXIS[1], 0.0] for sx, sy in _LEG_SIGNS]
    return np.array([[1.0, 0.0, 0.0], *legs])


_LEG_SIGNS = ((-1, 1), (-1, -1), (1, 1), (1, -1))  # of x and y, in the order of CHAMBERS[1:]


def build_mesh(resolution: Resolution) -> Mesh:
    """The mesh of a whole body."""
    plan, triangles, leg = _plan(resolution)
    levels = np.array(resolution.levels)
    nodes = np.concatenate([np.column_stack([plan, np.full(len(plan), z)]) for z in levels])
    tetrahedra, chamber = _prisms(triangles, leg, len(plan), levels)
    mirrored_nodes, mirrored_tets, mirrored_bottom, mirrored_chamber = [], [], [], []
    for quadrant, signs in enumerate(_LEG_SIGNS):
        first = quadrant * len(nodes)
        mirrored_nodes.append(nodes * [*signs, 1])
        mirrored_tets.append(first + tetrahedra)
        mirrored_bottom.append(first + triangles)
        mirrored_chamber.append(np.where(chamber == 1, 1 + quadrant, chamber))
    nodes, index = _merge(np.concatenate(mirrored_nodes))
    tetrahedra = _oriented(nodes, index[np.concatenate(mirrored_tets)])
    bottom = _oriented(nodes, index[np.concatenate(mirrored_bottom)])
    return Mesh(nodes, tetrahedra, bottom, np.concatenate(mirrored_chamber))


def _plan(resolution: Resolution) -> tuple[Floats, Ints, Ints]:
    """One quadrant seen from above: vertices (V, 2), triangles (T, 3), whether each lies in the leg's chamber, the
    centre's chamber, or neither (1, 0, -1)."""
    centre = _block([(0, 0), NOTCH, (0, WAIST[1]), WAIST], resolution.along_centre, resolution.across)
    leg = _block([NOTCH, TIP_INNER, WAIST, TIP_OUTER], resolution.along_leg, resolution.across)
    middle = (np.arange(resolution.along_leg) + 0.5) / resolution.along_leg
    inflated = (middle > LEG_SPAN[0]) & (middle < LEG_SPAN[1])
    column = np.repeat(np.arange(resolution.along_leg), 2 * resolution.across)
    vertices, index = _merge(np.concatenate([centre[0], leg[0]]))
    triangles = index[np.concatenate([centre[1], len(centre[0]) + leg[1]])]
    chamber = np.concatenate([np.zeros(len(centre[1]), int), np.where(inflated[column], 1, -1)])
    return vertices, triangles, chamber


def _block(corners: Sequence[ArrayLike], along: int, across: int) -> tuple[Floats, Ints]:
    """A bilinear grid of along x across quads, each cut in two: vertices (V, 2), triangles (T, 3).

    Corners: start and end at one side, start and end at the other. Triangles go column by column along the block.
    """
    u, v = np.meshgrid(np.linspace(0, 1, along + 1), np.linspace(0, 1, across + 1), indexing="ij")
    u, v = u[..., None], v[..., None]
    a, b, c, d = (np.asarray(corner, float) for corner in corners)
    vertices = ((1 - u) * (1 - v) * a + u * (1 - v) * b + (1 - u) * v * c + u * v * d).reshape(-1, 2)
    i = (np.arange(along)[:, None] * (across + 1) + np.arange(across)).ravel()
    triangles = np.stack([i, i + across + 1, i + across + 2, i, i + across + 2, i + 1], axis=1).reshape(-1, 3)
    return vertices, triangles


def _prisms(triangles: Ints, chamber: Ints, per_level: int, levels: Floats) -> tuple[Ints, Ints]:
    """The prisms over the triangles, three tetrahedra each; neighbours agree on their faces' diagonals."""
    a, b, c = np.sort(triangles, axis=1).T
    tetrahedra, chambers = [], []
    for k in range(len(levels) - 1):
        low, high = k * per_level, (k + 1) * per_level
        stairs = [(a + low, b + low, c + low, c + high), (a + low, b + low, b + high, c + high),
                  (a + low, a + high, b + high, c + high)]  # fmt: skip
        middle = (levels[k] + levels[k + 1]) / 2
        inside = CHAMBER_FLOOR < middle < CHAMBER_CEILING
        for stair in stairs:
            tetrahedra.append(np.stack(stair, axis=1))
            chambers.append(chamber if inside else np.full(len(chamber), -1))
    return np.concatenate(tetrahedra), np.concatenate(chambers)


def _merge(points: Floats) -> tuple[Floats, Ints]:
    """Points without duplicates, and the index of each given point among them."""
    _, first, inverse = np.unique(np.round(points, 9) + 0.0, axis=0, return_index=True, return_inverse=True)
    return points[first], inverse.ravel()


def _oriented(nodes: Floats, elements: Ints) -> Ints:
    """Tetrahedra with positive volume, triangles that face up."""
    edges = nodes[elements[:, 1:]] - nodes[elements[:, :1]]
    if elements.shape[1] == 3:
        edges = np.concatenate([edges, np.broadcast_to([0, 0, 1.0], (len(edges), 1, 3))], axis=1)
    wrong = np.linalg.det(edges) < 0
    elements = elements.copy()
    elements[wrong, -2:] = elements[wrong, :-3:-1]
    return elements
