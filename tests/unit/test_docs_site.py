"""The pages that docs/reference_pages.py writes miss no key, no option, no unit, no default."""

from __future__ import annotations

import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from reference_pages import PAGES, commands_page, configuration_page
from typer.main import get_command

from nlosrender.cli.app import app
from nlosrender.config.document import Config
from nlosrender.config.section import Section, sections_in, type_of

ROOT = Path(__file__).parents[2]
UNITLESS = re.compile(r"direction |share of|0\.\.1|relative L2|of the photons|where in its pixel|.*in any unit")
SUFFIXES = {"_deg": "degrees", "_ps": "ps", "_time": "s", "_limit_s": "s"}
LENGTHS = {"radius", "width", "height", "center", "position", "look_at", "near", "far", "thickness"}


def keys(section: type[Section], place: str = "", kind: str = "") -> Iterator[tuple[str, str, typing.Any]]:
    """Yield place, kind and field of every key, from the models themselves."""
    for name, field in section.model_fields.items():
        path = f"{place}.{name}".lstrip(".")
        yield path, kind, field
        for inner in sections_in(field.annotation):
            is_list = "tuple[" in str(field.annotation)
            yield from keys(inner, path + ".N" * is_list, type_of(inner))


def entries(page: str, directive: str) -> dict[str, tuple[str, str]]:
    """Return text and facts (type, default) of the entries of a page, by name."""
    found = re.findall(rf"^:::\{{{directive}\}} (.+)\n((?:.*\n)*?.*)\\\n\*(.*)\*\n:::$", page, re.MULTILINE)
    assert len(found) == page.count(f":::{{{directive}}}")
    return {name: (text, facts) for name, text, facts in found}


def test_every_key_has_an_entry_with_text_type_and_default() -> None:
    """The entries are the keys of the models; a key is required where its model says so, else it has a default."""
    found, wrong = entries(configuration_page(), "confval"), []
    expected = {path + (f" ({kind})" if kind else ""): field for path, kind, field in keys(Config)}
    assert len(expected) > 200
    assert found.keys() == expected.keys()
    for name, (text, facts) in found.items():
        kind, _, default = facts.rpartition(", ")
        shown = default == "required" if expected[name].is_required() else re.search("default: .", facts)
        wrong += [] if text.strip() and kind and shown else [name]
        if facts.endswith("as said"):
            assert "default" in text, name
        elif (factory := expected[name].default_factory) and facts.endswith("{}"):
            assert factory() == {}, name
    assert not wrong


def test_every_number_has_a_unit_or_says_why_not() -> None:
    """A key that takes numbers begins its text with the unit, or says that it has none; names agree with units."""
    wrong = []
    for name, (text, facts) in entries(configuration_page(), "confval").items():
        unit = re.search(r"\[([^]]+)\]", facts)
        key = name.split(" ")[0].rpartition(".")[2]
        needs = "number" in facts and not UNITLESS.match(text)
        wrong += [name] if needs and unit is None else []
        lengths = key in LENGTHS and "number" in facts
        ending = next((unit for suffix, unit in SUFFIXES.items() if key.endswith(suffix)), "m" if lengths else None)
        wrong += [(name, facts)] if ending and (unit is None or unit[1] != ending) else []
    assert not wrong


def test_every_command_and_option_has_an_entry_with_text_and_default() -> None:
    """As typer has them, all spellings of an option in one entry; those that are lengths say so."""

    def walk(command: typing.Any, name: str) -> Iterator[tuple[str, typing.Any]]:
        yield name, command
        for inner, subcommand in getattr(command, "commands", {}).items():
            yield from walk(subcommand, f"{name} {inner}")

    sections = dict(re.findall(r"^## (.+)\n((?:(?!## ).*\n?)*)", commands_page(), re.MULTILINE))
    commands = dict(walk(get_command(app), "nlosrender"))
    assert sections.keys() == commands.keys()
    for name, command in commands.items():
        found = entries(sections[name], "option")
        spelt = [set(names.split(", ")) for names in found if names.startswith("-")]
        options = [option for option in command.params if option.param_type_name == "option"]
        assert spelt == [{*option.opts, *option.secondary_opts} for option in options], name
        assert len(found) == len(command.params)
        assert command.help
        for names, (text, facts) in found.items():
            assert text.strip(), (name, names)
            assert re.search(r"., (required|default: .+)$", facts), (name, names)
            in_metres = re.match("(M|X,Y|X,Y,Z),", facts)
            assert not in_metres or re.search(r"\[m\]|, m ", text), (name, names)


class Resources(HTMLParser):
    """Collects what a browser would load with a page from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Links that a reader follows are no resources."""
        values = [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data") and tag != "a"]
        self.found += [value for value in values if re.match(r"(https?:)?//", value)]


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """Sphinx warns of links and anchors without target; pages, styles and fonts are all in the site."""
    pytest.importorskip("sphinx", reason="the extra docs")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-c", "docs", ".", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for page in tmp_path.rglob("*.html"):
        parser = Resources()
        parser.feed(page.read_text(encoding="utf-8"))
        assert not parser.found, page
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"""(url\(|@import)\s*["']?(https?:)?//""", style.read_text(encoding="utf-8")), style
    assert {path.stem for path in (tmp_path / "docs/reference").glob("*.html")} == PAGES.keys()
