"""Types of arrays, what NumPy reads of others, and rotations of many vectors at once.

Shapes and units are in the docstrings: the type system knows neither.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]


def on_host(value: Any) -> Any:
    """The same; a tensor of any device as one that NumPy reads."""
    return value.cpu() if hasattr(value, "cpu") else value


def rotate_by_quaternion(vectors: Floats, quaternion: Floats) -> Floats:
    """(..., 3) vectors turned by unit quaternions (..., 4) w, x, y, z; leading axes broadcast."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def rotate_by_vector(vectors: Floats, vector: Floats) -> Floats:
    """(n, 3) vectors turned by rotation vectors (n, 3) [rad]; by nothing, they keep their bits (Rodrigues)."""
    angle = np.sqrt((vector * vector).sum(axis=1))[:, None]
    axis = vector / np.maximum(angle, 1e-300)
    along = (axis * vectors).sum(axis=1)[:, None] * axis
    turned = np.cos(angle) * vectors + np.sin(angle) * np.cross(axis, vectors) + (1.0 - np.cos(angle)) * along
    return np.where(angle > 0, turned, vectors)
