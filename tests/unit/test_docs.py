"""What docs/ says of the code is in the code."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "nlosrender"
PAGES = sorted([*ROOT.glob("docs/*.md"), ROOT / "docs/notebook.ipynb", *ROOT.glob("*.md")])
OF_CODE = [ROOT / "docs" / name for name in ("virtual-lights.md", "architecture.md")]
ENGINE = PACKAGE / "engine"
FOLDERS = (ROOT, PACKAGE, PACKAGE / "rendering", ENGINE, ENGINE / "path", ENGINE / "virtual_lights")
FOREIGN = {"bsdf.eval", "wall_bsdf.eval", "ray_test", "sample_emitter_direction", "SmoothDiffuse"}  # Mitsuba's
WORDS = {
    "confocal",
    "auto",
    "diffuse",
    "twosided",
    "target_missed",
    "seconds",
    "execution_time",
}  # of configurations and files


def defined_in(tree: ast.AST) -> set[str]:
    """Return the names that a tree defines: classes, functions, arguments, variables, attributes."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
    return names


@cache  # not at import: every process that collects tests would parse the package
def modules() -> dict[Path, ast.Module]:
    """Return the trees of all modules."""
    paths = (*PACKAGE.rglob("*.py"), ROOT / "tests/support/constant_engine.py")
    return {path: ast.parse(path.read_text()) for path in paths}


@cache
def all_names() -> set[str]:
    """Return what is defined anywhere, and the names of modules."""
    return set().union(*(defined_in(tree) for tree in modules().values())) | {path.stem for path in modules()}


@cache
def names_of_classes() -> dict[str, set[str]]:
    """Return by class what is defined in it."""
    result: dict[str, set[str]] = {}
    for tree in modules().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                result.setdefault(node.name, set()).update(defined_in(node))
    return result


def code_spans(page: Path) -> list[str]:
    """Return what stands in backquotes, blocks of code left out."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))


@pytest.mark.parametrize("page", OF_CODE, ids=lambda page: page.name)
def test_every_name_in_backquotes_is_defined_in_the_code(page: Path) -> None:
    """A class, function, argument, attribute or constant; of ``Class.attribute`` the class has the attribute."""
    missing = []
    for span in code_spans(page):
        if (
            span in FOREIGN | WORDS
            or not re.fullmatch(r"\.?[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", span)
            or span.endswith(".py")
        ):
            continue
        first, *rest = span.lstrip(".").split(".")
        if rest and first in names_of_classes():
            found = rest[0] in names_of_classes()[first]
        else:
            found = all(name in all_names() for name in (first, *rest))
        if not found:
            missing.append(span)
    assert not missing


def module(name: str) -> Path:
    """Return the module that a page calls ``name``, below one of ``FOLDERS``."""
    return next(folder / name for folder in FOLDERS if (folder / name).exists())


@pytest.mark.parametrize("page", OF_CODE, ids=lambda page: page.name)
def test_a_name_beside_a_file_is_defined_in_that_file(page: Path) -> None:
    """Names before ``in file.py`` or ``(file.py``, one or a list; of ``Class.attribute`` the class."""
    placed = re.compile(r"((?:`[^`\n]+`(?:,?\s+and\s+|,\s+)?)+)\s+(?:in\s+|\()([a-z_][\w/-]*\.py)\b")
    found = placed.findall(page.read_text())
    assert found
    missing = []
    for names, path in found:
        defined = defined_in(modules()[module(path)])
        missing += [(span, path) for span in re.findall(r"`([^`]+)`", names) if span.split(".")[0] not in defined]
    assert not missing


@pytest.mark.parametrize("page", OF_CODE, ids=lambda page: page.name)
def test_a_constant_is_defined_in_a_file_that_its_section_names(page: Path) -> None:
    """Somewhere in the package is not enough: other modules have constants of the same name."""
    missing = []
    for section in re.split(r"^#+ ", page.read_text(), flags=re.MULTILINE):
        paths = set(re.findall(r"(?<![\w/])[a-z_][\w/-]*\.py\b", section))
        defined = set().union(*(defined_in(modules().get(module(path), ast.Module([], []))) for path in paths))
        missing += [name for name in re.findall(r"`([A-Z][A-Z_\d]+)`", section) if name not in defined]
    assert not missing


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub and the docs site give the headings of a page."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_and_path_on_a_page_leads_somewhere(page: Path) -> None:
    """Modules, pages, headings, pictures, configurations and folders; links are relative to the page."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not link.startswith("https://")]
    for path, _, anchor in (link.partition("#") for link in links):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"
    if page in OF_CODE:
        paths = set(re.findall(r"(?<![\w/])[a-z_][\w/-]*\.(?:py|yaml)\b", text))
        paths |= {span for span in code_spans(page) if re.fullmatch(r"[\w/]+/", span)}
        assert not {path for path in paths if not any((folder / path).exists() for folder in FOLDERS)}


@pytest.mark.parametrize("page", OF_CODE, ids=lambda page: page.name)
def test_no_section_that_the_code_cites_is_missing(page: Path) -> None:
    """``docs/virtual-lights.md, 2.3`` in a docstring leads to a heading with that number."""
    headings = set(re.findall(r"^#+ ([\d.]+) ", page.read_text(), flags=re.MULTILINE))
    cited = re.compile(rf"docs/{re.escape(page.name)}, (\d+(?:\.\d+)?)")
    found = {number for path in modules() for number in cited.findall(path.read_text())}
    assert found <= headings
