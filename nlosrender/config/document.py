"""The root of the config, and the rules between its sections."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Self

from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, ValidationInfo, model_validator

from nlosrender.config.capture import CaptureConfig, TimeAxisConfig
from nlosrender.config.fields import Name
from nlosrender.config.idle_keys import without_idle_keys
from nlosrender.config.line_of_sight import line_of_sight_faults, relay_wall_faults
from nlosrender.config.mitsuba_xml import read_mitsuba_xml
from nlosrender.config.plugin_check import config_folder
from nlosrender.config.refusal import Fault, shown
from nlosrender.config.relay_wall import EDGE_TOLERANCE, RelayWallConfig
from nlosrender.config.render import OutputConfig, RenderConfig
from nlosrender.config.scene import SceneConfig
from nlosrender.config.section import Section
from nlosrender.config.sweep import SweepConfig
from nlosrender.errors import KeyPath

STOKES_COMPONENTS = 4
MAX_BINS = 2**40  # 4 TiB of float32: beyond it a grid or bin count is a slip of the pen
_WALL: KeyPath = ("scene", "relay_wall")
_WALL_SHAPE = tuple((*_WALL, key) for key in ("type", "width", "height", "radius", "center", "normal"))
_LASER_GRID: KeyPath = ("capture", "laser_grid")


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
    # never set here: sweep_load makes many configs of it. No part of the capture, so no part of its hash either.
    sweep: SweepConfig | None = Field(default=None, exclude=True)
    """many captures from this file: which keys take which values"""

    _notes: tuple[str, ...] = PrivateAttr(default=())  # what of the file has no effect

    @model_validator(mode="wrap")
    @classmethod
    def _leave_out_idle_keys(cls, raw: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(raw, Mapping):
            return handler(raw)
        kept, notes = without_idle_keys(raw)
        config = handler(kept)
        return config.noting(notes)

    def noting(self, notes: Iterable[str]) -> Self:
        """Return this config, which from now on knows what of its file has no effect."""
        self._notes = (*self._notes, *notes)
        return self

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each choice that leaves keys of the file without effect."""
        return self._notes

    @model_validator(mode="before")
    @classmethod
    def _default_names(cls, raw: Any, validation: ValidationInfo) -> Any:
        if not isinstance(raw, Mapping):
            return raw
        stem = validation.context.get("stem", "capture") if validation.context else "capture"
        filled = {"name": stem, **raw}
        output = filled.get("output", {})
        if isinstance(output, Mapping) and isinstance(filled["name"], str):
            path = output.get("path", "{name}.hdf5")
            path = path.replace("{name}", filled["name"]) if isinstance(path, str) else path
            filled["output"] = {**output, "path": path}
        return _film_of_scene(_grids_on_patch(filled), validation)

    def rules(self) -> Iterator[Fault]:
        """Yield the faults between sections."""
        if self.capture.is_line_of_sight:
            yield from line_of_sight_faults(self.scene, self.capture, self.render)
        else:
            yield from relay_wall_faults(self.scene, self.capture, self.render)
            if self.scene.relay_wall is not None:
                yield from self._points_off_the_wall(self.scene.relay_wall)
                yield from self._devices_behind_the_wall(self.scene.relay_wall)
                yield from self._laser_spot(self.scene.relay_wall)
        pairs = self.capture.sensor_grid.n_points * self.capture.n_lasers
        n_bins = 1 if self.time_axis.n_bins == "auto" else self.time_axis.n_bins
        if pairs * n_bins > MAX_BINS:
            grid = ("capture", "camera" if self.capture.is_line_of_sight else "sensor_grid")
            path: KeyPath = ("time_axis", "n_bins") if pairs <= MAX_BINS else grid
            counted = "pixels" if self.capture.is_line_of_sight else "pairs of laser and sensor points"
            message = (
                f"got {pairs:_} {counted} with {n_bins:_} bins each, need at most 2**40 bins in all. Use fewer "
                f"{counted.split()[-1]} or bins."
            )
            yield Fault(path, message, needs=(("time_axis", "n_bins"), grid, _LASER_GRID))

    def _points_off_the_wall(self, relay_wall: RelayWallConfig) -> Iterator[Fault]:
        extent, wall = relay_wall.extent, relay_wall.type
        grids = {"sensor_grid": self.capture.sensor_grid, "laser_grid": self.capture.laser_grid}
        for key, grid in grids.items():
            sizes = (grid.width, grid.height) if grid else (None, None)
            for axis, size, largest in zip(("width", "height"), sizes, extent, strict=True):
                if size is not None and size > largest * (1 + EDGE_TOLERANCE):
                    message = f"got {shown(size)} m, need at most {largest:.6g} m, the {axis} of the {wall} relay wall."
                    path: KeyPath = ("capture", key, axis)
                    yield Fault(path, message, needs=(path, *_WALL_SHAPE))
        point = self.capture.laser_point or (0.0, 0.0)
        if any(abs(x) > size / 2 * (1 + EDGE_TOLERANCE) for x, size in zip(point, extent, strict=True)):
            message = (
                f"got {shown(point)}, off the relay wall; need x from {-extent[0] / 2:.6g} to {extent[0] / 2:.6g} m "
                f"and y from {-extent[1] / 2:.6g} to {extent[1] / 2:.6g} m."
            )
            yield Fault(("capture", "laser_point"), message, needs=(("capture", "laser_point"), *_WALL_SHAPE))

    def _devices_behind_the_wall(self, wall: RelayWallConfig) -> Iterator[Fault]:
        if wall.type != "rectangle":
            return
        for key in ("laser_position", "sensor_position"):
            position = getattr(self.capture, key)
            if position is None:
                continue
            height = wall.height_above(position)
            if height <= 0:
                where = f"{-height:.6g} m behind the relay wall" if height < 0 else "in the plane of the relay wall"
                message = f"got {shown(position)}, {where}; need a point on the side its normal looks to."
                yield Fault(("capture", key), message, needs=(("capture", key), *_WALL_SHAPE))

    def _laser_spot(self, wall: RelayWallConfig) -> Iterator[Fault]:
        path: KeyPath = ("capture", "laser_spot_radius")
        radius = self.capture.laser_spot_radius
        if radius > 0 and wall.type != "rectangle":
            message = f"got {shown(radius)} on a {wall.type} wall; need 0 there, or a rectangle wall."
            yield Fault(path, message, needs=(path, (*_WALL, "type")))
        if not self.render.laser_sampling and radius == 0:
            message = "got false with a laser that is a point, which no path finds by chance; "
            message += "need capture.laser_spot_radius > 0, such as 0.01."
            key: KeyPath = ("render", "laser_sampling")
            yield Fault(key, message, needs=(path, key))

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
    scene, capture = raw.get("scene"), raw.get("capture")
    name = scene.get("mitsuba") if isinstance(scene, Mapping) else None
    if not isinstance(name, str) or not isinstance(capture, Mapping) or capture.get("camera") is not None:
        return raw
    if capture.get("scan_type") != "line_of_sight" or "sensor_grid" in capture:
        return raw
    try:
        _, size = read_mitsuba_xml(config_folder(validation) / name)
    except ValueError:  # the scene's own fault, told with its place
        return raw
    grid = {} if size is None else {"sensor_grid": {"nx": size[0], "ny": size[1]}}
    return {**raw, "capture": {**capture, **grid}}


def _grids_on_patch(raw: dict[str, Any]) -> dict[str, Any]:
    """Give grids without an extent the ``width`` and ``height`` of a sphere wall, whose whole is rarely meant."""
    scene, capture = raw.get("scene"), raw.get("capture")
    wall = scene.get("relay_wall") if isinstance(scene, Mapping) else None
    if not isinstance(wall, Mapping) or wall.get("type") != "sphere" or not isinstance(capture, Mapping):
        return raw
    patch = {key: wall[key] for key in ("width", "height") if wall.get(key) is not None}
    changed = {
        key: {**grid, **{axis: size for axis, size in patch.items() if grid.get(axis) is None}}
        for key in ("sensor_grid", "laser_grid")
        if isinstance(grid := capture.get(key), Mapping)
    }
    return {**raw, "capture": {**capture, **changed}}
