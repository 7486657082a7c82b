"""The gather of patches in passes: kernels of about a second, whatever the number of patches and sensor points.

A lane adds the patches of its part one after the other into rows of its own, so where a loop is cut changes no bit.
"""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.passes import Passes, PassSize, Snapshot
from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram
from nlosrender.engine.virtual_lights.gather.kernel import gather_third_bounce
from nlosrender.engine.virtual_lights.gather.lighting import GatherSettings, PackedPatches


class GatherPasses:
    """Gathers groups of patches, the same ones in the same order every time, into a histogram.

    Parameters
    ----------
    settings, histogram
        What is gathered, and where to.
    passes
        Who is told between two kernels, and may have kept a state to go on from.
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
        self, params: LaunchParams, packed: PackedPatches, lane: mi.UInt32, part: mi.UInt32, tile: mi.UInt64
    ) -> None:
        """Gather the next group; parameters as for ``gather_third_bounce``."""
        group, self._group = self._group, self._group + 1
        if group < self._first_group:
            return
        longest = int(np.diff(np.array(packed.first)).max())
        done = self._skipped if group == self._first_group else 0
        while done < longest:
            steps = min(self._size.steps, longest - done)
            self._size.begin()
            cut = (dr.opaque(mi.UInt32, number) for number in (done, steps))
            gather_third_bounce(self._settings, params, packed, self._histogram, lane, part, tile, *cut)
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
