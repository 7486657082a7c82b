"""Writes a capture piece by piece into a Z-NLOS file that appears whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from nlosrender.files import layout
from nlosrender.files.atomic_write import check_writable, explained_write, new_partial, publish
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.chunking import TILE_AXES, Chunker
from nlosrender.files.file_kinds import CAPTURE, NOTHING
from nlosrender.files.sink import CaptureSink, new_capture
from nlosrender.interruption import uninterrupted

__all__ = ["CaptureWriter", "check_writable"]


class CaptureWriter:
    """Context manager that writes one capture file in one go; ``PartialCapture`` survives an interruption.

    Leaving the block normally puts the file in place under its name, replacing a capture that was there; an exception
    (Ctrl-C too) removes what was written and leaves the earlier file as it was.

    Parameters
    ----------
    path
        File to write.
    header
        Description of the capture.
    attributes
        Further attributes of the file, such as its provenance. They must not repeat those of the layout.
    compression
        ``gzip`` (with shuffle: the one filter pair that every HDF5 build has) or ``none``.
    store_variance
        Also store the variance of every sample, in a dataset ``variance`` shaped as ``data``.
    overwrite
        Whether an existing capture may be replaced.

    Raises
    ------
    ValueError
        ``compression`` is unknown.
    FileError
        On entering: the file cannot be created. On leaving: it cannot be completed.
    """

    def __init__(
        self,
        path: str | Path,
        header: CaptureHeader,
        *,
        attributes: Mapping[str, object] | None = None,
        compression: str = "gzip",
        store_variance: bool = False,
        overwrite: bool = True,
    ):
        self.path = Path(path)
        self.header = header
        self._attributes = dict(attributes or {})
        self._compression = compression
        self._store_variance = store_variance
        self._overwrite = overwrite
        self._chunker = Chunker(header, compression)
        self._sink: CaptureSink | None = None
        self._written: set[tuple[str, tuple[int, ...]]] = set()  # chunks that exist, by dataset

    def __enter__(self) -> CaptureWriter:
        self._kind = CAPTURE if self._overwrite else NOTHING
        self._target = check_writable(self.path, self._kind)
        with explained_write(self.path):
            self._partial = new_partial(self._target)
        try:
            self._sink = new_capture(self._partial, self.path, self.header, self._compression, self._store_variance)
            self._sink.set_attributes(self._attributes)
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            self._open_sink().close()
            with uninterrupted(), explained_write(self.path):
                publish(self.path, self._partial, self._target, self._kind)
        except BaseException:
            self._discard()
            raise

    def write(
        self,
        block: NDArray[np.floating],
        laser_at: tuple[int, int] = (0, 0),
        sensor_at: tuple[int, int] = (0, 0),
        variance: NDArray[np.floating] | None = None,
    ) -> None:
        """Write one block of the capture.

        Parameters
        ----------
        block
            (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) samples of H, float32 or float64
            [J m^-2 sr^-1]; channels, bounces and bins whole.
        laser_at, sensor_at
            (row, column) of the block's first laser and sensor point.
        variance
            Variance of the samples, shaped as ``block``; needed exactly when the file stores it.

        Raises
        ------
        ValueError
            The block does not fit, or ``variance`` is missing or superfluous.
        RenderError
            A sample is not finite (as float32).
        FileError
            The disk refuses.
        """
        self._check_fit(block, laser_at, sensor_at)
        if (variance is None) == self._store_variance:
            raise ValueError("variance: needed exactly when the file stores it (store_variance)")
        self._write_samples(layout.DATA, block, laser_at, sensor_at)
        if variance is not None:
            if variance.shape != block.shape:
                raise ValueError(f"variance: got shape {variance.shape}, need the block's {block.shape}")
            self._write_samples(layout.VARIANCE, variance, laser_at, sensor_at)

    def set_attributes(self, attributes: Mapping[str, object]) -> None:
        """Add attributes to the file, such as results known at the end only.

        Raises
        ------
        ValueError
            One of them belongs to the layout.
        FileError
            The disk refuses.
        """
        self._open_sink().set_attributes(attributes)

    def _check_fit(self, block: NDArray[np.floating], laser_at: tuple[int, int], sensor_at: tuple[int, int]) -> None:
        sizes = self.header.sizes
        if block.ndim != len(layout.MEMORY_AXES) or block.dtype.kind != "f":
            raise ValueError(f"block: got {block.dtype} {block.shape}, need floats over {layout.MEMORY_AXES}")
        starts = dict(zip(("laser_y", "laser_x", "sensor_y", "sensor_x"), (*laser_at, *sensor_at), strict=True))
        for axis, length in zip(layout.MEMORY_AXES, block.shape, strict=True):
            start = starts.get(axis, 0)
            whole = axis in starts or length == sizes[axis]
            if start < 0 or start + length > sizes[axis] or not whole:
                raise ValueError(f"block: {length} from {start} along {axis} does not fit, its length is {sizes[axis]}")

    def _write_samples(
        self, name: str, block: NDArray[np.floating], laser_at: tuple[int, int], sensor_at: tuple[int, int]
    ) -> None:
        sink = self._open_sink()
        confocal = self.header.confocal
        for piece in self._chunker.pieces(name, block, laser_at, sensor_at):
            # a chunk that exists may hold light of an earlier write, which zeros must replace
            if not piece.samples.any() and (name, piece.chunk) not in self._written:
                continue
            self._written.add((name, piece.chunk))
            if piece.fills:
                sink.put(self._chunker.pack(name, piece))
            else:
                selection = layout.in_file_order(piece.where, confocal)
                sink.fill(name, selection, layout.to_file_order(piece.samples, TILE_AXES, confocal))

    def _open_sink(self) -> CaptureSink:
        if self._sink is None:
            raise ValueError(f"{self.path}: the writer is not open; use it in a with block")
        return self._sink

    def _discard(self) -> None:
        # a second Ctrl-C waits until everything is removed
        with uninterrupted():
            if self._sink is not None:
                self._sink.abandon()
            with suppress(OSError):
                self._partial.unlink(missing_ok=True)
