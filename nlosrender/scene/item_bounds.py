"""The box around an item of the hidden geometry, before its scene is built: families are placed by it.

Imports what it needs where it needs it: ``validate`` of a file without families waits for none of it.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.errors import ConfigError

if TYPE_CHECKING:
    from nlosrender.config.hidden_geometry import HiddenItemConfig
    from nlosrender.scene.bounding_box import Bounds
    from nlosrender.scene.pose import Float64

KEPT_HULLS = 4096  # of mesh files, some hundred points each: the tries of a family read its files once


def item_bounds(item: HiddenItemConfig) -> Bounds | None:
    """Return the box around an item [m, scene coordinates]; None for a room, and what only Mitsuba can measure.

    Raises
    ------
    ConfigError
        Its mesh cannot be read.
    """
    from nlosrender.scene.bounding_box import bounds_of
    from nlosrender.scene.pose import Pose
    from nlosrender.scene.surfaces import MeshFile, hidden_surfaces

    if item.type == "room":
        return None
    (surface,) = hidden_surfaces([item], Pose.identity())
    if not isinstance(surface.shape, MeshFile):
        return surface.bounds()
    file = surface.shape
    try:
        status = Path(file.filename).stat()
        points = _hull(file.filename, file.kind, status.st_mtime_ns, status.st_size)
    except (OSError, ValueError) as error:
        raise ConfigError.at("scene.hidden_geometry", f"{file.filename} cannot be used as a mesh: {error}.") from error
    matrix = file.placed(bounds_of(points))
    return bounds_of(points @ matrix[:3, :3].T + matrix[:3, 3])


@functools.lru_cache(KEPT_HULLS)
def _hull(filename: str, kind: str, changed: int, size: int) -> Float64:
    """Return the corners (n, 3) of the convex hull of a mesh file, in its coordinates."""
    import numpy as np
    from scipy.spatial import ConvexHull, QhullError

    from nlosrender.scene.meshes.mesh_file import read_mesh_file

    mesh = read_mesh_file(filename, kind).mesh
    points = mesh.vertices[np.unique(mesh.faces)]
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # a flat mesh
        return points
