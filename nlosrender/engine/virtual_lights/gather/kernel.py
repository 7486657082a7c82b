"""The gather of the third bounce: every sensor point adds the light of every patch to the bins it covers.

One lane per sensor point loops over all patches, so that a lane owns its rows of the histogram. The lanes of a packet
are neighbouring sensor points whose shadow rays go to one point of the same patch: packets of rays stay together. The
loop is cut into passes, kernels of about half a second; a lane adds its patches one after the other, so the cuts change
no bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.flat_mirrors import FlatMirrors, image_in, turned_in
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.passes import Passes, PassSize, Snapshot
from nlosrender.engine.launch.second_bounce import on_one_plane
from nlosrender.engine.launch.wall_points import WallPoints
from nlosrender.engine.virtual_lights.gather.delay_distribution import Delays, PatchDelays, deposit_patch
from nlosrender.engine.virtual_lights.gather.lighting import ROWS, GatherSettings, PackedPatches
from nlosrender.engine.virtual_lights.gather.sensor_lattice import SensorLattice
from nlosrender.engine.virtual_lights.visibility.shadow_rays import is_visible, mirrored_share
from nlosrender.scene.build import SceneWithoutWall

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram


class GatherPasses:
    """Gathers groups of patches, the same ones in the same order every time, into a histogram.

    Parameters
    ----------
    settings, histogram
        What is gathered, and where to.
    passes
        Reported to between two kernels; may hold a saved state to go on from.
    first_pairs
        Of patches with sensor and laser points in the first kernel.
    """

    def __init__(self, settings: GatherSettings, histogram: BlockHistogram, passes: Passes, first_pairs: int):
        self._settings, self._histogram, self._passes = settings, histogram, passes
        self._group = self._first_group = self._skipped = 0
        if (earlier := passes.resumed("sums")) is not None:
            histogram.sums, histogram.outside = (
                on_device(mi.Float64, earlier.arrays[name]) for name in ("sums", "outside")
            )
            self._first_group, self._skipped = earlier.numbers["group"], earlier.numbers["skipped"]
        self._size = PassSize(max(1, first_pairs // (histogram.shape.lanes * histogram.shape.lasers)))

    def gather(
        self,
        params: LaunchParams,
        packed: PackedPatches,
        lane: mi.UInt32,
        slice_index: mi.UInt32,
        tile: mi.UInt64,
        mirror: FlatMirrors | None,
        lattice: SensorLattice | None = None,
    ) -> None:
        """Gather the next group; parameters as for ``gather_third_bounce``."""
        group, self._group = self._group, self._group + 1
        if group < self._first_group:
            return
        longest = int(np.diff(np.array(packed.first)).max())
        done = self._skipped if group == self._first_group else 0
        while done < longest:
            steps = min(self._size.steps, longest - done)
            if lattice is not None:
                steps = min(steps, lattice.most_steps)
            self._size.begin()
            cut = [dr.opaque(mi.UInt32, number) for number in (done, steps)]
            seen = None if lattice is None else lattice.visibility(self._settings, params.built, packed, *cut)
            gather_third_bounce(
                self._settings, params, packed, self._histogram, lane, slice_index, tile, *cut, mirror, lattice, seen
            )
            dr.eval(self._histogram.sums, self._histogram.outside)
            dr.sync_thread()
            self._size.end()
            done += steps
            share = 1 - 0.5**group * (1 - done / longest)  # how many groups there are is not known
            self._passes.between(share, partial(self._state, group, done))

    def _state(self, group: int, done: int) -> Snapshot:
        histogram = self._histogram
        arrays = {"sums": histogram.sums.numpy(), "outside": histogram.outside.numpy()}
        return Snapshot(arrays, {"group": group, "skipped": done})


@dr.syntax
def gather_third_bounce(
    settings: GatherSettings,
    params: LaunchParams,
    packed: PackedPatches,
    histogram: BlockHistogram,
    lane: mi.UInt32,
    slice_index: mi.UInt32,
    tile: mi.UInt64,
    skipped: mi.UInt32,
    most: mi.UInt32,
    mirror: FlatMirrors | None,
    lattice: SensorLattice | None = None,
    seen: mi.UInt32 | None = None,
) -> None:
    """Deposit the third bounce: lane by lane over ``most`` patches of its slice, after the first ``skipped`` ones.

    Several lanes may share the patches of one sensor point: each gathers a slice, into rows of its own.

    Parameters
    ----------
    settings, params, packed
        What is gathered, and by whom.
    histogram, lane
        Where to, and the row of each lane of ``params``.
    slice_index
        The slice of ``packed`` that each lane gathers.
    tile
        The bit of the tile that its sensor point lies in, see ``WallTiles``.
    skipped, most
        Opaque.
    mirror
        By way of which the sensor points see the patches of Lambertian surfaces; None: straight.
    lattice, seen
        That visibility is interpolated on, and what ``SensorLattice.visibility`` returns; None: each point sends rays.
    """
    n_lasers, own_laser = params.n_lasers, params.lasers.gather(params.first_laser)
    end = dr.gather(mi.UInt32, packed.first, slice_index + 1)

    # ---- State ------------------------------------------------------------------------------------------------------
    patch = dr.gather(mi.UInt32, packed.first, slice_index) + skipped
    end = dr.select(n_lasers > 0, dr.minimum(end, patch + most), patch)  # by reciprocity a lane may have no laser
    entry, stride = (0, 0) if lattice is None else (lattice.of_lane, lattice.stride)
    entry = mi.UInt32(entry)  # of the lattice's visibility: patch by patch

    while dr.hint(
        patch < end,
        exclude=[end, settings, params, packed, histogram, lane, own_laser, tile, mirror, lattice, seen, stride],
    ):
        share = None if lattice is None else lattice.share(seen, entry)
        if dr.hint(
            share is None or share > 0,
            exclude=[settings, params, packed, histogram, lane, own_laser, tile, mirror, patch],
        ):
            _gather_patch(settings, params, packed, histogram, lane, own_laser, tile, mirror, patch, share)
        entry += stride
        patch += 1


@dr.syntax
def _gather_patch(
    settings: GatherSettings,
    params: LaunchParams,
    packed: PackedPatches,
    histogram: BlockHistogram,
    lane: mi.UInt32,
    own_laser: WallPoints,
    tile: mi.UInt64,
    mirror: FlatMirrors | None,
    patch: mi.UInt32,
    share: mi.Float | None,
) -> None:
    """Deposit what one patch sends each lane's sensor point; ``share`` of it is seen, None: a shadow ray tells."""
    built, sensors = params.built, params.sensors
    sensor, sensor_bsdf = sensors.interaction, built.bsdf_at(sensors.interaction)
    context = mi.BSDFContext()
    n_lasers, count = params.n_lasers, packed.count

    # ---- The patch as the sensor point sees it ----------------------------------------------------------------------
    rows = [dr.gather(mi.Vector4f, packed.packed, patch * ROWS + k) for k in range(ROWS)]
    a, b, c, centre, shown, offset = (mi.Point3f(row.x, row.y, row.z) for row in rows)
    areas = mi.Vector3f(rows[0].w, rows[1].w, rows[2].w)
    point = centre + shown
    a, b, c, centre = (image_in(mirror, corner) for corner in (a, b, c, centre))
    areas = turned_in(mirror, areas)
    from_sensor = centre - sensor.p
    to_patch = from_sensor
    if dr.hint(packed.rounding_residual is not None, mode="scalar"):
        to_patch = from_sensor + turned_in(mirror, _rounding_residual(packed, patch))
    distance2 = dr.squared_norm(to_patch)
    direction = to_patch * dr.rsqrt(distance2)
    received = sensor_bsdf.eval(context, sensor, sensor.to_local(direction))
    weight = received * (dr.abs(dr.dot(areas, direction)) / distance2)
    active = dr.any(weight > 0)
    if dr.hint(isinstance(built, SceneWithoutWall), mode="scalar"):
        active &= ~on_one_plane(built, sensor, dr.normalize(areas), to_patch)
    cosine = mi.Float(0)
    if dr.hint(settings.is_diffuse, mode="scalar"):
        cosine = -dr.dot(turned_in(mirror, dr.gather(mi.Normal3f, packed.shading, patch)), direction)
        if dr.hint(settings.has_two_sided, mode="scalar"):
            is_behind = (rows[4].w > 0) & (cosine < 0)
            cosine = dr.select(is_behind, -cosine, cosine)
            if dr.hint(not settings.is_confocal, mode="scalar"):
                # light on the back is negative: for sensor points on that side it is positive
                weight = dr.select(is_behind, -weight, weight)
        active &= cosine > 0

    is_cluster = None
    if dr.hint(packed.has_clusters, mode="scalar"):
        is_cluster = rows[3].w > 0

    # ---- Visibility -------------------------------------------------------------------------------------------------
    if dr.hint(mirror is not None, mode="scalar"):
        weight *= mirrored_share(built, mirror, sensor, point, mi.Vector3f(offset), active)
        active = dr.any(weight != 0)
    elif dr.hint(share is not None, mode="scalar"):
        weight *= share
    elif dr.hint(settings.needs_visibility, mode="scalar"):
        # a mask holds in front of the tangent plane at the ray's end, not of the one at the patch's centre
        to_surface = from_sensor + shown
        mask = dr.select(dr.dot(areas, to_surface) < 0, dr.gather(mi.UInt64, packed.mask, patch), 0)
        active = is_visible(built, sensor, to_surface, mi.Vector3f(offset), active, mask, tile)

    # ---- Reflect towards the lasers and deposit ---------------------------------------------------------------------
    delays = PatchDelays.from_point(sensor.p, centre, (a, b, c), params.bins_per_unit)
    seen = _SeenPatch(patch, weight, is_cluster, to_patch - from_sensor, active)
    if dr.hint(settings.is_confocal, mode="scalar"):
        # of the laser point: the laser stands elsewhere than the sensor, and may not see it
        lit = own_laser.interaction
        light = built.bsdf_at(lit).eval(context, lit, lit.to_local(direction)) / distance2
        if dr.hint(settings.is_diffuse, mode="scalar"):
            light *= dr.gather(mi.Spectrum, packed.reflectance, patch) * cosine
        delays += delays
        _deposit(settings, packed, histogram, sensors, own_laser, lane, mi.UInt32(0), light, delays, seen)
    elif dr.hint(params.lasers_per_lane == 1, mode="scalar"):
        light, legs = packed.from_laser(patch)
        delays += legs
        _deposit(settings, packed, histogram, sensors, own_laser, lane, mi.UInt32(0), light, delays, seen)
    else:
        laser = mi.UInt32(0)
        while dr.hint(
            laser < n_lasers, exclude=[settings, params, packed, histogram, sensors, delays, patch, count, seen]
        ):
            points = params.lasers.gather(laser)
            light, legs = packed.from_laser(laser * count + patch)
            _deposit(settings, packed, histogram, sensors, points, lane, laser, light, legs + delays, seen)
            laser += 1


@dataclass(frozen=True, eq=False)
class _SeenPatch:
    """A patch as the lane's sensor point sees it."""

    number: mi.UInt32
    weight: mi.Spectrum  # wall's BSDF and the geometry between; of patches that are not Lambertian without their BSDF
    is_cluster: mi.Bool | None  # None: no patch is
    residual: mi.Vector3f  # what float32 rounds off its place
    active: mi.Bool


def _deposit(
    settings: GatherSettings,
    packed: PackedPatches,
    histogram: BlockHistogram,
    sensors: WallPoints,
    laser_points: WallPoints,
    lane: mi.UInt32,
    laser: mi.UInt32,
    light: mi.Spectrum,
    delays: PatchDelays,
    seen: _SeenPatch,
) -> None:
    """Deposit what a patch sends on of the ``light`` from one laser; ``delays``: of the ways within the scene."""
    value = seen.weight * light
    lit = seen.active & dr.any(value > 0)
    distribution = None
    if not settings.is_diffuse:
        reflected, distribution = _reflected(packed, sensors.interaction.p, laser_points.interaction.p, seen, lit)
        value *= reflected
        lit &= dr.any(value > 0)
    covered = Delays.of_patch(delays, seen.is_cluster, distribution)
    covered = covered.later(laser_points.delay_fraction + sensors.delay_fraction)
    deposit_patch(histogram, lane, laser, covered, laser_points.delay_bins + sensors.delay_bins, value, lit)


def _reflected(
    packed: PackedPatches, sensor: mi.Point3f, laser: mi.Point3f, seen: _SeenPatch, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Vector3f]:
    """Return the mean over patches of their BSDF times the cosine towards the laser, and its distribution.

    The BSDF is evaluated at the middles of the three edges, whose mean is exact for quadratic functions. The linear
    function through them tells the light per area at the corners, mean 1: docs/virtual-lights.md, 2.5.
    """
    interactions, to_laser = [], []
    for middles in packed.middles:
        si = dr.gather(mi.SurfaceInteraction3f, middles, seen.number)
        middle = si.p + seen.residual
        si.wi = dr.normalize(si.to_local(sensor - middle))
        interactions.append(si)
        to_laser.append(dr.normalize(si.to_local(laser - middle)))
    values = dr.dispatch(interactions[0].bsdf(), _bsdf_values, interactions, to_laser, active)
    mean = (values[0] + values[1] + values[2]) / 3
    scale = dr.rcp(dr.maximum(dr.mean(mean), dr.smallest(mi.Float)))
    light = mi.Vector3f(*(3 - 2 * (dr.mean(value) * scale) for value in values))
    light = dr.maximum(light, 0)
    return mean, light * (3 / dr.sum(light))


def _bsdf_values(
    bsdf: mi.BSDF, interactions: list[mi.SurfaceInteraction3f], directions: list[mi.Vector3f], active: mi.Bool
) -> list[mi.Spectrum]:
    """Return the BSDF times the cosine at several points of one surface."""
    context = mi.BSDFContext()
    return [bsdf.eval(context, si, wo, active) for si, wo in zip(interactions, directions, strict=True)]


def _rounding_residual(packed: PackedPatches, patch: mi.UInt32) -> mi.Vector3f:
    """Return what float32 rounds off a patch's centre."""
    row = dr.gather(mi.Vector4f, packed.rounding_residual, patch)
    return mi.Vector3f(row.x, row.y, row.z)
