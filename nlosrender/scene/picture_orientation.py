"""Orientation of pictures (textures): their first row lies at a surface's ``up`` side, their first column at the left.

Left is as seen from the front, the side that reflects. Mitsuba reads a picture's first row at v = 0, while its own
rectangle and cylinder have v = 0 at the bottom, and its round shapes mirror a picture that is seen from within.
docs/textures.md has the table for every shape.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.transforms import transform_matrix

TEXTURES_WITH_A_PLACE = ("bitmap", "checkerboard")  # those that differ between texture coordinates
_UPSIDE_DOWN = np.array([[1.0, 0, 0, 0], [0, -1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]])  # (u, v) -> (u, 1 - v)


def has_picture(bsdf: object) -> bool:
    """Return whether a BSDF dictionary holds a texture that differs between texture coordinates."""
    if not isinstance(bsdf, Mapping):
        return False
    return bsdf.get("type") in TEXTURES_WITH_A_PLACE or any(has_picture(part) for part in bsdf.values())


def upright_bsdf(shape: object, bsdf: Mapping[str, object]) -> Mapping[str, object]:
    """Return the BSDF dict for a shape: Mitsuba's rectangles, and its cylinders seen from outside, have v upwards."""
    if not isinstance(shape, Mapping):
        return bsdf
    grows_upwards = shape["type"] == "rectangle" or (shape["type"] == "cylinder" and not shape["flip_normals"])
    return _upside_down(bsdf) if grows_upwards else bsdf


def round_plugin(radius: float, height: float | None, *, inside: bool, turned: bool) -> dict[str, object]:
    """Return a Mitsuba sphere, or a cylinder about the y axis, on which pictures read right from the front.

    The middle of the picture lies at +z, and ``upright_bsdf`` does the rest for cylinders seen from outside. Seen from
    within, u has to run the other way round: a cylinder stands on its head, a sphere is mirrored, which turns its
    normals, too (Mitsuba gets those of a mirrored cylinder wrong).

    Parameters
    ----------
    radius, height
        [m]; height None: a sphere.
    inside
        Whether the front is the inner side.
    turned
        Whether there is a picture that is seen from within.

    Returns
    -------
    dict
        The plugin without bsdf; ``to_world`` is a (4, 4) array.
    """
    # Mitsuba's azimuth is 0 at its x axis and grows towards its y axis; v is 0 at +z of a sphere, at p0 of a cylinder
    to_world = np.eye(4)
    to_world[:3, 0] = [0, 0, -1]
    to_world[:3, 1] = [1 if turned else -1, 0, 0]
    to_world[:3, 2] = [0, -1 if turned and height is not None else 1, 0]
    is_mirrored = bool(np.linalg.det(to_world) < 0)
    plugin: dict[str, object] = {"radius": float(radius), "to_world": to_world, "flip_normals": inside != is_mirrored}
    if height is None:
        return {"type": "sphere", "center": [0.0, 0.0, 0.0], **plugin}
    return {"type": "cylinder", "p0": [0.0, 0.0, -height / 2], "p1": [0.0, 0.0, height / 2], **plugin}


def readable(mesh: TriangleMesh, *, from_within: bool = False) -> TriangleMesh:
    """Return a mesh whose v runs upwards with v downwards, as Mitsuba's textures take it; itself without coordinates.

    With ``from_within`` u runs the other way, too: a room is a box seen from the other side of its faces.
    """
    if mesh.uvs is None:
        return mesh
    return replace(mesh, uvs=mesh.uvs * [-1.0 if from_within else 1.0, -1.0] + [float(from_within), 1.0])


def _upside_down(bsdf: Mapping[str, object]) -> dict[str, object]:
    """Return a BSDF dictionary whose textures read (u, 1 - v), before their own ``to_uv``."""
    turned: dict[str, object] = {
        key: _upside_down(part) if isinstance(part, Mapping) else part for key, part in bsdf.items()
    }
    if bsdf.get("type") in TEXTURES_WITH_A_PLACE:
        turned["to_uv"] = transform_matrix(bsdf.get("to_uv")) @ _UPSIDE_DOWN
    return turned
