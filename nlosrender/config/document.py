"""The root of the config, and the rules between its sections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Self

from pydantic import Field, PrivateAttr, ValidationInfo

from nlosrender.config.capture import CaptureConfig, TimeAxisConfig
from nlosrender.config.dataset_section import DatasetConfig
from nlosrender.config.fields import Name
from nlosrender.config.issues import WrongValueRead, mismatch, shown
from nlosrender.config.mitsuba_xml import read_mitsuba_xml
from nlosrender.config.plugin_check import config_folder
from nlosrender.config.point_list import off_the_wall
from nlosrender.config.relay_wall import EDGE_TOLERANCE, RectangleWallConfig
from nlosrender.config.render import OutputConfig, RenderConfig
from nlosrender.config.scene import SceneConfig
from nlosrender.config.section import Section
from nlosrender.config.sensor import SensorConfig, misfits
from nlosrender.config.sweep import SweepConfig
from nlosrender.errors import KeyPath, ValidationIssue

STOKES_COMPONENTS = 4
MAX_BINS = 2**40  # 4 TiB of float32: beyond it a grid or bin count is a slip of the pen
MIN_BOUNCES_OF_WALLS = 2  # laser point and sensor point


class Config(Section):
    """One capture: the whole YAML, validated, defaults filled in, frozen."""

    name: Name = "capture"
    """what the capture is called; default: the name of the YAML file"""
    scene: SceneConfig
    """what is rendered"""
    capture: CaptureConfig
    """which points are lit and measured"""
    time_axis: TimeAxisConfig = Field(default_factory=TimeAxisConfig)
    """the bins"""
    render: RenderConfig = Field(default_factory=lambda: RenderConfig.model_validate({}))
    """how it is computed"""
    output: OutputConfig = Field(default_factory=OutputConfig)
    """the file that is written"""
    sensor: SensorConfig | None = None
    """what a detector reports of it, beside the ideal histogram"""
    # never set here: sweep_load makes many configs of it. No part of the capture, so no part of its hash either.
    sweep: SweepConfig | None = Field(default=None, exclude=True)
    """many captures from this file: which keys take which values"""
    dataset: DatasetConfig | None = Field(default=None, exclude=True)
    """what the captures of a sweep become for training: splits, index, packages"""

    _notes: tuple[str, ...] = PrivateAttr(default=())  # what of the file has no effect

    def with_notes(self, notes: Iterable[str]) -> Self:
        """Return this config, which from now on knows what of its file has no effect."""
        self._notes = (*self._notes, *notes)
        return self

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each choice that leaves keys of the file without effect."""
        return self._notes

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Fill in names, and grids that the scene gives."""
        filled = {"name": (validation.context or {}).get("stem", "capture"), **raw}
        output = filled.get("output", {})
        if isinstance(output, Mapping) and isinstance(filled["name"], str):
            path = output.get("path", "{name}.hdf5")
            path = path.replace("{name}", filled["name"]) if isinstance(path, str) else path
            filled["output"] = {**output, "path": path}
        return _film_of_scene(_grids_on_patch(filled), validation)

    # --- captures with a camera ---

    def rule_camera(self) -> Iterator[ValidationIssue]:
        """There is one, here or in the Mitsuba scene."""
        mitsuba = self.scene.mitsuba
        if self.capture.camera is not None or not (self.capture.is_line_of_sight or mitsuba is not None):
            return
        path, example = (
            ("capture", "camera"),
            "such as {position: [0, 1, 4], look_at: [0, 1, 0], width: 64, height: 64}.",
        )
        if mitsuba is None:
            yield ValidationIssue(path, f"missing, a line_of_sight capture needs it, {example}")
        elif read_mitsuba_xml(mitsuba)[1] is None:
            lacking = f"{mitsuba.name} has no perspective sensor with a whole film"
            yield ValidationIssue(path, f"missing, and {lacking}; need a camera, {example}")

    def rule_plain_paths(self) -> Iterator[ValidationIssue]:
        """A camera has neither virtual lights, which are on a relay wall, nor a kernel in time."""
        if not self.capture.is_line_of_sight:
            return
        if self.render.engine == "virtual_lights":
            message = "got virtual_lights, which need a relay wall; a line_of_sight capture needs auto or path."
            yield ValidationIssue(("render", "engine"), message)
        if self.render.temporal_kernel_opl > 0:
            message = mismatch(self.render.temporal_kernel_opl, "0: a line_of_sight capture has plain bins")
            yield ValidationIssue(("render", "temporal_kernel_opl"), message)

    def rule_ground_truth(self) -> Iterator[ValidationIssue]:
        """It is seen from a relay wall."""
        if self.output.ground_truth and (self.capture.is_line_of_sight or self.has_pixel_points):
            message = "is seen from a grid on a relay wall, and a capture with a camera has none; remove it."
            yield ValidationIssue(("output", "ground_truth"), message, "key")
        if "occupancy" in self.output.ground_truth and self.capture.sensor_points and not self.output.ground_truth_grid:
            message = "occupancy needs a grid, and the sensor points are a list; give output.ground_truth_grid."
            yield ValidationIssue(("output", "ground_truth"), message)

    def rule_pixel_points(self) -> Iterator[ValidationIssue]:
        """Laser and sensor of a scan whose points a camera sees: what they need, and what is for relay walls."""
        capture = self.capture
        if not self.has_pixel_points:
            for key in ("pixel_point", "laser_target", "laser_targets"):
                if getattr(capture, key) is not None:
                    message = "is for scans with a camera; a grid on a relay wall has laser_point or laser_grid."
                    yield ValidationIssue(("capture", key), message, "key")
            if capture.footprint is not None and capture.footprint.pixel:
                message = "is for scans with a camera; around points on a relay wall need radius or box."
                yield ValidationIssue(("capture", "footprint", "pixel"), message, "key")
            return
        if capture.pixel_point is not None and not all(0 <= share <= 1 for share in capture.pixel_point):
            message = mismatch(capture.pixel_point, "two numbers from 0 to 1", "[0.5, 0.5] is the pixel's centre.")
            yield ValidationIssue(("capture", "pixel_point"), message)
        if capture.scan_type == "single" and capture.laser_target is None:
            message = "missing, the laser of a single scan with a camera needs it, such as [0, 0, 0]: the point it is "
            yield ValidationIssue(("capture", "laser_target"), f"{message}aimed at from capture.laser_position.")
        if capture.laser_targets is not None and not capture.laser_targets:
            message = mismatch([], "at least one point, or null for the points of the camera's pixels")
            yield ValidationIssue(("capture", "laser_targets"), message)
        needs = "the points of a camera lie on any surface; need a grid on a rectangle relay wall."
        if capture.laser_spot_radius > 0:
            message = f"got {shown(capture.laser_spot_radius)}, and {needs.replace('need', 'need 0, or')}"
            yield ValidationIssue(("capture", "laser_spot_radius"), message)
        if capture.footprint is not None and not capture.footprint.pixel:
            message = f"got one in metres, and {needs} With a camera: {{pixel: true}}."
            yield ValidationIssue(("capture", "footprint"), message)
        for key in ("laser_spots", "laser_flash"):
            if getattr(capture, key) is not None:
                yield ValidationIssue(("capture", key), f"got some, and {needs}")
        if self.render.polarized:
            yield ValidationIssue(("render", "polarized"), f"got true, and {needs}")

    # --- captures of a relay wall ---

    def rule_relay_wall(self) -> Iterator[ValidationIssue]:
        """There is one."""
        if self.scene.relay_wall is None and not self.capture.is_line_of_sight and not self.has_pixel_points:
            message = "missing, it is required: the visible surface, told by its type; "
            message += "only captures with a capture.camera, such as scan_type: line_of_sight, do without."
            yield ValidationIssue(("scene", "relay_wall"), message)

    def rule_points_on_the_wall(self) -> Iterator[ValidationIssue]:
        """A scan measures a grid or a list, and an exhaustive one lights one."""
        if self.capture.is_line_of_sight or self.has_pixel_points:
            return
        found = [*self.capture.one_of("sensor", "it is required: the measured points")]
        if self.capture.scan_type == "exhaustive":
            found += self.capture.one_of("laser", "an exhaustive scan needs it")
        for issue in found:
            yield ValidationIssue(("capture", *issue.path), issue.message, issue.at)

    def rule_polarized(self) -> Iterator[ValidationIssue]:
        """Polarised light is for paths from a point of a rectangle."""
        if not self.render.polarized or self.capture.is_line_of_sight:
            return
        path: KeyPath = ("render", "polarized")
        if self.render.engine == "virtual_lights":
            message = "got virtual_lights, which know no polarisation; with render.polarized need auto or path."
            yield ValidationIssue(("render", "engine"), message)
        if self.capture.laser_spot_radius > 0:
            message = "got true with a laser that has a spot; polarised light needs capture.laser_spot_radius: 0."
            yield ValidationIssue(path, message)
        wall = self.scene.relay_wall
        if wall is not None and wall.type != "rectangle":
            message = f"got true before a {wall.type} wall; polarised light needs a rectangle relay wall."
            yield ValidationIssue(path, message)

    def rule_grids_on_the_wall(self) -> Iterator[ValidationIssue]:
        """Grids are no larger than the wall."""
        wall = self.scene.relay_wall
        for key, axis in (("sensor_grid", 0), ("sensor_grid", 1), ("laser_grid", 0), ("laser_grid", 1)):
            name = ("width", "height")[axis]
            with suppress(WrongValueRead):
                grid = getattr(self.capture, key)
                size = getattr(grid, name) if grid is not None else None
                if wall is None or size is None or size == getattr(wall, name, None):  # the wall's own is told there
                    continue
                if size > wall.extent[axis] * (1 + EDGE_TOLERANCE):
                    need = f"at most {wall.extent[axis]:.6g} m, the {name} of the {wall.type} relay wall"
                    yield ValidationIssue(("capture", key, name), f"got {shown(size)} m, need {need}.")

    def rule_laser_point_on_the_wall(self) -> Iterator[ValidationIssue]:
        """The laser point is on the wall."""
        if (wall := self.scene.relay_wall) is None:
            return
        point, (width, height) = self.capture.laser_point or (0.0, 0.0), wall.extent
        if any(abs(x) > size / 2 * (1 + EDGE_TOLERANCE) for x, size in zip(point, wall.extent, strict=True)):
            message = (
                f"got {shown(point)}, off the relay wall; need x from {-width / 2:.6g} to {width / 2:.6g} m "
                f"and y from {-height / 2:.6g} to {height / 2:.6g} m."
            )
            yield ValidationIssue(("capture", "laser_point"), message)

    def rule_lists_on_the_wall(self) -> Iterator[ValidationIssue]:
        """Points of lists are on the wall."""
        if (wall := self.scene.relay_wall) is None or self.capture.is_line_of_sight:
            return
        for name, key in (("sensor", "sensor_points"), ("laser", "laser_points"), ("spot", "laser_spots")):
            with suppress(WrongValueRead):
                points = getattr(self.capture, f"{name}_list")
                for issue in () if points is None else off_the_wall(points, wall.extent, EDGE_TOLERANCE):
                    yield issue.below(("capture", key))

    def rule_devices_before_the_wall(self) -> Iterator[ValidationIssue]:
        """Laser and sensor stand on the lit side of a flat wall."""
        wall = self.scene.relay_wall
        if not isinstance(wall, RectangleWallConfig) or self.has_pixel_points:
            return
        for key in ("laser_position", "sensor_position"):
            with suppress(WrongValueRead):
                position = getattr(self.capture, key)
                height = 1.0 if position is None else wall.height_above(position)
                if height <= 0:
                    where = f"{-height:.6g} m behind the relay wall" if height else "in the plane of the relay wall"
                    message = f"got {shown(position)}, {where}; need a point on the side its normal looks to."
                    yield ValidationIssue(("capture", key), message)

    def rule_spot_on_the_wall(self) -> Iterator[ValidationIssue]:
        """A laser spot is on a rectangle."""
        radius, wall = self.capture.laser_spot_radius, self.scene.relay_wall
        if radius > 0 and wall and wall.type != "rectangle":
            message = f"got {shown(radius)} on a {wall.type} wall; need 0 there, or a rectangle wall."
            yield ValidationIssue(("capture", "laser_spot_radius"), message)

    def rule_footprint_on_the_wall(self) -> Iterator[ValidationIssue]:
        """Footprints lie on a rectangle wall, whole."""
        footprint, wall = self.capture.footprint, self.scene.relay_wall
        if footprint is None or wall is None or self.capture.is_line_of_sight or self.has_pixel_points:
            return
        path: KeyPath = ("capture", "footprint")
        if wall.type != "rectangle":
            yield ValidationIssue(path, f"got one on a {wall.type} wall; need none there, or a rectangle wall.")
            return
        if self.render.polarized:
            yield ValidationIssue(path, "got one with render.polarized, whose sensors are points; need one of them.")
        for axis, (name, reach) in enumerate(
            zip(("width", "height"), self._reach_of_sensors(wall.extent), strict=True)
        ):
            size, left = footprint.extent[axis], wall.extent[axis] - 2 * reach
            if size > left + wall.extent[axis] * EDGE_TOLERANCE:
                message = f"got a {name} of {size:.6g} m, which leaves the wall: the outermost sensor points are "
                message += (
                    f"{left / 2:.6g} m from its edge; need at most {max(left, 0.0):.6g} m, or points farther inside."
                )
                yield ValidationIssue(path, message)

    def _reach_of_sensors(self, extent: tuple[float, float]) -> tuple[float, float]:
        """Return how far the sensor points are from the wall's centre along its axes [m]."""
        grid, listed = self.capture.sensor_grid, self.capture.sensor_list
        if listed is not None:
            across, up = abs(listed.xy).max(axis=0).tolist()
            return across, up
        if grid is None:
            return 0.0, 0.0
        sizes = (grid.width or extent[0]) / 2, (grid.height or extent[1]) / 2
        return sizes[0] * (1 - 1 / grid.nx), sizes[1] * (1 - 1 / grid.ny)

    def rule_flash_on_the_wall(self) -> Iterator[ValidationIssue]:
        """A flash lights a rectangle, and has no polarisation."""
        wall = self.scene.relay_wall
        if self.capture.laser_flash is None or wall is None:
            return
        if wall.type != "rectangle":
            message = f"got one on a {wall.type} wall; need none there, or a rectangle wall."
            yield ValidationIssue(("capture", "laser_flash"), message)
        if self.render.polarized:
            message = "got one with render.polarized, whose laser is a point; need one of them."
            yield ValidationIssue(("capture", "laser_flash"), message)

    def rule_laser_can_be_found(self) -> Iterator[ValidationIssue]:
        """Paths find a point by sampling it alone."""
        is_point = self.capture.laser_spot_radius == 0 and not self.capture.is_line_of_sight
        if not self.render.laser_sampling and is_point and (self.scene.relay_wall or self.has_pixel_points):
            message = "got false with a laser that is a point, which no path finds by chance; "
            message += "need capture.laser_spot_radius > 0, such as 0.01."
            yield ValidationIssue(("render", "laser_sampling"), message)

    def rule_sensor(self) -> Iterator[ValidationIssue]:
        """The detector can look at the capture."""
        if self.sensor is not None:
            for key, message in misfits(self.sensor, self.capture.scan_type):
                yield ValidationIssue(("sensor", key), message)
            if self.sensor.zones is not None and self.has_pixel_points:
                message = "add up the cells of a grid on a wall; points that a camera sees have none. Remove it."
                yield ValidationIssue(("sensor", "zones"), message, "key")

    # --- all captures ---

    def rule_enough_bounces(self) -> Iterator[ValidationIssue]:
        """Light gets from the source to the sensor."""
        bounces, is_view = self.render.max_bounces, self.capture.is_line_of_sight
        fewest = 0 if is_view else MIN_BOUNCES_OF_WALLS
        if bounces is not None and bounces < fewest:
            advice = "0 is the emitters alone, 1 what they light." if is_view else "3 is the third bounce."
            message = mismatch(bounces, f"an integer >= {fewest} or null for no limit", advice)
            yield ValidationIssue(("render", "max_bounces"), message)

    def rule_bins(self) -> Iterator[ValidationIssue]:
        """The capture fits a disk."""
        is_view, n_bins = self.capture.is_line_of_sight, self.time_axis.n_bins
        pairs = self.capture.n_sensors * self.capture.n_lasers
        per_pair = 1 if n_bins == "auto" else n_bins
        if pairs * per_pair > MAX_BINS:
            grid = ("capture", "camera" if is_view else self.capture.sensor_key)
            path: KeyPath = ("time_axis", "n_bins") if pairs <= MAX_BINS else grid
            counted = "pixels" if is_view else "pairs of laser and sensor points"
            message = f"got {pairs:_} {counted} with {per_pair:_} bins each, need at most 2**40 bins in all. "
            yield ValidationIssue(path, f"{message}Use fewer {counted.split()[-1]} or bins.")

    @property
    def has_pixel_points(self) -> bool:
        """Whether a camera sees laser and sensor points: its pixels' first surfaces, instead of a grid on the wall."""
        with_camera = self.capture.camera is not None or self.scene.mitsuba is not None
        return with_camera and not self.capture.is_line_of_sight

    @property
    def is_colored(self) -> bool:
        """Whether three channels are rendered: ``render.color``, or for ``auto`` what the scene needs."""
        if self.render.polarized:
            return False
        return self.render.color == "rgb" or (self.render.color == "auto" and self.scene.is_colored)

    @property
    def n_channels(self) -> int:
        """Channels that are rendered: grey, three colours or four Stokes components."""
        return STOKES_COMPONENTS if self.render.polarized else 3 if self.is_colored else 1


def _film_of_scene(raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
    """Make the film of a Mitsuba scene the sensor grid where no camera is given."""
    name, capture = _mapping(raw, "scene").get("mitsuba"), _mapping(raw, "capture")
    has_pixels = capture.get("camera") is not None or "sensor_grid" in capture
    if not isinstance(name, str) or has_pixels:
        return raw
    try:
        _, size = read_mitsuba_xml(config_folder(validation) / name)
    except ValueError:  # the scene's own issue, told with its place
        return raw
    grid = {} if size is None else {"sensor_grid": {"nx": size[0], "ny": size[1]}}
    return {**raw, "capture": {**capture, **grid}}


def _grids_on_patch(raw: dict[str, Any]) -> dict[str, Any]:
    """Give grids without an extent the ``width`` and ``height`` of a sphere wall, whose whole is rarely meant."""
    wall, capture = _mapping(_mapping(raw, "scene"), "relay_wall"), _mapping(raw, "capture")
    grids = {key: capture[key] for key in ("sensor_grid", "laser_grid") if isinstance(capture.get(key), Mapping)}
    if wall.get("type") != "sphere" or not grids:
        return raw
    patch = {axis: wall[axis] for axis in ("width", "height") if wall.get(axis) is not None}
    on_patch = {
        key: grid | {axis: size for axis, size in patch.items() if grid.get(axis) is None}
        for key, grid in grids.items()
    }
    return {**raw, "capture": {**capture, **on_patch}}


def _mapping(raw: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    return raw[key] if isinstance(raw.get(key), Mapping) else {}
