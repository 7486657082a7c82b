"""One picture of a capture: the wall over time, one histogram, the light of each bounce, one row over time."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from nlosrender.analysis.drawn_picture import Picture, picture_kind
from nlosrender.analysis.frames_plot import draw_frames, is_view, per_bin, unit_text, wall_extent
from nlosrender.analysis.laser_view import (
    Float64,
    LaserView,
    check_point,
    laser_view,
    lit_window,
    point_histograms,
    row_over_time,
)
from nlosrender.analysis.measured_plot import MeasuredPair, draw_counts, draw_response, measured_pair, point_name
from nlosrender.analysis.picture_style import PictureStyle
from nlosrender.analysis.theme import (
    COLORMAP,
    TICK_SIZE,
    Theme,
    add_legend,
    add_nanoseconds,
    color_bar,
    drawable,
    line_colors,
    power_of_ten,
    style,
)
from nlosrender.constants import opl_to_seconds
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.reading.reader import StoredCapture, open_capture
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

DECADES = 5  # shown of a logarithmic axis
MAX_TITLE = 120  # characters of a file name
MAX_ROW_LINES = 1200  # of the row over time, whose panel is about 500 pixels high


def plot_capture(
    path: str | Path,
    picture: str | Path,
    laser: tuple[int, int] | None = None,
    pixel: tuple[int, int] | None = None,
    ideal: Path | None = None,
    look: PictureStyle | None = None,
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
    look
        Theme, size and resolution; None: dark, for a screen.

    Raises
    ------
    FileError
        The capture cannot be read, or the picture cannot be written.
    OptionError
        There is no such point, or pictures have no such format.
    """
    picture = Path(picture)
    check_writable(picture, picture_kind(picture), [path])  # before the work, not after it
    return capture_picture(path, laser, pixel, ideal, look).save(picture, [path])


def capture_picture(
    path: str | Path,
    laser: tuple[int, int] | None = None,
    pixel: tuple[int, int] | None = None,
    ideal: Path | None = None,
    look: PictureStyle | None = None,
) -> Picture:
    """Draw as ``plot_capture`` without writing a file; parameters and errors are its own."""
    look = look or PictureStyle()
    with open_capture(path) as capture, ExitStack() as stack:
        sizes = capture.header.sizes
        laser = check_point("--laser", laser, sizes["laser_y"], sizes["laser_x"])
        pixel = check_point("--pixel", pixel, sizes["sensor_y"], sizes["sensor_x"])
        figure = _draw(capture, laser, pixel, measured_pair(capture, ideal, stack), look)
        return Picture(figure, look.dots_per_inch)


def _draw(
    capture: StoredCapture,
    laser: tuple[int, int] | None,
    pixel: tuple[int, int] | None,
    measured: MeasuredPair | None,
    style_asked: PictureStyle,
) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    header = capture.header
    middle = (header.sizes["laser_y"] // 2, header.sizes["laser_x"] // 2)
    view = laser_view(capture, middle if laser is None else laser)
    pixel = view.brightest if pixel is None else pixel
    look = style_asked.look
    spacing = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, hspace=0.04, wspace=0.02)
    figure = Figure(figsize=style_asked.size, facecolor=look.ground, layout=spacing)
    heading, upper, lower = cast("list[SubFigure]", figure.subfigures(3, 1, height_ratios=[0.17, 1.05, 1.12]))
    for part in (heading, upper, lower):
        part.set_facecolor(look.ground)
    # a dollar sign in a file name is not the start of a formula
    text: dict[str, Any] = {"x": 0.012, "va": "center", "parse_math": False}
    title = drawable(header.path.name)[:MAX_TITLE]
    heading.text(y=0.66, s=title, color=look.ink, size=look.size(15), weight="bold", **text)
    heading.text(y=0.12, s=drawable(_subtitle(header, view)), color=look.faint, size=look.size(10.5), **text)
    draw_frames(upper, capture, view, pixel, look, style_asked.shared_scale)
    left, center, right = lower.subplots(1, 3, width_ratios=[1.55, 0.75, 1.2])
    if measured is not None:
        draw_counts(left, measured, view.laser, pixel, look)
        draw_response(center, measured, look)
    else:
        _draw_histogram(left, capture, view, pixel, look)
        _draw_bounces(center, header, view, look)
    _draw_row(right, capture, view, look)
    return figure


def _subtitle(header: StoredHeader, view: LaserView) -> str:
    parts = [header.scan_type, f"{header.counted_points()} {'pixels' if is_view(header) else 'sensor points'}"]
    if header.scan_type == "exhaustive":
        parts.append(f"laser in row {view.laser[0]}, column {view.laser[1]} of {header.counted_points('laser')}")
    width = header.bin_width_opl
    parts.append(f"{header.n_bins} bins of {1000 * width:.4g} mm ({opl_to_seconds(width) * 1e12:.3g} ps)")
    engine, error = header.attributes.get("render_engine"), header.attributes.get("error_estimate")
    if header.is_multiplexed:
        parts.append("several laser spots at once")
    if header.is_flash:
        parts.append("a flash, not a laser point")
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


def _draw_histogram(axes: Axes, capture: StoredCapture, view: LaserView, pixel: tuple[int, int], look: Theme) -> None:
    header = capture.header
    first, last = lit_window(view.time)
    histograms = point_histograms(capture, view.laser, pixel)[:, first : last + 1]
    edges = header.start_opl + np.arange(first, last + 2) * header.bin_width_opl
    shown = [slot for slot in range(len(histograms)) if histograms[slot].any()]
    logarithmic = len(shown) > 1  # higher bounces are orders of magnitude darker
    factor, power = (1.0, "") if logarithmic else power_of_ten(float(histograms.max()))
    top = float(histograms.max()) / factor
    style(axes, point_name(header, pixel), "optical path length [m]", per_bin(header, power), look)
    for slot, color in zip(shown, line_colors(len(shown), look), strict=True):
        label = _bounce_label(header, slot)
        axes.stairs(histograms[slot] / factor, edges, baseline=None, color=color, lw=look.size(1.3), label=label)
    if logarithmic and top > 0:
        axes.set_yscale("log")
        axes.set_ylim(top * 10.0**-DECADES, top * 2)
    elif top > 0:
        axes.set_ylim(0, top * 1.08)
    if shown:
        add_legend(axes, look)
    axes.set_xlim(edges[0], edges[-1])
    add_nanoseconds(axes, look)


def _draw_bounces(axes: Axes, header: StoredHeader, view: LaserView, look: Theme) -> None:
    energy = view.bounces
    slots = range(len(energy))
    lit = [slot for slot in slots if energy[slot] > 0]
    summed = f"sum over {'pixels' if is_view(header) else 'wall'} and time [{unit_text(header)}]"
    style(axes, "light of each bounce, in %", "bounce", summed, look)
    axes.bar(lit, energy[lit], color=line_colors(len(lit), look), width=0.7)
    axes.set_xticks(slots, [_bounce_label(header, slot).removeprefix("bounce ") for slot in slots])
    axes.set_xlim(-1, len(energy))
    if lit:
        axes.set_yscale("log")
        top, bottom = energy.max(), energy[lit].min()
        axes.set_ylim(max(bottom / 10, top * 1e-12), top * 4)
    for slot in lit:
        percent = 100 * energy[slot] / energy[lit].sum()
        share = f"{percent:.0f}" if percent >= 10 else f"{percent:.2g}"
        place = (slot, float(energy[slot]))
        text: dict[str, Any] = {
            "ha": "center",
            "color": look.ink,
            "size": look.size(TICK_SIZE if len(lit) < 5 else TICK_SIZE - 1.5),
        }
        axes.annotate(share, place, (0, 3), textcoords="offset points", **text)


def _draw_row(axes: Axes, capture: StoredCapture, view: LaserView, look: Theme) -> None:
    from matplotlib.colors import PowerNorm

    header = capture.header
    row = view.brightest[0]
    first, last = lit_window(view.time)
    light = _at_most(row_over_time(capture, view.laser, row)[:, first : last + 1].T, MAX_ROW_LINES)
    factor, power = power_of_ten(float(light.max()))
    (left, right, _, _), xlabel, _ = wall_extent(header)
    if header.is_list():
        left, right, xlabel = -0.5, header.sensor_grid[1] - 0.5, "point, in the order of the list"
    early, late = (header.start_opl + index * header.bin_width_opl for index in (first, last + 1))
    title = "listed points over time" if header.is_list() else f"brightest row ({row}) over time"
    style(axes, title, xlabel, "optical path length [m]", look)
    # square root: one bright front would leave everything behind it black
    scale = PowerNorm(0.5, vmin=0, vmax=max(float(light.max()), 0.0) / factor or 1.0, clip=True)
    extent = (left, right, early, late)
    image = axes.imshow(
        light / factor, origin="lower", extent=extent, aspect="auto", cmap=COLORMAP, norm=scale, interpolation="nearest"
    )
    color_bar(axes.figure, image, axes, per_bin(header, power), look)


def _bounce_label(header: StoredHeader, slot: int) -> str:
    name = header.bounce_name(header.bounce_indices[slot]).replace(" and above", "+")
    return "all bounces" if name == "all" else f"bounce {name}"


def _at_most(light: Float64, lines: int) -> Float64:
    """Join neighbouring lines (their maximum) until no more than ``lines`` are left: a front must not vanish."""
    join = -(-len(light) // lines)
    padded = np.pad(light, ((0, -len(light) % join), (0, 0)))
    return padded.reshape(-1, join, light.shape[1]).max(axis=1)
