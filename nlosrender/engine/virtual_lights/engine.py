"""The virtual-light engine: third bounce gathered from patches, further bounces from walks, to the asked-for error."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import cached_property

import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.energy_contrasts import RoundContrasts, contrasts_of_deviation
from nlosrender.engine.launch.histogram import Histogram
from nlosrender.engine.launch.occlusion import nothing_occludes
from nlosrender.engine.launch.passes import Passes, Snapshot
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of
from nlosrender.engine.launch.sample_schedule import DEFAULT_TARGET, Budget
from nlosrender.engine.path.engine import PathEngine, RenderOptions
from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator, wall_sees_itself
from nlosrender.engine.virtual_lights.gather.lighting import GatherSettings
from nlosrender.engine.virtual_lights.reciprocity import is_reciprocal
from nlosrender.engine.virtual_lights.third_bounce import (
    COARSEST_SCALE,
    REFINEMENT,
    Gathered,
    ThirdBounce,
    difference_divisor,
    estimated_error,
)
from nlosrender.engine.virtual_lights.vpls.gather import (
    SHARES_OF_THIRD,
    SQUARES,
    VplBounces,
    rounds_needed,
)
from nlosrender.errors import RenderError
from nlosrender.scene.build import BuiltScene

# Shares of the target error: squares add up to less than 1, for what a pilot cannot know.
THIRD_ALONE = 0.85
THIRD_OF_MANY, REST_OF_MANY = 0.35, 0.88  # patches are cheaper than walks
PILOT_ERROR = 4.0  # times the target: when a pilot has seen enough to say how many rounds are needed
MOST_PILOT_ROUNDS = 16
PILOT_LANES = 2048
FEW_SENSORS = 8  # along each side of a pilot's grid: the error of patches has no noise
MISSED = 3.0  # times the light that is found of bounce 5: one of the four legs that may lead past the laser point is
RARE = 1e-4  # share of walks or paths: rarer light is not found by renders of common lengths, or by too few


class VirtualLightEngine:
    """Third bounce by the gather of patches, further bounces by the gather of walks.

    Parameters
    ----------
    built, capture, time_axis, options
        As for the path engine. The hidden geometry has to be meshes, spheres and cylinders, none of them a mirror, and
        no more than the wall may be.
    lanes
        Lanes that keep the backend busy.
    """

    name = "virtual_lights"

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, options: RenderOptions, lanes: int):
        self.built, self.capture, self.time_axis, self.options, self.lanes = built, capture, time_axis, options, lanes
        self.paths = PathEngine(built, capture, time_axis, options, first_bounce=THIRD_BOUNCE + 1)
        self.tessellator = Tessellator(built, capture, time_axis.bin_width_opl / built.unit)
        shapes = (*built.hidden_shapes, *([built.wall_shape] if wall_sees_itself(built) else []))
        self.settings = GatherSettings(
            is_confocal=capture.scan_type == "confocal",
            is_diffuse=all(is_lambertian(shape.bsdf()) for shape in shapes),
            needs_visibility=not nothing_occludes(built),
            has_one_laser=capture.n_lasers == 1,
        )
        all_lambertian = self.settings.is_diffuse and is_lambertian(built.wall_shape.bsdf())
        reciprocal = is_reciprocal(built, capture, time_axis.n_bins, is_lambertian=all_lambertian)
        self.third = ThirdBounce(self.paths, self.tessellator, self.settings, lanes, reciprocal)
        self.further: VplBounces | None = None  # else the path engine
        if self.has_further_bounces and self.settings.is_diffuse:
            masks = self.third.masks if self.settings.needs_visibility else None
            self.further = VplBounces(self.paths, self.tessellator, masks)
        self.reason = f"Lambertian surfaces before a {'planar' if built.wall.is_planar else 'curved'} wall"
        self._calibrated: dict[Budget, Budget] = {}

    def set_up(self) -> None:
        """Make what all resolutions and batches share, else made when it is first needed: it grows with the triangles.

        Sums over small cells, and the tree of what may hide something.
        """
        self.tessellator.set_up()
        if self.settings.needs_visibility and self.third.masks.pay_off(self.capture.n_sensors):
            self.third.masks.set_up()

    @property
    def has_further_bounces(self) -> bool:
        """Whether bounces above the third are asked for."""
        highest = self.options.bounces.max_bounces
        return highest is None or highest > THIRD_BOUNCE

    @cached_property
    def misses_light(self) -> bool:
        """Whether light of the further bounces is not found, nor known to the estimated error.

        Between a laser point and a surface almost on it, light goes to and fro in an area of about the distance
        squared. Walks begin anywhere and end there by chance.
        """
        sampler = self.paths.sampler
        if not self.has_further_bounces or self.capture.scan_type == "confocal" or sampler.is_empty:
            return False
        return math.pi * self.tessellator.nearest_to_laser**2 < RARE * sampler.area

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far; the gather's own kernels count as rendering."""
        return self.paths.compile_seconds

    def calibrate(self, budget: Budget, seconds: float = math.inf) -> Budget:
        """Turn a target error into settings for the whole capture, tried on a few of its points.

        The settings do not depend on how the capture is cut. With a time limit only the patches are settled.
        A pilot of paths ends after ``seconds``, as for ``calibrated_by_pilot``.
        """
        if budget.patch_scale is not None:
            return budget
        if budget not in self._calibrated:
            calibrated = self.calibrate_lights(budget)
            if self.has_further_bounces and self.further is None:
                squares = self.third.gather(pilot_of(self.capture), calibrated.patch_scale or COARSEST_SCALE).squares
                goal = REST_OF_MANY * (budget.target_error or DEFAULT_TARGET)
                paths = self.paths.calibrate(replace(budget, target_error=goal), squares, seconds)
                calibrated = replace(calibrated, spp=paths.spp)
            if math.isfinite(seconds):
                return calibrated
            self._calibrated[budget] = calibrated
        return self._calibrated[budget]

    def calibrate_lights(self, budget: Budget) -> Budget:
        """Return ``budget`` with the settings of patches and walks; what the path engine has to do is left open."""
        pilot = pilot_of(self.capture)
        target = budget.target_error or DEFAULT_TARGET
        share = THIRD_OF_MANY if self.has_further_bounces else THIRD_ALONE
        if budget.time_limit_s is not None:
            return replace(budget, patch_scale=self._patch_scale_in_time(budget, share * target))
        if self.further is not None:
            share = SHARES_OF_THIRD[0]
        few = self._pilot_of_patches(pilot)
        patch_scale, third = self.third.calibrate(few, share * target)
        if self.further is None:
            return replace(budget, patch_scale=patch_scale)
        goal, squares = REST_OF_MANY * target, third.squares * (pilot.sensors.size / few.sensors.size)
        squares += self.paths.second_squares(pilot)
        replicas = max(2, PILOT_LANES // pilot.sensors.size // 2 * 2)
        histogram = self.further.histogram(pilot, replicas)
        done, error = 0, math.inf
        while done < MOST_PILOT_ROUNDS and error > PILOT_ERROR * goal:
            self.further.accumulate(pilot, histogram, done)
            done += 1
            error = histogram.relative_error(done, squares)
        share = self.further.share_of_third(third.n_patches, error * math.sqrt(done) / target)
        if share < SHARES_OF_THIRD[0]:
            patch_scale, _ = self.third.calibrate(few, share * target)
        rounds = rounds_needed(error, done, math.sqrt(SQUARES - share**2) * target)
        return replace(budget, patch_scale=patch_scale, rounds=rounds)

    def _pilot_of_patches(self, pilot: Pilot) -> Pilot:
        """Return the pilot that patches are settled on: few points, unless some surface is nearer than they are apart.

        Only some of the points see such a surface close up, or what lies behind it.
        """
        nearest = self.tessellator.nearest
        if self.built.wall.is_planar and self.built.hidden_bounds is not None:  # what faces away from it, too
            nearest = self.built.hidden_bounds[0][2] / self.built.unit
        is_far = nearest > 2 * self.tessellator.reach / FEW_SENSORS
        return pilot_of(self.capture, FEW_SENSORS) if is_far else pilot

    def render(self, batch: Batch, budget: Budget, passes: Passes | None = None) -> Histogram:
        """Render one batch; as ``PathEngine.render``, whose errors it raises.

        The variance of the third bounce is the square of its estimated discretisation error.
        """
        begun, passes = time.perf_counter(), passes or Passes()
        budget = self.calibrate(budget)
        patch_scale = budget.patch_scale or COARSEST_SCALE
        shared = 0.5 if self.has_further_bounces else 1.0
        coarse, fine = self.third.pair(batch, patch_scale, passes.stage("third bounce", 0, shared))
        left = budget.time_limit_s
        if left is not None:
            left = max(0.0, left - (time.perf_counter() - begun))
        rest = passes.stage("further bounces", shared, 1)
        result = self._further_bounces(batch, replace(budget, time_limit_s=left), fine, rest)
        if self.misses_light:
            np.add(result.variance, np.square(MISSED * result.mean), out=result.variance)
            result.contrasts[:] += MISSED * result.mean.sum(axis=(2, 3, 4))
        slot, scale = self.options.bounces.slot(THIRD_BOUNCE), self.paths.scale
        third, deviation = fine.values, coarse.values  # large: worked on in place
        np.subtract(third, deviation, out=deviation)
        deviation *= scale / difference_divisor(coarse, fine)
        third *= scale
        result.mean[:, slot] += third[:, 0, ..., :-1]
        grid, sensors = self.capture.sensor_grid, self.paths.sensor_indices(batch)
        in_window = deviation[:, 0, ..., :-1]
        result.contrasts[:, :, slot] += contrasts_of_deviation(in_window, sensors, (grid.nx, grid.ny))
        result.variance[:, slot] += np.square(deviation, out=deviation)[:, 0, ..., :-1]
        result.outside[:, slot] += third[:, 0, ..., -1]
        if not np.isfinite(result.mean).all():
            raise RenderError("the gather produced a value that is not finite; please report the configuration")
        return result

    def _further_bounces(self, batch: Batch, budget: Budget, third: Gathered, passes: Passes) -> Histogram:
        if self.further is None:
            known_squares = third.squares if self.has_further_bounces else 0.0
            return self.paths.render(batch, budget, passes, known_squares=known_squares)
        known_squares = third.squares + self.paths.second_squares(batch)
        histogram = self.further.histogram(batch, self.options.replicas)
        grid = self.capture.sensor_grid
        contrasts = RoundContrasts(histogram, self.paths.sensor_indices(batch), (grid.nx, grid.ny))
        done, skipped, before = 0, 0, 0.0
        if (earlier := passes.resumed("sums")) is not None:
            histogram.sums = on_device(mi.Float64, earlier.arrays["sums"])
            contrasts.restore(earlier.arrays["contrasts"], earlier.arrays["grouped"], earlier.numbers["groups"])
            done, skipped, before = (earlier.numbers[name] for name in ("done", "skipped", "seconds"))
        begun, share = time.perf_counter() - before, 0.0

        def report_progress(skipped: int) -> None:
            numbers = {"done": done, "skipped": skipped, "seconds": time.perf_counter() - begun}
            numbers["groups"] = contrasts.groups
            saved = {"contrasts": contrasts.sums, "grouped": contrasts.grouped}
            passes.between(share, lambda: Snapshot({"sums": histogram.sums.numpy()} | saved, numbers))

        while True:
            self.further.accumulate(batch, histogram, done, report_progress, skipped)
            done, skipped = done + 1, 0
            if budget.rounds is not None:
                share = done / budget.rounds
            else:
                share = (time.perf_counter() - begun) / max(budget.time_limit_s or 0.0, 1e-9)
                if budget.target_error is not None:
                    error = histogram.relative_error(done, known_squares) / (REST_OF_MANY * budget.target_error)
                    share = max(share, 1 / max(error, 1e-9) ** 2)
            contrasts.add(done, share >= 1)
            if share >= 1:
                break
            report_progress(0)
        bounces = self.options.bounces
        first = bounces.slot(THIRD_BOUNCE + 1)
        slots = range(-first, bounces.n_slots - first)
        statistics = histogram.statistics(done, self.paths.scale, slots)
        errors = contrasts.result(self.paths.scale / (done * self.options.replicas), slots)
        mean, variance = (histogram.on_host(values) for values in statistics)
        contributions = done * self.further.contributions_per_round
        if not self.built.wall.is_planar:
            mean[:, :1] += self.paths.second_bounce(batch)
        return Histogram(mean[..., :-1], variance[..., :-1], mean[..., -1], contributions, errors)

    def _patch_scale_in_time(self, budget: Budget, target: float) -> float:
        """Return the fineness for ``target``, or the one that half of the time is predicted to suffice for."""
        pilot = pilot_of(self.capture)
        pairs = self.capture.n_sensors * (self.capture.n_lasers if self.capture.scan_type == "exhaustive" else 1)
        lasers = pilot.lasers.size if self.capture.scan_type == "exhaustive" else 1
        more = pairs / (pilot.sensors.size * lasers)
        patch_scale = COARSEST_SCALE
        coarse, second = self.third.gather(pilot, patch_scale), self.paths.second_squares(pilot)
        while True:
            finer = self.third.finer(patch_scale, REFINEMENT)
            begun = time.perf_counter()
            fine = self.third.gather(pilot, finer)
            predicted = (time.perf_counter() - begun) * more * 4
            error = estimated_error(coarse, fine, second)
            if error <= target or predicted > (budget.time_limit_s or 0.0) / 2:
                return finer if error <= target else patch_scale
            patch_scale, coarse = finer, fine


def is_lambertian(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is Mitsuba's one-sided ``diffuse``."""
    return bsdf.class_name() == "SmoothDiffuse"
