"""References of a benchmark: float64 quadrature where there is a formula, long runs elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nlosrender.bench.runs import Float64, LoadedScene, Timer, render
from nlosrender.bench.scenes import PLATE_DISTANCE, PLATE_REFLECTANCE, PLATE_SIZE
from nlosrender.engine.interface import Budget

CELLS = 200  # per edge of the plate: cells of 4 mm
QUADRATURE_ERROR = 2e-4  # of that: falls as 1 / CELLS^2, 6e-3 with 40
NARROWEST = 1e-4  # bins
FIRST_TARGET = 0.01  # of the refinements that end in the reference
FINEST_TARGET = 1e-3
LONG_RUN_SEED = 9001  # no contender uses it
VIRTUAL_LIGHTS = {"engine": "virtual_lights"}


@dataclass(frozen=True, eq=False)
class Reference:
    """H of a scene, as exact as the time allowed."""

    values: Float64  # (laser, row, column, bin)
    error: float  # its own relative L2 error, estimated: in quadrature a part of what is reported for a contender
    origin: str
    seconds: float


def find_reference(loaded: LoadedScene, seconds: float) -> Reference:
    """Compute the reference of a scene in about ``seconds``; kept in memory only.

    Raises
    ------
    RenderError
        A run failed.
    """
    if loaded.scene.truth == "quadrature":
        timer = Timer()
        values = plate_quadrature(loaded)
        return Reference(values, QUADRATURE_ERROR, f"float64 quadrature, {CELLS} x {CELLS} cells", timer.read()[0])
    return _refined(loaded, seconds) if loaded.scene.truth == "refined" else _long_run(loaded, seconds)


def _refined(loaded: LoadedScene, seconds: float) -> Reference:
    """Gather at finer and finer targets while the next one can be expected to fit."""
    timer, target = Timer(), FIRST_TARGET
    run = render(loaded, Budget(target_error=target), LONG_RUN_SEED, VIRTUAL_LIGHTS)
    while target > FINEST_TARGET:
        spent = timer.read()[0]
        target = min(target, run.estimate or target) / 2
        if spent + 3 * run.seconds > seconds:
            break
        run = render(loaded, Budget(target_error=target), LONG_RUN_SEED, VIRTUAL_LIGHTS)
    return Reference(run.values, run.estimate or 0.0, "virtual lights, refined", timer.read()[0])


def _long_run(loaded: LoadedScene, seconds: float) -> Reference:
    """Gather the third bounce as finely as a third of the time allows, and trace the rest of the light in the rest."""
    timer = Timer()
    third = replace(loaded, scene=replace(loaded.scene, max_bounces=3))
    cost = render(third, Budget(target_error=FIRST_TARGET), LONG_RUN_SEED, VIRTUAL_LIGHTS).seconds
    # a gather's error falls as 1 / seconds
    target = max(FINEST_TARGET, FIRST_TARGET * min(1.0, 3 * cost / seconds))
    budget = Budget(target_error=target, time_limit_s=max(seconds - timer.read()[0], 4 * cost))
    run = render(loaded, budget, LONG_RUN_SEED, VIRTUAL_LIGHTS)
    origin = f"third bounce gathered to {target:.1%}, further ones by {run.samples} paths per sensor point"
    return Reference(run.values, run.estimate or 0.0, origin, timer.read()[0])


def plate_quadrature(loaded: LoadedScene) -> Float64:
    """Integrate the third bounce of the plate in float64.

    H of design section 3 for a diffuse plate parallel to a planar wall, z apart: every cosine is z / r, so a cell dA
    contributes rho / pi^3 * z^4 / (r1 r2)^4 dA. Over a square cell the delay is taken as linear, which spreads its
    light over time as a trapezoid, exact to second order in the cell's size.

    Returns
    -------
    ndarray
        (1, row, column, bin) [J m^-2 sr^-1].
    """
    sensors = loaded.capture.sensor_grid.positions
    laser = loaded.capture.laser_grid.positions[0, 0]
    axis = loaded.time_axis
    middles = ((np.arange(CELLS) + 0.5) / CELLS - 0.5) * PLATE_SIZE
    cells = np.stack([*(side.ravel() for side in np.meshgrid(middles, middles)), np.full(CELLS**2, PLATE_DISTANCE)])
    values = np.zeros(loaded.shape)
    # Plate, wall and laser point share eight symmetries: sensor points with the same |x|, |y| in any order are equal.
    known: dict[tuple[float, float], Float64] = {}
    for row, column in np.ndindex(*sensors.shape[:2]):
        small, large = sorted(np.round(np.abs(sensors[row, column, :2]), 9))
        if (small, large) not in known:
            point = np.array([small, large, 0.0])
            known[small, large] = _plate_row(cells, laser, point, axis.start_opl, axis.bin_width_opl, axis.n_bins)
        values[0, row, column] = known[small, large]
    return values


def _plate_row(cells: Float64, laser: Float64, sensor: Float64, start: float, width: float, n_bins: int) -> Float64:
    """Return one histogram (bin,); ``cells`` (3, n) are the centres of the plate's cells."""
    edge = PLATE_SIZE / CELLS
    to_laser, to_sensor = cells - laser[:, None], cells - sensor[:, None]
    r1, r2 = np.sqrt((to_laser**2).sum(axis=0)), np.sqrt((to_sensor**2).sum(axis=0))
    light = PLATE_REFLECTANCE / np.pi**3 * edge**2 * PLATE_DISTANCE**4 / (r1 * r2) ** 4
    delay = (r1 + r2 - start) / width
    gradient = np.abs(to_laser[:2] / r1 + to_sensor[:2] / r2) * (edge / (2 * width))  # bins from centre to side
    reach = gradient.sum(axis=0)
    first = np.floor(delay - reach)
    histogram = np.zeros(n_bins)
    below = np.zeros_like(delay)
    for step in range(int(np.ceil(2 * reach.max())) + 2):
        share = _trapezoid_share(first + step + 1 - delay, gradient.max(axis=0), gradient.min(axis=0))
        index = (first + step).astype(np.int64)
        inside = (index >= 0) & (index < n_bins)
        histogram += np.bincount(index[inside], weights=((share - below) * light)[inside], minlength=n_bins)
        below = share
    return histogram


def _trapezoid_share(t: Float64, wide: Float64, narrow: Float64) -> Float64:
    """Return P(u + v < t) for u, v uniform in [-wide, wide] and [-narrow, narrow], narrow <= wide."""
    narrow = np.maximum(narrow, NARROWEST)  # the differences below would drown in rounding
    wide = np.maximum(wide, narrow)

    def half_square(x: Float64) -> Float64:
        return np.maximum(x, 0.0) ** 2 / 2

    corners = half_square(t + wide + narrow) - half_square(t + wide - narrow)
    corners -= half_square(t - wide + narrow) - half_square(t - wide - narrow)
    return corners / (4 * wide * narrow)
