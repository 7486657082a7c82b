"""One picture of a reconstruction: front view, depth map, and the views from above and from the side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nlosrender.analysis.drawn_picture import Picture
from nlosrender.analysis.reconstruction.reconstruct import SEPARATOR, Reconstruction, settings_text
from nlosrender.analysis.reconstruction.score import Score, otsu_threshold
from nlosrender.analysis.theme import COLORMAP, FAINT, GROUND, INK, MARK, color_bar, drawable, style
from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Float32

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DEPTH_COLORMAP = "viridis_r"  # near is bright
BACKGROUND_SHARE = 0.5  # of the threshold between object and background below which no depth is shown


def draw_reconstruction(
    reconstruction: Reconstruction, path: str | Path, silhouette: Float64 | None = None, score: Score | None = None
) -> Path:
    """Draw a reconstruction as a .png, .pdf or .svg, outlined by the true front ``silhouette`` (y, x).

    The front is drawn as the wall sees it, so that letters facing the wall read as they should. Returns ``path``.

    Raises
    ------
    FileError
        The picture cannot be written.
    """
    return reconstruction_picture(reconstruction, silhouette, score).save(path)


def reconstruction_picture(
    reconstruction: Reconstruction, silhouette: Float64 | None = None, score: Score | None = None
) -> Picture:
    """Draw as ``draw_reconstruction`` without writing a file."""
    return Picture(_figure(reconstruction, silhouette, score))


def _figure(reconstruction: Reconstruction, silhouette: Float64 | None, score: Score | None) -> Figure:
    """Draw three views as in a technical drawing, side and top beside and below the front; depth and text at right."""
    from matplotlib.figure import Figure

    grid, volume = reconstruction.grid, reconstruction.volume
    width, height, depth = (axis[-1] - axis[0] + grid.voxel_size for axis in (grid.x, grid.y, grid.z))
    side, below = max(depth, 0.25 * width), max(depth, 0.25 * height)
    tall = 11.0 * (height + below) / (2.25 * width + side) + 1.5
    figure = Figure(figsize=(13.0, min(max(tall, 4.5), 14.0)), facecolor=GROUND, layout="constrained")
    title = drawable(reconstruction.source.name)
    figure.suptitle(title, color=INK, size=14, weight="bold", x=0.01, ha="left", parse_math=False)
    axes = figure.subplots(2, 3, width_ratios=[width, side, 1.15 * width], height_ratios=[height, below])
    front = reconstruction.front_view()
    _show(axes[0, 0], front, grid.x, grid.y, "front view, as the wall sees it", "x [m]", "y [m]")
    if silhouette is not None:
        axes[0, 0].contour(grid.x, grid.y, silhouette, levels=[0.5], colors=MARK, linewidths=0.7)
    _show(axes[0, 1], volume.max(axis=2).T, grid.z, grid.y, "from the side", "z [m]", "y [m]")
    _show(axes[1, 0], volume.max(axis=1), grid.x, grid.z, "from above", "x [m]", "z [m]")
    _draw_depth(axes[0, 2], reconstruction, front)
    for panel in (axes[0, 0], axes[0, 2], axes[1, 0]):
        panel.invert_xaxis()
    for panel in axes[1, 1:]:
        panel.axis("off")
    axes[1, 2].text(0, 0.95, _text(reconstruction, score), color=FAINT, va="top", linespacing=1.6, parse_math=False)
    return figure


def _text(reconstruction: Reconstruction, score: Score | None) -> str:
    lines = settings_text(reconstruction).split(SEPARATOR)
    if score is not None:
        lines.append("against the true silhouette (outline):")
        lines.append(f"correlation {score.correlation:.3f}, IoU {score.iou:.3f}")
    return "\n".join(lines)


def _draw_depth(axes: Axes, reconstruction: Reconstruction, front: Float32) -> None:
    grid = reconstruction.grid
    seen = front > BACKGROUND_SHARE * otsu_threshold(front) if front.any() else np.zeros(front.shape, dtype=bool)
    depth = np.ma.masked_where(~seen, reconstruction.depth_map())
    image = _show(axes, depth, grid.x, grid.y, "depth of the brightest voxel", "x [m]", "y [m]", DEPTH_COLORMAP)
    if seen.any():
        # a flat object must not show as a mountain of rounding errors
        middle, half = (depth.max() + depth.min()) / 2, max(float(np.ptp(depth.compressed())), grid.z_extent / 4) / 2
        image.set_clim(middle - half, middle + half)
    color_bar(axes.figure, image, axes, "z [m]")


def _show(
    axes: Axes,
    picture: Any,
    across: Float64,
    upward: Float64,
    title: str,
    xlabel: str,
    ylabel: str,
    colors: str = COLORMAP,
) -> Any:
    from matplotlib.ticker import MaxNLocator

    style(axes, title, xlabel, ylabel)
    steps = [float(axis[1] - axis[0]) for axis in (across, upward) if len(axis) > 1]
    half = steps[0] / 2 if steps else 0.5
    extent = (across[0] - half, across[-1] + half, upward[0] - half, upward[-1] + half)
    bottom, top = (None, None) if colors == DEPTH_COLORMAP else (0.0, float(picture.max()) or 1.0)
    image = axes.imshow(picture, origin="lower", extent=extent, cmap=colors, aspect="equal", vmin=bottom, vmax=top)
    if extent[1] - extent[0] < 0.5 * (extent[3] - extent[2]):
        axes.xaxis.set_major_locator(MaxNLocator(2))
    return image
