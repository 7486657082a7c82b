"""Writes OpenEXR, PNG and GIF files; tone mapping, and false colours of polarised light."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]

SUFFIXES = {"exr": ".exr", "png": ".png", "gif": ".gif"}
STOKES_NAMES = ("I", "Q", "U", "V")
MIN_SIDE = 512  # pixels of a picture for the eye; smaller ones are enlarged by a whole number


def save_exr(picture: Float32, path: Path, stokes: bool = False) -> None:
    """Write (row, column, channel) as OpenEXR: Y, RGB, or the Stokes components I, Q, U, V.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    import OpenEXR

    names = STOKES_NAMES if stokes else ("Y",) if picture.shape[-1] == 1 else ("R", "G", "B")
    planes = {name: np.ascontiguousarray(picture[..., index]) for index, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    content = io.BytesIO()  # OpenEXR itself opens only names in UTF-8
    with OpenEXR.File(header, planes) as file:
        file.write(content)
    path.write_bytes(content.getbuffer())


def save_png(picture: Bytes, path: Path) -> None:
    """Write (row, column, 3) as PNG; small pictures enlarged.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    from PIL import Image

    Image.fromarray(_enlarged(picture)).save(path, format="PNG")


def save_animation(pictures: Bytes, path: Path, frames_per_second: float) -> None:
    """Write (frame, row, column, 3) as an animated GIF that starts over at its end.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    from PIL import Image

    # one palette for all, or colours would flicker
    brightest = Image.fromarray(_enlarged(pictures.max(axis=0)))
    palette = brightest.quantize(256, method=Image.Quantize.MEDIANCUT)
    # one by one: all of them enlarged take gigabytes
    indexed = (Image.fromarray(_enlarged(picture)).quantize(palette=palette) for picture in pictures)
    first = next(indexed)
    first.save(path, format="GIF", save_all=True, append_images=indexed, duration=1000 / frames_per_second, loop=0)


def tone_mapped(light: Float32) -> Bytes:
    """Return light (..., 1 or 3), 1 being white, as sRGB (..., 3); what is brighter keeps its colour."""
    light = np.maximum(np.broadcast_to(light, (*light.shape[:-1], 3)), 0)
    light = light / np.maximum(light.max(axis=-1, keepdims=True), 1)
    # IEC 61966-2-1
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


def degree_of_polarization(stokes: Float32) -> Float32:
    """Return sqrt(Q^2 + U^2 + V^2) / I of (..., 4), at most 1; 0 where there is no light."""
    polarized = np.linalg.norm(stokes[..., 1:], axis=-1)
    intensity = stokes[..., 0]
    return np.minimum(np.divide(polarized, intensity, out=np.zeros_like(intensity), where=intensity > 0), 1)


def angle_of_polarization(stokes: Float32) -> Float32:
    """Return the angle of linear polarisation from the reference direction (..., 4) -> (...,), 0 to pi [rad]."""
    return np.mod(np.arctan2(stokes[..., 2], stokes[..., 1]) / 2, np.pi)


def signed_colors(values: Float32) -> Bytes:
    """Return values from -1 to 1 as colours: green above zero, red below, as is the custom for Stokes components."""
    magnitude = np.sqrt(np.clip(np.abs(values), 0, 1))
    colors = np.zeros((*values.shape, 3))
    colors[..., 0] = np.where(values < 0, magnitude, 0)
    colors[..., 1] = np.where(values > 0, magnitude, 0)
    return np.round(255 * colors).astype(np.uint8)


def stokes_panels(stokes: Float32, scale: float) -> Bytes:
    """Return pictures (..., row, column, 4) as panels: I, Q, U above; V, degree and angle of polarisation below.

    ``scale`` makes the white of the intensity; Q, U and V are shown on a scale ten times finer. The angle is a hue, as
    strong as the light is bright and polarised.
    """
    from matplotlib.colors import hsv_to_rgb

    light = stokes * scale
    degree = degree_of_polarization(stokes)
    grey = tone_mapped(light[..., :1])
    brightness = grey[..., 0] / 255
    hue = angle_of_polarization(stokes) / np.pi
    angle = np.round(255 * hsv_to_rgb(np.stack([hue, np.ones_like(hue), np.sqrt(degree) * brightness], axis=-1)))
    shown_degree = tone_mapped((degree * (stokes[..., 0] > 0))[..., None])
    q, u, v = (signed_colors(10 * light[..., component]) for component in (1, 2, 3))
    above = np.concatenate([grey, q, u], axis=-2)
    below = np.concatenate([v, shown_degree, angle.astype(np.uint8)], axis=-2)
    return np.concatenate([above, below], axis=-3)


def _enlarged(picture: Bytes) -> Bytes:
    factor = max(1, -(-MIN_SIDE // max(picture.shape[:2])))
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)
