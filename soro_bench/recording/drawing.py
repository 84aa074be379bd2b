"""What a robot and its surroundings look like over the T + 1 states of an episode, whatever draws it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pose:
    """Where something is: one pose, or one for each state."""

    position: np.ndarray  # (3,) or (T + 1, 3) m
    quaternion: np.ndarray  # (4,) or (T + 1, 4) x, y, z, w


@dataclass(frozen=True)
class Mesh:
    """A surface that moves rigidly with ``pose``, deforms (vertices for each state), or both."""

    vertices: np.ndarray  # (V, 3) or (T + 1, V, 3) m
    normals: np.ndarray  # as the vertices, unit length
    faces: np.ndarray  # (F, 3) vertex indices
    color: np.ndarray  # (4,) uint8
    pose: Pose | None = None


@dataclass(frozen=True)
class Box:
    """A box, its pose that of its centre."""

    half_size: np.ndarray  # (3,) m
    color: np.ndarray  # (4,) uint8
    pose: Pose


@dataclass(frozen=True)
class Line:
    """A polyline of P points."""

    points: np.ndarray  # (T + 1, P, 3) m
    radius: float  # m
    colors: np.ndarray  # (T + 1, 3) uint8


@dataclass(frozen=True)
class Points:
    """Measured places, at n times of their own."""

    time: np.ndarray  # (n,) s
    positions: np.ndarray  # (n, P, 3) m, NaN where one is missing
    radius: float  # m
    color: np.ndarray  # (3,) uint8


@dataclass(frozen=True)
class Plot:
    """k curves."""

    title: str  # ends in the unit
    values: np.ndarray  # (T + 1, k)
    names: tuple[str, ...]  # k
    colors: np.ndarray  # (k, 3) uint8


@dataclass(frozen=True)
class Drawing:
    """A robot and its scene. Shapes go by the path under which a reviewer finds them."""

    meshes: dict[str, Mesh]
    boxes: dict[str, Box]
    lines: dict[str, Line]
    plots: dict[str, Plot]
    outline: str  # the line along the middle of the robot
    note: str  # what a reviewer has to know
    floor: float | None  # m, height of the floor
    up: tuple[int, int, int]  # the vertical: y or z
    eye: np.ndarray  # (3,) m, where to look from
    target: np.ndarray  # (3,) m, where to look at
    goal_radius: float = 0.004  # m
    goal_color: np.ndarray | None = None  # (4,) uint8
    body: tuple[str, ...] = ()  # meshes that are the robot: with the outline, enough where several robots are shown


def flat_shaded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh whose faces share no vertex and so keep sharp edges.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3).

    Returns:
        (3 F, 3) vertices [m], (3 F, 3) normals, (F, 3) faces; faces without area are left out.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    solid = area > 1e-12
    normals = np.repeat(normals[solid] / area[solid, None], 3, axis=0)
    return corners[solid].reshape(-1, 3), normals, np.arange(3 * solid.sum()).reshape(-1, 3)
