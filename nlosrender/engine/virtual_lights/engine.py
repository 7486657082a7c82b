"""The virtual-light engine: third bounce gathered to the asked-for error, further bounces by the path engine."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.histogram import DeviceHistogram, Histogram, HistogramShape, relative_l2_error, to_memory_order
from nlosrender.engine.path_engine import Budget, PathEngine, PathOptions, Progress
from nlosrender.engine.transport import Transport
from nlosrender.engine.virtual_lights.gather import (
    GatherSettings,
    gather_third_bounce,
    illuminate,
    own_rows,
    upload_patches,
)
from nlosrender.engine.virtual_lights.occlusion import nothing_occludes
from nlosrender.engine.virtual_lights.patches import MAX_PATCHES, Tessellator
from nlosrender.scene.build import BuiltScene

FIRST_COARSENESS = 1.0
REFINEMENT = 3.0  # at least so many times more patches between the two resolutions that are compared
DEFAULT_TARGET = 0.01


@dataclass(frozen=True, eq=False)
class _Gathered:
    """The third bounce at one resolution, (channel, 1, laser, sensor, row), per J and (engine unit)^2."""

    values: NDArray[np.float64]
    n_patches: int


class VirtualLightEngine:
    """Third bounce by the gather, further bounces by path tracing.

    Parameters
    ----------
    built, capture, time_axis, options
        As for the path engine. The wall has to be planar, the hidden geometry meshes and spheres without mirrors.
    lanes
        Lanes that keep the backend busy.
    """

    name = "virtual_lights"

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, options: PathOptions, lanes: int):
        self.built, self.capture, self.time_axis, self.options, self.lanes = built, capture, time_axis, options, lanes
        self.paths = PathEngine(built, capture, time_axis, options, first_bounce=THIRD_BOUNCE + 1)
        self.tessellator = Tessellator(built, time_axis.bin_width_opl / built.unit)
        self.settings = GatherSettings(
            is_confocal=capture.scan_type == "confocal",
            is_diffuse=all(is_lambertian(shape.bsdf()) for shape in built.hidden_shapes),
            needs_visibility=not nothing_occludes(built),
        )
        self._coarseness = FIRST_COARSENESS  # where the last batch ended: the next one starts near it

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far; the gather's own kernels count as rendering."""
        return self.paths.compile_seconds

    def render(self, batch: Batch, budget: Budget, progress: Progress = lambda fraction: None) -> Histogram:
        """Render one batch; as ``PathEngine.render``, whose errors it raises.

        The variance of the third bounce is the square of its estimated discretisation error.
        """
        begun = time.perf_counter()
        bounces = self.options.bounces
        has_more = bounces.max_bounces is None or bounces.max_bounces > THIRD_BOUNCE
        third, variance = self._third_bounce(batch, budget, lambda share: progress(share / 2 if has_more else share))
        left = budget.time_limit_s
        if left is not None:
            left = max(0.0, left - (time.perf_counter() - begun))
        rest = self.paths.render(
            batch,
            replace(budget, time_limit_s=left),
            lambda share: progress((1 + share) / 2),
            known_squares=float((third[..., :-1] ** 2).sum()) / self.paths.scale**2,
        )
        slot = bounces.slot(THIRD_BOUNCE)
        mean, total_variance, outside = rest.mean, rest.variance, rest.outside
        mean[:, slot] += third[:, 0, ..., :-1]
        total_variance[:, slot] += variance[:, 0, ..., :-1]
        outside[:, slot] += third[:, 0, ..., -1]
        return Histogram(mean, total_variance, outside, rest.samples)

    def _third_bounce(
        self, batch: Batch, budget: Budget, progress: Progress
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Refine until two resolutions say that the error is met; return H and its squared error per bin."""
        begun = time.perf_counter()
        target = budget.target_error or DEFAULT_TARGET
        shape, slices = self._shape(batch)
        transport, slice_of_lane = self._transport(batch, shape, slices)
        coarse = self._gather(batch, shape, transport, slice_of_lane, self._coarseness)
        fineness = self._finer(self._coarseness, coarse.n_patches, REFINEMENT)
        while True:
            fine = self._gather(batch, shape, transport, slice_of_lane, fineness)
            error, divisor = _estimated_error(coarse, fine)
            progress(min(1.0, target / error) if error > 0 else 1.0)
            spent = time.perf_counter() - begun
            out_of_time = budget.time_limit_s is not None and 3 * spent > budget.time_limit_s
            needed = fine.n_patches * error / target
            if error <= target or out_of_time or max(needed, 2 * fine.n_patches) > MAX_PATCHES:
                break
            more = min(max(1.2 * error / target, 2.0), 16.0)
            coarse, fineness = fine, self._finer(fineness, fine.n_patches, more)
        self._coarseness = min(FIRST_COARSENESS, fineness * math.sqrt(REFINEMENT))
        scale = self.paths.scale
        return fine.values * scale, ((fine.values - coarse.values) * (scale / divisor)) ** 2

    def _finer(self, coarseness: float, n_patches: int, factor: float) -> float:
        """Return a coarseness with at least ``factor`` times the patches (a mesh may be finer than asked for)."""
        finer = coarseness / math.sqrt(factor)
        while self.tessellator.count(finer) < 0.9 * factor * n_patches:
            finer *= 0.8
        return finer

    def _gather(
        self, batch: Batch, shape: HistogramShape, transport: Transport, slice_of_lane: mi.UInt32, coarseness: float
    ) -> _Gathered:
        patches = self.tessellator.patches(coarseness)
        on_device = upload_patches(self.built, patches)
        light = None if self.settings.is_confocal else illuminate(transport, on_device, shape.lasers)
        histogram = DeviceHistogram(shape)
        jitter = mi.sample_tea_32(dr.arange(mi.UInt32, shape.lanes), mi.UInt32(self.options.seed))[0]
        stride = dr.opaque(mi.UInt32, shape.replicas)
        first = mi.UInt32(slice_of_lane)
        gather_third_bounce(self.settings, transport, on_device, light, histogram, first, stride, jitter)
        values = histogram.sums.numpy().reshape(shape.replicas, -1).sum(axis=0)
        return _Gathered(to_memory_order(values, shape), len(patches))

    def _shape(self, batch: Batch) -> tuple[HistogramShape, int]:
        """Return the histogram's shape, whose replicas are slices: lanes that share the patches of a sensor point."""
        # no more than the replicas that the plan has counted memory for
        slices = max(1, min(math.ceil(self.lanes / batch.sensors.size), self.options.replicas))
        return replace(self.paths.shape(batch, 1), replicas=slices), slices

    def _transport(self, batch: Batch, shape: HistogramShape, slices: int) -> tuple[Transport, mi.UInt32]:
        transport = self.paths.transport(batch, replace(shape, replicas=1))
        sensors, slice_of_lane = own_rows(transport.sensors, shape.sensors, slices)
        lane = dr.arange(mi.UInt32, shape.lanes)
        first_laser = dr.gather(mi.UInt32, transport.first_laser, lane % shape.sensors)
        dr.eval(sensors.interaction, sensors.delay_bins, sensors.delay_fraction, first_laser, slice_of_lane)
        return replace(transport, sensors=sensors, first_laser=first_laser), slice_of_lane


def _estimated_error(coarse: _Gathered, fine: _Gathered) -> tuple[float, float]:
    """Return the relative L2 error of the finer resolution, and what to divide the difference of the two by.

    The discretisation error falls as 1 / n patches: the difference is (r - 1) times the finer's error, with r the
    ratio of the counts. The error of random visibility rays falls as n^(-3/4) and is independent: sqrt(r^1.5 + 1).
    """
    ratio = fine.n_patches / coarse.n_patches
    divisor = min(ratio - 1, math.sqrt(ratio**1.5 + 1))
    noise = float(((fine.values - coarse.values)[..., :-1] ** 2).sum()) / divisor**2
    energy = float((fine.values[..., :-1] ** 2).sum())
    return relative_l2_error(noise, energy + noise), divisor


def is_lambertian(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is Mitsuba's one-sided ``diffuse``."""
    return bsdf.class_name() == "SmoothDiffuse"
