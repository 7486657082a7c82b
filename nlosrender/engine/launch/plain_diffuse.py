"""Flat surfaces with a uniform diffuse BSDF: any shading frame around the normal serves, no texture is looked up."""

from __future__ import annotations

import mitsuba as mi

from nlosrender.scene.build import BuiltScene


def is_plain_diffuse(built: BuiltScene) -> bool:
    """Return whether all surfaces are flat and Mitsuba's ``diffuse`` of one reflectance."""
    shapes = (built.wall_shape, *built.hidden_shapes)
    return built.all_flat and all(_is_plain(shape) for shape in shapes)


def _is_plain(shape: mi.Shape) -> bool:
    has_smooth_normals = shape.class_name() == "Mesh" and shape.has_vertex_normals()
    return not has_smooth_normals and is_uniform_diffuse(shape.bsdf())


def is_uniform_diffuse(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is Mitsuba's ``diffuse`` of one reflectance, without a texture."""
    return bsdf.class_name() == "SmoothDiffuse" and [key for key, _ in mi.traverse(bsdf)] == ["reflectance.value"]


def is_two_sided_diffuse(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is Mitsuba's ``twosided`` of one ``diffuse`` of one reflectance, without a texture."""
    return bsdf.class_name() == "TwoSidedBRDF" and [key for key, _ in mi.traverse(bsdf)] == ["brdf_0.reflectance.value"]
