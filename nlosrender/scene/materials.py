"""BSDFs, emitters and the values in them: configuration -> Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import ConfigError, Problem
from nlosrender.scene.hidden_geometry import Radiance
from nlosrender.scene.images import check_image, image_files
from nlosrender.scene.transforms import transform_matrix

TEXEL_ROUNDING = 1e-3  # half-precision images and their filters may pass 1 a little
TRANSFORMS = ("to_world", "to_uv")  # keys of a plugin that hold a matrix or a list of steps


def load_bsdf(bsdf: Mapping[str, object], key: str) -> mi.BSDF:
    """Load a BSDF and look at its images.

    Raises
    ------
    ConfigError
        Mitsuba rejects it, or an image holds values that no reflectance has; ``key`` is named.
    """
    try:
        for image in image_files(bsdf):
            check_image(image)
        loaded = mi.load_dict(mitsuba_value(bsdf))
    except (RuntimeError, TypeError, ValueError) as error:
        raise rejected(key, f"Mitsuba rejects this BSDF: {first_line(error)}") from error
    for name, values in mi.traverse(loaded).items():
        if name.endswith(".data"):
            _check_texels(np.asarray(values), name.removesuffix(".data"), f"{key}.{name.split('.')[0]}")
    return loaded


def mitsuba_value(value: object) -> object:
    """Turn a value of a configuration's BSDF or shape dict into what Mitsuba loads.

    Mappings stay plugins, three numbers become an ``rgb`` colour, other numbers become floats.
    """
    if isinstance(value, Mapping):
        if value.get("type") == "rgb":
            return {"type": "rgb", "value": [float(channel) for channel in value["value"]]}
        return {
            key: mi.ScalarTransform4f(transform_matrix(item)) if key in TRANSFORMS else mitsuba_value(item)
            for key, item in value.items()
        }
    if isinstance(value, (tuple, list)):
        if len(value) == 3 and all(isinstance(item, (int, float)) for item in value):
            return {"type": "rgb", "value": [float(item) for item in value]}
        raise ValueError(f"got {list(value)}, need one number, three numbers [r, g, b], or a plugin with a type")
    return value


def area_emitter(radiance: Radiance) -> dict[str, object]:
    """Return the Mitsuba dict of what makes a surface an emitter."""
    return {"type": "area", "radiance": mitsuba_spectrum(radiance)}


def mitsuba_spectrum(value: Radiance) -> dict[str, object]:
    """Return a number or [r, g, b] of any size as a Mitsuba spectrum."""
    if isinstance(value, tuple):
        return {"type": "rgb", "value": list(value)}
    return {"type": "uniform", "value": float(value)}


def _check_texels(values: NDArray, name: str, key: str) -> None:
    """Refuse images with values no reflectance has; numbers in the configuration have been checked before."""
    if values.dtype.kind == "u":
        return  # 8-bit images stand for 0 to 1
    most = 1.0 if "reflectance" in name or "color" in name else float("inf")
    wrong = ~((values >= 0) & (values <= most * (1 + TEXEL_ROUNDING)) & np.isfinite(values))
    if wrong.any():
        found, need = float(values[wrong][0]), "from 0 to 1" if most == 1 else "finite and not negative"
        raise rejected(
            key, f"{int(wrong.sum())} of {values.size} values of the image, such as {found:g}, are not {need}."
        )


def rejected(key: str, message: str) -> ConfigError:
    """Return the error about an item of the configuration."""
    return ConfigError(Problem("", key, message))


def first_line(error: BaseException) -> str:
    """Return what one of Mitsuba's errors says, on one line."""
    return " ".join(str(error).split())[:400]
