"""Bounces 4 and up: rounds of walks from random sites, each gathered by all sensor points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.plan import Batch
from nlosrender.engine.launch.device_arrays import laser_points, on_device
from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.passes import PassSize
from nlosrender.engine.launch.pilot_points import Pilot, spread
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.path.laser_connections import off_the_surface
from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
from nlosrender.engine.virtual_lights.gather.device_patches import to_points
from nlosrender.engine.virtual_lights.gather.lighting import is_visible
from nlosrender.engine.virtual_lights.visibility.masks import Surface, VisibilityMasks, WallTiles
from nlosrender.engine.virtual_lights.vpls.sampler import Vpls, VplSampler
from nlosrender.engine.virtual_lights.vpls.subpaths import (
    ProposalLasers,
    SubpathPlan,
    VplContributions,
    arriving,
    vpl_contributions,
)

VPLS_PER_ROUND = 4096  # of all replicas together
CONTRIBUTIONS_PER_VPL = 8
CONFOCAL_CONTRIBUTIONS_PER_VPL = 2
TRIED_PER_AXIS = 2  # laser points by which the vertices of walks are judged
MOST_VALUES = 2**24  # impulses of a round times lasers, for memory
SUBPATHS_PER_VPL = (16, 64)  # walks are cheap beside the gather when many sensor points share them
FIRST_PAIRS = 2**26  # of impulses with sensor and laser points in the first kernel, whose speed is not known
MOST_ROUNDS = 2**20  # of a target that is out of reach
# Of the target error: what the third bounce may take, and the squares of the third bounce and of the rest together.
SHARES_OF_THIRD, SQUARES = (0.65, 0.5, 0.35), 0.9


@dataclass(frozen=True, eq=False)
class VplTable:
    """What the gather reads of the sites that anything leaves, one lane per site."""

    packed: mi.Float  # eight a site: position, first impulse; normal times area, end of the impulses
    offset: mi.Vector3f  # ray offset along the normal
    shading: mi.Normal3f
    mask: mi.UInt64  # see ``VisibilityMasks.of``
    first: mi.UInt32  # per replica: its sites are first[r] to first[r + 1]


class VplBounces:
    """Bounces above the third of a scene of Lambertian surfaces before a planar wall.

    Parameters
    ----------
    paths
        Engine whose scene, points and histogram shapes are used.
    tessellator
        Holds the cells the sites lie on.
    masks
        Tell what may lie between wall and hidden surfaces; None: nothing may.
    """

    def __init__(self, paths: PathEngine, tessellator: Tessellator, masks: VisibilityMasks | None):
        self.paths, self.masks = paths, masks
        self.built, self.options = paths.built, paths.options
        built, capture, time_axis = paths.built, paths.capture, paths.time_axis
        self.tessellator = tessellator
        proposal_lasers = spread(capture.laser_grid, TRIED_PER_AXIS)
        points = laser_points(built, capture, time_axis, np.array(proposal_lasers.indices, dtype=np.uint32))
        self.proposal_lasers = ProposalLasers(points, proposal_lasers.size, proposal_lasers.size == capture.n_lasers)
        pairs = capture.n_sensors * (capture.n_lasers if capture.scan_type == "exhaustive" else 1)
        fewest, most = SUBPATHS_PER_VPL
        self.is_confocal = capture.scan_type == "confocal"
        # every impulse of a confocal capture takes a ray of its own to the laser
        self.contributions_per_vpl = CONFOCAL_CONTRIBUTIONS_PER_VPL if self.is_confocal else CONTRIBUTIONS_PER_VPL
        lasers = capture.n_lasers if capture.scan_type == "exhaustive" else 1
        self.vpls_per_round = min(VPLS_PER_ROUND, max(64, MOST_VALUES // (self.contributions_per_vpl * lasers)))
        self.subpaths = int(min(max(pairs / 32, fewest), most))

    @cached_property
    def sampler(self) -> VplSampler:
        """What draws the sites; made when it is needed, for it holds all cells."""
        return VplSampler(self.tessellator, self.paths.capture_gate)

    def plan(self, replicas: int) -> SubpathPlan:
        """Return the numbers of a round of ``replicas`` independent sets of sites."""
        vpls = max(self.vpls_per_round // replicas, 16)
        max_bounces = self.options.bounces.max_bounces
        confocal, capture_gate = self.is_confocal, self.paths.capture_gate
        return SubpathPlan(
            replicas, vpls, self.subpaths, self.contributions_per_vpl, max_bounces, confocal, capture_gate
        )

    @property
    def contributions_per_round(self) -> int:
        """Impulses that every sensor point receives per round, at most."""
        return self.vpls_per_round * self.contributions_per_vpl

    def share_of_third(self, patches: int, noise: float) -> float:
        """Return the one of ``SHARES_OF_THIRD`` with which patches and walks together take the fewest rays.

        Parameters
        ----------
        patches
            That the largest share takes: their number goes with the error to the power of -4/3 where shadows decide.
        noise
            Error of one round over the target error.
        """
        rays_per_round = self.vpls_per_round * (1 + self.contributions_per_vpl * self.is_confocal)

        def rays(share: float) -> float:
            finer = patches * (SHARES_OF_THIRD[0] / share) ** (4 / 3)
            return finer * 4 / 3 + rays_per_round * max(1, math.ceil(noise**2 / (SQUARES - share**2)))

        return min(SHARES_OF_THIRD, key=rays)

    def histogram(self, batch: Batch | Pilot, replicas: int) -> DeviceHistogram:
        """Return an empty histogram of a batch: bounce slots from the fourth bounce on."""
        bounces = self.options.bounces
        slots = bounces.n_slots - bounces.slot(THIRD_BOUNCE + 1) if bounces.split else 1
        return DeviceHistogram(replace(self.paths.shape(batch, slots), replicas=replicas))

    def accumulate(
        self,
        batch: Batch | Pilot,
        histogram: DeviceHistogram,
        number: int,
        report_progress: Callable[[int], None] = lambda done: None,
        skipped: int = 0,
    ) -> None:
        """Add round ``number`` to ``histogram``; a round is the same for every batch of a capture.

        Parameters
        ----------
        batch, histogram, number
            What is rendered, where to; which round.
        report_progress
            Called between kernels with the sites that every replica is done with.
        skipped
            Sites that every replica is done with already.
        """
        shape = histogram.shape
        plan = self.plan(shape.replicas)
        if self.sampler.is_empty:
            return
        state = np.random.SeedSequence([self.options.seed, number]).generate_state(2)
        generator = np.random.default_rng(state[0])
        vpls = Vpls.joined([self.sampler.sample(plan.vpls, generator) for _ in range(plan.replicas)])
        params = self.paths.launch_params(batch, shape)
        contributions = vpl_contributions(plan, params, vpls, self.proposal_lasers, int(state[1]))
        if not contributions.count:
            return
        wall_tiles = WallTiles.of(self.built, self.paths.capture, batch)
        table = self._table(plan, vpls, contributions, wall_tiles)
        lowest = mi.UInt32(THIRD_BOUNCE + 1)
        slots = (
            dr.minimum(contributions.bounces - lowest, shape.slots - 1) if self.options.bounces.split else lowest * 0
        )
        slots = dr.full(mi.UInt32, 0, contributions.count) + slots
        dr.eval(slots)
        needs_visibility = self.masks is not None
        longest = int(np.diff(np.array(table.first)).max())
        pairs_per_step = shape.lanes * self.contributions_per_vpl * (shape.lasers + self.is_confocal)
        size, done = PassSize(max(1, FIRST_PAIRS // pairs_per_step)), skipped
        while done < longest:
            steps = min(size.steps, longest - done)
            cut = tuple(dr.opaque(mi.UInt32, count) for count in (done, steps))
            size.begin()
            _gather_contributions(
                params,
                needs_visibility,
                self.is_confocal,
                wall_tiles,
                table,
                cut,
                contributions,
                slots,
                shape,
                histogram,
            )
            dr.eval(histogram.sums)
            dr.sync_thread()
            size.end()
            done += steps
            if done < longest:
                report_progress(done)

    def _table(self, plan: SubpathPlan, vpls: Vpls, contributions: VplContributions, wall_tiles: WallTiles) -> VplTable:
        used, starts = np.unique(contributions.vpls, return_index=True)
        ends = np.append(starts[1:], contributions.count)
        first = np.searchsorted(used, np.arange(plan.replicas + 1) * plan.vpls)
        as_float = np.stack([starts, ends]).astype(np.uint32).view(np.float32)
        rows = np.zeros((len(used), 8), np.float32)
        rows[:, 0:3], rows[:, 3] = vpls.positions[used], as_float[0]
        rows[:, 4:7], rows[:, 7] = vpls.normals[used] * vpls.areas[used, None], as_float[1]
        shading = mi.Normal3f(to_points(vpls.normals[used]))
        positions = vpls.positions[used]
        offset = off_the_surface(self.built, positions, vpls.normals[used], vpls.shapes[used]) - positions
        mask = mi.UInt64(0)
        if self.masks is not None:
            surface = Surface(to_points(vpls.positions[used]), mi.Vector3f(shading), mi.Vector3f(shading))
            where, active = dr.zeros(mi.UInt32, len(used)), dr.full(mi.Bool, True, len(used))
            mask = self.masks.of(surface, wall_tiles, where, active)
        packed, first_site = on_device(mi.Float, rows.ravel()), on_device(mi.UInt32, first)
        return VplTable(packed, mi.Vector3f(to_points(offset)), shading, mask, first_site)


@dr.syntax
def _gather_contributions(
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
) -> None:
    """Deposit what leaves the sites: lane by lane over the sites of its replica, site by site over the impulses.

    Of the sites of a replica so many are skipped, and so many are gathered at most, as ``cut`` says (opaque).
    """
    built, sensors = params.built, params.sensors
    sensor, wall_bsdf, context = sensors.interaction, built.wall_bsdf, mi.BSDFContext()
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
        exclude=[params, table, contributions, histogram, built, sensors, sensor, wall_bsdf, end, own_laser, tile],
    ):
        # ---- The site as the sensor point sees it ------------------------------------------------------------------
        at = dr.gather(mi.Vector4f, table.packed, vpl * 2)
        by = dr.gather(mi.Vector4f, table.packed, vpl * 2 + 1)
        position, areas = mi.Point3f(at.x, at.y, at.z), mi.Vector3f(by.x, by.y, by.z)
        to_site = position - sensor.p
        distance2 = dr.squared_norm(to_site)
        distance = dr.sqrt(distance2)
        direction = to_site / distance
        weight = wall_bsdf.eval(context, sensor, sensor.to_local(direction))
        weight *= dr.maximum(-dr.dot(areas, direction), 0) / distance2
        active = dr.any(weight > 0)
        if dr.hint(needs_visibility, mode="scalar"):
            mask = dr.gather(mi.UInt64, table.mask, vpl)
            offset = dr.gather(mi.Vector3f, table.offset, vpl)
            active = is_visible(built, sensor, to_site, offset, active, mask, tile)

        # ---- Deposit its impulses ------------------------------------------------------------------------------------
        delay = distance * scale + sensors.delay_fraction
        contribution = dr.reinterpret_array(mi.UInt32, at.w)
        last = dr.select(active, dr.reinterpret_array(mi.UInt32, by.w), 0)
        while dr.hint(
            contribution < last,
            exclude=[params, contributions, slots, histogram, built, sensors, weight, delay, last, own_laser],
        ):
            slot = dr.gather(mi.UInt32, slots, contribution)
            if dr.hint(is_confocal, mode="scalar"):
                end_point = dr.gather(mi.Point3f, contributions.ends, contribution)
                facing = dr.gather(mi.Normal3f, contributions.shading, contribution)
                value = weight * dr.gather(mi.Spectrum, contributions.values, contribution)
                value *= arriving(built, own_laser, end_point, facing)
                lit = dr.any(value > 0)
                if dr.hint(needs_visibility, mode="scalar"):
                    end_offset = dr.gather(mi.Vector3f, contributions.offset, contribution)
                    lit = is_visible(built, own_laser.interaction, end_point - own_laser.interaction.p, end_offset, lit)
                arrival = delay + dr.gather(mi.Float, contributions.delays, contribution) + own_laser.delay_fraction
                arrival += dr.norm(end_point - own_laser.interaction.p) * scale
                bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + own_laser.delay_bins + sensors.delay_bins
                histogram.deposit(lane, mi.UInt32(0), slot, bins, value, lit)
            else:
                laser = mi.UInt32(0)
                while dr.hint(
                    laser < n_lasers,
                    exclude=[params, contributions, histogram, sensors, weight, delay, contribution, slot, count],
                ):
                    points = params.lasers.gather(params.first_laser + laser)
                    entry = laser * count + contribution
                    value = weight * dr.gather(mi.Spectrum, contributions.values, entry)
                    arrival = delay + dr.gather(mi.Float, contributions.delays, entry) + points.delay_fraction
                    bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + points.delay_bins + sensors.delay_bins
                    histogram.deposit(lane, laser, slot, bins, value, dr.any(value > 0))
                    laser += 1
            contribution += 1
        vpl += 1


def rounds_needed(error: float, done: int, target: float) -> int:
    """Return how many rounds bring the ``error`` after ``done`` rounds to ``target``: it falls as 1 / sqrt(rounds)."""
    return min(max(1, math.ceil(done * (error / target) ** 2)), MOST_ROUNDS) if math.isfinite(error) else MOST_ROUNDS
