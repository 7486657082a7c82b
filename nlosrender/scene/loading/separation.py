"""Loads the hidden surfaces, coincident ones moved apart so that rays resolve them, with a warning for each item."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import mitsuba as mi
import numpy as np

from nlosrender.scene.loading.coincident import MAX_LAYERS, Overlap, coincident_disks, moved_apart, overlaps
from nlosrender.scene.loading.mitsuba_shapes import (
    WALL_ID,
    has_two_sides,
    in_engine_units,
    load_bsdf_of,
    load_mesh,
    load_plugin,
    triangles_of,
)
from nlosrender.scene.loading.round_surfaces import Nested, nested_surfaces
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.surfaces import ShapeDescription, Surface

MIN_WARNED_SHARE = 1e-3  # of an item's area that coincides with other surfaces; below, edges that touch


def load_separated(
    surfaces: Sequence[Surface],
    read: Sequence[TriangleMesh | ShapeDescription],
    wall_shape: mi.Shape | None,
    unit: float,
) -> tuple[mi.Scene, list[mi.Shape], tuple[str, ...]]:
    """Load surfaces, whose shapes have been ``read``, and the scene of them and the wall, if there is one.

    Returns
    -------
    tuple
        Scene; shapes of the surfaces; a sentence for each item of which more than a little coincides with another.

    Raises
    ------
    ConfigError
        As ``load_surface``.
    """
    bsdfs = [load_bsdf_of(surface, shape) for surface, shape in zip(surfaces, read, strict=True)]
    meshes: dict[int, TriangleMesh] = {}
    shapes: list[mi.Shape] = []
    for index, (surface, shape, bsdf) in enumerate(zip(surfaces, read, bsdfs, strict=True)):
        if isinstance(shape, TriangleMesh):
            meshes[index] = in_engine_units(shape, surface, bsdf, unit)
            shapes.append(load_mesh(meshes[index], surface, bsdf))
        else:
            shapes.append(load_plugin(shape.description, surface, bsdf, unit))
            if shapes[-1].is_mesh():  # a plugin's own
                meshes[index] = triangles_of(shapes[-1])
    nested = nested_surfaces(shapes, wall_shape)
    for one in nested:
        shape = read[one.moved]
        if isinstance(shape, ShapeDescription):  # as all round ones are
            description = _resized(shape.description, one.factor)
            shapes[one.moved] = load_plugin(description, surfaces[one.moved], bsdfs[one.moved], unit)
    warned: dict[int, Overlap] = {}
    own: dict[str, object] = {"type": "scene"} | ({} if wall_shape is None else {WALL_ID: wall_shape})
    for seed in range(MAX_LAYERS):
        scene = mi.load_dict(own | {f"hidden_{index}": shape for index, shape in enumerate(shapes)})
        found = overlaps(scene, shapes, meshes, seed)
        for overlap in found:
            index = overlap.mesh
            warned.setdefault(index, overlap)
            meshes[index] = moved_apart(meshes[index], overlap.faces, both_sides=has_two_sides(bsdfs[index]))
            shapes[index] = load_mesh(meshes[index], surfaces[index], bsdfs[index])
        if not found:
            break
    keys = [surface.key for surface in surfaces]
    return scene, shapes, tuple(_warnings(keys, warned.values(), nested, coincident_disks(shapes)))


def _resized(description: Mapping[str, object], factor: float) -> dict[str, object]:
    """Return the description of a sphere or cylinder with another radius."""
    resized = dict(description)
    if "radius" in resized:
        return resized | {"radius": float(factor * np.asarray(resized["radius"], dtype=np.float64))}
    to_world = np.array(resized["to_world"], dtype=np.float64)
    to_world[:3, : 2 if resized["type"] == "cylinder" else 3] *= factor
    return resized | {"to_world": to_world}


def _warnings(
    keys: Sequence[str], moved: Iterable[Overlap], nested: Sequence[Nested], disks: Sequence[tuple[int, int]]
) -> Iterator[str]:
    for overlap in moved:
        if overlap.share > MIN_WARNED_SHARE:
            other = "itself" if overlap.other == overlap.mesh else keys[overlap.other]
            yield (
                f"{keys[overlap.mesh]}: {100 * overlap.share:.3g} % of its area lies where {other} is, or closer than "
                "rays tell apart. It is taken to lie in front there. Move one of them if it should not."
            )
    for one in nested:
        if one.is_hidden:
            yield (
                f"{keys[one.moved]} lies where {keys[one.other]} is, or closer than rays tell apart. It is taken to "
                "lie behind it. Leave it out, or move one of them if it should be seen."
            )
    for disk, neighbour in disks:
        yield (
            f"{keys[disk]}: a disk in one place with {keys[neighbour]}, or closer than rays tell apart: either may be "
            "met there, light may count twice, and the stated error does not know. Move one of them."
        )
