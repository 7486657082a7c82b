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
    FieldOfView,
    Flag,
    GridCount,
    Length,
    LengthOrZero,
    Point2,
    Point3,
    Sizes2,
    Weights,
)
from nlosrender.config.issues import mismatch
from nlosrender.config.point_list import PointList, WallPoints, point_list
from nlosrender.config.section import LIST, ONE_OF, Section
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


class FootprintConfig(Section):
    """The area that each sensor point stands for: H is its mean, as of a detector that sees an area."""

    radius: Length | None = None
    """m, of a disc around the point"""
    box: Sizes2 | None = None
    """m, [width, height] of a rectangle around it along the wall's axes, instead of radius"""
    pixel: Flag = False
    """with a camera: all that a pixel sees, on any surfaces, instead of radius"""

    def rule_one_shape(self) -> Iterator[ValidationIssue]:
        """A disc, a rectangle or a pixel."""
        if (self.radius is not None) + (self.box is not None) + self.pixel != 1:
            message = "need one of radius and box, such as {radius: 0.02} or {box: [0.04, 0.03]}, or with a camera "
            yield ValidationIssue((), f"{message}pixel: true.")

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height [m]."""
        return (2 * self.radius, 2 * self.radius) if self.box is None and self.radius else self.box or (0.0, 0.0)


class FlashConfig(Section):
    """A cone of light from laser_position around the way to laser_point, with equal energy per solid angle."""

    fov_deg: FieldOfView
    """degrees, full angle of the cone"""


class CaptureConfig(Section):
    """The scan: laser points, sensor points, and where laser and sensor stand."""

    scan_type: Annotated[ScanType, ONE_OF]
    """single: one laser point; confocal: laser and sensor on the same point; exhaustive: every pair;
    line_of_sight: what a camera sees of a scene with emitters"""
    sensor_grid: GridConfig | None = None
    """the measured points; with a camera: its pixels, not set here"""
    sensor_points: WallPoints | None = None
    """m, wall coordinates [[x, y], ...] instead of a grid, or {file: points.csv}, also .npy"""
    camera: CameraConfig | None = None
    """line_of_sight: where the scene is seen from; other scans: what each pixel sees first is its sensor point, on
    whatever surface; null: the camera of scene.mitsuba"""
    pixel_point: Point2 | None = None
    """where in its pixel a sensor point is seen, in pixels from the lower left corner; null: [0.5, 0.5], the centre"""
    laser_grid: GridConfig | None = None
    """the lit points of an exhaustive scan"""
    laser_points: WallPoints | None = None
    """m, instead of laser_grid, as sensor_points"""
    laser_spots: WallPoints | None = None
    """m, instead of laser_point, as sensor_points: spots that one pulse lights at once, into one histogram"""
    laser_spot_weights: Weights | None = None
    """of laser_spots: how the pulse's energy is shared, in any unit; null: equally"""
    multiplex: Flag = False
    """true with laser_spots: all at once"""
    laser_flash: FlashConfig | None = None
    """instead of a point: a cone of light from laser_position, whose axis goes to laser_point"""
    laser_point: Point2 | None = None
    """m, wall coordinates (x, y) from the wall's centre; the lit point of a single scan, default [0, 0]"""
    laser_target: Point3 | None = None
    """m, scene coordinates; single scan with a camera: the beam from laser_position towards it lights what it meets
    first"""
    laser_targets: Annotated[tuple[Point3, ...], LIST] | None = None
    """m, scene coordinates; exhaustive scan with a camera: as laser_target, a list; null: the points of the pixels"""
    laser_position: Point3 | None = None
    """m, scene coordinates; null: 1 m in front of the wall's centre, or where the camera stands"""
    sensor_position: Point3 | None = None
    """m, scene coordinates; null: 1 m in front of the wall's centre; with a camera: it stands there, not set here"""
    laser_energy: Energy = 1.0
    """J per pulse"""
    laser_spot_radius: LengthOrZero = 0.0
    """m, radius of the lit disc on the wall; 0: a point"""
    footprint: FootprintConfig | None = None
    """the area around each sensor point that H is the mean over; null: the point"""
    account_first_and_last_bounces: Flag = True
    """count the legs laser to wall and wall to sensor in the path length; line_of_sight: the leg to the camera"""

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Light the wall's centre, or make the camera's pixels the sensor grid."""
        scan = raw.get("scan_type")
        has_laser = any(raw.get(key) is not None for key in ("laser_point", "laser_target", "laser_spots"))
        if scan == "single" and not has_laser:
            raw["laser_point"] = [0.0, 0.0]
        if (scan == "line_of_sight" or raw.get("camera") is not None) and "sensor_grid" not in raw:
            pixels = {"nx": 1, "ny": 1}  # what the camera lacks is its own mistake
            if isinstance(camera := raw.get("camera"), Mapping):
                sizes = {"nx": camera.get("width"), "ny": camera.get("height")}
                pixels |= {key: size for key, size in sizes.items() if type(size) is int and size >= 1}
            raw["sensor_grid"] = pixels
        return raw

    def one_of(self, name: str, why: str) -> Iterator[ValidationIssue]:
        """Yield what is wrong where ``sensor`` or ``laser`` points are neither a grid nor a list, or both."""
        grid, points = getattr(self, f"{name}_grid"), getattr(self, f"{name}_points")
        if grid is None and points is None:
            message = f"missing, {why}, such as {{nx: 4, ny: 3}}, or a list as {name}_points."
            yield ValidationIssue((f"{name}_grid",), message)
        elif grid is not None and points is not None:
            message = f"stands beside {name}_grid: the points are a grid or a list; remove one of them."
            yield ValidationIssue((f"{name}_points",), message, "key")

    def rule_laser_spots(self) -> Iterator[ValidationIssue]:
        """Spots are lit at once, and share one pulse."""
        if self.laser_spots is None:
            for key in ("multiplex", "laser_spot_weights"):
                if getattr(self, key):
                    yield ValidationIssue((key,), "is for laser_spots, which are missing: a list [[x, y], ...].", "key")
            return
        if not self.multiplex:
            message = "are lit at once, into one histogram: set multiplex: true. One after the other they are the "
            yield ValidationIssue(("laser_spots",), f"{message}laser_points of scan_type: exhaustive.", "key")
        if self.laser_point is not None:
            yield ValidationIssue(("laser_point",), "stands beside laser_spots; remove one of them.", "key")
        if self.laser_spot_radius > 0:
            message = mismatch(self.laser_spot_radius, "0 with laser_spots, which are points")
            yield ValidationIssue(("laser_spot_radius",), message)
        spots, weights = self.spot_list, self.laser_spot_weights
        if spots is not None and weights is not None and len(weights) != len(spots):
            message = f"got {len(weights)} weights of {len(spots)} laser_spots, need one of each."
            yield ValidationIssue(("laser_spot_weights",), message)

    def rule_laser_flash(self) -> Iterator[ValidationIssue]:
        """A flash is neither spots nor a disc."""
        if self.laser_flash is None:
            return
        if self.laser_spots is not None:
            yield ValidationIssue(("laser_flash",), "stands beside laser_spots; remove one of them.", "key")
        if self.laser_spot_radius > 0:
            yield ValidationIssue(("laser_spot_radius",), mismatch(self.laser_spot_radius, "0 with laser_flash"))

    def rule_pixels(self) -> Iterator[ValidationIssue]:
        """The grid of a camera is its pixels."""
        camera, grid = self.camera, self.sensor_grid
        if grid is None or not (self.is_line_of_sight or camera is not None):
            return
        if grid.width or grid.height or (camera and (grid.nx, grid.ny) != (camera.width, camera.height)):
            message = "the sensor points of a capture with a camera are its pixels; remove it, and set "
            message += "capture.camera.width and height."
            yield ValidationIssue(("sensor_grid",), message, "key")

    @property
    def is_line_of_sight(self) -> bool:
        """Whether a camera sees the scene itself, not a relay wall."""
        return self.scan_type == "line_of_sight"

    @property
    def sensor_list(self) -> PointList | None:
        """The points of ``sensor_points``; None: a grid."""
        return None if self.sensor_points is None else point_list(self.sensor_points)

    @property
    def laser_list(self) -> PointList | None:
        """The points of ``laser_points``; None: a grid, or a single point."""
        return None if self.laser_points is None else point_list(self.laser_points)

    @property
    def spot_list(self) -> PointList | None:
        """The points of ``laser_spots``; None: the laser lights one point at a time."""
        return None if self.laser_spots is None else point_list(self.laser_spots)

    @property
    def sensor_key(self) -> str:
        """The key that the sensor points stand under."""
        return "sensor_grid" if self.sensor_points is None else "sensor_points"

    @property
    def n_sensors(self) -> int:
        """Number of sensor points."""
        return _count(self.sensor_grid, self.sensor_list)

    @property
    def n_lasers(self) -> int:
        """Number of laser points that have a histogram of their own; 1 for a confocal scan, whose pairs are fixed."""
        if self.scan_type == "exhaustive" and self.laser_grid is None and self.laser_points is None:  # of a camera
            return self.n_sensors if self.laser_targets is None else len(self.laser_targets)
        return _count(self.laser_grid, self.laser_list)


def _count(grid: GridConfig | None, points: PointList | None) -> int:
    return grid.n_points if grid is not None else 1 if points is None else len(points)


class TimeAxisConfig(Section):
    """The bins, in metres of optical path length (OPL)."""

    start_opl: Coordinate = 0.0
    """m, start of bin 0"""
    bin_width_opl: Length = 0.003
    """m; 0.003 is 10 ps"""
    n_bins: BinCount = "auto"
    """auto (up to the latest possible arrival) or an integer >= 1"""
