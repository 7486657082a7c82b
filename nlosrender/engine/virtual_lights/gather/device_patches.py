"""Patches on the device: where they are, what they reflect, and the points where their shadow rays end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import columns, on_device
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.plain_diffuse import is_two_sided_diffuse, is_uniform_diffuse
from nlosrender.engine.launch.ray_offsets import off_the_surface
from nlosrender.engine.launch.sequences import recurrence_steps
from nlosrender.engine.virtual_lights.elements.patches import SHADOW_RAYS, Patches, SurfacePoints, split_weights
from nlosrender.engine.virtual_lights.elements.round_shapes import RoundShape
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.engine.virtual_lights.visibility.masks import Surface
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.loading.round_surfaces import ROUND_PLUGINS
from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_point import triangle_weights


@dataclass(frozen=True, eq=False)
class PatchRegions:
    """The region of each patch, and its number within it."""

    regions: NDArray[np.int64]  # (n,) ascending
    numbers: NDArray[np.int64]  # (n,)

    @classmethod
    def of(cls, counts: Sequence[int]) -> PatchRegions:
        """Return regions and numbers of ``counts`` patches per region, region after region."""
        regions = np.repeat(np.arange(len(counts)), counts)
        return cls(regions, np.concatenate([np.arange(count) for count in counts]))

    def in_slices(self, patch: NDArray[np.integer], per_region: int) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Sort patches by slice, within it by number; return them and where each slice begins, and the last one ends.

        A region has ``per_region`` slices, each gathered by lanes of its own. A patch's number within its region
        decides its slice, so that the batch's other lasers, which may light other patches, change nothing.
        """
        slice_index = (self.regions * per_region + self.numbers % per_region)[patch]
        order = np.lexsort((patch, slice_index))
        n_slices = (int(self.regions[-1]) + 1) * per_region
        return patch[order], np.searchsorted(slice_index[order], np.arange(n_slices + 1))


@dataclass(frozen=True, eq=False)
class Curvature:
    """Sphere or cylinder that each patch lies on."""

    centre: mi.Vector3f  # from the patch's centre to that of a sphere, or to a point of a cylinder's axis
    radius: mi.Float  # 0 for flat patches
    axis: mi.Vector3f  # unit axis of a cylinder, 0 for a sphere

    @classmethod
    def of(cls, built: BuiltScene, patches: Patches) -> Curvature | None:
        """Return the curvature of patches; None where all are flat."""
        rows = np.zeros((len(built.scene.shapes()), 7))
        for index, shape in enumerate(built.scene.shapes()):
            if shape.class_name() in ROUND_PLUGINS:
                rows[index] = RoundShape.of(index, shape).row
        if not rows.any():
            return None
        rows = rows[patches.shapes]
        radius = on_device(mi.Float, np.abs(rows[:, 3]))
        return cls(to_vectors(rows[:, :3] - patches.centres), radius, to_vectors(rows[:, 4:]))

    def onto_surface(self, points: mi.Vector3f) -> mi.Vector3f:
        """Return points, relative to the patches' centres, brought onto the surface along its normal."""
        outward = self._outward(points)
        distance = dr.norm(outward)
        return dr.select(self.radius > 0, points + outward * ((self.radius - distance) / distance), points)

    def turned(self, along: mi.Vector3f, points: mi.Vector3f) -> mi.Vector3f:
        """Return vectors along the normals of patches, turned to the normals at points of them."""
        normal = dr.normalize(self._outward(points))
        return dr.select(self.radius > 0, normal * dr.mulsign(dr.norm(along), dr.dot(normal, along)), along)

    def _outward(self, points: mi.Vector3f) -> mi.Vector3f:
        outward = points - self.centre
        return outward - dr.dot(outward, self.axis) * self.axis


@dataclass
class RayEnds:
    """Where shadow rays end, one per patch."""

    point: mi.Vector3f  # of the surface, from the centre's float32 position
    offset: mi.Vector3f  # ray offset along the normal there, see ``off_the_surface``
    normal: mi.Vector3f  # of a cluster's member geometric, else the shading normal: for the visibility mask


def facing(is_cluster: mi.Bool, normal: mi.Vector3f, to_end: mi.Vector3f, is_one_sided: mi.Bool) -> mi.Float:
    """Return the weight of a shadow ray's end in the visible share of a patch: a cluster member's cosine, else 1.

    Members that face a laser or sensor point are hidden from it less often than others: without the cosines, clusters
    of a deep carpet were 1.8 % too dark.

    Parameters
    ----------
    normal
        Of any length.
    to_end
        From the laser or sensor point.
    is_one_sided
        Whether the surface reflects in front only.
    """
    cosine = dr.dot(dr.normalize(normal), dr.normalize(to_end))
    return dr.select(is_cluster, dr.select(is_one_sided, dr.maximum(-cosine, 0), dr.abs(cosine)), 1)


@dataclass(frozen=True, eq=False)
class DevicePatches:
    """Patches on the device, engine units; one lane per patch."""

    regions: PatchRegions
    number: mi.UInt32  # within its region: chooses, with ``start``, where its shadow rays end
    start: mi.Vector2u  # of the low-discrepancy sequence of these points
    rounding_residual: mi.Vector3f  # float64 centre minus float32 centre
    is_near: bool  # some patch is so near to a laser or sensor point that the residual counts
    corners: list[mi.Vector3f]  # three, from the centre
    curvature: Curvature | None  # None: all are flat
    is_cluster: mi.Float  # 1 or 0
    is_two_sided: mi.Float  # of Lambertian patches, 1 or 0
    members: list[RayEnds]  # of clusters, from the centres' float64 positions; none where there are no clusters
    areas: mi.Vector3f  # geometric normal times area
    interaction: mi.SurfaceInteraction3f  # at the centres
    middles: list[mi.SurfaceInteraction3f]  # in the middle of the edge before each corner; none of Lambertian patches
    reflectance: mi.Spectrum  # of Lambertian patches
    offset: mi.Vector3f  # ray offset at the centre, see ``off_the_surface``

    @property
    def has_clusters(self) -> bool:
        """Whether any patch is one."""
        return bool(self.members)

    def ends(self, index: mi.UInt32) -> RayEnds:
        """Return where shadow rays end, one per patch.

        ``index`` chooses a low-discrepancy point of a patch, or one of a cluster's members. On a curved patch the ray
        offset is along the normal at that point, not the centre's, for a grazing ray may come from behind the latter.
        """
        u, v = spread_numbers(self.start, index)
        inside, offset = point_inside(self.corners, u, v), self.offset
        if self.curvature is not None:
            inside = self.curvature.onto_surface(inside)
            offset = self.curvature.turned(offset, inside)
        end = RayEnds(inside, offset, mi.Vector3f(self.interaction.sh_frame.n))
        for k, member in enumerate(self.members):
            end = dr.select((self.is_cluster > 0) & (index % SHADOW_RAYS == k), member, end)
        end.point += self.rounding_residual
        return end

    def surface(self, ends: RayEnds) -> Surface:
        """Return positions and normals of the rays' ends, as visibility masks take them."""
        interaction = self.interaction
        return Surface(mi.Point3f(interaction.p + ends.point), mi.Vector3f(interaction.n), ends.normal)


def upload_patches(
    built: BuiltScene,
    patches: Patches,
    regions: PatchRegions,
    seed: int,
    is_near: bool,
    is_diffuse: bool,
    tuning: VirtualLightTuning = DEFAULT_TUNING,
) -> DevicePatches:
    """Bring patches to the device, neighbours together, and evaluate their reflectance and shading frames.

    ``seed`` draws the points where shadow rays end: a partly hidden patch counts by its visible share, on average
    (docs/virtual-lights.md, 5.1). ``is_near``: some patch is so near to a laser or sensor point that float32 positions
    are too coarse. ``is_diffuse``: all are Lambertian.
    """
    patches = patches.select(np.lexsort((morton_order(patches.centres), regions.regions)))
    interaction = surface_at(built, patches.points(patches.centres, patches.barycentric))
    reflectance = _mean_reflectance(built, patches, normal_reflectance(interaction), tuning)
    is_cluster = on_device(mi.Float, patches.is_cluster)
    # a cluster's members have normals of their own: it is lit and seen by their mean
    frame, own = interaction.sh_frame, mi.Frame3f(mi.Normal3f(interaction.n))
    interaction.sh_frame = dr.select(is_cluster > 0, own, frame)
    start = mi.Vector2u(*mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(0)))
    dr.make_opaque(start)
    curvature = Curvature.of(built, patches)
    offset = off_the_surface(built, patches.centres, patches.normals, patches.shapes) - patches.centres
    result = DevicePatches(
        regions=regions,
        number=on_device(mi.UInt32, regions.numbers),
        start=start,
        rounding_residual=to_vectors(patches.centres - np.array(interaction.p, np.float64).T),
        is_near=is_near,
        corners=[to_vectors(patches.corners[:, k] - patches.centres) for k in range(3)],
        curvature=curvature,
        is_cluster=is_cluster,
        is_two_sided=on_device(mi.Float, _of_shapes(built, patches, is_two_sided_diffuse)),
        members=_members(built, patches),
        areas=to_vectors(patches.normals * patches.areas[:, None]),
        interaction=interaction,
        middles=[] if is_diffuse else _middles(built, patches, interaction, is_cluster > 0, curvature),
        reflectance=reflectance,
        offset=to_vectors(offset),
    )
    dr.eval(result)
    return result


def _members(built: BuiltScene, patches: Patches) -> list[RayEnds]:
    """Return the cluster members where shadow rays end; zeros for patches that are no clusters."""
    chosen = np.flatnonzero(patches.is_cluster)
    if not len(chosen):
        return []
    centres, shapes = patches.centres[chosen], patches.shapes[chosen]
    result = []
    for k in range(SHADOW_RAYS):
        places, normals = patches.members[chosen, k], patches.member_normals[chosen, k].astype(np.float64)
        offsets = off_the_surface(built, centres + places, normals, shapes) - (centres + places)
        columns = np.zeros((3, len(patches), 3))
        columns[:, chosen] = places, offsets, normals
        result.append(RayEnds(*(to_vectors(column) for column in columns)))
    return result


def surface_at(built: BuiltScene, points: SurfacePoints) -> mi.SurfaceInteraction3f:
    """Return the surface at known points, as a ray from one unit above would find it; no ray is traced."""
    point, normal = to_points(points.positions), to_vectors(points.normals)
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(points))
    hit.t = dr.full(mi.Float, 1.0, len(points))
    hit.prim_uv = mi.Point2f(*columns(points.barycentric))
    hit.prim_index = on_device(mi.UInt32, points.primitives)
    shape = dr.gather(mi.ShapePtr, built.scene.shapes_dr(), on_device(mi.UInt32, points.shapes))
    interaction = shape.compute_surface_interaction(mi.Ray3f(point + normal, -normal), hit, mi.RayFlags.All)
    interaction.initialize_sh_frame()
    interaction.shape = shape
    interaction.p = point
    interaction.n = mi.Normal3f(normal)
    interaction.wi = mi.Vector3f(0, 0, 1)
    return interaction


def _middles(
    built: BuiltScene,
    patches: Patches,
    centre: mi.SurfaceInteraction3f,
    is_cluster: mi.Bool,
    curvature: Curvature | None,
) -> list[mi.SurfaceInteraction3f]:
    """Return the surface in the middle of the edge opposite each corner; of clusters ``centre``.

    Where a BSDF has a picture, at random points instead, each nearest to that edge: three texels on a grid would be the
    picture's mean or not as patches and texels happen to lie (docs/virtual-lights.md, 2.5).
    """
    chosen = np.flatnonzero(_of_shapes(built, patches, _has_picture))
    rng = np.random.default_rng(len(patches))
    random = np.stack(triangle_weights(rng.random(len(chosen)), rng.random(len(chosen))), axis=1)
    least = random.argmin(axis=1)[:, None]
    result = []
    for corner in range(3):
        weights = np.tile(0.5 - 0.5 * np.eye(3)[corner], (len(patches), 1))
        weights[chosen] = np.take_along_axis(random, (np.arange(3) - corner + least) % 3, axis=1)
        middle = surface_at(built, patches.mixed(weights))
        place = to_vectors(patches.corners[:, [corner - 1, corner - 2]].mean(axis=1) - patches.centres)
        middle.p = centre.p + (place if curvature is None else curvature.onto_surface(place))
        result.append(dr.select(is_cluster, centre, middle))
        dr.eval(result[-1])
    return result


def _mean_reflectance(
    built: BuiltScene, patches: Patches, reflectance: mi.Spectrum, tuning: VirtualLightTuning
) -> mi.Spectrum:
    """Return the reflectance of patches, averaged over stratified points of each where some surface has a texture.

    With that of the centre alone, ``reflectance``, a texture finer than the patches had other colours at every scale,
    and the difference of two scales, the stated error, would be noise.
    """
    chosen = np.flatnonzero(_of_shapes(built, patches, _has_reflectances) & ~patches.is_cluster)
    if not len(chosen):
        return reflectance
    some, random = patches.select(chosen), np.random.default_rng(len(patches))
    parts = split_weights(tuning.texture_splits[0 if len(chosen) > tuning.few_patches else 1])
    total = mi.Spectrum(0)
    for part in parts:
        weights = np.stack(triangle_weights(random.random(len(chosen)), random.random(len(chosen))), axis=1) @ part
        total += normal_reflectance(surface_at(built, some.mixed(weights)))
        dr.eval(total)
    dr.scatter(reflectance, total / len(parts), on_device(mi.UInt32, chosen))
    return reflectance


def _of_shapes(built: BuiltScene, patches: Patches, of_bsdf: Callable[[mi.BSDF], bool]) -> NDArray[np.bool_]:
    """Return for each patch whether the BSDF of its shape is such a one."""
    return np.array([of_bsdf(shape.bsdf()) for shape in built.scene.shapes()])[patches.shapes]


def _has_reflectances(bsdf: mi.BSDF) -> bool:
    return bsdf.class_name() == "SmoothDiffuse" and not is_uniform_diffuse(bsdf)


def _has_picture(bsdf: mi.BSDF) -> bool:
    return any(key.endswith("to_uv") for key, _ in mi.traverse(bsdf))


def normal_reflectance(interaction: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return pi times the BSDF along the normal: the reflectance of a Lambertian surface."""
    up = mi.Vector3f(0, 0, 1)
    return interaction.bsdf().eval(mi.BSDFContext(), interaction, up) * dr.pi


def point_inside(corners: list[mi.Vector3f], u: mi.Float, v: mi.Float) -> mi.Vector3f:
    """Return the point of a triangle that two uniform numbers choose, uniform by area."""
    _, at_b, at_c = triangle_weights(u, v, dr.sqrt)
    a, b, c = corners
    return a + (b - a) * at_b + (c - a) * at_c


def spread_numbers(start: mi.Vector2u, index: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return two numbers in [0, 1) per index of an additive recurrence, a low-discrepancy sequence."""
    steps = recurrence_steps(2)
    u, v = (mi.Float((start[k] + index * mi.UInt32(steps[k])) >> 8) * 2.0**-24 for k in range(2))
    return u, v


def to_points(values: Float64) -> mi.Point3f:
    """Bring positions (n, 3) to the device."""
    return mi.Point3f(*columns(values))


def to_vectors(values: Float64) -> mi.Vector3f:
    """Bring vectors (n, 3) to the device."""
    return mi.Vector3f(*columns(values))
