"""The drawing of the walker: its deforming surface, the line along its middle, and the floor."""

from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from soro_bench.envs.multigait import SCENE
from soro_bench.evaluation import Episode
from soro_bench.files import mjcf_path
from soro_bench.models.walker_mesh import CHAMBERS, RESOLUTIONS, Mesh, build_mesh
from soro_bench.recording.drawing import Box, Drawing, Line, Plot, Pose
from soro_bench.recording.drawing import Mesh as Surface

_FLOOR_HALF_SIZE = np.array([0.15, 0.08, 0.0005])  # m, drawn only
_FLOOR_HEIGHT = -0.0015  # m, as in multigait.xml
_FLOOR_COLOR = np.array([52, 56, 62, 255], np.uint8)
_SPINE_COLOR = np.array([214, 60, 52], np.uint8)
_SPINE_RADIUS = 0.0006  # m
# a colour for the centre, one for each pair of legs, left in a lighter tint
_CHAMBER_COLORS = np.array(
    [(120, 120, 120), (120, 170, 220), (31, 119, 180), (255, 187, 120), (255, 127, 14)], np.uint8
)


def draw_walker(episode: Episode) -> Drawing:
    """The drawing of an episode of MultiGait."""
    body, signals = build_mesh(RESOLUTIONS[episode.model]), episode.signals
    faces, color = surface(body), _material("ecoflex")
    vertices = signals["vertices"]
    spine = np.flatnonzero((np.abs(body.nodes[:, 1]) < 1e-9) & (body.nodes[:, 2] == body.nodes[:, 2].max()))
    spine = spine[np.argsort(body.nodes[spine, 0])]
    colors = np.tile(_SPINE_COLOR, (len(vertices), 1))
    floor = Pose(np.array([0, 0, _FLOOR_HEIGHT - _FLOOR_HALF_SIZE[2]]), np.array([0, 0, 0, 1.0]))
    return Drawing(
        meshes={"body": Surface(vertices, vertex_normals(vertices, faces), faces, color)},
        boxes={"floor": Box(_FLOOR_HALF_SIZE, _FLOOR_COLOR, floor)},
        lines={"spine": Line(vertices[:, spine], _SPINE_RADIUS, colors)},
        plots={"inflation": Plot("inflation", signals["inflation"], CHAMBERS, _CHAMBER_COLORS)},
        outline="spine",
        body=("body",),
        note="x is forward. One state per action.",
        floor=_FLOOR_HEIGHT,
        up=(0, 0, 1),
        eye=np.array([0.10, -0.19, 0.11]),
        target=np.array([0.0, 0.0, 0.01]),
    )


def surface(body: Mesh) -> np.ndarray:
    """(F, 3) the triangles that belong to one tetrahedron only, facing outwards."""
    corners = body.tetrahedra[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True)
    return corners[first[count == 1]]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(T + 1, V, 3) unit normals of a deforming surface, averages of the adjacent triangles weighted by area."""
    corners = vertices[:, faces]
    across = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals = np.zeros_like(vertices)
    for corner in faces.T:
        index: Any = (slice(None), corner)  # numpy's types know no tuple here
        np.add.at(normals, index, across)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


@lru_cache(maxsize=2)
def _material(name: str) -> np.ndarray:
    """(4,) uint8 colour of a material of the scene."""
    spec = mujoco.MjSpec.from_file(str(mjcf_path(SCENE)))
    return np.round(255 * np.array(spec.material(name).rgba)).astype(np.uint8)
