"""Shapes of a scene that a program has loaded with Mitsuba itself, as surfaces that the scene builder takes.

They are read in float32, as Mitsuba holds them, and keep their BSDF objects.
"""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from nlosrender.errors import ConfigError
from nlosrender.scene.loading.exact_blend import NAME
from nlosrender.scene.loading.materials import LOADED
from nlosrender.scene.loading.mitsuba_shapes import load_mesh, triangles_of
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.surfaces import ShapeDescription, Surface

ROUND = {"Sphere": "sphere", "Cylinder": "cylinder", "Disk": "disk"}  # class -> plugin
MESH_PARAMETERS = ("vertex_positions", "vertex_normals", "vertex_texcoords")
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])  # of Mitsuba's rectangle, u to x and v to y


def loaded_surfaces(scene: object, frame: Pose) -> tuple[Surface, ...]:
    """Return the shapes of a Mitsuba scene [m] in a local frame; sensors and the integrator play no part.

    Raises
    ------
    ConfigError
        It is no scene of the active variant, has emitters, or a shape or BSDF that is not supported.
    """
    if not isinstance(scene, mi.Scene):
        need = f"a scene of the active variant {mi.variant()}, as mi.load_dict or mi.load_file returns it"
        raise ConfigError.at("scene", f"got a {type(scene).__name__}, need {need}.")
    if scene.emitters():
        message = f"has {len(scene.emitters())} emitters, and the laser is the only light; take them out."
        raise ConfigError.at("scene", message)
    return tuple(loaded_surface(shape, frame, index) for index, shape in enumerate(scene.shapes()))


def loaded_surface(shape: mi.Shape, frame: Pose, index: int) -> Surface:
    """Return a shape [m] in a local frame; ``index`` is its number in the scene. Errors as of ``loaded_surfaces``."""
    key = f"scene.{shape.id() or f'{shape.class_name()}-{index}'}"
    for obstacle in _obstacles(shape):
        raise ConfigError.at(key, obstacle)
    to_local = frame.inverse_matrix()
    placed: TriangleMesh | ShapeDescription
    if shape.is_mesh():
        if shape.class_name() == "Rectangle":  # does not show its vertices
            uvs = (CORNERS[:, :2] + 1) / 2
            mesh = TriangleMesh(CORNERS.astype(np.float64), np.array([[0, 1, 2], [0, 2, 3]]), uvs)
            mesh = mesh.transformed(to_local @ to_world_of_shape(shape))
        else:
            mesh = triangles_of(shape).transformed(to_local)
        placed = mesh.turned_round() if shape.has_flipped_normals() else mesh
    else:
        description = {"type": ROUND[shape.class_name()], "to_world": to_local @ to_world_of_shape(shape)}
        placed = ShapeDescription(description | {"flip_normals": bool(shape.has_flipped_normals())})
    return Surface(shape.id() or key, key, placed, {LOADED: shape.bsdf()})


def _obstacles(shape: mi.Shape) -> Iterator[str]:
    """Yield what stands against a shape, a sentence each."""
    name, parameters = shape.class_name(), mi.traverse(shape)
    if not (shape.is_mesh() or name in ROUND):
        yield f"got a {name}, need a mesh, rectangle, {', '.join(ROUND.values())}; triangulate it."
        return
    others = [key for key in parameters.keys() if key.startswith(("vertex_", "face_")) and key not in MESH_PARAMETERS]  # noqa: SIM118  # no dict
    if others:
        yield f"has the mesh attribute {others[0]}, which is not read; use a bitmap."
    if shape.interior_medium() is not None or shape.exterior_medium() is not None:
        yield "is filled with a medium; light travels straight between surfaces here."
    if "to_world" in parameters and np.linalg.det(to_world_of_shape(shape)[:3, :3]) <= 0:
        yield "is mirrored by its to_world; use a rotation and a scale."
    bsdf = shape.bsdf()
    if "BlendBSDF[" in str(bsdf) and bool(bsdf.flags() & mi.BSDFFlags.Delta):
        yield f"blends a mirror: Mitsuba's blendbsdf samples it wrongly; use type: {NAME}, with the same parameters."


def with_vertices(shape: mi.Shape, index: int) -> mi.Shape:
    """Return a shape, but a mesh that does not show its vertices, or with normals against its faces, as a plain mesh.

    Mitsuba's rectangle is one of the former. Errors as of ``loaded_surfaces``.
    """
    if not (shape.is_mesh() and (shape.class_name() == "Rectangle" or shape.has_flipped_normals())):
        return shape
    surface = loaded_surface(shape, Pose.identity(), index)
    assert isinstance(surface.shape, TriangleMesh)
    return load_mesh(surface.shape, surface, shape.bsdf())


def to_world_of_shape(shape: mi.Shape) -> Float64:
    """Return the (4, 4) matrix of a shape that has one."""
    return np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
