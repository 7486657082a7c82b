"""Loads BSDFs and emitters of a configuration into Mitsuba, and checks what it does not."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import ConfigError
from nlosrender.scene.loading import exact_blend
from nlosrender.scene.loading.image_size import check_image, image_files
from nlosrender.scene.surfaces import Radiance
from nlosrender.scene.transforms import transform_matrix

TEXEL_ROUNDING = 1e-3  # half-precision images, of 2^-11, and their filters may pass 1 a little
BENDING = ("RoughDielectric", "Principled")  # BSDF classes that refract in directions a connection can take
LOADED = "loaded"  # the only key of a BSDF dict that holds a Mitsuba object
TRANSFORMS = ("to_world", "to_uv")  # keys of a plugin that hold a matrix or a list of steps
_SOURCE = re.compile(r"\[\w+\.(?:cpp|h|py):\d+\] |At dictionary node \"root\": ")


def load_bsdf(bsdf: Mapping[str, object], key: str) -> mi.BSDF:
    """Load a BSDF and look at its images; of ``{LOADED: bsdf}``, which a program has loaded, it is that one.

    Raises
    ------
    ConfigError
        Mitsuba rejects it, or an image holds values that no reflectance has; ``key`` is named.
    """
    if LOADED in bsdf:
        return bsdf[LOADED]
    try:
        for image in image_files(bsdf):
            check_image(image)
        loaded = mi.load_dict(mitsuba_value(bsdf))
    except (RuntimeError, TypeError, ValueError) as error:
        raise ConfigError.at(key, f"Mitsuba rejects this BSDF: {first_line(error)}") from error
    for name, values in _parameters(loaded, "", (".data",)):
        _check_texels(values, name.removesuffix(".data"), f"{key}.{name.split('.')[0]}")
    return loaded


def mitsuba_value(value: object) -> object:
    """Turn a value of a configuration's BSDF or shape dict into what Mitsuba loads.

    Mappings stay plugins, three numbers become an ``rgb`` colour, other numbers become floats.
    """
    if isinstance(value, Mapping):
        if value.get("type") == "rgb":
            return {"type": "rgb", "value": [float(channel) for channel in value["value"]]}
        loaded = {
            key: mi.ScalarTransform4f(transform_matrix(item)) if key in TRANSFORMS else mitsuba_value(item)
            for key, item in value.items()
        }
        return loaded | ({"type": exact_blend.NAME} if value.get("type") == exact_blend.MITSUBA_NAME else {})
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


def check_surface(shape: mi.Shape, key: str) -> None:
    """Refuse a surface whose BSDF Mitsuba loads but cannot evaluate, or whose refraction is ambiguous.

    Raises
    ------
    ConfigError
        ``key`` is named.
    """
    bsdf = shape.bsdf()
    what = f"{shape.class_name()} {shape.id()!r}" if shape.id() else shape.class_name()
    try:
        index_behind(bsdf)
    except ValueError as error:
        raise ConfigError.at(key, f"{what}: {error}.") from error
    point = dr.zeros(mi.SurfaceInteraction3f)
    point.shape = mi.ShapePtr(shape)
    point.wi = mi.Vector3f(0.6, 0, 0.8)
    point.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    try:
        bsdf.sample(mi.BSDFContext(), point, 0.5, mi.Point2f(0.5))  # recorded, never run
    except RuntimeError as error:
        advice = "Bump and normal maps need a bitmap with raw: true, a normal map one of three channels."
        raise ConfigError.at(key, f"{what}: Mitsuba cannot evaluate its BSDF: {first_line(error)}. {advice}") from error


def index_behind(bsdf: mi.BSDF) -> float:
    """Return the relative refractive index behind a surface, for straight connections across it; 1 where none bends.

    Smooth glass does not count: no connection crosses it.

    Raises
    ------
    ValueError
        The BSDF is made of several, and light that crosses it comes into different media.
    """
    connected = mi.BSDFFlags.DiffuseTransmission | mi.BSDFFlags.GlossyTransmission
    indices = sorted({_index_of(part) for part in _innermost(bsdf) if part.flags() & connected})
    if len(indices) > 1:
        found = " and ".join(f"{index:.6g}" for index in indices)
        raise ValueError(f"its parts let light into media of the refractive indices {found}, need one medium behind it")
    return indices[0] if indices else 1.0


def medium_warnings(surfaces: Iterable[tuple[str, mi.Shape]]) -> tuple[str, ...]:
    """Return a sentence for each (key, shape) that light enters bent and unbent, such as a mask over glass.

    Refractive indices are counted at every crossing, and a crossing that does not bend counts none.
    """
    return tuple(
        f"{key}: light crosses it bent as well as unbent, and which medium it is in behind is a guess: arrival times "
        "there are wrong. Leave out the mask, null or thin part of its BSDF, or its glass."
        for key, shape in surfaces
        if shape.bsdf().flags() & mi.BSDFFlags.Null and _bends_in_part(shape.bsdf())
    )


def _bends_in_part(bsdf: mi.BSDF) -> bool:
    bent = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission
    parts = list(_innermost(bsdf))
    bends = any(part.class_name() in (*BENDING, "SmoothDielectric") and part.flags() & bent for part in parts)
    return bends and any(part.flags() & mi.BSDFFlags.Null for part in parts)


def _innermost(bsdf: mi.BSDF) -> Iterator[mi.BSDF]:
    """Yield the BSDFs in a BSDF that hold no other and that light meets: those in a blend, a mask, under a bump map.

    A BSDF that holds none yields itself, and a mask with holes an empty BSDF for them.
    """
    holders = mi.traverse(bsdf).hierarchy  # of every part, textures too: what it is part of, and how deep
    parts = [part for part, (holder, _) in holders.items() if isinstance(part, mi.BSDF) and holder is bsdf]
    if bsdf.class_name() == "MaskBSDF":
        low, high = _extremes(bsdf, "opacity")
        parts = parts if high > 0 else []
        if low < 1:
            yield mi.load_dict({"type": "null"})
    elif bsdf.class_name() == "BlendBSDF":
        low, high = _extremes(bsdf, "weight")  # of the second one
        both = (parts[0], low < 1), (parts[-1], high > 0)  # two that are equal are one object
        parts = [part for part, is_met in both if is_met]
    elif not parts:
        yield bsdf
    for part in parts:
        yield from _innermost(part)


def _extremes(bsdf: mi.BSDF, texture: str) -> tuple[float, float]:
    """Return the least and the largest value of a texture of a BSDF; 0 and 1 where they are not known."""
    found = _parameters(bsdf, f"{texture}.", (".value", ".data"))
    values = [part / 255 if part.dtype.kind == "u" else part for _, part in found]  # 8 bits: 0 to 1
    if not values:
        return 0.0, 1.0
    return float(min(part.min() for part in values)), float(max(part.max() for part in values))


def _parameters(bsdf: mi.BSDF, prefix: str, suffixes: tuple[str, ...]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield names and values of the parameters of a BSDF's textures."""
    parameters = mi.traverse(bsdf)
    for name in parameters.keys():  # noqa: SIM118  # not its items: some of other parameters cannot be read
        if name.startswith(prefix) and name.endswith(suffixes):
            yield name, np.ravel(np.asarray(parameters[name]))


def _index_of(bsdf: mi.BSDF) -> float:
    if bsdf.class_name() not in BENDING:
        return 1.0
    parameters = dict(mi.traverse(bsdf))
    if "eta" in parameters:
        return float(np.ravel(parameters["eta"])[0])
    # a principled BSDF has its reflectance along the normal, 0.08 specular = ((eta - 1) / (eta + 1))^2
    return float(2 / (1 - math.sqrt(0.08 * np.ravel(parameters["specular"])[0])) - 1)


def _check_texels(values: NDArray[Any], name: str, key: str) -> None:
    """Refuse images with values no reflectance has; numbers in the configuration have been checked before."""
    if values.dtype.kind == "u":
        return  # 8-bit images stand for 0 to 1
    most = 1.0 if any(word in name for word in ("reflectance", "color", "albedo", "diffuse")) else float("inf")
    wrong = ~((values >= 0) & (values <= most * (1 + TEXEL_ROUNDING)) & np.isfinite(values))
    if wrong.any():
        need = "from 0 to 1" if most == 1 else "finite and not negative"
        message = f"{int(wrong.sum())} of {values.size} values of the image, such as {float(values[wrong][0]):g}"
        raise ConfigError.at(key, f"{message}, are not {need}.")


def first_line(error: BaseException) -> str:
    """Return what one of Mitsuba's errors says, on one line and without the places in Mitsuba's own source."""
    return _SOURCE.sub("", " ".join(str(error).split())).rstrip(".!")[:400]
