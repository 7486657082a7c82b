"""Rounds of VPLs for bounces 4 and up: VPLs at random points, subpaths from them, the gather by all sensor points."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.plan import Batch
from nlosrender.engine.interface import Budget
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.energy_contrasts import RoundContrasts
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.passes import Passes, PassSize, Snapshot
from nlosrender.engine.launch.pilot_points import Pilot, spread
from nlosrender.engine.launch.sensor_footprint import SensorFootprint
from nlosrender.engine.launch.time_steps import StepKernel
from nlosrender.engine.launch.wall_points import laser_points
from nlosrender.engine.virtual_lights.visibility.masks import VisibilityMasks, WallTiles
from nlosrender.engine.virtual_lights.vpls.gather import NO_SLOT, VplTable, gather_contributions
from nlosrender.engine.virtual_lights.vpls.light_histograms import (
    GROUP,
    LightHistograms,
    SharedContributions,
    VplReceivers,
    deposit_shared,
    gather_histograms,
)
from nlosrender.engine.virtual_lights.vpls.round_forecast import RoundForecast
from nlosrender.engine.virtual_lights.vpls.sampler import Vpls, VplSampler
from nlosrender.engine.virtual_lights.vpls.step_sums import PARTS, StepSums
from nlosrender.engine.virtual_lights.vpls.subpaths import (
    ProposalLasers,
    SubpathPlan,
    VplContributions,
    vpl_contributions,
)

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator


PARTS_OF_ENERGY = 8  # of the VPLs that are added at once, whose energies are compared: as ``FEW_PAIRS``


class VplBounces:
    """Bounces above the third whose last hidden vertex is not specular, by virtual point lights.

    Parameters
    ----------
    device
        The capture on the device.
    tessellator
        Holds the elements that VPLs lie on.
    masks
        Tell what may lie between wall and hidden surfaces; None: nothing may.
    is_diffuse
        Whether all surfaces are Lambertian.
    may_share
        Whether VPLs may share subpaths: one laser, and the wall is Lambertian, too.
    with_delta
        Whether subpaths go on by way of delta lobes, and exact light is added; otherwise another engine adds both.
    """

    def __init__(
        self,
        device: DeviceCapture,
        tessellator: Tessellator,
        masks: VisibilityMasks | None,
        is_diffuse: bool,
        may_share: bool = False,
        *,
        with_delta: bool = True,
    ):
        self.device, self.masks, self.with_delta = device, masks, with_delta
        self.built, self.options = device.built, device.options
        tuning = self.tuning = tessellator.tuning
        built, capture, time_axis = device.built, device.capture, device.time_axis
        self.tessellator = tessellator
        proposal_lasers = spread(capture.laser_grid, tuning.proposal_lasers_per_axis)
        points = laser_points(built, capture, time_axis, np.array(proposal_lasers.indices, dtype=np.uint32))
        self.proposal_lasers = ProposalLasers(
            points, proposal_lasers.size, proposal_lasers.size == capture.n_lasers, tuning.untried_share
        )
        self.proposal_sensors = None
        if not is_diffuse:
            some = spread(capture.sensor_grid, tuning.proposal_sensors_per_axis).indices
            self.proposal_sensors = (
                capture.sensor_grid.positions.reshape(-1, 3)[list(some)] / built.metres_per_engine_unit
            )
        lasers = 1 if capture.scan_type == "confocal" else capture.n_lasers
        pairs = capture.n_sensors * lasers
        self.is_confocal = capture.scan_type == "confocal"
        # every contribution of a confocal capture takes a shadow ray of its own to the laser
        kept = tuning.confocal_contributions_per_vpl, tuning.contributions_per_vpl
        self.contributions_per_vpl = kept[0 if self.is_confocal else 1]
        self.vpls_per_round = min(
            tuning.vpls_per_round, max(64, tuning.max_contribution_values // (self.contributions_per_vpl * lasers))
        )
        most = tuning.max_subpaths if is_diffuse else tuning.max_glossy_subpaths
        self.subpaths = int(min(max(pairs / 32, tuning.min_subpaths), most))
        self.max_units = self.pilot_units = 1  # of ``vpls_per_round`` VPLs, in one round
        # of few sensor points every replica has few VPLs
        has_groups = GROUP * self.options.replicas <= tuning.sharing_vpls * tuning.max_units
        self.shares_subpaths = may_share and has_groups and self._groups_in_memory(self.options.replicas) > 0
        if self.shares_subpaths:
            self.vpls_per_round, self.max_units = tuning.sharing_vpls, tuning.max_units
            self.pilot_units = tuning.pilot_units
            self.subpaths = int(min(max(pairs / 8, tuning.min_subpaths), tuning.max_shared_subpaths))

    @cached_property
    def sampler(self) -> VplSampler:
        """Sampler of VPL positions; made when it is needed, for it holds all elements."""
        return VplSampler(self.tessellator, self.device.capture_gate, self.device.lone_mirror)

    def plan(self, replicas: int, units: int = 1) -> SubpathPlan:
        """Return the numbers of a round of ``replicas`` independent sets of VPLs."""
        vpls = max(units * self.vpls_per_round // replicas, 16)
        if self.shares_subpaths:
            vpls = math.ceil(vpls / GROUP) * GROUP
        max_bounces = self.options.bounces.max_bounces
        confocal, capture_gate = self.is_confocal, self.device.capture_gate
        return SubpathPlan(
            replicas,
            vpls,
            self.subpaths,
            None if self.shares_subpaths else self.contributions_per_vpl,
            max_bounces,
            confocal,
            self.with_delta,
            self.proposal_sensors,
            capture_gate,
        )

    @property
    def forecast(self) -> RoundForecast:
        """How many rounds a target takes."""
        rays_per_vpl = 1 + self.contributions_per_vpl * self.is_confocal
        units = self.max_units, self.pilot_units
        return RoundForecast(self.tuning, self.vpls_per_round, *units, self.shares_subpaths, rays_per_vpl)

    @property
    def contributions_per_round(self) -> int:
        """Contributions that every sensor point receives per round, at most."""
        return self.vpls_per_round * (self.subpaths if self.shares_subpaths else self.contributions_per_vpl)

    def pilot_replicas(self, sensors: int) -> int:
        """Return the replicas of a pilot of so many sensor points; groups that share must be as in the render."""
        return self.options.replicas if self.shares_subpaths else max(2, self.tuning.pilot_lanes // sensors // 2 * 2)

    def histogram(self, batch: Batch | Pilot, replicas: int) -> DeviceHistogram:
        """Return an empty histogram of a batch: bounce slots from the fourth bounce on."""
        return DeviceHistogram(replace(self.device.shape(batch, self._n_slots), replicas=replicas))

    @property
    def _n_slots(self) -> int:
        bounces = self.options.bounces
        return bounces.n_slots - bounces.slot(THIRD_BOUNCE + 1) if bounces.split else 1

    def render(self, batch: Batch, budget: Budget, passes: Passes, known_squares: float = 0.0) -> Histogram:
        """Render bounces 2 and 4 and up of a batch; see ``SupplementaryEngine.render``."""
        if budget.rounds is None and budget.target_error is not None:
            known_squares += self.device.exact_squares(batch)
        histogram = self.histogram(batch, self.options.replicas)
        if not self.shares_subpaths:
            histogram.kernel = StepKernel(budget.bins_per_step or 1)
        places = self.device.capture.sensor_grid.places[self.device.sensor_indices(batch)]
        contrasts = RoundContrasts(histogram, places)
        done, skipped, units, before = 0, 0, 1, 0.0
        if (earlier := passes.resumed("sums")) is not None:
            histogram.sums = on_device(mi.Float64, earlier.arrays["sums"])
            contrasts.restore(earlier.arrays["contrasts"], earlier.arrays["grouped"], earlier.numbers["groups"])
            done, skipped, units, before = (earlier.numbers[name] for name in ("done", "skipped", "units", "seconds"))
        begun, share = time.perf_counter() - before, 0.0

        def report_progress(skipped: int) -> None:
            numbers = {"done": done, "skipped": skipped, "units": units, "seconds": time.perf_counter() - begun}
            numbers["groups"] = contrasts.groups
            saved = {"contrasts": contrasts.sums, "grouped": contrasts.grouped}
            passes.between(share, lambda: Snapshot({"sums": histogram.sums.numpy()} | saved, numbers))

        while True:
            if not skipped:
                units = self._units(budget, done, time.perf_counter() - begun)
            steps = budget.bins_per_step or 1
            self.accumulate(batch, histogram, done, report_progress, skipped, units, steps, contrasts.add_part)
            done, skipped = done + units, 0
            if budget.rounds is not None:
                share = done / budget.rounds
            else:
                share = (time.perf_counter() - begun) / max(budget.time_limit_s or 0.0, 1e-9)
                if budget.target_error is not None:
                    goal = self.tuning.rest_share_of_many * budget.target_error
                    error = histogram.relative_error(done, known_squares) / goal
                    share = max(share, 1 / max(error, 1e-9) ** 2)
            if not self.shares_subpaths:
                contrasts.add(done, share >= 1)
            if share >= 1:
                break
            report_progress(0)
        return self._result(batch, histogram, contrasts, done, budget.steps_variance or 0.0)

    def _units(self, budget: Budget, done: int, seconds: float) -> int:
        """Return the units of the next round: all that are left, as many as before, or fewer if time is short."""
        left = done if budget.rounds is None else budget.rounds - done
        if budget.rounds is None and budget.time_limit_s is not None:
            left = int(done * min(budget.time_limit_s / max(seconds, 1e-9) - 1, 1))
        return min(max(left, 1), self.max_units)

    def _result(
        self, batch: Batch, histogram: DeviceHistogram, contrasts: RoundContrasts, done: int, steps_variance: float
    ) -> Histogram:
        bounces, scale = self.options.bounces, self.device.scale
        first = bounces.slot(THIRD_BOUNCE + 1)
        slots = range(-first, bounces.n_slots - first)
        statistics = histogram.statistics(done, scale, slots)
        errors = contrasts.result(scale / (done * self.options.replicas), slots)
        mean, variance = histogram.on_host(statistics[0]), histogram.on_host(statistics[1] * (1 + steps_variance))
        result = Histogram.of_rows(mean, variance, done * self.contributions_per_round, errors)
        if self.with_delta:
            self.device.add_exact_light(batch, result)
        return result

    def accumulate(
        self,
        batch: Batch | Pilot,
        histogram: DeviceHistogram,
        number: int,
        report_progress: Callable[[int], None] = lambda done: None,
        skipped: int = 0,
        units: int = 1,
        bins_per_step: int = 1,
        add_part: Callable[[NDArray[np.float64]], None] = lambda energies: None,
    ) -> None:
        """Add a round to ``histogram``, the same for every batch of a capture, ``units`` times what it estimates.

        Parameters
        ----------
        batch, histogram, number
            What is rendered, where to; units of the rounds before.
        report_progress
            Called between kernels with the number of VPLs that every replica is done with.
        skipped
            VPLs that every replica is done with already.
        units
            Size of the round: VPLs of one round are stratified, and the error falls faster than with their number.
        bins_per_step
            Of the time steps in which light that VPLs share is added.
        add_part
            Called with the energies of independent parts of it; see ``RoundContrasts.add_part``.
        """
        shape = histogram.shape
        plan = self.plan(shape.replicas, units)
        if self.sampler.is_empty:
            return
        state = np.random.SeedSequence([self.options.seed, number]).generate_state(2)
        generator = np.random.default_rng(state[0])
        vpls = Vpls.joined([self.sampler.sample(plan.vpls, generator) for _ in range(plan.replicas)])
        params = self._placed(self.device.launch_params(batch, shape), shape, number)
        mirror = self.device.lone_mirror
        contributions = vpl_contributions(plan, params, vpls, self.proposal_lasers, int(state[1]), mirror)
        if not contributions.count:
            return
        vpls = replace(vpls, areas=vpls.areas * units)
        wall_tiles = WallTiles.of(self.built, self.device.capture, batch)
        first_vpls = np.arange(plan.replicas + 1) * plan.vpls
        table = VplTable.of(self.built, vpls, first_vpls, contributions, self.masks, wall_tiles)
        if self.shares_subpaths:
            views = params, self.masks is not None, wall_tiles, table
            reports = report_progress, add_part
            self._add_shared(views, vpls, contributions, plan, histogram, reports, skipped, bins_per_step)
            return
        # straight, and by way of the mirror one bounce later
        by_mirrors = [None] if mirror is None else [None, mirror]
        ways = [(self._slots(contributions.bounces + more, shape), by) for more, by in enumerate(by_mirrors)]
        needs_visibility = self.masks is not None
        longest = int(np.diff(np.array(table.first)).max())
        pairs_per_step = shape.lanes * self.contributions_per_vpl * (shape.lasers + self.is_confocal)
        size, done = PassSize(max(1, self.options.schedule.first_vpl_pairs // pairs_per_step)), skipped
        while done < longest:
            steps = min(size.steps, longest - done)
            cut = tuple(dr.opaque(mi.UInt32, count) for count in (done, steps))
            size.begin()
            scene = params, needs_visibility, self.is_confocal, wall_tiles
            for slots, by in ways:
                gather_contributions(*scene, table, cut, contributions, slots, shape, histogram, by)
            dr.eval(histogram.sums)
            dr.sync_thread()
            size.end()
            done += steps
            if done < longest:
                report_progress(done)

    def _placed(self, params: LaunchParams, shape: HistogramShape, number: int) -> LaunchParams:
        """Return these with the sensor points at places in their footprints, another one per round and replica."""
        if not isinstance(params.footprint, SensorFootprint):
            return params
        places = params.footprint.places(number * shape.replicas + np.arange(shape.replicas))
        replica = dr.arange(mi.UInt32, shape.lanes) // shape.sensors
        x, y = (dr.gather(mi.Float, on_device(mi.Float, column), replica) for column in places.T)
        return params.at_place(mi.Point2f(x, y))

    def _add_shared(
        self,
        scene: tuple[LaunchParams, bool, WallTiles, VplTable],
        vpls: Vpls,
        contributions: VplContributions,
        plan: SubpathPlan,
        histogram: DeviceHistogram,
        reports: tuple[Callable[[int], None], Callable[[NDArray[np.float64]], None]],
        skipped: int,
        bins_per_step: int,
    ) -> None:
        """Add VPLs that share subpaths, in chunks that are the same for every batch (docs/virtual-lights.md, 7.7)."""
        (params, needs_visibility, *_), shape = scene, histogram.shape
        report_progress, add_part = reports
        receivers = VplReceivers.of(self.built, vpls)
        shared = SharedContributions.of(self.built, receivers, contributions, needs_visibility)
        lowest = dr.opaque(mi.UInt32, THIRD_BOUNCE + 1)
        chunk = GROUP * min(
            self.tuning.groups_at_once * bins_per_step, self._groups_in_memory(plan.replicas, bins_per_step)
        )
        parts_per_bin = dr.opaque(mi.Float, PARTS / bins_per_step)
        for begin in range(skipped, plan.vpls, chunk):
            size = min(chunk, plan.vpls - begin)
            numbers = np.arange(plan.replicas)[:, None] * plan.vpls + begin + np.arange(size)
            index = on_device(mi.UInt32, numbers.ravel())
            chosen = dr.gather(VplReceivers, receivers, index)
            dr.eval(chosen)
            sums = DeviceHistogram(
                HistogramShape(
                    1, numbers.size, 1, shape.slots, shape.channels, self._steps_of_vpls(bins_per_step) * PARTS
                )
            )
            deposit_shared(chosen, index, shared, params.bins_per_unit, parts_per_bin, lowest, sums)
            dr.eval(sums.sums)
            light = LightHistograms.of(sums)
            first = on_device(mi.UInt32, np.repeat(numbers[:, 0], shape.sensors))
            step_sums = StepSums(shape, bins_per_step)
            part = GROUP * math.ceil(size / (GROUP * PARTS_OF_ENERGY))
            before = np.zeros(1)
            for begun in range(0, size, part):
                gather_histograms(*scene, first, size, range(begun, min(begun + part, size)), light, step_sums)
                energies = step_sums.energies()
                add_part(energies - before)
                before = energies
            step_sums.add_to(histogram)
            if begin + size < plan.vpls:
                report_progress(begin + size)

    def _steps_of_vpls(self, bins_per_step: int) -> int:
        """Time steps of a VPL's histogram: later light falls behind the window, whatever the sensor point.

        Rounded up by an eighth at most: another start of the window need not be another kernel.
        """
        capture, time_axis = self.device.capture, self.device.time_axis
        legs = capture.sensor_legs.min() + capture.laser_legs.min() - capture.blur
        bins = time_axis.n_bins + math.ceil((time_axis.start_opl - legs) / time_axis.bin_width_opl)
        steps = max(bins, 0) // bins_per_step + 2
        unit = 2 ** max(steps.bit_length() - 4, 0)
        return -(-steps // unit) * unit

    def _groups_in_memory(self, replicas: int, bins_per_step: int = 1) -> int:
        """Return how many groups of VPLs of every replica have histograms that memory holds."""
        values = GROUP * replicas * self._steps_of_vpls(bins_per_step) * PARTS * self._n_slots * self.options.channels
        return self.tuning.max_histogram_values // values

    def _slots(self, bounces: mi.UInt32, shape: HistogramShape) -> mi.UInt32:
        """Return the slots of contributions; ``NO_SLOT`` for bounces that are not rendered here."""
        lowest, highest = mi.UInt32(THIRD_BOUNCE + 1), self.options.bounces.max_bounces
        slots = dr.minimum(bounces - lowest, shape.slots - 1) if self.options.bounces.split else bounces * 0
        is_rendered = bounces >= lowest
        if highest is not None:
            is_rendered &= bounces <= highest
        slots = dr.select(is_rendered, slots, NO_SLOT)
        dr.eval(slots)
        return slots
