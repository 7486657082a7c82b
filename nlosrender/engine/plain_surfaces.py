"""Scenes whose surfaces look the same in every frame around their normal: frames need not be computed from textures."""

from __future__ import annotations

import mitsuba as mi

from nlosrender.scene.build import BuiltScene


def only_normals_matter(built: BuiltScene) -> bool:
    """Return whether all surfaces are flat and Mitsuba's ``diffuse`` of one reflectance."""
    shapes = (built.wall_shape, *built.hidden_shapes)
    return built.all_flat and all(_is_plain(shape) for shape in shapes)


def _is_plain(shape: mi.Shape) -> bool:
    bsdf = shape.bsdf()
    has_smooth_normals = shape.class_name() == "Mesh" and shape.has_vertex_normals()
    if has_smooth_normals or bsdf.class_name() != "SmoothDiffuse":
        return False
    return [key for key, _ in mi.traverse(bsdf)] == ["reflectance.value"]
