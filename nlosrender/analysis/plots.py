"""One picture of a capture: the wall over time, one histogram, the light of each bounce, one row over time."""

from __future__ import annotations

import math
import re
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from nlosrender.analysis.drawn_picture import Picture, picture_kind
from nlosrender.analysis.laser_view import (
    Float64,
    LaserView,
    frame_bins,
    laser_view,
    list_on_wall,
    lit_window,
    point_histograms,
    row_over_time,
    wall_frames,
)
from nlosrender.analysis.measured_plot import MeasuredPair, draw_counts, draw_response, measured_pair, point_name
from nlosrender.analysis.theme import (
    COLORMAP,
    EDGE,
    FAINT,
    GROUND,
    INK,
    MARK,
    PANEL,
    TICK_SIZE,
    add_nanoseconds,
    color_bar,
    line_colors,
    power_of_ten,
    style,
)
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.config.encodable import encodable
from nlosrender.constants import opl_to_seconds
from nlosrender.errors import OptionError
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.reading.reader import StoredCapture, open_capture
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

DECADES = 5  # shown of a logarithmic axis
DOT_AREA = 4000.0  # square points, of the dots of a list together
MAX_ROW_LINES = 1200  # of the row over time, whose panel is about 500 pixels high


def plot_capture(
    path: str | Path,
    picture: str | Path,
    laser: tuple[int, int] | None = None,
    pixel: tuple[int, int] | None = None,
    ideal: Path | None = None,
) -> Path:
    """Draw one laser point's part of a capture; only that part is read, a few rows at a time.

    Parameters
    ----------
    path, picture
        Capture file; picture to write: .png, .pdf or .svg.
    laser, pixel
        (row, column) of the laser point, by default in the middle of its grid, and of the sensor point whose histogram
        is shown, by default the brightest.
    ideal
        The capture that a file of counts was measured from: its histogram is drawn beside the counts.

    Raises
    ------
    FileError
        The capture cannot be read, or the picture cannot be written.
    OptionError
        There is no such point, or pictures have no such format.
    """
    picture = Path(picture)
    check_writable(picture, picture_kind(picture), [path])  # before the work, not after it
    return capture_picture(path, laser, pixel, ideal).save(picture, [path])


def capture_picture(
    path: str | Path,
    laser: tuple[int, int] | None = None,
    pixel: tuple[int, int] | None = None,
    ideal: Path | None = None,
) -> Picture:
    """Draw as ``plot_capture`` without writing a file; parameters and errors are its own."""
    with open_capture(path) as capture, ExitStack() as stack:
        sizes = capture.header.sizes
        check_point("--laser", laser, sizes["laser_y"], sizes["laser_x"])
        check_point("--pixel", pixel, sizes["sensor_y"], sizes["sensor_x"])
        return Picture(_draw(capture, laser, pixel, measured_pair(capture, ideal, stack)))


def check_point(option: str, point: tuple[int, int] | None, rows: int, columns: int) -> None:
    """Raise OptionError for a (row, column) that a grid does not have; ``option`` is named."""
    if point is not None and not (0 <= point[0] < rows and 0 <= point[1] < columns):
        raise OptionError(
            f"{option}: got {point[0]},{point[1]}, need a row from 0 to {rows - 1} and a column from 0 to {columns - 1}"
        )


def _draw(
    capture: StoredCapture,
    laser: tuple[int, int] | None,
    pixel: tuple[int, int] | None,
    measured: MeasuredPair | None = None,
) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    header = capture.header
    middle = (header.sizes["laser_y"] // 2, header.sizes["laser_x"] // 2)
    view = laser_view(capture, middle if laser is None else laser)
    pixel = view.brightest if pixel is None else pixel
    spacing = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, hspace=0.04, wspace=0.02)
    figure = Figure(figsize=(14, 7.6), facecolor=GROUND, layout=spacing)
    heading, upper, lower = cast("list[SubFigure]", figure.subfigures(3, 1, height_ratios=[0.17, 1, 1.12]))
    for part in (heading, upper, lower):
        part.set_facecolor(GROUND)
    # a dollar sign in a file name is not the start of a formula
    title = encodable(header.path.name)
    heading.text(0.012, 0.66, title, color=INK, size=15, weight="bold", va="center", parse_math=False)
    heading.text(0.012, 0.12, _subtitle(header, view), color=FAINT, size=10.5, va="center", parse_math=False)
    _draw_frames(upper, capture, view, pixel)
    left, center, right = lower.subplots(1, 3, width_ratios=[1.55, 0.75, 1.2])
    if measured is not None:
        draw_counts(left, measured, view.laser, pixel)
        draw_response(center, measured)
    else:
        _draw_histogram(left, capture, view, pixel)
        _draw_bounces(center, header, view)
    _draw_row(right, capture, view)
    return figure


def _subtitle(header: StoredHeader, view: LaserView) -> str:
    parts = [header.scan_type, f"{header.counted_points()} {'pixels' if _is_view(header) else 'sensor points'}"]
    if header.scan_type == "exhaustive":
        parts.append(f"laser in row {view.laser[0]}, column {view.laser[1]} of {header.counted_points('laser')}")
    width = header.bin_width_opl
    parts.append(f"{header.n_bins} bins of {1000 * width:.4g} mm ({opl_to_seconds(width) * 1e12:.3g} ps)")
    engine, error = header.attributes.get("render_engine"), header.attributes.get("error_estimate")
    if header.is_measured:
        parts.append("counts")
    if isinstance(engine, str):
        parts.append(f"engine {engine[:40]}")
    if isinstance(error, float) and math.isnan(error):
        parts.append("error not known")
    elif isinstance(error, (int, float)):
        parts.append(f"estimated error {100 * error:.2g} %")
    if not view.time.any():
        parts.append("no light in the time window")
    return "  ·  ".join(parts)


def _draw_frames(figure: SubFigure, capture: StoredCapture, view: LaserView, pixel: tuple[int, int]) -> None:
    """Draw the wall at a few moments, each scaled by itself: the last are orders of magnitude darker."""
    header = capture.header
    first, last = lit_window(view.time)
    half = (last - first) // 400  # a single bin is mostly noise where bins are many
    bins = frame_bins(view.time)
    windows = [slice(max(index - half, 0), index + half + 1) for index in bins]
    frames = wall_frames(capture, view.laser, windows)
    extent, xlabel, ylabel = _wall_extent(header)
    left, right, bottom, top = extent
    rows, columns = header.sensor_grid
    at_pixel = (left + (pixel[1] + 0.5) / columns * (right - left), bottom + (pixel[0] + 0.5) / rows * (top - bottom))
    points = list_on_wall(capture)
    if points is not None:
        at_pixel = (float(points[pixel[1], 0]), float(points[pixel[1], 1]))
        xlabel, ylabel = "wall x [m]", "wall y [m]"
    moments = [header.start_opl + (index + 0.5) * header.bin_width_opl for index in bins]
    titles = [f"{opl:.3f} m   {opl_to_seconds(opl) * 1e9:.2f} ns" for opl in moments]
    if header.has_pixels:
        frames, titles = np.concatenate([view.wall[None], frames]), ["sum over time", *titles]
    all_axes = np.ravel(figure.subplots(1, len(titles), sharex=True, sharey=True, squeeze=False))
    for axes, frame, title in zip(all_axes, frames, titles, strict=True):
        style(axes, title, xlabel, ylabel if axes is all_axes[0] else "")
        scale: dict[str, Any] = {"cmap": COLORMAP, "vmin": 0, "vmax": max(frame.max(), 0) or 1}
        if points is None:
            axes.imshow(frame, origin="lower", extent=extent, **scale)
        else:
            area = max(4.0, min(80.0, DOT_AREA / len(points)))
            axes.scatter(*points.T, c=frame[0], s=area, edgecolors=EDGE, linewidths=0.5, **scale)
            axes.set_aspect("equal")
            axes.margins(0.08)
        axes.plot(*at_pixel, marker="+", markersize=9, markeredgewidth=1.2, color=MARK, clip_on=False)


def _draw_histogram(axes: Axes, capture: StoredCapture, view: LaserView, pixel: tuple[int, int]) -> None:
    header = capture.header
    first, last = lit_window(view.time)
    histograms = point_histograms(capture, view.laser, pixel)[:, first : last + 1]
    edges = header.start_opl + np.arange(first, last + 2) * header.bin_width_opl
    shown = [slot for slot in range(len(histograms)) if histograms[slot].any()]
    logarithmic = len(shown) > 1  # higher bounces are orders of magnitude darker
    factor, power = (1.0, "") if logarithmic else power_of_ten(float(histograms.max()))
    top = float(histograms.max()) / factor
    title = point_name(header, pixel)
    style(axes, title, "optical path length [m]", _per_bin(header, power))
    for slot, color in zip(shown, line_colors(len(shown)), strict=True):
        label = _bounce_label(header, slot)
        axes.stairs(histograms[slot] / factor, edges, baseline=None, color=color, lw=1.3, label=label)
    if logarithmic and top > 0:
        axes.set_yscale("log")
        axes.set_ylim(top * 10.0**-DECADES, top * 2)
    elif top > 0:
        axes.set_ylim(0, top * 1.08)
    if shown:
        axes.legend(facecolor=PANEL, edgecolor="none", labelcolor=INK, fontsize=9, loc="upper right", framealpha=0.75)
    axes.set_xlim(edges[0], edges[-1])
    add_nanoseconds(axes)


def _draw_bounces(axes: Axes, header: StoredHeader, view: LaserView) -> None:
    energy = view.bounces
    slots = range(len(energy))
    lit = [slot for slot in slots if energy[slot] > 0]
    summed = f"sum over {'pixels' if _is_view(header) else 'wall'} and time [{_unit(header)}]"
    style(axes, "light of each bounce", "bounce", summed)
    axes.bar(lit, energy[lit], color=line_colors(len(lit)), width=0.7)
    axes.set_xticks(slots, [_bounce_label(header, slot).removeprefix("bounce ") for slot in slots])
    axes.set_xlim(-1, len(energy))
    if lit:
        axes.set_yscale("log")
        top, bottom = energy.max(), energy[lit].min()
        axes.set_ylim(max(bottom / 10, top * 1e-12), top * 4)
    for slot in lit:
        percent = 100 * energy[slot] / energy[lit].sum()
        share = f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"
        place = (slot, float(energy[slot]))
        axes.annotate(share, place, (0, 3), textcoords="offset points", ha="center", color=INK, size=TICK_SIZE)


def _draw_row(axes: Axes, capture: StoredCapture, view: LaserView) -> None:
    from matplotlib.colors import PowerNorm

    header = capture.header
    row = view.brightest[0]
    first, last = lit_window(view.time)
    light = _at_most(row_over_time(capture, view.laser, row)[:, first : last + 1].T, MAX_ROW_LINES)
    factor, power = power_of_ten(float(light.max()))
    (left, right, _, _), xlabel, _ = _wall_extent(header)
    if header.is_list():
        left, right, xlabel = -0.5, header.sensor_grid[1] - 0.5, "point, in the order of the list"
    early, late = (header.start_opl + index * header.bin_width_opl for index in (first, last + 1))
    title = "listed points over time" if header.is_list() else f"brightest row ({row}) over time"
    style(axes, title, xlabel, "optical path length [m]")
    # square root: one bright front would leave everything behind it black
    scale = PowerNorm(0.5, vmin=0, vmax=max(float(light.max()), 0.0) / factor or 1.0, clip=True)
    extent = (left, right, early, late)
    image = axes.imshow(
        light / factor, origin="lower", extent=extent, aspect="auto", cmap=COLORMAP, norm=scale, interpolation="nearest"
    )
    color_bar(axes.figure, image, axes, _per_bin(header, power))


def _is_view(header: StoredHeader) -> bool:
    return header.scan_type == LINE_OF_SIGHT


def _per_bin(header: StoredHeader, power: str) -> str:
    if header.is_measured:
        return f"counts per bin{f' [{power.strip()}]' if power else ''}"
    return f"{'radiance' if _is_view(header) else 'H'} per bin [{power}{_unit(header)}]"


def _unit(header: StoredHeader) -> str:
    return re.sub(r"\^(-\d)", r"$^{\1}$", header.unit)


def _bounce_label(header: StoredHeader, slot: int) -> str:
    name = header.bounce_name(header.bounce_indices[slot]).replace(" and above", "+")
    return "all bounces" if name == "all" else f"bounce {name}"


def _wall_extent(header: StoredHeader) -> tuple[tuple[float, float, float, float], str, str]:
    """Return (left, right, bottom, top) of the sensor grid, and labels for its axes; indices without a known size."""
    size = None if header.has_pixels else header.sensor_grid_size
    if size is not None and len(size) == 2 and all(np.isfinite(length) and length > 0 for length in size):
        width, height = size
        return (-width / 2, width / 2, -height / 2, height / 2), "wall x [m]", "wall y [m]"
    rows, columns = header.sensor_grid
    return (-0.5, columns - 0.5, -0.5, rows - 0.5), "column", "row"


def _at_most(light: Float64, lines: int) -> Float64:
    """Join neighbouring lines (their maximum) until no more than ``lines`` are left: a front must not vanish."""
    join = -(-len(light) // lines)
    padded = np.pad(light, ((0, -len(light) % join), (0, 0)))
    return padded.reshape(-1, join, light.shape[1]).max(axis=1)
