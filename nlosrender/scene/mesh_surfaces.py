"""Mesh files of a scene, read and placed without Mitsuba, with what is to be said of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.config.bsdf_table import TRANSMITTING
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import box_corners
from nlosrender.scene.hidden_geometry import MeshFile, ShapeDescription, Surface, hidden_surfaces
from nlosrender.scene.mesh_wall import MeshWall
from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_file import read_mesh_file
from nlosrender.scene.meshes.mesh_normals import with_normals
from nlosrender.scene.meshes.mesh_report import MeshReport, mesh_report
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pictures import has_picture, readable
from nlosrender.scene.placing import placed
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.relay_wall import RelayWall, relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.config.scene import SceneConfig


@dataclass(frozen=True, eq=False)
class ReadSurfaces:
    """Surfaces whose mesh files have been read."""

    shapes: tuple[TriangleMesh | ShapeDescription, ...]  # local frame [m]
    meshes: tuple[MeshReport, ...]  # of those that are files, and of a wall that is one
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Origin:
    pose: Pose


def read_surfaces(surfaces: Sequence[Surface], wall: RelayWall | None = None) -> ReadSurfaces:
    """Read the mesh files of surfaces in their own coordinates, then move them in float64; other shapes pass.

    Parameters
    ----------
    surfaces
        In the local frame of ``wall``.
    wall
        None: a line-of-sight capture.

    Raises
    ------
    ConfigError
        A file cannot be used as a mesh, or lacks what its item asks of it; names the item.
    """
    wall_box = None if wall is None else box_corners(wall.bounds())
    shapes: list[TriangleMesh | ShapeDescription] = []
    meshes: list[MeshReport] = []
    warnings: list[str] = []
    if isinstance(wall, MeshWall) and wall.read is not None:
        meshes.append(mesh_report("scene.relay_wall", "relay wall", wall.file, wall.read, wall.mesh, "flat", None))
        warnings += meshes[-1].warnings(wall.read, has_two_sides=False)
    for surface in surfaces:
        shape, read, told = _read(surface, wall_box)
        shapes.append(shape)
        if read is not None and told is not None:
            meshes.append(told)
            warnings += told.warnings(read, has_two_sides=surface.bsdf.get("type") in TRANSMITTING)
    return ReadSurfaces(tuple(shapes), tuple(meshes), tuple(warnings))


def describe_meshes(scene_config: SceneConfig) -> ReadSurfaces:
    """Read all mesh files that a configuration names, as ``validate`` does.

    Raises
    ------
    ConfigError
        As ``read_surfaces``; or a pose is degenerate.
    """
    with placed():
        wall = None if scene_config.relay_wall is None else relay_wall_from_config(scene_config.relay_wall)
        frame = _Origin(Pose.identity()) if wall is None else wall
        surfaces = hidden_surfaces(scene_config.hidden_geometry, frame)
        for index, item in scene_config.shining_surfaces:
            surfaces += hidden_surfaces([item], frame, [f"scene.emitters.{index}"])
    return read_surfaces(surfaces, wall)


def _read(
    surface: Surface, wall_box: Float64 | None
) -> tuple[TriangleMesh | ShapeDescription, FileMesh | None, MeshReport | None]:
    shape = surface.shape
    if not isinstance(shape, MeshFile):
        return shape, None, None
    try:
        read = read_mesh_file(shape.filename, shape.kind)
        mesh, normals = with_normals(read.mesh, shape.normals)
        mesh = mesh.transformed(shape.to_local)
        mesh = readable(mesh) if shape.flip_v else mesh
        mesh = mesh.turned_round() if shape.flip_normals else mesh
    except ValueError as error:
        message = f"{shape.filename} cannot be used as a mesh: {error}."
        raise ConfigError.at(f"{surface.key}.filename", message) from error
    if mesh.uvs is None and has_picture(surface.bsdf):
        message = (
            f"a picture needs texture coordinates, and {shape.filename} cannot place it: {read.no_uvs}. Give every "
            "corner some, or take a texture or number that is the same everywhere."
        )
        raise ConfigError.at(f"{surface.key}.bsdf", message)
    return mesh, read, mesh_report(surface.key, surface.name, Path(shape.filename).name, read, mesh, normals, wall_box)
