"""Hidden surfaces, and a wall that sees itself -> patches, as fine as asked.

A patch of size h at distance d from the nearest laser or sensor point has an error of order (h/d)^2 in its geometry
and of h^2/(4 d w) bins in its delay, with w the bin width: within a triangle the delay is taken as linear
(docs/virtual-lights.md, 2 and 3). One number, ``patch_scale``, scales the size allowed by both, so that the error falls
with its square.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import mitsuba as mi
import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.engine.launch.flat_mirrors import FlatMirrors
from nlosrender.engine.virtual_lights.elements.patches import Patches
from nlosrender.engine.virtual_lights.elements.round_shapes import RoundShape
from nlosrender.engine.virtual_lights.elements.sensor_regions import regions_of
from nlosrender.engine.virtual_lights.elements.size_field import SizedElements, SizeField
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, WallDistance, elements_of_mesh, subdivide
from nlosrender.engine.virtual_lights.elements.surface_distance import SurfaceDistance
from nlosrender.engine.virtual_lights.elements.triangles import centroids
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID
from nlosrender.scene.loading.round_surfaces import ROUND_PLUGINS
from nlosrender.scene.pixel_points import FirstHits

N_KEPT = 2  # scales: that of the gather, and one coarser for its error


class Tessellator:
    """Cuts the hidden geometry of one scene, and a wall that sees itself, into patches, as fine as asked.

    Triangles are quartered until none is longer than its distance from the nearest laser or sensor point (*elements*),
    then cut into equal parts, or merged where they are far smaller than need be.

    Parameters
    ----------
    built
        The scene: meshes, spheres and cylinders; ``can_tessellate`` tells beforehand.
    capture
        Where the laser and sensor points are.
    bin_width
        Bin width [engine units].
    may_divide
        Whether regions of the sensor grid may have patches of their own, where that is cheaper.
    mirror
        The only one, which may show the wall what turns away from it.
    tuning
        Sizes and limits.
    """

    def __init__(
        self,
        built: BuiltScene,
        capture: Capture,
        bin_width: float,
        *,
        may_divide: bool = True,
        mirror: FlatMirrors | None = None,
        tuning: VirtualLightTuning = DEFAULT_TUNING,
    ):
        self.built, self.capture, self.tuning = built, capture, tuning
        unit = built.metres_per_engine_unit
        self.distance: WallDistance | SurfaceDistance = WallDistance(capture, unit)
        size = max(capture.sensor_grid.lattice.size)
        if isinstance(built, SceneWithoutWall):
            self.distance = surface_distance(built, built.pixels.sensors, built.pixels.lasers)
            size = float(np.ptp(capture.sensor_grid.positions.reshape(-1, 3), axis=0).max())
            may_divide = False
        self.reach = size / (2 * unit)  # half the sensor grid's extent [engine units]
        triangles: list[Elements] = []
        self.round_shapes: list[RoundShape] = []
        self.wall_index: int | None = None  # of the wall among the scene's shapes, where it is cut as well
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID and not isinstance(built, SceneWithoutWall):
                if not wall_sees_itself(built):
                    continue
                self.wall_index = index
            if is_mirror(shape.bsdf()):
                continue
            if shape.is_mesh():
                triangles.append(elements_of_mesh(built, index, shape, mirror))
            else:
                self.round_shapes.append(RoundShape.of(index, shape))
        light = capture.laser_grid.positions.reshape(-1, 3).mean(axis=0) / built.metres_per_engine_unit
        self.size_field = SizeField(bin_width, self.wall_index, light, capture.n_lasers == 1, tuning)
        joined = Elements.joined(triangles or [Elements.none()])
        self.elements = subdivide(joined, self.distance, self.wall_index)
        whole = SizedElements(self.elements, self.size_field)
        self.regions = None
        if may_divide and isinstance(self.distance, WallDistance):
            self.regions = regions_of(capture, unit, self.distance, joined, whole)
        self.shared = whole if self.regions is None else self.regions.shared
        self._is_hidden = whole.is_hidden
        self._kept: dict[float, Patches] = {}  # by patch_scale, the last used at the end

    def set_up(self) -> None:
        """Sum up the elements that are merged at any scale, if there are any."""
        for elements in (self.shared, *(self.regions.near if self.regions else ())):
            elements.set_up()

    def patches(self, patch_scale: float) -> Patches:
        """Return patches whose error is of order ``patch_scale`` squared; those of the last calls are kept if few.

        Where there are regions, these are the patches that all of them share.
        """
        if sum(self.shared.counts(patch_scale)) > self.tuning.max_kept_patches:
            return self._make(patch_scale)
        # a dict: lru_cache of a bound method is a reference cycle, in which the scene stays alive, and Dr.Jit compiles
        # every living BSDF and shape into the kernels of the next capture
        patches = self._kept.pop(patch_scale, None)
        self._kept[patch_scale] = self._make(patch_scale) if patches is None else patches
        if len(self._kept) > N_KEPT:
            del self._kept[next(iter(self._kept))]
        return self._kept[patch_scale]

    def regional_patches(self, patch_scale: float, wanted: Sequence[int]) -> Iterator[tuple[list[int], list[Patches]]]:
        """Yield the ``wanted`` regions, and the patches close to the wall of each: as many as fit at once."""
        if self.regions is None:
            return
        labels: list[int] = []
        parts: list[Patches] = []
        for label in wanted:
            patches = self.regions.near[label].patches(patch_scale)
            if parts and sum(map(len, parts)) + len(patches) > self.tuning.max_regional_patches:
                yield labels, parts
                labels, parts = [], []
            labels.append(label)
            parts.append(patches)
        if parts:
            yield labels, parts

    def _make(self, patch_scale: float) -> Patches:
        on_round = [shape.patches(*self._allowed_on(shape, patch_scale)) for shape in self.round_shapes]
        return Patches.joined([self.shared.patches(patch_scale), *on_round])

    def count(self, patch_scale: float) -> int:
        """Return about how many patches a sensor point would gather, on average; exact where none merge."""
        return sum(self.counts(patch_scale))

    def counts(self, patch_scale: float) -> tuple[int, ...]:
        """Return ``count`` of the hidden meshes, of a mesh wall that sees itself, and of each sphere and cylinder."""
        on_round = (shape.count(*self._allowed_on(shape, patch_scale)) for shape in self.round_shapes)
        return (*(self.regions or self.shared).counts(patch_scale), *on_round)

    @property
    def nearest(self) -> float:
        """Distance from the points to the nearest hidden element's centroid, or round shape [engine units]."""
        return min([float(self.elements.distances[self._is_hidden].min(initial=np.inf)), self.nearest_round])

    @property
    def nearest_round(self) -> float:
        """Distance from the points to the nearest hidden round shape [engine units]; inf where there is none."""
        on_round = (shape.nearest(self.distance) for shape in self.round_shapes if shape.index != self.wall_index)
        return min(on_round, default=math.inf)

    @cached_property
    def nearest_to_laser(self) -> float:
        """Distance from the laser points to the nearest hidden element's centroid, or round shape [engine units]."""
        hidden = self.elements.select(self._is_hidden)
        if isinstance(self.built, SceneWithoutWall):
            of_lasers = surface_distance(self.built, self.built.pixels.lasers)
            lasers: WallDistance | SurfaceDistance = of_lasers
            distances = of_lasers.of_elements(hidden)
        else:
            lasers = WallDistance(
                replace(self.capture, sensor_grid=self.capture.laser_grid), self.built.metres_per_engine_unit
            )
            distances = lasers(centroids(hidden.corners)) if len(hidden) else np.zeros(0)
        on_round = [shape.nearest(lasers) for shape in self.round_shapes if shape.index != self.wall_index]
        return min([float(distances.min(initial=np.inf)), *on_round])

    @property
    def n_round_elements(self) -> int:
        """Elements of all round shapes: a needle has as many as it is longer than it is wide."""
        return sum(shape.count(*self._allowed_on(shape, 1.0)) for shape in self.round_shapes)

    def round_elements(self) -> list[tuple[RoundShape, Patches]]:
        """Return every round shape, and its elements, whose corners lie on it."""
        return [(shape, shape.patches(*self._allowed_on(shape, 1.0))) for shape in self.round_shapes]

    def _allowed_on(self, shape: RoundShape, patch_scale: float) -> tuple[float, float]:
        """Return the size of patches across a round shape, and along the axis of a cylinder, which is straight."""
        if shape.index == self.wall_index:
            # cos cos / r^2 varies over the radius only, however near: 1 / (4 radius^2) between points of a sphere
            nearest = abs(shape.radius)
        else:
            # at most 20 * 9^2 patches of a ball at scale 1, however near
            nearest = max(shape.nearest(self.distance), abs(shape.radius) / 8)
        straight = float(self.size_field.allowed_size(np.array([nearest]))[0])
        return patch_scale * min(straight, abs(shape.radius)), patch_scale * straight


def can_tessellate(built: BuiltScene) -> bool:
    """Return whether every hidden shape is a mesh, a sphere or a cylinder, or nothing but a mirror."""
    shapes = [shape for shape in built.hidden_shapes if not is_mirror(shape.bsdf())]
    return all(shape.is_mesh() or shape.class_name() in ROUND_PLUGINS for shape in shapes)


def is_mirror(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF has delta lobes alone: connections evaluate it to 0."""
    return not bool(bsdf.flags() & mi.BSDFFlags.Smooth)


def surface_distance(built: SceneWithoutWall, *hits: FirstHits) -> SurfaceDistance:
    """Return the distance from points that a camera sees."""
    shapes = enumerate(built.scene.shapes())
    is_round = frozenset(index for index, shape in shapes if shape.class_name() in ROUND_PLUGINS)
    return SurfaceDistance(hits, built.metres_per_engine_unit, is_round)


def wall_sees_itself(built: BuiltScene) -> bool:
    """Return whether light may go from the wall to the wall: not on a plane, nor outside a sphere or cylinder.

    Without relay wall all surfaces are hidden ones.
    """
    if isinstance(built, SceneWithoutWall):
        return False
    wall = built.wall_shape
    return not built.wall.is_planar and (wall.is_mesh() or wall.has_flipped_normals())
