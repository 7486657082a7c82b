"""``capture`` and ``time_axis``: which points are lit and measured, and when."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import ValidationInfo

from nlosrender.config.camera import CameraConfig
from nlosrender.config.fields import (
    BinCount,
    Coordinate,
    Energy,
    Flag,
    GridCount,
    Length,
    LengthOrZero,
    Point2,
    Point3,
)
from nlosrender.config.section import ONE_OF, Section
from nlosrender.errors import ValidationIssue

ScanType = Literal["single", "confocal", "exhaustive", "line_of_sight"]


class GridConfig(Section):
    """A regular grid of points on the relay wall, centred on it; points are cell centres (i + 0.5) / n."""

    nx: GridCount
    """points along the wall's x axis"""
    ny: GridCount
    """points along the wall's y axis"""
    width: Length | None = None
    """m, extent along x; null: the whole wall"""
    height: Length | None = None
    """m, extent along y; null: the whole wall"""

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.nx * self.ny


class CaptureConfig(Section):
    """The scan: laser points, sensor points, and where laser and sensor stand."""

    scan_type: Annotated[ScanType, ONE_OF]
    """single: one laser point; confocal: laser and sensor on the same point; exhaustive: every pair;
    line_of_sight: what a camera sees of a scene with emitters"""
    sensor_grid: GridConfig
    """the measured points; line_of_sight: the camera's pixels, not set here"""
    camera: CameraConfig | None = None
    """line_of_sight: where the scene is seen from; null: the camera of scene.mitsuba"""
    laser_grid: GridConfig | None = None
    """the lit points of an exhaustive scan"""
    laser_point: Point2 | None = None
    """m, wall coordinates (x, y) from the wall's centre; the lit point of a single scan, default [0, 0]"""
    laser_position: Point3 | None = None
    """m, scene coordinates; null: 1 m in front of the wall's centre"""
    sensor_position: Point3 | None = None
    """m, scene coordinates; null: 1 m in front of the wall's centre"""
    laser_energy: Energy = 1.0
    """J per pulse"""
    laser_spot_radius: LengthOrZero = 0.0
    """m, radius of the lit disc on the wall; 0: a point"""
    account_first_and_last_bounces: Flag = True
    """count the legs laser to wall and wall to sensor in the path length; line_of_sight: the leg to the camera"""

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Light the wall's centre, or make the camera's pixels the sensor grid."""
        scan = raw.get("scan_type")
        if scan == "single" and raw.get("laser_point") is None:
            raw["laser_point"] = [0.0, 0.0]
        if scan == "line_of_sight" and "sensor_grid" not in raw:
            pixels = {"nx": 1, "ny": 1}  # what the camera lacks is its own mistake
            if isinstance(camera := raw.get("camera"), Mapping):
                sizes = {"nx": camera.get("width"), "ny": camera.get("height")}
                pixels |= {key: size for key, size in sizes.items() if type(size) is int and size >= 1}
            raw["sensor_grid"] = pixels
        return raw

    def rule_laser_grid(self) -> Iterator[ValidationIssue]:
        """An exhaustive scan has one."""
        if self.scan_type == "exhaustive" and self.laser_grid is None:
            message = "missing, an exhaustive scan needs it, such as {nx: 4, ny: 3}."
            yield ValidationIssue(("laser_grid",), message)

    def rule_pixels(self) -> Iterator[ValidationIssue]:
        """The grid of a camera is its pixels."""
        camera, grid = self.camera, self.sensor_grid
        if not self.is_line_of_sight:
            return
        if grid.width or grid.height or (camera and (grid.nx, grid.ny) != (camera.width, camera.height)):
            message = "the sensor points of a line_of_sight capture are the camera's pixels; remove it, and set "
            message += "capture.camera.width and height."
            yield ValidationIssue(("sensor_grid",), message, "key")

    @property
    def is_line_of_sight(self) -> bool:
        """Whether a camera sees the scene itself, not a relay wall."""
        return self.scan_type == "line_of_sight"

    @property
    def n_lasers(self) -> int:
        """Number of laser points that have a histogram of their own; 1 for a confocal scan, whose pairs are fixed."""
        return self.laser_grid.n_points if self.laser_grid is not None else 1


class TimeAxisConfig(Section):
    """The bins, in metres of optical path length (OPL)."""

    start_opl: Coordinate = 0.0
    """m, start of bin 0"""
    bin_width_opl: Length = 0.003
    """m; 0.003 is 10 ps"""
    n_bins: BinCount = "auto"
    """auto (up to the latest possible arrival) or an integer >= 1"""
