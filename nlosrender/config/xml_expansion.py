"""What a Mitsuba scene file says with other words: parameters, included files, folders, aliases, names of old versions.

The rules are those of Mitsuba 3's own reader: a ``<default>`` holds from its place on, an earlier one of the same name
stands; the contents of an included scene take the place of ``<include>``; ``<path>`` adds a folder that file names may
start at. Files of versions below 2 write the names of parameters in camelCase.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from nlosrender.config.issues import shown
from nlosrender.config.plugin_check import existing_file
from nlosrender.config.xml_tree import (
    MAX_DEPTH,
    MAX_ELEMENTS,
    MAX_XML_BYTES,
    PlacedError,
    SceneElement,
    prefixed_with_place,
    read_xml,
)

MAX_INCLUDE_DEPTH = 15  # Mitsuba's
MAX_FILES = 1000  # in one scene
LEFT_OUT = ("integrator", "sampler")  # what another renderer would do with the scene
START = "the folder of the scene's file, or that of a <path>"  # of relative file names
_UNREAD = (*LEFT_OUT, "film", "sensor")  # parameters in them may be without a value, as long as nobody needs it
_CAPITALS = re.compile(r"(?<=[a-z])([A-Z]+)")
_VERSION = re.compile(r"\s*(\d+)\.(\d+)(\.\d+)?\s*")
_PLACE_OF_UV = ("uscale", "vscale", "uoffset", "voffset")
_TRANSFORM = "transform"


@dataclass
class Expansion:
    """One reading of a scene with everything it includes.

    Parameters
    ----------
    main
        The scene's file.
    """

    main: Path
    folders: list[Path] = field(default_factory=list)  # where file names may start, the nearest first
    files: list[Path] = field(default_factory=list)  # all that were read, the scene's own first
    _parameters: dict[str, str] = field(default_factory=dict)
    _aliases: dict[str, str] = field(default_factory=dict)  # another name -> the id it stands for
    _room: int = MAX_XML_BYTES  # for what parameters put in: a short file could ask for more than there is memory
    _count: int = 0  # elements of all files

    def read(self) -> Element:
        """Return the root, with nothing left of what this module is about.

        Raises
        ------
        ValueError
            A file is no Mitsuba scene, is too large, or refers to something that is not there; says what.
        """
        self.folders.append(self.main.parent)
        root = self._file(self.main, 0, 0)
        with prefixed_with_place(root):
            if root.tag != "scene":
                raise ValueError(f"its root is <{root.tag}>, need <scene>")
        for reference in root.iter("ref"):
            seen = set()
            while (name := reference.get("id", "")) in self._aliases and name not in seen:
                seen.add(name)
                reference.set("id", self._aliases[name])
        return root

    def _file(self, path: Path, depth: int, level: int) -> Element:
        if len(self.files) == MAX_FILES:
            raise ValueError(f"it includes more than {MAX_FILES} files")
        root = read_xml(path, "" if depth == 0 else path.name)
        self.files.append(path)
        self._count += sum(1 for _ in root.iter())
        if self._count > MAX_ELEMENTS:
            raise ValueError(f"it has more than {MAX_ELEMENTS} elements, with those of the files it includes")
        with prefixed_with_place(root):
            is_old = _is_old(root)
        root.set("version", "3.0.0")
        self._expand(root, path, depth, level, is_read=root.tag not in _UNREAD)
        if is_old:
            for element in root.iter():
                _upgrade(element)
        return root

    def _expand(self, element: Element, path: Path, depth: int, level: int, *, is_read: bool) -> None:
        """Expand an element that lies in ``level`` others, in a file that lies in ``depth`` others."""
        with prefixed_with_place(element):
            if level == MAX_DEPTH:
                raise ValueError(f"its elements lie in each other more than {MAX_DEPTH} deep")
            self._fill_in(element, is_read=is_read)
        children = list(element)
        element[:] = []
        for child in children:
            with prefixed_with_place(child):
                if child.tag in ("default", "alias", "path", "include"):
                    self._fill_in(child, is_read=True)
                    element.extend(list(self._directive(child, path, depth, level)))
                    continue
                if child.tag == "lookAt":  # as it was written before version 2
                    child.tag = "lookat"
                element.append(child)
            self._expand(child, path, depth, level + 1, is_read=is_read and child.tag not in _UNREAD)

    def _directive(self, element: Element, path: Path, depth: int, level: int) -> Iterator[Element]:
        """Do what an element says, and yield what takes its place."""
        needed = {"default": ("name", "value"), "alias": ("id", "as"), "path": ("value",), "include": ("filename",)}
        for key in needed[element.tag]:
            if element.get(key) is None:
                raise ValueError(f"<{element.tag}> has no {key}")
        if element.tag == "default":
            self._parameters.setdefault(element.get("name", ""), element.get("value", ""))
        elif element.tag == "alias":
            self._aliases[element.get("as", "")] = element.get("id", "")
        elif element.tag == "path":
            name = element.get("value", "")
            folder = next((start / name for start in (path.parent, *self.folders) if (start / name).is_dir()), None)
            if folder is None:
                raise ValueError(f"<path>: there is no folder {path.parent / name}")
            self.folders.insert(0, folder)
        else:
            yield from self._included(element, path, depth, level)

    def _included(self, element: Element, path: Path, depth: int, level: int) -> list[Element]:
        name = element.get("filename", "")
        if depth == MAX_INCLUDE_DEPTH:
            raise ValueError(f"files include each other more than {MAX_INCLUDE_DEPTH} deep")
        tried = [existing_file(name, folder, START) for folder in (path.parent, *self.folders)]
        file, problem = next(((file, problem) for file, problem in tried if not problem), tried[0])
        if problem:
            raise ValueError(problem.removesuffix("."))
        try:
            root = self._file(file, depth + 1, level + 1)
        except PlacedError:
            raise
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error
        if root.tag == "scene":
            return list(root)
        if element.get("name") is not None:
            root.set("name", element.get("name", ""))
        del root.attrib["version"]
        return [root]

    def _fill_in(self, element: Element, *, is_read: bool) -> None:
        """Put the values of parameters into the attributes of an element."""
        for key, text in element.attrib.items():
            if "$" not in text:
                continue
            for name in sorted(self._parameters, key=len, reverse=True):  # $spp_max is not $spp
                self._room -= text.count(f"${name}") * len(self._parameters[name])
                if self._room < 0:
                    raise ValueError("what its <default>s stand for is too large")
                written = rf"(?<!\\)\$(?:{re.escape(name)}|{{{re.escape(name)}}})"
                text = re.sub(written, self._parameters[name].replace("\\", r"\\"), text)
            left = re.search(r"(?<!\\)\$\{?(\w*)", text)
            if left and is_read:
                advice = f"write <default name={left[1]!r} value='...'/> at the beginning of the scene"
                raise ValueError(f"${left[1]} has no <default>; {advice}")
            element.set(key, text.replace(r"\$", "$"))


def _is_old(root: Element) -> bool:
    version = root.get("version")
    if version is None:
        return False
    numbers = _VERSION.fullmatch(version)
    if numbers is None:
        raise ValueError(f"its version is {shown(version)}, need one such as 3.0.0")
    return int(numbers[1]) < 2


def _upgrade(element: Element) -> None:
    """Give what an element of a version below 2 holds the names of today."""
    for child in element:
        name = child.get("name")
        if name is not None:
            child.set("name", _CAPITALS.sub(lambda capitals: "_" + capitals[1].lower(), name))
        if element.get("type") == "diffuse" and child.get("name") == "diffuse_reflectance":
            child.set("name", "reflectance")
    placed = {child.get("name"): child for child in element if child.get("name") in _PLACE_OF_UV}
    if element.tag != "texture" or not placed:
        return
    for child in placed.values():
        element.remove(child)
    transform = SceneElement.like(next(iter(placed.values())), _TRANSFORM, name="to_uv")
    for step, default in (("offset", "0"), ("scale", "1")):  # the texture is moved first
        values = {axis: placed.get(f"{uv}{step}") for axis, uv in (("x", "u"), ("y", "v"))}
        attributes = {axis: default if item is None else item.get("value", "") for axis, item in values.items()}
        transform.append(SceneElement.like(transform, "translate" if step == "offset" else "scale", **attributes))
    element.append(transform)
