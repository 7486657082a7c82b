"""Captures of one small patch off the wall's centre: where it is and when its light arrives is known beforehand.

Points are (x, y, z) in the relay wall's own axes here: x and y along the wall, z away from it, origin at its centre.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlosrender import pipeline
from nlosrender.config.load import parse_config

Array = NDArray[np.float64]
Point = tuple[float, float, float]

WALL_CENTRE = (0.3, -0.2, 0.5)  # m, scene coordinates; the wall faces the scene's x axis, its y axis is the scene's z
PATCH: Point = (0.35, -0.2, 0.6)
PATCH_EDGE = 0.004  # m
LASER: Point = (-0.5, 0.1, 0.4)
SENSOR: Point = (0.6, 0.3, 0.5)
LASER_POINT = (0.25, 0.4)  # of a single capture
START_OPL, BIN_WIDTH, N_BINS = 1.3, 0.01, 420  # m, m: not exact in float32; the window ends at 5.5 m

# Each leg changes by at most the distance between two points of the patch: half its diagonal from its centre.
SPREAD = 2 * PATCH_EDGE / np.sqrt(2)


@dataclass(frozen=True)
class Grid:
    """Points on the wall: their number and the extent of their cells [m] along its x and its y."""

    nx: int
    ny: int
    width: float
    height: float

    def expected(self) -> Array:
        """Return the points as the layout has them, in the file's frame (ny, nx, 3) [m]."""
        x = ((np.arange(self.nx) + 0.5) / self.nx - 0.5) * self.width
        y = ((np.arange(self.ny) + 0.5) / self.ny - 0.5) * self.height
        return np.stack(np.broadcast_arrays(x, 0.0, y[:, None]), axis=-1)


@dataclass(frozen=True)
class PatchCapture:
    """A rendered capture and what it was made from."""

    scan_type: str
    sensors: Grid
    lasers: Grid | None  # of an exhaustive capture
    path: Path

    def laser_points(self) -> Array:
        """Return the laser points in the file's frame (ly, lx, 3) [m]; those of the sensor for a confocal capture."""
        if self.scan_type == "confocal":
            return self.sensors.expected()
        if self.lasers is not None:
            return self.lasers.expected()
        return np.array([[file_point((*LASER_POINT, 0.0))]])


GRIDS: dict[str, tuple[Grid, Grid | None]] = {
    "single": (Grid(5, 4, 1.8, 1.5), None),
    "confocal": (Grid(6, 6, 1.9, 1.4), None),  # square: y-tal tells a confocal file by it
    "exhaustive": (Grid(3, 5, 1.7, 1.6), Grid(2, 4, 1.2, 0.9)),
}


def scene_point(point: Point) -> list[float]:
    """Return a point in scene coordinates: the wall's x, y, z are the scene's y, z, x."""
    x, y, z = point
    return [WALL_CENTRE[0] + z, WALL_CENTRE[1] + x, WALL_CENTRE[2] + y]


def file_point(point: Point) -> list[float]:
    """Return a point in the frame of a Z-NLOS file, (X, Y, Z) = (x, -z, y)."""
    x, y, z = point
    return [x, -z, y]


def render_patch(
    path: Path, scan_type: str, sensors: Grid, lasers: Grid | None = None, *, legs: bool = True
) -> PatchCapture:
    """Render the patch into a file.

    Parameters
    ----------
    path
        File to write.
    scan_type, sensors, lasers
        The scan; ``lasers`` for an exhaustive one.
    legs
        Whether path lengths count laser -> wall and wall -> sensor.
    """
    capture: dict[str, object] = {
        "scan_type": scan_type,
        "sensor_grid": vars(sensors),
        "laser_position": scene_point(LASER),
        "sensor_position": scene_point(SENSOR),
        "account_first_and_last_bounces": legs,
    }
    if scan_type == "single":
        capture["laser_point"] = LASER_POINT
    if lasers is not None:
        capture["laser_grid"] = vars(lasers)
    patch = {"type": "rectangle", "width": PATCH_EDGE, "height": PATCH_EDGE, "center": scene_point(PATCH)}
    patch |= {"normal": [-1, 0, 0], "up": [0, 0, 1]}
    wall = {"type": "rectangle", "width": 2.0, "height": 1.7}
    wall |= {"center": WALL_CENTRE, "normal": [1, 0, 0], "up": [0, 0, 1]}
    document = {
        "scene": {"relay_wall": wall, "hidden_geometry": [patch]},
        "capture": capture,
        "time_axis": {"start_opl": START_OPL, "bin_width_opl": BIN_WIDTH, "n_bins": N_BINS},
        "render": {"max_bounces": 3, "spp": 64, "backend": "llvm"},
        "output": {"path": str(path)},
    }
    # JSON is YAML
    pipeline.render_capture(parse_config(json.dumps(document), "patch.yaml", path.parent))
    return PatchCapture(scan_type, sensors, lasers, path)


def arrival_bins(laser_points: Array, sensor_points: Array, start_opl: float, bin_width: float) -> Array:
    """Return the first and the last bin that light of the patch can be in, (2, ...), from points in the file's frame.

    The path is laser -> laser point -> patch -> sensor point -> sensor; it differs by ``SPREAD`` over the patch.

    Parameters
    ----------
    laser_points, sensor_points
        (..., 3) [m], of shapes that go together.
    start_opl, bin_width
        Start of bin 0 and width of a bin [m].
    """
    laser, patch, sensor = (np.array(file_point(point)) for point in (LASER, PATCH, SENSOR))
    corners = (laser, laser_points, patch, sensor_points, sensor)
    opl = sum(np.linalg.norm(end - start, axis=-1) for start, end in pairwise(corners))
    # coordinates, start and width come from float32: 420 bins of a width that is off by 2e-10 m move by 1e-7 m
    reach = SPREAD + 1e-6
    return np.floor((np.stack([opl - reach, opl + reach]) - start_opl) / bin_width)


def lit_bins(histograms: Array) -> Array:
    """Return the first and the last bin that is not zero, (2, ...), of histograms (bin, ...), all of which are lit."""
    lit = histograms > 0
    assert lit.any(axis=0).all(), "a histogram without light"
    return np.stack([lit.argmax(axis=0), len(lit) - 1 - lit[::-1].argmax(axis=0)])
