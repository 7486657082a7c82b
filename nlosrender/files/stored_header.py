"""What a capture file says about itself, read without touching its samples; also from files by other writers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FILE_BOUNCES, LINE_OF_SIGHT, first_bounce_of
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import get_attributes

Numbers = tuple[float, ...]
T = TypeVar("T", np.float32, np.float64)
MAX_CHUNK_BYTES = 2**30  # unpacked; a few kilobytes in a file may claim 4 GiB
MOST_BOUNCES = 64  # on the axis of a file from elsewhere; ours have 6


@dataclass(frozen=True)
class StoredHeader:
    """Metadata of a capture file; None and empty where the file does not say."""

    path: Path
    scan_type: str
    data_shape: tuple[int, ...]  # as h5py shows it
    confocal: bool  # no laser axes
    sizes: Mapping[str, int]  # length of every axis, by its in-memory name
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
        return first_bounce_of(self.scan_type)

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
    for name in layout.SPECS:  # read or not: a file that names others is refused as a whole
        dataset_in(file, path, name)
    confocal = samples.ndim == len(layout.CONFOCAL_AXES)
    sizes = {"laser_y": 1, "laser_x": 1} | dict(zip(layout.file_axes(confocal), samples.shape, strict=True))
    attributes, data_attributes = get_attributes(file), get_attributes(samples)
    if sizes["bounce"] > MOST_BOUNCES:
        raise FileError(f"{path}: has {sizes['bounce']} bounces, a capture has {FILE_BOUNCES}. {_NOT_ZNLOS}")
    indices = _bounce_indices(data_attributes, sizes["bounce"])
    split = attributes.get("split_bounces")
    width = _exact_or_stored(file, path, "deltaT")
    if width is None:
        raise FileError(f"{path}: has no dataset deltaT (the bin width in m of optical path). {_NOT_ZNLOS}")
    if not (np.isfinite(width) and width > 0):
        raise FileError(f"{path}: deltaT is {width}, need a length > 0 [m of optical path]")
    edges = small_numbers(file, path, "hiddenVolumeSize", exact=True)
    return StoredHeader(
        path=path,
        scan_type=_scan_type(attributes, confocal, sizes),
        data_shape=tuple(samples.shape),
        confocal=confocal,
        sizes=sizes,
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


def dataset_in(file: h5py.File, path: Path, name: str) -> h5py.Dataset | None:
    """Return the dataset ``name`` at the root of a file, or None when there is none.

    Raises
    ------
    FileError
        Its numbers lie in another file: a capture must not make this program open whatever it names.
    """
    link = file.get(name, getlink=True)
    if link is None:
        return None
    dataset = file.get(name) if isinstance(link, h5py.HardLink) else None
    if not isinstance(link, h5py.HardLink) or (
        isinstance(dataset, h5py.Dataset) and (dataset.external or dataset.is_virtual)
    ):
        raise FileError(
            f"{path}: {name} lies in another place or file. Copy it into the file itself, as with h5repack."
        )
    return dataset if isinstance(dataset, h5py.Dataset) else None


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
        raise FileError(f"{path}: has no dataset {name} (found: {found}). {_NOT_ZNLOS}")
    if samples.dtype.kind not in "iuf":
        raise FileError(f"{path}: {name} holds {samples.dtype}, need numbers. {_NOT_ZNLOS}")
    if samples.ndim not in (len(layout.CONFOCAL_AXES), len(layout.PAIR_AXES)):
        confocal, pairs = " ".join(layout.CONFOCAL_AXES), " ".join(layout.PAIR_AXES)
        raise FileError(
            f"{path}: {name} has {samples.ndim} axes {samples.shape or ''}, need 5 ({confocal}) or 7 ({pairs}). "
            f"{_NOT_ZNLOS}"
        )
    if 0 in samples.shape:
        raise FileError(f"{path}: {name} is empty: its shape is {samples.shape}")
    if samples.chunks is not None and prod(samples.chunks) * samples.dtype.itemsize > MAX_CHUNK_BYTES:
        raise FileError(f"{path}: {name} has chunks of shape {samples.chunks}, need at most 1 GiB each. Use h5repack.")
    return samples


def small_numbers(file: h5py.File, path: Path, name: str, exact: bool = False) -> Numbers | None:
    """Return the few numbers of the dataset ``name``; None when it is missing.

    Parameters
    ----------
    file, path
        The open file and its path.
    name
        Dataset at the file's root.
    exact
        Prefer the float64 attribute ``exact`` to the float32 the layout asks for.

    Raises
    ------
    FileError
        The dataset holds something else.
    """
    if name not in file:
        return None
    dataset = dataset_in(file, path, name)
    # checked before reading: a dataset may claim any size without taking any
    if dataset is None or dataset.dtype.kind not in "biuf" or not 0 < (dataset.size or 0) <= 16:
        raise FileError(f"{path}: {name} is not what a capture has there. {_NOT_ZNLOS}")
    values = dataset[()]
    if exact and "exact" in dataset.attrs and np.asarray(dataset.attrs["exact"]).dtype.kind in "iuf":
        values = dataset.attrs["exact"]
    return tuple(float(value) for value in np.ravel(values))


def stored_points(file: h5py.File, path: Path, name: str, sizes: Mapping[str, int]) -> np.ndarray:
    """Return a grid of positions or normals as (rows, columns, 3) float64, in the file's frame.

    Raises
    ------
    FileError
        The dataset is missing, not numeric, or does not have one entry per point.
    """
    dataset = dataset_in(file, path, name)
    need = layout.resolve_shape(layout.SPECS[name], sizes)
    if dataset is None:
        raise FileError(f"{path}: has no dataset {name}. {_NOT_ZNLOS}")
    if dataset.dtype.kind not in "iuf" or dataset.size != prod(need):
        raise FileError(f"{path}: {name} is {dataset.dtype} {dataset.shape}, need numbers of shape {need}")
    return layout.axes_last(np.asarray(dataset[()], dtype=np.float64).reshape(need))


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


_NOT_ZNLOS = "Is this a Z-NLOS capture, as `nlosrender render` writes it?"
