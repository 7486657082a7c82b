"""``<shape>`` and ``<bsdf>`` elements of a Mitsuba scene, held to the rules of the same plugins in a YAML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from nlosrender.config.bsdf import check_parameters
from nlosrender.config.plugin_check import PluginCheck
from nlosrender.config.shape_check import check_shape
from nlosrender.config.xml_transforms import numbers_of, transform_steps, vector_of


def shape_parameters(shape: Element) -> dict[str, Any]:
    """Return type, numbers, points and texts of a ``<shape>``; its transform, BSDF and emitter are not among them.

    What is not of its kind, such as a float that is no number, stays text.
    """
    return {"type": shape.get("type", "")} | dict(_values(shape))


def _values(element: Element) -> Iterator[tuple[str, Any]]:
    for item in element:
        if item.tag in _VALUES:
            try:
                yield item.get("name", ""), _VALUES[item.tag](item)
            except ValueError:
                yield item.get("name", ""), item.get("value", "")


def placement(shape: Element) -> list[Any]:
    """Return the ``to_world`` of a ``<shape>`` as steps, each a ``to_world`` of its own, the first applied first."""
    transform = next((item for item in shape.findall("transform") if item.get("name") == "to_world"), None)
    return [] if transform is None else transform_steps(transform) or []


def check_xml_shape(shape: Element, folder: Path) -> None:
    """Refuse a ``<shape>`` that a YAML file could not hold either, such as one without extent.

    Raises
    ------
    ValueError
        Says which shape, what is wrong and what is needed.
    """
    check = PluginCheck(folder)
    check_shape(check, shape_parameters(shape))
    for step in placement(shape):
        check.transform(step, ("to_world",))
    _raise_first(check, shape)


def check_xml_bsdf(bsdf: Element, folder: Path) -> None:
    """Refuse a ``<bsdf>`` with a number that no such material has; textures and nested BSDFs have their own checks.

    Raises
    ------
    ValueError
        Says which BSDF, what is wrong and what is needed.
    """
    check = PluginCheck(folder)
    check_parameters(check, bsdf.get("type", ""), dict(_values(bsdf)), [item.get("name", "") for item in bsdf])
    _raise_first(check, bsdf)


def _raise_first(check: PluginCheck, element: Element) -> None:
    for issue in check.issues:
        where = "".join(f"{key}: " for key in issue.path[:1])
        raise ValueError(f"{named(element)}: {where}{issue.message.removesuffix('.')}")


def named(element: Element) -> str:
    """Return the tag of an element with its type and, if it has one, its id."""
    identity = f" id={element.get('id')!r}" if element.get("id") else ""
    return f"<{element.tag} type={element.get('type')!r}{identity}>"


def _color(item: Element) -> Any:
    numbers = numbers_of(item.get("value"), (1, 3))
    return numbers if len(set(numbers)) > 1 else numbers[0]


_VALUES: Mapping[str, Callable[[Element], Any]] = {
    "boolean": lambda item: {"true": True, "false": False}.get(item.get("value", ""), item.get("value", "")),
    "float": lambda item: float(item.get("value", "")),
    "rgb": _color,
    "integer": lambda item: int(item.get("value", "")),
    "point": vector_of,
    "string": lambda item: item.get("value", ""),
    "vector": vector_of,
}
