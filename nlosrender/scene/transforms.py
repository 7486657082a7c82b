"""Configured object transforms (``to_world``) as homogeneous matrices in float64."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pose import Float64, euler_xyz

if TYPE_CHECKING:
    from nlosrender.config.hidden_geometry import MeshConfig
    from nlosrender.config.relay_wall import MeshWallConfig


def transform_matrix(to_world: object) -> Float64:
    """Return the (4, 4) matrix of a configured ``to_world``.

    Parameters
    ----------
    to_world
        None (identity), a 4 x 4 nested list, or a list of steps of which the first is applied first:
        ``{translate: [x, y, z]}`` [m], ``{rotate: {axis: [x, y, z], angle_deg: a}}``, ``{scale: s}`` or
        ``{scale: [x, y, z]}``.

    Raises
    ------
    ValueError
        It is none of these, a number is not finite or a rotation axis is zero.
    """
    if to_world is None:
        return np.eye(4)
    if not isinstance(to_world, list | tuple | np.ndarray):
        raise ValueError(f"to_world: got {to_world!r}, need a 4 x 4 matrix or a list of steps")
    if not len(to_world) or not isinstance(to_world[0], Mapping):
        return _matrix(to_world)
    matrix = np.eye(4)
    for number, step in enumerate(to_world):
        if not isinstance(step, Mapping) or len(step) != 1:
            raise ValueError(f"to_world.{number}: got {step!r}, need one of translate, rotate, scale")
        matrix = _step_matrix(*next(iter(step.items())), number) @ matrix
    return matrix


def mesh_matrix(item: MeshConfig | MeshWallConfig) -> Float64:
    """Return scale, then rotations about x, y and z, then translation, as one (4, 4) matrix."""
    matrix = np.eye(4)
    matrix[:3, :3] = euler_xyz(item.rotate_deg) * np.asarray(item.scale)  # of columns: before the rotation
    matrix[:3, 3] = item.translate
    return matrix


def _matrix(rows: ArrayLike) -> Float64:
    matrix = np.asarray(rows, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise ValueError(f"to_world: got shape {matrix.shape}, need a 4 x 4 matrix of finite numbers")
    return matrix


def _step_matrix(operation: str, value: object, number: int) -> Float64:
    matrix = np.eye(4)
    if operation == "translate":
        matrix[:3, 3] = _vector(value, f"to_world.{number}.translate")
    elif operation == "scale":
        matrix[[0, 1, 2], [0, 1, 2]] = _vector(value, f"to_world.{number}.scale", scalar=True)
    elif operation == "rotate" and isinstance(value, Mapping) and set(value) == {"axis", "angle_deg"}:
        axis = _vector(value["axis"], f"to_world.{number}.rotate.axis")
        matrix[:3, :3] = _rotation(axis, float(value["angle_deg"]))
    else:
        raise ValueError(
            f"to_world.{number}: got {operation}: {value!r}, need translate: [x, y, z], scale: s or [x, y, z], "
            "or rotate: {axis: [x, y, z], angle_deg: a}"
        )
    return matrix


def _vector(value: object, key: str, *, scalar: bool = False) -> Float64:
    vector = np.asarray(value, dtype=np.float64)
    if scalar and vector.shape == ():
        vector = np.repeat(vector, 3)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ValueError(f"{key}: got {value!r}, need three finite numbers")
    return vector


def _rotation(axis: Float64, angle_deg: float) -> Float64:
    """Return the (3, 3) rotation about an axis (Rodrigues' formula)."""
    length = float(np.linalg.norm(axis))
    if length < 1e-12 or not np.isfinite(angle_deg):
        raise ValueError(f"rotate: axis {axis.tolist()} by {angle_deg} degrees is no rotation")
    x, y, z = axis / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
