"""Pages of the docs site that are written from the code: every key of the YAML, every command, the file, the API.

``docs/conf.py`` writes them into docs/reference/ when the site is built: Markdown with Sphinx's directives.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import nlosrender

SITE = Path(__file__).parent
Schema = Mapping[str, Any]
# of lengths, times, angles, ...: attribute docstrings of the models begin with the unit
_UNITS = ("m of optical path", "m^2", "m", "s", "ps", "nm", "sr", "degrees", "1/s", "W m^-2 sr^-1", "W sr^-1")
_UNIT = re.compile(rf"(?:\[from, to\] in )?({'|'.join(map(re.escape, _UNITS))}|\w+ per pulse)(?=[,; ]|$)")
_IN_TEXT, _OF_KEYS = "as said", "those of its keys"  # defaults that are made, not declared
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def configuration_page() -> str:
    """Return the page of every key of the YAML: where it stands, type, unit, default."""
    from nlosrender.config.document import Config

    schema = Config.model_json_schema()
    intro = "Every key of the YAML, by where it stands; `N` is the place in a list, from 0, as `--set` counts. "
    intro += "`nlosrender schema` prints the same for editors."
    return "\n\n".join(["# Configuration keys", intro, *_section(schema, schema["$defs"], ""), *_bsdf_keys()])


def _section(section: Schema, sections: Mapping[str, Schema], place: str, kind: str = "") -> Iterator[str]:
    """Yield the keys of a section, then the sections in it."""
    if place:
        yield f"## {place}" + (f", type {kind}" if kind else "")
        yield _plain(section["description"])
    required, inner = section.get("required", ()), []
    for key, value in section["properties"].items():
        path = f"{place}.{key}".lstrip(".")
        text = section["description"] if "const" in value else value.get("description", "")
        made = _IN_TEXT if "default" in text else _OF_KEYS if "$ref" in value else "{}"
        default = json.dumps(value["default"]) if "default" in value else made
        said = "required" if key in required else f"default: {default}"
        yield _entry("confval", path + (f" ({kind})" if kind else ""), _type(value), said, text)
        inner += [(part, path + ".N" * is_list) for part, is_list in _sections_in(value)]
    for part, path in inner:
        found = sections[part.rpartition("/")[2]]
        yield from _section(found, sections, path, found["properties"].get("type", {}).get("const", ""))


def _sections_in(value: Schema, is_list: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield references to the sections that a value may be, and whether it is a list of them."""
    if "$ref" in value:
        yield value["$ref"], is_list
    for option in (*value.get("anyOf", ()), *value.get("oneOf", ())):
        yield from _sections_in(option, is_list)
    if isinstance(value.get("items"), dict):
        yield from _sections_in(value["items"], True)


def _type(value: Schema) -> str:
    """Return the type of a value in words, with its bounds and unit."""
    unit = _UNIT.match(value.get("description", ""))
    return _shape(value) + (f" [{unit[1]}]" if unit else "")


def _shape(value: Schema) -> str:
    if options := value.get("anyOf") or value.get("oneOf"):
        return " or ".join(dict.fromkeys(map(_shape, options)))
    if "const" in value or "enum" in value:
        return " | ".join(map(str, value.get("enum") or [value["const"]]))
    if value.get("type") == "array":
        size = f"{value['minItems']} x " if value.get("minItems", 0) == value.get("maxItems") else ""
        return f"list of {size}{_shape(value['items'])}" if "items" in value else "list"
    words: dict[str, str] = {"string": "text", "boolean": "true | false", "object": "mapping"}
    bounds = [f"{sign} {_number(value[key])}" for key, sign in _BOUNDS.items() if key in value]
    kind = str(value.get("type", "mapping"))
    return " ".join([words.get(kind, kind), " and ".join(bounds)]).strip()


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _bsdf_keys() -> Iterator[str]:
    from nlosrender.config.bsdf_table import BSDF_PARAMETERS, BSDF_TYPES

    yield "## Keys of a BSDF"
    yield "`type`, and the parameters of the Mitsuba plugin; those of types without entry go to Mitsuba unchecked."
    rows = []
    for kind in sorted(BSDF_TYPES):
        known = [f"`{key}`: {_plain(allowed.value)}" for key, allowed in BSDF_PARAMETERS.get(kind, {}).items()]
        rows.append((f"`{kind}`", "; ".join(known) or "unchecked" * (kind not in BSDF_PARAMETERS)))
    yield _table(("type", "parameters"), rows)


def commands_page() -> str:
    """Return the page of every command, with its arguments and options."""
    from typer import Context
    from typer.main import get_command

    from nlosrender.cli.app import app

    def pages(command: Any, name: str) -> Iterator[str]:
        context = Context(command, info_name=name)
        yield f"## {name}\n\n{_plain(command.help)}"
        yield f"```sh\n{context.get_usage().removeprefix('Usage: ')}\n```"
        yield f"```{{eval-rst}}\n.. program:: {name}\n```"
        for parameter in command.params:
            if record := parameter.get_help_record(context):  # None: hidden
                yield _option(*record)
        if command.epilog:
            yield _plain(command.epilog)
        for inner, subcommand in getattr(command, "commands", {}).items():
            yield from pages(subcommand, f"{name} {inner}")

    return "\n\n".join(["# Commands", *pages(get_command(app), "nlosrender")])


def _option(names: str, text: str) -> str:
    """Return the entry of an option or argument, from the two columns that ``--help`` has of it."""
    text, _, facts = text.removesuffix("]").partition("  [")
    name, kind = re.findall(r"((?:--?[\w-]+(?:, | / )?)+|\S+) ?(.*)", names)[0]
    default = re.search(r"default: \(?([^;)]*)", facts)
    said = f"default: {default[1] if default else 'none' if kind else 'off'}"
    bounds = "".join(f", {part}" for part in facts.split("; ") if re.search("[<>]=?", part))
    said = "required" if "required" in facts else said
    return _entry("option", name.replace(" / ", ", "), (kind.strip("<>") or "flag") + bounds, said, text)


def file_layout_page() -> str:
    """Return the page of the datasets in a capture file."""
    from nlosrender.files.layout import DATA, DATA_UNIT, DATASETS, FLOAT, GROUND_TRUTH, VARIANCE, file_axes

    head = ("dataset", "type", "shape", "unit", "holds")
    kinds = {FLOAT: "float32"}

    def shape(axes: Iterable[object]) -> str:
        return f"({', '.join(map(str, axes))})"

    samples = [
        (f"`{name}`", "float32", shape(file_axes(confocal)), unit, f"{text}; {scan}")
        for confocal, scan in ((True, "confocal"), (False, "single, exhaustive"))
        for name, unit, text in ((DATA, DATA_UNIT, "H"), (VARIANCE, f"({DATA_UNIT})²", "its variance"))
    ]

    def table(specs: Iterable[Any]) -> list[tuple[str, ...]]:
        return [
            (f"`{each.name}`", kinds.get(each.dtype, "int32"), shape(each.shape), each.unit, each.meaning)
            for each in specs
        ]

    return "\n\n".join(
        [
            "# Datasets of a capture file",
            "Shapes as h5py shows them; the bounce axis is 6 long, index k holds bounce k + 2. "
            "[Capture files](../formats.md) has the attributes, and what is read of other writers' files.",
            _table(head, [*samples, *table(DATASETS)]),
            "## Ground truth\n\nWhere `output.ground_truth` asks for it.",
            _table(head, table(GROUND_TRUTH)),
        ]
    )


def python_page() -> str:
    """Return the page of what ``import nlosrender`` gives, and of its errors; Sphinx fills in the docstrings."""
    from nlosrender.errors import NlosError

    lines = []
    for name in nlosrender.__all__:
        if name != "open":  # of Capture
            is_class = isinstance(getattr(nlosrender, name), type)
            lines.append(f".. auto{'class' if is_class else 'function'}:: nlosrender.{name}")
            lines += ["   :members:", "   :exclude-members: args"] if is_class else []
    text = "`nlosrender.open(path)` is `Capture(path)`. [Python and notebooks](../python.md) has examples."
    lines += [f".. autoexception:: nlosrender.errors.{error.__name__}" for error in NlosError.__subclasses__()]
    return "\n".join(["# Python API", "", text, "", "```{eval-rst}", *lines, "```"])


def notebook_page() -> str:
    """Return docs/notebook.ipynb as a page."""
    cells = json.loads((SITE / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    parts = [
        f"```python\n{text}\n```" if cell["cell_type"] == "code" else text.replace("](", "](../")
        for cell, text in zip(cells, texts, strict=True)
    ]
    return "\n\n".join([parts[0], "This page as a notebook: [notebook.ipynb](../notebook.ipynb).", *parts[1:]])


PAGES = {
    "configuration": configuration_page,
    "commands": commands_page,
    "file-layout": file_layout_page,
    "python-api": python_page,
    "notebook": notebook_page,
}


def write_pages() -> None:
    """Write all pages into docs/reference/."""
    folder = SITE / "reference"
    folder.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (folder / f"{name}.md").write_text(page() + "\n", encoding="utf-8")


def _entry(directive: str, name: str, kind: str, default: str, text: str) -> str:
    return f":::{{{directive}}} {name}\n{_plain(text)}\\\n*{_plain(f'{kind}, {default}')}*\n:::"


def _plain(text: str) -> str:
    """Return text in which Markdown finds no HTML, emphasis or table."""
    return re.sub(r"([<*|])", r"\\\1", text)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    cells = [list(head)]
    lines = [cells[0], ["---"] * len(cells[0]), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
