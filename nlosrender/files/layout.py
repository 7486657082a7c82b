"""The Z-NLOS HDF5 layout (Galindo et al. 2019), declared once as data.

The writer creates what is listed here, the reader looks for it and the validation checks it. Shapes are as h5py
shows them. The class of a number (floating point or integer) is part of the layout: C++ loaders choose the type
they read into by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import ceil, isqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FILE_BOUNCES, LINE_OF_SIGHT
from nlosrender.scene.pose import Pose

Float64 = NDArray[np.float64]
T = TypeVar("T")

FORMAT_VERSION = 1  # of the attributes this program adds; the layout itself has no version
FLOAT = "<f4"
INTEGER = "<i4"
SCAN_TYPES = ("single", "confocal", "exhaustive", LINE_OF_SIGHT)
FRAMES = ("znlos", "scene")

MEMORY_AXES = ("channel", "bounce", "laser_y", "laser_x", "sensor_y", "sensor_x", "bin")
CONFOCAL_AXES = ("channel", "bin", "bounce", "sensor_y", "sensor_x")
PAIR_AXES = (*CONFOCAL_AXES, "laser_y", "laser_x")  # single and exhaustive captures

THREE = 3  # coordinates of a position
CHUNK_SAMPLES = 262_144  # 1 MiB of float32


@dataclass(frozen=True)
class DatasetSpec:
    """One dataset at the root of a file."""

    name: str
    dtype: str  # FLOAT or INTEGER, little-endian 32 bit
    shape: tuple[str | int, ...]  # names of axes (their length is meant) or fixed lengths
    meaning: str
    unit: str = ""


DATA = "data"
COUNTS = "counts"  # what a detector counts of data, beside it
SUMMED_INDEX = 1  # of the bounce axis, for the sum of all: where every loader looks
VARIANCE = "variance"

DATASETS: tuple[DatasetSpec, ...] = (
    DatasetSpec("cameraGridPositions", FLOAT, (THREE, "sensor_y", "sensor_x"), "sensor points on the relay wall", "m"),
    DatasetSpec("cameraGridNormals", FLOAT, (THREE, "sensor_y", "sensor_x"), "unit normals at the sensor points"),
    DatasetSpec("laserGridPositions", FLOAT, (THREE, "laser_y", "laser_x"), "laser points on the relay wall", "m"),
    DatasetSpec("laserGridNormals", FLOAT, (THREE, "laser_y", "laser_x"), "unit normals at the laser points"),
    DatasetSpec("cameraPosition", FLOAT, (3,), "position of the sensor", "m"),
    DatasetSpec("laserPosition", FLOAT, (3,), "position of the laser", "m"),
    DatasetSpec("cameraGridSize", FLOAT, (2,), "width and height of the sensor grid along the wall", "m"),
    DatasetSpec("laserGridSize", FLOAT, (2,), "width and height of the laser grid along the wall", "m"),
    DatasetSpec("cameraGridPoints", FLOAT, (2,), "number of sensor points (Nx, Ny)"),
    DatasetSpec("laserGridPoints", FLOAT, (2,), "number of laser points (Lx, Ly)"),
    DatasetSpec("t", INTEGER, (), "number of bins"),
    DatasetSpec("t0", FLOAT, (), "optical path length at the start of bin 0", "m"),
    DatasetSpec("deltaT", FLOAT, (), "width of a bin in optical path length", "m"),
    DatasetSpec("hiddenVolumePosition", FLOAT, (3,), "centre of the hidden geometry's bounding box", "m"),
    DatasetSpec("hiddenVolumeRotation", FLOAT, (3,), "rotation of that box about x, then y, then z", "rad"),
    DatasetSpec("hiddenVolumeSize", FLOAT, (), "full edge of the hidden geometry's bounding cube", "m"),
    DatasetSpec("isConfocal", INTEGER, (), "1 for a confocal capture, else 0"),
)

# Ground truth, where ``output.ground_truth`` asks for it; rows and columns of the sensor grid, or of a grid of its own.
GROUND_TRUTH: tuple[DatasetSpec, ...] = (
    DatasetSpec("gt_depth", FLOAT, ("gt_y", "gt_x"), "distance from the wall along its normal; NaN: nothing", "m"),
    DatasetSpec("gt_normal", FLOAT, (THREE, "gt_y", "gt_x"), "unit normal of the surface's front; NaN: nothing there"),
    DatasetSpec("gt_albedo", FLOAT, ("gt_channel", "gt_y", "gt_x"), "diffuse reflectance; NaN: nothing there"),
    DatasetSpec("gt_position", FLOAT, (THREE, "gt_y", "gt_x"), "point of the surface; NaN: nothing there", "m"),
    DatasetSpec("gt_instance", INTEGER, ("gt_y", "gt_x"), "1 + index of the hidden item, see names; 0: nothing there"),
    DatasetSpec(
        "gt_occupancy",
        FLOAT,
        ("gt_z", "gt_y", "gt_x"),
        "share of the voxel inside of an item; along the wall's normal, its y and its x axis",
    ),
    DatasetSpec("gt_occupancy_bounds", FLOAT, (2, THREE), "outer corners of the first and the last voxel", "m"),
    DatasetSpec("gt_poses", FLOAT, ("item", 4, 4), "from each hidden item's own coordinates to this file's; see names"),
)
SPECS: Mapping[str, DatasetSpec] = {spec.name: spec for spec in DATASETS}

ROOT_TEXT = {"data order": "column-major", "engine": "nlosrender"}  # attributes of the file
STOKES = "stokes"
# Attribute of captures whose points are lists, not grids: "sensor", "laser" or both. The points are one row then
# (ny = 1), stand anywhere on the wall, and the grid's size is that of the box around them.
POINT_LISTS = "point_lists"
# Attributes of captures whose points a camera sees: how many of its pixels see nothing, and how many laser points are
# hidden from the laser. Empty points have zeros as position and normal.
EMPTY_POINTS, UNLIT_POINTS = "empty_sensor_points", "unlit_laser_points"
# Attributes of captures whose sensor points stand for an area of the wall: in words, and how large it is [m^2].
FOOTPRINT, FOOTPRINT_AREA = "footprint", "footprint_area"
# Of captures whose laser spots are lit at once: an attribute that says so, and the datasets of the spots, (3, 1, spots)
# in the file's frame [m] and (spots,), their shares of the pulse. laserGridPositions holds their weighted middle.
MULTIPLEXED = "laser_spots"
FLASH = "laser_flash"  # attribute of captures whose laser lights a part of the wall at once, in words
SPOT_POSITIONS, SPOT_SHARES = "laserSpotPositions", "laserSpotShares"
CHANNELS = {3: "rgb", 4: STOKES}  # grey: files without the attribute
DATA_UNIT = "J m^-2 sr^-1"  # radiance leaving a sensor point, integrated over the bin, for one pulse
VIEW_UNIT = "W m^-2 sr^-1"  # line_of_sight: of a pixel's steady radiance the share that arrives in the bin
COUNTS_UNIT = "counts"  # of measured captures: detections of all pulses


def data_unit(scan_type: str) -> str:
    """Return the unit of the samples."""
    return VIEW_UNIT if scan_type == LINE_OF_SIGHT else DATA_UNIT


def file_axes(confocal: bool) -> tuple[str, ...]:
    """Return the names of the axes of ``data``, in the order h5py shows them."""
    return CONFOCAL_AXES if confocal else PAIR_AXES


def data_shape(sizes: Mapping[str, int], confocal: bool) -> tuple[int, ...]:
    """Return the shape of ``data`` from the length of every in-memory axis; the bounce axis is always 6 long."""
    return in_file_order({**sizes, "bounce": FILE_BOUNCES}, confocal)


def in_file_order(by_axis: Mapping[str, T], confocal: bool) -> tuple[T, ...]:
    """Arrange one value per axis name (a length, an index, a slice) in the order of the file's axes."""
    return tuple(by_axis[axis] for axis in file_axes(confocal))


def sample_names(has_variance: bool) -> tuple[str, ...]:
    """Return the datasets of samples of a capture."""
    return (DATA, VARIANCE) if has_variance else (DATA,)


def resolve_shape(spec: DatasetSpec, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Return the shape of a dataset, axis names replaced by their lengths."""
    return tuple(length if isinstance(length, int) else sizes[length] for length in spec.shape)


def grid_sizes(sizes: Mapping[str, int], confocal: bool) -> dict[str, int]:
    """Return ``sizes`` with the lengths of the stored laser grid: in a confocal file it is a copy of the sensor's."""
    return {**sizes, "laser_y": sizes["sensor_y"], "laser_x": sizes["sensor_x"]} if confocal else dict(sizes)


# rows: X, Y, Z of a Z-NLOS file in terms of the wall's own x, y, z: (X, Y, Z) = (x, -z, y)
ZNLOS_FROM_LOCAL: Float64 = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
ZNLOS_FROM_LOCAL.setflags(write=False)

FRAME_TEXT = {
    "znlos": (
        "X = x, Y = -z, Z = y, where x, y are the relay wall's axes, z its normal and its centre the origin; "
        "file_to_scene takes positions of this file to the scene's coordinates"
    ),
    "scene": "coordinates of the scene as configured",
}


def file_frame(frame: str, pose: Pose) -> Pose:
    """Return the pose of the local frame (wall in z = 0, normal +z) in the file's frame.

    Parameters
    ----------
    frame
        ``znlos``: wall in Y = 0 with normal (0, -1, 0), Z up; ``scene``: the scene's own coordinates.
    pose
        Pose of the local frame in the scene.

    Raises
    ------
    ValueError
        ``frame`` is neither of the two.
    """
    if frame not in FRAMES:
        raise ValueError(f"frame: got {frame!r}, need one of {', '.join(FRAMES)}")
    return pose if frame == "scene" else Pose(ZNLOS_FROM_LOCAL, np.zeros(3))


def file_to_scene(frame: str, pose: Pose) -> Float64:
    """Return the (4, 4) matrix from positions in the file to scene coordinates; ValueError: ``frame`` is unknown."""
    return pose.matrix() @ file_frame(frame, pose).inverse_matrix()


def axes_last(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn the file's (3, rows, columns) into (rows, columns, 3)."""
    return np.moveaxis(array, 0, -1)


def axes_first(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (rows, columns, 3) into the file's (3, rows, columns)."""
    return np.moveaxis(array, -1, 0)


def missing_datasets(present: Iterable[str]) -> list[str]:
    """Return the names of the layout that are not among ``present``."""
    names = set(present)
    return [name for name in (DATA, *SPECS) if name not in names]


def sensor_tile(n_bins: int, n_rows: int, n_columns: int, chunk_samples: int = CHUNK_SAMPLES) -> tuple[int, int, int]:
    """Return (bins, rows, columns) of one chunk: whole histograms of a small sensor tile of one laser, about 1 MiB.

    A loader that wants one laser, one bounce or one sensor point then reads little more than that, and a chunk that
    holds no light is never written. The bin axis stays whole unless one histogram alone is longer than
    ``chunk_samples``. Tiles are as square as the grid lets them be, and of even size, so that the last tile of a row is
    not mostly padding.
    """
    bins = min(n_bins, chunk_samples)
    points = max(chunk_samples // bins, 1)
    columns = min(n_columns, isqrt(points))
    rows = _even(n_rows, min(n_rows, points // columns))
    columns = min(n_columns, points // rows)  # a low grid leaves room for wider tiles
    return bins, rows, _even(n_columns, columns)


def chunk_shape(sizes: Mapping[str, int], confocal: bool, chunk_samples: int = CHUNK_SAMPLES) -> tuple[int, ...]:
    """Return the chunk shape of ``data`` in the file's axis order from the length of every in-memory axis."""
    bins, rows, columns = sensor_tile(sizes["bin"], sizes["sensor_y"], sizes["sensor_x"], chunk_samples)
    one = {"channel": 1, "bounce": 1, "laser_y": 1, "laser_x": 1}
    return in_file_order({**one, "bin": bins, "sensor_y": rows, "sensor_x": columns}, confocal)


def cuts(start: int, stop: int, step: int) -> Iterator[tuple[int, int]]:
    """Cut [start, stop) at the multiples of ``step``."""
    while start < stop:
        end = min((start // step + 1) * step, stop)
        yield start, end
        start = end


def _even(length: int, tile: int) -> int:
    return ceil(length / ceil(length / tile))
