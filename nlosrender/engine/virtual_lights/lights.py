"""Virtual lights: patches on the device, and what the lasers make of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.connections import off_the_wall
from nlosrender.engine.device_arrays import columns, on_device
from nlosrender.engine.low_discrepancy import recurrence_steps
from nlosrender.engine.space_filling import z_order
from nlosrender.engine.transport import Transport
from nlosrender.engine.virtual_lights.occlusion import HiddenHull
from nlosrender.engine.virtual_lights.patches import Patches
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

ROWS = 5  # of four numbers each: what the gather reads of a patch
LASER_RAYS = 4  # shadow rays from a laser to points spread over a patch
SHORT = 1e-4  # of the way: rays stop so short of a patch; a thin sheet 4 mm in front still hides it
LEAST_SHORT = 2e-7  # engine units: float32 knows a surface's place no better, and a ray must not meet its own end


@dataclass(frozen=True)
class GatherSettings:
    """What the gather's kernel does; part of the compiled kernel."""

    is_confocal: bool
    is_diffuse: bool  # every hidden BSDF is Lambertian: reflectance and a cosine are all there is
    needs_visibility: bool  # something may lie between wall and patches


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of the patches, each gathered by lanes of its own: slices of those of a region, or of all.

    A patch's number within its region decides its slice, so what one laser sends does not depend on the batch's other
    lasers, whose patches may be others.
    """

    regions: NDArray[np.int64]  # (n,) region of each patch, ascending
    numbers: NDArray[np.int64]  # (n,) of each patch within its region
    slices: int  # lanes that share the patches of a sensor point

    @classmethod
    def of(cls, counts: Sequence[int], slices: int) -> Parts:
        """Return the parts of ``counts`` patches per region, region after region."""
        regions = np.repeat(np.arange(len(counts)), counts)
        return cls(regions, np.concatenate([np.arange(count) for count in counts]), slices)

    def sorted(self, patch: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Sort patches by part, within it by number; return them and where each part begins, and the last one ends."""
        part = (self.regions * self.slices + self.numbers % self.slices)[patch]
        order = np.lexsort((patch, part))
        n_parts = (int(self.regions[-1]) + 1) * self.slices
        return patch[order], np.searchsorted(part[order], np.arange(n_parts + 1))


@dataclass(frozen=True, eq=False)
class DevicePatches:
    """Patches on the device, engine units; one lane per patch."""

    parts: Parts
    number: mi.UInt32  # within its region: what decides the points its light is asked for
    remainder: mi.Vector3f  # of the centre, what float32 rounds off: close to the wall it is more than the distance
    is_near: bool  # some patch is so near to a laser or sensor point that the remainder counts
    corners: list[mi.Vector3f]  # three, from the centre
    lift: mi.Vector3f  # from the plane of the corners to the surface
    members: mi.Vector4f  # from the centre to where shadow rays of clusters end, and 1 for a cluster, else 0
    has_clusters: bool
    areas: mi.Vector3f  # geometric normal times area
    interaction: mi.SurfaceInteraction3f  # at the centres
    reflectance: mi.Spectrum  # of Lambertian patches
    shown: mi.Vector3f  # from the centre's float32 position to where rays from sensor points end
    is_open: mi.Float  # 1 where nothing can stop them


@dataclass(frozen=True, eq=False)
class Lights:
    """What the gather's loop reads: patches that are lit, packed so that one load brings four numbers."""

    # 20 a patch: three corners, each with one component of normal times area; the centre, and 1 for a cluster; from it
    # to where rays from sensor points end, and 1 where nothing can stop them
    packed: mi.Float
    remainder: mi.Float | None  # four a patch: what float32 rounds off the centre; None where that does not count
    shading: mi.Normal3f  # shading normals
    interaction: mi.SurfaceInteraction3f  # at the centres; not read for Lambertian patches
    reflectance: mi.Spectrum  # confocal Lambertian patches: reflectance / pi
    arriving: mi.Spectrum  # index = laser * count + patch: light that arrives, per area perpendicular to it;
    # of Lambertian patches the light that leaves; empty for confocal captures
    delays: mi.Float  # four an index: from the laser point to each corner [bins]
    has_clusters: bool
    count: mi.UInt32  # of lit patches, opaque
    first: mi.UInt32  # of part k: its patches are first[k] to first[k + 1]


def upload_patches(
    built: BuiltScene, patches: Patches, parts: Parts, hull: HiddenHull, seed: int, is_near: bool
) -> DevicePatches:
    """Bring patches to the device, neighbours together, and evaluate their reflectance and shading frames.

    Parameters
    ----------
    built, patches
        The scene and what it was cut into, region after region.
    parts
        Region of each patch, and its number there.
    hull
        Tells which patches the whole wall sees.
    seed
        Of the points that stand for their patches where visibility is asked for. A point at random makes a partly
        hidden patch count by its visible share, on average; one for all sensor points keeps their rays together.
    is_near
        Whether some patch is so near to a laser or sensor point that float32 positions do not do.
    """
    patches = patches.at(np.lexsort((z_order(patches.centres), parts.regions)))
    interaction = surface_at(
        built, patches.centres, patches.normals, patches.shapes, patches.primitives, patches.barycentric
    )
    reflectance = normal_reflectance(interaction)
    centre = np.array(interaction.p, np.float64).T
    from_rounded = patches.centres - centre
    remainder = mi.Vector3f(to_points(from_rounded))
    corners = [mi.Vector3f(to_points(patches.corners[:, k] - patches.centres)) for k in range(3)]
    areas = mi.Vector3f(to_points(patches.normals * patches.areas[:, None]))
    lift = mi.Vector3f(to_points(patches.normals * patches.lifts[:, None]))
    is_cluster = on_device(mi.Float, patches.is_cluster)
    members = mi.Vector4f(*to_points(patches.members - patches.centres), is_cluster)
    # a cluster's members have normals of their own: it is lit and seen by their mean
    frame, own = interaction.sh_frame, mi.Frame3f(mi.Normal3f(interaction.n))
    interaction.sh_frame = dr.select(members.w > 0, own, frame)
    number, steps = on_device(mi.UInt32, parts.numbers), recurrence_steps(2)
    start_u, start_v = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(0))
    u, v = (
        mi.Float((start + number * step) >> 8) * 2.0**-24 for start, step in zip((start_u, start_v), steps, strict=True)
    )
    shown = remainder + dr.select(members.w > 0, members.xyz, point_inside(corners, u, v) + lift)
    is_open = on_device(mi.Float, hull.is_below(patches) & ~patches.is_cluster)
    dr.eval(interaction, reflectance, remainder, corners, areas, lift, members, shown, is_open)
    has_clusters = bool(patches.is_cluster.any())
    return DevicePatches(
        parts,
        number,
        remainder,
        is_near,
        corners,
        lift,
        members,
        has_clusters,
        areas,
        interaction,
        reflectance,
        shown,
        is_open,
    )


def surface_at(
    built: BuiltScene,
    positions: Float64,
    normals: Float64,
    shapes: NDArray[np.uint32],
    primitives: NDArray[np.uint32],
    barycentric: Float64,
) -> mi.SurfaceInteraction3f:
    """Return the surface at known points, as a ray from one unit above would find it; no ray is traced.

    Parameters
    ----------
    built
        The scene.
    positions, normals
        (n, 3) points [engine units] and geometric normals.
    shapes, primitives
        (n,) index into the scene's shapes; triangle of a mesh.
    barycentric
        (n, 2) coordinates within the triangle.
    """
    point, normal = to_points(positions), mi.Vector3f(to_points(normals))
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(positions))
    hit.t = dr.full(mi.Float, 1.0, len(positions))
    hit.prim_uv = mi.Point2f(*columns(barycentric))
    hit.prim_index = on_device(mi.UInt32, primitives)
    shape = dr.gather(mi.ShapePtr, built.scene.shapes_dr(), on_device(mi.UInt32, shapes))
    interaction = shape.compute_surface_interaction(mi.Ray3f(point + normal, -normal), hit, mi.RayFlags.All)
    interaction.initialize_sh_frame()
    interaction.shape = shape
    interaction.p = point
    interaction.n = mi.Normal3f(normal)
    interaction.wi = mi.Vector3f(0, 0, 1)
    return interaction


def normal_reflectance(interaction: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return pi times the BSDF along the normal: the reflectance of a Lambertian surface."""
    up = mi.Vector3f(0, 0, 1)
    return interaction.bsdf().eval(mi.BSDFContext(), interaction, up) * dr.pi


def light_patches(settings: GatherSettings, transport: Transport, patches: DevicePatches, n_lasers: int) -> Lights:
    """Return the patches that some laser of the batch lights; confocal captures keep all and light them as they go.

    Parameters
    ----------
    settings, transport
        What the gather does and reads.
    patches
        All patches of a resolution.
    n_lasers
        Lasers of the batch.
    """
    count = dr.width(patches.areas)
    lit = dr.arange(mi.UInt32, count)
    arriving, delays = mi.Spectrum(0), mi.Float(0)
    if not settings.is_confocal:
        arriving, brightest = _illuminate(settings, transport, patches, n_lasers)
        lit = dr.compress(brightest > 0)
        if not dr.width(lit):
            lit = mi.UInt32(0)  # all is dark: one dark patch, since arrays of no length cannot be read
    lit, first = (on_device(mi.UInt32, values) for values in patches.parts.sorted(np.array(lit.numpy())))
    if not settings.is_confocal:
        index = dr.arange(mi.UInt32, dr.width(lit) * n_lasers)
        n_lit = dr.opaque(mi.UInt32, dr.width(lit))  # as a constant it would be part of the kernel
        laser, patch = index // n_lit, dr.gather(mi.UInt32, lit, index % n_lit)
        arriving = dr.gather(mi.Spectrum, arriving, laser * dr.opaque(mi.UInt32, count) + patch)
        points = dr.gather(mi.Point3f, transport.lasers.interaction.p, laser)
        ends = four_corners(*_corners(patches, patch))
        delays = dr.ravel(mi.Vector4f(*(dr.norm(end - points) * transport.bins_per_unit for end in ends)))
    a, b, c = _corners(patches, lit)
    areas, interaction = (
        dr.gather(mi.Vector3f, patches.areas, lit),
        dr.gather(mi.SurfaceInteraction3f, patches.interaction, lit),
    )
    is_cluster = dr.gather(mi.Vector4f, patches.members, lit).w
    shown, is_open = dr.gather(mi.Vector3f, patches.shown, lit), dr.gather(mi.Float, patches.is_open, lit)
    rows = [(a, areas.x), (b, areas.y), (c, areas.z), (interaction.p, is_cluster), (shown, is_open)]
    packed = dr.zeros(mi.Float, 4 * ROWS * dr.width(lit))
    lane = dr.arange(mi.UInt32, dr.width(lit))
    for k, (point, fourth) in enumerate(rows):
        dr.scatter(packed, mi.Vector4f(*point, fourth), lane * ROWS + k)
    remainder = None
    if patches.is_near:
        rest = dr.gather(mi.Vector3f, patches.remainder, lit)
        remainder = dr.ravel(mi.Vector4f(rest.x, rest.y, rest.z, 0))
    reflectance = dr.gather(mi.Spectrum, patches.reflectance, lit) * dr.inv_pi
    dr.eval(packed, remainder, arriving, delays, interaction, reflectance)
    return Lights(
        packed,
        remainder,
        interaction.sh_frame.n,
        interaction,
        reflectance,
        arriving,
        delays,
        patches.has_clusters,
        dr.opaque(mi.UInt32, dr.width(lit)),
        first,
    )


def _illuminate(
    settings: GatherSettings, transport: Transport, patches: DevicePatches, n_lasers: int
) -> tuple[mi.Spectrum, mi.Float]:
    """Light every patch by every laser: emission, distance, and the share of the patch that is not in shadow.

    Returns
    -------
    tuple
        What arrives (of Lambertian patches: leaves), index = laser * n_patches + patch; and the most of it per patch.
    """
    built = transport.built
    n_patches = dr.width(patches.areas)
    index = dr.arange(mi.UInt32, n_patches * n_lasers)
    divisor = dr.opaque(mi.UInt32, n_patches)
    patch, laser = index % divisor, index // divisor
    points = transport.lasers.gather(laser)
    lit = points.interaction
    corners = [dr.gather(mi.Vector3f, corner, patch) for corner in patches.corners]
    centre = dr.gather(mi.Point3f, patches.interaction.p, patch)
    to_patch = (centre - lit.p) + dr.gather(mi.Vector3f, patches.remainder, patch)
    distance2 = dr.squared_norm(to_patch)
    direction = to_patch * dr.rsqrt(distance2)
    arriving = built.wall_bsdf.eval(mi.BSDFContext(), lit, lit.to_local(direction)) / distance2
    cosine = -dr.dot(dr.gather(mi.Normal3f, patches.interaction.sh_frame.n, patch), direction)
    active = dr.any(arriving > 0)
    if settings.is_diffuse:
        arriving *= dr.maximum(cosine, 0) * dr.gather(mi.Spectrum, patches.reflectance, patch) * dr.inv_pi
        active &= dr.any(arriving > 0)
    else:
        flags = dr.gather(mi.SurfaceInteraction3f, patches.interaction, patch).bsdf().flags()
        active &= (cosine > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide)
    lift = dr.gather(mi.Vector3f, patches.lift, patch)
    member = dr.gather(mi.Vector4f, patches.members, patch)
    seen = mi.Float(1)
    if settings.needs_visibility:
        seen = mi.Float(0)
        first = dr.gather(mi.UInt32, patches.number, patch) * LASER_RAYS
        for k in range(LASER_RAYS):
            u, v = (_fraction(first + k, step) for step in recurrence_steps(2))
            in_patch = dr.select(member.w > 0, member.xyz, point_inside(corners, u, v) + lift)
            seen += dr.select(is_visible(built, lit, to_patch + in_patch, active), 1.0 / LASER_RAYS, 0)
    arriving = dr.select(active, arriving * seen, 0)
    brightest = dr.zeros(mi.Float, n_patches)
    dr.scatter_reduce(dr.ReduceOp.Max, brightest, dr.max(arriving), patch)
    dr.eval(arriving, brightest)
    return arriving, brightest


def is_visible(built: BuiltScene, wall_point: mi.SurfaceInteraction3f, way: mi.Vector3f, active: mi.Bool) -> mi.Bool:
    """Return whether nothing lies on the way from a point of the wall to a point of a patch."""
    origin = off_the_wall(built, wall_point)
    direction = way - (origin - wall_point.p)
    end = dr.maximum(1 - SHORT - LEAST_SHORT * dr.rsqrt(dr.squared_norm(direction)), 0)
    ray = mi.Ray3f(origin, direction, end, mi.Float(0), [])
    return active & ~built.scene.ray_test(ray, coherent=False, active=active)


def four_corners(a: mi.Point3f, b: mi.Point3f, c: mi.Point3f) -> tuple[mi.Point3f, ...]:
    """Return a triangle's corners and the fourth that makes it a parallelogram."""
    return a, b, c, a + (c - b)


def _corners(patches: DevicePatches, index: mi.UInt32) -> list[mi.Point3f]:
    centre = dr.gather(mi.Point3f, patches.interaction.p, index)
    return [centre + dr.gather(mi.Vector3f, corner, index) for corner in patches.corners]


def point_inside(corners: list[mi.Vector3f], u: mi.Float, v: mi.Float) -> mi.Vector3f:
    """Return the point of a triangle that two uniform numbers choose, uniform by area."""
    root = dr.sqrt(u)
    a, b, c = corners
    return a + (b - a) * (root * (1 - v)) + (c - a) * (root * v)


def _fraction(index: mi.UInt32, step: int) -> mi.Float:
    return mi.Float((index * mi.UInt32(step)) >> 8) * 2.0**-24


def to_points(values: Float64) -> mi.Point3f:
    """Bring vectors (n, 3) to the device."""
    return mi.Point3f(*columns(values))
