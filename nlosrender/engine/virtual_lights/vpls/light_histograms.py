"""Histograms of the light that leaves VPLs, and their gather: every sensor point adds them, each after its own delay.

Single contributions leave white noise in every bin, and a sensor point pays for each. A histogram costs it as much as a
few dozen and holds thousands: the subpaths of ``GROUP`` neighbouring VPLs, each connected to all of them and weighted
by the balance heuristic (Veach 1997). docs/virtual-lights.md, 7.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.ray_offsets import offset_origin
from nlosrender.engine.launch.time_steps import divided
from nlosrender.engine.virtual_lights.gather.device_patches import normal_reflectance, surface_at
from nlosrender.engine.virtual_lights.visibility.masks import WallTiles
from nlosrender.engine.virtual_lights.vpls.gather import VplTable, connect_to_vpl
from nlosrender.engine.virtual_lights.vpls.sampler import Vpls
from nlosrender.engine.virtual_lights.vpls.step_sums import BLOCK, BLOCK_BITS, PARTS, PARTS_BITS, StepSums
from nlosrender.engine.virtual_lights.vpls.subpaths import FirstHit, VplContributions
from nlosrender.scene.build import BuiltScene

GROUP = 64  # VPLs that share their subpaths: bits of a mask. Room 10.6 / 7.5 / 5.8 / 4.7 % at 1 / 4 / 16 / 64


@dataclass(frozen=True, eq=False)
class VplReceivers:
    """What the light that VPLs receive depends on, one lane each."""

    position: mi.Point3f  # moved off the surface, see ``offset_origin``
    normal: mi.Normal3f  # geometric
    shading: mi.Normal3f
    reflectance: mi.Spectrum

    @classmethod
    def of(cls, built: BuiltScene, vpls: Vpls) -> VplReceivers:
        """Return those of Lambertian ``vpls``."""
        si = surface_at(built, vpls)
        shading = mi.Normal3f(si.sh_frame.n)
        position = mi.Point3f(offset_origin(built, si, mi.Vector3f(shading)))
        result = cls(position, si.n, shading, normal_reflectance(si))
        dr.eval(result)
        return result

    def density(self, first: FirstHit) -> tuple[mi.Float, mi.Float]:
        """Return pi times the density per area with which subpaths meet first hits in sight, and the distance."""
        away = first.position - self.position
        distance2 = dr.squared_norm(away)
        faces = (dr.dot(self.normal, away) > 0) & (dr.dot(first.shading, away) < 0)
        cosines = dr.maximum(dr.dot(self.shading, away), 0) * dr.abs(dr.dot(first.normal, away))
        return dr.select(faces, cosines / dr.square(distance2), 0), dr.sqrt(distance2)


@dataclass(frozen=True, eq=False)
class SharedContributions:
    """Contributions that all VPLs of a group receive; those of one group lie together."""

    contributions: VplContributions
    densities: mi.Float  # (count,) summed over the VPLs that see the first hit
    seen_by: mi.UInt64  # (count,) bit per VPL of the group
    bounds: mi.UInt32  # where the contributions of each VPL begin, and the last ones end

    @classmethod
    def of(
        cls, built: BuiltScene, receivers: VplReceivers, contributions: VplContributions, needs_visibility: bool
    ) -> SharedContributions:
        """Connect first hits to all VPLs of the group whose subpath met them."""
        own, count = on_device(mi.UInt32, contributions.vpls), dr.width(receivers.position)
        firsts = cast(FirstHit, contributions.firsts)  # those of shared subpaths are kept
        densities, seen_by = _connect_group(built, receivers, own, firsts, needs_visibility)
        bounds = on_device(mi.UInt32, np.searchsorted(contributions.vpls, np.arange(count + 1)))
        dr.eval(densities, seen_by)
        return cls(contributions, densities, seen_by, bounds)


@dr.syntax
def _connect_group(
    built: BuiltScene, receivers: VplReceivers, own: mi.UInt32, firsts: FirstHit, needs_visibility: bool
) -> tuple[mi.Float, mi.UInt64]:
    group = own // GROUP * GROUP
    vpl, end, total, seen_by = mi.UInt32(group), group + GROUP, mi.Float(0), mi.UInt64(0)
    while dr.hint(vpl < end, exclude=[built, receivers, own, firsts, group, end]):
        receiver = dr.gather(VplReceivers, receivers, vpl)
        density = receiver.density(firsts)[0]
        sees = density > 0
        if dr.hint(needs_visibility, mode="scalar"):
            asked = sees & (vpl != own)
            # from the first hit on: a point of a planar wall may begin a ray, and hides itself at its end
            ray = mi.Ray3f(firsts.position, receiver.position - firsts.position, mi.Float(1), mi.Float(0), [])
            sees &= ~(asked & built.scene.ray_test(ray, coherent=False, active=asked))
        total += dr.select(sees, density, 0)
        seen_by |= dr.select(sees, mi.UInt64(1) << mi.UInt64(vpl - group), 0)
        vpl += 1
    return total, seen_by


@dr.syntax
def deposit_shared(
    receivers: VplReceivers,
    number: mi.UInt32,
    shared: SharedContributions,
    bins_per_unit: mi.Float,
    parts_per_bin: mi.Float,
    lowest: mi.UInt32,
    histogram: DeviceHistogram,
) -> None:
    """Deposit what VPLs receive of their group, by parts of steps from the laser point on: a lane per VPL.

    ``number``: of the VPL in the round. ``lowest``: bounce of the histogram's first slot.
    """
    shape, contributions = histogram.shape, shared.contributions
    lane, group = dr.arange(mi.UInt32, shape.lanes), number // GROUP * GROUP
    bit = mi.UInt64(number - group)
    contribution, end = dr.gather(mi.UInt32, shared.bounds, group), dr.gather(mi.UInt32, shared.bounds, group + GROUP)
    while dr.hint(
        contribution < end,
        exclude=[
            receivers,
            shared,
            contributions,
            bins_per_unit,
            parts_per_bin,
            lowest,
            histogram,
            shape,
            lane,
            bit,
            end,
        ],
    ):
        density, distance = receivers.density(dr.gather(FirstHit, contributions.firsts, contribution))
        share = density / dr.gather(mi.Float, shared.densities, contribution)
        value = receivers.reflectance * dr.gather(mi.Spectrum, contributions.values, contribution) * share
        delay = dr.gather(mi.Float, contributions.delays, contribution) + distance * bins_per_unit
        bins = mi.Int32(dr.floor(dr.minimum(delay, 1e8) * parts_per_bin))
        slot = dr.minimum(dr.gather(mi.UInt32, contributions.bounces, contribution) - lowest, shape.slots - 1)
        sees = ((dr.gather(mi.UInt64, shared.seen_by, contribution) >> bit) & 1) == 1
        histogram.deposit(lane, mi.UInt32(0), slot, bins, value, sees)
        contribution += 1


@dataclass(frozen=True, eq=False)
class LightHistograms:
    """Light that leaves VPLs over time, once for every part of a step that a delay may begin with."""

    bins: mi.Float  # (VPL, row, part, step): light that falls into each step after a delay of so many parts
    later: mi.Float  # (VPL, row, part of a step): light from there on, behind the histogram included
    spans: mi.UInt32  # (VPL, row, 2): the first step that holds light, and the one behind the last
    n_bins: int

    @classmethod
    def of(cls, histogram: DeviceHistogram) -> LightHistograms:
        """Return those of VPLs, a lane each."""
        shape = histogram.shape
        row, rows, n_bins = shape.row, shape.rows_per_lane, shape.n_bins // PARTS
        lines = shape.lanes * rows
        line, part = divided(dr.arange(mi.UInt32, lines * row), row)
        vpl, row_of_vpl = divided(line, rows)
        light = mi.Float(dr.gather(mi.Float64, histogram.sums, vpl * shape.entries_per_lane + row_of_vpl * row + part))
        is_lit = (light > 0) & (part < n_bins * PARTS)
        first = dr.select(is_lit, part // PARTS, n_bins)
        # light of the last part of a step falls into the next one where the delay begins with a part
        end = dr.select(is_lit, (part + PARTS - 1) // PARTS + 1, 0)
        dr.eval(light, first, end)
        later = dr.block_prefix_reduce(dr.ReduceOp.Add, light, row, exclusive=False, reverse=True)
        first, end = dr.block_reduce(dr.ReduceOp.Min, first, row), dr.block_reduce(dr.ReduceOp.Max, end, row)
        rest, entry = divided(dr.arange(mi.UInt32, lines * PARTS * n_bins), n_bins)
        line, part = divided(rest, PARTS)
        bins = mi.Float(0)
        for k in range(PARTS):
            place = mi.Int32(entry * PARTS + k) - mi.Int32(part)
            bins += dr.gather(mi.Float, light, line * row + mi.UInt32(place), place >= 0)
        spans = dr.ravel(mi.Vector2u(first, dr.minimum(end, n_bins)))
        dr.eval(bins, spans, later)
        return cls(bins, later, spans, n_bins)


@dr.syntax
def gather_histograms(
    params: LaunchParams,
    needs_visibility: bool,
    wall_tiles: WallTiles,
    table: VplTable,
    first_vpl: mi.UInt32,
    size: int,
    cut: range,
    light: LightHistograms,
    step_sums: StepSums,
) -> None:
    """Add the histograms of a chunk of VPLs to ``step_sums``: a lane loops over the VPLs of its replica.

    Parameters
    ----------
    params, needs_visibility, wall_tiles, table
        As for ``gather_contributions``.
    first_vpl, size
        Of each lane, the first VPL of the chunk, numbered in the round; VPLs of the chunk, of each replica.
    cut
        Those of them that are added.
    light
        Their histograms, replica by replica.
    step_sums
        Of the lanes.
    """
    sensors, shape, sums, outside = params.sensors, step_sums.shape, step_sums.sums, step_sums.outside
    lane, chunk = dr.arange(mi.UInt32, shape.lanes), dr.opaque(mi.UInt32, size)
    skipped, count = dr.opaque(mi.UInt32, cut.start), dr.opaque(mi.UInt32, len(cut))
    n_bins, n_parts = dr.opaque(mi.UInt32, light.n_bins), dr.opaque(mi.Int32, light.n_bins * PARTS)
    blocks, stop = dr.opaque(mi.Int32, step_sums.blocks), dr.opaque(mi.Int32, shape.n_bins * PARTS)
    own_laser = params.lasers.gather(params.first_laser)
    legs, fraction = own_laser.delay_bins + sensors.delay_bins, own_laser.delay_fraction + sensors.delay_fraction
    bins_per_step = dr.opaque(mi.Int32, step_sums.bins_per_step)
    whole = dr.select(legs >= 0, legs * PARTS, legs * PARTS - (bins_per_step - 1)) // bins_per_step  # rounded down
    fraction += mi.Float(legs * PARTS - whole * bins_per_step) / PARTS
    parts_per_bin = PARTS / mi.Float(bins_per_step)
    tile = wall_tiles.tile_bit(mi.UInt32(0), sensors.interaction.p)
    vpl, entry = first_vpl + skipped, lane // dr.opaque(mi.UInt32, shape.sensors) * chunk + skipped
    end = entry + count

    while dr.hint(
        entry < end,
        exclude=[
            params,
            table,
            light,
            shape,
            sums,
            outside,
            end,
            whole,
            fraction,
            parts_per_bin,
            tile,
            lane,
            blocks,
            stop,
            n_bins,
            n_parts,
        ],
    ):
        connection = connect_to_vpl(params, needs_visibility, table, vpl, tile)
        active = connection.active
        parts = dr.floor(dr.minimum(connection.distance * params.bins_per_unit + fraction, 1e8) * parts_per_bin + 0.5)
        delay = mi.Int32(parts) + whole
        moved_by, part = delay >> PARTS_BITS, mi.UInt32(delay & (PARTS - 1))
        for row in range(shape.rows_per_lane):
            weight = connection.weight[row % shape.channels]
            source, target = entry * shape.rows_per_lane + row, lane * shape.rows_per_lane + row

            # ---- Outside the window ---------------------------------------------------------------------------------
            start = source * mi.UInt32(n_parts + 1)
            since = [dr.clip(parts, 0, n_parts) for parts in (-delay, stop - delay)]
            in_window, behind = (dr.gather(mi.Float, light.later, start + mi.UInt32(k), active) for k in since)
            lost = weight * (dr.gather(mi.Float, light.later, start, active) - in_window + behind)
            dr.scatter_add(outside, lost, target, active & (lost > 0), dr.ReduceMode.NoConflicts)

            # ---- Bins that hold light -------------------------------------------------------------------------------
            start = (source * PARTS + part) * n_bins
            span = dr.gather(mi.Vector2u, light.spans, source, active)
            block = dr.maximum((mi.Int32(span.x) + moved_by) >> BLOCK_BITS, 0)
            last = dr.minimum((mi.Int32(span.y) + moved_by + (BLOCK - 1)) >> BLOCK_BITS, blocks)
            last = dr.select(active, last, 0)
            while dr.hint(block < last, exclude=[light, sums, weight, start, moved_by, target, blocks, last, n_bins]):
                first = mi.UInt32(block * BLOCK - moved_by)  # wraps around below 0
                added = [
                    weight * dr.gather(mi.Float, light.bins, start + first + k, first + k < n_bins)
                    for k in range(BLOCK)
                ]
                place = target * mi.UInt32(blocks) + mi.UInt32(block)
                dr.scatter_add(sums, mi.ArrayXf(added), place, True, dr.ReduceMode.NoConflicts)
                block += 1
        entry += 1
        vpl += 1
