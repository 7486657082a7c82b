"""From a block of a capture to chunks of its file: cut, checked, transposed, packed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from nlosrender.errors import RenderError
from nlosrender.files import layout
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.chunks import chunk_shape, cuts

COMPRESSIONS = ("gzip", "none")
TILE_AXES = ("sensor_y", "sensor_x", "bin")  # of a piece, as it lies in memory
# ISA-L's encoder. Measured on captures, one core: 640 to 2000 MB/s where zlib's level 4 does 57 to 230 MB/s, for
# 0 to 4 % more bytes. Any HDF5 reads the result: the filters are shuffle and deflate.
ENCODER_LEVEL = 2


@dataclass(frozen=True, eq=False)
class Piece:
    """The part of one chunk that a block covers."""

    chunk: tuple[int, ...]  # where the chunk starts, in file order
    where: dict[str, int | slice]  # the piece's place in the capture, by axis
    fills: bool  # whether nothing else of the capture lies in this chunk
    samples: NDArray[np.float32]  # (sensor_y, sensor_x, bin)


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

    Raises
    ------
    ValueError
        ``compression`` is unknown.
    """

    def __init__(self, header: CaptureHeader, compression: str):
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression: got {compression!r}, need one of {', '.join(COMPRESSIONS)}")
        self.header, self.compression = header, compression
        self.chunks = chunk_shape(header.sizes, header.confocal)
        self._step = dict(zip(layout.file_axes(header.confocal), self.chunks, strict=True))

    def pieces(
        self, name: str, block: NDArray[np.floating], laser_at: tuple[int, int], sensor_at: tuple[int, int]
    ) -> Iterator[Piece]:
        """Yield the pieces of a block, dark ones too.

        Parameters
        ----------
        name
            ``data`` or ``variance``, for messages.
        block
            (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) samples, float32 or float64.
        laser_at, sensor_at
            (row, column) of the block's first laser and sensor point.

        Raises
        ------
        RenderError
            A sample is not finite (as float32).
        """
        # one laser at a time: the copies made on the way stay small beside the block
        for row, column in np.ndindex(block.shape[2:4]):
            laser = (laser_at[0] + row, laser_at[1] + column)
            with np.errstate(over="ignore"):  # what overflows float32 is found and named right below
                histograms = block[:, :, row, column].astype(np.float32, copy=False)
            self._refuse_non_finite(name, histograms, laser, sensor_at)
            yield from self._pieces_of_laser(histograms, laser, sensor_at)

    def pack(self, name: str, piece: Piece) -> PackedChunk:
        """Return a piece as a chunk; what it does not cover is zero."""
        padded = np.zeros(self.chunks, dtype=layout.FLOAT)
        samples = layout.to_file_order(piece.samples, TILE_AXES, self.header.confocal)
        inside = tuple(
            slice(part.start - start, part.stop - start) if isinstance(part, slice) else 0
            for part, start in zip(layout.in_file_order(piece.where, self.header.confocal), piece.chunk, strict=True)
        )
        padded[inside] = samples
        return PackedChunk(name, piece.chunk, pack(padded, self.compression))

    def _pieces_of_laser(
        self, histograms: NDArray[np.float32], laser: tuple[int, int], sensor_at: tuple[int, int]
    ) -> Iterator[Piece]:
        header, step, sizes = self.header, self._step, self.header.sizes
        rows, columns, bins = histograms.shape[2:]
        for y0, y1 in cuts(sensor_at[0], sensor_at[0] + rows, step["sensor_y"]):
            for x0, x1 in cuts(sensor_at[1], sensor_at[1] + columns, step["sensor_x"]):
                for t0, t1 in cuts(0, bins, step["bin"]):
                    tile = {"sensor_y": slice(y0, y1), "sensor_x": slice(x0, x1), "bin": slice(t0, t1)}
                    inside = (slice(y0 - sensor_at[0], y1 - sensor_at[0]), slice(x0 - sensor_at[1], x1 - sensor_at[1]))
                    fills = all(
                        part.start % step[axis] == 0 and (part.stop % step[axis] == 0 or part.stop == sizes[axis])
                        for axis, part in tile.items()
                    )
                    for channel, slot in np.ndindex(histograms.shape[:2]):
                        place: dict[str, int | slice] = {"channel": channel, "bounce": header.bounce_indices[slot]}
                        where = place | {"laser_y": laser[0], "laser_x": laser[1]} | tile
                        start = {axis: part.start if isinstance(part, slice) else part for axis, part in where.items()}
                        corner = {axis: index // step.get(axis, 1) * step.get(axis, 1) for axis, index in start.items()}
                        chunk = layout.in_file_order(corner, header.confocal)
                        yield Piece(chunk, where, fills, histograms[(channel, slot, *inside, slice(t0, t1))])

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


def packed_chunks(
    chunker: Chunker, name: str, block: NDArray[np.floating], laser_at: tuple[int, int], sensor_at: tuple[int, int]
) -> Iterator[PackedChunk]:
    """Yield a block's chunks, dark ones left out; nothing else may come to lie in them.

    Parameters
    ----------
    chunker
        Of the capture.
    name, block, laser_at, sensor_at
        As for ``Chunker.pieces``, whose errors it raises.
    """
    for piece in chunker.pieces(name, block, laser_at, sensor_at):
        if piece.samples.any():
            yield chunker.pack(name, piece)


def pack(chunk: NDArray[np.float32], compression: str) -> bytes:
    """Return the bytes that HDF5 stores for a chunk: shuffled and deflated for ``gzip``."""
    if compression == "none":
        return chunk.tobytes()
    # HDF5's shuffle filter: the first bytes of all samples, then their second bytes, ...
    shuffled = np.ascontiguousarray(chunk.view(np.uint8).reshape(-1, chunk.itemsize).T)
    return isal_zlib.compress(shuffled, ENCODER_LEVEL)
