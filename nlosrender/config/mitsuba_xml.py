"""``scene.mitsuba``: a whole scene as Mitsuba XML, read and checked here before Mitsuba sees any of it.

What reaches Mitsuba is a tree of known plugins with absolute file names: nothing that loads code, includes other
files, or is known to end the process. Integrators and samplers are left out, and of the film all but its size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from pydantic import ValidationInfo

from nlosrender.config.bsdf_table import BSDF_TYPES, COLORED_TYPES, SHAPE_TYPES, TEXTURE_REQUIRED, TEXTURE_TYPES
from nlosrender.config.fields import Checked
from nlosrender.config.plugin_check import config_folder, existing_file
from nlosrender.config.refusal import Fault, listed, refuse
from nlosrender.config.xml_numbers import check_numbers

MAX_XML_BYTES = 16 * 2**20
MAX_ELEMENTS = 100_000
MAX_DEPTH = 64  # of elements in each other; scenes have five or six
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
    try:
        with path.open("rb") as file:
            text = file.read(MAX_XML_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from error
    if len(text) > MAX_XML_BYTES:
        raise ValueError(f"it is larger than {MAX_XML_BYTES // 2**20} MiB; keep meshes in files of their own")
    root = _parsed(text)
    if root.tag != "scene":
        raise ValueError(f"its root is <{root.tag}>, need <scene>")
    _substitute(root)
    size = _keep_one_sensor(root)
    _clean(root, path.parent)
    if size is not None:
        _add_film(root, size)
    return root, size


def is_colored_xml(root: Element) -> bool:
    """Return whether a colour occurs in a scene, or may: textures from files and spectra count as coloured."""
    for element in root.iter():
        if element.get("type") in COLORED_TYPES:
            return True
        value = element.get("value", "").strip()
        if element.tag == "rgb" and len(set(_channels(value))) > 1:
            return True
        if element.tag == "spectrum" and (":" in value or element.get("filename") is not None):
            return True
    return False


def mesh_files(root: Element) -> Iterator[tuple[str, str]]:
    """Yield file name and kind (``ply`` or ``obj``) of every mesh of a scene."""
    for shape in root.iter("shape"):
        if shape.get("type") in ("ply", "obj"):
            yield _string(shape, "filename") or "", str(shape.get("type"))


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


class _LimitedTree(ElementTree.TreeBuilder):
    """Builds a scene's tree, or says what no scene needs while it is read, before it grows."""

    def __init__(self) -> None:
        super().__init__()
        self._count = self._depth = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it declares a document type or entities, which no Mitsuba scene needs")

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self._count += 1
        self._depth += 1
        if self._count > MAX_ELEMENTS:
            raise ValueError(f"it has more than {MAX_ELEMENTS} elements")
        if self._depth > MAX_DEPTH:
            raise ValueError(f"its elements lie in each other more than {MAX_DEPTH} deep")
        return super().start(tag, attrs)

    def end(self, tag: str) -> Element:
        self._depth -= 1
        return super().end(tag)


def _parsed(text: bytes) -> Element:
    parser = ElementTree.XMLParser(target=_LimitedTree())
    try:
        parser.feed(text)
        root: Element = parser.close()
    except (ElementTree.ParseError, LookupError) as error:  # LookupError: an encoding nobody knows
        raise ValueError(f"it is not well-formed XML: {error}") from error
    return root


def _channels(value: str) -> list[str]:
    if value.startswith("#"):
        return [value[1 + 2 * i : 3 + 2 * i].lower() for i in range(3)]
    return _COLOR.split(value)


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
        film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
        for name, pixels in zip(("width", "height"), size, strict=True):
            ElementTree.SubElement(film, "integer", name=name, value=str(pixels))


def _clean(element: Element, folder: Path) -> None:
    """Check an element and everything in it; drop what is left out, make file names absolute."""
    for child in list(element):
        if child.tag in _LEFT_OUT:
            element.remove(child)
            continue
        if child.tag not in _PLUGINS and child.tag not in _PLAIN:
            raise ValueError(f"<{child.tag}> is not supported; need {listed(sorted((*_PLUGINS, *_PLAIN)))}")
        kind, allowed = child.get("type", ""), _PLUGINS.get(child.tag, ())
        if allowed and kind not in allowed:
            raise ValueError(f"<{child.tag} type={kind!r}> is not supported; need one of {listed(allowed)}")
        if kind and not allowed:
            raise ValueError(f"<{child.tag}> has a type {kind!r}, which is not supported")
        for name in TEXTURE_REQUIRED.get(kind, ()) if child.tag == "texture" else ():
            if all(item.get("name") != name for item in child):
                raise ValueError(f"<texture type={kind!r}> has no {name}")
        if kind in ("ply", "obj", "envmap") and _string(child, "filename") is None:
            raise ValueError(f"<{child.tag} type={kind!r}> has no filename")
        check_numbers(child)
        _absolute_files(child, folder)
        _clean(child, folder)


def _absolute_files(element: Element, folder: Path) -> None:
    for key in _file_keys(element):
        if element.get(key) is not None:
            file, problem = existing_file(str(element.get(key)), folder)
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
