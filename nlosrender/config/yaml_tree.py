"""YAML text -> plain values, with the place of every key and value, and a bound on what the text may grow to.

The node composer of PyYAML is used, never its constructors, so no tag can run code. Values are read as YAML 1.2 has
them: ``1e-3`` is a number, ``NO`` and ``12:30`` are text.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from nlosrender.config.encodable import joined
from nlosrender.config.issues import Wrong, shown
from nlosrender.config.yaml_mistakes import syntax_issue
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

MAX_BYTES = 2**20
MAX_NODES = 100_000  # keys and values after every alias is written out
MAX_DEPTH = 32
_MAX_DIGITS = 100  # Python itself refuses more than 4300, slowly
_TAG = "tag:yaml.org,2002:"
_KNOWN_TAGS = tuple(_TAG + name for name in ("null", "bool", "int", "float", "str", "map", "seq"))


@dataclass(frozen=True)
class Place:
    """Where a key and its value stand, as ``z.yaml:14:3``."""

    key: str
    value: str


@dataclass
class Document:
    """The values of a YAML text, where they stand, and what is wrong with the text itself."""

    source: str
    folder: Path  # where relative file names start
    stem: str  # the default name of a capture
    tree: Any = None
    places: dict[KeyPath, Place] = field(default_factory=dict)
    issues: list[ValidationIssue] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what of the text has no effect
    unread: set[KeyPath] = field(default_factory=set)  # paths whose value could not be read
    overrides: tuple[str, ...] = ()  # as given to --set

    def copy(self) -> Document:
        """Return a document to change; what stands in the text is shared."""
        return dataclasses.replace(
            self, tree=copy.deepcopy(self.tree), places={**self.places}, issues=[*self.issues], notes=[*self.notes]
        )

    def issue(self, path: KeyPath, message: str, at: Literal["value", "key"] = "value") -> ValidationIssue:
        """Return an issue with its place."""
        return ValidationIssue(path, message, at, self.place(path, at))

    @contextmanager
    def placing_issues(self) -> Iterator[None]:
        """Add the places to what the renderer raises, such as of a mesh file that cannot be read.

        Raises
        ------
        ConfigError
            With a place for every issue that has only a key so far.
        """
        try:
            yield
        except ConfigError as error:
            raise ConfigError([self._placed(issue) for issue in error.issues]) from error

    def _placed(self, issue: ValidationIssue) -> ValidationIssue:
        return issue if issue.place or not issue.path else dataclasses.replace(issue, place=self.place(issue.path))

    def place(self, path: KeyPath, at: str = "value") -> str:
        """Return the place of ``path``, or of the nearest mapping around it that is in the text."""
        for end in range(len(path), -1, -1):
            if path[:end] in self.places:
                place = self.places[path[:end]]
                return place.value if at == "value" and end == len(path) else place.key
        return f"{self.source}:1:1"


class _Composer(yaml.BaseLoader):
    """PyYAML's composer with the scalars of YAML 1.2 and a bound on depth and size."""

    _depth = 0
    _n_nodes = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        self._depth += 1
        self._n_nodes += 1
        mark = self.peek_event().start_mark
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels", problem_mark=mark)
        if self._n_nodes > MAX_NODES:
            raise yaml.MarkedYAMLError(problem=f"more than {MAX_NODES} keys and values", problem_mark=mark)
        node: Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def compose_scalar_node(self, anchor: Any) -> ScalarNode:
        node: ScalarNode = super().compose_scalar_node(anchor)
        node.value = joined(node.value)
        return node


for _name, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Composer.add_implicit_resolver(_TAG + _name, re.compile(rf"(?:{_pattern})\Z"), _first)


def read_document(text: str, source: str, folder: Path = Path()) -> Document:
    """Read one YAML document.

    Parameters
    ----------
    text
        The YAML, at most 1 MiB, at most 100_000 values and 32 levels after aliases are written out.
    source
        What to call it in places, such as the file name.
    folder
        Where relative file names in it start.

    Returns
    -------
    Document
        With issues that do not stop the reading (duplicate keys, numbers that are not finite, foreign tags).

    Raises
    ------
    ConfigError
        The text is no YAML, or grows beyond the bounds.
    """
    if len(text.encode("utf-8", "surrogatepass")) > MAX_BYTES:
        raise ConfigError.of_file(source, f"larger than {MAX_BYTES // 1024} KiB, which no configuration needs.")
    document = Document(source, folder, _default_name(source))
    try:
        node = _Composer(text).get_single_node()
        if node is not None:
            _measured(node, {})
            document.places[()] = Place(_at(node, source), _at(node, source))
            document.tree = _Builder(document).build(node, ())
    except yaml.MarkedYAMLError as error:
        raise ConfigError(syntax_issue(error, source)) from error
    except ReaderError as error:
        before = text[: error.position]
        place = f"{source}:{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"
        message = f"character U+{error.character:04X} may not stand in YAML; remove it."
        raise ConfigError.of_file(place, message) from error
    return document


def _default_name(source: str) -> str:
    """Return the name of a capture whose config gives none: that of its file, which may hold what a name may not."""
    letters = (letter if letter.isprintable() and letter != "\\" else "-" for letter in Path(source).stem)
    return "".join(letters).strip() or "capture"


def _at(node: Node, source: str) -> str:
    return f"{source}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"


def _measured(node: Node, known: dict[int, tuple[int, float]]) -> tuple[int, float]:
    """Return nodes and levels of a node with every alias written out; each node is looked at once, in milliseconds.

    Raises
    ------
    yaml.MarkedYAMLError
        They are too many.
    """
    if id(node) not in known:
        known[id(node)] = (1, math.inf)  # until it is measured: an alias of it lies inside it
        children = node.value if isinstance(node, SequenceNode) else []
        if isinstance(node, MappingNode):
            children = itertools.chain.from_iterable(node.value)
        sizes = [(0, 0.0), *(_measured(child, known) for child in children)]
        n_nodes, levels = 1 + sum(n for n, _ in sizes), 1 + max(below for _, below in sizes)
        if n_nodes > MAX_NODES or levels > MAX_DEPTH:
            message = f"aliases grow it beyond {MAX_NODES} values or {MAX_DEPTH} levels"
            message = "an alias inside its own anchor never ends" if levels == math.inf else message
            raise yaml.MarkedYAMLError(problem=message, problem_mark=node.start_mark)
        known[id(node)] = (n_nodes, levels)
    return known[id(node)]


class _Builder:
    """Turns nodes into values, writing aliases out, and notes places and issues in the document."""

    def __init__(self, document: Document):
        self.document = document

    def build(self, node: Node, path: KeyPath) -> Any:
        """Return the value of ``node`` at ``path``."""
        if node.tag not in _KNOWN_TAGS:
            known = "only plain values, lists and mappings"
            return self._unread(node, path, f"tag {node.tag.replace(_TAG, '!!')} is not allowed, {known}.")
        if isinstance(node, ScalarNode):
            return self._scalar(node, path)
        return self._list(node, path) if isinstance(node, SequenceNode) else self._mapping(node, path)

    def _list(self, node: Node, path: KeyPath) -> list[Any]:
        items = []
        for index, item in enumerate(node.value):
            place = _at(item, self.document.source)
            self.document.places[(*path, index)] = Place(place, place)
            items.append(self.build(item, (*path, index)))
        return items

    def _mapping(self, node: Node, path: KeyPath) -> dict[str, Any]:
        values: dict[str, Any] = {}
        source = self.document.source
        for key_node, value_node in node.value:
            if _is_merge(key_node):
                continue
            if not isinstance(key_node, ScalarNode) or key_node.tag != _TAG + "str":
                found = shown(key_node.value) if isinstance(key_node, ScalarNode) else "a list or mapping"
                self._note(key_node, path, f"got {found} as a key, need text; put it in quotes.")
                continue
            key, at = key_node.value, (*path, key_node.value)
            if key in values:
                message = f"appears twice, first at {self.document.places[at].key}; keep one of them."
                self._note(key_node, at, message)
                continue
            self.document.places[at] = Place(_at(key_node, source), _at(value_node, source))
            values[key] = self.build(value_node, at)
        for key_node, value_node in node.value:
            if _is_merge(key_node):
                self._merge(value_node, path, values)
        return values

    def _merge(self, node: Node, path: KeyPath, values: dict[str, Any]) -> None:
        """Add what ``<<: *anchor`` brings; keys of the mapping itself, and of earlier anchors, win."""
        for part in node.value if isinstance(node, SequenceNode) else [node]:
            if not isinstance(part, MappingNode):
                self._note(part, path, "got no mapping after <<, need the alias of a mapping or a list of them.")
                continue
            # only new keys are built: places of keys that win must stay
            new = [pair for pair in part.value if str(pair[0].value) not in values]
            values.update(self.build(MappingNode(_TAG + "map", new, part.start_mark), path))

    def _scalar(self, node: ScalarNode, path: KeyPath) -> Any:
        text, kind = node.value, node.tag.removeprefix(_TAG)
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        if kind == "int" and len(text) > _MAX_DIGITS:
            return self._unread(node, path, f"got an integer of {len(text)} digits, need at most {_MAX_DIGITS}.")
        try:
            if kind == "int":
                return int(text, 0) if text[:2] in ("0x", "0o") else int(text)
            if kind == "float":
                number = float(text.replace(".inf", "inf").replace(".nan", "nan") if "." in text else text)
                if not math.isfinite(number):
                    return self._unread(node, path, f"got {text}, need a finite number.")
                return number
        except ValueError:
            return self._unread(node, path, f"got {shown(text)} with the tag !!{kind}, need a number.")
        return text

    def _unread(self, node: Node, path: KeyPath, message: str) -> Wrong:
        self.document.unread.add(path)
        self._note(node, path, message)
        return Wrong()

    def _note(self, node: Node, path: KeyPath, message: str) -> None:
        self.document.issues.append(ValidationIssue(path, message, place=_at(node, self.document.source)))


def _is_merge(key: Node) -> bool:
    return isinstance(key, ScalarNode) and key.value == "<<" and key.style is None
