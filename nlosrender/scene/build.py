"""Geometry -> Mitsuba scene, in engine units: the relay wall's local frame, scaled to a size near 1.

Ray offsets and intersection tolerances are absolute lengths in a ray tracer. A power of two brings every
scene, of millimetres or kilometres, to the same size without rounding anything; results are scaled back exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import Bounds, box_corners, joined_bounds
from nlosrender.scene.loading.materials import medium_warnings
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID, load_surface, shape_bounds
from nlosrender.scene.loading.round_surfaces import ROUND_PLUGINS, curvature
from nlosrender.scene.loading.separation import load_separated
from nlosrender.scene.meshes.mesh_report import MeshReport
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import upright_bsdf
from nlosrender.scene.pixel_points import PixelPoints
from nlosrender.scene.pose import Float64
from nlosrender.scene.read_surfaces import read_surfaces
from nlosrender.scene.surfaces import ShapeDescription, Surface
from nlosrender.scene.walls.wall import RelayWall

MAX_REACH = 1e5  # hidden geometry over the wall's size: float32 then resolves 1 % of the wall
MIN_EXTENT = 1e-12  # hidden geometry over the wall's size: the squares of areas stay numbers in float32
Value = TypeVar("Value", np.float32, np.bool_)
EXACT_PLUGINS = ("Rectangle", "Disk", *ROUND_PLUGINS)  # intersections in closed form, as those of meshes


@dataclass(frozen=True, eq=False, kw_only=True)
class EngineScene:
    """A scene ready to be traced, seen by a relay wall's points or a camera."""

    scene: mi.Scene
    wall: RelayWall  # a camera's image plane
    surfaces: tuple[Surface, ...]  # configured ones; a Mitsuba scene has more
    hidden_shapes: tuple[mi.Shape, ...]  # one per surface, then those of a Mitsuba scene
    hidden_bounds: Bounds | None  # box around these and all lamps [m, local frame]; None when there is none
    metres_per_engine_unit: float  # a power of two, so that conversions are exact
    n_triangles: int  # of the hidden shapes; analytic shapes count as none
    warnings: tuple[str, ...] = ()  # about what was left out, or is likely a mistake
    meshes: tuple[MeshReport, ...] = ()  # of mesh files

    @property
    def unseen_bounds(self) -> Bounds | None:
        """Box around what is to be found [m, local frame]: all hidden geometry; None when there is none."""
        return self.hidden_bounds


@dataclass(frozen=True, eq=False, kw_only=True)
class BuiltScene(EngineScene):
    """The scene of a capture with a relay wall, whose local frame is the engine's."""

    wall_shape: mi.Shape
    poses: tuple[Float64, ...] = ()  # (4, 4) of each surface, from its own coordinates to the local frame [m]
    pixels: PixelPoints | None = None  # laser and sensor points of a capture with a camera

    @property
    def all_flat(self) -> bool:
        """Whether the wall is a plane and every hidden surface made of triangles."""
        return self.wall.is_planar and all(shape.is_mesh() for shape in self.hidden_shapes)

    @cached_property
    def has_exact_hits(self) -> bool:
        """Whether rays meet every hidden surface where float32 has it; curves and distance grids are searched for."""
        return all(shape.is_mesh() or shape.class_name() in EXACT_PLUGINS for shape in self.hidden_shapes)

    @cached_property
    def curvature_of_shapes(self) -> Float64:
        """1 / radius (n,) [1 / engine unit] of spheres and cylinders, 0 for other shapes; in the scene's order."""
        return np.array([curvature(shape) for shape in self.scene.shapes()])

    @cached_property
    def curvatures(self) -> mi.Float:
        """``curvature_of_shapes`` on the device; index = registry of shapes."""
        table = mi.Float(self._by_registry(self.curvature_of_shapes.astype(np.float32)))
        dr.eval(table)
        return table

    def _by_registry(self, values: NDArray[Value]) -> NDArray[Value]:
        """Return values (shapes,), in the scene's order, by the index of each shape in Dr.Jit's registry; else 0."""
        registry = np.array(dr.reinterpret_array(mi.UInt32, self.scene.shapes_dr()))
        table = np.zeros(int(registry.max(initial=0)) + 1, values.dtype)
        table[registry] = values
        return table

    @property
    def is_curved(self) -> bool:
        """Whether any shape is a sphere or a cylinder."""
        return bool(self.curvature_of_shapes.any())

    @property
    def wall_bsdf(self) -> mi.BSDF:
        """BSDF of the relay wall."""
        return self.wall_shape.bsdf()

    # What engines ask of laser and sensor points, wherever these lie

    @property
    def sampled_shapes(self) -> tuple[mi.Shape, ...]:
        """The shapes of hidden geometry sampling."""
        return self.hidden_shapes

    @property
    def lit_shapes(self) -> tuple[mi.Shape, ...]:
        """The shapes that laser points lie on."""
        return (self.wall_shape,)

    def is_wall(self, shapes: mi.ShapePtr) -> mi.Bool:
        """Return whether shapes are the relay wall."""
        return shapes == mi.ShapePtr(self.wall_shape)

    def bsdf_at(self, point: mi.SurfaceInteraction3f) -> mi.BSDF:
        """Return the BSDF at laser or sensor points."""
        return self.wall_bsdf

    def shape_at(self, point: mi.SurfaceInteraction3f) -> mi.ShapePtr:
        """Return the shape that laser or sensor points lie on."""
        return mi.ShapePtr(self.wall_shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneWithoutWall(BuiltScene):
    """The scene of a capture with a camera whose points lie on any of its surfaces; ``wall_shape`` is None.

    All shapes are ``hidden_shapes``: each may reflect light to another one.
    """

    pixels: PixelPoints
    reason: str  # why it has no relay wall

    @cached_property
    def _walls(self) -> set[int]:
        """Numbers of the shapes that laser and sensor points lie on."""
        hits = self.pixels.sensors, self.pixels.lasers
        return {int(number) for hit in hits for number in np.unique(hit.shapes[hit.is_reached])}

    @cached_property
    def _is_wall(self) -> mi.Bool:
        is_wall = np.array([number in self._walls for number in range(len(self.scene.shapes()))])
        table = mi.Bool(self._by_registry(is_wall))
        dr.eval(table)
        return table

    @cached_property
    def sampled_shapes(self) -> tuple[mi.Shape, ...]:
        return tuple(shape for number, shape in enumerate(self.scene.shapes()) if number not in self._walls)

    @property
    def unseen_bounds(self) -> Bounds | None:
        """Box around the surfaces on which no point lies; of all where each has one."""
        unit = self.metres_per_engine_unit
        return joined_bounds([shape_bounds(shape, unit) for shape in self.sampled_shapes]) or self.hidden_bounds

    @property
    def lit_shapes(self) -> tuple[mi.Shape, ...]:
        lasers, shapes = self.pixels.lasers, self.scene.shapes()
        return tuple(shapes[number] for number in np.unique(lasers.shapes[lasers.is_reached]))

    def is_wall(self, shapes: mi.ShapePtr) -> mi.Bool:
        return dr.gather(mi.Bool, self._is_wall, dr.reinterpret_array(mi.UInt32, shapes), shapes != None)  # noqa: E711

    def bsdf_at(self, point: mi.SurfaceInteraction3f) -> mi.BSDF:
        return point.bsdf()

    def shape_at(self, point: mi.SurfaceInteraction3f) -> mi.ShapePtr:
        return point.shape

    def set_up(self) -> None:
        """Make the tables: not while a kernel is recorded."""
        _ = self.curvatures, self._is_wall


def build_scene(wall: RelayWall, wall_bsdf: Mapping[str, object], surfaces: Sequence[Surface]) -> BuiltScene:
    """Build the Mitsuba scene; the backend has to be started before.

    Parameters
    ----------
    wall
        The relay wall; it blocks and reflects light like any surface.
    wall_bsdf
        Mitsuba BSDF dict of the relay wall.
    surfaces
        Hidden geometry in the local frame [m].

    Raises
    ------
    ConfigError
        Mitsuba rejects a shape or a BSDF, or a mesh file cannot be read; the key of the item is named.
    """
    read = read_surfaces(surfaces, wall)
    boxes = [shape.bounds() for shape in read.shapes]
    _check_reach(surfaces, boxes, wall)
    unit = _unit_length(wall, joined_bounds(boxes))
    description = wall.shape_description()
    wall_item = description if isinstance(description, TriangleMesh) else ShapeDescription(description)
    wall_surface = Surface(WALL_ID, "scene.relay_wall", wall_item, upright_bsdf(description, wall_bsdf))
    wall_shape = load_surface(wall_surface, wall_item, unit)
    scene, shapes, warnings = load_separated(surfaces, read.shapes, wall_shape, unit)
    boxes = [shape_bounds(shape, unit) for shape in shapes]
    _check_reach(surfaces, boxes, wall)
    keys = (f"{surface.key}.bsdf" for surface in surfaces)
    built = BuiltScene(
        scene=scene,
        wall=wall,
        wall_shape=wall_shape,
        surfaces=tuple(surfaces),
        hidden_shapes=tuple(shapes),
        hidden_bounds=joined_bounds(boxes),
        metres_per_engine_unit=unit,
        n_triangles=count_triangles(shapes),
        warnings=read.warnings + warnings + medium_warnings(zip(keys, shapes, strict=True)),
        meshes=read.meshes,
        poses=read.poses,
    )
    _ = built.curvatures  # now, not while a kernel is recorded
    return built


def count_triangles(shapes: Iterable[mi.Shape]) -> int:
    """Return the number of triangles of the meshes among shapes."""
    return sum(int(shape.face_count()) for shape in shapes if shape.is_mesh())


def _check_reach(surfaces: Sequence[Surface], boxes: Sequence[Bounds | None], wall: RelayWall) -> None:
    """Refuse what is so far away or so large that the wall's own points fall together in float32, or has no extent."""
    size = _wall_size(wall)
    for surface, box in zip(surfaces, boxes, strict=True):
        if box is not None and not float((box[1] - box[0]).max()) >= MIN_EXTENT * size:
            message = f"it has no extent beside a relay wall of {size:.4g} m. Check units and scale."
            raise ConfigError.at(surface.key, message)
        if box is not None and not float(np.abs(box).max()) <= MAX_REACH * size:
            raise ConfigError.at(
                surface.key,
                f"it reaches {float(np.abs(box).max()):.4g} m from the relay wall's centre, need at most {MAX_REACH:g} "
                f"times the wall's size of {size:.4g} m. Check units, scale and position.",
            )


def _unit_length(wall: RelayWall, hidden: Bounds | None) -> float:
    """Return the power of two [m] nearest to the scene's size."""
    size = _wall_size(wall)
    if hidden is not None:
        size = max(size, float(np.abs(box_corners(hidden)).max()))
    return 2.0 ** round(math.log2(size))


def _wall_size(wall: RelayWall) -> float:
    """Return the longest extent of the wall [m]: what its coordinates say, but of a mesh the true one."""
    if isinstance(wall.shape_description(), TriangleMesh):
        return float(np.ptp(wall.bounds(), axis=0).max())
    return max(wall.width, wall.height)


def wall_box(wall: RelayWall) -> Float64:
    """Return the corners (8, 3) of a box around the wall [m, local frame]."""
    return box_corners(wall.bounds())
