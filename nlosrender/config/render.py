"""``render`` and ``output``: how it is computed and where it goes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ValidationInfo

from nlosrender.config.fields import (
    BounceCount,
    Checked,
    Flag,
    GridCount,
    Length,
    LengthOrZero,
    MemoryLimit,
    OpenUnit,
    Positive,
    SampleCount,
    Seed,
    memory_bytes,
)
from nlosrender.config.issues import invalid_value, mismatch, shown
from nlosrender.config.section import LIST, ONE_OF, Section
from nlosrender.errors import ValidationIssue

_STOPPING = ("spp", "target_error", "time_limit_s")
DEFAULT_TARGET_ERROR = 0.05


def _output_path(value: object) -> Path:
    if not isinstance(value, str) or not value.strip() or any(ord(character) < 32 for character in value):
        raise invalid_value(value, "the name of the file to write", "Leave it out for <name>.hdf5.")
    if value.endswith(("/", "\\")) or Path(value).name in ("", "..", "."):
        raise invalid_value(value, "the name of a file, not of a folder")
    return Path(value)


OutputPath = Annotated[Path, Checked(_output_path, {"type": "string", "minLength": 1})]


class RenderConfig(Section):
    """What is computed, how well, and on what."""

    engine: Annotated[Literal["auto", "path", "virtual_lights"], ONE_OF] = "auto"
    """auto: the cheapest engine right for the scene; path: path tracer; virtual_lights: third bounce without noise"""
    max_bounces: BounceCount | None = 7
    """highest bounce, counting both points on the wall: 3 is the third bounce; null: no limit; line_of_sight: number
    of surface interactions, from 0"""
    split_bounces: Flag = True
    """give each bounce an index of its own in the file; false: all in index 1"""
    spp: SampleCount | None = None
    """paths per pair of laser and sensor point; excludes target_error"""
    target_error: OpenUnit | None = None
    """relative L2 error of H to stop at; default 0.05 when neither spp nor time_limit_s is given"""
    time_limit_s: Positive | None = None
    """s, stop after this time"""
    laser_sampling: Flag = True
    """connect paths to the laser point; false: find the laser spot by chance (needs capture.laser_spot_radius)"""
    hidden_geometry_sampling: Flag = True
    """sample points on the hidden geometry beside the BSDF"""
    temporal_kernel_opl: LengthOrZero = 0.0
    """m of optical path, full width of a kernel that spreads each path in time: less noise, a bias; 0: a histogram"""
    russian_roulette: Flag = True
    """end paths of low weight early, without bias; the walks of virtual lights always end so"""
    seed: Seed = 0
    """start of the random numbers; the same seed gives the same file"""
    backend: Annotated[Literal["auto", "llvm", "cuda"], ONE_OF] = "auto"
    """llvm: processor, cuda: NVIDIA GPU, auto: the GPU where there is one"""
    color: Annotated[Literal["auto", "grey", "rgb"], ONE_OF] = "auto"
    """auto: three channels only when the scene has colours"""
    polarized: Flag = False
    """four grey channels, the Stokes components I, Q, U, V, instead of colours"""
    memory_limit: MemoryLimit = "auto"
    """auto, or a size such as 600MB, 8GB, 2GiB"""

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Stop at an error where nothing says when to stop."""
        unbounded = all(raw.get(key) is None for key in _STOPPING)
        return {**raw, "target_error": DEFAULT_TARGET_ERROR} if unbounded else raw

    def rule_goals(self) -> Iterator[ValidationIssue]:
        """There is one goal."""
        if self.spp is not None and self.target_error is not None:
            message = f"got {shown(self.target_error)} beside spp {self.spp}; they exclude each other, keep one."
            yield ValidationIssue(("target_error",), message, "key")

    def rule_polarized(self) -> Iterator[ValidationIssue]:
        """Polarised light is grey."""
        if self.polarized and self.color == "rgb":
            message = "got true beside color rgb; polarised light is rendered in grey: use color auto or grey."
            yield ValidationIssue(("polarized",), message, "key")

    @property
    def memory_limit_bytes(self) -> int | None:
        """Memory the render may use [bytes]; None: the engine decides."""
        return memory_bytes(self.memory_limit)


TruthKind = Literal["depth", "normal", "albedo", "position", "instance", "occupancy", "poses"]


class TruthGridConfig(Section):
    """Points and voxels of the ground truth; they cover what the sensor grid covers."""

    nx: GridCount
    """points along the wall's x axis"""
    ny: GridCount
    """points along the wall's y axis"""
    nz: GridCount | None = None
    """voxels along the wall's normal; null: as many as nx"""
    near: LengthOrZero | None = None
    """m from the wall, where voxels begin; null: where the hidden geometry does"""
    far: Length | None = None
    """m from the wall, where voxels end; null: where the hidden geometry does"""

    def rule_depths(self) -> Iterator[ValidationIssue]:
        """There is room between near and far."""
        if self.near is not None and self.far is not None and not self.near < self.far:
            yield ValidationIssue(("far",), mismatch(self.far, f"more than near, {self.near:g} m"))


class OutputConfig(Section):
    """The file that is written."""

    path: OutputPath = Path("capture.hdf5")
    """default <name>.hdf5; relative to the current directory; {name} in it is the capture's name"""
    format: Annotated[Literal["znlos"], ONE_OF] = "znlos"
    """znlos: the HDF5 layout of the Z-NLOS dataset"""
    frame: Annotated[Literal["znlos", "scene"], ONE_OF] = "znlos"
    """coordinates in the file: znlos: wall in y = 0, hidden scene at y < 0; scene: as in the config"""
    compression: Annotated[Literal["gzip", "none"], ONE_OF] = "gzip"
    """gzip (with shuffle) or none"""
    variance: Flag = True
    """store the variance of the estimate per bin"""
    ground_truth: Annotated[tuple[Annotated[TruthKind, ONE_OF], ...], LIST] = ()
    """what of the hidden scene is stored beside the light, any of: depth, normal, albedo, position, instance,
    occupancy, poses"""
    ground_truth_grid: TruthGridConfig | None = None
    """its points; null: the sensor points. Of sensor_points, a list, it covers the whole wall"""
