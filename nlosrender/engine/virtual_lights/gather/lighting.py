"""Light of the lasers on patches, third bounce: BSDFs, distance, visibility, packed as sensor points gather it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.flat_mirrors import FlatMirrors, image_in, turned_in
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.second_bounce import on_one_plane
from nlosrender.engine.launch.wall_points import WallPoints
from nlosrender.engine.virtual_lights.elements.patches import SHADOW_RAYS
from nlosrender.engine.virtual_lights.gather.delay_distribution import PatchDelays
from nlosrender.engine.virtual_lights.gather.device_patches import RayEnds, facing
from nlosrender.engine.virtual_lights.refinement import Lattice
from nlosrender.engine.virtual_lights.visibility.shadow_rays import is_visible, mirrored_share
from nlosrender.scene.build import BuiltScene, SceneWithoutWall

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.gather.device_patches import DevicePatches
    from nlosrender.engine.virtual_lights.visibility.masks import VisibilityMasks, WallTiles

ROWS = 6  # of four numbers each, aligned loads: what the gather reads of a patch


@dataclass(frozen=True)
class GatherSettings:
    """What the gather's kernel does; part of the compiled kernel."""

    is_confocal: bool
    is_diffuse: bool  # every hidden BSDF is Lambertian: reflectance and a cosine are all there is
    has_two_sided: bool  # some Lambertian surface reflects on both sides
    needs_visibility: bool  # something may lie between wall and patches
    has_one_laser: bool  # in the whole capture, however it is cut
    is_multiplexed: bool = False  # all lasers light every batch, at once

    @property
    def lights_once(self) -> bool:
        """Whether the patches of all batches send on the same light."""
        return self.has_one_laser or self.is_confocal or self.is_multiplexed


@dataclass(frozen=True, eq=False)
class PackedPatches:
    """What the gather's loop reads: patches that are lit, packed so that one load brings four numbers."""

    # 24 a patch: three corners, each with one component of normal times area; the centre, and 1 for a cluster; from it
    # to the point of the surface where shadow rays end, and 1 for a two-sided surface; the ray offset along the normal
    # there, and 0
    packed: mi.Float
    mask: mi.UInt64  # of that point, see ``VisibilityMasks.of``
    rounding_residual: mi.Float | None  # four a patch: float64 minus float32 centre; None: negligible
    shading: mi.Normal3f  # shading normals
    interaction: mi.SurfaceInteraction3f  # at the centres
    middles: list[mi.SurfaceInteraction3f]  # in the middle of each edge; none of Lambertian patches
    reflectance: mi.Spectrum  # confocal Lambertian patches: reflectance / pi
    # index = laser * count + patch: light that arrives, per area perpendicular to it; of Lambertian patches the light
    # that leaves, negative on the back of two-sided ones; empty for confocal captures
    laser_light: mi.Spectrum
    delays: mi.Float  # four an index: from the laser point to each corner [bins]
    middle_delays: mi.Float  # to the centre
    # of ``sensor_lattice``, eight for each of SHADOW_RAYS points of a patch: the way from its centre, the first of
    # ``LitPatches.end_weights``, the ray offset, and the second; None: one ray is enough
    ends: mi.Float | None
    has_clusters: bool
    count: mi.UInt32  # of lit patches, opaque
    first: mi.UInt32  # of slice k: its patches are first[k] to first[k + 1]

    def from_laser(self, entry: mi.UInt32) -> tuple[mi.Spectrum, PatchDelays]:
        """Return ``laser_light`` and delays of pairs of laser and patch."""
        delays = PatchDelays(dr.gather(mi.Vector4f, self.delays, entry), dr.gather(mi.Float, self.middle_delays, entry))
        return dr.gather(mi.Spectrum, self.laser_light, entry), delays


@dataclass(frozen=True, eq=False)
class MaskQuery:
    """Visibility masks, and the rectangles of the wall that they are for."""

    masks: VisibilityMasks
    wall_tiles: WallTiles  # a rectangle per region of the patches

    @property
    def pays_off(self) -> bool:
        """Whether enough sensor points share a mask."""
        return self.masks.pay_off(self.wall_tiles.n_points)

    def of(self, patches: DevicePatches, ends: RayEnds, active: mi.Bool) -> mi.UInt64:
        """Return the masks of patches where rays end, see ``VisibilityMasks.of``."""
        where = on_device(mi.UInt32, patches.regions.regions)
        return self.masks.of(patches.surface(ends), self.wall_tiles, where, active)


@dataclass(frozen=True, eq=False)
class LitPatches:
    """Patches and what the lasers of a batch send them; those of confocal captures are lit as they are gathered."""

    patches: DevicePatches
    laser_light: mi.Spectrum  # index = laser * n_patches + patch; see ``PackedPatches``
    is_lit: mi.Bool  # by any of the lasers
    # SHADOW_RAYS: by which the only laser lights the points where rays end, over the share of the patch that it lights,
    # 0 in shadow, and the same without shadow and share
    end_weights: list[mi.Vector2f]
    ends: RayEnds  # of the sensor points' shadow rays, one each
    mask: mi.UInt64  # there, see ``VisibilityMasks.of``
    is_cleared: bool  # masks have been asked for: enough sensor points share them

    def cleared(self, mask_query: MaskQuery) -> LitPatches:
        """Return the same with visibility masks, if they pay off."""
        if not mask_query.pays_off:
            return self
        return replace(self, mask=mask_query.of(self.patches, self.ends, self.is_lit), is_cleared=True)


def light_patches(
    settings: GatherSettings,
    params: LaunchParams,
    patches: DevicePatches,
    mask_query: MaskQuery,
    n_lasers: int,
    mirror: FlatMirrors | None = None,
) -> LitPatches:
    """Light all patches of a scale by the ``n_lasers`` of a batch, and find their visibility masks.

    ``mirror``: by way of which the light comes; None: straight.
    """
    count = dr.width(patches.areas)
    ends, all_lit, no_mask = patches.ends(patches.number), dr.full(mi.Bool, True, count), dr.zeros(mi.UInt64, count)
    end_weights = [dr.full(mi.Vector2f, 1, count) for _ in range(SHADOW_RAYS)]
    dr.eval(ends)
    lit = LitPatches(patches, mi.Spectrum(0), all_lit, end_weights, ends, no_mask, is_cleared=False)
    if settings.needs_visibility and not settings.has_one_laser:
        lit = lit.cleared(mask_query)
    if not settings.is_confocal:
        lit = _light_by_lasers(settings, params, lit, mask_query, n_lasers, mirror)
    if settings.needs_visibility and settings.has_one_laser:
        lit = lit.cleared(mask_query)
    return lit


def pack_patches(
    settings: GatherSettings,
    params: LaunchParams,
    lit_patches: LitPatches,
    slices_per_region: int,
    n_lasers: int,
    mirror: FlatMirrors | None = None,
    lattice: Lattice | None = None,
) -> PackedPatches:
    """Return what the gather reads: the patches that are lit, sorted by slice (see ``PatchRegions.in_slices``)."""
    patches, laser_light = lit_patches.patches, lit_patches.laser_light
    delays, middle_delays = mi.Float(0), mi.Float(0)
    count = dr.width(patches.areas)
    lit = dr.compress(lit_patches.is_lit)
    if not dr.width(lit):
        lit = mi.UInt32(0)  # all is dark: one dark patch, since arrays of no length cannot be read
    lit, first = (
        on_device(mi.UInt32, values) for values in patches.regions.in_slices(np.array(lit.numpy()), slices_per_region)
    )
    n_lit = dr.opaque(mi.UInt32, dr.width(lit))  # as a constant it would be part of the kernel
    if not settings.is_confocal:
        index = dr.arange(mi.UInt32, dr.width(lit) * n_lasers)
        laser, patch = index // n_lit, dr.gather(mi.UInt32, lit, index % n_lit)
        laser_light = dr.gather(mi.Spectrum, laser_light, laser * dr.opaque(mi.UInt32, count) + patch)
        points = image_in(mirror, dr.gather(mi.Point3f, params.lasers.interaction.p, laser))
        centre = dr.gather(mi.Point3f, patches.interaction.p, patch)
        legs = PatchDelays.from_point(points, centre, _corners(patches, patch), params.bins_per_unit)
        delays, middle_delays = dr.ravel(legs.corners), legs.middle
    a, b, c = _corners(patches, lit)
    areas = dr.gather(mi.Vector3f, patches.areas, lit)
    interaction = dr.gather(mi.SurfaceInteraction3f, patches.interaction, lit)
    is_cluster = dr.gather(mi.Float, patches.is_cluster, lit)
    end = dr.gather(RayEnds, lit_patches.ends, lit)
    sides = dr.gather(mi.Float, patches.is_two_sided, lit)
    rows = [(a, areas.x), (b, areas.y), (c, areas.z), (interaction.p, is_cluster), (end.point, sides), (end.offset, 0)]
    packed = dr.zeros(mi.Float, 4 * ROWS * dr.width(lit))
    lane = dr.arange(mi.UInt32, dr.width(lit))
    for k, (point, fourth) in enumerate(rows):
        dr.scatter(packed, mi.Vector4f(*point, fourth), lane * ROWS + k)
    rounding_residual = None
    if patches.is_near:
        rounding_residual = dr.ravel(mi.Vector4f(*dr.gather(mi.Vector3f, patches.rounding_residual, lit), 0))
    result = PackedPatches(
        packed=packed,
        mask=dr.gather(mi.UInt64, lit_patches.mask, lit),
        rounding_residual=rounding_residual,
        shading=interaction.sh_frame.n,
        interaction=interaction,
        middles=[] if settings.is_diffuse else [dr.gather(mi.SurfaceInteraction3f, si, lit) for si in patches.middles],
        reflectance=dr.gather(mi.Spectrum, patches.reflectance, lit) * dr.inv_pi,
        laser_light=laser_light,
        delays=delays,
        middle_delays=middle_delays,
        ends=_packed_ends(lit_patches, lit) if lattice and lattice.rays > 1 else None,
        has_clusters=patches.has_clusters,
        count=n_lit,
        first=first,
    )
    dr.eval(result)
    return result


def _light_by_lasers(
    settings: GatherSettings,
    params: LaunchParams,
    dark: LitPatches,
    mask_query: MaskQuery,
    n_lasers: int,
    mirror: FlatMirrors | None,
) -> LitPatches:
    """Light every patch by every laser: emission, distance, and the fraction of the patch that is not in shadow.

    Shadow rays of sensor points end where they did, or at a point that the only laser lights. Of Lambertian patches
    the result is the light that leaves.
    """
    patches, ends, end_weights = dark.patches, dark.ends, dark.end_weights
    built = params.built
    n_patches = dr.width(patches.areas)
    index = dr.arange(mi.UInt32, n_patches * n_lasers)
    divisor = dr.opaque(mi.UInt32, n_patches)
    patch, laser = index % divisor, index // divisor
    points = params.lasers.gather(laser)
    lit = points.interaction
    centre = dr.gather(mi.Point3f, patches.interaction.p, patch)
    to_rounded = centre - image_in(mirror, lit.p)
    to_patch = to_rounded + dr.gather(mi.Vector3f, patches.rounding_residual, patch)
    distance2 = dr.squared_norm(to_patch)
    direction = to_patch * dr.rsqrt(distance2)
    sent = lit.to_local(turned_in(mirror, direction))
    laser_light = points.shared(built.bsdf_at(lit).eval(mi.BSDFContext(), lit, sent) / distance2)
    cosine = -dr.dot(dr.gather(mi.Normal3f, patches.interaction.sh_frame.n, patch), direction)
    active = dr.any(laser_light > 0)
    if isinstance(built, SceneWithoutWall):
        active &= ~on_one_plane(built, lit, dr.gather(mi.Normal3f, patches.interaction.n, patch), to_patch)
    if settings.is_diffuse:
        cosine = dr.select(dr.gather(mi.Float, patches.is_two_sided, patch) > 0, cosine, dr.maximum(cosine, 0))
        laser_light *= cosine * dr.gather(mi.Spectrum, patches.reflectance, patch) * dr.inv_pi
        active &= dr.any(laser_light != 0)
    else:
        flags = dr.gather(mi.SurfaceInteraction3f, patches.interaction, patch).bsdf().flags()
        active &= (cosine > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide)
    seen = mi.Spectrum(1)
    if settings.has_one_laser and (settings.needs_visibility or mirror is not None):
        seen, end_weights, ends = _lit_fraction(settings, built, patches, lit, centre, active, mirror)
    elif mirror is not None:
        end = dr.gather(RayEnds, ends, patch)
        seen = mirrored_share(built, mirror, lit, centre + end.point, end.offset, active)
    elif settings.needs_visibility:
        # the very point where the sensor points' rays end: what hides a part of a patch from both hides the same part
        end = dr.gather(RayEnds, ends, patch)
        to_surface = to_rounded + end.point
        tile = mask_query.wall_tiles.tile_bit(mi.UInt32(0), lit.p)
        is_before = dr.dot(dr.gather(mi.Vector3f, patches.areas, patch), to_surface) < 0  # the plane through that point
        mask = dr.select(is_before, dr.gather(mi.UInt64, dark.mask, patch), 0)
        seen = dr.select(is_visible(built, lit, to_surface, end.offset, active, mask, tile), mi.Spectrum(1), 0)
    laser_light = dr.select(active, laser_light * seen, 0)
    brightest = dr.zeros(mi.Float, n_patches)
    dr.scatter_reduce(dr.ReduceOp.Max, brightest, dr.max(dr.abs(laser_light)), patch)
    is_lit = brightest > 0
    dr.eval(laser_light, is_lit, ends, end_weights)
    return replace(dark, laser_light=laser_light, is_lit=is_lit, ends=ends, end_weights=end_weights)


def _lit_fraction(
    settings: GatherSettings,
    built: BuiltScene,
    patches: DevicePatches,
    laser: mi.SurfaceInteraction3f,
    centre: mi.Point3f,
    active: mi.Bool,
    mirror: FlatMirrors | None,
) -> tuple[mi.Spectrum, list[mi.Vector2f], RayEnds]:
    """Return the share of the only laser's light that each patch has, weights of ends that are lit, and one of them.

    The fractions that laser and sensor point see are not independent where one edge throws both shadows. One point,
    drawn among those in light by reservoir sampling, makes their product right on average: docs/virtual-lights.md, 5.
    """
    weights: list[mi.Vector2f] = []
    chosen, share, total, lit = dr.zeros(RayEnds), mi.Spectrum(0), mi.Float(0), mi.Float(0)
    is_cluster, is_one_sided = patches.is_cluster > 0, settings.is_diffuse & (patches.is_two_sided == 0)
    origin = image_in(mirror, laser.p)
    for k in range(SHADOW_RAYS):
        index = patches.number * SHADOW_RAYS + k
        end = patches.ends(index)
        if mirror is None:
            seen = mi.Spectrum(
                dr.select(is_visible(built, laser, centre - laser.p + end.point, end.offset, active), 1, 0)
            )
        else:
            seen = mirrored_share(built, mirror, laser, centre + end.point, end.offset, active)
        weight = facing(is_cluster, end.offset, centre + end.point - origin, is_one_sided)
        total += weight
        share += weight * seen
        lit_weight = dr.select(dr.any(seen > 0), weight, 0)
        lit += lit_weight
        weights.append(mi.Vector2f(lit_weight, weight))
        # reservoir of one: a lit point replaces the one before with its part of all weights so far
        chosen = dr.select(mi.sample_tea_float32(index, patches.start.x) * lit < lit_weight, end, chosen)
    over_share = dr.select(lit > 0, mi.Vector2f(total / lit, 1), mi.Vector2f(0, 1))
    return dr.select(total > 0, share / total, 0), [weight * over_share for weight in weights], chosen


def _packed_ends(lit_patches: LitPatches, lit: mi.UInt32) -> mi.Float:
    """Return ``PackedPatches.ends`` of the patches with numbers ``lit``."""
    patches, packed = lit_patches.patches, dr.zeros(mi.Float, 8 * SHADOW_RAYS * dr.width(lit))
    lane = dr.arange(mi.UInt32, dr.width(lit))
    for k, weights in enumerate(lit_patches.end_weights):
        end = dr.gather(RayEnds, patches.ends(patches.number * SHADOW_RAYS + k), lit)
        row = 2 * (lane * SHADOW_RAYS + k)
        weight = dr.gather(mi.Vector2f, weights, lit)
        dr.scatter(packed, mi.Vector4f(*end.point, weight.x), row)
        dr.scatter(packed, mi.Vector4f(*end.offset, weight.y), row + 1)
    dr.eval(packed)
    return packed


def _corners(patches: DevicePatches, index: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f, mi.Point3f]:
    centre = dr.gather(mi.Point3f, patches.interaction.p, index)
    a, b, c = (centre + dr.gather(mi.Vector3f, corner, index) for corner in patches.corners)
    return a, b, c


def irradiance(built: BuiltScene, laser: WallPoints, point: mi.Point3f, shading: mi.Normal3f) -> mi.Spectrum:
    """Return the irradiance at a point from a laser point that it sees [1 / (engine unit)^2 per J]."""
    emitted, direction, distance2 = _emitted(built, laser, point, shading)
    return emitted * (dr.maximum(-dr.dot(shading, direction), 0) / distance2)


def reflected_light(
    built: BuiltScene, laser: WallPoints, si: mi.SurfaceInteraction3f, active: mi.Bool = True
) -> mi.Spectrum:
    """Return the radiance along ``si.wi`` of surfaces that a laser point lights; visibility is left to the caller.

    In 1 / (sr engine unit^2) per J, by Mitsuba's ``eval`` of their BSDF.
    """
    emitted, direction, distance2 = _emitted(built, laser, si.p, si.n)
    return emitted * si.bsdf().eval(mi.BSDFContext(), si, si.to_local(-direction), active) / distance2


def _emitted(
    built: BuiltScene, laser: WallPoints, point: mi.Point3f, normal: mi.Normal3f
) -> tuple[mi.Spectrum, mi.Vector3f, mi.Float]:
    """Return the wall's BSDF towards points, the direction there, and the squared distance."""
    to_point = point - laser.interaction.p
    distance2 = dr.squared_norm(to_point)
    direction = to_point * dr.rsqrt(distance2)
    lit = laser.interaction
    is_lit: mi.Bool | bool = True
    if isinstance(built, SceneWithoutWall):
        is_lit = ~on_one_plane(built, lit, normal, to_point)
    emitted = built.bsdf_at(lit).eval(mi.BSDFContext(), lit, lit.to_local(direction), is_lit)
    return emitted, direction, distance2
