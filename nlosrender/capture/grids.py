"""Laser and sensor points on the relay wall, and the legs to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Float64
from nlosrender.scene.walls.wall import EDGE_TOLERANCE, RelayWall

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig, GridConfig

SCAN_TYPES = ("single", "confocal", "exhaustive", LINE_OF_SIGHT)


@dataclass(frozen=True, eq=False)
class PointGrid:
    """Points on the relay wall: rows ascend in wall y, columns in wall x; positions and normals in the local frame."""

    wall_coordinates: Float64  # (ny, nx, 2) m
    positions: Float64  # (ny, nx, 3) m
    normals: Float64  # (ny, nx, 3), unit
    size: tuple[float, float]  # extent the cells cover (width, height) [m]; (0, 0) for a single point

    @property
    def ny(self) -> int:
        """Number of rows."""
        return self.positions.shape[0]

    @property
    def nx(self) -> int:
        """Number of columns."""
        return self.positions.shape[1]


@dataclass(frozen=True, eq=False)
class Capture:
    """One capture in the relay wall's local frame, before time and light.

    Raises
    ------
    ValueError
        The scan type is unknown, the grids do not fit it, or the energy or the spot's radius is out of range.
    """

    scan_type: str  # single, confocal, exhaustive or line_of_sight
    sensor_grid: PointGrid  # line_of_sight: the pixels, on the image plane
    laser_grid: PointGrid  # confocal: the sensor grid itself; line_of_sight: one unused point
    laser_position: Float64  # (3,) m
    sensor_position: Float64  # (3,) m
    account_first_and_last_bounces: bool
    laser_energy: float  # J per pulse
    laser_spot_radius: float  # m; 0 = a point

    def __post_init__(self) -> None:
        if self.scan_type not in SCAN_TYPES:
            raise ValueError(f"scan_type {self.scan_type!r}: need one of {', '.join(SCAN_TYPES)}")
        if self.scan_type == "confocal" and self.laser_grid is not self.sensor_grid:
            raise ValueError("a confocal capture has one grid: laser_grid must be sensor_grid")
        if self.scan_type in ("single", LINE_OF_SIGHT) and self.n_lasers != 1:
            raise ValueError(f"a {self.scan_type} capture has one laser point, got {self.n_lasers}")
        if not (np.isfinite(self.laser_energy) and self.laser_energy > 0):
            raise ValueError(f"laser_energy: got {self.laser_energy!r}, need a finite number > 0 [J]")
        if not (np.isfinite(self.laser_spot_radius) and self.laser_spot_radius >= 0):
            raise ValueError(f"laser_spot_radius: got {self.laser_spot_radius!r}, need a finite number >= 0 [m]")

    @property
    def n_lasers(self) -> int:
        """Number of laser points."""
        return self.laser_grid.ny * self.laser_grid.nx

    @property
    def n_sensors(self) -> int:
        """Number of sensor points."""
        return self.sensor_grid.ny * self.sensor_grid.nx

    @property
    def lasers_per_sensor(self) -> int:
        """Number of laser points that each sensor point is measured for: of confocal captures only its own."""
        return self.n_lasers if self.scan_type == "exhaustive" else 1

    @property
    def is_line_of_sight(self) -> bool:
        """Whether a camera sees the scene itself."""
        return self.scan_type == LINE_OF_SIGHT

    @property
    def laser_legs(self) -> Float64:
        """Optical path length laser -> laser point, (ly, lx) [m]; zeros when first and last legs are not counted."""
        return self._legs(self.laser_grid, self.laser_position)

    @property
    def sensor_legs(self) -> Float64:
        """Optical path length sensor point -> sensor, (ny, nx) [m]; zeros when first and last legs are not counted."""
        return self._legs(self.sensor_grid, self.sensor_position)

    def _legs(self, grid: PointGrid, device_position: Float64) -> Float64:
        if not self.account_first_and_last_bounces:
            return np.zeros(grid.positions.shape[:2])
        return np.linalg.norm(grid.positions - device_position, axis=-1)


def point_grid(wall: RelayWall, nx: int, ny: int, width: float | None = None, height: float | None = None) -> PointGrid:
    """Return the centres of nx x ny equal cells, centred on the wall.

    Parameters
    ----------
    wall
        The relay wall.
    nx, ny
        Number of columns and rows, >= 1.
    width, height
        Extent of all cells together in wall coordinates [m]; the whole wall when None.

    Returns
    -------
    PointGrid
        Point (row j, column i) at ((i + 0.5) / nx - 0.5) * width, ((j + 0.5) / ny - 0.5) * height.

    Raises
    ------
    ValueError
        A count is below 1, or the extent is not positive or larger than the wall.
    """
    if nx < 1 or ny < 1:
        raise ValueError(f"grid of {nx} x {ny} points: need at least 1 x 1")
    width = wall.width if width is None else float(width)
    height = wall.height if height is None else float(height)
    for name, extent, limit in (("width", width, wall.width), ("height", height, wall.height)):
        if not 0 < extent <= limit * (1 + EDGE_TOLERANCE):
            raise ValueError(f"grid {name}: got {extent:g} m, need > 0 and <= {limit:g} m, the wall's")
    x, y = _cell_centres(nx) * width, _cell_centres(ny) * height
    return _grid_at(wall, np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1), (width, height))


def single_point(wall: RelayWall, xy: ArrayLike) -> PointGrid:
    """Return the 1 x 1 grid of one point at wall coordinates ``xy`` (2,) [m]; ValueError off the wall."""
    return _grid_at(wall, np.asarray(xy, dtype=np.float64).reshape(1, 1, 2), (0.0, 0.0))


def build_capture(capture_config: CaptureConfig, wall: RelayWall) -> Capture:
    """Build the capture of a configuration, in the wall's local frame.

    Raises
    ------
    ConfigError
        A grid does not fit the wall; the size of a mesh wall is known from its file alone.
    ValueError
        A point is off the wall, or a value is out of range.
    """
    sensor_grid = _configured_grid(capture_config.sensor_grid, wall, "capture.sensor_grid")
    if capture_config.scan_type == "confocal":
        laser_grid = sensor_grid
    elif capture_config.scan_type == "exhaustive":
        if capture_config.laser_grid is None:
            raise ValueError("an exhaustive capture needs a laser_grid")
        laser_grid = _configured_grid(capture_config.laser_grid, wall, "capture.laser_grid")
    else:
        laser_point = capture_config.laser_point
        laser_grid = single_point(wall, (0.0, 0.0) if laser_point is None else laser_point)
    return Capture(
        scan_type=capture_config.scan_type,
        sensor_grid=sensor_grid,
        laser_grid=laser_grid,
        laser_position=_device_position(capture_config.laser_position, wall),
        sensor_position=_device_position(capture_config.sensor_position, wall),
        account_first_and_last_bounces=bool(capture_config.account_first_and_last_bounces),
        laser_energy=float(capture_config.laser_energy),
        laser_spot_radius=float(capture_config.laser_spot_radius),
    )


def _cell_centres(count: int) -> Float64:
    # (2i + 1 - n) / 2n: symmetric about 0 to the last bit, and exactly 0 in the middle of an odd count
    return (2 * np.arange(count) + 1 - count) / (2 * count)


def _configured_grid(grid_config: GridConfig, wall: RelayWall, key: str) -> PointGrid:
    try:
        return point_grid(wall, grid_config.nx, grid_config.ny, grid_config.width, grid_config.height)
    except ValueError as error:
        raise ConfigError.at(key, f"{error}.") from error


def _device_position(scene_position: ArrayLike | None, wall: RelayWall) -> Float64:
    return wall.default_device_position if scene_position is None else wall.pose.to_local(scene_position)


def _grid_at(wall: RelayWall, xy: Float64, size: tuple[float, float]) -> PointGrid:
    arrays = (xy, wall.positions(xy), wall.normals(xy))
    for array in arrays:
        array.flags.writeable = False
    return PointGrid(*arrays, size)
