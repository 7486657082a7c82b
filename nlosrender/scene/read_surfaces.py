"""Mesh files of a scene, read and placed without Mitsuba, with a report and warnings for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.config.bsdf_table import TRANSMITTING
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import box_corners
from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_file import read_mesh_file
from nlosrender.scene.meshes.mesh_normals import with_normals
from nlosrender.scene.meshes.mesh_report import MeshReport, mesh_report
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import has_picture, readable
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.surfaces import MeshFile, ShapeDescription, Surface, all_surfaces
from nlosrender.scene.walls.mesh_wall import MeshWall
from nlosrender.scene.walls.wall import RelayWall
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.config.scene import SceneConfig


@dataclass(frozen=True, eq=False)
class ReadSurfaces:
    """Surfaces whose mesh files have been read."""

    shapes: tuple[TriangleMesh | ShapeDescription, ...]  # local frame [m]
    meshes: tuple[MeshReport, ...]  # of those that are files, and of a wall that is one
    warnings: tuple[str, ...]
    poses: tuple[Float64, ...] = ()  # (4, 4) of each surface, from its own coordinates to the local frame


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
    wall_corners = None if wall is None else box_corners(wall.bounds())
    shapes: list[TriangleMesh | ShapeDescription] = []
    meshes: list[MeshReport] = []
    warnings: list[str] = []
    poses: list[Float64] = []
    if isinstance(wall, MeshWall) and wall.read is not None:
        meshes.append(mesh_report("scene.relay_wall", "relay wall", wall.file, wall.read, wall.mesh, "flat", None))
        warnings += meshes[-1].warnings(wall.read, has_two_sides=False)
    for surface in surfaces:
        shape = surface.shape
        if isinstance(shape, MeshFile):
            read, mesh, normals, pose = _read(surface, shape)
            name = Path(shape.filename).name
            meshes.append(mesh_report(surface.key, surface.name, name, read, mesh, normals, wall_corners))
            warnings += meshes[-1].warnings(read, has_two_sides=surface.bsdf.get("type") in TRANSMITTING)
            shape = mesh
        elif isinstance(shape, ShapeDescription) and surface.pose is None:
            pose = np.asarray(shape.description.get("to_world", np.eye(4)), dtype=np.float64)
        else:
            pose = np.eye(4) if surface.pose is None else surface.pose
        shapes.append(shape)
        poses.append(pose)
    return ReadSurfaces(tuple(shapes), tuple(meshes), tuple(warnings), tuple(poses))


def describe_meshes(scene_config: SceneConfig) -> ReadSurfaces:
    """Read all mesh files that a configuration names, as ``validate`` does; errors as of ``read_surfaces``."""
    wall = None if scene_config.relay_wall is None else relay_wall_from_config(scene_config.relay_wall)
    return read_surfaces(all_surfaces(scene_config, Pose.identity() if wall is None else wall.pose), wall)


def _read(surface: Surface, file: MeshFile) -> tuple[FileMesh, TriangleMesh, str, Float64]:
    """Return what a file holds, its mesh in the local frame, what the mesh's normals are, and its pose (4, 4)."""
    try:
        read = read_mesh_file(file.filename, file.kind)
        mesh, normals = with_normals(read.mesh, file.normals)
        pose = file.placed(mesh.bounds())
        mesh = mesh.transformed(pose)
        mesh = readable(mesh) if file.flip_v else mesh
        mesh = mesh.turned_round() if file.flip_normals else mesh
    except ValueError as error:
        message = f"{file.filename} cannot be used as a mesh: {error}."
        raise ConfigError.at(f"{surface.key}.filename", message) from error
    if mesh.uvs is None and has_picture(surface.bsdf):
        message = (
            f"a picture needs texture coordinates, and {file.filename} cannot place it: {read.no_uvs}. Give every "
            "corner some, or take a texture or number that is the same everywhere."
        )
        raise ConfigError.at(f"{surface.key}.bsdf", message)
    return read, mesh, normals, pose
