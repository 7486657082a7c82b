"""The true front view of a hidden scene, from the configuration that a capture file carries; without a renderer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.analysis.reconstruction.voxel_grid import VoxelGrid
from nlosrender.config.load import parse_config
from nlosrender.errors import ConfigError, FileError
from nlosrender.files.layout import Float64
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.read_surfaces import read_surfaces
from nlosrender.scene.surfaces import ShapeDescription, Surface, hidden_surfaces
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

UP = np.array([0.0, 0.0, 1.0])
CIRCLE_CORNERS = 64  # of the polygon in place of a circle: its area is 0.16 % smaller
SUBPIXELS = 4  # per voxel edge, for the share of a front pixel that is covered


def true_silhouette(source: Path, attributes: Mapping[str, object], grid: VoxelGrid) -> Float64:
    """Return the share of each front pixel (y, x) that hidden geometry within the volume's depth covers.

    The scene is that of ``config`` among the ``attributes`` of the capture file ``source``.

    Raises
    ------
    FileError
        The file has no configuration, it cannot be read, or a shape's outline is not known without a renderer.
    """
    import shapely

    shapes = [_outline(surface, shape, grid) for surface, shape in _surfaces(source, attributes.get("config"))]
    covered = shapely.union_all([shape for shape in shapes if not shape.is_empty])
    shapely.prepare(covered)
    offsets = ((np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5) * grid.voxel_size
    x, y = (np.add.outer(axis, offsets).ravel() for axis in (grid.x, grid.y))
    inside = shapely.contains_xy(covered, x[None, :], y[:, None])
    return inside.reshape(len(grid.y), SUBPIXELS, len(grid.x), SUBPIXELS).mean(axis=(1, 3))


def _outline(surface: Surface, shape: TriangleMesh | ShapeDescription, grid: VoxelGrid) -> BaseGeometry:
    """Return the projection along z of what lies in the volume's depth, as a shapely polygon."""
    import shapely

    low, high = grid.z[0] - grid.voxel_size / 2, grid.z[-1] + grid.voxel_size / 2
    if isinstance(shape, TriangleMesh):
        corners = shape.vertices[shape.faces]  # (face, corner, 3)
        depth = corners[..., 2].mean(axis=1)
        flat = corners[(depth >= low) & (depth <= high), :, :2]
        triangles = shapely.polygons(flat)
        return shapely.union_all(triangles[shapely.area(triangles) > 1e-12])  # m^2: not those seen edge on
    points = _round_points(shape.description)
    if points is None:
        raise FileError(
            f"{surface.key} ({surface.name}): the silhouette of a Mitsuba {shape.description.get('type')!r} is not "
            "known here, so there is nothing to score against. Leave --score away."
        )
    depth = float(points[:, 2].mean())
    hull = shapely.convex_hull(shapely.multipoints(points[:, :2]))
    return hull if low <= depth <= high else shapely.Polygon()


def _surfaces(source: Path, text: object) -> Iterator[tuple[Surface, TriangleMesh | ShapeDescription]]:
    """Yield the surfaces of a configuration and their shapes, mesh files read."""
    if not isinstance(text, str):
        raise FileError(f"{source}: does not carry the scene's configuration, so there is nothing to score against")
    try:
        config = parse_config(text, str(source), source.absolute().parent)
        if config.scene.relay_wall is None:
            raise FileError(
                f"{source}: has no relay wall, so that nothing says which surfaces are hidden; leave --score away"
            )
        surfaces = hidden_surfaces(config.scene.hidden_geometry, relay_wall_from_config(config.scene.wall).pose)
        yield from zip(surfaces, read_surfaces(surfaces).shapes, strict=True)
    except (ConfigError, ValueError) as error:
        raise FileError(f"{source}: the configuration it carries cannot be used: {error}") from error


def _round_points(description: Mapping[str, object]) -> Float64 | None:
    """Return points (n, 3) whose projections have the shape's as their convex hull; None for unknown shapes."""
    angles = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(CIRCLE_CORNERS)], axis=-1)
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    kind, to_world = description.get("type"), np.asarray(description.get("to_world", np.eye(4)), dtype=np.float64)
    if kind == "sphere":
        latitudes = np.linspace(-np.pi / 2, np.pi / 2, CIRCLE_CORNERS // 2 + 1)[:, None, None]
        ball = circle * np.cos(latitudes) + UP * np.sin(latitudes)
        center = np.asarray(description.get("center", [0.0, 0, 0]), dtype=np.float64)
        points = center + float(np.asarray(description.get("radius", 1.0))) * ball.reshape(-1, 3)
    elif kind == "cylinder":
        points = _cylinder(description, circle)
    elif kind in ("rectangle", "disk", "cube"):
        points = circle if kind == "disk" else square
        if kind == "cube":
            points = np.concatenate([square - UP, square + UP])
    else:
        return None
    return points @ to_world[:3, :3].T + to_world[:3, 3]


def _cylinder(description: Mapping[str, object], circle: Float64) -> Float64:
    ends = [
        np.asarray(description.get(key, place), dtype=np.float64)
        for key, place in (("p0", [0, 0, 0]), ("p1", [0, 0, 1]))
    ]
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    radius = float(np.asarray(description.get("radius", 1.0)))
    ring = radius * (circle[:, :1] * across + circle[:, 1:2] * np.cross(axis, across))
    return np.concatenate([end + ring for end in ends])
