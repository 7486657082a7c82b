"""What a capture file says beside its samples: the description the writer is given."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.capture.bounces import FILE_BOUNCES, LINE_OF_SIGHT, first_bounce_of
from nlosrender.files.layout import CHUNK_SAMPLES, FRAMES, SCAN_TYPES, Float64, chunk_shape
from nlosrender.scene.pose import Pose

INT32_MAX = 2**31 - 1  # t is a 32-bit integer in the file
UNIT_TOLERANCE = 1e-6  # deviation of a normal's length from 1: float32 leaves 6e-8 per component


@dataclass(frozen=True, eq=False)
class CaptureHeader:
    """Everything of a capture but its samples, in the local frame (wall in z = 0, normal +z) and float64.

    Raises
    ------
    ValueError
        A field is impossible or contradicts another one; the message starts with the field's name.
    """

    scan_type: str  # one of ``layout.SCAN_TYPES``; the sensor points of ``line_of_sight`` are a camera's pixels
    sensor_positions: Float64  # (Ny, Nx, 3) sensor points [m]
    sensor_normals: Float64  # (Ny, Nx, 3) unit normals there
    laser_positions: Float64  # (Ly, Lx, 3) laser points [m]; (1, 1, 3) for ``single``, the sensor's for ``confocal``
    laser_normals: Float64
    sensor_position: Float64  # (3,) where the sensor stands [m]
    laser_position: Float64
    sensor_grid_size: tuple[float, float]  # width and height of the grid along the wall [m]
    laser_grid_size: tuple[float, float]
    n_bins: int
    bin_width_opl: float  # m of optical path
    start_opl: float  # where bin 0 starts [m of optical path]
    n_channels: int  # 1 (grey), 3 (red, green, blue) or 4 (Stokes components)
    bounce_indices: tuple[int, ...]  # of each in-memory bounce slot, on the file's bounce axis
    max_bounces: int | None  # highest bounce rendered; None: no limit
    split_bounces: bool  # whether bounces have indices of their own
    account_first_and_last_bounces: bool  # whether path lengths include the legs laser -> wall and wall -> sensor
    hidden_bounds: tuple[Float64, Float64] | None  # lowest and highest corner (3,) of the hidden geometry [m], if any
    pose: Pose  # of the local frame in the scene
    frame: str = "znlos"  # of the positions in the file, one of ``layout.FRAMES``
    planar_wall: bool = True
    empty_sensors: NDArray[np.bool_] | None = None  # (Ny, Nx) pixels that see nothing; None: there is no camera
    empty_lasers: NDArray[np.bool_] | None = None  # (Ly, Lx)
    n_unlit_lasers: int = 0  # that are hidden from the laser
    shared_samples: str = ""  # which samples have errors in common, in words: their variances may not be summed
    point_lists: tuple[str, ...] = ()  # which of "sensor" and "laser" points are a list, see ``layout.POINT_LISTS``
    # what H is the mean over, in words, and its area [m^2], None for pixels of a camera; None: points
    footprint: tuple[str, float | None] | None = None
    # (spots, 3) positions [m] and (spots,) shares of the pulse, sum 1, of spots that are lit at once;
    # ``laser_positions`` is their weighted middle then
    laser_spots: tuple[Float64, Float64] | None = None
    laser_flash: str = ""  # what the laser lights at once, in words; empty: points
    chunk_samples: int = CHUNK_SAMPLES  # of a chunk of the file at most

    def __post_init__(self) -> None:
        _require(self.scan_type in SCAN_TYPES, "scan_type", self.scan_type, f"one of {', '.join(SCAN_TYPES)}")
        _require(self.frame in FRAMES, "frame", self.frame, f"one of {', '.join(FRAMES)}")
        for name in ("sensor", "laser"):
            self._freeze_grid(name)
            self._freeze(f"{name}_position", _finite(getattr(self, f"{name}_position"), f"{name}_position", (3,)))
            size = _finite(getattr(self, f"{name}_grid_size"), f"{name}_grid_size", (2,))
            _require(bool((size >= 0).all()), f"{name}_grid_size", tuple(size.tolist()), "lengths >= 0")
            self._freeze(f"{name}_grid_size", (float(size[0]), float(size[1])))
        self._check_laser_grid()
        self._check_time_axis()
        self._check_bounces()
        self._check_hidden_bounds()

    @property
    def confocal(self) -> bool:
        """Whether laser and sensor point coincide, so that the file has no laser axes."""
        return self.scan_type == "confocal"

    @property
    def first_bounce(self) -> int:
        """The bounce that index 0 of the file's bounce axis holds."""
        return first_bounce_of(self.scan_type)

    @property
    def sizes(self) -> dict[str, int]:
        """Length of every in-memory axis, by name; confocal captures have 1 x 1 lasers."""
        laser_y, laser_x = (1, 1) if self.confocal else self.laser_positions.shape[:2]
        sensor_y, sensor_x = self.sensor_positions.shape[:2]
        return {
            "channel": self.n_channels,
            "bounce": len(self.bounce_indices),
            "laser_y": laser_y,
            "laser_x": laser_x,
            "sensor_y": sensor_y,
            "sensor_x": sensor_x,
            "bin": self.n_bins,
        }

    @property
    def chunks(self) -> tuple[int, ...]:
        """Shape of the chunks of ``data``, in the file's axis order."""
        return chunk_shape(self.sizes, self.confocal, self.chunk_samples)

    def bounce_name(self, slot: int) -> str:
        """Return what the in-memory bounce index ``slot`` holds, in words."""
        if not self.split_bounces:
            return "all bounces"
        index = self.bounce_indices[slot]
        bounce = index + self.first_bounce
        more = index == FILE_BOUNCES - 1 and (self.max_bounces is None or self.max_bounces > bounce)
        return f"bounce {bounce}" + (" and above" if more else "")

    def _freeze(self, name: str, value: object) -> None:
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(self, name, value)  # the dataclass is frozen: only its constructor may do this

    def _freeze_grid(self, name: str) -> None:
        positions_name, normals_name = f"{name}_positions", f"{name}_normals"
        positions = _finite(getattr(self, positions_name), positions_name)
        usable = positions.ndim == 3 and positions.shape[2] == 3 and positions.size > 0
        need = "shape (rows, columns, 3) with at least one point"
        _require(usable, positions_name, f"shape {positions.shape}", need)
        normals = _finite(getattr(self, normals_name), normals_name, positions.shape)
        lengths = np.linalg.norm(normals, axis=-1)
        worst = float(lengths.flat[int(np.argmax(np.abs(lengths - 1)))])
        _require(abs(worst - 1) <= UNIT_TOLERANCE, normals_name, f"a normal of length {worst:g}", "unit normals")
        self._freeze(positions_name, positions)
        self._freeze(normals_name, normals)

    def _check_laser_grid(self) -> None:
        rows, columns = self.laser_positions.shape[:2]
        if self.scan_type in ("single", LINE_OF_SIGHT):
            need = f"one (scan type {self.scan_type})"
            _require((rows, columns) == (1, 1), "laser_positions", f"{rows} x {columns} points", need)
        if self.confocal:
            same = np.array_equal(self.laser_positions, self.sensor_positions)
            _require(same, "laser_positions", "other points", "the sensor points (scan type confocal)")
            same = np.array_equal(self.laser_normals, self.sensor_normals)
            _require(same, "laser_normals", "other normals", "the sensor points' (scan type confocal)")

    def _check_time_axis(self) -> None:
        usable = _is_int(self.n_bins) and 1 <= self.n_bins <= INT32_MAX
        _require(usable, "n_bins", self.n_bins, "an integer from 1 to 2^31 - 1")
        for name in ("bin_width_opl", "start_opl"):
            self._freeze(name, float(_finite(getattr(self, name), name, ())))
        # float32, because that is what loaders read: a width that underflows there would be zero for all of them
        _require(bool(np.float32(self.bin_width_opl) > 0), "bin_width_opl", self.bin_width_opl, "a length > 0")

    def _check_bounces(self) -> None:
        need = "1 (grey), 3 (red, green, blue) or 4 (Stokes components)"
        _require(self.n_channels in (1, 3, 4), "n_channels", self.n_channels, need)
        indices, limit = tuple(self.bounce_indices), self.max_bounces
        ascending = len(indices) > 0 and all(a < b for a, b in pairwise(indices))
        inside = all(_is_int(index) and 0 <= index < FILE_BOUNCES for index in indices)
        need = f"ascending indices from 0 to {FILE_BOUNCES - 1}"
        _require(ascending and inside, "bounce_indices", indices, need)
        is_sum = self.split_bounces or len(indices) == 1
        _require(is_sum, "bounce_indices", indices, "one index when bounces are not split")
        self._freeze("bounce_indices", indices)
        usable = limit is None or (_is_int(limit) and limit >= self.first_bounce)
        _require(usable, "max_bounces", limit, f"None or an integer >= {self.first_bounce}")

    def _check_hidden_bounds(self) -> None:
        if self.hidden_bounds is not None:
            low, high = (_finite(corner, "hidden_bounds", (3,)) for corner in self.hidden_bounds)
            got = (low.tolist(), high.tolist())
            _require(bool((low <= high).all()), "hidden_bounds", got, "lowest corner <= highest corner")
            self._freeze("hidden_bounds", (low, high))


def _require(condition: bool, name: str, got: object, need: str) -> None:
    if not condition:
        raise ValueError(f"{name}: got {got}, need {need}")


def _is_int(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _finite(values: ArrayLike, name: str, shape: tuple[int, ...] | None = None) -> Float64:
    array = np.array(values, dtype=np.float64)
    if shape is not None:
        _require(array.shape == shape, name, f"shape {array.shape}", f"shape {shape}")
    _require(bool(np.isfinite(array).all()), name, "a value that is not finite", "finite numbers")
    fits = bool((np.abs(array) <= np.finfo(np.float32).max).all())  # of the file
    _require(fits, name, "a value beyond float32", "numbers below 3.4e38")
    return array
