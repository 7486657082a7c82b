"""XML -> elements that know their line, read with bounds on size and depth; and back to text with a map of lines."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

MAX_XML_BYTES = 16 * 2**20
MAX_ELEMENTS = 100_000
MAX_DEPTH = 64  # of elements in each other; scenes have five or six


class SceneElement(Element):
    """An element and where it stands in its file."""

    line: int = 0  # counted from 1; 0: it does not come from a file
    file: str = ""  # name of an included file; empty: the scene's own
    included: tuple[Path, ...] = ()  # of a scene's root: files whose contents are in it

    @classmethod
    def like(cls, other: Element, tag: str, **attributes: str) -> SceneElement:
        """Return a new element that stands where another one does."""
        element = cls(tag, attributes)
        if isinstance(other, SceneElement):
            element.line, element.file = other.line, other.file
        return element


def place_of(element: Element) -> str:
    """Return where an element begins: its line, counted from 1, and its file where that is an included one."""
    if not isinstance(element, SceneElement):
        return "line 0"
    return f"{element.file}, line {element.line}" if element.file else f"line {element.line}"


@contextmanager
def prefixed_with_place(element: Element) -> Iterator[None]:
    """Put the place of an element before what is raised; the innermost element's place stays the only one."""
    try:
        yield
    except PlacedError:
        raise
    except ValueError as error:
        raise PlacedError(f"{place_of(element)}: {error}") from error


class PlacedError(ValueError):
    """Says where in a scene something is wrong."""


def read_xml(path: Path, name: str = "") -> Element:
    """Read an XML file; text between the elements is left out, no Mitsuba scene has any.

    Parameters
    ----------
    path
        The file, in any encoding that XML knows.
    name
        What it is called in messages; empty: not at all.

    Returns
    -------
    Element
        The root.

    Raises
    ------
    ValueError
        The file cannot be read, is no XML, is too large or too deep, or declares entities; says what.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_XML_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from error
    if len(content) > MAX_XML_BYTES:
        raise ValueError(f"it is larger than {MAX_XML_BYTES // 2**20} MiB; keep meshes in files of their own")
    return parsed_xml(content, name)


def parsed_xml(content: bytes, name: str = "") -> Element:
    """Return the root of a document; what no scene needs is refused while it is read, before it grows.

    Raises
    ------
    ValueError
        As ``read_xml``.
    """
    parser = expat.ParserCreate()
    opened: list[Element] = [Element("document")]
    count = itertools.count(1)

    def refuse(what: str, line: int | None = None) -> NoReturn:
        place = f"line {parser.CurrentLineNumber if line is None else line}"
        raise PlacedError(f"{name}, {place}: {what}" if name else f"{place}: {what}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        if next(count) > MAX_ELEMENTS:
            refuse(f"it has more than {MAX_ELEMENTS} elements")
        if len(opened) > MAX_DEPTH:
            refuse(f"its elements lie in each other more than {MAX_DEPTH} deep")
        element = SceneElement(tag, attributes)
        element.line, element.file = parser.CurrentLineNumber, name
        opened[-1].append(element)
        opened.append(element)

    def doctype(*_: object) -> None:
        refuse("it declares a document type or entities, which no Mitsuba scene needs; remove them")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: opened.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        refuse(f"it is not well-formed XML: {expat.ErrorString(error.code)}", error.lineno)
    except LookupError as error:  # an encoding nobody knows
        refuse(f"it is not well-formed XML: {error}")
    return opened[0][0]  # expat refuses a document without an element


def numbered_text(root: Element) -> tuple[str, list[Element]]:
    """Return an element as XML, and for each line of that text the element it begins or ends."""
    lines: list[str] = []
    sources: list[Element] = []

    def write(element: Element) -> None:
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.attrib.items())
        lines.append(f"<{element.tag}{attributes}{'' if len(element) else '/'}>")
        sources.append(element)
        for child in element:
            write(child)
        if len(element):
            lines.append(f"</{element.tag}>")
            sources.append(element)

    write(root)
    return "\n".join(lines), sources
