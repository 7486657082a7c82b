"""VPL subpaths: the light of bounces 4 and up that leaves a VPL towards the sensor points, as contributions in time.

Where the light of a VPL (Keller 1997) came from is found by tracing on from it, away from the sensor points, until a
vertex is connected to the lasers (Royo et al. 2022, section 4, read backwards). Every sensor point gathers every VPL,
so a subpath is cheap beside the gather of what it brings: many are traced, and few contributions are kept by systematic
resampling with probability in proportion to the light they bring, so that all carry the same (resampled importance
sampling, Talbot et al. 2005). Subpaths whose light can only arrive after the time window end by roulette.
docs/virtual-lights.md, 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.flat_mirrors import FlatMirrors, image_in, turned_in
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.launch_params import MAX_SURVIVAL, LaunchParams
from nlosrender.engine.launch.ray_offsets import connection_segment, off_the_wall, offset_origin
from nlosrender.engine.launch.time_gate import CaptureTimeGate, TimeGate, time_gate_roulette
from nlosrender.engine.launch.wall_points import WallPoints
from nlosrender.engine.virtual_lights.gather.device_patches import normal_reflectance, surface_at
from nlosrender.engine.virtual_lights.gather.lighting import irradiance, reflected_light
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.vpls.sampler import Vpls

SIDE_SEED = 0x9E3779B9  # seeds the choice of a two-sided VPL's side, which has to be independent of the direction's
MIN_SIDE_SHARE = 0.05  # probability of either side, at least: sensor points that were not tried may see it; chosen


@dataclass(frozen=True, eq=False)
class ProposalLasers:
    """Laser points whose light, visibility aside, is the proposal for choosing a vertex; the same for every batch."""

    points: WallPoints
    count: int
    are_all: bool  # whether the capture has no others; otherwise every vertex is given a chance
    untried_share: float = DEFAULT_TUNING.untried_share

    def light(
        self,
        built: BuiltScene,
        leaving: mi.Spectrum,
        point: mi.Point3f,
        shading: mi.Normal3f,
        mirror: FlatMirrors | None = None,
    ) -> mi.Float:
        """Return the light expected, by way of ``mirror``, of a point that sends on a share ``leaving`` of it."""
        lit, point, shading = mi.Float(0), image_in(mirror, point), mi.Normal3f(turned_in(mirror, shading))
        for k in range(self.count):
            laser = self.points.gather(mi.UInt32(k))
            lit += dr.mean(leaving * irradiance(built, laser, point, shading)) / self.count
        lit += self.untried(leaving, point)
        return lit

    def untried(self, leaving: mi.Spectrum, point: mi.Point3f) -> mi.Float:
        """Return the least light expected of a vertex: lasers that are no proposal lasers may light it."""
        if self.are_all:
            return mi.Float(0)
        away = dr.squared_norm(point - self.points.gather(mi.UInt32(0)).interaction.p)
        return self.untried_share * dr.mean(leaving) / away


@dataclass(eq=False)  # not frozen: the state of a loop
class FirstHit:
    """Where subpaths met their first surface; one lane per subpath."""

    position: mi.Point3f  # moved off the surface, see ``offset_origin``
    normal: mi.Normal3f  # geometric
    shading: mi.Normal3f


@dataclass(eq=False)  # not frozen: the state of a loop
class SubpathVertex:
    """One vertex of every subpath, chosen in proportion to the light it is expected to bring; one lane per subpath."""

    position: mi.Point3f
    normal: mi.Normal3f  # geometric
    shading: mi.Normal3f
    shape: mi.ShapePtr
    carried: mi.Spectrum  # throughput up to the vertex; of Lambertian surfaces its reflectance / pi included
    opl: mi.Float  # from the VPL [engine units]
    bounce: mi.UInt32  # of a connection to the laser
    expected: mi.Float  # light expected of it
    interaction: mi.SurfaceInteraction3f | None  # None: all surfaces are Lambertian
    by_mirror: mi.Bool  # the connection is by way of the mirror
    first: FirstHit | None = None  # of subpaths that VPLs share


@dataclass(frozen=True, eq=False)
class VplContributions:
    """Light that leaves VPLs at known delays; those of one VPL lie together.

    ``values`` and ``delays`` have index laser * count + contribution. Of confocal captures, whose sensor points each
    have a laser of their own, they leave out the way from the laser to the end of the subpath.
    """

    count: int
    vpls: NDArray[np.int64]  # (count,) the VPL each leaves, ascending
    bounces: mi.UInt32  # (count,)
    values: mi.Spectrum  # radiance towards the sensor points, for the VPL's area
    delays: mi.Float  # from the laser point to the VPL [bins]
    ends: mi.Point3f  # (count,) where the laser's light meets the subpath
    shading: mi.Normal3f  # (count,) shading normals there
    offset: mi.Vector3f  # (count,) ray offset there, along the geometric normal
    # Of surfaces that are not Lambertian, whose BSDF ``values`` leave out; else None. (count,)
    directions: mi.Vector3f | None = None  # to where the light comes from, in the VPL's frame
    interaction: mi.SurfaceInteraction3f | None = None  # at the ends, in confocal captures
    # (count,) of subpaths that VPLs share: ``values`` and ``delays`` end there; else None
    firsts: FirstHit | None = None


@dr.syntax
def trace_subpaths(
    built: BuiltScene,
    vpls: mi.SurfaceInteraction3f,
    direction: mi.Vector3f,
    reflectance: mi.Spectrum,
    is_diffuse: bool,
    with_delta: bool,
    proposal_lasers: ProposalLasers,
    max_bounces: int | None,
    time_gate: TimeGate | None,
    randomness: LaneRandomness,
    mirror: FlatMirrors | None,
    *,
    keeps_first: bool,
) -> tuple[SubpathVertex, mi.Float]:
    """Trace one subpath per lane from ``vpls`` until roulette, escape or ``max_bounces`` (None: no limit) ends it.

    The first ``direction`` is one of the VPL's frame. ``with_delta``: whether delta lobes are sampled.

    Returns one vertex of each, and the light expected of all of them; by way of the scene's only ``mirror``, too.
    """
    scene, wall, context = built.scene, mi.ShapePtr(built.wall_shape), mi.BSDFContext()
    if not with_delta:
        context.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Delta)
    generator = mi.PCG32(randomness.generator)
    gate_survival = 1.0 if time_gate is None else time_gate.survival

    # ---- State ------------------------------------------------------------------------------------------------------
    throughput = mi.Spectrum(reflectance)
    side = 1.0 if is_diffuse else dr.sign(direction.z)
    direction = vpls.sh_frame.to_world(direction)
    ray = mi.Ray3f(offset_origin(built, vpls, direction), direction)
    alive = dr.any(throughput > 0) & (dr.dot(direction, vpls.n) * side > 0)
    origin = mi.Point3f(vpls.p)
    opl = mi.Float(0)  # optical path length from the VPL [engine units]
    bounce = mi.UInt32(FIRST_BOUNCE + 1)  # of a connection from the last vertex
    nowhere = None if is_diffuse else dr.zeros(mi.SurfaceInteraction3f)
    none = mi.Normal3f(0), mi.Normal3f(0), wall, mi.Spectrum(0), mi.Float(0), mi.UInt32(0), mi.Float(0)
    first = FirstHit(mi.Point3f(0), mi.Normal3f(0), mi.Normal3f(0)) if keeps_first else None
    vertex = SubpathVertex(mi.Point3f(0), *none, nowhere, mi.Bool(False), first)
    total = mi.Float(0)  # light expected of all vertices so far
    if mirror is not None:  # what VPLs on a planar wall receive by way of it, patches of hidden surfaces do not tell
        vertex = dr.select((vpls.shape == wall) & built.wall.is_planar, _on_wall(vpls, reflectance), vertex)
        vertex.expected = proposal_lasers.light(built, vertex.carried, vertex.position, vertex.shading, mirror)
        total = mi.Float(vertex.expected)
    is_past_gate = mi.Bool(False)  # all light still to be found comes too late; survived that roulette

    while dr.hint(alive, exclude=[built, scene, proposal_lasers, vpls, time_gate, mirror]):
        # ---- Intersect ----------------------------------------------------------------------------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=alive)
        alive = alive & si.is_valid()
        opl += dr.norm(si.p - origin)
        bounce += 1
        if dr.hint(keeps_first, mode="scalar"):
            position = mi.Point3f(offset_origin(built, si, mi.Vector3f(si.sh_frame.n)))
            hit = FirstHit(position, si.n, mi.Normal3f(si.sh_frame.n))
            first = dr.select(bounce == FIRST_BOUNCE + 2, hit, first)

        # ---- Roulette for what comes after the time window, once a subpath ------------------------------------------
        alive, is_past_gate, throughput = time_gate_roulette(
            time_gate, generator, alive, is_past_gate, opl, si.p, si.shape == wall, throughput
        )

        # ---- Light expected of the lasers, visibility aside; a plane is dark to its own laser points ----------------
        bsdf = si.bsdf()
        hidden = mi.Bool(alive)
        if dr.hint(is_diffuse, mode="scalar"):
            hidden &= mi.Frame3f.cos_theta(si.wi) > 0
        front = mi.Bool(hidden)
        if dr.hint(built.wall.is_planar, mode="scalar"):
            hidden &= si.shape != wall
        leaving, lit = mi.Spectrum(throughput), mi.Float(0)
        if dr.hint(is_diffuse, mode="scalar"):
            upright = mi.SurfaceInteraction3f(si)
            upright.wi = mi.Vector3f(0, 0, 1)
            leaving *= bsdf.eval(context, upright, mi.Vector3f(0, 0, 1), hidden if mirror is None else front)
            lit = proposal_lasers.light(built, leaving, si.p, si.sh_frame.n)
        else:
            for k in range(proposal_lasers.count):
                laser = proposal_lasers.points.gather(mi.UInt32(k))
                lit += dr.mean(throughput * reflected_light(built, laser, si, hidden)) / proposal_lasers.count
            lit += proposal_lasers.untried(leaving, si.p)
        lit = dr.select(hidden, lit, 0)
        if dr.hint(time_gate is not None, mode="scalar"):
            lit = dr.select(is_past_gate, lit * gate_survival, lit)
        # reservoir sampling: of the vertices so far, each is chosen in proportion to its light
        total += lit
        pick = (lit > 0) & (generator.next_float32(alive) * total < lit)
        straight, shading, interaction = mi.Bool(False), mi.Normal3f(si.sh_frame.n), None if is_diffuse else si
        found = SubpathVertex(si.p, si.n, shading, si.shape, leaving, opl, bounce, lit, interaction, straight, first)
        vertex = dr.select(pick, found, vertex)
        if dr.hint(mirror is not None, mode="scalar"):
            lit = dr.select(front, proposal_lasers.light(built, leaving, si.p, si.sh_frame.n, mirror), 0)
            if dr.hint(time_gate is not None, mode="scalar"):
                lit = dr.select(is_past_gate, lit * gate_survival, lit)
            if dr.hint(max_bounces is not None, mode="scalar"):
                lit = dr.select(bounce < max_bounces, lit, 0)
            total += lit
            pick = (lit > 0) & (generator.next_float32(alive) * total < lit)
            by_mirror = SubpathVertex(si.p, si.n, shading, si.shape, leaving, opl, bounce + 1, lit, None, ~straight)
            vertex = dr.select(pick, by_mirror, vertex)

        # ---- Sample the next direction ------------------------------------------------------------------------------
        if dr.hint(max_bounces is not None, mode="scalar"):
            alive &= bounce < max_bounces
        lobe = generator.next_float32(alive)
        sample = mi.Point2f(generator.next_float32(alive), generator.next_float32(alive))
        bs, weight = bsdf.sample(context, si, lobe, sample, alive)
        survival = dr.minimum(dr.max(weight), MAX_SURVIVAL)
        alive &= generator.next_float32(alive) < survival
        throughput *= weight / dr.maximum(survival, 1e-9)
        direction = si.to_world(bs.wo)
        origin = mi.Point3f(si.p)
        ray = mi.Ray3f(offset_origin(built, si, direction), direction)

    return vertex, total


def _on_wall(vpls: mi.SurfaceInteraction3f, reflectance: mi.Spectrum) -> SubpathVertex:
    """Return VPLs as ends of subpaths of no length that are connected by mirror."""
    place = vpls.p, mi.Normal3f(vpls.n), mi.Normal3f(vpls.sh_frame.n), vpls.shape
    bounce = mi.UInt32(THIRD_BOUNCE + 1)
    return SubpathVertex(*place, reflectance * dr.inv_pi, mi.Float(0), bounce, mi.Float(0), None, mi.Bool(True))


@dataclass(frozen=True, eq=False)
class SubpathPlan:
    """How many subpaths are traced for a capture, and how many contributions are kept."""

    replicas: int  # independent sets of VPLs
    vpls: int  # per round and replica
    subpaths: int  # per VPL
    contributions: int | None  # kept per VPL, on average; None: all, and VPLs share them
    max_bounces: int | None
    is_confocal: bool
    with_delta: bool  # subpaths go on by way of delta lobes
    sensors: Float64 | None  # (k, 3) some sensor points; None: all surfaces are Lambertian
    capture_gate: CaptureTimeGate | None  # None: no light comes too late


def vpl_contributions(
    plan: SubpathPlan,
    params: LaunchParams,
    vpls: Vpls,
    proposal_lasers: ProposalLasers,
    seed: int,
    mirror: FlatMirrors | None = None,
) -> VplContributions:
    """Trace subpaths from ``vpls``, one replica after the other, and return what the batch's lasers send back."""
    built = params.built
    surface = surface_at(built, vpls)
    dr.eval(surface)
    vpl = dr.arange(mi.UInt32, len(vpls) * plan.subpaths) // plan.subpaths
    time_gate = None
    if plan.capture_gate is not None:
        time_gate = plan.capture_gate.of_points(np.repeat(vpls.positions, plan.subpaths, axis=0))
    randomness = LaneRandomness.seeded(seed, dr.arange(mi.UInt32, dr.width(vpl)))
    square = mi.Point2f(mi.Float(randomness.sequence[0] >> 8), mi.Float(randomness.sequence[1] >> 8)) * 2.0**-24
    direction, from_vpl = mi.warp.square_to_cosine_hemisphere(square), dr.gather(mi.SurfaceInteraction3f, surface, vpl)
    is_diffuse = plan.sensors is None
    if plan.contributions is None:
        reflectance = mi.Spectrum(1)
    elif plan.sensors is None:
        reflectance = normal_reflectance(surface)
        dr.eval(reflectance)
        reflectance = dr.gather(mi.Spectrum, reflectance, vpl)
    else:
        front = dr.gather(mi.Float, on_device(mi.Float, _front_shares(built, vpls, plan.sensors)), vpl)
        is_front = mi.sample_tea_float32(dr.arange(mi.UInt32, dr.width(vpl)), mi.UInt32(seed ^ SIDE_SEED)) < front
        direction.z = dr.select(is_front, direction.z, -direction.z)
        response = _response(from_vpl, direction, plan.sensors)
        reflectance = mi.Spectrum(response / dr.select(is_front, front, 1 - front))
        dr.eval(direction, response)
    ends, expected = trace_subpaths(
        built,
        from_vpl,
        direction,
        reflectance,
        is_diffuse,
        plan.with_delta,
        proposal_lasers,
        plan.max_bounces,
        time_gate,
        randomness,
        mirror,
        keeps_first=plan.contributions is None,
    )
    dr.eval(ends, expected)
    light = expected.numpy()
    if plan.contributions is None:
        subpath = np.flatnonzero(light > 0)
        scales = light[subpath] / plan.subpaths
    else:
        subpath, copies, share = _resample(light, vpls, plan, plan.contributions, np.random.default_rng(seed))
        scales = copies * share
    if not len(subpath):
        return no_contributions()
    end, scale = on_device(mi.UInt32, subpath), on_device(mi.Float, scales)
    n_lasers = 1 if plan.is_confocal else params.lasers_per_lane
    values, delays, lit = (
        _unconnected(params, ends, end, scale) if plan.is_confocal else _connect(params, ends, end, scale, mirror)
    )
    saved = dr.compress(lit)
    n_kept = dr.width(saved)
    if not n_kept:
        return no_contributions()
    index = dr.arange(mi.UInt32, n_kept * n_lasers)
    # opaque: no two rounds keep as many, and each number would be a kernel to compile
    per_laser, found = dr.opaque(mi.UInt32, n_kept), dr.opaque(mi.UInt32, len(subpath))
    entry = index // per_laser * found + dr.gather(mi.UInt32, saved, index % per_laser)
    chosen = subpath[np.asarray(saved.numpy())]
    end = on_device(mi.UInt32, chosen)
    si = _surface_of(ends, end)
    shading = dr.gather(mi.Normal3f, ends.shading, end)
    values = dr.gather(mi.Spectrum, values, entry)
    if not is_diffuse:
        # over the density of the direction; the BSDF brings its cosine
        direction = dr.gather(mi.Vector3f, direction, end)
        density = dr.gather(mi.Float, response, end) * dr.abs(direction.z) * dr.inv_pi
        values *= dr.gather(mi.Float, dr.rcp(density), index % per_laser)
    delays, firsts = dr.gather(mi.Float, delays, entry), None
    if plan.contributions is None:
        firsts = dr.gather(FirstHit, ends.first, end)
        own = dr.gather(mi.Point3f, surface.p, on_device(mi.UInt32, chosen // plan.subpaths))
        delays -= dr.norm(firsts.position - own) * params.bins_per_unit
    contributions = VplContributions(
        count=n_kept,
        vpls=chosen // plan.subpaths,
        bounces=dr.gather(mi.UInt32, ends.bounce, end),
        values=values,
        delays=delays,
        ends=si.p,
        shading=shading,
        offset=mi.Vector3f(offset_origin(built, si, shading) - si.p),
        directions=None if is_diffuse else direction,
        interaction=si if plan.is_confocal and not is_diffuse else None,
        firsts=firsts,
    )
    dr.eval(contributions)
    return contributions


def _front_shares(built: BuiltScene, vpls: Vpls, sensors: Float64) -> Float64:
    """Return the probability (n,) that a VPL sends light from its front: of two-sided ones about what sees it."""
    shares = (np.einsum("nkx,nx->nk", sensors - vpls.positions[:, None], vpls.normals) > 0).mean(axis=1)
    is_two_sided = np.array([bool(shape.bsdf().flags() & mi.BSDFFlags.BackSide) for shape in built.scene.shapes()])
    return np.where(is_two_sided[vpls.shapes], np.clip(shares, MIN_SIDE_SHARE, 1 - MIN_SIDE_SHARE), 1.0)


def _response(vpls: mi.SurfaceInteraction3f, direction: mi.Vector3f, sensors: Float64) -> mi.Float:
    """Return the part of the light from ``direction`` that VPLs send on to ``sensors``, times pi; never 0.

    Half of it is the mean over all VPLs: other sensor points may receive more.
    """
    response, context = mi.Float(0), mi.BSDFContext()
    for sensor in sensors:
        vpls.wi = vpls.to_local(dr.normalize(mi.Point3f(sensor) - vpls.p))
        response += dr.mean(vpls.bsdf().eval(context, vpls, direction))
    response *= dr.pi / (len(sensors) * dr.maximum(dr.abs(direction.z), 1e-3))
    return (response + dr.mean(response)) / 2


def no_contributions() -> VplContributions:
    """Return what comes back when no subpath finds light."""
    nothing = mi.UInt32(), mi.Spectrum(0), mi.Float(), mi.Point3f(), mi.Normal3f(), mi.Vector3f()
    return VplContributions(0, np.zeros(0, np.int64), *nothing)


def _surface_of(ends: SubpathVertex, index: mi.UInt32) -> mi.SurfaceInteraction3f:
    """Return the ends of subpaths; of Lambertian ones position, geometric normal and shape, for ray offsets."""
    if ends.interaction is not None:
        return dr.gather(mi.SurfaceInteraction3f, ends.interaction, index)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    si.p, si.n = dr.gather(mi.Point3f, ends.position, index), dr.gather(mi.Normal3f, ends.normal, index)
    si.shape = dr.gather(mi.ShapePtr, ends.shape, index)
    return si


def _resample(
    expected: NDArray[np.float32], vpls: Vpls, plan: SubpathPlan, kept: int, generator: np.random.Generator
) -> tuple[NDArray[np.int64], Float64, Float64]:
    """Choose subpaths in proportion to what they bring to the sensor points, by systematic resampling along the VPLs.

    ``kept`` per VPL. Returns subpaths (n,) ascending, how often each was chosen, and a choice's value: radiance per
    expected light.
    """
    importance = np.repeat(vpls.importance, plan.subpaths)
    weights = expected.astype(np.float64) * importance
    per_replica, count = plan.vpls * plan.subpaths, kept * plan.vpls
    subpaths, copies, shares = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
    for replica in range(plan.replicas):
        cumulative = np.cumsum(weights[replica * per_replica : (replica + 1) * per_replica])
        total = cumulative[-1]
        if not total > 0:
            continue
        position = (np.arange(count) + generator.random()) * (total / count)
        # never one without weight: the first whose cumulative weight exceeds the number
        chosen = np.minimum(np.searchsorted(cumulative, position, side="right"), np.searchsorted(cumulative, total))
        subpath, repeats = np.unique(chosen + replica * per_replica, return_counts=True)
        subpaths.append(subpath)
        copies.append(repeats.astype(np.float64))
        shares.append(total / (count * plan.subpaths * importance[subpath]))
    return np.concatenate(subpaths), np.concatenate(copies), np.concatenate(shares)


def _unconnected(
    params: LaunchParams, ends: SubpathVertex, end: mi.UInt32, scale: mi.Float
) -> tuple[mi.Spectrum, mi.Float, mi.Bool]:
    """Return what chosen ends pass on of the light that will meet them there, its delay, and which pass on any."""
    values = dr.gather(mi.Spectrum, ends.carried, end) / dr.gather(mi.Float, ends.expected, end) * scale
    delays = dr.gather(mi.Float, ends.opl, end) * params.bins_per_unit
    dr.eval(values, delays)
    return values, delays, dr.any(values > 0)


def _connect(
    params: LaunchParams, ends: SubpathVertex, end: mi.UInt32, scale: mi.Float, mirror: FlatMirrors | None
) -> tuple[mi.Spectrum, mi.Float, mi.Bool]:
    """Connect chosen ends to every laser; return values and delays (laser * n + end), and which bring any light."""
    built, n = params.built, dr.width(end)
    index = dr.arange(mi.UInt32, n * params.lasers_per_lane)
    per_laser = dr.opaque(mi.UInt32, n)
    entry = index % per_laser
    end = dr.gather(mi.UInt32, end, entry)
    lasers = params.lasers.gather(index // per_laser)
    si = _surface_of(ends, end)
    to_laser = lasers.interaction.p - si.p
    distance = dr.norm(to_laser)
    carried = dr.gather(mi.Spectrum, ends.carried, end) / dr.gather(mi.Float, ends.expected, end)
    facing = dr.gather(mi.Normal3f, ends.shading, end)
    if ends.interaction is None:
        value = carried * irradiance(built, lasers, si.p, facing)
    else:
        value = carried * reflected_light(built, lasers, si)
    value = lasers.shared(value * dr.gather(mi.Float, scale, entry))
    active = dr.any(value > 0)
    if mirror is not None:
        active &= ~dr.gather(mi.Bool, ends.by_mirror, end)
    segment = connection_segment(built, si, to_laser / distance, lasers.interaction)
    active &= ~built.scene.ray_test(segment, coherent=False, active=active)
    value = dr.select(active, value, 0)
    if mirror is not None:
        lit, number = lasers.interaction, mi.UInt32(0)
        by_mirror = dr.gather(mi.Bool, ends.by_mirror, end) & mirror.may_reflect(number, si.p, lit.p)
        found = mirror.reflected(built, number, si, lit.p, off_the_wall(built, lit), by_mirror)
        carried *= found.value * (dr.maximum(dr.dot(facing, found.direction), 0) * dr.gather(mi.Float, scale, entry))
        carried *= built.bsdf_at(lit).eval(mi.BSDFContext(), lit, lit.to_local(found.from_lit))
        value = dr.select(found.active, lasers.shared(carried), value)
        distance = dr.select(found.active, found.distance, distance)
        active = dr.any(value > 0)
    delays = (dr.gather(mi.Float, ends.opl, end) + distance) * params.bins_per_unit
    lit = dr.zeros(mi.UInt32, n)
    dr.scatter(lit, mi.UInt32(1), entry, active)  # lasers write the same 1; a reduction would have ``n`` in its kernel
    dr.eval(value, delays, lit)
    return value, delays, lit > 0
