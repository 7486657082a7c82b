"""Metadata of a capture file, also of one by another writer, read without touching its samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import (
    FILE_BOUNCES,
    FIRST_BOUNCE,
    LINE_OF_SIGHT,
    THIRD_BOUNCE,
    BounceAxis,
    first_bounce_of,
)
from nlosrender.capture.time_axis import bin_centres
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import get_attributes
from nlosrender.files.reading.stored_axes import BY_RANK, stored_axes
from nlosrender.files.reading.stored_points import NOT_ZNLOS, Numbers, dataset_in, small_numbers

T = TypeVar("T", np.float32, np.float64)
MAX_CHUNK_BYTES = 2**30  # unpacked; a few kilobytes in a file may claim 4 GiB
MAX_BOUNCES = 64  # longest bounce axis that is read; this program writes 6


@dataclass(frozen=True)
class StoredHeader:
    """Metadata of a capture file; None and empty where the file does not say."""

    path: Path
    scan_type: str
    data_shape: tuple[int, ...]  # as h5py shows it
    axes: tuple[str, ...]  # in-memory names of the axes of ``data_shape``
    row_major: bool  # whether every dataset has its axes in reverse order
    confocal: bool  # laser and sensor points are the same
    sizes: Mapping[str, int]  # length of every axis, by its in-memory name
    third_index: int | None  # of the third bounce on the bounce axis; None: the file has none, or says nonsense
    bin_width_opl: float  # m
    start_opl: float  # m
    bounce_indices: tuple[int, ...]  # of the bounce axis that hold light; all of them when the file does not say
    bounces_known: bool  # whether it does say
    split_bounces: bool | None
    sensor_grid_size: Numbers | None  # (width, height) m
    laser_grid_size: Numbers | None
    sensor_position: Numbers | None  # (3,) m, in the file's frame
    laser_position: Numbers | None
    hidden_volume_position: Numbers | None
    hidden_volume_rotation: Numbers | None
    hidden_volume_edges: Numbers | None  # three numbers when the file has them, else the cube's edge
    dtype: str
    itemsize: int  # bytes of one sample
    chunks: tuple[int, ...] | None
    compression: str
    has_variance: bool
    attributes: Mapping[str, object]  # of the file
    data_attributes: Mapping[str, object]

    @property
    def first_bounce(self) -> int:
        """The bounce that index 0 of the bounce axis holds."""
        if self.scan_type == LINE_OF_SIGHT or self.third_index is None:
            return first_bounce_of(self.scan_type)
        return THIRD_BOUNCE - self.third_index

    @property
    def n_bins(self) -> int:
        """Number of bins."""
        return self.sizes["bin"]

    @property
    def end_opl(self) -> float:
        """Optical path length at the end of the last bin [m]."""
        return self.start_opl + self.n_bins * self.bin_width_opl

    @property
    def sensor_grid(self) -> tuple[int, int]:
        """Rows and columns of the sensor grid."""
        return self.sizes["sensor_y"], self.sizes["sensor_x"]

    @property
    def laser_grid(self) -> tuple[int, int]:
        """Rows and columns of the laser grid; a confocal capture has its sensor grid here."""
        return self.sensor_grid if self.confocal else (self.sizes["laser_y"], self.sizes["laser_x"])

    def bin_centres(self) -> NDArray[np.float64]:
        """Return the optical path length in the middle of every bin, (bin,) [m]."""
        return bin_centres(self.start_opl, self.bin_width_opl, self.n_bins)

    def is_list(self, name: str = "sensor") -> bool:
        """Whether ``sensor`` or ``laser`` points are a list, in one row, and not a grid."""
        return name in str(self.attributes.get(layout.POINT_LISTS, "")).split()

    def counted_points(self, name: str = "sensor") -> str:
        """Return the number of ``sensor`` or ``laser`` points in words: ``5 x 3``, or ``15 listed``."""
        rows, columns = self.sensor_grid if name == "sensor" else self.laser_grid
        return f"{columns} listed" if self.is_list(name) else f"{columns} x {rows}"

    @property
    def has_pixels(self) -> bool:
        """Whether rows and columns are those of a camera's picture, not of a grid on a wall."""
        return self.scan_type == LINE_OF_SIGHT or layout.EMPTY_POINTS in self.attributes

    @property
    def whose_points(self) -> str:
        """Whose the sensor points are where they have no cells: ``a list``, ``a camera``; empty: a grid's."""
        return "a list" if self.is_list() else "a camera" if self.has_pixels else ""

    @property
    def is_multiplexed(self) -> bool:
        """Whether several laser spots were lit at once."""
        return layout.MULTIPLEXED in self.attributes

    @property
    def is_flash(self) -> bool:
        """Whether the laser lit a part of the wall at once, not points."""
        return layout.FLASH in self.attributes

    def refuse_spots(self, what: str) -> None:
        """Raise FileError where a flash or several laser spots lit the wall, for ``what`` is for one laser point."""
        if self.is_flash:
            raise FileError(
                f"{self.path}: its laser is {self.attributes[layout.FLASH]}, and {what} takes a laser point."
            )
        if self.is_multiplexed:
            raise FileError(
                f"{self.path}: its laser spots were lit at once ({layout.SPOT_POSITIONS}), and {what} takes one laser "
                "point at a time. Render them with capture.scan_type: exhaustive and laser_points."
            )

    @property
    def footprint(self) -> tuple[str, float | None] | None:
        """What each histogram is the mean over, in words, and its area [m^2], if it has one; None: points."""
        words, area = (self.attributes.get(name) for name in (layout.FOOTPRINT, layout.FOOTPRINT_AREA))
        return (words, float(area) if isinstance(area, (int, float)) else None) if isinstance(words, str) else None

    @property
    def is_measured(self) -> bool:
        """Whether the samples are a detector's counts."""
        return self.data_attributes.get("unit") == layout.COUNTS_UNIT

    @property
    def unit(self) -> str:
        """Unit of the samples."""
        return layout.COUNTS_UNIT if self.is_measured else layout.data_unit(self.scan_type)

    def bounce_name(self, index: int) -> str:
        """Return what an index of the bounce axis holds: a bounce number, "7 and above" or "all"."""
        limit = self.attributes.get("max_bounces")
        highest = limit if isinstance(limit, int) else None
        return BounceAxis(highest, self.split_bounces is not False, self.first_bounce).name(index)


def intensity(header: StoredHeader, block: NDArray[T]) -> NDArray[T]:
    """Return a block (channel, ...) in grey: colours averaged, of Stokes components the first."""
    if header.attributes.get("channels") == layout.STOKES:
        return block[0]
    return block.mean(axis=0)


def header_of(file: h5py.File, path: Path) -> StoredHeader:
    """Read the metadata of an open file.

    Raises
    ------
    FileError
        ``data`` or ``deltaT`` is missing, or what is there cannot be a capture.
    """
    samples = samples_of(file, path)
    for name in layout.SPECS:  # whether it is read or not: a link to another file is refused
        dataset_in(file, path, name)
    attributes, data_attributes = get_attributes(file), get_attributes(samples)
    axes = stored_axes(file, path, samples, attributes)
    sizes = axes.sizes
    if sizes["bounce"] > MAX_BOUNCES:
        raise FileError(f"{path}: has {sizes['bounce']} bounces, a capture has {FILE_BOUNCES}. {NOT_ZNLOS}")
    indices = _bounce_indices(data_attributes, sizes["bounce"])
    split = attributes.get("split_bounces")
    width = _exact_or_stored(file, path, "deltaT")
    if width is None:
        raise FileError(f"{path}: has no dataset deltaT (the bin width in m of optical path). {NOT_ZNLOS}")
    if not (np.isfinite(width) and width > 0):
        raise FileError(f"{path}: deltaT is {width}, need a length > 0 [m of optical path]")
    edges = small_numbers(file, path, "hiddenVolumeSize", exact=True)
    return StoredHeader(
        path=path,
        scan_type=_scan_type(attributes, axes.confocal, sizes),
        data_shape=tuple(samples.shape),
        axes=axes.names,
        row_major=axes.row_major,
        confocal=axes.confocal,
        sizes=sizes,
        third_index=_third_index(data_attributes, sizes["bounce"]),
        bin_width_opl=width,
        start_opl=_exact_or_stored(file, path, "t0") or 0.0,
        bounce_indices=tuple(range(sizes["bounce"])) if indices is None else indices,
        bounces_known=indices is not None,
        split_bounces=bool(split) if isinstance(split, int) else None,
        sensor_grid_size=small_numbers(file, path, "cameraGridSize"),
        laser_grid_size=small_numbers(file, path, "laserGridSize"),
        sensor_position=small_numbers(file, path, "cameraPosition"),
        laser_position=small_numbers(file, path, "laserPosition"),
        hidden_volume_position=small_numbers(file, path, "hiddenVolumePosition"),
        hidden_volume_rotation=small_numbers(file, path, "hiddenVolumeRotation"),
        hidden_volume_edges=edges,
        dtype=str(samples.dtype),
        itemsize=samples.dtype.itemsize,
        chunks=samples.chunks,
        compression=samples.compression or "none",
        has_variance=dataset_in(file, path, layout.VARIANCE) is not None,
        attributes=attributes,
        data_attributes=data_attributes,
    )


def samples_of(file: h5py.File, path: Path, name: str = layout.DATA) -> h5py.Dataset:
    """Return the dataset ``data`` (or ``variance``) once it is sure to hold a capture's samples.

    Raises
    ------
    FileError
        It is missing, not numeric, of the wrong rank, or empty.
    """
    samples = dataset_in(file, path, name)
    if samples is None:
        found = ", ".join(sorted(file)[:8]) or "nothing"
        raise FileError(f"{path}: has no dataset {name} (found: {found}). {NOT_ZNLOS}")
    if samples.dtype.kind not in "iuf":
        raise FileError(f"{path}: {name} holds {samples.dtype}, need numbers. {NOT_ZNLOS}")
    # the ranks without a channel are common: deltaT tells a capture
    if samples.ndim not in BY_RANK or (samples.ndim % 2 == 0 and dataset_in(file, path, "deltaT") is None):
        confocal, pairs = " ".join(layout.CONFOCAL_AXES), " ".join(layout.PAIR_AXES)
        raise FileError(
            f"{path}: {name} has {samples.ndim} axes {samples.shape or ''}, need 5 ({confocal}) or 7 ({pairs}), or one "
            f"less without a channel. {NOT_ZNLOS}"
        )
    if 0 in samples.shape:
        raise FileError(f"{path}: {name} is empty: its shape is {samples.shape}")
    if samples.chunks is not None and prod(samples.chunks) * samples.dtype.itemsize > MAX_CHUNK_BYTES:
        raise FileError(f"{path}: {name} has chunks of shape {samples.chunks}, need at most 1 GiB each. Use h5repack.")
    return samples


def _exact_or_stored(file: h5py.File, path: Path, name: str) -> float | None:
    numbers = small_numbers(file, path, name, exact=True)
    return None if numbers is None else numbers[0]


def _bounce_indices(data_attributes: Mapping[str, object], length: int) -> tuple[int, ...] | None:
    stored = data_attributes.get("bounce_indices")
    if not isinstance(stored, list) or length > FILE_BOUNCES:
        return None
    indices = tuple(sorted({index for index in stored if isinstance(index, int) and 0 <= index < length}))
    return indices or None


def _scan_type(attributes: Mapping[str, object], confocal: bool, sizes: Mapping[str, int]) -> str:
    if confocal:
        return "confocal"
    if sizes["laser_y"] * sizes["laser_x"] > 1:
        return "exhaustive"
    # an exhaustive capture may have a single laser point too
    stored = attributes.get("scan_type")
    return str(stored) if stored in ("exhaustive", LINE_OF_SIGHT) else "single"


def _third_index(data_attributes: Mapping[str, object], n_bounces: int) -> int | None:
    stored = data_attributes.get("third_bounce", THIRD_BOUNCE - FIRST_BOUNCE)
    if isinstance(stored, list) and len(stored) == 1:  # MATLAB knows no scalars
        stored = stored[0]
    usable = isinstance(stored, (int, float)) and stored in range(n_bounces)
    return int(stored) if usable else None  # type: ignore[call-overload]
