"""The virtual-light engine: third bounce gathered from patches, further bounces from VPLs, to the error asked for."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.plan import Batch, Plan
from nlosrender.engine.interface import Budget, OmittedWork, PilotSeconds, SupplementaryEngine, TimeEstimate
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.energy_contrasts import contrasts_of_deviation
from nlosrender.engine.launch.histogram import Histogram
from nlosrender.engine.launch.occlusion import nothing_occludes
from nlosrender.engine.launch.omissions import omitted_by_time_gate, omitted_triangles, omitted_visibility
from nlosrender.engine.launch.passes import Passes
from nlosrender.engine.launch.pilot_points import pilot_of
from nlosrender.engine.launch.plain_diffuse import is_two_sided_diffuse
from nlosrender.engine.launch.schedule import DEFAULT_TARGET
from nlosrender.engine.virtual_lights.calibration import calibrated_lights
from nlosrender.engine.virtual_lights.cost import gather_batch_bytes, virtual_light_estimate
from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator, is_mirror, wall_sees_itself
from nlosrender.engine.virtual_lights.gather.lighting import GatherSettings
from nlosrender.engine.virtual_lights.reciprocity import is_reciprocal
from nlosrender.engine.virtual_lights.refinement import Lattice, difference_divisor
from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.engine.virtual_lights.vpls.rounds import VplBounces
from nlosrender.scene.build import SceneWithoutWall


class VirtualLightEngine:
    """Third bounce by the gather of patches, further bounces by the gather of VPLs, and by paths for delta lobes.

    Parameters
    ----------
    device
        The capture on the device. Its hidden geometry has to be meshes, spheres and cylinders, all of them opaque.
    paths
        Engine of what delta lobes add to the bounces above the third.
    lanes
        Lanes that keep the backend busy.
    tuning
        Its numbers.
    """

    name = "virtual_lights"

    def __init__(
        self,
        device: DeviceCapture,
        paths: SupplementaryEngine,
        lanes: int,
        tuning: VirtualLightTuning = DEFAULT_TUNING,
    ):
        self.device, self.paths = device, paths
        self.built, self.capture, self.time_axis = device.built, device.capture, device.time_axis
        self.options = device.options
        built, capture = self.built, self.capture
        shapes = (*built.hidden_shapes, *([built.wall_shape] if wall_sees_itself(built) else []))
        bsdfs = [shape.bsdf() for shape in shapes if not is_mirror(shape.bsdf())]
        self._is_one_sided = all(is_lambertian(bsdf) for bsdf in bsdfs)  # and Lambertian
        self.settings = GatherSettings(
            is_confocal=capture.scan_type == "confocal",
            is_diffuse=all(is_lambertian(bsdf) or is_two_sided_diffuse(bsdf) for bsdf in bsdfs),
            has_two_sided=any(is_two_sided_diffuse(bsdf) for bsdf in bsdfs),
            needs_visibility=not nothing_occludes(built),
            has_one_laser=capture.n_lasers == 1,
            is_multiplexed=capture.laser_weights is not None,
        )
        all_lambertian = self._is_one_sided and all(is_lambertian(shape.bsdf()) for shape in built.lit_shapes)
        has_vpls = self.has_further_bounces and self._mirrors_once
        mirror = device.lone_mirror if has_vpls else None
        bin_width = self.time_axis.bin_width_opl / built.metres_per_engine_unit
        self.tessellator = Tessellator(built, capture, bin_width, mirror=mirror, tuning=tuning)
        reciprocal = (
            mirror is None
            and device.footprint is None
            and is_reciprocal(built, capture, self.time_axis.n_bins, is_lambertian=all_lambertian, tuning=tuning)
        )
        self.third = ThirdBounce(device, self.tessellator, self.settings, lanes, reciprocal, mirror)
        self.further: VplBounces | None = None  # where further bounces are asked for
        self.traces_paths = self.has_further_bounces and not has_vpls  # for light of delta lobes
        if self.has_further_bounces:
            masks = self.third.masks if self.settings.needs_visibility else None
            can_share = self.settings.has_one_laser and not self.settings.is_confocal
            self.further = VplBounces(
                device,
                self.tessellator,
                masks,
                self._is_one_sided,
                may_share=can_share and all_lambertian and has_vpls and mirror is None,
                with_delta=has_vpls,
            )
            paths.only_specular = self.traces_paths
        surfaces = "Lambertian" if self.settings.is_diffuse else "diffuse and rough"
        surfaces += " surfaces and a mirror" if mirror is not None else " surfaces"
        surfaces += " (light of mirrors by paths)" if self.traces_paths else ""
        before = f"before a {'planar' if built.wall.is_planar else 'curved'} wall"
        self.reason = f"{surfaces} {'that a camera sees' if isinstance(built, SceneWithoutWall) else before}"
        self._calibrated: dict[Budget, Budget] = {}

    @property
    def _mirrors_once(self) -> bool:
        """Whether VPLs find all light of mirrors: none is there, or one that shows a wall which may have VPLs."""
        built, mirror = self.built, self.device.lone_mirror
        if not any(_has_delta_lobe(shape.bsdf()) for shape in built.scene.shapes()):
            return True
        if mirror is None or self.settings.is_confocal or not self._is_one_sided:
            return False
        if not built.wall.is_planar:
            return wall_sees_itself(built)
        has_vpls = built.wall_shape.class_name() == "Rectangle" and is_lambertian(built.wall_bsdf)
        return has_vpls or not mirror.shows_wall(built)

    def set_up(self) -> None:
        """Make what all resolutions and batches share, else made when it is first needed: it grows with the triangles.

        Area moments of small elements, and the tree of what may hide something.
        """
        self.tessellator.set_up()
        if self.has_masks:
            self.third.masks.set_up()

    @property
    def has_further_bounces(self) -> bool:
        """Whether bounces above the third are asked for."""
        highest = self.options.bounces.max_bounces
        return highest is None or highest > THIRD_BOUNCE

    @property
    def has_masks(self) -> bool:
        """Whether visibility masks save rays."""
        return self.settings.needs_visibility and self.third.masks.pay_off(self.capture.n_sensors)

    @cached_property
    def misses_light(self) -> bool:
        """Whether light of the further bounces is not found, nor known to the estimated error.

        Between a laser point and a surface almost on it, light goes to and fro in an area of about the distance
        squared. Subpaths begin anywhere and end there by chance.
        """
        if not self.has_further_bounces or self.capture.scan_type == "confocal":
            return False
        # of all surfaces that VPLs lie on: without relay wall the sampler leaves out those with points on them
        is_seen = isinstance(self.built, SceneWithoutWall)
        area = float(self.tessellator.shared.areas.sum()) if is_seen else self.device.sampler.area
        return math.pi * self.tessellator.nearest_to_laser**2 < self.tessellator.tuning.rare_share * area

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far; the gather's own kernels count as rendering."""
        return self.paths.compile_seconds

    def calibrate(self, budget: Budget, seconds: float = math.inf) -> Budget:
        """Turn a target error into a patch scale, and into rounds or samples; see ``Engine.calibrate``.

        With a time limit only the patch scale is decided.
        """
        if budget.patch_scale is not None:
            return budget
        if budget not in self._calibrated:
            tuning = self.third.tuning
            of_lights = tuning.share_squares - (tuning.specular_share**2 if self.traces_paths else 0.0)
            calibrated, used = calibrated_lights(self.third, self.further, budget, share_squares=of_lights)
            if self.traces_paths:
                squares = self.third.gather(
                    pilot_of(self.capture), calibrated.patch_scale or self.third.tuning.coarsest_scale
                ).squares
                goal = math.sqrt(tuning.share_squares - used) * (budget.target_error or DEFAULT_TARGET)
                paths = self.paths.calibrate(replace(budget, target_error=goal), seconds, squares)
                calibrated = replace(
                    calibrated,
                    spp=paths.spp,
                    bins_per_step_of_paths=paths.bins_per_step_of_paths,
                    steps_variance_of_paths=paths.steps_variance_of_paths,
                )
            if math.isfinite(seconds):
                return calibrated
            self._calibrated[budget] = calibrated
        return self._calibrated[budget]

    def render(self, batch: Batch, budget: Budget, passes: Passes | None = None) -> Histogram:
        """Render one batch; see ``Engine.render``.

        The variance of the third bounce is the square of its estimated discretisation error.
        """
        begun, passes = time.perf_counter(), passes or Passes()
        budget = self.calibrate(budget)
        scale = budget.patch_scale or self.third.tuning.coarsest_scale
        shared = 0.5 if self.has_further_bounces else 1.0
        self.third.footprint_places = budget.footprint_places or self.third.tuning.footprint_places[1]
        stage = passes.stage("third bounce", 0, shared)
        lattice = None
        if budget.visibility_step is not None and budget.rays_per_node is not None:
            lattice = Lattice(budget.visibility_step, budget.rays_per_node)
        coarse, fine = self.third.pair(batch, scale, stage, lattice)
        left = budget.time_limit_s
        if left is not None:
            left = max(0.0, left - (time.perf_counter() - begun))
        result = self._further_bounces(batch, replace(budget, time_limit_s=left), passes, shared, fine.squares)
        if self.misses_light:
            missed = self.third.tuning.missed_light
            np.add(result.variance, np.square(missed * result.mean), out=result.variance)
            result.contrasts[:] += missed * result.mean.sum(axis=(2, 3, 4))
        factor = self.device.scale
        third, deviation = fine.values, coarse.values  # large: worked on in place
        np.subtract(third, deviation, out=deviation)
        deviation *= factor / (budget.difference_divisor or difference_divisor(coarse, fine))
        third *= factor
        places = self.capture.sensor_grid.places[self.device.sensor_indices(batch)]
        for number, slot in enumerate(self._slots(third.shape[1])):
            result.mean[:, slot] += third[:, number, ..., :-1]
            in_window = deviation[:, number, ..., :-1]
            result.contrasts[:, :, slot] += contrasts_of_deviation(in_window, places)
            result.variance[:, slot] += np.square(in_window, out=in_window)
            result.outside[:, slot] += third[:, number, ..., -1]
            if fine.footprint_deviation is not None:
                in_window = factor * fine.footprint_deviation[:, number, ..., :-1]
                result.contrasts[:, :, slot] += contrasts_of_deviation(in_window, places)
                result.variance[:, slot] += np.square(in_window)
        result.refuse_not_finite()
        return result

    def _further_bounces(
        self, batch: Batch, budget: Budget, passes: Passes, begin: float, known_squares: float
    ) -> Histogram:
        """Return the second bounce and those above the third; ``begin``: share of the work that is done."""
        if self.further is None:
            return self.device.histogram_without_samples(batch)
        if not self.traces_paths:
            return self.further.render(batch, budget, passes.stage("further bounces", begin, 1), known_squares)
        end, left = self.third.tuning.time_share_of_lights, budget.time_limit_s
        of_lights, of_paths = (None, None) if left is None else (end * left, (1 - end) * left)
        rest = passes.stage("further bounces", begin, end)
        result = self.further.render(batch, replace(budget, time_limit_s=of_lights), rest, known_squares)
        rest = passes.stage("light of mirrors", end, 1)
        specular = self.paths.render(batch, replace(budget, time_limit_s=of_paths), rest, known_squares)
        for name in ("mean", "variance", "outside", "contrasts"):
            total = getattr(result, name)
            np.add(total, getattr(specular, name), out=total)
        return result

    def _slots(self, count: int) -> list[int]:
        """Return the bounce slots of gathered bounces, the third and what a mirror adds, up to the highest."""
        highest = self.options.bounces.max_bounces
        bounces = range(THIRD_BOUNCE, THIRD_BOUNCE + count)
        return [self.options.bounces.slot(bounce) for bounce in bounces if highest is None or bounce <= highest]

    # What ``preflight`` and reports ask

    def omitted_work(self) -> Iterator[OmittedWork]:
        """Yield the work that is left out; see ``Engine.omitted_work``."""
        if not self.settings.needs_visibility:
            yield omitted_visibility()
        elif self.has_masks:
            why = "where nothing can lie between a patch and a part of the wall"
            yield OmittedWork("shadow rays that nothing can stop", why)
        yield from omitted_triangles(self.device)
        if self.third.is_reciprocal:
            why = "laser and sensor points are the same and everything is Lambertian: H(l, s) = H(s, l)"
            yield OmittedWork("half of the pairs of laser and sensor points", why)
        if self.further is not None:
            yield from omitted_by_time_gate(self.device)
        if self.traces_paths:
            yield from self.paths.omitted_path_work()

    def shared_samples(self) -> str:
        """Return what makes errors correlated; see ``Engine.shared_samples``."""
        return "all sensor points share the same patches" + (" and VPLs" if self.further is not None else "")

    def batch_bytes(self, plan: Plan, available: float = math.inf) -> int:
        """Return the memory of the largest batch; see ``Engine.batch_bytes``."""
        return gather_batch_bytes(self, plan, available)

    def warnings(self) -> Iterator[str]:
        """Yield light that is not found, and bins that take too many patches; see ``Engine.warnings``."""
        if self.misses_light:
            distance = self.tessellator.nearest_to_laser * self.built.metres_per_engine_unit
            yield (
                f"a hidden surface lies {distance:.1g} m from a laser point: the third bounce is right, "
                "but most of the light that goes to and fro between the two is not found, and the stated "
                "error takes all further bounces for unknown. Use render.max_bounces: 3 where they do not matter."
            )
        most = self.third.tuning.max_patches
        needed = self.tessellator.count(self.third.tuning.coarsest_scale) * self.third.tuning.refinement
        if needed > most:
            yield (
                f"time_axis.bin_width_opl: bins of {self.time_axis.bin_width_opl:.3g} m are so fine that {needed:.1e} "
                f"patches of the hidden geometry are needed, more than {most:.0e}. "
                "Use wider bins, or render.engine: path."
            )

    def cost_estimate(self, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds) -> TimeEstimate:
        """Estimate the seconds of a render; see ``Engine.cost_estimate``."""
        return virtual_light_estimate(self, plan, budget, lanes, pilot)


def is_lambertian(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is Mitsuba's one-sided ``diffuse``."""
    return bsdf.class_name() == "SmoothDiffuse"


def _has_delta_lobe(bsdf: mi.BSDF) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
