"""From a block of a capture to chunks of its file: cut, checked, transposed, packed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from nlosrender.errors import RenderError
from nlosrender.files import layout
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.layout import cuts

COMPRESSIONS = ("gzip", "none")
# ISA-L's encoder. Measured on captures, one core: 640 to 2000 MB/s where zlib's level 4 does 57 to 230 MB/s, for
# 0 to 4 % more bytes. Any HDF5 reads the result: the filters are shuffle and deflate.
ENCODER_LEVEL = 2


@dataclass(frozen=True)
class PackedChunk:
    """One chunk as it is stored."""

    dataset: str  # ``data`` or ``variance``
    at: tuple[int, ...]  # where it starts, in file order
    content: bytes


class Chunker:
    """Cuts blocks of one capture into the chunks of its file.

    Parameters
    ----------
    header
        Description of the capture.
    compression
        ``gzip`` or ``none``.
    has_variance
        Whether the file has a dataset ``variance``.

    Raises
    ------
    ValueError
        ``compression`` is unknown.
    """

    def __init__(self, header: CaptureHeader, compression: str, has_variance: bool = False):
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression: got {compression!r}, need one of {', '.join(COMPRESSIONS)}")
        self.header, self.compression, self.has_variance = header, compression, has_variance

    def pack(
        self, samples: Mapping[str, NDArray[np.floating]], laser_at: tuple[int, int], sensor_at: tuple[int, int]
    ) -> Iterator[PackedChunk]:
        """Yield the chunks of a block, dark ones left out; what the block does not cover of a chunk is zero in it.

        Parameters
        ----------
        samples
            By dataset, ``data`` or ``variance``: (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin), float32
            or float64.
        laser_at, sensor_at
            (row, column) of the block's first laser and sensor point.

        Raises
        ------
        RenderError
            A sample is not finite (as float32).
        """
        for name, block in samples.items():
            # one laser at a time: the copies made on the way stay small beside the block
            for row, column in np.ndindex(block.shape[2:4]):
                laser = (laser_at[0] + row, laser_at[1] + column)
                with np.errstate(over="ignore"):  # what overflows float32 is found and named right below
                    histograms = block[:, :, row, column].astype(np.float32, copy=False)
                self._refuse_non_finite(name, histograms, laser, sensor_at)
                yield from self._chunks_of_laser(name, histograms, laser, sensor_at)

    def _chunks_of_laser(
        self, name: str, histograms: NDArray[np.float32], laser: tuple[int, int], sensor_at: tuple[int, int]
    ) -> Iterator[PackedChunk]:
        header, (y_start, x_start) = self.header, sensor_at
        step = dict(zip(layout.file_axes(header.confocal), header.chunks, strict=True))
        n_rows, n_columns, n_bins = histograms.shape[2:]
        for (y0, y1), (x0, x1), (t0, t1) in product(
            cuts(y_start, y_start + n_rows, step["sensor_y"]),
            cuts(x_start, x_start + n_columns, step["sensor_x"]),
            cuts(0, n_bins, step["bin"]),
        ):
            tile = histograms[:, :, y0 - y_start : y1 - y_start, x0 - x_start : x1 - x_start, t0:t1]
            below, right = (
                y0 % step["sensor_y"],
                x0 % step["sensor_x"],
            )  # offset of the tile in its chunk: shards may begin inside one
            for channel, slot in np.ndindex(tile.shape[:2]):
                samples = tile[channel, slot]
                if not samples.any():
                    continue
                # all other axes of a chunk have length 1
                padded = np.zeros((step["bin"], step["sensor_y"], step["sensor_x"]), dtype=layout.FLOAT)
                padded[: t1 - t0, below : below + y1 - y0, right : right + x1 - x0] = samples.transpose(2, 0, 1)
                corner = {"channel": channel, "bounce": header.bounce_indices[slot], "bin": t0}
                corner |= {"sensor_y": y0 - below, "sensor_x": x0 - right, "laser_y": laser[0], "laser_x": laser[1]}
                yield PackedChunk(name, layout.in_file_order(corner, header.confocal), self._packed(padded))

    def _packed(self, chunk: NDArray[np.float32]) -> bytes:
        """Return the bytes that HDF5 stores for a chunk: shuffled and deflated for ``gzip``."""
        if self.compression == "none":
            return chunk.tobytes()
        # HDF5's shuffle filter: the first bytes of all samples, then their second bytes, ...
        shuffled = np.ascontiguousarray(chunk.view(np.uint8).reshape(-1, chunk.itemsize).T)
        return isal_zlib.compress(shuffled, ENCODER_LEVEL)

    def _refuse_non_finite(
        self, name: str, histograms: NDArray[np.float32], laser: tuple[int, int], sensor_at: tuple[int, int]
    ) -> None:
        finite = np.isfinite(histograms)
        if finite.all():
            return
        channel, slot, row, column, time_bin = (int(index[0]) for index in np.nonzero(~finite))
        raise RenderError(
            f"{name} is {histograms[channel, slot, row, column, time_bin]} at laser ({laser[0]}, {laser[1]}), "
            f"sensor ({sensor_at[0] + row}, {sensor_at[1] + column}), bin {time_bin}, "
            f"{self.header.bounce_name(slot)}, channel {channel}. Nothing that is not finite is written. "
            "Look for a reflectance, a texture or a length in the scene that is out of all proportion."
        )
