"""Plugins of a Mitsuba scene: their keys, and BSDFs and textures as mappings of a configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from nlosrender.config.issues import shown
from nlosrender.config.xml_shapes import shape_parameters
from nlosrender.config.xml_transforms import transform_steps
from nlosrender.config.xml_tree import SceneElement
from nlosrender.files.importing.scan_geometry import to_world_of
from nlosrender.files.importing.translation import Found

_PARTS = ("film", "sampler", "rfilter")  # elements whose keys are listed under their own names
_ATTRIBUTES = {*"xyz", "value", "angle", "origin", "target", "up"}  # of a step of a <transform>
_BOOLEANS = ("true", "false")
DEFAULT_DIFFUSE = {"type": "diffuse", "reflectance": 0.5}  # Mitsuba's, ours is white


def plugin_of(element: Element, with_id: Mapping[str, Element], file_name: Callable[[str], str]) -> dict[str, Any]:
    """Return a ``<bsdf>`` or ``<texture>``, or what a ``<ref>`` stands for, as a configuration has it.

    Parameters
    ----------
    element
        Checked, its file names absolute.
    with_id
        What may be referred to.
    file_name
        Returns how the configuration names a file.
    """
    element = with_id.get(element.get("id", ""), element) if element.tag == "ref" else element
    values = shape_parameters(element)
    plugin: dict[str, Any] = {"type": element.get("type", "")}
    for index, child in enumerate(element):
        name = child.get("name", "")
        if child.tag in ("bsdf", "texture", "ref"):
            plugin[name or f"{child.tag}{index}"] = plugin_of(child, with_id, file_name)
        elif child.tag == "transform":
            plugin[name] = to_world_of(transform_steps(child) or [])
        elif child.tag == "spectrum":
            plugin[name] = _spectrum(child, file_name)
        else:
            plugin[name] = file_name(values[name]) if name == "filename" else values.get(name, child.get("value"))
    return DEFAULT_DIFFUSE | plugin if plugin["type"] == "diffuse" else plugin


def _spectrum(element: Element, file_name: Callable[[str], str]) -> Any:
    if element.get("filename") is not None:
        return {"type": "spectrum", "filename": file_name(element.get("filename", ""))}
    pairs = [pair.split(":") for pair in re.split(r"[\s,]+", element.get("value", "").strip())]
    if len(pairs) == 1 and len(pairs[0]) == 1:
        return float(pairs[0][0])
    return {"type": "spectrum", "value": [[float(part) for part in pair] for pair in pairs]}


def found_keys(path: Path, elements: list[Element], prefix: str = "") -> Iterator[tuple[str, Found]]:
    """Yield the keys of integrator, sensor, film, sampler and emitter as ``film.width``, each with its place."""
    for element in elements:
        part = prefix or element.tag
        values = shape_parameters(element)
        yield f"{part}.type", Found(element.get("type", ""), place_in(path, element))
        for child in element:
            name = child.get("name") or child.tag
            if child.tag in _PARTS:
                yield from found_keys(path, [child], child.tag)
            else:
                said = child.get("value", child.get("type", child.tag))
                yield f"{part}.{name}", Found(values.get(name, said), place_in(path, child))


def mistakes(elements: Iterable[Element]) -> Iterator[tuple[Element, str]]:
    """Yield what Mitsuba refuses to read, and what is wrong with it: here it would be left out without a word."""
    for element in elements:
        names = [child.get("name") for child in element]
        for index, child in enumerate(element):
            if names[index] and names[index] in names[:index]:
                yield child, f"{names[index]} is given a second time; remove one of them"
            if element.tag in ("shape", "bsdf") and child.tag == "boolean" and child.get("value") not in _BOOLEANS:
                yield child, f"got {shown(child.get('value'))}, need true or false"
            if element.tag == "transform" and (set(child.attrib) - _ATTRIBUTES or transform_steps([child]) is None):
                said = " ".join([child.tag, *(f"{key}={value!r}" for key, value in child.attrib.items())])
                yield child, f"got <{said}>, need translate, rotate, scale, matrix or lookat, with their numbers"


def place_in(path: Path, element: Element) -> str:
    """Return file and line of an element of the scene in the file ``path``."""
    if not isinstance(element, SceneElement) or not element.line:
        return str(path)
    return f"{path.parent / element.file if element.file else path}:{element.line}"
