"""The wall at a few moments, side by side, with the laser point and the sensor point of the histogram."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nlosrender.analysis.laser_view import (
    FRAME_SHARES,
    Float64,
    LaserView,
    list_on_wall,
    moments,
)
from nlosrender.analysis.theme import COLORMAP, DARK, FRAME_MARK, Theme, color_bar, power_of_ten, style
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.constants import opl_to_seconds
from nlosrender.errors import FileError
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.scan import moved, wall_frame
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import SubFigure

LETTER = 0.55  # width of a letter, of the height of the text
DOT_AREA = 4000.0  # square points, of the dots of a list together
Place = tuple[float, float]  # row and column, also between points; or x and y on the axes


def draw_frames(
    figure: SubFigure,
    capture: StoredCapture,
    view: LaserView,
    pixel: tuple[int, int],
    look: Theme,
    shared_scale: bool = False,
) -> None:
    """Draw the wall at a few moments: each on a scale of its own, as the last are orders of magnitude darker, or not.

    Above them stands which scale it is, and what the marks are.
    """
    frames, label = _frames(capture, view, shared_scale)
    points = list_on_wall(capture)
    laser, about_laser = _laser_place(capture, view.laser, pixel, points)
    all_axes = np.ravel(figure.subplots(1, len(frames), sharex=True, sharey=True, squeeze=False))
    for axes, frame in zip(all_axes, frames, strict=True):
        _, xlabel, ylabel = wall_extent(capture.header)
        style(axes, frame.title, xlabel, ylabel if axes is all_axes[0] else "", look)
        image = _draw_light(axes, frame, capture.header, points, look)
        mark: dict[str, Any] = {"linestyle": "none", "color": FRAME_MARK, "markeredgewidth": look.size(1.2)}
        at_pixel = _on_wall(pixel, capture.header, points)
        axes.plot(*at_pixel, marker="+", markersize=look.size(9), clip_on=False, **mark)
        if laser is not None:
            axes.plot(*laser, marker="o", markersize=look.size(10), fillstyle="none", **mark)
    if shared_scale:
        color_bar(figure, image, list(all_axes), label, look)
    lines = [_moments(capture.header, view, shared_scale), f"+ histogram below{about_laser}"]
    fits = figure.figure.get_figwidth() * 72 / (look.size(9.5) * LETTER)
    caption = (";   " if sum(map(len, lines)) < fits else "\n").join(lines)
    figure.suptitle(caption, color=look.faint, size=look.size(9.5), x=0.012, ha="left")


@dataclass(frozen=True, eq=False)
class Frame:
    """The wall at one moment."""

    title: str
    light: Float64  # (rows, columns), in the unit of the colour bar
    top: float  # the end of its colour scale


def _frames(capture: StoredCapture, view: LaserView, shared_scale: bool) -> tuple[list[Frame], str]:
    """Return the moments, and the label of the scale that they share."""
    header = capture.header
    found = moments(capture, view)
    shared = max(float(found.light.max()), 0.0) if shared_scale else 0.0
    factor, power = power_of_ten(shared)
    frames = []
    if header.has_pixels:  # of all bins: on its scale the moments would be black
        frames.append(_own_scale("sum over time", view.wall))
    for opl, moment in zip(found.opl, found.light, strict=True):
        title = f"{opl:.3f} m   {opl_to_seconds(opl) * 1e9:.2f} ns"
        frames.append(Frame(title, moment / factor, shared / factor) if shared_scale else _own_scale(title, moment))
    return frames, per_bin(header, power, found.n_bins)


def _own_scale(title: str, light: Float64) -> Frame:
    top = max(float(light.max()), 0.0)
    return Frame(f"{title}\nup to {top:.2g}", light, top)


def _draw_light(axes: Axes, frame: Frame, header: StoredHeader, points: Float64 | None, look: Theme) -> ScalarMappable:
    """Draw the light of a frame: as pixels, or as dots where the points are a list."""
    colors: dict[str, Any] = {"cmap": COLORMAP, "vmin": 0, "vmax": frame.top or 1.0}
    if points is None:
        extent, _, _ = wall_extent(header)
        image: ScalarMappable = axes.imshow(frame.light, origin="lower", extent=extent, **colors)
        axes.set_autoscale_on(False)  # no mark may move the axes
        return image
    axes.set_facecolor(DARK.panel)
    axes.set_aspect("equal")
    axes.margins(0.08)
    area = look.size(max(4.0, min(80.0, DOT_AREA / len(points))))
    return axes.scatter(
        points[:, 0], points[:, 1], c=frame.light[0], s=area, edgecolors=look.edge, linewidths=0.5, **colors
    )


def _moments(header: StoredHeader, view: LaserView, shared_scale: bool) -> str:
    shares = ", ".join(f"{100 * share:.0f}" for share in FRAME_SHARES)
    when = f"when {shares} % of the light have arrived" if view.time.any() else "without light"
    own = f"each on a colour scale of its own [{unit_text(header)}]"
    scale = "one colour scale for all moments" if shared_scale else own
    return f"{'pixels' if header.has_pixels else 'wall'} {when}, {scale}"


def _on_wall(place: Place, header: StoredHeader, points: Float64 | None) -> Place:
    """Return where on the axes of the frames a row and column of the sensor points lie."""
    if points is not None:
        x, y = points[int(place[1])]
        return float(x), float(y)
    (left, right, bottom, top), _, _ = wall_extent(header)
    rows, columns = header.sensor_grid
    return left + (place[1] + 0.5) / columns * (right - left), bottom + (place[0] + 0.5) / rows * (top - bottom)


def _laser_place(
    capture: StoredCapture, laser: tuple[int, int], pixel: tuple[int, int], points: Float64 | None
) -> tuple[Place | None, str]:
    """Return where on the axes of the frames the laser point lies, and what to say of it."""
    header = capture.header
    if is_view(header):
        return None, ""
    if header.confocal:
        return _on_wall(pixel, header, points), " and o its laser point (confocal: each sensor point has its own)"
    try:
        positions = capture.positions
    except FileError:  # other writers leave them out
        return None, ";   laser point not known"
    point = positions.laser_positions[laser]
    if points is not None:
        x, y = moved(point, wall_frame(header))[:2]
        return (float(x), float(y)), ";   o laser point"
    place = grid_place(positions.sensor_positions, point)
    rows, columns = header.sensor_grid
    if place is None:
        return None, ";   laser point not marked: it and the sensor points are no even grid on a plane"
    if not (-0.5 <= place[0] <= rows - 0.5 and -0.5 <= place[1] <= columns - 0.5):
        return None, ";   laser point outside the grid"
    return _on_wall(place, header, None), ";   o laser point"


def grid_place(grid: Float64, point: Float64) -> Place | None:
    """Return the row and column, also between points, of a point (3,) on an evenly spaced grid (rows, columns, 3).

    None where the grid is curved or unevenly spaced, or the point not on its plane, by more than a quarter of a cell.
    """
    rows, columns = np.indices(grid.shape[:2]).reshape(2, -1)
    design = np.stack([np.ones(rows.size), rows, columns], axis=1)
    fitted = np.linalg.lstsq(design, grid.reshape(-1, 3), rcond=None)[0]
    steps = fitted[1:]
    place = np.linalg.lstsq(steps.T, point - fitted[0], rcond=None)[0]
    lengths = np.linalg.norm(steps, axis=1)
    off = np.append(
        np.linalg.norm(grid.reshape(-1, 3) - design @ fitted, axis=1), np.linalg.norm(fitted[0] + place @ steps - point)
    )
    return (float(place[0]), float(place[1])) if off.max() <= 0.25 * lengths.max() else None


def is_view(header: StoredHeader) -> bool:
    """Return whether a capture is what a camera sees."""
    return header.scan_type == LINE_OF_SIGHT


def per_bin(header: StoredHeader, power: str, bins: int = 1) -> str:
    """Return the label of samples per bin, or per a few; ``power`` is that of ``theme.power_of_ten``."""
    per = "per bin" if bins == 1 else f"per {bins} bins"
    if header.is_measured:
        return f"counts {per}{f' [{power.strip()}]' if power else ''}"
    return f"{'radiance' if is_view(header) else 'H'} {per} [{power}{unit_text(header)}]"


def unit_text(header: StoredHeader) -> str:
    """Return the unit of the samples, with powers as matplotlib draws them."""
    return re.sub(r"\^(-\d)", r"$^{\1}$", header.unit)


def wall_extent(header: StoredHeader) -> tuple[tuple[float, float, float, float], str, str]:
    """Return (left, right, bottom, top) of the sensor grid, and labels for its axes; indices without a known size."""
    size = None if header.has_pixels else header.sensor_grid_size
    if size is not None and len(size) == 2 and all(np.isfinite(length) and length > 0 for length in size):
        width, height = size
        return (-width / 2, width / 2, -height / 2, height / 2), "wall x [m]", "wall y [m]"
    rows, columns = header.sensor_grid
    if header.is_list():
        return (-0.5, columns - 0.5, -0.5, rows - 0.5), "wall x [m]", "wall y [m]"
    return (-0.5, columns - 0.5, -0.5, rows - 0.5), "column", "row"
