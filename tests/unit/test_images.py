"""Images that would unpack to more memory than there is are refused by their headers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from nlosrender.scene.loading.image_size import MAX_TEXELS, check_image, image_files


def _png(path: Path, width: int, height: int) -> Path:
    """Write a .png of so many black pixels in a few bytes: rows of zeros, cut off after the first ones."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(min(width + 1, 1000) * min(height, 100)))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("side", [2**14, 2**20])
def test_a_small_file_of_too_many_texels_is_refused(tmp_path: Path, side: int) -> None:
    """A .png of a few hundred bytes that claims more than the limit is refused, whichever library finds it."""
    bomb = _png(tmp_path / "bomb.png", side, side)
    assert bomb.stat().st_size < 2000
    with pytest.raises(ValueError, match=r"texels, need at most|too large an image"):
        check_image(bomb)


def test_an_image_within_the_limit_passes(tmp_path: Path) -> None:
    """The limit itself is allowed."""
    check_image(_png(tmp_path / "large.png", MAX_TEXELS // 2**13, 2**13))


def test_the_data_window_of_an_exr_counts(tmp_path: Path) -> None:
    """An .exr is measured by its data window, not by its file."""
    path = tmp_path / "texture.exr"
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"Y": np.zeros((5, 7), np.float32)}).write(str(path))
    check_image(path)
    content = path.read_bytes()
    at = content.index(b"dataWindow\x00box2i\x00") + len(b"dataWindow\x00box2i\x00") + 4
    window = struct.pack("<4i", 0, 0, 2**15 - 1, 2**15 - 1)
    path.write_bytes(content[:at] + window + content[at + 16 :])
    with pytest.raises(ValueError, match="32768 x 32768 texels"):
        check_image(path)


def test_what_is_no_image_is_left_to_the_renderer(tmp_path: Path) -> None:
    """Garbage raises nothing here: Mitsuba names what is wrong."""
    for name in ("a.png", "a.exr", "a.hdr"):
        (tmp_path / name).write_bytes(b"no image at all")
        check_image(tmp_path / name)


def test_images_of_nested_bsdfs_are_found() -> None:
    """A bitmap two levels down is looked at as well."""
    texture = {"type": "bitmap", "filename": "wood.png"}
    bsdf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": texture}}
    assert list(image_files(bsdf)) == [Path("wood.png")]
