"""``scene.mitsuba``: a whole scene as Mitsuba XML, read and checked here before Mitsuba sees any of it.

What reaches Mitsuba is a tree of known plugins with absolute file names: nothing that loads code, includes other
files, or is known to end the process. Integrators and samplers are left out, and of the film all but its size.

``mitsuba.parser`` does not do for this (3.9.1): values are folded into properties that have no line of their own, files
are included without a bound on their number, 100 000 elements in each other end the process, a parameter without value
stops it even where nobody reads it, and ``validate`` would have to load Mitsuba.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated
from xml.etree.ElementTree import Element, SubElement

from pydantic import ValidationInfo

from nlosrender.config.bsdf_table import (
    BSDF_TYPES,
    COLORED_TYPES,
    NO_METAL,
    SHAPE_TYPES,
    TEXTURE_REQUIRED,
    TEXTURE_TYPES,
)
from nlosrender.config.fields import Checked
from nlosrender.config.issues import InvalidValue, invalid_value
from nlosrender.config.plugin_check import config_folder, existing_file, mitsuba_file
from nlosrender.config.xml_expansion import LEFT_OUT, START, Expansion
from nlosrender.config.xml_numbers import check_numbers
from nlosrender.config.xml_shapes import check_xml_bsdf, check_xml_shape
from nlosrender.config.xml_transforms import check_rotation
from nlosrender.config.xml_tree import SceneElement, parsed_xml, prefixed_with_place
from nlosrender.errors import ValidationIssue, did_you_mean

DEFAULT_FILM = (768, 576)  # Mitsuba's
_PLUGINS = {  # element: the types it may have
    "scene": (),
    "bsdf": BSDF_TYPES,
    "emitter": ("area", "constant", "directional", "envmap", "point", "projector", "spot"),
    "shape": SHAPE_TYPES,
    "texture": TEXTURE_TYPES,
    "spectrum": (),
    "sensor": ("perspective",),
}
_VALUES = ("boolean", "float", "integer", "point", "ref", "rgb", "string", "vector")
_PLAIN = (*_VALUES, "transform", "lookat", "matrix", "rotate", "scale", "translate")
_RULES = {"bsdf": check_xml_bsdf, "shape": check_xml_shape}
_LEFT_OUT = ("film", *LEFT_OUT)
_MEDIA = "participating media are not rendered; remove it, and what refers to it"
_ADVICE = {  # what is often found and not supported: what to do instead
    "medium": _MEDIA,
    "phase": _MEDIA,
    "volume": _MEDIA,
    "instance": "write each of the shapes out, with a <transform> of its own",
    "shapegroup": "write each of the shapes out, with a <transform> of its own",
    "srgb": "write <rgb> with linear values",
}
_COLOR = re.compile(r"[\s,]+")


def read_mitsuba_xml(path: Path) -> tuple[Element, tuple[int, int] | None]:
    """Read a Mitsuba scene and leave of it what may be loaded.

    Parameters
    ----------
    path
        The XML file; relative file names in it start at its folder.

    Returns
    -------
    Element
        The scene, with at most one sensor.
    tuple of int, or None
        Columns and rows of that sensor's film; None without a sensor.

    Raises
    ------
    ValueError
        The file is no Mitsuba scene, too large, or holds something that is not allowed; says what.
    """
    expansion = Expansion(path)
    root = expansion.read()
    if isinstance(root, SceneElement):
        root.included = tuple(expansion.files[1:])
    size = _keep_one_sensor(root)
    _clean(root, expansion.folders)
    if size is not None:
        _add_film(root, size)
    return root, size


def checked_bsdf(text: str, folder: Path) -> Element:
    """Return the one ``<bsdf>`` of a piece of XML, held to the rules of scenes; file names start at ``folder``.

    Raises
    ------
    ValueError
        The text is no XML, holds something else, or something that is not allowed; says what.
    """
    root = parsed_xml(f"<scene>{text}</scene>".encode())
    if [child.tag for child in root] != ["bsdf"]:
        raise ValueError("need one <bsdf>")
    _clean(root, [folder])
    return root[0]


def is_colored_xml(root: Element) -> bool:
    """Return whether a colour occurs in a scene, or may: metals, textures from files and spectra count as coloured."""
    for element in root.iter():
        if element.get("type") in (*COLORED_TYPES, "envmap"):
            return True
        value = element.get("value", "").strip()
        if element.tag == "string" and element.get("name") == "material" and value != NO_METAL:
            return True
        if element.tag == "rgb" and len(set(_COLOR.split(value))) > 1:
            return True
        if element.tag == "spectrum" and (":" in value or element.get("filename") is not None):
            return True
    return False


def image_files(root: Element) -> Iterator[Path]:
    """Yield the file of every image of a scene."""
    for element in root.iter():
        if element.get("type") in ("bitmap", "envmap"):
            yield Path(_string(element, "filename") or "")


def named_files(root: Element) -> Iterator[Path]:
    """Yield every file a scene names: included scenes, meshes, images, measured materials and spectra."""
    yield from root.included if isinstance(root, SceneElement) else ()
    for element in root.iter():
        for key in _file_keys(element):
            if element.get(key) is not None:
                yield Path(str(element.get(key)))


def _keep_one_sensor(root: Element) -> tuple[int, int] | None:
    """Leave the first perspective camera whose film can be used, and return the size of that film."""
    sizes = {sensor: _film_size(sensor) for sensor in root.iter("sensor") if sensor.get("type") == "perspective"}
    kept = next((sensor for sensor in root.findall("sensor") if isinstance(sizes.get(sensor), tuple)), None)
    for holder in list(root.iter()):
        for sensor in holder.findall("sensor"):  # some lie in the shape that they measure
            if sensor is not kept:
                holder.remove(sensor)
    if kept is None:
        return None
    for part in list(kept):
        if part.tag not in (*_PLAIN, "film") or part.tag == "ref":  # such as the medium it lies in
            kept.remove(part)
    return sizes[kept]


def _film_size(sensor: Element) -> tuple[int, int] | None:
    """Return columns and rows of a sensor's film; None for one that is cropped, or sized by a parameter without value.

    Raises
    ------
    ValueError
        A size is no number of pixels.
    """
    film = sensor.find("film")
    size = {} if film is None else {item.get("name"): item.get("value", "") for item in film.findall("integer")}
    numbers = [size.get(key, str(default)) for key, default in zip(("width", "height"), DEFAULT_FILM, strict=True)]
    if any(str(name).startswith("crop") for name in size) or any("$" in number for number in numbers):
        return None
    if not all(number.strip().isdecimal() and len(number) < 8 and int(number) > 0 for number in numbers):
        with prefixed_with_place(sensor if film is None else film):
            raise ValueError(f"its film has {numbers[0]} x {numbers[1]} pixels, need two integers >= 1")
    return int(numbers[0]), int(numbers[1])


def _add_film(root: Element, size: tuple[int, int]) -> None:
    """Give the sensor a plain film of its old film's size: Mitsuba's fov_axis and focal_length depend on its aspect."""
    for sensor in root.findall("sensor"):
        film = SubElement(sensor, "film", type="hdrfilm")
        for name, pixels in zip(("width", "height"), size, strict=True):
            SubElement(film, "integer", name=name, value=str(pixels))


def _clean(element: Element, folders: Sequence[Path]) -> None:
    """Check an element and everything in it; drop what is left out, make file names absolute."""
    for child in list(element):
        if child.tag in _LEFT_OUT:
            element.remove(child)
            continue
        with prefixed_with_place(child):
            _check(child, folders)
        _clean(child, folders)
        if child.tag in _RULES:  # after its parts, whose line is the nearer one
            with prefixed_with_place(child):
                _RULES[child.tag](child, folders[-1])


def _check(element: Element, folders: Sequence[Path]) -> None:
    """Refuse an element that is not supported or lacks something, and make the file it names absolute."""
    tag, kind, allowed = element.tag, element.get("type", ""), _PLUGINS.get(element.tag, ())
    if tag not in _PLUGINS and tag not in _PLAIN:
        need = _ADVICE.get(tag) or f"need {', '.join(sorted((*_PLUGINS, *_PLAIN)))}"
        raise ValueError(f"<{tag}> is not supported; {need}")
    if allowed and kind not in allowed:
        hint = did_you_mean(kind, allowed)
        need = _ADVICE.get(kind) or f"need one of {', '.join(allowed)}" + (f". {hint}" if hint else "")
        raise ValueError(f"<{tag} type={kind!r}> is not supported; {need}")
    if kind and not allowed:
        raise ValueError(f"<{tag}> has a type {kind!r}, which is not supported")
    for name in TEXTURE_REQUIRED.get(kind, ()) if tag == "texture" else ():
        if all(item.get("name") != name for item in element):
            raise ValueError(f"<texture type={kind!r}> has no {name}")
    if kind in ("ply", "obj", "serialized", "envmap") and _string(element, "filename") is None:
        raise ValueError(f"<{tag} type={kind!r}> has no filename")
    check_numbers(element)
    if tag == "rotate":
        check_rotation(element)
    if tag == "boolean":
        element.set("value", element.get("value", "").lower())  # Mitsuba takes True for true
    _absolute_files(element, folders)


def _absolute_files(element: Element, folders: Sequence[Path]) -> None:
    for key in _file_keys(element):
        if element.get(key) is not None:
            name = str(element.get(key))
            tried = [mitsuba_file(name, folder, START) for folder in folders]
            file, problem = next((found for found in tried if not found[1]), tried[-1])
            if problem:
                raise ValueError(problem.removesuffix("."))
            element.set(key, str(file))


def _file_keys(element: Element) -> tuple[str, ...]:
    """Return the attributes in which an element may name a file."""
    return ("value",) if element.tag == "string" and element.get("name") == "filename" else ("filename",)


def _string(element: Element, name: str) -> str | None:
    return next((item.get("value") for item in element.findall("string") if item.get("name") == name), None)


def _xml_file(value: object, validation: ValidationInfo) -> Path:
    if not isinstance(value, str) or not value.lower().endswith(".xml"):
        raise invalid_value(value, "the name of a Mitsuba .xml file")
    path, problem = existing_file(value, config_folder(validation))
    if problem:
        raise InvalidValue(ValidationIssue((), problem))
    try:
        read_mitsuba_xml(path)
    except ValueError as error:
        raise InvalidValue(ValidationIssue((), f"{path}: {error}.")) from error
    return path


MitsubaXml = Annotated[Path, Checked(_xml_file, {"type": "string", "pattern": r"\.[xX][mM][lL]$"}, with_context=True)]
