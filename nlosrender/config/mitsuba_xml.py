"""``scene.mitsuba``: a whole scene as Mitsuba XML, read and checked here before Mitsuba sees any of it.

What reaches Mitsuba is a tree of known plugins with absolute file names: nothing that loads code, includes other
files, or is known to end the process. Integrators and samplers are left out, and of the film all but its size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
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
from nlosrender.config.plugin_check import config_folder, existing_file, mitsuba_file
from nlosrender.config.refusal import Fault, listed, refuse
from nlosrender.config.xml_numbers import check_numbers
from nlosrender.config.xml_shapes import at_line, check_xml_bsdf, check_xml_shape
from nlosrender.config.xml_transforms import check_rotation
from nlosrender.config.xml_tree import MAX_XML_BYTES, read_xml

DEFAULT_FILM = (768, 576)  # Mitsuba's
_PLUGINS = {  # element: the types it may have
    "scene": (),
    "bsdf": BSDF_TYPES,
    "emitter": ("area", "constant", "directional", "envmap", "point", "projector", "spot"),
    # what Mitsuba's own readers cannot be trusted with, or the renderer cannot check, stays out
    "shape": tuple(kind for kind in SHAPE_TYPES if kind != "serialized"),
    "texture": TEXTURE_TYPES,
    "spectrum": (),
    "sensor": ("perspective",),
}
_VALUES = ("boolean", "float", "integer", "point", "ref", "rgb", "string", "vector")
_PLAIN = (*_VALUES, "transform", "lookat", "matrix", "rotate", "scale", "translate")
_RULES = {"bsdf": check_xml_bsdf, "shape": check_xml_shape}
_LEFT_OUT = ("film", "integrator", "sampler")
_VARIABLE = re.compile(r"\$\{?(\w+)\}?")
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
    root = read_xml(path)
    if root.tag != "scene":
        raise ValueError(f"its root is <{root.tag}>, need <scene>")
    _substitute(root)
    size = _keep_one_sensor(root)
    _clean(root, path.parent)
    if size is not None:
        _add_film(root, size)
    return root, size


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
    """Yield every file a scene names: meshes, images, measured materials and spectra."""
    for element in root.iter():
        for key in _file_keys(element):
            if element.get(key) is not None:
                yield Path(str(element.get(key)))


def _substitute(root: Element) -> None:
    defaults = {d.get("name", ""): d.get("value", "") for d in root.findall("default")}
    for default in root.findall("default"):
        root.remove(default)

    def value_of(match: re.Match[str]) -> str:
        if match[1] not in defaults:
            raise ValueError(f"${match[1]} has no <default>")
        return defaults[match[1]]

    longest = max((len(value) for value in defaults.values()), default=0)
    room = MAX_XML_BYTES  # for all that is put in: a short file could ask for more than there is memory
    for element in root.iter():
        for key, text in element.attrib.items():
            if "$" not in text:
                continue
            room -= text.count("$") * longest
            if room < 0:
                raise ValueError("what its <default>s stand for is too large")
            element.set(key, _VARIABLE.sub(value_of, text))


def _keep_one_sensor(root: Element) -> tuple[int, int] | None:
    """Leave the first perspective camera of a scene, and return the size of its film."""
    sensors = root.findall("sensor")
    kept = next((sensor for sensor in sensors if sensor.get("type") == "perspective"), None)
    for sensor in sensors:
        if sensor is not kept:
            root.remove(sensor)
    if kept is None:
        return None
    film = kept.find("film")
    size = {} if film is None else {item.get("name"): item.get("value", "") for item in film.findall("integer")}
    if any(str(name).startswith("crop") for name in size):
        raise ValueError("its film is cropped, which is not supported; remove the crop or give capture.camera")
    numbers = [size.get(key, str(default)) for key, default in zip(("width", "height"), DEFAULT_FILM, strict=True)]
    if not all(number.strip().isdecimal() and len(number) < 8 and int(number) > 0 for number in numbers):
        raise ValueError(f"its film has {numbers[0]} x {numbers[1]} pixels, need two integers >= 1")
    return int(numbers[0]), int(numbers[1])


def _add_film(root: Element, size: tuple[int, int]) -> None:
    """Give the sensor a plain film of its old film's size: Mitsuba's fov_axis and focal_length depend on its aspect."""
    for sensor in root.findall("sensor"):
        film = SubElement(sensor, "film", type="hdrfilm")
        for name, pixels in zip(("width", "height"), size, strict=True):
            SubElement(film, "integer", name=name, value=str(pixels))


def _clean(element: Element, folder: Path) -> None:
    """Check an element and everything in it; drop what is left out, make file names absolute."""
    for child in list(element):
        if child.tag in _LEFT_OUT:
            element.remove(child)
            continue
        with _told_by_line(child):
            _check(child, folder)
        _clean(child, folder)
        if child.tag in _RULES:  # after its parts, whose line is the nearer one
            with _told_by_line(child):
                _RULES[child.tag](child, folder)


@contextmanager
def _told_by_line(element: Element) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(at_line(element, error)) from error


def _check(element: Element, folder: Path) -> None:
    """Refuse an element that is not supported or lacks something, and make the file it names absolute."""
    tag, kind, allowed = element.tag, element.get("type", ""), _PLUGINS.get(element.tag, ())
    if tag not in _PLUGINS and tag not in _PLAIN:
        raise ValueError(f"<{tag}> is not supported; need {listed(sorted((*_PLUGINS, *_PLAIN)))}")
    if allowed and kind not in allowed:
        raise ValueError(f"<{tag} type={kind!r}> is not supported; need one of {listed(allowed)}")
    if kind and not allowed:
        raise ValueError(f"<{tag}> has a type {kind!r}, which is not supported")
    for name in TEXTURE_REQUIRED.get(kind, ()) if tag == "texture" else ():
        if all(item.get("name") != name for item in element):
            raise ValueError(f"<texture type={kind!r}> has no {name}")
    if kind in ("ply", "obj", "envmap") and _string(element, "filename") is None:
        raise ValueError(f"<{tag} type={kind!r}> has no filename")
    check_numbers(element)
    if tag == "rotate":
        check_rotation(element)
    _absolute_files(element, folder)


def _absolute_files(element: Element, folder: Path) -> None:
    for key in _file_keys(element):
        if element.get(key) is not None:
            file, problem = mitsuba_file(str(element.get(key)), folder)
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
        raise refuse(value, "the name of a Mitsuba .xml file")
    path, problem = existing_file(value, config_folder(validation))
    if problem:
        raise Fault((), problem).as_error()
    try:
        read_mitsuba_xml(path)
    except ValueError as error:
        raise Fault((), f"{path}: {error}.").as_error() from error
    return path


MitsubaXml = Annotated[Path, Checked(_xml_file, {"type": "string", "pattern": r"\.[xX][mM][lL]$"}, with_context=True)]
