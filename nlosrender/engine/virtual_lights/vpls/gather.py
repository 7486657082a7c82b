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
from nlosrender.engine.launch.launch_params import Transport
from nlosrender.engine.launch.passes import PassSize
from nlosrender.engine.launch.pilot_points import Pilot, spread
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.path.laser_connections import off_the_surface
from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
from nlosrender.engine.virtual_lights.gather.device_patches import to_points
from nlosrender.engine.virtual_lights.gather.lighting import is_visible
from nlosrender.engine.virtual_lights.visibility.masks import Clearances, Outlook, Surface
from nlosrender.engine.virtual_lights.vpls.sampler import Sites, SiteSampler
from nlosrender.engine.virtual_lights.vpls.subpaths import Impulses, TriedLasers, WalkPlan, arriving, walk_back

SITES_PER_ROUND = 4096  # of all replicas together
IMPULSES_PER_SITE = 8
CONFOCAL_IMPULSES_PER_SITE = 2
TRIED_PER_AXIS = 2  # laser points by which the vertices of walks are judged
MOST_VALUES = 2**24  # impulses of a round times lasers, for memory
WALKS_PER_SITE = (16, 64)  # walks are cheap beside the gather when many sensor points share them
FIRST_PAIRS = 2**26  # of impulses with sensor and laser points in the first kernel, whose speed is not known
MOST_ROUNDS = 2**20  # of a target that is out of reach
# Of the target error: what the third bounce may take, and the squares of the third bounce and of the rest together.
SHARES_OF_THIRD, SQUARES = (0.65, 0.5, 0.35), 0.9


@dataclass(frozen=True, eq=False)
class SiteTable:
    """What the gather reads of the sites that anything leaves, one lane per site."""

    packed: mi.Float  # eight a site: position, first impulse; normal times area, end of the impulses
    offset: mi.Vector3f  # ray offset along the normal
    shading: mi.Normal3f
    clearance: mi.UInt64  # see ``Clearances.of``
    first: mi.UInt32  # per replica: its sites are first[r] to first[r + 1]


class FurtherBounces:
    """Bounces above the third of a scene of Lambertian surfaces before a planar wall.

    Parameters
    ----------
    paths
        Engine whose scene, points and histogram shapes are used.
    tessellator
        Holds the cells the sites lie on.
    clearances
        Tell what may lie between wall and hidden surfaces; None: nothing may.
    """

    def __init__(self, paths: PathEngine, tessellator: Tessellator, clearances: Clearances | None):
        self.paths, self.clearances = paths, clearances
        self.built, self.options = paths.built, paths.options
        built, capture, time_axis = paths.built, paths.capture, paths.time_axis
        self.tessellator = tessellator
        tried = spread(capture.laser_grid, TRIED_PER_AXIS)
        points = laser_points(built, capture, time_axis, np.array(tried.indices, dtype=np.uint32))
        self.tried = TriedLasers(points, tried.size, tried.size == capture.n_lasers)
        pairs = capture.n_sensors * (capture.n_lasers if capture.scan_type == "exhaustive" else 1)
        fewest, most = WALKS_PER_SITE
        self.is_confocal = capture.scan_type == "confocal"
        # every impulse of a confocal capture takes a ray of its own to the laser
        self.impulses_per_site = CONFOCAL_IMPULSES_PER_SITE if self.is_confocal else IMPULSES_PER_SITE
        lasers = capture.n_lasers if capture.scan_type == "exhaustive" else 1
        self.sites_per_round = min(SITES_PER_ROUND, max(64, MOST_VALUES // (self.impulses_per_site * lasers)))
        self.walks = int(min(max(pairs / 32, fewest), most))

    @cached_property
    def sampler(self) -> SiteSampler:
        """What draws the sites; made when it is needed, for it holds all cells."""
        return SiteSampler(self.tessellator, self.paths.horizon)

    def plan(self, replicas: int) -> WalkPlan:
        """Return the numbers of a round of ``replicas`` independent sets of sites."""
        sites = max(self.sites_per_round // replicas, 16)
        max_bounces = self.options.bounces.max_bounces
        confocal, horizon = self.is_confocal, self.paths.horizon
        return WalkPlan(replicas, sites, self.walks, self.impulses_per_site, max_bounces, confocal, horizon)

    @property
    def impulses_per_round(self) -> int:
        """Impulses that every sensor point receives per round, at most."""
        return self.sites_per_round * self.impulses_per_site

    def share_of_third(self, patches: int, noise: float) -> float:
        """Return the one of ``SHARES_OF_THIRD`` with which patches and walks together take the fewest rays.

        Parameters
        ----------
        patches
            That the largest share takes: their number goes with the error to the power of -4/3 where shadows decide.
        noise
            Error of one round over the target error.
        """
        rays_per_round = self.sites_per_round * (1 + self.impulses_per_site * self.is_confocal)

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
        told: Callable[[int], None] = lambda done: None,
        skipped: int = 0,
    ) -> None:
        """Add round ``number`` to ``histogram``; a round is the same for every batch of a capture.

        Parameters
        ----------
        batch, histogram, number
            What is rendered, where to; which round.
        told
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
        sites = Sites.joined([self.sampler.sample(plan.sites, generator) for _ in range(plan.replicas)])
        transport = self.paths.transport(batch, shape)
        impulses = walk_back(plan, transport, sites, self.tried, int(state[1]))
        if not impulses.count:
            return
        outlook = Outlook.of(self.built, self.paths.capture, batch)
        table = self._table(plan, sites, impulses, outlook)
        lowest = mi.UInt32(THIRD_BOUNCE + 1)
        slots = dr.minimum(impulses.bounces - lowest, shape.slots - 1) if self.options.bounces.split else lowest * 0
        slots = dr.full(mi.UInt32, 0, impulses.count) + slots
        dr.eval(slots)
        needs_visibility = self.clearances is not None
        longest = int(np.diff(np.array(table.first)).max())
        pairs_per_step = shape.lanes * self.impulses_per_site * (shape.lasers + self.is_confocal)
        size, done = PassSize(max(1, FIRST_PAIRS // pairs_per_step)), skipped
        while done < longest:
            steps = min(size.steps, longest - done)
            cut = tuple(dr.opaque(mi.UInt32, count) for count in (done, steps))
            size.begin()
            _gather_impulses(
                transport, needs_visibility, self.is_confocal, outlook, table, cut, impulses, slots, shape, histogram
            )
            dr.eval(histogram.sums)
            dr.sync_thread()
            size.end()
            done += steps
            if done < longest:
                told(done)

    def _table(self, plan: WalkPlan, sites: Sites, impulses: Impulses, outlook: Outlook) -> SiteTable:
        used, starts = np.unique(impulses.sites, return_index=True)
        ends = np.append(starts[1:], impulses.count)
        first = np.searchsorted(used, np.arange(plan.replicas + 1) * plan.sites)
        as_float = np.stack([starts, ends]).astype(np.uint32).view(np.float32)
        rows = np.zeros((len(used), 8), np.float32)
        rows[:, 0:3], rows[:, 3] = sites.positions[used], as_float[0]
        rows[:, 4:7], rows[:, 7] = sites.normals[used] * sites.areas[used, None], as_float[1]
        shading = mi.Normal3f(to_points(sites.normals[used]))
        positions = sites.positions[used]
        offset = off_the_surface(self.built, positions, sites.normals[used], sites.shapes[used]) - positions
        clearance = mi.UInt64(0)
        if self.clearances is not None:
            surface = Surface(to_points(sites.positions[used]), mi.Vector3f(shading), mi.Vector3f(shading))
            where, active = dr.zeros(mi.UInt32, len(used)), dr.full(mi.Bool, True, len(used))
            clearance = self.clearances.of(surface, outlook, where, active)
        packed, first_site = on_device(mi.Float, rows.ravel()), on_device(mi.UInt32, first)
        return SiteTable(packed, mi.Vector3f(to_points(offset)), shading, clearance, first_site)


@dr.syntax
def _gather_impulses(
    transport: Transport,
    needs_visibility: bool,
    is_confocal: bool,
    outlook: Outlook,
    table: SiteTable,
    cut: tuple[mi.UInt32, mi.UInt32],
    impulses: Impulses,
    slots: mi.UInt32,
    shape: HistogramShape,
    histogram: DeviceHistogram,
) -> None:
    """Deposit what leaves the sites: lane by lane over the sites of its replica, site by site over the impulses.

    Of the sites of a replica so many are skipped, and so many are gathered at most, as ``cut`` says (opaque).
    """
    built, sensors = transport.built, transport.sensors
    sensor, wall_bsdf, context = sensors.interaction, built.wall_bsdf, mi.BSDFContext()
    lane = dr.arange(mi.UInt32, shape.lanes)
    replica = lane // shape.sensors
    n_lasers = transport.n_lasers
    count = dr.opaque(mi.UInt32, impulses.count)
    scale = transport.bins_per_unit
    own_laser = transport.lasers.gather(transport.first_laser)
    site = dr.gather(mi.UInt32, table.first, replica) + cut[0]
    end = dr.minimum(dr.gather(mi.UInt32, table.first, replica + 1), site + cut[1])
    tile = outlook.tile_bit(mi.UInt32(0), sensor.p)

    while dr.hint(
        site < end,
        exclude=[transport, table, impulses, histogram, built, sensors, sensor, wall_bsdf, end, own_laser, tile],
    ):
        # ---- The site as the sensor point sees it ------------------------------------------------------------------
        at = dr.gather(mi.Vector4f, table.packed, site * 2)
        by = dr.gather(mi.Vector4f, table.packed, site * 2 + 1)
        position, areas = mi.Point3f(at.x, at.y, at.z), mi.Vector3f(by.x, by.y, by.z)
        to_site = position - sensor.p
        distance2 = dr.squared_norm(to_site)
        distance = dr.sqrt(distance2)
        direction = to_site / distance
        weight = wall_bsdf.eval(context, sensor, sensor.to_local(direction))
        weight *= dr.maximum(-dr.dot(areas, direction), 0) / distance2
        active = dr.any(weight > 0)
        if dr.hint(needs_visibility, mode="scalar"):
            clearance = dr.gather(mi.UInt64, table.clearance, site)
            offset = dr.gather(mi.Vector3f, table.offset, site)
            active = is_visible(built, sensor, to_site, offset, active, clearance, tile)

        # ---- Deposit its impulses ------------------------------------------------------------------------------------
        delay = distance * scale + sensors.delay_fraction
        impulse = dr.reinterpret_array(mi.UInt32, at.w)
        last = dr.select(active, dr.reinterpret_array(mi.UInt32, by.w), 0)
        while dr.hint(
            impulse < last,
            exclude=[transport, impulses, slots, histogram, built, sensors, weight, delay, last, own_laser],
        ):
            slot = dr.gather(mi.UInt32, slots, impulse)
            if dr.hint(is_confocal, mode="scalar"):
                end_point = dr.gather(mi.Point3f, impulses.ends, impulse)
                facing = dr.gather(mi.Normal3f, impulses.shading, impulse)
                value = weight * dr.gather(mi.Spectrum, impulses.values, impulse)
                value *= arriving(built, own_laser, end_point, facing)
                lit = dr.any(value > 0)
                if dr.hint(needs_visibility, mode="scalar"):
                    end_offset = dr.gather(mi.Vector3f, impulses.offset, impulse)
                    lit = is_visible(built, own_laser.interaction, end_point - own_laser.interaction.p, end_offset, lit)
                arrival = delay + dr.gather(mi.Float, impulses.delays, impulse) + own_laser.delay_fraction
                arrival += dr.norm(end_point - own_laser.interaction.p) * scale
                bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + own_laser.delay_bins + sensors.delay_bins
                histogram.deposit(lane, mi.UInt32(0), slot, bins, value, lit)
            else:
                laser = mi.UInt32(0)
                while dr.hint(
                    laser < n_lasers,
                    exclude=[transport, impulses, histogram, sensors, weight, delay, impulse, slot, count],
                ):
                    points = transport.lasers.gather(transport.first_laser + laser)
                    entry = laser * count + impulse
                    value = weight * dr.gather(mi.Spectrum, impulses.values, entry)
                    arrival = delay + dr.gather(mi.Float, impulses.delays, entry) + points.delay_fraction
                    bins = mi.Int32(dr.floor(dr.minimum(arrival, 1e9))) + points.delay_bins + sensors.delay_bins
                    histogram.deposit(lane, laser, slot, bins, value, dr.any(value > 0))
                    laser += 1
            impulse += 1
        site += 1


def rounds_needed(error: float, done: int, target: float) -> int:
    """Return how many rounds bring the ``error`` after ``done`` rounds to ``target``: it falls as 1 / sqrt(rounds)."""
    return min(max(1, math.ceil(done * (error / target) ** 2)), MOST_ROUNDS) if math.isfinite(error) else MOST_ROUNDS
