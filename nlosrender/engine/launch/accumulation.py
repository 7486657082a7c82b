"""Accumulation of samples: launches of an engine's kernel into one histogram until the schedule has enough."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.plan import MAX_SUMS
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.energy_contrasts import contrasts_of_points
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape, Kernel
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.passes import Passes, Snapshot
from nlosrender.engine.launch.schedule import Schedule
from nlosrender.errors import RenderError

Launch = Callable[[DeviceHistogram, LaneRandomness, int, range], LaneRandomness]


@dataclass
class Accumulation:
    """Samples of a batch, one lane for each replica of each sensor point (or pixel).

    Parameters
    ----------
    shape
        Of the batch's histogram.
    points
        (sensors,) flat indices of the batch's sensor points, in the lanes' order: what their random numbers depend on.
    seed
        Of the render.
    launch
        Adds samples to a histogram; called with the histogram, the random state, the number of samples per lane and the
        block of samples that they belong to. Returns the advanced random state.
    scale
        What sums are multiplied by.
    slots
        Bounce slots of the result, as for ``DeviceHistogram.statistics``.
    kernel
        As for ``DeviceHistogram``.
    row_points
        (sensors,) flat indices of the sensor points in the histogram's order; None: ``points``.
    """

    shape: HistogramShape
    points: NDArray[np.uint32]
    seed: int
    launch: Launch
    scale: float = 1.0
    slots: range | None = None
    kernel: Kernel | None = None
    row_points: NDArray[np.uint32] | None = None
    compile_seconds: float = 0.0
    histogram: DeviceHistogram | None = None  # of the last run, and the samples of each of its lanes
    done: int = 0

    def run(self, schedule: Schedule, passes: Passes) -> Histogram:
        """Launch until ``schedule`` has enough.

        Raises
        ------
        RenderError
            The batch is too large for 32-bit indices, or the result is not finite.
        """
        refuse_many_sums(self.shape.size)
        histogram = self.histogram = DeviceHistogram(self.shape, self.kernel)
        if (earlier := passes.resumed("sums")) is None:
            randomness = lane_randomness(self.shape, self.points, self.seed)
            done, before = 0, 0.0
        else:
            histogram.sums = on_device(mi.Float64, earlier.arrays["sums"])
            randomness = LaneRandomness.restored(earlier)
            done, before = earlier.numbers["done"], earlier.numbers["seconds"]
            schedule.restore(earlier.numbers)
        begun, is_first = time.perf_counter() - before, True
        while (more := schedule.next_samples(done, time.perf_counter() - begun)) > 0:
            launched = time.perf_counter()
            randomness = self.launch(histogram, randomness, more, schedule.block)
            dr.sync_thread()
            seconds = time.perf_counter() - launched
            if is_first:
                self.compile_seconds += seconds  # the first launch is small: mostly compilation
            else:
                schedule.speed = more / max(seconds, 1e-6)
            done, is_first = done + more, False
            if schedule.wants_error(done):
                schedule.record_error(done, histogram.relative_error(done, schedule.known_squares))
            seconds = time.perf_counter() - begun

            def take(random: LaneRandomness = randomness, done: int = done, seconds: float = seconds) -> Snapshot:
                own = random.snapshot()
                numbers = {"done": done, "seconds": seconds, **own.numbers, **schedule.numbers()}
                return Snapshot({"sums": np.asarray(histogram.sums.numpy()), **own.arrays}, numbers)

            passes.between(schedule.fraction(done, seconds), take)
        self.done = done
        return self._result(histogram, done)

    def _result(self, histogram: DeviceHistogram, done: int) -> Histogram:
        shape, slots = self.shape, range(self.shape.slots) if self.slots is None else self.slots
        mean, variance = histogram.statistics(done, self.scale, slots)
        dr.eval(mean, variance)
        points = self.points if self.row_points is None else self.row_points
        contrasts = contrasts_of_points(histogram, points, self.scale / (done * shape.replicas), slots)
        result = Histogram.of_rows(
            histogram.on_host(mean), histogram.on_host(variance), done * shape.replicas, contrasts
        )
        result.refuse_not_finite()
        return result


def refuse_many_sums(size: float) -> None:
    """Raise ``RenderError`` where a batch has more sums than 32-bit indices reach."""
    if size > MAX_SUMS:
        raise RenderError(f"a batch of {size:.2e} sums is more than 32-bit indices reach; lower render.memory_limit")


def lane_randomness(shape: HistogramShape, points: NDArray[np.uint32], seed: int) -> LaneRandomness:
    """Return the random state that lanes begin with; parameters as for ``Accumulation``."""
    lane = dr.arange(mi.UInt32, shape.lanes)
    point = dr.gather(mi.UInt32, on_device(mi.UInt32, points), lane % shape.sensors)
    return LaneRandomness.seeded(seed, point * shape.replicas + lane // shape.sensors)
