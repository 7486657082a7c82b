"""Panels of a measured capture: counts of a point beside its ideal histogram, and the detector's response."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.analysis.laser_view import Float64, lit_window, point_histograms
from nlosrender.analysis.theme import DARK, Theme, add_legend, add_nanoseconds, line_colors, style
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.constants import SPEED_OF_LIGHT
from nlosrender.errors import FileError
from nlosrender.files.attributes import json_object
from nlosrender.files.measured import MEASUREMENT, sensor_of
from nlosrender.files.reading.reader import StoredCapture, open_capture
from nlosrender.files.reading.stored_header import StoredHeader
from nlosrender.sensor.detector import detector_of
from nlosrender.sensor.rebinning import TimeBins

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nlosrender.config.sensor import SensorConfig

PS_PER_M = 1e12 / SPEED_OF_LIGHT
RESPONSE_SHARE = 0.002  # of its peak, where the picture of a response ends
RESPONSE_POINTS = 600


@dataclass(frozen=True, eq=False)
class MeasuredPair:
    """Counts and the ideal capture that they were counted of, as far as there is one."""

    counts: StoredCapture
    ideal: StoredCapture | None
    sensor: SensorConfig


def measured_pair(capture: StoredCapture, ideal: Path | None, stack: ExitStack) -> MeasuredPair | None:
    """Return the counts of a capture and their ideal histograms; None where nothing was measured.

    ``stack`` closes the file ``ideal``.

    Raises
    ------
    FileError
        A file cannot be read; ``ideal`` has another grid, holds counts, or is given where there are none.
    """
    beside = capture.counts()
    try:
        sensor = sensor_of(capture.header)
    except FileError:  # the curve of its response is gone: the ideal panels are drawn without it
        sensor = None
    if capture.header.is_measured and sensor is not None:
        other = None if ideal is None else stack.enter_context(open_capture(ideal))
        if other is not None and (other.header.is_measured or other.header.sensor_grid != capture.header.sensor_grid):
            raise FileError(
                f"{ideal}: is not the ideal capture of {capture.path}: need samples of the same sensor grid."
            )
        return MeasuredPair(capture, other, sensor)
    if ideal is not None:
        raise FileError(f"{capture.path}: holds no counts that {ideal} could stand beside.")
    same_grid = beside is not None and beside.header.sensor_grid == capture.header.sensor_grid  # no zones
    return MeasuredPair(beside, capture, sensor) if beside is not None and sensor is not None and same_grid else None


def draw_counts(
    axes: Axes, pair: MeasuredPair, laser: tuple[int, int], pixel: tuple[int, int], look: Theme = DARK
) -> None:
    """Draw the counts of one point over the photons that the ideal histogram would make without pile-up and noise."""
    edges, counts = _histogram(pair.counts, laser, pixel)
    style(axes, point_name(pair.counts.header, pixel), "optical path length [m]", "counts per bin", look)
    shown, top = edges, float(counts.max(initial=0.0))
    axes.stairs(counts, edges, baseline=None, color=look.mark, lw=look.size(1.0), label="measured")
    if pair.ideal is not None:
        ideal_edges, ideal = _histogram(pair.ideal, laser, pixel)
        stated = json_object(pair.counts.header.attributes.get(MEASUREMENT)).get("scale")
        width = (edges[1] - edges[0]) / (ideal_edges[1] - ideal_edges[0])
        scale = float(stated) if isinstance(stated, (int, float)) else 0.0
        ideal = ideal * scale * pair.sensor.n_pulses * pair.sensor.photon_detection_ratio * width
        axes.stairs(
            ideal,
            ideal_edges,
            baseline=None,
            color=line_colors(1, look)[0],
            lw=look.size(1.3),
            label="ideal, as counts",
        )
        # where the signal is: counts have background everywhere
        first, last = lit_window(ideal)
        shown, top = ideal_edges[first : last + 2], max(top, float(ideal.max()))
        spread = (shown[-1] - shown[0]) / 3
        shown = np.array([shown[0] - spread, shown[-1] + spread])
    axes.set_xlim(max(shown[0], edges[0]), min(shown[-1], edges[-1]))
    axes.set_ylim(0, top * 1.08 or 1.0)
    add_legend(axes, look)
    add_nanoseconds(axes, look)


def point_name(header: StoredHeader, pixel: tuple[int, int]) -> str:
    """Return the heading of one point's histogram."""
    if header.is_list():
        return f"sensor point {pixel[1]} of the list (+)"
    what = "pixel" if header.scan_type == LINE_OF_SIGHT else "sensor point"
    return f"{what} in row {pixel[0]}, column {pixel[1]} (+)"


def draw_response(axes: Axes, pair: MeasuredPair, look: Theme = DARK) -> None:
    """Draw the time response of pulse and detector."""
    source = (pair.ideal or pair.counts).header
    detector = detector_of(pair.sensor, TimeBins(source.start_opl, source.bin_width_opl, source.n_bins))
    response = detector.response
    title = f"response: {response.fwhm * PS_PER_M:.3g} ps at half maximum"
    style(axes, title, f"delay [ps]; grey: a bin of {detector.bins.width * PS_PER_M:.3g} ps", "of its peak", look)
    if not response.fwhm:
        axes.axvline(0.0, color=look.mark, lw=look.size(1.5))
        axes.set_xlim(-1, 1)
        return
    delay = np.linspace(*response.support, 20 * RESPONSE_POINTS)
    density = response.density(delay)
    shown = np.flatnonzero(density > RESPONSE_SHARE * density.max())
    delay = np.linspace(delay[shown[0]], delay[shown[-1]], RESPONSE_POINTS)
    axes.plot(delay * PS_PER_M, response.density(delay) / density.max(), color=look.mark, lw=look.size(1.3))
    axes.axvline(0.0, color=look.ink, lw=look.size(0.6), alpha=0.5)
    axes.set_ylim(0, 1.08)
    width = detector.bins.width * PS_PER_M
    axes.axvspan(-width / 2, width / 2, color=look.ink, alpha=0.12, lw=0)


def _histogram(capture: StoredCapture, laser: tuple[int, int], pixel: tuple[int, int]) -> tuple[Float64, Float64]:
    """Return the edges of the bins [m] and one point's samples, bounces summed."""
    header = capture.header
    bins = TimeBins(header.start_opl, header.bin_width_opl, header.n_bins)
    return bins.edges, point_histograms(capture, laser, pixel).sum(axis=0)
