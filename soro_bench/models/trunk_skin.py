"""The trunk's skin: a surface of revolution that follows the vertebrae, drawn only."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.models import trunk_geometry as geo

_SEGMENTS = 24  # vertices around the trunk


@dataclass(frozen=True)
class Skin:
    """Rest shape of the surface; every vertex follows one link rigidly (0 is the base, k + 1 vertebra k)."""

    vertices: Floats  # (V, 3) m, in the frame of the trunk at rest
    faces: Ints  # (F, 3)
    link: Ints  # (V,)


def build_skin() -> Skin:
    """Discs of the mesh's outer radius joined by thin necks, closed at both ends."""
    rings = [(0.0, 0.0, 0), (0.0, geo.outer_radius(0.0), 0)]  # z, radius, link
    for k in range(geo.NUM_NECKS):
        near, far = geo.NECK_START[k], geo.NECK_END[k]
        rings += [(near, geo.outer_radius(near), k), (near, geo.NECK_RADIUS, k)]
        rings += [(far, geo.NECK_RADIUS, k + 1), (far, geo.outer_radius(far), k + 1)]
    rings += [(geo.LENGTH, geo.outer_radius(geo.LENGTH), geo.NUM_NECKS), (geo.LENGTH, 0.0, geo.NUM_NECKS)]
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
        bindpos=np.concatenate([[0, 0, 0 if k == 0 else geo.NECK_MIDDLE[k - 1]] for k in range(len(links))]),
        bindquat=np.tile([1.0, 0, 0, 0], len(links)),
    )
    element.vertid = [bone.tolist() for bone in bones]
    element.vertweight = [np.ones(len(bone)).tolist() for bone in bones]
