"""How large a capture file will be, before it is written."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, prod
from pathlib import Path

import numpy as np

from nlosrender.files import layout
from nlosrender.files.layout import chunk_shape
from nlosrender.readable import readable_size

SAMPLE_BYTES = 4  # float32
HEADER_BYTES = 60_000  # attributes with the configuration, and HDF5's tables of a small file
# Measured: gzip and shuffle leave 0.8 to 1.1 bytes per byte of light (the more the noisier and the more scattered)
# and 0.001 of zeros, at 320 and 2800 MB/s on one core.
PACKED_LIGHT, PACKED_ZEROS = 1.0, 0.001
PACKING_LIGHT, PACKING_ZEROS = 320e6, 2800e6  # bytes of samples per second
UNPACKED_SPEED = 500e6  # bytes per second, of a disk


@dataclass(frozen=True)
class FileSize:
    """What a capture file takes."""

    logical_bytes: int  # of all datasets but ground truth and counts, as a reader sees them; exact
    disk_bytes_estimate: int
    write_seconds: float  # estimate, packing included
    assumption: str  # behind the two estimates


def forecast_size(
    sizes: Mapping[str, int],
    confocal: bool,
    filled: Sequence[float],
    *,
    compression: str,
    variance: bool,
    line_of_sight: bool = False,
) -> FileSize:
    """Return the size of a file that is not yet written.

    Parameters
    ----------
    sizes, confocal
        Length of every in-memory axis, as ``CaptureHeader.sizes``; whether the file has no laser axes.
    filled
        For each bounce slot that is rendered, the share of the bins that hold light; chunks of a slot with 0 are
        never written.
    compression, variance
        ``gzip`` or ``none``; whether the variance is stored beside the samples.
    line_of_sight
        Whether a camera sees the light: no bounce is known better than from the pilot.
    """
    copies = 2 if variance else 1
    samples = copies * SAMPLE_BYTES
    logical = samples * prod(layout.data_shape(sizes, confocal)) + _small_bytes(sizes, confocal)
    rows = prod(sizes[axis] for axis in ("channel", "laser_y", "laser_x", "sensor_y", "sensor_x"))
    written = [share for share in filled if share > 0]
    small = HEADER_BYTES + _small_bytes(sizes, confocal)
    if compression == "none":
        lengths = layout.in_file_order({**sizes, "bounce": len(written)}, confocal)
        chunks = chunk_shape(sizes, confocal)
        stored = samples * prod(ceil(n / c) * c for n, c in zip(lengths, chunks, strict=True))
        assumption = "every bounce that light can reach is stored in full, without compression"
        return FileSize(logical, stored + small, stored / UNPACKED_SPEED, assumption)
    light = samples * rows * sizes["bin"] * sum(written)
    zeros = samples * rows * sizes["bin"] * len(written) - light
    reached = "third bounce in every bin it can reach, further bounces in as many as in the pilot"
    if line_of_sight:
        reached = "light in as many bins as in the pilot"
    assumption = f"{reached}; light does not compress, zeros do"
    seconds = light / PACKING_LIGHT + zeros / PACKING_ZEROS
    return FileSize(logical, int(light * PACKED_LIGHT + zeros * PACKED_ZEROS) + small, seconds, assumption)


def disk_warnings(path: Path, size: FileSize) -> Iterator[str]:
    """Yield what stands against writing a file of ``size`` at ``path``, as far as can be told without writing."""
    folder = path.absolute().parent
    if not folder.is_dir():
        yield f"output.path: there is no folder {folder}; create it before the render."
        return
    free = shutil.disk_usage(folder).free
    if size.disk_bytes_estimate > free:
        yield (
            f"output.path: up to {readable_size(size.disk_bytes_estimate)} may be written, but {folder} has "
            f"{readable_size(free)} left."
        )


def _small_bytes(sizes: Mapping[str, int], confocal: bool) -> int:
    """Return the bytes of every dataset but the samples."""
    grids = layout.grid_sizes(sizes, confocal)
    return sum(prod(layout.resolve_shape(spec, grids)) * np.dtype(spec.dtype).itemsize for spec in layout.DATASETS)
