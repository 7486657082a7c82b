"""Draws the figures of virtual-lights.md beside it: ``.venv/bin/python docs/virtual_lights_figures.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

FOLDER = Path(__file__).parent
BLUE, RED, GREY = "#2166ac", "#b2182b", "#777777"

# virtual-lights.md, 6.4: patches and relative L2 errors of the two scenes there
PLATE = [(288, 2.93e-2), (512, 1.49e-2), (968, 8.32e-3), (1800, 4.11e-3), (3528, 1.91e-3), (7200, 8.20e-4)]
PLATE += [(14112, 3.3e-4), (27848, 1.4e-4), (55112, 7e-5)]
BLOCKER = [(360, 4.83e-2), (640, 2.37e-2), (1210, 2.42e-2), (2312, 1.66e-2), (4496, 1.09e-2), (9122, 5.91e-3)]
BLOCKER += [(17984, 3.59e-3), (35536, 2.36e-3), (70600, 1.49e-3)]
NOISE = [(360, 1.95e-2), (640, 1.13e-2), (1210, 1.25e-2), (2312, 9.25e-3), (4496, 5.95e-3), (9122, 3.90e-3)]
NOISE += [(17984, 2.45e-3), (35536, 1.73e-3), (70600, 1.18e-3)]


def save(figure: Figure, name: str) -> None:
    """Write a figure as PNG beside this script."""
    FigureCanvasAgg(figure).print_figure(FOLDER / name, dpi=110)


def cdf(t: NDArray[np.float64], t0: float, t1: float, t2: float, t3: float) -> NDArray[np.float64]:
    """Return the area with a delay below ``t``, in shares of a patch: formula (6)."""
    total = t3 + t2 - t1 - t0
    rising = np.maximum(t - t0, 0) ** 2 / ((t1 - t0) * total)
    falling = 1 - np.maximum(t3 - t, 0) ** 2 / ((t3 - t2) * total)
    return np.where(t < t1, rising, np.where(t < t2, (2 * t - t0 - t1) / total, falling))


def draw_patch() -> None:
    """One triangle with lines of equal delay, its distribution and the fractions of the bins; and a parallelogram's."""
    figure = Figure(figsize=(10, 3.3), layout="constrained")
    triangle, axes, both = figure.subplots(1, 3)
    corners, delays = np.array([[0.1, 0.15], [1.05, 0.3], [0.35, 0.95]]), np.array([1.3, 3.4, 5.6])
    gradient = np.linalg.solve(corners[1:] - corners[0], delays[1:] - delays[0])
    grid = np.stack(np.meshgrid(np.linspace(0, 1.2, 300), np.linspace(0, 1.1, 300)), axis=-1)
    weights = np.linalg.solve(
        np.vstack([corners.T, np.ones(3)]), np.append(grid, np.ones((300, 300, 1)), -1)[..., None]
    )
    inside = (weights[..., 0] >= 0).all(axis=-1)
    bins = np.where(inside, np.floor(delays[0] + (grid - corners[0]) @ gradient), np.nan)
    triangle.pcolormesh(grid[..., 0], grid[..., 1], bins, cmap="Blues", vmin=-1, vmax=7)
    triangle.add_collection(PolyCollection([corners], facecolor="none", edgecolor="black"))
    for k, (corner, delay) in enumerate(zip(corners, delays, strict=True)):
        triangle.annotate(
            f"t{(0, 1, 3)[k]} = {delay}", corner, textcoords="offset points", xytext=(4, -12 + 18 * (k > 1))
        )
    triangle.set(title="bins over a triangle", xlim=(0, 1.3), ylim=(0, 1.1), aspect="equal")
    triangle.set_axis_off()
    t = np.linspace(0, 7, 500)
    for number, (title, ends) in enumerate(
        {"triangle": (1.3, 3.4, 3.4, 5.6), "parallelogram": (1, 2.2, 4.2, 5.4)}.items()
    ):
        panel = (axes, both)[number]
        edges = np.arange(0, 8)
        panel.bar(
            edges[:-1] + 0.5,
            np.diff(cdf(edges.astype(float), *ends)),
            width=0.96,
            color="#9ecae1",
            label="bin_fractions",
        )
        panel.plot(t, np.gradient(cdf(t, *ends), t), color=BLUE, label="density")
        panel.plot(t, cdf(t, *ends), color=RED, label="cdf")
        panel.set(title=title, xlabel="delay [bins]", ylim=(0, 1.05))
        panel.legend(loc="upper left", fontsize=8)
    save(figure, "virtual-lights-patch.png")


def quarters(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the four similar parts of triangles (n, 3, 2)."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab))])


def sizes(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the longest edges (n,)."""
    return np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1)


def draw_elements() -> None:
    """Elements of a side wall x = 1 that touches the relay wall z = 0, and the patches that (7) makes of them."""
    along = (np.arange(8) + 0.5) / 4 - 1
    sensors = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (n,) of points (y, z) of the side wall from the nearest sensor point."""
        across = np.square(points[:, None, 0] - sensors[None, :, 1]) + np.square(1 - sensors[None, :, 0])
        return np.sqrt(across.min(axis=1) + points[:, 1] ** 2)

    square = np.array([[-1.0, 0], [1, 0], [1, 2], [-1, 2]])
    left, done = square[[[0, 1, 2], [0, 2, 3]]], []
    while len(left):
        large = sizes(left) > distance(left.mean(axis=1))
        done.append(left[~large])
        left = quarters(left[large])
    elements = np.concatenate(done)
    d = distance(elements.mean(axis=1))
    allowed = np.minimum(np.where(d < 0.01, d / 2, d), 2 * np.sqrt(d * 0.01))
    patches = []
    for element, splits in zip(elements, np.ceil(sizes(elements) / allowed).astype(int), strict=True):
        i, j = np.meshgrid(np.arange(splits + 1), np.arange(splits + 1), indexing="ij")
        points = (
            element[0] + (i[..., None] * (element[1] - element[0]) + j[..., None] * (element[2] - element[0])) / splits
        )
        for row, column in np.argwhere(i + j < splits):
            patches.append(points[[row, row + 1, row], [column, column, column + 1]])
            if row + column < splits - 1:
                patches.append(points[[row + 1, row + 1, row], [column, column + 1, column + 1]])
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    parts = {f"{len(elements)} elements: longest edge <= d": elements}
    parts[f"{len(patches)} patches: edge <= min(d, 2 sqrt(d w))"] = np.array(patches)
    for axes, (title, triangles) in zip(figure.subplots(1, 2), parts.items(), strict=True):
        axes.add_collection(PolyCollection(triangles, facecolor="#eef3f8", edgecolor=BLUE, linewidth=0.5))
        axes.plot(along, np.full(8, -0.03), "o", color=RED, markersize=4, clip_on=False)
        axes.set(
            title=title,
            xlim=(-1, 1),
            ylim=(-0.06, 2),
            aspect="equal",
            xlabel="along the relay wall",
            ylabel="away from it",
        )
    save(figure, "virtual-lights-elements.png")


def draw_error() -> None:
    """Error of the gather against the number of patches, with the slopes of section 6."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    curves = {"plate, discretisation": (PLATE, BLUE, "o"), "plate and blocker": (BLOCKER, RED, "s")}
    curves["noise of its shadow rays"] = (NOISE, GREY, "^")
    for label, (points, colour, marker) in curves.items():
        axes.loglog(*zip(*points, strict=True), marker=marker, color=colour, label=label)
    for power, first, last, start in ((-1.25, 500, 2e4, 1.2e-2), (-0.5, 350, 6e3, 1.5e-2), (-0.75, 1e4, 8e4, 6.5e-3)):
        n = np.geomspace(first, last, 2)
        axes.loglog(n, start * (n / first) ** power, ":", color="black", linewidth=1.1)
        axes.annotate(f"$N^{{{power:g}}}$", (last, start * (last / first) ** power), fontsize=9)
    axes.set(xlabel="patches N", ylabel="relative L2 error of H")
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    save(figure, "virtual-lights-error.png")


if __name__ == "__main__":
    draw_patch()
    draw_elements()
    draw_error()
