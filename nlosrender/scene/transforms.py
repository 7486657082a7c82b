"""Configured transforms as homogeneous matrices in float64; the configuration has checked their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pose import Float64, euler_xyz

if TYPE_CHECKING:
    from nlosrender.config.hidden_geometry import MeshConfig
    from nlosrender.config.relay_wall import MeshWallConfig


def transform_matrix(to_world: Any) -> Float64:
    """Return the (4, 4) matrix of a ``to_world``.

    Parameters
    ----------
    to_world
        None (identity), a 4 x 4 nested list, or a list of steps of which the first is applied first:
        ``{translate: [x, y, z]}`` [m], ``{rotate: {axis: [x, y, z], angle_deg: a}}``, ``{scale: s}`` or
        ``{scale: [x, y, z]}``.
    """
    if to_world is None:
        return np.eye(4)
    if not isinstance(to_world[0], Mapping):
        return np.asarray(to_world, dtype=np.float64)
    matrix = np.eye(4)
    for step in to_world:
        ((operation, value),) = step.items()
        one = np.eye(4)
        if operation == "translate":
            one[:3, 3] = value
        elif operation == "scale":
            one[[0, 1, 2], [0, 1, 2]] = value
        else:
            one[:3, :3] = _rotation(value["axis"], float(value["angle_deg"]))
        matrix = one @ matrix
    return matrix


def mesh_matrix(item: MeshConfig | MeshWallConfig) -> Float64:
    """Return scale, then rotations about x, y and z, then translation, as one (4, 4) matrix."""
    matrix = np.eye(4)
    matrix[:3, :3] = euler_xyz(item.rotate_deg) * np.asarray(item.scale)  # of columns: before the rotation
    matrix[:3, 3] = item.translate
    return matrix


def _rotation(axis: ArrayLike, angle_deg: float) -> Float64:
    """Return the (3, 3) rotation about an axis (Rodrigues' formula)."""
    vector = np.asarray(axis, dtype=np.float64)
    x, y, z = vector / float(np.linalg.norm(vector))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
