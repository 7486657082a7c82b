"""The gather of VPLs: every sensor point connects to every VPL of its replica and deposits its contributions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.flat_mirrors import FlatMirrors, image_in, turned_in
from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.ray_offsets import WALL_OFFSET, off_the_surface
from nlosrender.engine.launch.second_bounce import on_one_plane
from nlosrender.engine.virtual_lights.gather.device_patches import surface_at, to_points
from nlosrender.engine.virtual_lights.gather.lighting import irradiance, reflected_light
from nlosrender.engine.virtual_lights.visibility.masks import Surface, VisibilityMasks, WallTiles
from nlosrender.engine.virtual_lights.visibility.shadow_rays import is_visible, mirrored_share
from nlosrender.scene.build import BuiltScene, SceneWithoutWall

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.vpls.sampler import Vpls
    from nlosrender.engine.virtual_lights.vpls.subpaths import VplContributions

NO_SLOT = 0xFFFFFFFF  # of contributions to bounces that are not rendered


@dataclass(frozen=True, eq=False)
class VplTable:
    """What the gather reads of the VPLs that have contributions, one lane per VPL."""

    packed: mi.Float  # eight a VPL: position, first contribution; normal times area, end of its contributions
    offset: mi.Vector3f  # ray offset along the normal
    shading: mi.Normal3f
    mask: mi.UInt64  # see ``VisibilityMasks.of``
    first: mi.UInt32  # per replica: its VPLs are first[r] to first[r + 1]
    interaction: mi.SurfaceInteraction3f | None  # None: all are Lambertian

    @classmethod
    def of(
        cls,
        built: BuiltScene,
        vpls: Vpls,
        first_vpls: NDArray[np.int64],
        contributions: VplContributions,
        masks: VisibilityMasks | None,
        wall_tiles: WallTiles,
    ) -> VplTable:
        """Return the VPLs that any contribution leaves; all, where they share subpaths.

        Parameters
        ----------
        built
            The scene.
        vpls, first_vpls
            All VPLs of a round, and (replicas + 1,) where those of each replica begin, and the last ones end.
        contributions
            Sorted by VPL.
        masks, wall_tiles
            What may lie between wall and hidden surfaces; None: nothing may.
        """
        used = np.unique(contributions.vpls) if contributions.firsts is None else np.arange(len(vpls))
        starts, ends = (np.searchsorted(contributions.vpls, used, side=side) for side in ("left", "right"))
        first = np.searchsorted(used, first_vpls)
        as_float = np.stack([starts, ends]).astype(np.uint32).view(np.float32)
        rows = np.zeros((len(used), 8), np.float32)
        rows[:, 0:3], rows[:, 3] = vpls.positions[used], as_float[0]
        rows[:, 4:7], rows[:, 7] = vpls.normals[used] * vpls.areas[used, None], as_float[1]
        shading = mi.Normal3f(to_points(vpls.normals[used]))
        positions = vpls.positions[used]
        offset = off_the_surface(built, positions, vpls.normals[used], vpls.shapes[used]) - positions
        if built.wall.is_planar:  # VPLs on it
            offset[:, 2] = np.where(positions[:, 2] == 0, WALL_OFFSET, offset[:, 2])
        mask = mi.UInt64(0)
        if masks is not None:
            surface = Surface(to_points(vpls.positions[used]), mi.Vector3f(shading), mi.Vector3f(shading))
            where, active = dr.zeros(mi.UInt32, len(used)), dr.full(mi.Bool, True, len(used))
            mask = masks.of(surface, wall_tiles, where, active)
        packed, first_vpl = on_device(mi.Float, rows.ravel()), on_device(mi.UInt32, first)
        interaction = None if contributions.directions is None else surface_at(built, vpls.select(used))
        return cls(packed, mi.Vector3f(to_points(offset)), shading, mask, first_vpl, interaction)


@dataclass(frozen=True, eq=False)
class VplConnection:
    """The connection of each sensor point to a VPL."""

    weight: mi.Spectrum  # radiance that the sensor point sends on per radiance of the VPL
    direction: mi.Vector3f
    distance: mi.Float
    active: mi.Bool
    first: mi.UInt32  # contribution of the VPL
    end: mi.UInt32  # of its contributions; 0 where not active


def connect_to_vpl(
    params: LaunchParams,
    needs_visibility: bool,
    table: VplTable,
    vpl: mi.UInt32,
    tile: mi.UInt64,
    mirror: FlatMirrors | None = None,
) -> VplConnection:
    """Connect sensor points to VPLs, by way of ``mirror``."""
    built, sensor = params.built, params.sensors.interaction
    at = dr.gather(mi.Vector4f, table.packed, vpl * 2)
    by = dr.gather(mi.Vector4f, table.packed, vpl * 2 + 1)
    position, areas = mi.Point3f(at.x, at.y, at.z), mi.Vector3f(by.x, by.y, by.z)
    to_vpl = image_in(mirror, position) - sensor.p
    distance2 = dr.squared_norm(to_vpl)
    distance = dr.sqrt(distance2)
    direction = to_vpl / distance
    weight = built.bsdf_at(sensor).eval(mi.BSDFContext(), sensor, sensor.to_local(direction))
    facing = -dr.dot(turned_in(mirror, areas), direction)
    if table.interaction is not None:
        facing = dr.abs(facing)
    if isinstance(built, SceneWithoutWall):
        facing = dr.select(on_one_plane(built, sensor, dr.normalize(areas), to_vpl), 0, facing)
    weight *= dr.maximum(facing, 0) / distance2
    active = dr.any(weight > 0)
    if mirror is not None:
        offset = dr.gather(mi.Vector3f, table.offset, vpl)
        weight *= mirrored_share(built, mirror, sensor, position, offset, active)
        active = dr.any(weight > 0)
    elif needs_visibility:
        mask = dr.gather(mi.UInt64, table.mask, vpl)
        if table.interaction is not None:
            mask = dr.select(dr.dot(areas, direction) < 0, mask, 0)
        offset = dr.gather(mi.Vector3f, table.offset, vpl)
        active = is_visible(built, sensor, to_vpl, offset, active, mask, tile)
    first, end = dr.reinterpret_array(mi.UInt32, at.w), dr.reinterpret_array(mi.UInt32, by.w)
    return VplConnection(weight, direction, distance, active, first, dr.select(active, end, 0))


@dr.syntax
def gather_contributions(
    params: LaunchParams,
    needs_visibility: bool,
    is_confocal: bool,
    wall_tiles: WallTiles,
    table: VplTable,
    cut: tuple[mi.UInt32, mi.UInt32],
    contributions: VplContributions,
    slots: mi.UInt32,
    shape: HistogramShape,
    histogram: DeviceHistogram,
    mirror: FlatMirrors | None = None,
) -> None:
    """Deposit the contributions of VPLs: a lane loops over the VPLs of its replica and, for each, its contributions.

    ``cut`` (opaque): how many VPLs of a replica are skipped, and how many are gathered at most. ``mirror``: VPLs are
    gathered by way of it instead. Contributions of ``NO_SLOT`` are left out.
    """
    built, sensors = params.built, params.sensors
    sensor, context = sensors.interaction, mi.BSDFContext()
    lane = dr.arange(mi.UInt32, shape.lanes)
    replica = lane // shape.sensors
    n_lasers = params.n_lasers
    count = dr.opaque(mi.UInt32, contributions.count)
    scale = params.bins_per_unit
    own_laser = params.lasers.gather(params.first_laser)
    vpl = dr.gather(mi.UInt32, table.first, replica) + cut[0]
    end = dr.minimum(dr.gather(mi.UInt32, table.first, replica + 1), vpl + cut[1])
    tile = wall_tiles.tile_bit(mi.UInt32(0), sensor.p)

    while dr.hint(
        vpl < end,
        exclude=[
            params,
            table,
            contributions,
            histogram,
            built,
            sensors,
            sensor,
            end,
            own_laser,
            tile,
            mirror,
        ],
    ):
        # ---- Connect to the VPL -------------------------------------------------------------------------------------
        connection = connect_to_vpl(params, needs_visibility, table, vpl, tile, mirror)
        weight, direction = connection.weight, connection.direction

        # ---- Deposit its contributions ------------------------------------------------------------------------------
        delay = connection.distance * scale + sensors.delay_fraction
        si = sensor  # read for glossy VPLs alone
        if dr.hint(table.interaction is not None, mode="scalar"):
            si = dr.gather(mi.SurfaceInteraction3f, table.interaction, vpl)
            si.wi = si.to_local(-direction)
        contribution, last = connection.first, connection.end
        while dr.hint(
            contribution < last,
            exclude=[
                params,
                table,
                contributions,
                slots,
                histogram,
                built,
                sensors,
                weight,
                delay,
                last,
                own_laser,
                si,
                context,
            ],
        ):
            slot = dr.gather(mi.UInt32, slots, contribution)
            reflected = mi.Spectrum(weight)
            if dr.hint(table.interaction is not None, mode="scalar"):
                reflected *= si.bsdf().eval(context, si, dr.gather(mi.Vector3f, contributions.directions, contribution))
            if dr.hint(is_confocal, mode="scalar"):
                end_point = dr.gather(mi.Point3f, contributions.ends, contribution)
                shading = dr.gather(mi.Normal3f, contributions.shading, contribution)
                value = reflected * dr.gather(mi.Spectrum, contributions.values, contribution)
                if dr.hint(contributions.interaction is None, mode="scalar"):
                    value *= irradiance(built, own_laser, end_point, shading)
                else:
                    there = dr.gather(mi.SurfaceInteraction3f, contributions.interaction, contribution)
                    value *= reflected_light(built, own_laser, there)
                is_lit = dr.any(value > 0)
                if dr.hint(needs_visibility, mode="scalar"):
                    end_offset = dr.gather(mi.Vector3f, contributions.offset, contribution)
                    to_end = end_point - own_laser.interaction.p
                    is_lit = is_visible(built, own_laser.interaction, to_end, end_offset, is_lit)
                arrival = delay + dr.gather(mi.Float, contributions.delays, contribution) + own_laser.delay_fraction
                arrival += dr.norm(end_point - own_laser.interaction.p) * scale
                bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + own_laser.delay_bins + sensors.delay_bins
                histogram.deposit(lane, mi.UInt32(0), slot, bins, value, is_lit & (slot != NO_SLOT))
            else:
                laser = mi.UInt32(0)
                while dr.hint(
                    laser < n_lasers,
                    exclude=[params, contributions, histogram, sensors, reflected, delay, contribution, slot, count],
                ):
                    points = params.lasers.gather(params.first_laser + laser)
                    entry = laser * count + contribution
                    value = reflected * dr.gather(mi.Spectrum, contributions.values, entry)
                    arrival = delay + dr.gather(mi.Float, contributions.delays, entry) + points.delay_fraction
                    bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + points.delay_bins + sensors.delay_bins
                    histogram.deposit(lane, laser, slot, bins, value, dr.any(value > 0) & (slot != NO_SLOT))
                    laser += 1
            contribution += 1
        vpl += 1
