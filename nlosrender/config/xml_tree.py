"""XML -> elements that know their line, read with bounds on size and depth; and back to text with a map of lines."""

from __future__ import annotations

from pathlib import Path
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
    return _LimitedTree(name).read(content)


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


class _LimitedTree:
    """Builds a tree, or says what no scene needs while it is read, before it grows."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._open: list[Element] = []
        self._root: Element | None = None
        self._count = 0

    def read(self, content: bytes) -> Element:
        """Return the root of a document."""
        try:
            self._parser.Parse(content, True)
        except (expat.ExpatError, LookupError) as error:  # LookupError: an encoding nobody knows
            raise ValueError(f"it is not well-formed XML: {error}") from error
        if self._root is None:  # expat refuses a document without an element
            raise ValueError("it is not well-formed XML: no element found")
        return self._root

    def _doctype(self, name: str, system: str | None, public: str | None, has_internal_subset: int) -> None:
        raise ValueError("it declares a document type or entities, which no Mitsuba scene needs")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if self._count > MAX_ELEMENTS:
            raise ValueError(f"it has more than {MAX_ELEMENTS} elements")
        if len(self._open) == MAX_DEPTH:
            raise ValueError(f"its elements lie in each other more than {MAX_DEPTH} deep")
        element = SceneElement(tag, attributes)
        element.line, element.file = self._parser.CurrentLineNumber, self._name
        if self._open:
            self._open[-1].append(element)
        else:
            self._root = element
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop()
