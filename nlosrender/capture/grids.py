"""Laser and sensor points on the relay wall, and the legs to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.capture.flash import Flash
from nlosrender.capture.footprint import Footprint, PixelFootprint
from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Float64
from nlosrender.scene.walls.wall import EDGE_TOLERANCE, RectangleWall, RelayWall

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig, GridConfig
    from nlosrender.config.point_list import PointList
    from nlosrender.scene.pixel_points import PixelPoints

EVENNESS = 1e-6  # of the spacing: decimal coordinates of a grid with few digits
SCAN_TYPES = ("single", "confocal", "exhaustive", LINE_OF_SIGHT)


@dataclass(frozen=True, eq=False)
class PointGrid:
    """Points on the relay wall: rows ascend in wall y, columns in wall x; positions and normals in the local frame."""

    wall_coordinates: Float64  # (ny, nx, 2) m
    positions: Float64  # (ny, nx, 3) m
    normals: Float64  # (ny, nx, 3), unit
    size: tuple[float, float]  # extent the cells cover (width, height) [m], of a list its points'; (0, 0) for one point
    is_list: bool = False  # one row of points that stand anywhere, in the order they were given
    is_empty: NDArray[np.bool_] | None = None  # (ny, nx) pixels that see nothing; None: there is no camera

    @property
    def ny(self) -> int:
        """Number of rows."""
        return self.positions.shape[0]

    @property
    def nx(self) -> int:
        """Number of columns."""
        return self.positions.shape[1]

    @cached_property
    def lattice(self) -> PointGrid:
        """The same points as the rows and columns of a regular grid; a list that is none is returned as it is.

        What depends on neighbours asks for it, so that a grid given as a list, row by row, gives the same numbers.
        """
        listed = self.wall_coordinates.reshape(-1, 2)
        x, y = np.unique(listed[:, 0]), np.unique(listed[:, 1])
        if not self.is_list or len(x) * len(y) != len(listed):
            return self
        in_rows = np.array_equal(listed, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        if not (in_rows and _is_even(x) and _is_even(y)):
            return self
        # 12 digits: the cells' extent, not how the points were rounded
        size = [float(f"{np.ptp(axis) / max(len(axis) - 1, 1) * len(axis):.12g}") for axis in (x, y)]
        shape = len(y), len(x), -1
        xy, positions, normals = (a.reshape(shape) for a in (self.wall_coordinates, self.positions, self.normals))
        return PointGrid(xy, positions, normals, (size[0], size[1]))

    @cached_property
    def places(self) -> Float64:
        """Where each point is (points, 2), from 0 to 1 along x and y of the grid, or of the box around a list."""
        grid = self.lattice
        index = np.arange(grid.ny * grid.nx)
        if not grid.is_list:
            return np.stack([index % grid.nx / grid.nx, index // grid.nx / grid.ny], axis=-1)
        xy = grid.wall_coordinates[0]
        return np.asarray((xy - xy.min(axis=0)) / np.maximum(np.ptp(xy, axis=0), np.finfo(float).tiny))


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
    n_unlit_lasers: int = 0  # laser points that a camera sees and the laser does not light
    footprint: Footprint | PixelFootprint | None = None  # around each sensor point; None: a point
    # (lasers,) of the laser points of a single capture that one pulse lights at once, sum 1; None: one at a time
    laser_weights: Float64 | None = None
    laser_flash: Flash | None = None  # around the way to the laser point; None: a point or a spot

    def __post_init__(self) -> None:
        if self.scan_type not in SCAN_TYPES:
            raise ValueError(f"scan_type {self.scan_type!r}: need one of {', '.join(SCAN_TYPES)}")
        if self.scan_type == "confocal" and self.laser_grid is not self.sensor_grid:
            raise ValueError("a confocal capture has one grid: laser_grid must be sensor_grid")
        if self.scan_type in ("single", LINE_OF_SIGHT) and self.n_lasers != 1 and self.laser_weights is None:
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
    def point_lists(self) -> tuple[str, ...]:
        """Which of "sensor" and "laser" points are a list."""
        grids = {"sensor": self.sensor_grid, "laser": self.laser_grid}
        return tuple(
            name for name, grid in grids.items() if grid.is_list and (name == "sensor" or self.laser_weights is None)
        )

    @property
    def middle_of_spots(self) -> Float64:
        """The weighted middle of laser spots that are lit at once, (1, 1, 3) [m]."""
        return np.average(self.laser_grid.positions, axis=1, weights=self.laser_weights)[:, None]

    @property
    def is_line_of_sight(self) -> bool:
        """Whether a camera sees the scene itself."""
        return self.scan_type == LINE_OF_SIGHT

    @property
    def blur(self) -> float:
        """Distance by which a leg, and the way next to it, may differ from those of laser and sensor point [m]."""
        seen, flash = self.footprint, self.laser_flash
        return self.laser_spot_radius + (seen.reach if seen else 0.0) + (flash.reach if flash else 0.0)

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


def listed_points(wall: RelayWall, xy: ArrayLike) -> PointGrid:
    """Return the list of points at wall coordinates ``xy`` (points, 2) [m] as one row; ValueError off the wall."""
    row = np.asarray(xy, dtype=np.float64)[None]
    width, height = np.ptp(row[0], axis=0).tolist()
    return replace(_grid_at(wall, row, (width, height)), is_list=True)


def single_point(wall: RelayWall, xy: ArrayLike) -> PointGrid:
    """Return the 1 x 1 grid of one point at wall coordinates ``xy`` (2,) [m]; ValueError off the wall."""
    return _grid_at(wall, np.asarray(xy, dtype=np.float64).reshape(1, 1, 2), (0.0, 0.0))


def build_capture(capture_config: CaptureConfig, wall: RelayWall, pixels: PixelPoints | None = None) -> Capture:
    """Build the capture of a configuration, in the wall's local frame; ``pixels``: the points that a camera sees.

    Raises
    ------
    ConfigError
        A grid does not fit the wall; the size of a mesh wall is known from its file alone.
    ValueError
        A point is off the wall, or a value is out of range.
    """
    if pixels is not None:
        return _capture_of_pixels(capture_config, wall, pixels)
    sensor_grid = _configured_points(capture_config, "sensor", wall)
    if capture_config.scan_type == "confocal":
        laser_grid = sensor_grid
    elif capture_config.scan_type == "exhaustive":
        laser_grid = _configured_points(capture_config, "laser", wall)
    elif capture_config.spot_list is not None:
        laser_grid = _configured_points(capture_config, "spot", wall)
    else:
        laser_point = capture_config.laser_point
        laser_grid = single_point(wall, (0.0, 0.0) if laser_point is None else laser_point)
    positions = capture_config.laser_position, capture_config.sensor_position
    laser, sensor = (_device_position(at, wall) for at in positions)
    capture = _capture(capture_config, sensor_grid, laser_grid, laser, sensor)
    if capture_config.laser_flash is None:
        return capture
    angle, size = float(np.radians(capture_config.laser_flash.fov_deg)), (wall.width, wall.height)
    return replace(capture, laser_flash=Flash.onto(angle, laser, laser_grid.positions[0, 0], size))


def _capture_of_pixels(capture_config: CaptureConfig, wall: RelayWall, pixels: PixelPoints) -> Capture:
    both = pixels.sensors, pixels.lasers
    if isinstance(wall, RectangleWall):
        sensor_grid, laser_grid = (
            replace(_grid_at(wall, xy, _extent(xy)), is_empty=hits.is_empty)
            for hits, xy in zip(both, pixels.wall_coordinates(wall), strict=True)
        )
    else:
        sensor_grid, laser_grid = (
            PointGrid(
                np.zeros((*hits.shapes.shape, 2)), hits.positions, hits.normals, (0.0, 0.0), is_empty=hits.is_empty
            )
            for hits in both
        )
    if capture_config.scan_type == "confocal":
        laser_grid = sensor_grid
    laser, eye = (wall.pose.to_local(pixels.frame.to_scene(at)) for at in (pixels.laser, pixels.sensors.origin))
    capture = _capture(capture_config, sensor_grid, laser_grid, laser, eye)
    areas = None if pixels.areas is None else PixelFootprint(pixels.areas.reach)
    return replace(capture, n_unlit_lasers=pixels.lasers.n_hidden, footprint=areas)


def _extent(xy: Float64) -> tuple[float, float]:
    width, height = np.ptp(xy.reshape(-1, 2), axis=0).tolist()
    return width, height


def _capture(
    capture_config: CaptureConfig, sensor_grid: PointGrid, laser_grid: PointGrid, laser: Float64, sensor: Float64
) -> Capture:
    seen, shares, spots = capture_config.footprint, capture_config.laser_spot_weights, capture_config.spot_list
    weights: Float64 | None = None if spots is None else np.array(shares or [1.0] * len(spots), dtype=np.float64)
    return Capture(
        scan_type=capture_config.scan_type,
        sensor_grid=sensor_grid,
        laser_grid=laser_grid,
        laser_position=laser,
        sensor_position=sensor,
        account_first_and_last_bounces=bool(capture_config.account_first_and_last_bounces),
        laser_energy=float(capture_config.laser_energy),
        laser_spot_radius=float(capture_config.laser_spot_radius),
        footprint=None if seen is None else Footprint(*seen.extent, is_disc=seen.box is None),
        laser_weights=None if weights is None else weights / weights.sum(),
    )


def _cell_centres(count: int) -> Float64:
    # (2i + 1 - n) / 2n: symmetric about 0 to the last bit, and exactly 0 in the middle of an odd count
    return (2 * np.arange(count) + 1 - count) / (2 * count)


def _configured_points(capture_config: CaptureConfig, name: str, wall: RelayWall) -> PointGrid:
    """Return the grid or the list of sensor or laser points, or of the ``spot`` points that are lit at once."""
    grid: GridConfig | None = getattr(capture_config, f"{name}_grid", None)
    points: PointList | None = getattr(capture_config, f"{name}_list")
    try:
        if points is not None:
            return listed_points(wall, points.xy)
        if grid is None:
            raise ValueError(f"a capture of scan_type {capture_config.scan_type} needs a {name}_grid or {name}_points")
        return point_grid(wall, grid.nx, grid.ny, grid.width, grid.height)
    except ValueError as error:
        key = "laser_spots" if name == "spot" else f"{name}_{'grid' if points is None else 'points'}"
        raise ConfigError.at(f"capture.{key}", f"{error}.") from error


def _is_even(ascending: Float64) -> bool:
    """Return whether coordinates are equally spaced, but for rounding."""
    steps = np.diff(ascending)
    return len(steps) < 2 or bool(np.ptp(steps) <= EVENNESS * steps[0])


def _device_position(scene_position: ArrayLike | None, wall: RelayWall) -> Float64:
    return wall.default_device_position if scene_position is None else wall.pose.to_local(scene_position)


def _grid_at(wall: RelayWall, xy: Float64, size: tuple[float, float]) -> PointGrid:
    arrays = (xy, wall.positions(xy), wall.normals(xy))
    for array in arrays:
        array.flags.writeable = False
    return PointGrid(*arrays, size)
