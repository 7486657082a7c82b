"""Radiance pictures (.hdr, Ward 1991): three floats in four bytes, which share an exponent; relative rounding 2^-8."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MIN_WIDTH, MAX_WIDTH = 8, 32767  # of rows that are run-length encoded
MAX_LITERAL, MAX_RUN = 128, 127  # bytes after one count; a run's count has 128 added
SMALLEST = 1e-38  # radiance that the shared exponent can hold; less is stored as black
Bytes = NDArray[np.uint8]


def write_hdr(path: Path, picture: NDArray[np.floating]) -> NDArray[np.float32]:
    """Write a picture (row, column, 3) or (row, column), not negative; return what a reader finds, in its shape.

    Rows without light are stored as runs, others plainly: light hardly compresses.

    Raises
    ------
    ValueError
        The width is out of bounds.
    OSError
        The disk refuses.
    """
    rgb = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture
    rows, width = rgb.shape[:2]
    if not MIN_WIDTH <= width <= MAX_WIDTH:
        raise ValueError(f"a .hdr picture is {MIN_WIDTH} to {MAX_WIDTH} columns wide, got {width}")
    encoded = rgbe(rgb)
    start = np.array([2, 2, width >> 8, width & 255], dtype=np.uint8).tobytes()
    black = start + 4 * b"".join(bytes([128 + min(MAX_RUN, width - at), 0]) for at in range(0, width, MAX_RUN))
    parts = []
    for at in range(0, width, MAX_LITERAL):
        planes = np.moveaxis(encoded[:, at : at + MAX_LITERAL], 2, 1)  # (row, 4, column)
        counts = np.full((*planes.shape[:2], 1), planes.shape[2], dtype=np.uint8)
        parts.append(np.concatenate([counts, planes], axis=2))
    literal = np.concatenate(parts, axis=2)
    is_lit = encoded[..., 3].max(axis=1) > 0
    with path.open("wb") as file:
        file.write(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {rows} +X {width}\n".encode())
        for row, lit in zip(literal, is_lit, strict=True):
            file.write(start + row.tobytes() if lit else black)
    found = decoded(encoded)
    return found[..., 0] if picture.ndim == 2 else found


def rgbe(rgb: NDArray[np.floating]) -> Bytes:
    """Return pixels (..., 3) as mantissas and the exponent they share, (..., 4)."""
    largest = rgb.max(axis=-1)
    _, exponent = np.frexp(largest)
    scale = np.ldexp(1.0, 8 - exponent)[..., None]
    mantissa = np.rint(rgb * scale)
    over = mantissa.max(axis=-1) > 255  # rounded up to the next power of two
    exponent = exponent + over
    mantissa = np.where(over[..., None], np.rint(rgb * scale / 2), mantissa)
    found = np.concatenate([mantissa, exponent[..., None] + 128], axis=-1)
    return np.where((largest > SMALLEST)[..., None], found, 0).astype(np.uint8)


def decoded(pixels: Bytes) -> NDArray[np.float32]:
    """Return what readers make of pixels (..., 4): mantissa times 2^(exponent - 136)."""
    return np.ldexp(pixels[..., :3].astype(np.float32), pixels[..., 3:].astype(int) - 136)
