"""Chunk shape of ``data``: whole histograms of a small sensor tile of one laser, about 1 MiB each.

A loader that wants one laser, one bounce or one sensor point then reads little more than that, and a chunk that
holds no light is never written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import ceil, isqrt

from nlosrender.files.layout import in_file_order

CHUNK_SAMPLES = 262_144  # 1 MiB of float32


def sensor_tile(n_bins: int, n_rows: int, n_columns: int, chunk_samples: int = CHUNK_SAMPLES) -> tuple[int, int, int]:
    """Return (bins, rows, columns) of one chunk of at most ``chunk_samples``.

    The bin axis stays whole unless one histogram alone is longer than a chunk. Tiles are as square as the grid
    lets them be, and of even size, so that the last tile of a row is not mostly padding.
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
