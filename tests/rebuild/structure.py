"""Figures of a source tree that a rebuild is held against: size, imports, constants, and the way of a batch.

    python tests/rebuild/structure.py --source TREE [--json] [--junit FILE] [--no-batches]

Definitions
-----------
Import levels: modules on the longest chain of imports inside ``engine/``; edges: pairs of modules of which one
imports the other. Package files (``__init__``) and what stands under ``if TYPE_CHECKING`` do not count; imports inside
functions do.
Checks of engines: ``isinstance(x, C)`` with C or one of a tuple named ``...Engine``, anywhere but in the planner, in
the module that defines C, and in the folder of that module where it is one of its own (``engine/path/``).
Patched constants: a name in capitals of an imported module that a test, or the package itself (its benchmarks), sets:
``monkeypatch.setattr(module, "NAME", ...)``, ``mock.patch("module.NAME")``, ``mock.patch.object``, ``setattr``, or
``module.NAME = ...``.
Constants: names in capitals assigned at module level a number, or a tuple or expression of numbers, and fields with
such a default of dataclasses named ``...Tuning`` or in a module ``tuning``. *Without a word*: no comment on its line,
directly above or below, and no docstring below. *Without an origin*: that text has none of the words and units of
``ORIGIN``, with which a derivation, a measurement, a source or the effect of another value is told. A heuristic: it
knows no physics, and takes any unit for a measurement.
The way of a batch: the functions of the package are listed in the order in which they are called first between the
call and the return of the outermost ``render`` of an engine (a class ``...Engine``, rendering one work item), each
function once. Files: those the functions are in. Returns: how often two functions that follow each other in this
list are in different files and the second file had been entered before, which is how often a reader who follows the
batch has to go back to a file. Given for files of ``engine/`` alone, and for all.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml
from rebuild_captures import capture_cases, write_files

PACKAGE = "nlosrender"
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]+")
ORIGIN = re.compile(
    r"measured|benchmark|deriv|because|otherwise|beyond|below (it|which|that)|above (it|which|that)|so that|"
    r"keeps?\b|costs?\b|takes?\b|saves?\b|needs?\b|minimi[sz]|bound|rounding|precision|float32|float64|\bulp|\bbits?\b|"
    r"docs/|section|\bEq\b|et al|\b(19|20)\d\d\b|standard|exact|definition|per cent|%|sigma|variance|noise|memory|"
    r"\d ?(GB|MB|kB|ns|ps|ms|s|min)\b|times (as|faster|slower)|found by|chosen|from (the|a)\b|error of order",
    re.IGNORECASE,
)
N_LONGEST = 15
BATCHES = {"virtual_lights": "vl-single-two-plates", "path": "path-single", "line_of_sight": "los-area-lamp"}
MAX_SECONDS = 240.0  # of one render


class Tree:
    """The parsed modules of a source tree."""

    def __init__(self, source: Path):
        self.source = source.resolve()
        self.package = self.source / PACKAGE
        self.paths = sorted(self.package.rglob("*.py"))
        if not self.paths:
            raise SystemExit(f"{source}: no modules in {PACKAGE}/")
        self.modules = {self.name_of(path): path for path in self.paths}
        self.parsed = {path: ast.parse(path.read_text()) for path in self.paths}

    def name_of(self, path: Path) -> str:
        """Return the dotted name of a module."""
        parts = path.relative_to(self.source).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def place(self, path: Path, node: ast.AST | int) -> str:
        """Return file:line."""
        line = node if isinstance(node, int) else getattr(node, "lineno", 0)
        return f"{path.relative_to(self.source)}:{line}"


def lines_per_folder(tree: Tree) -> dict[str, dict[str, int]]:
    """Return modules and lines of each folder of the package, of its own files, of all, and of the tests."""
    table: dict[str, dict[str, int]] = {}
    tests = sorted((tree.source / "tests").rglob("*.py"))
    for path in (*tree.paths, *tests):
        parts = path.relative_to(tree.source).parts
        in_tests = parts[0] == "tests"
        folder = parts[1] if len(parts) > 2 and not in_tests else "(top level)"
        lines = len(path.read_text().splitlines())
        for key in ("tests",) if in_tests else (folder, "(package)"):
            row = table.setdefault(key, {"modules": 0, "lines": 0})
            row["modules"] += path.name != "__init__.py"
            row["lines"] += lines
    return dict(sorted(table.items()))


# --- imports ---------------------------------------------------------------------------------------------------------


def imports_of(tree: Tree, path: Path) -> set[str]:
    """Return the modules of the package that a module imports at run time."""
    found: set[str] = set()
    own = tree.name_of(path).split(".")
    for node in _at_run_time(tree.parsed[path]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = own[: len(own) - node.level + (path.name == "__init__.py")]
                base = ".".join((*up, *([base] if base else [])))
            found |= {full if (full := f"{base}.{alias.name}") in tree.modules else base for alias in node.names}
    return {name for name in found if name in tree.modules}


def _at_run_time(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from _at_run_time(child)


def import_figures(tree: Tree) -> dict[str, Any]:
    """Return modules, levels, edges and a longest chain of ``engine/``, and of what the virtual lights import of it."""
    engine = tree.package / "engine"
    inside = {tree.name_of(p): p for p in tree.paths if engine in p.parents and p.name != "__init__.py"}
    graph = {name: sorted(imports_of(tree, path) & set(inside) - {name}) for name, path in inside.items()}
    figures = {"engine": _chain_figures(graph)}
    start = f"{PACKAGE}.engine.virtual_lights.engine"
    if start in graph:
        reached, left = set(), [start]
        while left:
            name = left.pop()
            if name not in reached:
                reached.add(name)
                left += graph[name]
        figures["reached from virtual_lights/engine"] = _chain_figures({name: graph[name] for name in reached})
    return figures


def _chain_figures(graph: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    longest: dict[str, list[str]] = {}
    cycles: list[str] = []

    def chain(name: str, above: tuple[str, ...] = ()) -> list[str]:
        if name in above:
            cycles.append(" -> ".join((*above[above.index(name) :], name)))
            return []
        if name not in longest:
            longest[name] = [name, *max((chain(other, (*above, name)) for other in graph[name]), key=len, default=[])]
        return longest[name]

    way = max((chain(name) for name in graph), key=len, default=[])
    return {
        "modules": len(graph),
        "levels": len(way),
        "edges": sum(map(len, graph.values())),
        "longest_chain": [name.removeprefix(f"{PACKAGE}.engine.") for name in way],
        "cycles": cycles,
    }


def duplicated_names(tree: Tree) -> dict[str, list[str]]:
    """Return module names that occur more than once in the package, and where."""
    names = Counter(path.stem for path in tree.paths if path.name != "__init__.py")
    return {
        name: [str(path.relative_to(tree.package)) for path in tree.paths if path.stem == name]
        for name, count in sorted(names.items())
        if count > 1
    }


# --- engines and constants -------------------------------------------------------------------------------------------


def engine_checks(tree: Tree) -> list[str]:
    """Return the places that ask which engine they have."""
    engine = tree.package / "engine"
    defined = {
        node.name: path
        for path, parsed in tree.parsed.items()
        for node in parsed.body
        if isinstance(node, ast.ClassDef) and node.name.endswith("Engine")
    }
    places = []
    for path, parsed in tree.parsed.items():
        for node in ast.walk(parsed):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance"):
                continue
            names = {name for name in re.findall(r"\w+", ast.unparse(node.args[-1])) if name.endswith("Engine")}
            homes = {defined[name] for name in names if name in defined}
            own = {folder for home in homes if (folder := home.parent) not in (engine, tree.package)}
            is_exempt = path.stem == "planner" or path in homes or own & set(path.parents)
            if names and not is_exempt:
                places.append(f"{tree.place(path, node)} {', '.join(sorted(names))}")
    return places


def patched_constants(tree: Tree) -> dict[str, list[str]]:
    """Return the constants of modules that tests, and the package, set from outside, and where."""
    found: dict[str, list[str]] = {}
    for path in sorted({*(tree.source / "tests").rglob("*.py"), *tree.paths}):
        parsed = tree.parsed.get(path) or ast.parse(path.read_text())
        modules = _imported_names(parsed)
        for node in ast.walk(parsed):
            for name in _set_from_outside(node, modules):
                found.setdefault(name, []).append(tree.place(path, node))
    return dict(sorted(found.items()))


def _imported_names(parsed: ast.Module) -> set[str]:
    """Return the names in lower case that a module imports: modules, as far as can be told."""
    aliases = (a for n in ast.walk(parsed) if isinstance(n, ast.Import | ast.ImportFrom) for a in n.names)
    return {name for alias in aliases if (name := alias.asname or alias.name.split(".")[0]).islower()}


def _set_from_outside(node: ast.AST, modules: set[str]) -> Iterator[str]:
    if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            if isinstance(target, ast.Attribute) and CONSTANT.fullmatch(target.attr):
                owner = ast.unparse(target.value)
                if owner.split(".")[0] in modules:
                    yield target.attr
    if not isinstance(node, ast.Call):
        return
    function = ast.unparse(node.func)
    texts = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
    if not texts or not re.search(r"(^|\.)(setattr|patch|patch\.object)$", function):
        return
    name = texts[0].rsplit(".", 1)[-1]
    if CONSTANT.fullmatch(name):
        yield name


def constants(tree: Tree) -> list[dict[str, Any]]:
    """Return module-level numbers and fields of tunings: name, place, and whether they have a word and an origin."""
    rows = []
    for path, parsed in tree.parsed.items():
        text = path.read_text().splitlines()
        comments = _comments(path)
        for body, node, name in _numeric_assignments(parsed, path):
            words = _words_about(node, body, text, comments)
            where = {"name": name, "place": tree.place(path, node), "value": ast.unparse(node.value)}
            rows.append(where | {"has_words": bool(words), "has_origin": bool(ORIGIN.search(words))})
    return rows


def _numeric_assignments(parsed: ast.Module, path: Path) -> Iterator[tuple[list[ast.stmt], Any, str]]:
    for node in parsed.body:
        if isinstance(node, ast.ClassDef) and (node.name.endswith("Tuning") or path.stem == "tuning"):
            for field in node.body:
                if isinstance(field, ast.AnnAssign) and field.value is not None and _is_number(field.value):
                    yield node.body, field, f"{node.name}.{ast.unparse(field.target)}"
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and _is_number(node.value):
            names = [name for target in targets for name in re.findall(r"\w+", ast.unparse(target))]
            if names and all(CONSTANT.fullmatch(name) for name in names):
                yield parsed.body, node, ", ".join(names)


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers, operators, tuples and other constants, and has a number in it."""
    nodes = list(ast.walk(value))
    allowed = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple, ast.Name, ast.Attribute, ast.operator, ast.unaryop)
    numbers = [n.value for n in nodes if isinstance(n, ast.Constant)]
    is_plain = all(isinstance(n, (*allowed, ast.expr_context)) for n in nodes)
    are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
    return is_plain and bool(numbers) and are_numbers


def _comments(path: Path) -> dict[int, tuple[str, bool]]:
    """Return the comment of each line that has one, and whether it stands alone."""
    with path.open("rb") as file:
        tokens = [t for t in tokenize.tokenize(file.readline) if t.type == tokenize.COMMENT]
    return {t.start[0]: (t.string, not t.line[: t.start[1]].strip()) for t in tokens}


def _words_about(node: Any, body: list[ast.stmt], text: list[str], comments: Mapping[int, tuple[str, bool]]) -> str:
    words = [comments[line][0] for line in range(node.lineno, node.end_lineno + 1) if line in comments]
    for step, line in ((-1, node.lineno - 1), (1, node.end_lineno + 1)):
        while line in comments and comments[line][1]:
            words.append(comments[line][0])
            line += step
    following = body[index + 1] if (index := body.index(node)) + 1 < len(body) else None
    if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
        words.append(str(following.value.value))
    return " ".join(words)


def longest_functions(tree: Tree) -> list[tuple[int, str]]:
    """Return the longest functions: lines, docstrings included, and place with name."""
    rows = [
        (node.end_lineno - node.lineno + 1, f"{tree.place(path, node)} {node.name}")
        for path, parsed in tree.parsed.items()
        for node in ast.walk(parsed)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno
    ]
    return sorted(rows, reverse=True)[:N_LONGEST]


# --- the way of a batch ----------------------------------------------------------------------------------------------

TRACER = """
import runpy, sys, json
package, config, target, report = sys.argv[1:]
calls, outermost, is_over = {}, None, False

def watch(frame, event, arg):
    global outermost, is_over
    if is_over or event not in ("call", "return"):
        return
    code = frame.f_code
    if outermost is None:
        owner = type(frame.f_locals.get("self")).__name__
        if event != "call" or code.co_name != "render" or not owner.endswith("Engine"):
            return
        if not code.co_filename.startswith(package):
            return
        outermost = frame
    if event == "return":
        is_over = frame is outermost
    elif code.co_filename.startswith(package):
        calls.setdefault((code.co_filename[len(package):], code.co_qualname))

sys.setprofile(watch)
sys.argv = ["nlosrender", "render", config, "-o", target, "--overwrite", "-q"]
try:
    runpy.run_module("nlosrender", run_name="__main__")
except SystemExit as end:
    code = end.code
sys.setprofile(None)
with open(report, "w") as file:
    json.dump(list(calls), file)
sys.exit(code)
"""


def batch_figures(tree: Tree) -> dict[str, Any]:
    """Render a small capture by each engine; return what its batch enters."""
    cases = {case.name: case for case in capture_cases()}
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder)
        for engine, case in BATCHES.items():
            config, target, report = (folder / f"{case}.{suffix}" for suffix in ("yaml", "hdf5", "json"))
            config.write_text(yaml.safe_dump(dict(cases[case].config)))
            command = [sys.executable, "-c", TRACER, f"{tree.package}{os.sep}", *map(str, (config, target, report))]
            environment = os.environ | {"PYTHONPATH": str(tree.source), "PYTHONDONTWRITEBYTECODE": "1"}
            options = {"capture_output": True, "text": True, "timeout": MAX_SECONDS}
            done = subprocess.run(command, env=environment, cwd=folder, check=False, **options)
            if done.returncode != 0:
                raise SystemExit(f"{case}: exit code {done.returncode}\n{done.stderr[-1500:]}")
            calls = json.loads(report.read_text())
            if not calls:
                raise SystemExit(f"{case}: no method `render` of a class named ...Engine was called")
            inside = [file for file, _ in calls if file.startswith("engine/")]
            figures[engine] = {"case": case, "engine": way_of(inside), "package": way_of([file for file, _ in calls])}
    return figures


def way_of(files: Sequence[str]) -> dict[str, Any]:
    """Return functions, files and returns of a list of the files of functions, in the order of first calls."""
    entered, returns, last = dict.fromkeys(files[:1]), 0, files[0] if files else ""
    for file in files:
        returns += file != last and file in entered
        entered.setdefault(file)
        last = file
    return {"functions": len(files), "files": len(entered), "returns": returns, "entered": list(entered)}


# --- report ----------------------------------------------------------------------------------------------------------


def suite_seconds(path: Path) -> dict[str, float]:
    """Return seconds and number of tests of a JUnit report."""
    suites = list(ElementTree.parse(path).getroot().iter("testsuite"))
    return {key: sum(float(suite.get(key, 0)) for suite in suites) for key in ("time", "tests")}


def figures_of(source: Path, *, junit: Path | None = None, batches: bool = True) -> dict[str, Any]:
    """Return all figures of a tree."""
    tree = Tree(source)
    numbers = constants(tree)
    return {
        "lines": lines_per_folder(tree),
        "imports": import_figures(tree),
        "duplicated_names": duplicated_names(tree),
        "engine_checks": engine_checks(tree),
        "patched_constants": patched_constants(tree),
        "constants": {
            "all": len(numbers),
            "in_virtual_lights": sum("virtual_lights" in row["place"] for row in numbers),
            "without_a_word": [row for row in numbers if not row["has_words"]],
            "without_an_origin": [row for row in numbers if not row["has_origin"]],
        },
        "longest_functions": longest_functions(tree),
        "batches": batch_figures(tree) if batches else {},
        "suite": suite_seconds(junit) if junit else {},
    }


def printed(figures: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of the table."""
    yield "folder                modules    lines"
    for folder, row in figures["lines"].items():
        yield f"{folder:20} {row['modules']:8} {row['lines']:8}"
    for name, row in figures["imports"].items():
        yield f"\nimports, {name}: {row['modules']} modules, {row['levels']} levels, {row['edges']} edges"
        yield f"  longest chain: {' > '.join(row['longest_chain'])}"
        yield from (f"  cycle: {cycle}" for cycle in row["cycles"])
    yield f"\nmodule names that occur more than once: {len(figures['duplicated_names'])}"
    yield from (f"  {name}: {', '.join(paths)}" for name, paths in figures["duplicated_names"].items())
    yield f"\nchecks of engines: {len(figures['engine_checks'])}"
    yield from (f"  {place}" for place in figures["engine_checks"])
    patched = figures["patched_constants"]
    yield f"\npatched constants: {len(patched)} names in {sum(map(len, patched.values()))} places"
    yield from (f"  {name}: {', '.join(places)}" for name, places in patched.items())
    numbers = figures["constants"]
    for key in ("without_a_word", "without_an_origin"):
        rows = numbers[key]
        ours = sum("virtual_lights" in row["place"] for row in rows)
        of_all = f"of {numbers['all']} constants, {ours} of {numbers['in_virtual_lights']} in virtual_lights"
        yield f"\nconstants {key.replace('_', ' ')}: {len(rows)} {of_all}"
        yield from (f"  {row['place']} {row['name']} = {row['value']}" for row in rows)
    yield "\nlongest functions"
    yield from (f"  {lines:5} {place}" for lines, place in figures["longest_functions"])
    for engine, row in figures["batches"].items():
        for part, way in ((part, row[part]) for part in ("engine", "package")):
            counts = f"{way['functions']} functions, {way['files']} files, {way['returns']} returns"
            yield f"\nbatch of {engine} ({row['case']}), files of {part}: {counts}"
            yield f"  {' '.join(way['entered'])}"
    if figures["suite"]:
        yield f"\nsuite: {figures['suite']['tests']:.0f} tests, {figures['suite']['time']:.0f} s"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, default=Path(), metavar="TREE", help="default: the current folder")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--junit", type=Path, metavar="FILE", help="of the suite (pytest --junit-xml): its seconds")
    parser.add_argument("--no-batches", action="store_true", help="render nothing")
    chosen = parser.parse_args(arguments)
    figures = figures_of(chosen.source, junit=chosen.junit, batches=not chosen.no_batches)
    print(json.dumps(figures, indent=1) if chosen.json else "\n".join(printed(figures)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
