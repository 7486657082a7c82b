"""Refuses huge images by their headers: a file of a kilobyte may unpack to more memory than there is."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

MAX_TEXELS = 2**27  # 1.6 GB as three float32 channels; more than any texture of a hidden scene has use for


def image_files(plugin: Mapping[str, object]) -> Iterator[Path]:
    """Yield the image files that a BSDF or texture dictionary names, nested ones included."""
    filename = plugin.get("filename")
    if plugin.get("type") == "bitmap" and isinstance(filename, (str, Path)):
        yield Path(filename)
    for part in plugin.values():
        if isinstance(part, Mapping):
            yield from image_files(part)


def check_image(path: Path) -> None:
    """Raise ValueError for an image that would unpack to more than ``MAX_TEXELS``; other formats pass unchecked."""
    size = _exr_size(path) if path.suffix.lower() == ".exr" else _bitmap_size(path)
    if size is not None and size[0] * size[1] > MAX_TEXELS:
        raise ValueError(f"{path} has {size[0]} x {size[1]} texels, need at most {MAX_TEXELS:_}. Scale it down.")


def _bitmap_size(path: Path) -> tuple[int, int] | None:
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # ours is the limit
            with Image.open(path) as image:
                return image.size
    except Image.DecompressionBombError as error:
        raise ValueError(f"{path} is too large an image: {error}") from error
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None  # Mitsuba reports what is wrong with it


def _exr_size(path: Path) -> tuple[int, int] | None:
    import OpenEXR

    try:
        with path.open("rb") as stream, OpenEXR.File(stream, header_only=True) as file:
            low, high = file.header()["dataWindow"]
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return None
    return int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
