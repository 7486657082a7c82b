"""``capture`` and ``time_axis``: which points are lit and measured, and when."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from pydantic import model_validator

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
from nlosrender.config.refusal import Fault
from nlosrender.config.section import Section

ScanType = Literal["single", "confocal", "exhaustive"]


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

    scan_type: ScanType
    """single: one laser point; confocal: laser and sensor on the same point; exhaustive: every pair"""
    sensor_grid: GridConfig
    """the measured points"""
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
    """count the legs laser to wall and wall to sensor in the path length"""

    @model_validator(mode="before")
    @classmethod
    def _default_laser_point(cls, raw: Any) -> Any:
        is_single = isinstance(raw, Mapping) and raw.get("scan_type") == "single"
        return {**raw, "laser_point": [0.0, 0.0]} if is_single and raw.get("laser_point") is None else raw

    def rules(self) -> Iterator[Fault]:
        """Yield the faults of laser points that do not fit the scan type."""
        if self.scan_type == "exhaustive" and self.laser_grid is None:
            message = "missing, an exhaustive scan needs it, such as {nx: 4, ny: 3}."
            yield Fault(("laser_grid",), message, needs=(("scan_type",), ("laser_grid",)))
        if self.scan_type != "exhaustive" and self.laser_grid is not None:
            instead = "laser_point" if self.scan_type == "single" else "sensor_grid alone: each point is lit in turn"
            message = f"a {self.scan_type} scan has no laser grid; use {instead}, or scan_type: exhaustive."
            yield Fault(("laser_grid",), message, "key", (("scan_type",),))
        if self.scan_type != "single" and self.laser_point is not None:
            message = f"a laser point is for scan_type: single, got {self.scan_type}; remove one of the two."
            yield Fault(("laser_point",), message, "key", (("scan_type",),))

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
