"""Geometry, stiffness and skin of the cable-driven trunk, measured on the mesh of the reference simulator.

Frame: z along the undeformed trunk, y up, origin at the clamped end. SI units. Sources:

- [SofaGym] the reference trunk scene (lengths, cable points, masses, limits): docs/archive/tasks_and_models.md.
- [FEM] relative stiffness of every neck, from linear tetrahedral elements on the reference mesh at E = 4.5 MPa,
  as the reference simulator uses them (linear tetrahedra, so it includes their locking near nu = 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from soro_bench.arrays import Floats, Ints

NUM_NECKS = 10
LENGTH = 0.195  # m [SofaGym]
PITCH = 0.0174853  # m, distance from one neck to the next [SofaGym]
NECK_LENGTH = 0.006  # m [SofaGym]
NECK_START = 0.021 + PITCH * np.arange(NUM_NECKS)  # m, proximal face of each neck [SofaGym]
NECK_END = NECK_START + NECK_LENGTH
NECK_MIDDLE = NECK_START + NECK_LENGTH / 2
VERTEBRA_END = np.append(NECK_START[1:], LENGTH)  # vertebra k spans NECK_END[k] .. VERTEBRA_END[k]

# Cables: four long ones through every neck and four short ones, which end on the far side of the fourth neck's
# vertebra. Both sets in the order +y, -x, -y, +x. [SofaGym]
CABLE_NAMES = ("L0", "L1", "L2", "L3", "S0", "S1", "S2", "S3")
CABLE_DIRECTIONS = np.array([(0, 1, 0), (-1, 0, 0), (0, -1, 0), (1, 0, 0)] * 2, float)
CABLE_RADIUS = 0.010 - 0.00071735 * np.arange(NUM_NECKS)  # m from the axis, on both faces of neck k
LONG_CABLE_EYELETS = 21  # the pull point at z = 0 and both faces of ten necks; ends at z = 184.37 mm
SHORT_CABLE_EYELETS = 10  # ends on the near face of the fifth neck, z = 90.94 mm
CABLE_LIMITS = np.array([0.070] * 4 + [0.040] * 4)  # m, largest displacement [SofaGym]
CABLE_RATE = 0.1  # m/s: 1 mm every 10 ms [SofaGym]

# 21 keypoints on the axis: the clamped end and both faces of every neck. [SofaGym]
KEYPOINT_Z = np.concatenate([[0.0], np.column_stack([NECK_START, NECK_END]).ravel()])

# The reference spreads mass equally over 709 mesh nodes: nodes of each vertebra, from the middle of the neck before it.
# The rest sit in the clamp here; the reference fixes only those up to z = 20 mm. [SofaGym]
VERTEBRA_MASS_SHARE = np.array([89, 73, 71, 66, 67, 62, 53, 42, 33, 31]) / 709

# Outer radius of the mesh [SofaGym]
_OUTER_Z = np.array([0, 20, 40, 60, 80, 100, 120, 140, 160, 180, 195]) * 1e-3
_OUTER_RADIUS = np.array([13.0, 12.4, 11.2, 10.6, 9.7, 9.0, 8.1, 7.4, 6.5, 5.6, 5.3]) * 1e-3
NECK_RADIUS = 0.0023  # m, drawn only: the mesh's cores are 2.0-2.5 mm [SofaGym]

YOUNG_MODULUS_OF_TABLE = 4.5e6  # Pa; every stiffness below is proportional to it
POISSON_RATIO_OF_TABLE = np.array([0.40, 0.45, 0.49])
BEND = np.array([  # N m/rad, rows by Poisson's ratio, columns by neck [FEM]
    [0.215, 0.182, 0.160, 0.168, 0.133, 0.0817, 0.0709, 0.0648, 0.0687, 0.0685],
    [0.244, 0.196, 0.171, 0.184, 0.142, 0.0933, 0.0803, 0.0706, 0.0748, 0.0744],
    [0.374, 0.258, 0.216, 0.257, 0.195, 0.135, 0.114, 0.0891, 0.0984, 0.0969],
])
AXIAL = np.array([  # N/m [FEM]
    [37388, 31749, 31939, 25407, 22140, 18285, 15799, 17781, 18101, 19589],
    [41971, 34136, 33942, 26970, 23701, 19514, 16844, 18797, 19077, 20683],
    [58296, 41276, 38567, 31377, 28092, 22566, 19520, 20546, 20781, 22877],
])
# N m/rad at nu = 0.45; at 0.40 and 0.49 only the mean compliance is known: 1.08 and 0.69 times that of 0.45. [FEM]
_TWIST = np.array([0.342, 0.307, 0.270, 0.306, 0.360, 0.101, 0.087, 0.080, 0.080, 0.105])
TWIST = np.outer(1 / np.array([1.08, 1.00, 0.69]), _TWIST)
# Shear is not in the table. A prism between rigid faces has axial/shear = (lambda + 2 mu)/mu, 3.5 at nu = 0.3,
# where such a prism fits bend and axial together. Neck shear adds below 1 % to a tip deflection, so 3.5 is enough.
AXIAL_PER_SHEAR = 3.5


def _log_compressibility(poisson_ratio: ArrayLike) -> Floats:
    return -np.log1p(-2 * np.asarray(poisson_ratio))


# (3, 10) coefficients of the parabolas through the rows of each table, highest power first
_PARABOLAS = {
    name: np.linalg.solve(np.vander(_log_compressibility(POISSON_RATIO_OF_TABLE)), table)
    for name, table in (("bend", BEND), ("axial", AXIAL), ("twist", TWIST))
}


@overload
def outer_radius(z: float) -> float: ...
@overload
def outer_radius(z: Floats) -> Floats: ...
def outer_radius(z: Floats | float) -> Floats | float:
    """Outer radius [m] of the trunk at distance ``z`` [m] from the clamped end."""
    return np.interp(z, _OUTER_Z, _OUTER_RADIUS)


def neck_stiffness(young_modulus: ArrayLike, poisson_ratio: ArrayLike) -> dict[str, Floats]:
    """Stiffness of every neck for N materials.

    Between the tabulated Poisson's ratios the stiffness is the parabola in -ln(1 - 2 nu) through the three rows,
    which has the logarithm's growth towards incompressibility; it meets the FEM's mean bending compliance at
    nu = 0.425 and 0.475 within 1 %.

    Args:
        young_modulus: (N,) Pa.
        poisson_ratio: (N,), at most 0.495.

    Returns:
        dict of (N, 10) arrays: ``bend`` and ``twist`` [N m/rad], ``axial`` and ``shear`` [N/m].
    """
    x = _log_compressibility(poisson_ratio)[:, None]
    scale = np.asarray(young_modulus)[:, None] / YOUNG_MODULUS_OF_TABLE
    # elementwise, so that a material's stiffness has the same bits alone and among others
    stiffness = {name: scale * ((a * x + b) * x + c) for name, (a, b, c) in _PARABOLAS.items()}
    stiffness["shear"] = stiffness["axial"] / AXIAL_PER_SHEAR
    return stiffness


# --- the skin, drawn only: a surface of revolution that follows the vertebrae ---

_SEGMENTS = 24  # vertices around the trunk


@dataclass(frozen=True)
class Skin:
    """Rest shape of the surface; every vertex follows one link rigidly (0 is the base, k + 1 vertebra k)."""

    vertices: Floats  # (V, 3) m, in the frame of the trunk at rest
    faces: Ints  # (F, 3)
    link: Ints  # (V,)


def build_skin() -> Skin:
    """Discs of the mesh's outer radius joined by thin necks, closed at both ends."""
    rings = [(0.0, 0.0, 0), (0.0, outer_radius(0.0), 0)]  # z, radius, link
    for k in range(NUM_NECKS):
        near, far = NECK_START[k], NECK_END[k]
        rings += [(near, outer_radius(near), k), (near, NECK_RADIUS, k)]
        rings += [(far, NECK_RADIUS, k + 1), (far, outer_radius(far), k + 1)]
    rings += [(LENGTH, outer_radius(LENGTH), NUM_NECKS), (LENGTH, 0.0, NUM_NECKS)]
    angle = np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_SEGMENTS)])
    vertices = np.concatenate([radius * circle + [0, 0, z] for z, radius, _ in rings])
    i = np.arange(_SEGMENTS)
    j = (i + 1) % _SEGMENTS
    strip = np.concatenate([
        np.column_stack([i, j, i + _SEGMENTS]), np.column_stack([j, j + _SEGMENTS, i + _SEGMENTS])
    ])  # fmt: skip
    faces = np.concatenate([strip + r * _SEGMENTS for r in range(len(rings) - 1)])
    return Skin(vertices, faces, np.repeat([link for *_, link in rings], _SEGMENTS))


def add_skin(spec: mujoco.MjSpec, links: Sequence[mujoco.MjsBody]) -> None:
    """Add the skin to a spec whose links stand at rest."""
    skin = build_skin()
    bones = [np.flatnonzero(skin.link == k) for k in range(len(links))]
    element = spec.add_skin(
        name="trunk",
        material="silicone",
        vert=skin.vertices.ravel(),
        face=skin.faces.ravel(),
        bodyname=[link.name for link in links],
        bindpos=np.concatenate([[0, 0, 0 if k == 0 else NECK_MIDDLE[k - 1]] for k in range(len(links))]),
        bindquat=np.tile([1.0, 0, 0, 0], len(links)),
    )
    element.vertid = [bone.tolist() for bone in bones]
    element.vertweight = [np.ones(len(bone)).tolist() for bone in bones]
