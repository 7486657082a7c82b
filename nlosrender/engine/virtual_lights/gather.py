"""The gather: every sensor point looks at every patch; each patch's light is spread over the bins it covers.

One lane per sensor point walks over all patches, so that a lane owns its rows of the histogram. A triangle's delay
differs over its area. Let t0 <= t1 <= t2 be the delays (in bins) at its corners; with the delay linear in between,
the part of its area with a delay below t is

    (t - t0)^2 / ((t2 - t0)(t1 - t0))          for t0 <= t <= t1
    1 - (t2 - t)^2 / ((t2 - t0)(t2 - t1))      for t1 <= t <= t2

and the share of a bin is the difference of this function at the bin's edges: no noise, exact for a linear delay.
Cf. Iseringhausen & Hullin 2020; Tsai et al. 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.connections import RAY_OFFSET
from nlosrender.engine.device_arrays import WallPoints
from nlosrender.engine.histogram import DeviceHistogram
from nlosrender.engine.low_discrepancy import recurrence_steps
from nlosrender.engine.transport import Transport
from nlosrender.engine.virtual_lights.patches import Patches
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

NARROWEST = 1e-3  # bins: below it a triangle's delay counts as one number
LASER_RAYS = 4  # shadow rays from a laser to points spread over a patch


@dataclass(frozen=True)
class GatherSettings:
    """What the gather's kernel does; part of the compiled kernel."""

    is_confocal: bool
    is_diffuse: bool  # every hidden BSDF is Lambertian: reflectance and a cosine are all there is
    needs_visibility: bool  # something may lie between wall and patches


@dataclass(frozen=True, eq=False)
class DevicePatches:
    """Patches on the device, engine units."""

    corners: list[mi.Point3f]  # three, one lane per patch
    interaction: mi.SurfaceInteraction3f  # at the centres
    area: mi.Float
    lift: mi.Vector3f  # from the plane of the corners to the surface
    reflectance: mi.Spectrum  # of Lambertian patches
    count: mi.UInt32  # opaque


@dataclass(frozen=True, eq=False)
class Illumination:
    """What the lasers make of the patches: index = laser * n_patches + patch; empty for confocal captures."""

    arriving: mi.Spectrum  # energy per area perpendicular to the ray [1 / (engine unit)^2 per J], shadows included
    delays: list[mi.Float]  # three: from the laser point to each corner [bins]


def upload_patches(built: BuiltScene, patches: Patches) -> DevicePatches:
    """Bring patches to the device and evaluate their reflectance and shading frames."""
    centre, normal = _points(patches.centres), mi.Vector3f(_points(patches.normals))
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(patches))
    hit.t = dr.full(mi.Float, 1.0, len(patches))
    hit.prim_uv = mi.Point2f(patches.barycentric.T.astype(np.float32))
    hit.prim_index = mi.UInt32(patches.primitives)
    shape = dr.gather(mi.ShapePtr, built.scene.shapes_dr(), mi.UInt32(patches.shapes))
    # as if a ray had come from one unit above the patch: no ray is traced, the hit is known
    interaction = shape.compute_surface_interaction(mi.Ray3f(centre + normal, -normal), hit, mi.RayFlags.All)
    interaction.initialize_sh_frame()
    interaction.shape = shape
    interaction.p = centre
    interaction.n = mi.Normal3f(normal)
    up = mi.Vector3f(0, 0, 1)
    interaction.wi = mi.Vector3f(up)
    reflectance = interaction.bsdf().eval(mi.BSDFContext(), interaction, up) * dr.pi
    corners = [_points(patches.corners[:, k]) for k in range(3)]
    area = mi.Float(patches.areas.astype(np.float32))
    lift = mi.Vector3f(_points(patches.normals * patches.lifts[:, None]))
    dr.eval(interaction, reflectance, corners, area, lift)
    return DevicePatches(corners, interaction, area, lift, reflectance, dr.opaque(mi.UInt32, len(patches)))


def illuminate(transport: Transport, patches: DevicePatches, n_lasers: int) -> Illumination:
    """Light every patch by every laser: emission, distance, and the share of the patch that is not in shadow."""
    built = transport.built
    n_patches = dr.width(patches.area)
    index = dr.arange(mi.UInt32, n_patches * n_lasers)
    patch, laser = index % n_patches, index // n_patches
    points = transport.lasers.gather(laser)
    lit = points.interaction
    corners = [dr.gather(mi.Point3f, corner, patch) for corner in patches.corners]
    centre = dr.gather(mi.Point3f, patches.interaction.p, patch)
    to_patch = centre - lit.p
    distance2 = dr.squared_norm(to_patch)
    direction = to_patch * dr.rsqrt(distance2)
    arriving = built.wall_bsdf.eval(mi.BSDFContext(), lit, lit.to_local(direction)) / distance2
    shading = dr.gather(mi.Normal3f, patches.interaction.sh_frame.n, patch)
    two_sided = mi.has_flag(
        dr.gather(mi.SurfaceInteraction3f, patches.interaction, patch).bsdf().flags(), mi.BSDFFlags.BackSide
    )
    active = dr.any(arriving > 0) & ((dr.dot(shading, direction) < 0) | two_sided)
    lift = dr.gather(mi.Vector3f, patches.lift, patch)
    seen = mi.Float(0)
    steps = recurrence_steps(2)
    for k in range(LASER_RAYS):
        u, v = _fraction(index * 7 + k, steps[0]), _fraction(index * 7 + k, steps[1])
        seen += dr.select(_is_visible(built, lit, _inside(corners, u, v) + lift, active), 1.0 / LASER_RAYS, 0)
    arriving = dr.select(active, arriving * seen, 0)
    delays = [dr.norm(corner - lit.p) * transport.bins_per_unit for corner in corners]
    dr.eval(arriving, delays)
    return Illumination(arriving, delays)


@dr.syntax
def gather_third_bounce(
    settings: GatherSettings,
    transport: Transport,
    patches: DevicePatches,
    illumination: Illumination,
    histogram: DeviceHistogram,
    first: mi.UInt32,
    stride: mi.UInt32,
    jitter: mi.UInt32,
) -> None:
    """Deposit the third bounce: lane by lane over the patches ``first``, ``first + stride``, ...

    Parameters
    ----------
    first, stride
        Per lane: several lanes may share the patches of one sensor point, each into rows of its own.
    jitter
        Per lane: start of the sequence that places the visibility ray within each patch. A ray to a random point
        makes a partly hidden patch count by its visible share, on average.
    """
    built, sensors = transport.built, transport.sensors
    sensor, wall_bsdf = sensors.interaction, built.wall_bsdf
    context = mi.BSDFContext()
    lane = dr.arange(mi.UInt32, dr.width(sensors.delay_bins))
    steps = recurrence_steps(2)
    n_lasers, count = transport.n_lasers, patches.count
    own_laser = transport.lasers.gather(transport.first_laser)

    # ---- State ---------------------------------------------------------------------------------------------------
    patch = mi.UInt32(first)
    seq_u, seq_v = mi.UInt32(jitter), mi.UInt32(jitter * 0x9E3779B1)

    while dr.hint(
        patch < count,
        exclude=[settings, transport, patches, illumination, histogram, built, sensors, sensor, wall_bsdf, own_laser],
    ):
        # ---- The patch as the sensor point sees it -----------------------------------------------------------------
        si = dr.gather(mi.SurfaceInteraction3f, patches.interaction, patch)
        a, b, c = (dr.gather(mi.Point3f, patches.corners[k], patch) for k in range(3))
        to_patch = si.p - sensor.p
        distance2 = dr.squared_norm(to_patch)
        direction = to_patch * dr.rsqrt(distance2)
        received = wall_bsdf.eval(context, sensor, sensor.to_local(direction))
        area = dr.gather(mi.Float, patches.area, patch)
        weight = received * (dr.abs(dr.dot(si.n, direction)) * area / distance2)
        active = dr.any(weight > 0)
        if dr.hint(settings.is_diffuse, mode="scalar"):
            active &= dr.dot(si.sh_frame.n, direction) < 0
            weight *= dr.gather(mi.Spectrum, patches.reflectance, patch) * dr.inv_pi

        # ---- Visibility --------------------------------------------------------------------------------------------
        if dr.hint(settings.needs_visibility, mode="scalar"):
            seq_u += steps[0]
            seq_v += steps[1]
            point = _inside([a, b, c], mi.Float(seq_u >> 8) * 2.0**-24, mi.Float(seq_v >> 8) * 2.0**-24)
            point += dr.gather(mi.Vector3f, patches.lift, patch)
            active = _is_visible(built, sensor, point, active)

        # ---- Delays at the corners ---------------------------------------------------------------------------------
        scale = transport.bins_per_unit
        t0, t1, t2 = (dr.norm(corner - sensor.p) * scale + sensors.delay_fraction for corner in (a, b, c))
        wi = si.to_local(-direction)

        # ---- Reflect towards the lasers and deposit ----------------------------------------------------------------
        if dr.hint(settings.is_confocal, mode="scalar"):
            fraction = own_laser.delay_fraction - sensors.delay_fraction
            lit = own_laser.interaction
            value = weight * wall_bsdf.eval(context, lit, lit.to_local(direction)) / distance2
            value *= _reflected(settings, si, wi, wi, active)
            whole = own_laser.delay_bins + sensors.delay_bins
            _spread(
                histogram,
                lane,
                mi.UInt32(0),
                2 * t0 + fraction,
                2 * t1 + fraction,
                2 * t2 + fraction,
                whole,
                value,
                active,
            )
        else:
            laser = mi.UInt32(0)
            while dr.hint(
                laser < n_lasers,
                exclude=[settings, transport, illumination, histogram, sensors, si, weight, a, b, c, wi, direction],
            ):
                entry = laser * count + patch
                points = transport.lasers.gather(laser)
                to_laser = dr.normalize(points.interaction.p - si.p)
                value = weight * dr.gather(mi.Spectrum, illumination.arriving, entry)
                lit_here = active & dr.any(value > 0)
                value *= _reflected(settings, si, wi, si.to_local(to_laser), lit_here)
                d0, d1, d2 = (
                    dr.gather(mi.Float, illumination.delays[k], entry) + points.delay_fraction for k in range(3)
                )
                whole = points.delay_bins + sensors.delay_bins
                _spread(histogram, lane, laser, t0 + d0, t1 + d1, t2 + d2, whole, value, lit_here & dr.any(value > 0))
                laser += 1
        patch += stride


@dr.syntax
def _spread(
    histogram: DeviceHistogram,
    lane: mi.UInt32,
    laser: mi.UInt32,
    a: mi.Float,
    b: mi.Float,
    c: mi.Float,
    whole: mi.Int32,
    value: mi.Spectrum,
    active: mi.Bool,
) -> None:
    """Deposit ``value`` over the bins that a triangle with corner delays ``a``, ``b``, ``c`` [bins] covers."""
    t0 = dr.minimum(a, dr.minimum(b, c))
    t2 = dr.maximum(a, dr.maximum(b, c))
    t1 = dr.maximum(dr.minimum(a, b), dr.minimum(dr.maximum(a, b), c))
    base = dr.floor(t0)
    t0, t1, t2 = t0 - base, t1 - base, t2 - base
    span = dr.maximum(t2 - t0, NARROWEST)
    rising = dr.rcp(span * dr.maximum(t1 - t0, 1e-6))
    falling = dr.rcp(span * dr.maximum(t2 - t1, 1e-6))
    edge = mi.Float(0)  # left edge of the bin, counted from ``base``
    below = mi.Float(0)  # share of the area with a delay below it
    more = mi.Bool(active)
    slot = mi.UInt32(0)
    while dr.hint(more, exclude=[histogram, value, lane, laser, whole, slot]):
        edge += 1
        up = dr.square(edge - t0) * rising
        down = 1 - dr.square(dr.maximum(t2 - edge, 0)) * falling
        share = dr.select(edge >= t2, 1, dr.select(edge < t1, up, down))
        histogram.deposit(lane, laser, slot, mi.Int32(base + edge) - 1 + whole, value * (share - below), more)
        below = share
        more = edge < t2


def _reflected(
    settings: GatherSettings, si: mi.SurfaceInteraction3f, wi: mi.Vector3f, wo: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """Return BSDF times the cosine towards the laser; of Lambertian patches the cosine alone."""
    if settings.is_diffuse:
        return mi.Spectrum(dr.maximum(wo.z, 0))
    si = mi.SurfaceInteraction3f(si)
    si.wi = wi
    return si.bsdf().eval(mi.BSDFContext(), si, wo, active)


def _is_visible(built: BuiltScene, wall_point: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool) -> mi.Bool:
    """Return whether nothing lies between a point of the wall and a point of a patch."""
    origin = wall_point.p + wall_point.n * RAY_OFFSET
    direction = target - origin
    # stops short of the patch by 1e-4 of the way: a thin sheet 4 mm in front still hides it
    ray = mi.Ray3f(origin, direction, mi.Float(1 - 1e-4), mi.Float(0), [])
    return active & ~built.scene.ray_test(ray, coherent=False, active=active)


def _inside(corners: list[mi.Point3f], u: mi.Float, v: mi.Float) -> mi.Point3f:
    root = dr.sqrt(u)
    a, b, c = corners
    return a + (b - a) * (root * (1 - v)) + (c - a) * (root * v)


def _fraction(index: mi.UInt32, step: int) -> mi.Float:
    return mi.Float((index * mi.UInt32(step)) >> 8) * 2.0**-24


def _points(values: Float64) -> mi.Point3f:
    return mi.Point3f(np.ascontiguousarray(values.T, dtype=np.float32))


def own_rows(points: WallPoints, sensors: int, slices: int) -> tuple[WallPoints, mi.UInt32]:
    """Repeat the sensor points once per slice of the patches; return them and each lane's slice."""
    lane = dr.arange(mi.UInt32, sensors * slices)
    return points.gather(lane % sensors), lane // sensors
